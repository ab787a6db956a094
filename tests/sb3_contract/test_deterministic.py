"""SB3's contract: equal seeds give equal results to the bit."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.noise import NormalActionNoise

from tests.sb3_contract.helpers import make_gac, pendulum, vectorized


def _train_and_act(seed, n_envs, **kwargs):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    env = vectorized(pendulum, n_envs)
    model = make_gac(env, seed=seed, action_noise=noise, train_freq=4, learning_starts=100, **kwargs).learn(300)
    env, obs, actions, rewards = model.get_env(), model.get_env().reset(), [], []
    for _ in range(50):
        actions.append(model.predict(obs, deterministic=False)[0])
        obs, reward, _, _ = env.step(actions[-1])
        rewards.append(reward)
    return np.array(actions), np.array(rewards), model


@pytest.mark.parametrize(("n_envs", "guider"), [(1, "residual"), (2, "independent")])
def test_equal_seeds_equal_training(n_envs, guider):
    runs = [_train_and_act(seed, n_envs, guider=guider) for seed in (0, 0, 1)]
    (actions, rewards, model), (same_actions, same_rewards, same), (other_actions, _, _) = runs
    np.testing.assert_array_equal(actions, same_actions)
    np.testing.assert_array_equal(rewards, same_rewards)
    for tensor, same_tensor in zip(model.policy.state_dict().values(), same.policy.state_dict().values(), strict=True):
        assert th.equal(tensor, same_tensor)
    assert not np.array_equal(actions, other_actions)
