"""What GAC learns, what it logs, and what it refuses; for its gradient step see tests/test_plain_step.py."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import LinearSchedule

from sb3_gac import GAC, AsymmetricSAC, GACShare, GACWithoutQ
from tests.helpers import TwoViewBandit, small_model, unlike_each_other
from tests.plain.replay import Recorded

LOGGED = {
    *("kl", "kl_p95", "kl_above_target", "target_kl", "kl_coef", "kl_coef_loss", "kl_coef_on_bound"),
    *("entropy", "ent_coef", "ent_coef_loss", "actor_loss", "guider_loss", "learner_loss", "critic_loss"),
    *("guider_critic_loss", "learner_critic_loss", "guider_critic_q", "learner_critic_q", "learning_rate", "n_updates"),
    *("guider_grad_norm", "learner_grad_norm", "guider_critic_grad_norm", "learner_critic_grad_norm"),
}


def test_residual_guider_starts_at_the_learner_and_its_kl_is_half_its_squared_output():
    model = small_model()
    obs = {"partial": th.randn(64, 2), "privileged": th.randn(64, 1)}
    guider, learner, _ = model.policy.distributions(obs)
    delta = model.policy.guider.distribution(obs).mean
    th.testing.assert_close(guider.kl_of_means(learner), 0.5 * delta.square().mean(-1), rtol=1e-3, atol=1e-6)
    assert guider.kl_of_means(learner).mean() < 1e-3


@pytest.mark.parametrize("shared_std", ["learner", "guider"])
@pytest.mark.parametrize("guider", ["residual", "independent"])
@pytest.mark.parametrize("kl_reduction", ["mean", "sum"])
def test_max_kl_bounds_the_kl_of_every_state(guider, kl_reduction, shared_std):
    """Of four action dimensions; KL by hand."""
    model = small_model(Recorded(n_actions=4), guider=guider, max_kl=0.01, kl_reduction=kl_reduction, shared_std=shared_std)
    unlike_each_other(model.policy)
    obs = {"partial": th.randn(64, 3), "privileged": th.randn(64, 2)}
    with th.no_grad():
        guider, learner, _ = model.policy.distributions(obs)
    per_dimension = 0.5 * ((guider.mean - learner.mean) / learner.log_std.exp()) ** 2
    kl = per_dimension.sum(dim=-1) / (4 if kl_reduction == "mean" else 1)
    assert kl.max().item() == pytest.approx(0.01, rel=1e-2), "met by some, exceeded by none"
    assert (per_dimension > 1e-8).sum(dim=-1).float().mean() > 3.5, "in every dimension"


def test_the_guider_collects_and_the_learner_is_evaluated():
    model = small_model()
    with th.no_grad():
        model.policy.guider.head.mean.bias.fill_(50.0)
    obs = TwoViewBandit().reset(seed=0)[0]
    assert model.predict_guider(obs, deterministic=True)[0][0] == pytest.approx(1.0)
    assert model.predict(obs, deterministic=True)[0][0] < 0.9
    model.num_timesteps = 10_000  # past the warm-up
    model._last_obs = {key: value[None] for key, value in obs.items()}
    action, scaled = model._sample_action(learning_starts=10)
    assert action.shape == scaled.shape == (1, 1)
    assert scaled[0, 0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("shared_std", "more"), [("learner", set()), ("guider", {"log_std_loss"})])
def test_everything_is_logged(shared_std, more):
    model = small_model(shared_std=shared_std)
    model.learn(30)
    logged = {name.removeprefix("train/") for name in model.logger.name_to_value if name.startswith("train/")}
    assert logged >= LOGGED | more
    assert ("log_std_loss" in logged) == ("log_std_loss" in more)
    values = [value for name, value in model.logger.name_to_value.items() if name.startswith("train/")]
    assert np.isfinite(values).all()


def test_logged_values_are_means_over_the_gradient_steps():
    model = small_model(kl_coef=0.5)
    model.learn(30)
    history = []
    original = model.update
    model.update = lambda *args: history.append(original(*args)) or history[-1]
    model.train(gradient_steps=5, batch_size=8)
    logged = model.logger.name_to_value
    for name in ("guider_critic_loss", "learner_critic_loss", "learner_loss", "kl_p95"):
        assert logged[f"train/{name}"] == pytest.approx(np.mean([step[name].item() for step in history]), rel=1e-5)
    assert logged["train/critic_loss"] == logged["train/guider_critic_loss"] + logged["train/learner_critic_loss"]
    assert logged["train/actor_loss"] == logged["train/learner_loss"]
    assert logged["train/kl_coef"] == 0.5


def test_targets_follow_at_their_interval():
    model = small_model(target_update_interval=3, learning_starts=1000)
    model.learn(30)
    updates = []
    model.policy.update_targets = lambda tau: updates.append((model._n_updates + 1, tau))
    for _ in range(7):
        model.train(gradient_steps=1, batch_size=8)
    model.train(gradient_steps=2, batch_size=8)
    assert updates == [(n, model.tau) for n in (3, 6, 9)], "counted over all gradient steps, not over those of one train()"


def test_target_kl_may_shrink_over_training():
    model = small_model(target_kl=LinearSchedule(0.02, 0.002, 0.5))
    model.learn(100)
    assert model.current_target_kl == pytest.approx(0.002)
    model._current_progress_remaining = 0.75
    assert model.current_target_kl == pytest.approx(0.011)
    violations, update = [], model.kl_coef_dual.update
    model.kl_coef_dual.update = lambda violation: violations.append(violation) or update(violation)
    model.train(gradient_steps=1, batch_size=8)
    kl, target = (model.logger.name_to_value[f"train/{name}"] for name in ("kl", "target_kl"))
    assert target == pytest.approx(0.011)
    assert violations[0].mean().item() == pytest.approx(kl - 0.011, abs=1e-6), "kl_coef steers to the bound of the moment"


@pytest.mark.parametrize(
    ("cls", "arguments", "steps"),
    [
        (GAC, {}, 700),
        (GAC, {"learner_entropy": False, "learning_rate": 5e-3}, 1000),
        (GAC, {"guider": "independent", "max_kl": 0.02}, 700),
        (GACShare, {}, 700),
        (GACWithoutQ, {"guider": "independent", "target_kl": 0.3, "learning_rate": 3e-3}, 1500),
    ],
    ids=["GAC", "as printed", "independent", "GACShare", "GACWithoutQ"],
)
def test_learner_reaches_the_known_optimum(cls, arguments, steps):
    """The target is in the partial view; random actions are 0.6 away from it on average."""
    arguments = {"learning_rate": 1e-2, "tau": 0.02, **arguments}
    model = small_model(TwoViewBandit(), cls, batch_size=64, learning_starts=100, **arguments)
    model.learn(steps)
    targets = np.linspace(-0.7, 0.7, 15, dtype=np.float32)
    partial = np.stack([targets, np.zeros_like(targets)], axis=1)
    actions, _ = model.predict({"partial": partial}, deterministic=True)
    assert np.abs(actions[:, 0] - targets).mean() < 0.06


def test_learner_averages_over_what_it_cannot_see():
    """Through noise the best action is the posterior mean, well inside the target's range; the guider sees the target."""
    model = small_model(TwoViewBandit(noise_std=0.5), learning_rate=5e-3, tau=0.02, batch_size=64, learning_starts=100)
    model.learn(1000)
    noise, targets = np.linspace(-1.2, 1.2, 9), np.linspace(-0.8, 0.8, 2001)
    likelihood = np.exp(-0.5 * ((noise[:, None] - targets) / 0.5) ** 2)
    posterior_mean = (likelihood * targets).sum(axis=1) / likelihood.sum(axis=1)
    partial = np.stack([noise, np.zeros(9)], axis=1).astype(np.float32)
    actions, _ = model.predict({"partial": partial}, deterministic=True)
    assert np.abs(actions[:, 0] - posterior_mean).mean() < 0.1
    assert np.abs(actions[:, 0] - noise).mean() > 0.2, "following the noise would be something else"


