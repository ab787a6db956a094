"""Which loss moves which network: exactly those that it should, for every loss and every variant."""

from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_gac import GAC, GACShare, GACWithoutQ
from sb3_gac.base.update import scale_of
from sb3_gac.math.distributions import TanhGaussian
from sb3_gac.math.losses import critic_loss, distillation_loss, log_std_loss, policy_loss
from sb3_gac.optim.trained import TrainedParameters
from tests.gac.helpers import steps_of
from tests.helpers import small_model, unlike_each_other


def _observations(n=8):
    generator = th.Generator().manual_seed(0)
    return {"partial": th.randn(n, 2, generator=generator), "privileged": th.randn(n, 1, generator=generator)}


def _reached(policy, loss):
    """Names of the policy's parts in which the loss leaves a gradient."""
    for parameter in policy.parameters():
        parameter.grad = None
    loss.backward()
    touched = {name for name, p in policy.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}
    parts = {name.split(".")[0] for name in touched}
    if "learner" in parts:  # the learner's deployment log-std head is a part of its own
        of_learner = {name.removeprefix("learner.") for name in touched if name.startswith("learner.")}
        parts -= {"learner"}
        parts |= {"learner_log_std" if name.startswith("head.log_std.") else "learner" for name in of_learner}
    return parts


#: Guider, and whose std both policies have
FORMS = [("residual", "learner"), ("residual", "guider"), ("independent", "learner"), ("independent", "guider")]


@pytest.fixture(params=FORMS, ids="-".join)
def model(request):
    guider, shared_std = request.param
    return small_model(guider=guider, shared_std=shared_std)


def test_guider_loss_moves_the_guider_alone(model):
    obs = _observations()
    guider, learner, _ = model.policy.distributions(obs)
    kl = guider.kl_of_means(learner.detach())
    log_prob = guider.sample_with_log_prob(th.randn_like(guider.mean))[1]
    assert _reached(model.policy, policy_loss(q=th.zeros(2, 8), log_prob=log_prob, ent_coef=0.1, kl=kl, kl_coef=1.0)) == {
        "guider"
    }


@pytest.mark.parametrize(("guider", "shared_std"), FORMS)
def test_a_bound_on_kl_moves_neither_the_learner_nor_a_borrowed_std(guider, shared_std):
    model = small_model(guider=guider, shared_std=shared_std, max_kl=0.01)
    unlike_each_other(model.policy)
    distributions = model.policy.distributions(_observations())
    assert _reached(model.policy, distributions.guider.mean.sum()) == {"guider"}
    assert model.policy.guider.head.log_std.weight.grad is None, "the mean's place in the ball says nothing of its size"


def test_learner_kl_moves_the_learner_alone_and_not_its_log_std_head(model):
    guider, learner, _ = model.policy.distributions(_observations())
    kl = TanhGaussian(guider.mean.detach() + 0.1, guider.log_std).kl_of_means(learner)
    assert _reached(model.policy, distillation_loss(kl)) == {"learner"}


def test_learner_q_term_has_a_gradient_for_the_mean_and_for_the_std_unless_it_is_borrowed(model):
    obs = _observations()
    _, learner, _ = model.policy.distributions(obs)
    q = model.policy.learner_critic(obs, learner.sample())
    own = {"learner_log_std"} if model.shared_std == "learner" else set()
    assert _reached(model.policy, policy_loss(q=q, kl=th.zeros(8), kl_coef=1.0)) == {"learner", "learner_critic"} | own


def test_guider_q_term_has_a_gradient_for_the_mean_and_for_the_std_unless_it_is_borrowed(model):
    obs = _observations()
    guider, *_ = model.policy.distributions(obs)
    q = model.policy.guider_critic(obs, guider.sample())
    assert _reached(model.policy, -q.mean()) == {"guider", "guider_critic"}
    reaches_std = model.policy.guider.head.log_std.weight.grad is not None
    assert reaches_std == (model.shared_std == "guider")


def test_both_policies_have_one_std(model):
    guider, learner, _ = model.policy.distributions(_observations())
    assert th.equal(guider.log_std, learner.log_std)
    owner = getattr(model.policy, model.shared_std)
    assert th.equal(guider.log_std, owner(_observations()).log_std)


