"""The README's Python, run as it stands there, but for shorter trainings."""

import configparser
import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

from sb3_gac import GAC

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
SHORTER = {"1_000_000": "120", "5_000": "60", "20_000": "50", "200_000": "110"}
SMALL = {"learning_starts": 100, "batch_size": 16, "buffer_size": 1_000, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}


def _shorter(block):
    (warm_up,) = re.findall("learning_starts=([0-9]+)", block)[:1] or ["100"]
    block = block.replace("noise_std=0.1)", "noise_std=0.1, max_episode_steps=50)")
    shorter = SHORTER | {"100_000": str(int(warm_up) + 20)}
    return re.sub(r"\b[0-9]+_[0-9_]+\b", lambda number: shorter[number.group()], block)


def _names_by_then():
    """What the text around a block has told the reader to have."""
    env, eval_env = (gym.make("sb3_gac/HalfCheetah-v5", noise_std=0.1, max_episode_steps=50) for _ in range(2))
    model = GAC("MultiInputPolicy", env, **SMALL).learn(110)
    partial = env.observation_space["partial"].sample()
    return {"gymnasium": gym, "np": np, "GAC": GAC, "env": env, "eval_env": eval_env, "model": model, "partial": partial}


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_python_of_the_readme_runs(number, tmp_path, monkeypatch):
    for simulator, named in {"popgym": "popgym", "envpool": "EnvPool"}.items():
        if named in BLOCKS[number]:
            pytest.importorskip(simulator, reason=f"the block needs {named}")
    monkeypatch.chdir(tmp_path)
    exec(compile(_shorter(BLOCKS[number]), f"README.md, block {number}", "exec"), _names_by_then())


def test_what_gac_has_not_of_sac_or_has_otherwise_is_said():
    (text,) = re.findall(r"GAC is an `OffPolicyAlgorithm`.*?(?=So callbacks)", README, re.DOTALL)
    ours, sacs = (inspect.signature(algorithm).parameters for algorithm in (GAC, SAC))
    assert set(re.findall(r"`(use_\w+|sde_\w+)`", text)) == set(sacs) - set(ours)
    assert {name for name in set(ours) & set(sacs) if ours[name].default != sacs[name].default} == set()
    policies = [
        algorithm("MultiInputPolicy", gym.make("sb3_gac/Pendulum-v1"), buffer_size=10).policy for algorithm in (GAC, SAC)
    ]
    of_gac, of_sac = ({type(module).__name__ for module in policy.modules()} & {"SiLU", "ReLU", "Tanh"} for policy in policies)
    assert (of_gac, of_sac) == (set(re.findall("`(SiLU)`", text)), set(re.findall("`(ReLU)`", text)))


def test_every_extra_that_a_user_may_need_is_named_where_installing_is_explained():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    (text,) = re.findall(r"## Install\n(.*?)\n## ", README, re.DOTALL)
    assert "pip install -e ." in text
    (named,) = re.findall(r"what an extra needs \((.*)\)", text)
    assert set(named.split(", ")) == set(parser["options.extras_require"]) - {"dev"}


def test_there_is_python_in_the_readme():
    assert len(BLOCKS) >= 6
