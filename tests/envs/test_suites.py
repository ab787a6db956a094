"""The table of registered environments."""

import sys

import gymnasium as gym
import numpy as np
import pytest

from sb3_gac.envs.suites import SUITES, is_batched, register, registered_id, suite_of, task_of
from sb3_gac.envs.suites.extras import import_extra


@pytest.mark.parametrize("name", SUITES)
def test_a_suites_environments_are_registered_as_the_table_says(name):
    assert SUITES[name].environments
    for env_id, arguments in SUITES[name].environments.items():
        specification = gym.spec(env_id)
        assert suite_of(env_id) == name
        assert env_id.startswith(f"sb3_gac/{task_of(env_id)}-v")
        if "vec_entry_point" in arguments:
            arguments = {"entry_point": "sb3_gac.envs.vector.single:make_single", "kwargs": {"env_id": env_id}}
        of_gymnasium = {key: value for key, value in arguments.items() if key not in ("shapes", "whole_state")}
        assert {key: getattr(specification, key) for key in of_gymnasium} == of_gymnasium


def test_every_registered_environment_is_in_a_suite():
    ours = {env_id for env_id in gym.registry if env_id.startswith("sb3_gac/")}
    assert ours == {env_id for suite in SUITES.values() for env_id in suite.environments}
    assert suite_of("CartPole-v1") is None


@pytest.mark.parametrize("env_id", ["sb3_gac/Hopper-v5", "sb3_gac/Go1Getup-v0", "sb3_gac/TigerDoor-v0", "CartPole-v1"])
def test_an_environment_is_the_same_after_a_module_that_registers_it(env_id):
    behind = f"sb3_gac:{env_id}"
    for ask in (suite_of, task_of, is_batched):
        assert ask(behind) == ask(env_id)
    suite = suite_of(env_id)
    assert registered_id(behind) == (behind if suite is None else env_id)
    if suite is not None:
        assert SUITES[suite].shows_whole_state(behind) == SUITES[suite].shows_whole_state(env_id)


@pytest.mark.parametrize("name", [name for name, suite in SUITES.items() if suite.sensor_noise])
def test_suites_that_say_so_take_sensor_noise_and_show_the_whole_state_or_what_partial_lacks(name):
    partial, state = (
        [_first_of(name, noise_std=noise).reset(seed=0)[0][entry] for noise in (0.0, 1.0)]
        for entry in ("partial", "privileged")
    )
    assert (partial[0] != partial[1]).mean() > 0.5, "all but goals"
    assert (state[0] == state[1]).all()
    assert (set(partial[0]) < set(state[0])) == SUITES[name].shows_whole_state(next(iter(SUITES[name].environments)))


@pytest.mark.parametrize("name", [name for name, suite in SUITES.items() if suite.history])
def test_suites_that_say_so_take_a_history(name):
    env, alone = _first_of(name, noise_std=0.1, history=3), _first_of(name, noise_std=0.1)
    (observation, _), (reference, _) = env.reset(seed=0), alone.reset(seed=0)
    shown = [reference["partial"]] * 3
    for number in range(3):
        action = np.full(env.action_space.shape, 0.1 * number, dtype=np.float32)
        observation, reference = env.step(action)[0], alone.step(action)[0]
        shown = [*shown[1:], reference["partial"]]
    n_actions = 2 * env.action_space.shape[0]
    assert observation["partial"].size == 3 * shown[0].size + n_actions - 2 * _goal_size(env)
    assert (observation["privileged"] == reference["privileged"]).all()
    frames = np.concatenate([frame[: frame.size - _goal_size(env)] for frame in shown])
    assert (observation["partial"][: frames.size] == frames).all()
    actions = observation["partial"][frames.size : frames.size + n_actions].reshape(2, -1)
    assert (actions == np.float32([[0.1], [0.2]])).all()


def _first_of(name, **kwargs):
    """Skips the test where the suite's simulator is not installed."""
    try:
        return gym.make(next(iter(SUITES[name].environments)), **kwargs)
    except ImportError as error:
        pytest.skip(str(error))


def _goal_size(env):
    return np.size(getattr(env.unwrapped, "goal", ()))


@pytest.mark.parametrize("name", [name for name, suite in SUITES.items() if suite.history])
@pytest.mark.parametrize("history", [0, -1, 1.5, True, "4"])
def test_a_history_that_is_none_is_named(name, history):
    with pytest.raises(ValueError, match="history must be an integer of at least 1, got"):
        _first_of(name, history=history)


def test_a_simulator_that_is_missing_is_named_with_its_extra(monkeypatch):
    assert import_extra("json", "nothing", "Env-v0") is sys.modules["json"]
    with pytest.raises(ImportError, match=r'^Env-v0 needs no_such, which .* sb3_gac\[chess\] has: pip .*"\.\[chess\]"'):
        import_extra("no_such.games", "chess", "Env-v0")


def test_a_suite_of_ones_own_is_one_line_in_the_table(monkeypatch):
    module = type(sys)("of_a_test")
    module.ENVIRONMENTS = {"sb3_gac/Test-v3": {"entry_point": "gymnasium.envs.classic_control:PendulumEnv"}}
    monkeypatch.setitem(sys.modules, "of_a_test", module)
    monkeypatch.setitem(SUITES, "test", SUITES["popgym"]._replace(module="of_a_test"))
    register("test")
    try:
        assert (suite_of("sb3_gac/Test-v3"), task_of("sb3_gac/Test-v3")) == ("test", "Test")
        gym.make("sb3_gac/Test-v3").close()
    finally:
        gym.registry.pop("sb3_gac/Test-v3")
