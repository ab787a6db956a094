"""
What of EnvPool its adapter meets, in Python, with the same traps.

A pool's random numbers depend on the seeds that it was built with; a step after an end begins the next episode, ignores its
action and has reward 0; ``done`` at the limit is told with ``trunc``, a fall or not; a reset returns the rows that were asked
for, here in an order of its own, which ``info["env_id"]`` tells; all is in double precision.
"""

from types import SimpleNamespace

import numpy as np
from gymnasium import spaces

FALL = 7  # an episode of environment i ends by a fall after FALL + i steps
LIMIT = 20
TASKS = {"Walk-v1": ("state", "privileged_state"), "MuJoCoPlayground/Go1JoystickFlatTerrain-v1": ("state", "privileged_state")}
FLAT = "Flat-v1"
built = []


def list_all_envs():
    """Ids of tasks."""
    return [*TASKS, FLAT]


def make_spec(task_id, max_episode_steps=LIMIT, scale=1.0, **unused):
    """Spaces and configuration of a task."""
    entry = spaces.Box(-np.inf, np.inf, (4,), np.float64)
    flat = task_id == FLAT
    return SimpleNamespace(
        gymnasium_observation_space=entry if flat else spaces.Dict({"state": entry, "privileged_state": entry}),
        gymnasium_action_space=spaces.Box(-1.0, 1.0, (2,), np.float64),
        config=SimpleNamespace(max_episode_steps=max_episode_steps),
    )


def make(task_id, env_type, num_envs, num_threads, env_seed, max_episode_steps, scale=1.0):
    """A pool."""
    assert env_type == "gymnasium"
    built.append({"seeds": list(env_seed), "threads": num_threads})
    return Pool(task_id == FLAT, env_seed, max_episode_steps, scale)


class Pool:
    """
    The observation is ``elapsed`` steps, ``drawn`` at the episode's start, the sum of the last action, and the environment's
    number; ``state`` has noise of the simulator's own in the place of the last one.
    """

    def __init__(self, is_flat, seeds, limit, scale):
        self.flat, self.limit, self.scale = is_flat, limit, scale
        self.generators = [np.random.default_rng(seed) for seed in seeds]
        self.n = len(seeds)
        self.elapsed, self.drawn, self.acted = (np.zeros(self.n) for _ in range(3))
        self.done = np.ones(self.n, dtype=bool)

    def _begin(self, index):
        self.elapsed[index], self.acted[index], self.done[index] = 0, 0, False
        self.drawn[index] = self.generators[index].random()

    def _rows(self, ids):
        clean = np.stack([self.elapsed, self.drawn, self.acted, np.arange(self.n)], axis=1)[ids]
        info = {"env_id": ids.astype(np.int32), "elapsed_step": self.elapsed[ids].astype(np.int32), "height": clean[:, 1]}
        return (clean if self.flat else {"state": clean * [1, 1, 1, 0.5], "privileged_state": clean}), info

    def reset(self, env_id):
        assert env_id.dtype == np.int32
        for index in env_id:
            self._begin(index)
        return self._rows(env_id[::-1])

    @property
    def _state_keys(self):
        of_observation = ["obs"] if self.flat else ["obs:state", "obs:privileged_state"]
        return [*of_observation, "reward", "done", "trunc", *(f"info:{name}" for name in ("env_id", "elapsed_step", "height"))]

    def _recv(self):
        observation, info = self._rows(np.arange(self.n))
        return [*([observation] if self.flat else observation.values()), *self.returned, *info.values()]

    def send(self, actions):
        assert np.abs(actions).max() <= 1
        rewards = np.zeros(self.n)
        trunc = np.zeros(self.n, dtype=bool)
        for index in range(self.n):
            if self.done[index]:
                self._begin(index)
                continue
            self.elapsed[index] += 1
            self.acted[index] = actions[index].sum()
            rewards[index] = self.scale * self.acted[index]
            trunc[index] = self.elapsed[index] >= self.limit
            self.done[index] = trunc[index] or self.elapsed[index] == FALL + index
        self.returned = rewards, self.done.copy(), trunc