@pytest.mark.parametrize("guider", ["residual", "independent"])
def test_log_std_loss_moves_its_head_alone(guider):
    model = small_model(guider=guider, shared_std="guider")
    guider, _, deployed = model.policy.distributions(_observations())
    loss = log_std_loss(deployed.log_std, guider.log_std.detach() + 1)
    assert _reached(model.policy, loss) == {"learner_log_std"}


@pytest.mark.parametrize("part", ["guider_critic", "learner_critic"])
def test_each_critic_loss_moves_its_own_critics(model, part):
    q = getattr(model.policy, part)(_observations(), th.zeros(8, 1))
    assert _reached(model.policy, critic_loss(q, th.ones(8))) == {part}


def test_kl_does_not_move_the_std(model):
    guider, learner, _ = model.policy.distributions(_observations())
    kl = TanhGaussian(guider.mean + 0.1, guider.log_std).kl_of_means(learner.detach())
    for parameter in model.policy.parameters():
        parameter.grad = None
    kl.sum().backward()
    assert model.policy.guider.head.log_std.weight.grad is None
    assert model.policy.guider.head.mean.weight.grad is not None


def _changed_parts(model, update):
    before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    update()
    changed = {n for n, p in model.policy.named_parameters() if not th.equal(p, before[n])}
    return {name.split(".")[0] for name in changed}


def _filled(cls, **arguments):
    model = small_model(cls=cls, learning_starts=1000, **arguments)
    model.learn(64)
    return model


@pytest.mark.parametrize(
    ("cls", "critics"),
    [(GAC, {"guider_critic", "learner_critic"}), (GACShare, {"guider_critic"}), (GACWithoutQ, {"guider_critic"})],
)
def test_updates_leave_the_other_networks_bit_for_bit(cls, critics):
    model = _filled(cls)
    batch = model._sample_batch(32)
    steps = steps_of(model, batch)
    assert {step.network for step in steps} == critics | {"guider", "learner"}
    for network, loss, tensors in steps:
        update = partial(model.minimize, network, loss, *tensors)
        assert _changed_parts(model, update) == {network}
    targets = {f"{name}_target" for name in critics}
    assert _changed_parts(model, lambda: model.policy.update_targets(0.5)) == targets


@pytest.mark.parametrize("cls", [GAC, GACShare])
def test_policy_updates_leave_no_gradient_in_the_critics(cls):
    model = _filled(cls)
    batch = model._sample_batch(32)
    for network, loss, tensors in steps_of(model, batch):
        if "critic" not in network:
            model.minimize(network, loss, *tensors)
    assert all(p.grad is None for critic, _ in model.policy.pairs.values() for p in critic.parameters())


def test_learner_has_no_gradient_with_respect_to_privileged():
    model = small_model()
    obs = _observations()
    obs["privileged"].requires_grad_(True)
    obs["partial"].requires_grad_(True)
    mean, log_std = model.policy.learner.distribution(obs)
    (mean.sum() + log_std.sum()).backward()
    assert obs["privileged"].grad is None
    assert obs["partial"].grad.abs().sum() > 0


def test_learner_action_ignores_privileged_whatever_it_holds():
    model = small_model()
    partial = np.random.default_rng(0).standard_normal((5, 2)).astype(np.float32)
    alone, _ = model.predict({"partial": partial}, deterministic=True)
    for privileged in (np.zeros((5, 1)), np.full((5, 1), 1e6), np.full((5, 1), np.nan)):
        full, _ = model.predict({"partial": partial, "privileged": privileged.astype(np.float32)}, deterministic=True)
        np.testing.assert_array_equal(alone, full)


def test_guider_does_depend_on_privileged():
    model = small_model()
    obs = _observations()
    obs["privileged"].requires_grad_(True)
    model.policy.distributions(obs)[0].mean.sum().backward()
    assert obs["privileged"].grad.abs().sum() > 0


