"""An environment that writes down what it did, and whether a replay buffer holds just that."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv


class Diary:
    """
    What a number of environments did: (environment, episode, step) -> action, reward, terminated, truncated.

    ``training`` is false while somebody else uses them: what happens then must not be in the buffer.
    """

    def __init__(self) -> None:
        self.entries: dict[tuple[int, int, int], tuple[Any, float, bool, bool]] = {}
        self.training = True
        self.n_envs = 0
        self.interrupt_in: int | None = None

    def envs(self, n_envs: int, **kwargs: Any) -> DummyVecEnv:
        """New environments, with numbers of their own."""
        return DummyVecEnv([lambda: DiaryEnv(self, **kwargs)] * n_envs)


class DiaryEnv(gym.Env):
    """
    Its observations say where they come from: ``partial`` is (environment, episode, step), ``privileged`` one number of it.

    :param diary: to write into
    :param length: steps per episode, and one more in every other environment
    :param terminates: whether episodes terminate, instead of running into a time limit
    :param discrete: whether actions are numbered
    """

    def __init__(self, diary: Diary, length: int = 5, terminates: bool = False, discrete: bool = False):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-np.inf, np.inf, (3,), np.float32), privileged=spaces.Box(-np.inf, np.inf, (1,), np.float32)
        )
        self.action_space = spaces.Discrete(3) if discrete else spaces.Box(-2.0, 3.0, (2,), np.float32)
        self.diary, self.number, diary.n_envs = diary, diary.n_envs, diary.n_envs + 1
        self.length, self.terminates = length + self.number % 2, terminates
        self.episode, self.t = -1, 0

    @property
    def where(self) -> tuple[int, int, int]:
        return self.number, self.episode, self.t

    def _observation(self) -> dict[str, np.ndarray]:
        number = 10_000 * self.number + 100 * self.episode + self.t
        return {"partial": np.array(self.where, np.float32), "privileged": np.array([number], np.float32)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        if self.diary.interrupt_in is not None:
            self.diary.interrupt_in -= 1
            if self.diary.interrupt_in < 0:
                self.diary.interrupt_in = None
                raise KeyboardInterrupt
        reward, end = float(np.sum(action) + self.t), self.t + 1 >= self.length
        done = (end and self.terminates, end and not self.terminates)
        if self.diary.training:
            self.diary.entries[self.where] = (np.array(action), reward, *done)
        self.t += 1
        return self._observation(), reward, *done, {}

    def checkpoint_state(self) -> dict[str, Any]:
        return {"where": list(self.where), "length": self.length}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        (self.number, self.episode, self.t), self.length = state["where"], state["length"]


def stored_transitions(model: Any) -> list[tuple[tuple[int, ...], tuple[int, ...], Any, float, bool, bool]]:
    """(where, where next, action as the environment gets it, reward, done, timeout), of all that the buffer holds."""
    buffer, found = model.replay_buffer, []
    observations, next_observations = buffer.observations, buffer.next_observations
    for row in range(buffer.size()):
        for env in range(buffer.n_envs):
            action = buffer.actions[row, env]
            box = isinstance(model.action_space, spaces.Box)
            found.append(
                (
                    tuple(observations["partial"][row, env].astype(int).tolist()),
                    tuple(next_observations["partial"][row, env].astype(int).tolist()),
                    model.policy.unscale_action(action) if box else action[0],
                    float(buffer.rewards[row, env]),
                    bool(buffer.dones[row, env]),
                    bool(buffer.timeouts[row, env]),
                )
            )
    return found


def assert_true_and_whole(model: Any, diary: Diary, but: int = 0) -> None:
    """
    Each stored transition is one that happened, and each that happened is stored, once.

    :param model: whose buffer was never full
    :param diary: what its environments have written down
    :param but: how many of those that happened may be missing: an interrupted step of the others
    """
    found = stored_transitions(model)
    assert len({where for where, *_ in found}) == len(found), "a transition is stored twice"
    for where, after, action, reward, done, timeout in found:
        assert where in diary.entries, f"{where} -> {after} never happened"
        assert after == (*where[:2], where[2] + 1), f"{where} -> {after} never happened"
        happened = diary.entries[where]
        np.testing.assert_allclose(action, happened[0], rtol=1e-5, atol=1e-6, err_msg=f"at {where}")
        np.testing.assert_allclose(reward, happened[1], rtol=1e-5, atol=1e-5)
        assert (done, timeout) == (happened[2] or happened[3], happened[3]), f"at {where}"
    missing = sorted(set(diary.entries) - {where for where, *_ in found})
    assert len(missing) <= but, f"not stored: {missing}"
