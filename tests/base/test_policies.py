"""What networks are made of: targets, encoders, sizes."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_gac import GAC, AsymmetricSAC, GACShare
from sb3_gac.networks.heads import LOG_STD_BOUNDS, make_head
from sb3_gac.networks.layers import INITIALIZATIONS
from tests.helpers import Sampled, TwoViewBandit, TwoViewChoice, optimizers_of, small_model, unlike_each_other
from tests.registry import classes

IMAGE = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=spaces.Box(-1, 1, (2,), np.float32))
CNN = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}, "share_features_extractor": True}
ALGORITHMS = pytest.mark.parametrize("cls", classes("critics"))


def _critics(policy):
    """Each with its target."""
    return [policy.pairs[role] for role in policy.roles.critics if role in policy.pairs]


def _same(one, other):
    return all(th.equal(p, q) for p, q in zip(one.parameters(), other.parameters(), strict=True))


@ALGORITHMS
@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
def test_targets_start_as_their_critics_and_stay_until_they_are_averaged(cls, env):
    policy = small_model(env(), cls).policy
    for critic, target in _critics(policy):
        assert _same(critic, target)
        members = next(iter(critic.parameters()))
        assert not th.equal(members[0], members[1]), "two critics, not one twice"
        with th.no_grad():
            for parameter in critic.parameters():
                parameter.add_(1.0)
        before = [parameter.clone() for parameter in target.parameters()]
        policy.update_targets(0.25)
        for p, was in zip(target.parameters(), before, strict=True):
            th.testing.assert_close(p, was + 0.25)


@pytest.mark.parametrize("cls", classes("critics", "shared encoder"))
def test_a_targets_encoder_is_its_own_where_the_learners_is_shared(cls):
    """Or the target would follow the learner's loss at once, and not by averaging."""
    policy = small_model(Sampled(IMAGE), cls, policy_kwargs=CNN).policy
    of_deployed = {id(parameter) for parameter in policy.deployed.parameters()}
    for critic, target in _critics(policy):
        assert of_deployed & {id(parameter) for parameter in critic.parameters()}
        assert not of_deployed & {id(parameter) for parameter in target.parameters()}
        assert _same(critic, target)


@ALGORITHMS
def test_policies_and_critics_may_differ_in_size(cls):
    policy = small_model(cls=cls, policy_kwargs={"net_arch": {"pi": [8], "qf": [4, 5]}}).policy
    assert policy.deployed.net_arch == [8]
    pairs = _critics(policy)
    assert [critic.net_arch for pair in pairs for critic in pair] == [[4, 5]] * 2 * len(pairs)


@pytest.mark.parametrize(("guider", "starts_at_the_learner"), [("residual", True), ("independent", False)])
@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
def test_a_residual_guiders_correction_starts_near_zero(env, guider, starts_at_the_learner):
    """Weights and biases of its last layer; the std's are as they are in any network."""
    head = small_model(env(), guider=guider).policy.guider.head
    correction = head.mean if env is TwoViewBandit else head.logits
    for parameter in correction.parameters():
        assert (parameter.abs().max() < 0.01 * 16**-0.5) == starts_at_the_learner
    if env is TwoViewBandit:
        assert head.log_std.weight.abs().max() > 0.5 * 16**-0.5


def test_a_std_by_softplus_is_the_number_and_what_is_added():
    """log(1 + e^x) + 0.001 at -20, 0 and 3, in double precision; and the KL of two such Gaussians, which tanh leaves alone."""
    head = make_head(3, spaces.Box(-1, 1, (3,)), LOG_STD_BOUNDS, softplus_min_std=0.001).double()
    with th.no_grad():
        head.log_std.weight.copy_(th.eye(3))
        head.log_std.bias.zero_()
    outputs = th.tensor([[-20.0, 0.0, 3.0], [1.0, -4.0, 0.5]], dtype=th.float64)
    found = head(outputs)
    expected = [0.0010000020611536, 0.6941471805599453, 3.0495873515737420]
    th.testing.assert_close(found.log_std[0].exp(), th.tensor(expected, dtype=th.float64), rtol=1e-12, atol=0)
    one, other = (type(found)(mean, log_std) for mean, log_std in zip(found.mean, found.log_std, strict=True))
    plain = [
        th.distributions.Normal(each.mean, (1 + row.exp()).log() + 0.001)
        for each, row in zip((one, other), outputs, strict=True)
    ]
    th.testing.assert_close(one.kl(other), th.distributions.kl_divergence(*plain).sum())
    log_jacobian = (1 - other.mean.tanh().square()).log()
    th.testing.assert_close(one.log_prob(other.mean), (plain[0].log_prob(other.mean) - log_jacobian).sum())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"softplus_min_std": 0.0}, "softplus_min_std must be"),
        ({"softplus_min_std": 0.001, "log_std_bounds": (-3, 1)}, r"softplus_min_std=0.001 takes the place of log_std_bounds"),
        ({"initialization": "orthogonal"}, r"initialization must be one of \['lecun_uniform', 'torch'\], got 'orthogonal'"),
    ],
)
def test_options_of_networks_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        small_model(policy_kwargs=options)


