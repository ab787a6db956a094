"""The state of an environment in the middle of an episode, taken down and put back."""

import json
from collections import deque
from copy import deepcopy

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import Monitor

from sb3_gac.checkpoint.serialization import decode, encode
from sb3_gac.envs import DroppedFrames, History, PreviousAction, SensorDelay, SensorNoise, SplitObservation
from sb3_gac.envs.state import NotRestorableError, env_state, restore_env_state
from tests.helpers import TwoViewBandit

TASKS = ["HalfCheetah", "Ant", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "Hopper", "Walker2d", "Swimmer"]


def _cheetah_with_history():
    env = SplitObservation(gym.make("HalfCheetah-v5"), partial=range(8), privileged=range(17))
    return PreviousAction(History(SensorNoise(SensorNoise(env, 0.1), 0.2), length=3, actions=True), reward=True)


def _pendulum():
    return SensorNoise(SplitObservation(gym.make("Pendulum-v1"), partial=[0, 1], privileged=[0, 1, 2]), 0.1)


MAKERS = {task: lambda task=task: gym.make(f"sb3_gac/{task}-v5", noise_std=0.1) for task in TASKS} | {
    "history": _cheetah_with_history,
    "pendulum": _pendulum,
    "late and lost": lambda: gym.make("sb3_gac/Hopper-v5", noise_std=0.1, history=3, delay=2, drop=0.4),
    "touching hand": lambda: gym.make("sb3_gac/HandManipulateBlockRotateZTouch-v1", noise_std=0.1),
    "arm with goals": lambda: gym.make("sb3_gac/FetchPush-v4", goal_entries=True),
    "arm with a history": lambda: gym.make("sb3_gac/FetchReach-v4", noise_std=0.1, history=3),
    "hand at a door": lambda: gym.make("sb3_gac/AdroitHandDoor-v1", noise_std=0.1, max_episode_steps=40),
    "hand with a ball": lambda: gym.make("sb3_gac/AdroitHandRelocate-v1", max_episode_steps=40),
    "own methods": lambda: gym.wrappers.TimeLimit(TwoViewBandit(noise_std=0.3, length=9), 7),
}


def _go_on(env, actions):
    """All that the environment returns, episode after episode."""
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((deepcopy(observation), reward, terminated, truncated))
        if terminated or truncated:
            seen.append(deepcopy(env.reset()[0]))
    return seen


@pytest.mark.parametrize("name", MAKERS)
def test_another_environment_goes_on_to_the_bit(name):
    env, other = Monitor(MAKERS[name]()), Monitor(MAKERS[name]())
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(120)]
    env.reset(seed=3)
    _go_on(env, actions[:55])
    state = env_state(env)
    expected = _go_on(env, actions[55:])
    other.reset(seed=99)
    _go_on(other, actions[:3])
    restore_env_state(other, state)
    np.testing.assert_equal(_go_on(other, actions[55:]), expected)
    assert other.episode_returns == env.episode_returns


def test_a_state_can_be_restored_again_and_again():
    env = Monitor(MAKERS["late and lost"]())
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(60)]
    env.reset(seed=3)
    state, seen = env_state(env), []
    for _ in range(2):
        restore_env_state(env, state)
        seen.append((_go_on(env, actions), list(env.episode_returns)))
    np.testing.assert_equal(seen[0], seen[1])


def _disturbed(noise_std=0.1):
    return SensorNoise(DroppedFrames(SensorDelay(MAKERS["pendulum"](), 1), 0.5), noise_std, key="privileged")


def _settings(env):
    return [float(env.noise_std), env.env.probability, env.env.env.steps, float(env.env.env.env.noise_std)]


def _disturb_more(env):
    env.noise_std, env.env.probability, env.env.env.steps, env.env.env.env.noise_std = 0.4, 0.25, 3, 0.2


def test_settings_that_changed_during_training_are_restored():
    env, other = _disturbed(), _disturbed()
    actions = [np.array([0.1 * number], np.float32) for number in range(20)]
    env.reset(seed=3)
    _go_on(env, actions[:7])
    _disturb_more(env)
    _go_on(env, actions[7:10])
    state = env_state(env)
    expected = _go_on(env, actions)
    other.reset(seed=4)
    restore_env_state(other, state)
    assert _settings(other) == pytest.approx([0.4, 0.25, 3, 0.2])
    np.testing.assert_equal(_go_on(other, actions), expected)