def test_a_log_std_head_that_is_fitted_has_no_say_in_the_clipping_of_the_learner():
    """Its gradient belongs to another loss: a huge one must not shrink the learner's."""
    model = _filled(GAC, max_grad_norm=1.0, shared_std="guider")
    head = list(model.policy.learner.head.log_std.parameters())
    parameters = model.policy.trained["learner"].everything
    assert [id(p) for p in parameters[-2:]] == [id(p) for p in head]
    trained = TrainedParameters(parameters, th.optim.SGD(parameters, lr=1.0), model.policy.unclipped("learner"))
    obs = _observations()
    norms, gradients = [], []
    for weight_of_head in (0.0, 1e6):
        before = [p.detach().clone() for p in parameters]
        mean, log_std = model.policy.learner.distribution(obs)
        found = th.autograd.grad(0.01 * mean.sum() + weight_of_head * log_std.sum(), parameters)
        norm = trained.norm(found)
        trained.step(found, scale_of([norm], 1.0))
        norms.append(norm.item())
        gradients.append([p - q.detach() for p, q in zip(before, parameters, strict=True)])
        with th.no_grad():
            for p, q in zip(parameters, before, strict=True):
                p.copy_(q)
    assert 0 < norms[0] < 1, "not clipped by itself"
    assert norms[1] == pytest.approx(norms[0], rel=1e-6)
    for alone, beside in zip(*(parts[:-2] for parts in gradients), strict=True):
        th.testing.assert_close(beside, alone, rtol=1e-4, atol=1e-6)
    assert gradients[1][-1].norm() > 1e5, "its own is left as it is"


class TestSharedEncoder:
    """With ``share_features_extractor`` the learner's loss alone trains the encoder that all look through."""

    @pytest.fixture
    def model(self):
        class Encoder(CombinedExtractor):
            """Has parameters even for vectors."""

            def __init__(self, observation_space):
                super().__init__(observation_space)
                self.linear = th.nn.Linear(self.features_dim, self.features_dim)

            def forward(self, observations):
                return self.linear(super().forward(observations))

        kwargs = {"net_arch": [16], "share_features_extractor": True, "features_extractor_class": Encoder}
        model = small_model(learning_starts=1000, policy_kwargs=kwargs)
        model.learn(64)
        return model

    def test_is_one_object(self, model):
        shared = model.policy.learner.features_extractor
        for part in (model.policy.guider, model.policy.guider_critic, model.policy.learner_critic):
            assert part.features_extractor is shared
        assert model.policy.learner_critic_target.features_extractor is not shared

    def test_critics_leave_it_and_the_learner_trains_it(self, model):
        batch = model._sample_batch(32)
        encoder = model.policy.learner.features_extractor.linear.weight
        before = encoder.detach().clone()
        for network, loss, tensors in steps_of(model, batch):
            assert th.equal(encoder, before)
            model.minimize(network, loss, *tensors)
        assert network == "learner"
        assert not th.equal(encoder, before)
        guider = model.policy.distributions(batch.observations).guider
        assert "learner" not in _reached(model.policy, guider.mean.sum() + guider.log_std.sum())

    def test_is_optimised_once_and_followed_by_the_targets(self, model):
        optimised = [id(p) for network in model.policy.trained.values() for p in network.parameters]
        assert len(optimised) == len(set(optimised))
        assert id(model.policy.learner.features_extractor.linear.weight) in optimised
        model.update(model._sample_batch(32))
        model.policy.update_targets(1.0)
        critic, target = model.policy.pairs["learner_critic"]
        assert all(th.equal(p, q) for p, q in zip(critic.parameters(), target.parameters(), strict=True))

    def test_saves_and_loads(self, model, tmp_path):
        model.save(tmp_path / "model")
        loaded = GAC.load(tmp_path / "model")
        assert loaded.policy.guider.features_extractor is loaded.policy.learner.features_extractor
        obs = {"partial": np.ones(2, np.float32)}
        np.testing.assert_array_equal(*(m.predict(obs, deterministic=True)[0] for m in (model, loaded)))


def test_shared_encoder_needs_a_privileged_view():
    kwargs = {"share_features_extractor": True}
    with pytest.raises(ValueError, match="share_features_extractor=True needs a guider_critic"):
        small_model(role_keys={"guider_critic": ["partial"]}, policy_kwargs=kwargs)
