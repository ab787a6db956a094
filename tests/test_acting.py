"""How data is collected: warm-up, noise, ranges of actions, exploration, rates that follow a schedule; for every algorithm."""

import numpy as np
import pytest
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule

from sb3_gac import GAC, AsymmetricSAC, GACShare, GACWithoutQ
from tests.helpers import small_model
from tests.plain.replay import Recorded

ALGORITHMS = pytest.mark.parametrize("cls", [GAC, GACShare, GACWithoutQ, AsymmetricSAC])


def _far_up():
    """Noise that takes every action over its upper bound."""
    return NormalActionNoise(np.full(2, 10.0), np.zeros(2))


@ALGORITHMS
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


@ALGORITHMS
@pytest.mark.parametrize("discrete", [False, True])
def test_the_behaviour_policy_explores_unless_it_is_asked_not_to(cls, discrete):
    model = small_model(Recorded(discrete), cls)
    obs = {"partial": np.zeros((200, 3), np.float32), "privileged": np.zeros((200, 2), np.float32)}
    explored, _ = model.policy.behaviour_action(obs)
    chosen, _ = model.policy.behaviour_action(obs, deterministic=True)
    assert len(np.unique(explored, axis=0)) > 1
    np.testing.assert_allclose(chosen, chosen[:1].repeat(200, axis=0), atol=1e-6)


@ALGORITHMS
def test_all_rates_but_kl_coefs_follow_the_schedule(cls):
    model = small_model(cls=cls, learning_rate=LinearSchedule(1e-3, 5e-4, 1.0)).learn(50)
    expected = model.lr_schedule(model._current_progress_remaining)
    assert 5e-4 <= expected < 6e-4
    optimizers = [
        model.actor.optimizer,
        model.policy.critic_pairs["guider_critic" if cls is not AsymmetricSAC else "critic"][0].optimizer,
    ]
    for optimizer in (*optimizers, model.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(expected)
    if cls is not AsymmetricSAC:
        assert model.kl_coef_dual.optimizer.param_groups[0]["lr"] == model.kl_coef_learning_rate
