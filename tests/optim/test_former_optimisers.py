"""A network's optimiser: files of versions that laid all parameters out as one, and what can't be compiled."""

import pytest
import torch as th

from sb3_gac import GAC, AsymmetricSAC
from tests.helpers import TwoViewBandit, optimizers_of, small_model


def _as_one(state):
    """An optimiser's state as former versions kept it: of all trained parameters, end to end."""
    (group,) = state["param_groups"]
    trained = [entry for index, entry in sorted(state["state"].items()) if group["trained"][index]]
    flat = {name: th.cat([entry[name].flatten() for entry in trained]) for name in ("exp_avg", "exp_avg_sq")}
    return {"state": {0: {"step": trained[0]["step"], **flat}}, "param_groups": [{**group, "params": [0]}]}


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_states_of_former_versions_go_on_as_present_ones(cls):
    model = small_model(cls=cls)
    next(model.policy.deployed.latent_net.parameters()).requires_grad_(False)
    model.learn(40)
    present = model.get_parameters()
    former = {name: _as_one(state) if "policy." in name else state for name, state in present.items()}
    other = small_model(cls=cls)
    next(other.policy.deployed.latent_net.parameters()).requires_grad_(False)
    other.set_parameters(former)
    th.testing.assert_close(other.get_parameters(), present, rtol=0, atol=0)
    assert any(state["exp_avg"].abs().max() > 0 for o in optimizers_of(other.policy) for state in o.state.values())


@pytest.mark.parametrize(
    ("optimizer_class", "options"), [(th.optim.RMSprop, {}), (th.optim.SGD, {}), (th.optim.Adam, {"amsgrad": True})]
)
def test_an_optimiser_that_can_not_be_compiled_is_refused(optimizer_class, options):
    kwargs = {"net_arch": [4], "optimizer_class": optimizer_class, "optimizer_kwargs": options}
    with pytest.raises(
        ValueError, match=rf"torch's Adam and AdamW.* of learner is {optimizer_class.__name__}: choose another"
    ):
        small_model(TwoViewBandit(), compile=True, policy_kwargs=kwargs)
    small_model(TwoViewBandit(), policy_kwargs=kwargs).learn(20)