def test_an_environment_made_with_another_setting_keeps_it_from_the_first_step_on():
    env, other = _disturbed(), _disturbed(noise_std=0.0)
    env.reset(seed=3)
    _disturb_more(env)
    env.step(np.zeros(1, np.float32))  # draws noise for many steps
    restore_env_state(other, env_state(env))
    assert _settings(other) == pytest.approx([0.0, 0.25, 3, 0.2])
    cosine, sine, _ = other.step(np.zeros(1, np.float32))[0]["privileged"]
    assert np.hypot(cosine, sine) == pytest.approx(1)


def test_a_state_of_an_earlier_version_leaves_settings_alone():
    env = _disturbed()
    env.reset(seed=3)
    state = [{key: value for key, value in layer.items() if key != "settings"} for layer in env_state(env)]
    _disturb_more(env)
    restore_env_state(env, state)
    assert _settings(env) == pytest.approx([0.4, 0.25, 3, 0.2])


@pytest.mark.parametrize("probability", [-0.1, 1.1, True, "half"])
def test_a_probability_is_checked_when_it_changes_too(probability):
    env = DroppedFrames(MAKERS["pendulum"](), 0.5)
    with pytest.raises(ValueError, match="probability must be a number from 0 to 1"):
        env.probability = probability
    assert env.probability == 0.5


@pytest.mark.parametrize("name", MAKERS)
def test_an_environment_that_was_never_reset_takes_a_state_from_before_the_first_step(name):
    env, other = MAKERS[name](), MAKERS[name]()
    env.reset(seed=0)
    state = env_state(env)
    restore_env_state(other, state)
    actions = [env.action_space.sample() for _ in range(5)]
    np.testing.assert_equal(_go_on(other, actions), _go_on(env, actions))


def test_a_state_from_before_the_first_reset():
    env, other = _pendulum(), _pendulum()
    restore_env_state(other, env_state(env))
    np.testing.assert_equal(other.reset(seed=0)[0], env.reset(seed=0)[0])


PLUGIN = """
<mujoco><extension><plugin plugin="mujoco.sensor.touch_grid"/></extension>
<worldbody><geom type="plane" size="1 1 .1"/>
<body pos="0 0 .2"><freejoint/><geom size=".1"/><site name="s"/></body></worldbody>
<sensor><plugin name="skin" plugin="mujoco.sensor.touch_grid" objtype="site" objname="s">
<config key="size" value="2 2"/><config key="fov" value="90 90"/>
<config key="gamma" value="0"/><config key="nchannel" value="1"/>
</plugin></sensor></mujoco>
"""


class _Feeling(gym.Env):
    """On a model with a plugin, whose data are somewhere in this process's memory."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(PLUGIN)
        self.data = mujoco.MjData(self.model)


def test_what_a_plugin_has_in_memory_stays_with_its_own_environment():
    """It would be freed twice."""
    env, other = _Feeling(), _Feeling()
    mujoco.mj_step(env.model, env.data, 50)
    address = other.data.plugin_data.copy()
    assert address.size == 1
    assert address != env.data.plugin_data
    restore_env_state(other, env_state(env))
    assert other.data.plugin_data == address
    np.testing.assert_array_equal(other.data.qpos, env.data.qpos)


def _drawing(change):
    """An environment whose reset draws a part of MuJoCo's model."""

    class Drawing(HopperEnv):
        def reset_model(self):
            change(self.model, self.np_random.uniform(0.2, 1.0))
            return super().reset_model()

    return Drawing()


def _set(array, value):
    array[:] = value


@pytest.mark.parametrize(
    "change",
    [
        lambda model, drawn: _set(model.opt.gravity, [0, 0, -10 * drawn]),
        lambda model, drawn: setattr(model.opt, "viscosity", 100 * drawn),
        lambda model, drawn: setattr(model.opt, "timestep", 0.002 * drawn),
        lambda model, drawn: _set(model.geom_friction, drawn),
        lambda model, drawn: _set(model.qpos_spring, drawn),
        lambda model, drawn: _set(model.geom_rgba, drawn),
        lambda model, drawn: _set(model.light_diffuse, drawn),
    ],
    ids=["gravity", "viscosity", "time step", "friction", "springs", "colours", "lights"],
)
def test_what_a_reset_draws_of_the_model_is_restored(change):
    env, other = _drawing(change), _drawing(change)
    env.reset(seed=1)
    other.reset(seed=7)
    restore_env_state(other, env_state(env))
    for name in ("geom_rgba", "light_diffuse"):
        np.testing.assert_array_equal(getattr(other.model, name), getattr(env.model, name))
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_equal(_go_on(other, actions), _go_on(env, actions))


