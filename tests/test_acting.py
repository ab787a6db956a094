"""How data is collected: warm-up, noise, ranges of actions, exploration, rates that follow a schedule; for every algorithm."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule

from sb3_gac import GAC, AsymmetricSAC
from sb3_gac.algorithms import name_of
from tests.helpers import Sampled, optimizers_of, small_model, unlike_each_other
from tests.plain.replay import Recorded
from tests.registry import LINES, classes

ALGORITHMS = pytest.mark.parametrize("cls", classes("replay"))


def _far_up():
    """Noise that takes every action over its upper bound."""
    return NormalActionNoise(np.full(2, 10.0), np.zeros(2))


#: What remembers goes along from the first step on
FORGETFUL = [kind for kind in classes("replay") if not LINES[name_of(kind)].remembers]


@pytest.mark.parametrize("cls", FORGETFUL)
def test_the_behaviour_policy_acts_from_the_first_step_after_warm_up(cls):
    model = small_model(Recorded(), cls, learning_starts=10)
    steps, behave = [], model.policy.behaviour_action

    def spy(*args, **kwargs):
        steps.append(model.num_timesteps)
        return behave(*args, **kwargs)

    model.policy.behaviour_action = spy
    model.learn(20)
    assert steps == list(range(10, 20))


@ALGORITHMS
@pytest.mark.parametrize("warm_up", [0, 1000])
def test_the_environment_gets_actions_in_its_range_and_the_buffer_the_same_scaled(cls, warm_up):
    env = Recorded()
    model = small_model(env, cls, learning_starts=warm_up).learn(30)
    taken = np.array([step.action for step in env.steps])
    low, high = env.action_space.low, env.action_space.high
    stored = model.replay_buffer.actions[:30, 0]
    np.testing.assert_allclose(2 * (taken - low) / (high - low) - 1, stored, atol=1e-6)
    assert (np.ptp(taken, axis=0) > 0.3 * (high - low)).all(), "it explores"


@ALGORITHMS
def test_noise_is_added_and_clipped(cls):
    env = Recorded()
    model = small_model(env, cls, learning_starts=0, action_noise=_far_up()).learn(12)
    np.testing.assert_array_equal(model.replay_buffer.actions[:12, 0], 1.0)
    np.testing.assert_array_equal([step.action for step in env.steps], [env.action_space.high] * 12)


@pytest.mark.parametrize("shape", [(2, 2), (4, 1)])
@pytest.mark.parametrize("of_noise", ["flat", "in the actions' shape"])
def test_noise_is_added_to_actions_of_any_shape(shape, of_noise):
    """Component by component: the first one's noise is far up, the others' far down."""
    shown = {key: spaces.Box(-1, 1, (2,), np.float32) for key in ("partial", "privileged")}
    env = Sampled(spaces.Dict(**shown), spaces.Box(-1, 1, shape, np.float32))
    mean = np.array([9.0, -9, -9, -9])
    noise = NormalActionNoise(
        mean if of_noise == "flat" else mean.reshape(shape), np.zeros(4 if of_noise == "flat" else shape)
    )
    model = small_model(env, learning_starts=0, action_noise=noise).learn(12)
    np.testing.assert_array_equal(model.replay_buffer.actions[:12, 0], np.tile([1.0, -1, -1, -1], (12, 1)))


@ALGORITHMS
@pytest.mark.parametrize("discrete", [False, True])
def test_the_behaviour_policy_explores_unless_it_is_asked_not_to(cls, discrete):
    model = small_model(Recorded(discrete), cls)
    obs = {"partial": np.zeros((200, 3), np.float32), "privileged": np.zeros((200, 2), np.float32)}
    explored, _ = model.policy.behaviour_action(obs)
    chosen, _ = model.policy.behaviour_action(obs, deterministic=True)
    assert len(np.unique(explored, axis=0)) > 1
    np.testing.assert_allclose(chosen, chosen[:1].repeat(200, axis=0), atol=1e-6)


@pytest.mark.parametrize("guider", ["residual", "independent"])
@pytest.mark.parametrize("shared_std", ["learner", "guider"])
def test_what_the_guider_does_is_what_its_distribution_says(guider, shared_std):
    """Its mode in the environment's range; and about that the std that both policies have."""
    model = small_model(Recorded(), guider=guider, shared_std=shared_std)
    unlike_each_other(model.policy, scale=0.2)
    obs = {"partial": np.full((4000, 3), 0.3, np.float32), "privileged": np.full((4000, 2), -0.2, np.float32)}
    with th.no_grad():
        distribution = model.policy.distributions(model.policy.obs_to_tensor(obs)[0]).guider
    low, high = model.action_space.low, model.action_space.high
    by_hand = low + (np.tanh(distribution.mean.numpy()) + 1) / 2 * (high - low)
    chosen, _ = model.predict_guider(obs, deterministic=True)
    np.testing.assert_allclose(chosen, by_hand, atol=1e-5)
    sampled, _ = model.predict_guider(obs)
    np.testing.assert_allclose(
        np.arctanh(np.clip(2 * (sampled - low) / (high - low) - 1, -1 + 1e-6, 1 - 1e-6)).std(axis=0),
        distribution.log_std[0].exp().numpy(),
        rtol=0.05,
    )


