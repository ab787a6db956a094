"""What pulls the learner towards the guider, in GAC and in its ablations."""

import math

import pytest
import torch as th

from sb3_gac import GAC, GACShare, GACWithoutQ
from sb3_gac.base.batch import Outputs
from sb3_gac.gac.policies import ActionDistributions
from sb3_gac.math.distributions import TanhGaussian
from tests.gac.helpers import batch_of
from tests.helpers import small_model


@pytest.mark.parametrize(("guider", "scale"), [("residual", 0.0), ("lagged", 1.0), ("independent", 1.0)])
def test_the_pull_towards_the_guider_is_there_where_it_can_close_a_gap(guider, scale):
    assert small_model(guider=guider).learner_kl_weight == scale
    assert small_model(guider=guider, learner_kl_scale=0.3).learner_kl_weight == 0.3


def test_auto_is_saved_as_given_and_follows_the_guider(tmp_path):
    small_model().save(tmp_path / "model")
    for guider, pull in (("residual", 0.0), ("independent", 1.0)):
        loaded = GAC.load(tmp_path / "model", guider=guider)
        assert (loaded.learner_kl_scale, loaded.learner_kl_weight) == ("auto", pull)


def test_a_residual_guiders_kl_does_not_depend_on_the_learner():
    """Why "auto" drops the pull: move the learner as far as you like, and KL stays what it was."""
    model = small_model()
    obs = {"partial": th.randn(32, 2), "privileged": th.randn(32, 1)}
    with th.no_grad():
        model.policy.guider.head.mean.bias.fill_(0.5)
        kls = []
        for shift in (0.0, 3.0):
            model.policy.learner.head.mean.bias.fill_(shift)
            guider, learner, _ = model.policy.distributions(obs)
            kls.append(guider.kl_of_means(learner))
    th.testing.assert_close(*kls, rtol=1e-4, atol=1e-6)
    assert kls[0].min() > 0.05


def test_ablations_have_the_critics_that_they_should():
    assert small_model(cls=GACShare).policy.learner_critic is None
    share = small_model(cls=GACShare)
    assert share.policy.critic is share.policy.guider_critic
    full = small_model()
    assert full.policy.critic is full.policy.learner_critic
    assert full.critic_target is full.policy.learner_critic_target


def _learner_gradient(model, obs, kl_coef):
    guider, learner = (Outputs(getattr(model.policy, role).distribution(obs), None) for role in ("guider", "learner"))
    loss = model.learner_loss(batch_of(obs), guider, learner, th.zeros(32, 1), th.tensor(kl_coef), th.tensor(1.0))
    return th.autograd.grad(loss.metrics["learner_loss"], model.policy.learner.head.mean.bias)[0]


@pytest.mark.parametrize("cls", [GACShare, GACWithoutQ])
@pytest.mark.parametrize("guider", ["residual", "independent"])
def test_ablations_keep_the_pull_whatever_the_guider(cls, guider):
    """By hand: the KL's gradient with respect to the learner's mean is (its mean - the guider's) / std^2."""
    model = small_model(cls=cls, guider=guider)
    obs = {"partial": th.randn(32, 2), "privileged": th.randn(32, 1)}
    with th.no_grad():
        model.policy.guider.head.mean.bias.fill_(0.5)
    now = model.policy.distributions(obs)
    by_hand = ((now.learner.mean - now.guider.mean) / now.guider.log_std.exp() ** 2).mean().detach()
    assert abs(by_hand) > 0.1
    pull = _learner_gradient(model, obs, 1.0)
    if cls is GACShare:  # which climbs critics too
        pull = pull - _learner_gradient(model, obs, 0.0)
    th.testing.assert_close(pull.squeeze(), by_hand, rtol=1e-4, atol=1e-5)


def test_without_q_the_learner_imitates_and_nothing_else(monkeypatch):
    model = small_model(cls=GACWithoutQ)
    learner = TanhGaussian(th.zeros(2, 1), th.full((2, 1), math.log(0.5)))
    guider = TanhGaussian(th.tensor([[0.2], [0.4]]), learner.log_std)
    monkeypatch.setattr(model.policy, "action_distributions", lambda *_: ActionDistributions(guider, learner, learner))
    outputs = Outputs(guider, None), Outputs(learner, None)
    loss = model.learner_loss(batch_of({}), *outputs, th.randn(2, 1), th.tensor(1.0), th.tensor(1.0))
    assert loss.metrics["learner_loss"].item() == pytest.approx(0.5 * (0.4**2 + 0.8**2) / 2)


def test_guidance_follows_its_schedule_and_stands_in_a_saved_model_as_it_was_given(tmp_path):
    model = small_model(guidance="linear 0.4 -> 0.0 over 0.5")
    assert model.is_guided
    for remaining, now in ((1.0, 0.4), (0.75, 0.2), (0.5, 0.0), (0.0, 0.0)):
        model._current_progress_remaining = remaining
        model.refresh_schedules()
        assert model.guidance_tensor.item() == pytest.approx(now)
    model.save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model")
    assert loaded.guidance == "linear 0.4 -> 0.0 over 0.5"
    assert loaded.guidance_schedule(0.75) == pytest.approx(0.2)


def test_a_learner_without_critics_refuses_guidance():
    with pytest.raises(ValueError, match="guidance would do nothing"):
        small_model(cls=GACWithoutQ, guidance=0.1)
    assert not small_model(cls=GACWithoutQ, guidance=0.0).is_guided


def test_a_lagged_guider_stands_at_the_learners_average_whatever_the_learner_is_by_now():
    """Where the residual one moves along; its KL tells how far the learner has absorbed the correction."""
    model = small_model(guider="lagged")
    obs = {"partial": th.randn(32, 2), "privileged": th.randn(32, 1)}
    with th.no_grad():
        before = model.policy.distributions(obs)
        model.policy.learner.head.mean.bias.add_(0.3)
        after = model.policy.distributions(obs)
        th.testing.assert_close(after.guider.mean, before.guider.mean)
        assert before.guider.kl_of_means(before.learner).max() < 1e-3
        shifted = 0.5 * (0.3 / after.learner.log_std.exp()).square().mean(-1)
        th.testing.assert_close(after.guider.kl_of_means(after.learner), shifted, rtol=0.05, atol=1e-3)
        model.policy.update_targets(1.0)
        assert model.policy.distributions(obs).guider.kl_of_means(after.learner).max() < 1e-3, "the average has followed"


def test_a_lagged_guider_refuses_memories():
    with pytest.raises(ValueError, match='guider="lagged" asks an average of the learner'):
        small_model(policy="MultiInputGruPolicy", guider="lagged", policy_kwargs={"rnn_hidden_size": 4, "rnn_net_arch": [4]})