def test_kl_settles_at_its_target():
    rates = {"learning_rate": 3e-3, "kl_coef_learning_rate": 5e-3}
    model = small_model(TwoViewBandit(noise_std=0.5), batch_size=64, learning_starts=100, target_kl=0.02, **rates)
    kls = []
    original = model.update

    def spy(*args):
        metrics = original(*args)
        kls.append(metrics["kl"].item())
        return metrics

    model.update = spy
    model.learn(1200)
    assert np.mean(kls[-400:]) == pytest.approx(0.02, rel=0.25)


@pytest.mark.parametrize("truncate", [True, False])
def test_time_limits_bootstrap_and_terminations_do_not(truncate):
    """An episode of one step with reward 1 is worth 1 if it terminates, and 1 / (1 - gamma) if only time ran out."""

    class OneStep(gym.Env):
        observation_space = spaces.Dict(partial=spaces.Box(-1, 1, (1,)), privileged=spaces.Box(-1, 1, (1,)))
        action_space = spaces.Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {key: np.zeros(1, dtype=np.float32) for key in ("partial", "privileged")}, {}

        def step(self, action):
            return self.reset()[0], 1.0, not truncate, truncate, {}

    model = small_model(OneStep(), gamma=0.8, tau=0.3, ent_coef=0.0, kl_coef=0.0, learning_rate=1e-2, batch_size=32)
    model.learn(400)
    obs = {key: th.zeros(1, 1) for key in ("partial", "privileged")}
    expected = 5.0 if truncate else 1.0
    for critic in (model.policy.guider_critic, model.policy.learner_critic):
        assert critic(obs, th.zeros(1, 1)).detach().numpy() == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("cls", "arguments", "owner"),
    [
        (GAC, {}, "learner"),
        (GAC, {"learner_entropy": False}, "guider"),
        (GAC, {"guider": "independent"}, "guider"),
        (GAC, {"guider": "independent", "shared_std": "learner"}, "learner"),
        (GAC, {"shared_std": "guider"}, "guider"),
        (GACShare, {}, "learner"),
        (GACWithoutQ, {}, "guider"),
    ],
)
def test_whose_std_both_policies_have(cls, arguments, owner):
    policy = small_model(cls=cls, **arguments).policy
    assert policy.constructor_options["shared_std"] == owner
    assert policy.learner.owns_std == (owner == "learner")