@pytest.mark.parametrize("cls", classes("replay", "memory"))
@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputGruPolicy", "MultiInputLstmPolicy"])
def test_predict_gives_actions_in_the_environments_range_and_samples_on_request(cls, policy):
    model = small_model(Recorded(), cls, policy=policy, policy_kwargs={"net_arch": [8]})
    unlike_each_other(model.policy, scale=0.2)
    obs = {"partial": np.full((500, 3), 0.3, np.float32)}
    actor = model.policy.deployed
    with th.no_grad():
        distribution, _ = actor.remember(actor.obs_to_tensor(obs)[0], None, None)
    low, high = model.action_space.low, model.action_space.high
    by_hand = low + (np.tanh(distribution.mean.numpy()) + 1) / 2 * (high - low)
    chosen, _ = model.predict(obs, deterministic=True)
    np.testing.assert_allclose(chosen, by_hand, atol=1e-5)
    sampled, _ = model.predict(obs)
    assert (sampled.std(axis=0) > 0.02).all()
    assert model.action_space.contains(sampled.min(axis=0))
    assert model.action_space.contains(sampled.max(axis=0))


@pytest.mark.parametrize("cls", classes("replay", "temperature"))
def test_all_rates_but_kl_coefs_follow_the_schedule(cls):
    model = small_model(cls=cls, learning_rate=LinearSchedule(1e-3, 5e-4, 1.0)).learn(50)
    expected = model.lr_schedule(model._current_progress_remaining)
    assert 5e-4 <= expected < 6e-4
    for optimizer in (*optimizers_of(model.policy), model.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(expected)
    if issubclass(cls, GAC):
        assert model.kl_coef_dual.optimizer.param_groups[0]["lr"] == model.kl_coef_learning_rate


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_rounding_does_not_lead_beyond_the_upper_bound(cls):
    low = np.random.default_rng(0).uniform(-3, -1, 1_000).astype(np.float32)
    high = np.random.default_rng(1).uniform(1, 3, 1_000).astype(np.float32)
    model = small_model(Sampled(Recorded().observation_space, spaces.Box(low, high)), cls, policy_kwargs={"net_arch": [2]})
    largest = np.ones((1, 1_000), np.float32)
    assert (BasePolicy.unscale_action(model.policy, largest) > high).any(), "as it would"
    for policy in (model.policy, model.policy.deployed):
        assert (policy.unscale_action(largest) <= high).all()
        np.testing.assert_array_equal(policy.unscale_action(-largest)[0], low)


def test_the_guider_acts_without_what_only_training_has():
    """Dropout, above all."""

    class Dropout(th.nn.Dropout):
        def __init__(self):
            super().__init__(0.5)

    model = small_model(Recorded(), policy_kwargs={"net_arch": [32], "activation_fn": Dropout}, guider="independent")
    model.policy.set_training_mode(True)
    observation = {"partial": np.ones((1, 3), np.float32), "privileged": np.ones((1, 2), np.float32)}
    for predict in (model.predict_guider, model.predict):
        model.policy.set_training_mode(True)
        actions = [predict(observation, deterministic=True)[0] for _ in range(5)]
        np.testing.assert_array_equal(actions, [actions[0]] * 5)
