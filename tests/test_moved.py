"""Modules are found under the names that they had in earlier versions, and what was saved under these can be read."""

import importlib
import pickle
import sys

import gymnasium as gym
import pytest

from sb3_gac.checkpoint.serialization import dereference
from sb3_gac.envs.suites import SUITES
from sb3_gac.moved import MOVED


@pytest.mark.parametrize("former", MOVED)
def test_a_module_is_found_under_its_former_name(former):
    sys.modules.pop(former, None)
    with pytest.warns(DeprecationWarning, match=f"{former} is {MOVED[former]} now"):
        module = importlib.import_module(former)
    present = importlib.import_module(MOVED[former])
    assert present.__name__ == MOVED[former]
    assert all(getattr(module, name) is value for name, value in vars(present).items() if not name.startswith("__"))


@pytest.mark.filterwarnings("ignore:sb3_gac.common:DeprecationWarning")
def test_what_was_saved_names_the_former_modules():
    from sb3_gac import CompactDictReplayBuffer

    assert pickle.loads(b"csb3_gac.common.buffers\nCompactDictReplayBuffer\n.") is CompactDictReplayBuffer
    assert dereference("sb3_gac.common.buffers:CompactDictReplayBuffer") is CompactDictReplayBuffer


@pytest.mark.parametrize("suite", ["mujoco", "pendulum", "popgym"])
def test_suites_of_environments_are_found_where_they_were(suite, recwarn):
    from sb3_gac import envs

    sys.modules.pop(f"sb3_gac.envs.{suite}", None)
    vars(envs).pop(suite, None)
    assert SUITES[suite].environments == getattr(envs, suite).ENVIRONMENTS
    assert f"sb3_gac.envs.{suite} is sb3_gac.envs.suites.{suite} now" in str(recwarn.pop(DeprecationWarning).message)
    register = getattr(envs, f"register_{suite}")
    assert f'is sb3_gac.envs.suites.register("{suite}") now' in str(recwarn.pop(DeprecationWarning).message)
    for env_id in SUITES[suite].environments:
        specification = gym.registry.pop(env_id)
        with pytest.MonkeyPatch.context() as context:
            context.setattr(gym.envs.registration, "current_namespace", None)
            register()
        assert gym.registry[env_id] == specification
    with pytest.raises(AttributeError, match="register_chess"):
        envs.register_chess  # noqa: B018


def test_other_names_are_nowhere():
    with pytest.raises(ModuleNotFoundError, match=r"sb3_gac\.common\.nothing"):
        importlib.import_module("sb3_gac.common.nothing")


def test_the_runner_of_exported_files_is_found_by_its_former_name():
    learner = importlib.import_module("sb3_gac.learner")
    for place in (importlib.import_module("sb3_gac"), learner):
        with pytest.warns(DeprecationWarning, match="Learner is .*OnnxPolicy now"):
            assert place.Learner is learner.OnnxPolicy
