"""The code of docs/environments.md and docs/goals.md, run as it stands there, but for shorter trainings."""

import re
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac import GAC
from sb3_gac.envs.suites import SUITES
from tests.envs.test_groups import Simulator

PAGE = "".join((Path(__file__).parents[1] / f"docs/{name}.md").read_text() for name in ("environments", "goals"))
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_what_a_user_types_runs(monkeypatch):
    """All blocks one after the other, on the stand-in for a simulator."""
    init = GAC.__init__

    def smaller(self, *args, **kwargs):
        small = {"batch_size": 8, "gradient_steps": 1, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
        init(self, *args, **{**small, **kwargs, "learning_starts": 100})

    monkeypatch.setattr(GAC, "__init__", smaller)
    names = {"simulator": Simulator()}
    shapes = []
    assert len(BLOCKS) == 6
    for number, block in enumerate(BLOCKS):
        exec(compile(block.replace("5_000", "160"), f"environments.md and goals.md, block {number}", "exec"), names)
        assert _ends(names["env"]), f"episodes of block {number} must end"
        shapes.append({key: box.shape for key, box in names["env"].observation_space.items()})
    assert shapes[0] == {"partial": (4 * 6 + 3 * 2,), "privileged": (10,)}
    assert shapes[1] == {"partial": (9,), "privileged": (17,)}
    assert shapes[2] == {"partial": (2,), "privileged": (3,)}
    assert shapes[4] == {"partial": (8,), "privileged": (5,)}
    assert shapes[5] == {"partial": (5,), "privileged": (5,), "achieved_goal": (3,), "desired_goal": (3,)}
    assert np.shape(names["action"]) == (4,)
    assert names["model"]._n_updates > 0


def _ends(env):
    """Whether an episode ends: a robot's has a new goal only then. Vectorised environments have trained before."""
    if isinstance(env, VecEnv):
        return True
    env.reset(seed=0)
    return any(any(env.step(env.action_space.sample())[2:4]) for _ in range(200))


def test_tasks_that_are_named_are_registered():
    ids = {env_id for suite in SUITES.values() for env_id in suite.environments}
    named = set(re.findall(r"sb3_gac/[\w-]+-v\d+", PAGE))
    for pattern, names in re.findall(r"`((?:sb3_gac/)?[\w-]*\{([\w,]+)\}-v\d+)`", PAGE):
        for name in names.split(","):
            env_id = pattern.replace(f"{{{names}}}", name)
            named.add(env_id if "/" in env_id else f"sb3_gac/{env_id}")
    assert len(named) >= 20
    assert named <= ids
