"""SB3's contract: equal seeds give equal results to the bit."""

import numpy as np
import torch as th
from stable_baselines3.common.noise import NormalActionNoise

from tests.registry import algorithms, make, on_policy
from tests.sb3_contract.helpers import pendulum, vectorized


def _train_and_act(algorithm, seed):
    noise = {} if on_policy(algorithm) else {"action_noise": NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))}
    env = vectorized(pendulum, 2)
    model = make(algorithm, env, seed=seed, **noise).learn(60)
    env, obs, actions, rewards = model.get_env(), model.get_env().reset(), [], []
    for _ in range(20):
        actions.append(model.predict(obs, deterministic=False)[0])
        obs, reward, _, _ = env.step(actions[-1])
        rewards.append(reward)
    return np.array(actions), np.array(rewards), model


@algorithms()
def test_equal_seeds_equal_training(algorithm):
    runs = [_train_and_act(algorithm, seed) for seed in (0, 0, 1)]
    (actions, rewards, model), (same_actions, same_rewards, same), (other_actions, _, _) = runs
    np.testing.assert_array_equal(actions, same_actions)
    np.testing.assert_array_equal(rewards, same_rewards)
    for tensor, same_tensor in zip(model.policy.state_dict().values(), same.policy.state_dict().values(), strict=True):
        assert th.equal(tensor, same_tensor)
    assert not np.array_equal(actions, other_actions)
