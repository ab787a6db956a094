"""A simulator of many environments whose every number is known."""

import numpy as np
from gymnasium import spaces

from sb3_gac.envs import BatchStep, BatchVecEnv


class Counters(BatchVecEnv):
    """
    The observation is ``steps`` of the episode, ``index`` of the environment, ``drawn`` at the episode's start from the
    environment's own random numbers, and ``action``, the last one. Environment i terminates after 3 + i steps.
    """

    def __init__(self, n_envs, **kwargs):
        entry = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        names = ("steps", "index", "drawn", "action")
        split = {"partial": ["steps", "action"], "privileged": ["steps", "index", "drawn"]}
        actions = spaces.Box(-1.0, 1.0, (1,), np.float64)
        super().__init__(n_envs, spaces.Dict(dict.fromkeys(names, entry)), actions, **split | kwargs)
        self.values = {name: np.zeros((n_envs, 1)) for name in names}

    def start(self, seeds):
        self.generators = [np.random.default_rng(seed) for seed in seeds]
        return self.restart(np.arange(self.num_envs))

    def restart(self, indices):
        self.values["index"][indices] = indices[:, None]
        self.values["drawn"][indices, 0] = [self.generators[index].random() for index in indices]
        for name in ("steps", "action"):
            self.values[name][indices] = 0.0
        return {name: values[indices] for name, values in self.values.items()}

    def advance(self, actions):
        self.values["steps"] += 1
        self.values["action"][:] = actions
        steps = self.values["steps"][:, 0]
        infos = {"doubled": 2 * steps}
        return BatchStep(self.values, 10.0 + actions[:, 0], steps >= 3 + np.arange(self.num_envs), infos=infos)


class RestorableCounters(Counters):
    """The same, whose state can be put back."""

    def simulator_state(self):
        return {"values": {name: values.copy() for name, values in self.values.items()}, "generators": self.generators}

    def restore_simulator_state(self, state):
        self.values, self.generators = state["values"], state["generators"]


ENVIRONMENTS = {
    "sb3_gac/Counters-v0": {"vec_entry_point": f"{__name__}:Counters", "whole_state": False, "kwargs": {"time_limit": 5}}
}