@pytest.mark.parametrize("options", [{"cls": AsymmetricSAC}, {"guider": "residual"}, {"guider": "lagged"}, {"cls": GACShare}])
def test_lecuns_initialisation_is_torchs_times_the_root_of_three_without_biases(options):
    """Targets are what they follow, and a residual guider starts at the learner, as ever."""
    sizes = {"net_arch": [16, 16]}
    lecun = small_model(**options, policy_kwargs={**sizes, "initialization": "lecun_uniform"}).policy
    of_torch = dict(small_model(**options, policy_kwargs=sizes).policy.named_parameters())
    for name, parameter in lecun.named_parameters():
        factor = 0.0 if name.endswith("bias") else 3**0.5
        th.testing.assert_close(parameter, factor * of_torch[name], msg=lambda text, name=name: f"{name}: {text}")
    for network, target in lecun.pairs.values():
        assert _same(network, target)
    hidden = lecun.deployed.latent_net[2].weight
    assert (1 / 16) ** 0.5 < hidden.abs().max() <= (3 / 16) ** 0.5
    assert hidden.var().item() == pytest.approx(1 / 16, rel=0.2), "one over the inputs"


def test_lecuns_initialisation_reaches_an_encoder_that_is_shared_once():
    policies = [small_model(Sampled(IMAGE), policy_kwargs={**CNN, "initialization": name}).policy for name in INITIALIZATIONS]
    first = [next(p for name, p in policy.named_parameters() if "extractor" in name and p.dim() == 4) for policy in policies]
    th.testing.assert_close(first[1], 3**0.5 * first[0])


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_a_policy_that_is_saved_by_itself_is_the_same_again(cls, tmp_path):
    """With all that it was made with, whether a network shows it or not."""
    options = {
        "net_arch": [8, 4],
        "activation_fn": th.nn.Tanh,
        "log_std_bounds": (-3.0, -2.0),
        "initialization": "lecun_uniform",
        "n_critics": 3,
        "optimizer_class": th.optim.AdamW,
        "optimizer_kwargs": {"weight_decay": 0.25},
        "normalize_images": False,
    }
    policy = small_model(cls=cls, policy_kwargs=options).policy
    policy.save(tmp_path / "policy")
    again = type(policy).load(tmp_path / "policy")
    assert _same(policy, again)
    assert again.deployed.log_std_bounds == (-3.0, -2.0)
    assert again.constructor_options["initialization"] == "lecun_uniform"
    assert (again.deployed.activation_fn, again.n_critics, again.normalize_images) == (th.nn.Tanh, 3, False)
    for optimizer in optimizers_of(again):
        assert type(optimizer) is th.optim.AdamW
        assert optimizer.param_groups[0]["weight_decay"] == 0.25


@pytest.mark.parametrize(
    ("cls", "options"),
    [
        (GAC, {"guider": "independent", "shared_std": "guider", "max_kl": 0.01, "kl_reduction": "sum"}),
        (GACShare, {"guider": "residual", "shared_std": "learner"}),
        (GAC, {"policy_kwargs": {"net_arch": [8], "softplus_min_std": 0.2}}),
    ],
)
def test_a_policy_of_ones_own_options_that_is_saved_by_itself_is_the_same_again(cls, options, tmp_path):
    policy = small_model(cls=cls, **options).policy
    unlike_each_other(policy, 1.0)
    policy.save(tmp_path / "policy")
    again = type(policy).load(tmp_path / "policy")
    obs = {"partial": th.randn(7, 2), "privileged": th.randn(7, 1)}
    for ours, theirs in zip(policy.distributions(obs), again.distributions(obs), strict=True):
        th.testing.assert_close(ours, theirs)
    assert (policy.learner_critic is None) == (again.learner_critic is None) == (cls is GACShare)
