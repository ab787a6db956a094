"""Networks that take a step now and then rest in between: nothing of them moves, and rounds of gradient steps do not count."""

import numpy as np
import pytest
import torch as th

from sb3_gac import GAC, AsymmetricMPO, AsymmetricSAC, GACShare, GACWithoutQ
from tests.helpers import TwoViewBandit, small_model


def _model(cls=GAC, **arguments):
    return small_model(cls=cls, learning_starts=1000, **arguments).learn(40)


def _state(model, name):
    """All that a step changes of a network."""
    optimizer = model.policy.trained[name].optimizer
    steps = [state["step"].item() for state in optimizer.state.values()]
    return [p.detach().clone() for p in getattr(model.policy, name).parameters()], steps


def _moved(model, rounds):
    """Name -> the gradient steps in which it moved, of rounds of so many each."""
    names, moved, done = list(model.policy.trained), {}, 0
    update = model.update

    def watched(batch):
        nonlocal done
        before = {name: _state(model, name) for name in names}
        metrics = update(batch)
        for name in names:
            (parameters, steps), (parameters_now, steps_now) = before[name], _state(model, name)
            changed = any(not th.equal(p, q) for p, q in zip(parameters, parameters_now, strict=True))
            assert changed == (steps != steps_now) == (f"{name}_grad_norm" in metrics)
            if changed:
                moved.setdefault(name, []).append(done)
        done += 1
        return metrics

    model.update = watched
    for gradient_steps in rounds:
        model.train(gradient_steps, 8)
    return moved


@pytest.mark.parametrize("cls", [GAC, GACShare, GACWithoutQ, AsymmetricSAC, AsymmetricMPO])
@pytest.mark.parametrize("rounds", [(6,), (1,) * 6, (4, 2)])
def test_policies_are_delayed_over_all_gradient_steps(cls, rounds):
    model = _model(cls, policy_delay=3)
    moved = _moved(model, rounds)
    for name in model.policy.trained:
        assert moved[name] == ([0, 3] if name in model.policy.roles.policies else list(range(6))), name


@pytest.mark.parametrize(
    ("update_every", "expected"),
    [
        ({"guider": 3}, {"guider": [0, 3], "learner": [0, 2, 4], "guider_critic": 6, "learner_critic": 6}),
        ({"critic": 4, "learner_critic": 1}, {"guider_critic": [0, 4], "learner_critic": 6, "guider": [0, 2, 4]}),
        ({"critic": 2, "learner": 1}, {"guider_critic": [0, 2, 4], "learner_critic": [0, 2, 4], "learner": 6}),
    ],
)
def test_by_name_and_for_all_critics(update_every, expected):
    moved = _moved(_model(policy_delay=2, update_every=update_every), (6,))
    assert {name: moved[name] for name in expected} == {
        name: list(range(steps)) if isinstance(steps, int) else steps for name, steps in expected.items()
    }


def test_the_norm_that_is_logged_is_the_mean_of_the_steps_that_were_taken():
    model, norms = _model(policy_delay=2), []
    update = model.update
    model.update = lambda batch: norms.append(update(batch)) or norms[-1]
    model.train(4, 8)
    own = [metrics["learner_grad_norm"].item() for metrics in norms if "learner_grad_norm" in metrics]
    assert len(own) == 2
    assert model.logger.name_to_value["train/learner_grad_norm"] == pytest.approx(np.mean(own), rel=1e-5)


def test_a_policy_that_rests_is_learned_from_all_the_same():
    """Its loss is there to be logged, and the coefficients follow it."""
    model = _model(policy_delay=100)
    model.train(1, 8)
    before = model.kl_coef_dual.value.item()
    model.train(1, 8)
    assert "train/actor_loss" in model.logger.name_to_value
    assert model.kl_coef_dual.value.item() != before


class Uncompiled:
    """In the place of a program: what it is made of, and no compiler."""

    def __init__(self, function, device, when_it_fails):
        self.function = function

    def __call__(self, *args):
        return self.function(*args)


@pytest.fixture
def compiled(monkeypatch):
    """A model of AsymmetricSAC that keeps programs as it does where it compiles."""
    monkeypatch.setattr("sb3_gac.optim.compile.Program", Uncompiled)
    return _model(AsymmetricSAC, compile=True, policy_delay=2)


def test_a_step_with_networks_that_rest_is_a_program_of_its_own(compiled):
    compiled.train(4, 8)
    assert len(compiled.programs) == 2
    compiled.programs.clear()  # of what is watched they are made anew
    assert _moved(compiled, (4,))["actor"] == [0, 2]


@pytest.mark.parametrize(
    ("setting", "value"), [("max_grad_norm", 0.1), ("target_entropy", -3.0), ("mixed_precision", True), ("batch_size", 4)]
)
def test_what_a_program_takes_for_a_constant_is_in_its_key(compiled, setting, value):
    compiled.train(4, 8)
    compiled.train(2, 8)
    assert len(compiled.programs) == 2
    if setting == "batch_size":
        compiled.train(2, value)
    else:
        setattr(compiled, setting, value)
        compiled.train(2, 8)
    assert len(compiled.programs) == 4


def test_what_was_frozen_and_an_optimisers_options_are_in_its_key(compiled):
    compiled.train(2, 8)
    compiled.policy.actor.latent_net.requires_grad_(False)
    compiled.train(2, 8)
    assert len(compiled.programs) == 4
    compiled.policy.critic.optimizer.param_groups[0]["weight_decay"] = 0.1
    compiled.train(2, 8)
    assert len(compiled.programs) == 6
    compiled.policy.critic.optimizer.param_groups[0]["lr"] = 0.1  # which is a tensor
    compiled.train(2, 8)
    assert len(compiled.programs) == 6


def test_a_model_with_rests_goes_on_where_it_was(tmp_path):
    model = _model(policy_delay=3)
    model.train(4, 8)
    model.save_checkpoint(tmp_path)
    again = GAC.resume(tmp_path, TwoViewBandit(), device="cpu")
    again.set_logger(model.logger)
    assert _moved(again, (5,))["learner"] == [2]
