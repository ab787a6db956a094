"""Which settings are evaluated, and how each comes about in an environment."""

import gymnasium as gym
import numpy as np
import pytest
import yaml

from sb3_gac.envs import DroppedFrames, History, SensorDelay, SensorNoise
from sb3_gac.envs.state import layers
from sb3_gac.envs.suites import suite_of
from sb3_gac.evaluation.settings import UNDISTURBED, Environment, Setting, check_fits, environment_of_run, plan
from sb3_gac.training.environments import make_wrapped
from tests.evaluation.helpers import ENV, Walk

NOISY = "tests.evaluation.helpers:noisy_walk"


def _disturbances(env):
    kinds = (SensorNoise, SensorDelay, DroppedFrames, History)
    return [layer for layer in layers(env) if isinstance(layer, kinds)]


def test_one_thing_is_varied_at_a_time():
    settings, curves = plan({"noise": [0.3, 0.0], "delay": [0, 2]}, Setting(noise=0.1))
    assert curves == {
        "noise": [Setting(0.0), Setting(0.1), Setting(0.3)],
        "delay": [Setting(0.1, 0), Setting(0.1, 2)],
    }
    assert settings == [UNDISTURBED, Setting(0.1), Setting(0.3), Setting(0.1, 2)], "each once, the undisturbed one first"


def test_a_single_value_holds_for_all_settings():
    settings, curves = plan({"noise": [0.2], "drop": [0.1, 0.5]}, Setting(noise=0.1, delay=1))
    assert curves == {"drop": [Setting(0.2, 1, 0.0), Setting(0.2, 1, 0.1), Setting(0.2, 1, 0.5)]}
    assert settings == [UNDISTURBED, *curves["drop"]]


def test_single_values_alone_make_one_setting_beside_the_undisturbed_one():
    assert plan({"noise": [0.2], "delay": [3]}, Setting()) == ([UNDISTURBED, Setting(0.2, 3)], {})
    assert plan({"noise": [0.0]}, Setting()) == ([UNDISTURBED], {})


def test_registered_tasks_bring_a_setting_about_by_their_own_arguments():
    environment = Environment("sb3_gac/Pendulum-v1", {"history": 2, "noise_std": 0.3, "delay": 1})
    assert environment.trained == Setting(0.3, 1, 0.0)
    found = _disturbances(environment.make(Setting(0.1, 2, 0.5)))
    assert [type(layer) for layer in found] == [History, DroppedFrames, SensorDelay, SensorNoise]
    assert (found[1].probability, found[2].steps, found[3].noise_std) == (0.5, 2, np.float32(0.1))
    assert [type(layer) for layer in _disturbances(environment.make(UNDISTURBED))] == [History, SensorNoise]


def test_what_is_trained_by_default_is_the_environments_default():
    assert Environment("sb3_gac/HalfCheetah-v5").trained == Setting(0.1)
    assert Environment("sb3_gac/Pendulum-v1").trained == UNDISTURBED
    assert Environment("sb3_gac/TigerDoor-v0").trained == UNDISTURBED
    assert Environment("sb3_gac/brax-Ant-v0").trained == Setting(0.1), "known without the simulator"
    assert Environment("sb3_gac/Go1Getup-v0", {"noise_std": 0.2}).trained == Setting(0.2)
    assert Environment("sb3_gac/Go1Getup-v0").has_noise
    with pytest.raises(ValueError, match=r'noise_std of .* is \[0.1, 0.2\], .* --env-kwargs "{noise_std: 0.1}"'):
        _ = Environment("sb3_gac/Pendulum-v1", {"noise_std": [0.1, 0.2]}).trained


def test_an_environment_of_ones_own_gets_wrappers_beneath_its_memory():
    environment = Environment(NOISY, {"history": 3, "noise_std": 0.3})
    assert (environment.trained, environment.has_noise) == (UNDISTURBED, False)
    found = _disturbances(environment.make(Setting(0.5, 2, 0.1)))
    assert [type(layer) for layer in found] == [History, DroppedFrames, SensorDelay, SensorNoise, SensorNoise]
    assert [layer.noise_std for layer in found[3:]] == [np.float32(0.5), np.float32(0.3)], "on top of its own"
    plain = Environment(ENV)
    assert [type(layer) for layer in _disturbances(plain.make(Setting(0.5, 2)))] == [SensorDelay, SensorNoise]


class Controlled(Walk):
    """A walk whose arguments have the names of disturbances, and mean something else."""

    def __init__(self, delay=0.05, drop="left", noise_std=("joints", 2)):
        super().__init__()
        self.arguments = delay, drop, noise_std


def test_arguments_of_ones_own_are_no_disturbances():
    gym.register("tests/Controlled-v0", entry_point=Controlled, kwargs={"delay": 0.1})
    for env_id, period in {f"{__name__}:Controlled": 0.05, "tests/Controlled-v0": 0.1}.items():
        environment = Environment(env_id, {"drop": "right"})
        assert environment.trained == UNDISTURBED
        for setting in (UNDISTURBED, Setting(0.5, 2, 0.1)):
            assert environment.make(setting).unwrapped.arguments == (period, "right", ("joints", 2))