@pytest.mark.parametrize(("cls", "arguments"), [(GAC, {"learner_entropy": False}), (GACWithoutQ, {})])
def test_a_learner_without_an_entropy_term_cannot_train_a_std(cls, arguments):
    with pytest.raises(ValueError, match='shared_std="learner" needs an entropy term'):
        small_model(cls=cls, shared_std="learner", **arguments)


def test_the_learners_update_is_that_of_sac_with_asymmetric_critics(monkeypatch):
    """With a residual guider the guider's only say is in the data: on the same batches and noise, the same networks."""
    arguments = {"ent_coef": 0.2, "learning_starts": 1000, "max_grad_norm": 1.0}
    model, sac = small_model(**arguments).learn(64), small_model(cls=AsymmetricSAC, **arguments)
    sac._setup_learn(64)
    pairs = [("learner", "actor"), ("learner_critic", "critic"), ("learner_critic_target", "critic_target")]
    for ours, theirs in pairs:
        getattr(sac.policy, theirs).load_state_dict(getattr(model.policy, ours).state_dict())
    for _ in range(5):
        batch, noise = model._sample_batch(32), th.randn(2, 32, 1)
        monkeypatch.setattr(th, "randn", lambda shape, noise=noise, **_: th.cat([th.zeros_like(noise), noise])[-shape[0] :])
        for one in (model, sac):
            one.update(batch)
            one.policy.update_targets(0.1)
        monkeypatch.undo()
    for ours, theirs in pairs:
        for name, value in getattr(model.policy, ours).state_dict().items():
            th.testing.assert_close(getattr(sac.policy, theirs).state_dict()[name], value, rtol=1e-4, atol=1e-6)


def test_target_entropy_conventions():
    assert small_model().target_entropy == -0.5
    assert small_model(target_entropy="sac").target_entropy == -1.0
    assert small_model(target_entropy=-2).target_entropy == -2.0


def test_optimizers_are_where_sac_has_them():
    model = small_model()
    for network in (model.actor, model.critic):
        of_optimizer = network.optimizer.param_groups[0]["params"]
        assert [id(p) for p in of_optimizer] == [id(p) for p in network.parameters()]
    assert model.policy.net_arch == [16]


def test_networks_learn_at_rates_of_their_own():
    scales = {"guider": 3.0, "critic": 2.0, "learner_critic": 5.0}
    model = small_model(learning_rate=LinearSchedule(1e-3, 5e-4, 1.0), lr_scales=scales)
    model.learn(50)
    networks = ("learner", "guider", "guider_critic", "learner_critic")
    rates = [getattr(model.policy, network).optimizer.param_groups[0]["lr"] for network in networks]
    assert rates[0] == pytest.approx(model.lr_schedule(model._current_progress_remaining))
    assert 0 < rates[0] < 1e-3
    assert np.array(rates) / rates[0] == pytest.approx([1.0, 3.0, 2.0, 5.0])
