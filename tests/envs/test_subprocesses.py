"""Registered environments in processes that import nothing by themselves, as those of a notebook."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAMS = {
    "gymnasium": """
import gymnasium, sb3_gac
env = gymnasium.make_vec("sb3_gac/Pendulum-v1", 2, vectorization_mode="async", vector_kwargs={"context": METHOD})
""",
    "SB3": """
import sb3_gac
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
kwargs = {"vec_env_cls": SubprocVecEnv, "vec_env_kwargs": {"start_method": METHOD}}
env = make_vec_env("sb3_gac/HalfCheetah-v5", 2, **kwargs)
""",
}


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
@pytest.mark.parametrize("library", PROGRAMS)
def test_a_process_that_starts_from_nothing_knows_the_environments(library, method):
    """The main module is a string: new processes can't import it again."""
    program = PROGRAMS[library].replace("METHOD", repr(method)) + "env.reset()\nenv.close()\nprint('closed')"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.stdout.split() == ["closed"], result.stderr[-2000:]
    assert result.stderr == "", "nothing is registered twice"


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_other_processes_are_started_as_ever(method):
    program = f"""
import multiprocessing, sb3_gac
process = multiprocessing.get_context({method!r}).Process(target=exit, args=(7,), name="seven")
process.start()
process.join()
print(process.name, process.exitcode)
"""
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.stdout.split() == ["seven", "7"], result.stderr[-2000:]


def test_the_environments_are_registered_without_torch():
    program = "import sys, sb3_gac.envs; print('torch' in sys.modules, 'stable_baselines3' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "False"]


def test_without_the_import_an_id_names_its_module():
    program = "import gymnasium; print(gymnasium.make('sb3_gac:sb3_gac/Pendulum-v1').spec.id)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["sb3_gac/Pendulum-v1"]
