"""The Python of the README and of the guides, run as it stands there, but for shorter trainings."""

import configparser
import inspect
import os
import re
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

from sb3_gac import GAC, AsymmetricSAC, export_learner
from sb3_gac.presets import PRESETS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
HYPERPARAMETERS = (ROOT / "docs/hyperparameters.md").read_text()
PAGES = ("README.md", *(f"docs/{name}.md" for name in ("training", "memory", "images", "robots", "teachers", "resuming")))
PAGES += ("docs/hyperparameters.md", "docs/logging.md", "docs/index.md")
BLOCKS = {page: re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL) for page in PAGES}
ALONE = [(page, number) for page in PAGES for number in range(len(BLOCKS[page])) if page != "docs/resuming.md"]
SHORTER = {"1_000_000": "120", "5_000": "60", "20_000": "50", "200_000": "110"}
SMALL = {"learning_starts": 100, "batch_size": 16, "buffer_size": 1_000, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
SIMULATORS = {"popgym": "popgym", "envpool": "EnvPool"}


def _shorter(block):
    (warm_up,) = re.findall("learning_starts=([0-9]+)", block)[:1] or ["100"]
    block = re.sub(r"noise_std=0\.1([,)])", r"noise_std=0.1, max_episode_steps=50\1", block)
    shorter = SHORTER | {"100_000": str(int(warm_up) + 20)}
    return re.sub(r"\b[0-9]+_[0-9_]+\b", lambda number: shorter[number.group()], block)


def _names_by_then(block, folder):
    """What the text around a block has told the reader to have."""
    env = gym.make("sb3_gac/HalfCheetah-v5", noise_std=0.1, max_episode_steps=50)
    names = {"gymnasium": gym, "np": np, "GAC": GAC, "env": env, "settings": SMALL}
    if "model" in block or "clone" in block or "act(" in block:
        names["model"] = GAC("MultiInputPolicy", env, **SMALL).learn(110)
    if "teacher" in block:
        names["teacher"] = AsymmetricSAC("MultiInputPolicy", env, **SMALL, role_keys={"actor": ["partial", "privileged"]})
        space = env.observation_space["partial"]
        names["observations"] = np.stack([space.sample() for _ in range(40)])
        names["actions"] = np.stack([env.action_space.sample() for _ in range(40)])
    if "robot.onnx" in block:
        export_learner(names["model"], folder / "robot.onnx")
        names["partial"] = env.observation_space["partial"].sample()
    return names


@pytest.mark.parametrize(("page", "number"), ALONE, ids=lambda value: str(value))
def test_a_block_of_python_runs(page, number, tmp_path, monkeypatch):
    block = BLOCKS[page][number]
    for simulator, named in SIMULATORS.items():
        if f"[{simulator}]" in block:
            pytest.importorskip(simulator, reason=f"the block needs {named}")
    if "Pixels" in block and os.environ.get("MUJOCO_GL") != "egl":
        pytest.skip("renders by EGL: MUJOCO_GL=egl")
    monkeypatch.chdir(tmp_path)
    exec(compile(_shorter(block), f"{page}, block {number}", "exec"), _names_by_then(block, tmp_path))


def test_the_blocks_about_resuming_run_one_after_the_other(tmp_path, monkeypatch):
    """The second environment is the page's own: a forgotten attribute of its state would be a warning, or other networks."""
    first, *cart = BLOCKS["docs/resuming.md"]
    assert len(cart) == 2
    monkeypatch.chdir(tmp_path)
    exec(compile(_shorter(first), "resuming.md, block 0", "exec"), _names_by_then(first, tmp_path))
    small = ", batch_size=16, buffer_size=500, policy_kwargs={'net_arch': [8]}, device='cpu')"
    names = {}
    for number, block in enumerate(cart, 1):
        block = block.replace("1_000", "150").replace("2_000", "300").replace("seed=0)", f"seed=0{small}")
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*new episodes.*|.*New episodes.*")
            exec(compile(block, f"resuming.md, block {number}", "exec"), names)
    assert names["resumed"].num_timesteps == names["whole"].num_timesteps == 300


def test_what_gac_has_not_of_sac_or_has_otherwise_is_said():
    (text,) = re.findall(r"GAC is an `OffPolicyAlgorithm`.*?(?=So callbacks)", HYPERPARAMETERS, re.DOTALL)
    ours, sacs = (inspect.signature(algorithm).parameters for algorithm in (GAC, SAC))
    assert set(re.findall(r"`(use_\w+|sde_\w+)`", text)) == set(sacs) - set(ours)
    assert {name for name in set(ours) & set(sacs) if ours[name].default != sacs[name].default} == set()
    policies = [
        algorithm("MultiInputPolicy", gym.make("sb3_gac/Pendulum-v1"), buffer_size=10).policy for algorithm in (GAC, SAC)
    ]
    of_gac, of_sac = ({type(module).__name__ for module in policy.modules()} & {"SiLU", "ReLU", "Tanh"} for policy in policies)
    assert (of_gac, of_sac) == (set(re.findall("`(SiLU)`", text)), set(re.findall("`(ReLU)`", text)))


def _table(heading):
    """First and second column of the table under a heading of docs/hyperparameters.md, as code without its marks."""
    (text,) = re.findall(rf"## {re.escape(heading)}\n(.*?)(?=\n## |\Z)", HYPERPARAMETERS, re.DOTALL)
    rows = [line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    return {name: default.strip(" `") for names, default, *_ in rows for name in re.findall(r"`([\w-]+)`", names)}


@pytest.mark.parametrize("heading", ["GAC's own arguments", "Arguments of all algorithms"])
def test_defaults_in_the_tables_of_arguments_are_so(heading):
    parameters = inspect.signature(GAC).parameters
    for name, default in _table(heading).items():
        shown = eval(default.split("`, `")[0].split(",")[0], {})
        assert parameters[name].default == shown or name in ("update_every", "behaviour_per"), name


def test_every_preset_is_described():
    assert set(_table("Presets")) == set(PRESETS)


def test_every_extra_that_a_user_may_need_is_named_where_installing_is_explained():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    extras = set(parser["options.extras_require"])
    (text,) = re.findall(r"## Install\n(.*?)\n## ", README, re.DOTALL)
    assert "pip install -e ." in text
    (named,) = re.findall(r"what an extra needs \((.*)\)", text)
    assert set(named.split(", ")) == extras - {"dev", "docs"}
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs/installation.md").read_text(), re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == extras


def test_there_is_python_where_it_is_promised():
    assert [page for page, blocks in BLOCKS.items() if not blocks] == []