class Following(HopperEnv):
    """A hopper with a state of its own in Python: a commanded speed that follows a slow walk, and past actions."""

    def __init__(self, weight=1.0, level=0, **kwargs):
        self.weight, self._level, self.tool = weight, level, None
        super().__init__(**kwargs)

    def reset_model(self):
        self.n, self.recent = 0, deque([np.zeros(3)] * 2, maxlen=2)
        self.command = {
            "speed": self.np_random.uniform(0, 2),
            "walk": np.random.default_rng(int(1e6 * self.np_random.uniform())),
        }
        self.joints = self.data.qpos[3:]
        return super().reset_model()

    def step(self, action):
        observation, _, _, _, info = super().step(action)
        self.n += 1
        self.recent.append(np.array(action))
        self.command["speed"] += self.command["walk"].normal()
        jerk = np.square(self.recent[0] - self.recent[1]).sum()
        reward = -self.weight * abs(info["x_velocity"] - self.command["speed"]) - jerk - abs(self.joints).sum()
        return observation, float(reward), False, self.n >= 20, info


def _through_a_file(state):
    arrays = {}
    return decode(json.loads(json.dumps(encode(state, arrays))), arrays)


def test_attributes_of_an_own_mujoco_environment_are_restored():
    env, other = Following(), Following()
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    env.reset(seed=1)
    _go_on(env, actions[:27])
    env._level = 3
    other.reset(seed=7)
    restore_env_state(other, _through_a_file(env_state(env)))
    assert (other.n, other._level, other.recent.maxlen) == (7, 3, 2)
    np.testing.assert_equal(_go_on(other, actions), _go_on(env, actions))


def test_an_own_mujoco_environment_that_was_never_reset_takes_attributes():
    env, other = Following(), Following()
    env.reset(seed=1)
    env.step(np.ones(3))
    restore_env_state(other, env_state(env))
    assert (other.n, other.command["speed"]) == (1, env.command["speed"])


@pytest.mark.parametrize(
    ("tool", "kind"),
    [
        (spaces.Box(-1, 1), None),
        ([len, int], None),
        ({1: 2.0}, "dict"),
        (object(), "object"),
        (np.array([None]), "ndarray"),
        (TwoViewBandit(), "TwoViewBandit"),
        (gym.wrappers.TimeLimit(TwoViewBandit(), 7), "TimeLimit"),
        (mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")), "MjData"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_attribute_that_cannot_be_held_is_named(tool, kind):
    env = Following()
    env.tool = tool
    if kind is None:
        assert "tool" not in env_state(env)[0]["mujoco"]["attributes"]
        return
    with pytest.raises(NotRestorableError, match=rf"the attribute tool of .*Following is a {kind}, which a checkpoint can't"):
        env_state(env)


def test_two_names_for_one_generator_are_not_taken_for_two_generators():
    env = Following()
    env.reset(seed=0)
    env.tool = env.np_random
    with pytest.raises(NotRestorableError, match=r"the attribute tool of .*generators of its own"):
        env_state(env)


def test_an_environment_made_with_another_argument_keeps_it():
    def make(**kwargs):
        env = gym.make(EnvSpec("Following-v0", entry_point=Following, kwargs={"weight": 1.0}), **kwargs)
        env.reset(seed=0)
        return env

    env = make(weight=2.0, level=1)
    env.unwrapped.weight, env.unwrapped._level = 2.5, 4
    alike, other = make(weight=2.0, level=1), make(level=2)
    for one in (alike, other):
        restore_env_state(one, env_state(env))
    assert (alike.unwrapped.weight, alike.unwrapped._level) == (2.5, 4)
    assert (other.unwrapped.weight, other.unwrapped._level) == (1.0, 2)
    assert other.unwrapped.command["speed"] == env.unwrapped.command["speed"]


def test_a_state_of_an_earlier_version_has_drawn_goals():
    env = Following()
    env.reset(seed=0)
    state = env_state(env)
    del state[0]["mujoco"]["attributes"], state[0]["mujoco"]["arguments"]
    state[0]["mujoco"]["drawn"] = {"goal": np.ones(3)}
    restore_env_state(env, state)
    np.testing.assert_array_equal(env.goal, np.ones(3))


class _Unknown(gym.Wrapper):
    pass


def test_an_unknown_layer_is_named():
    with pytest.raises(NotRestorableError, match=r"test_state\._Unknown.*checkpoint_state\(\)"):
        env_state(_Unknown(TwoViewBandit()))


def test_other_layers_are_named():
    env = gym.wrappers.TimeLimit(TwoViewBandit(), 7)
    env.reset(seed=0)
    with pytest.raises(NotRestorableError, match=r"made of \['tests.*, but the checkpoint's was made of \['.*TimeLimit"):
        restore_env_state(TwoViewBandit(), env_state(env))