def test_environments_that_are_not_there():
    with pytest.raises(ValueError, match="--env no_such_module:Env: there is no module 'no_such_module'"):
        _ = Environment("no_such_module:Env").trained
    with pytest.raises(gym.error.Error, match="Nothing"):
        Environment("tests.evaluation.helpers:Nothing").make(UNDISTURBED)
    with pytest.raises(gym.error.Error, match="HalfCheetha"):
        Environment("sb3_gac/HalfCheetha-v5").make(UNDISTURBED)
    with pytest.raises(ValueError, match='Pendulum-v1 has no entry "partial"'):
        Environment("Pendulum-v1").make(UNDISTURBED)


def test_a_runs_configuration_says_where_it_was_trained(tmp_path):
    run = {"task": "Hopper", "noise": 0.2, "history": 3, "privileged": "velocity", "seed": 1}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(run))
    expected = Environment("sb3_gac/Hopper-v5", {"noise_std": 0.2, "history": 3, "privileged": "velocity"})
    assert environment_of_run(tmp_path) == expected
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"task": "Hopper", "noise": 0.2}))
    assert environment_of_run(tmp_path) == Environment("sb3_gac/Hopper-v5", {"noise_std": 0.2})
    run = {"task": "Hopper", "noise": 0.0, "environment": None}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"run": run, "arguments": {}}))
    assert environment_of_run(tmp_path) == Environment("sb3_gac/Hopper-v5", {"noise_std": 0.0}), "of a benchmark"
    wrappers = [{"sb3_gac.envs:History": {"length": 3}}]
    run = {"task": None, "noise": None, "environment": {"id": ENV, "kwargs": {}, "wrappers": wrappers}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(run))
    environment = environment_of_run(tmp_path)
    assert environment == Environment(ENV, {}, wrappers)
    kinds = [type(layer) for layer in _disturbances(environment.make(Setting(0.1, 1)))]
    assert kinds == [History, SensorDelay, SensorNoise]


def test_what_the_policy_reads_must_be_shown():
    env = Environment(ENV).make(UNDISTURBED)
    check_fits({"partial": (2,)}, env, ENV)
    with pytest.raises(ValueError, match=r'reads "partial" of the shape \(9,\).*shows \(2,\).*--env-kwargs "\{history: 4\}"'):
        check_fits({"partial": (9,)}, env, ENV)
    with pytest.raises(ValueError, match='reads an entry "goal"'):
        check_fits({"goal": (2,)}, env, ENV)


def test_what_a_module_registers_comes_before_its_class_of_that_name(tmp_path, monkeypatch):
    """With its time limit and arguments, in training and in evaluations."""
    source = (
        "import gymnasium\nfrom tests.evaluation.test_settings import Controlled\nclass Cart(Controlled): pass\n"
        "gymnasium.register('Cart', Cart, max_episode_steps=10, kwargs={'delay': 0.3})\n"
    )
    (tmp_path / "registers_late.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    for env in (Environment("registers_late:Cart").make(UNDISTURBED), make_wrapped("registers_late:Cart", {}, [])):
        assert isinstance(env, gym.wrappers.TimeLimit)
        assert env.unwrapped.arguments[0] == 0.3


def test_disturbances_that_stay_are_named():
    """A task in wrappers of one's own has them beside those of a setting."""
    wrappers = [{"sb3_gac.envs:SensorNoise": {"noise_std": 0.5}}, {"sb3_gac.envs:SensorDelay": {"steps": 2}}]
    beside = Environment("sb3_gac/Pendulum-v1", {}, wrappers).beside
    assert beside == "what it has of its own: SensorDelay and SensorNoise"
    assert Environment(NOISY).beside == "what it has of its own: SensorNoise"
    assert Environment("sb3_gac/Pendulum-v1").beside == ""
    assert Environment(ENV).beside == "any noise that it may have of its own"


def test_noise_that_a_task_has_of_its_own_is_named(monkeypatch):
    """The settings come on top of it, unless it is left out."""
    robot = "sb3_gac/Go1JoystickFlatTerrain-v0"
    assert suite_of(robot) == "playground"
    for kwargs, argument in (({}, "noise_level"), ({"noise_level": 0.5}, "noise_level"), ({"noise_level": 0}, None)):
        assert Environment(robot, kwargs).own_noise == argument
    assert Environment("sb3_gac/Pendulum-v1").own_noise is None
    monkeypatch.setattr(Environment, "own_noise", "noise_level")
    beside = Environment("sb3_gac/Pendulum-v1").beside
    assert beside == "what it has of its own: the task's own sensor noise, which noise_level=0 leaves out"


@pytest.mark.parametrize("task", ["TigerDoor", "popgym-RepeatPreviousEasy"])
def test_a_benchmarks_run_of_a_task_without_noise_has_no_argument_for_it(task, tmp_path):
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"run": {"task": task, "noise": 0.0, "history": 1}, "arguments": {}}))
    environment = environment_of_run(tmp_path)
    assert environment == Environment(f"sb3_gac/{task}-v0", {})
    environment.make(UNDISTURBED)
