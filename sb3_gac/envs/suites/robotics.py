"""
gymnasium-robotics: hands with privileged touch sensors, and arms with privileged velocities.

================================  ==============================================  ====================================
task                              partial                                         privileged="hidden"
================================  ==============================================  ====================================
HandManipulate*Touch              joints 24, their velocities 24, object's        touch 92, log(1 + x)
                                  velocity 6 and pose 7, desired goal 7 = 68
FetchPush, Slide, PickAndPlace    gripper 3, object 3, relative 3, fingers 2,     velocities 11: object 3 + 3, gripper
                                  object's angles 3, desired goal 3 = 17          3, fingers 2
FetchReach                        gripper 3, fingers 2, desired goal 3 = 8        velocities 5: gripper 3, fingers 2
HandReach                         joints 24, fingertips 15, desired goal 15 = 54  joint velocities 24
AdroitHandDoor, AdroitHandRelocate  observation 39                                qvel 30 or 36, touch 21, log(1 + x)
================================  ==============================================  ====================================

Achieved goals are part of these observations already.  ``privileged="state"`` is all of both columns, without noise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.goals import ACHIEVED_GOAL, GOALS, AppendDesiredGoal
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites.layout import check_size, noisy_with_history
from sb3_gac.envs.wrappers import Observation, SplitDictObservation, reset_with

PRIVILEGED_CHOICES = ("hidden", "state")
Selection = Mapping[str, tuple[int, ...] | None]


@dataclass(frozen=True)
class RobotTask:
    """
    The layout of a task's observation.

    :param env_id: gymnasium-robotics's id of the task
    :param max_episode_steps: number of steps after which an episode is truncated
    :param partial: entry -> indices of the components that a robot measures; ``None`` for the whole entry
    :param hidden: entry -> indices of the components that only a simulator knows; ``None`` for the whole entry
    :param sizes: sizes of ``partial`` with the goal, of the hidden components, and of an action
    :param kwargs: keyword arguments for ``gymnasium.make``
    :param has_goals: whether the task is a goal environment
    """

    env_id: str
    max_episode_steps: int
    partial: Selection
    hidden: Selection
    sizes: tuple[int, int, int]
    kwargs: dict[str, Any] = field(default_factory=dict)
    has_goals: bool = True


def _touching(name: str) -> RobotTask:
    """A hand with an observation of 61 numbers, 92 touch sensors, and rewards by distance."""
    partial, touch = {"observation": tuple(range(61))}, {"observation": tuple(range(61, 153))}
    kwargs = {"touch_get_obs": "log", "reward_type": "dense"}
    return RobotTask(f"HandManipulate{name}_ContinuousTouchSensors-v1", 100, partial, touch, (68, 92, 20), kwargs)


def _fetch(name: str, n_positions: int, n_velocities: int) -> RobotTask:
    size = n_positions + n_velocities
    partial, velocity = {"observation": tuple(range(n_positions))}, {"observation": tuple(range(n_positions, size))}
    return RobotTask(f"Fetch{name}-v4", 50, partial, velocity, (n_positions + 3, n_velocities, 4))


def _reaching_hand() -> RobotTask:
    """The layout joints 0:24, their velocities 24:48, fingertips 48:63."""
    partial, velocity = (*range(24), *range(48, 63)), tuple(range(24, 48))
    return RobotTask("HandReach-v3", 50, {"observation": partial}, {"observation": velocity}, (54, 24, 20))


def _adroit(name: str, n_velocities: int, n_actions: int) -> RobotTask:
    """A hand with an observation of 39 numbers, and 21 touch sensors."""
    hidden, sizes = {"qvel": None, "touch": None}, (39, n_velocities + 21, n_actions)
    return RobotTask(f"AdroitHand{name}-v1", 200, {"observation": None}, hidden, sizes, has_goals=False)


_TOUCHED = (
    "Block",
    "BlockRotateParallel",
    "BlockRotateXYZ",
    "BlockRotateZ",
    "Egg",
    "EggRotate",
    "Pen",
    "PenRotate",
)
TASKS: dict[str, RobotTask] = {
    **{f"HandManipulate{name}Touch": _touching(name) for name in _TOUCHED},
    **{f"Fetch{name}": _fetch(name, 14, 11) for name in ("Push", "Slide", "PickAndPlace")},
    "FetchReach": _fetch("Reach", 5, 5),
    "HandReach": _reaching_hand(),
    "AdroitHandDoor": _adroit("Door", 30, 28),
    "AdroitHandRelocate": _adroit("Relocate", 36, 30),
}


class WithSimulatorState(gym.ObservationWrapper):
    """
    Add the simulator's knowledge to an observation: velocities ``qvel``, and ``touch``, log(1 + x) of the touch sensors.

    The logarithm is there since forces x reach hundreds.  The model's other sensors, of joints and actuators, are left out.

    :param env: MuJoCo environment with a Box observation
    """

    def __init__(self, env: gym.Env):
        import mujoco

        super().__init__(env)
        model = env.unwrapped.model  # type: ignore[attr-defined]
        self._touch = model.sensor_adr[model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH]
        sizes = {"qvel": model.nv, "touch": len(self._touch)}
        added = {key: spaces.Box(-np.inf, np.inf, (size,), np.float64) for key, size in sizes.items()}
        self.observation_space = spaces.Dict({"observation": env.observation_space, **added})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: seed of the environment, ``None`` to go on with its random numbers
        :param options: options of the environment's reset
        :return: observation, info
        """
        observation, info = reset_with(self.env, seed, options)
        return self.observation(observation), info

    def observation(self, observation: np.ndarray) -> Observation:
        """
        :param observation: observation of the environment
        :return: entries ``observation``, ``qvel`` and ``touch``, the last two as the simulator has them now
        """
        data = self.unwrapped.data  # type: ignore[attr-defined]
        return {"observation": observation, "qvel": data.qvel, "touch": np.log1p(data.sensordata[self._touch])}


class Robot(gym.Env):
    """
    An environment of gymnasium-robotics that has ``compute_reward`` on request alone.

    SB3 takes an environment with ``compute_reward`` for a goal environment, whose observation must have the goals as entries.
    A copy in another process is made anew, since :class:`_ByNumber` need not be in place there yet.

    :param env_id: gymnasium-robotics's id of the environment
    :param rewards_goals: whether the environment has ``compute_reward``, which rewards other goals
    :param kwargs: keyword arguments for ``gymnasium.make``
    """

    def __init__(self, env_id: str, rewards_goals: bool = False, **kwargs: Any):
        _import_robotics()
        env: Any = gym.make(env_id, disable_env_checker=True, max_episode_steps=-1, **kwargs).unwrapped
        self._arguments = env_id, rewards_goals, kwargs
        self.simulated = env
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.metadata, self.render_mode = env.metadata, env.render_mode
        self.model, self.data = env.model, env.data
        if rewards_goals:
            takes_rows = not getattr(env, "ignore_z_target_rotation", False)
            self.compute_reward = env.compute_reward if takes_rows else partial(_rewards_by_row, env.compute_reward)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: seed of the simulator, ``None`` to go on with its random numbers
        :param options: options of the simulator's reset
        :return: observation, info
        """
        return reset_with(self.simulated, seed, options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        :param action: action for the robot
        :return: observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.simulated.step(action)
        return observation, float(reward), bool(terminated), bool(truncated), info  # some are of numpy's types

    def render(self) -> Any:
        """Draw a frame in the form that ``render_mode`` names."""
        return self.simulated.render()

    def close(self) -> None:
        """Close the simulator's windows."""
        self.simulated.close()

    @property
    def goal(self) -> np.ndarray:
        """Goal that the last reset drew; an environment without goals raises an ``AttributeError``."""
        goal: np.ndarray = self.simulated.goal
        return goal

    @goal.setter
    def goal(self, goal: np.ndarray) -> None:
        self.simulated.goal = goal

    @property
    def _np_random(self) -> np.random.Generator | None:
        """The simulator's random generator; this object has no other."""
        generator: np.random.Generator | None = self.simulated._np_random
        return generator

    @_np_random.setter
    def _np_random(self, generator: np.random.Generator | None) -> None:
        self.simulated._np_random = generator

    @property
    def np_random_seed(self) -> int:
        """Seed of the simulator's random generator."""
        return int(self.simulated.np_random_seed)

    def __reduce__(self) -> Any:
        return _make_again, self._arguments


def _rewards_by_row(compute_reward: Any, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
    """
    Rewards of rows of goals, one row after the other.

    Where gymnasium-robotics ignores a rotation, as of pens, it copies the third row's angles in place of each row's third.
    """
    if np.ndim(achieved) == 1:
        return compute_reward(achieved, desired, info)
    return np.array([compute_reward(*goals, {}) for goals in zip(achieved, desired, strict=True)])


def _make_again(env_id: str, rewards_goals: bool, kwargs: dict[str, Any]) -> Robot:
    return Robot(env_id, rewards_goals, **kwargs)


def make_robotics(
    task: str,
    noise_std: float = 0.0,
    privileged: str = "hidden",
    history: int = 1,
    goal_entries: bool = False,
    delay: int = 0,
    drop: float = 0.0,
    **kwargs: Any,
) -> gym.Env:
    """
    Build a task without its time limit, which ``gymnasium.make("sb3_gac/<task>-v<version>")`` adds.

    :param task: name of the task, a key of ``TASKS``
    :param noise_std: standard deviation of the noise on the measurements in ``partial``, in their own units (rad, m, m/s); the
        desired goal is a command, and has no noise
    :param privileged: privileged entry: "hidden" for the components that ``partial`` lacks; "state" for these and the
        components of ``partial`` without noise
    :param history: number of measurements in ``partial``, the newest last, with the actions between them
    :param goal_entries: whether goals stay entries of their own, ``achieved_goal`` and ``desired_goal``, for
        ``HerReplayBuffer``; ``role_keys`` must then give the deployed policy ``["partial", "desired_goal"]``
    :param delay: number of steps by which the measurements in ``partial`` are late; the desired goal never is
    :param drop: probability that a measurement is lost, and the last one shown again
    :param kwargs: keyword arguments of the gymnasium-robotics environment, such as ``reward_type``, except those that change
        its observation
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if an argument is wrong, is for another kind of task, or makes an observation of another size
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {sorted(TASKS)}, got {task!r}.")
    found = TASKS[task]
    if privileged not in PRIVILEGED_CHOICES:
        raise ValueError(f"privileged must be one of {list(PRIVILEGED_CHOICES)}, got {privileged!r}.")
    if goal_entries and not found.has_goals:
        raise ValueError(f"goal_entries=True, but {task} has no goals.")
    if "touch_get_obs" in kwargs:
        raise ValueError("touch_get_obs would change the observation, whose touch values are privileged: leave it out.")
    env: gym.Env = Robot(found.env_id, goal_entries, **{**found.kwargs, **kwargs})
    if not found.has_goals:
        env = WithSimulatorState(env)
    check_size(found.env_id, _size_without_achieved_goal(env.observation_space), found.sizes[0] + found.sizes[1])
    visible = found.hidden if privileged == "hidden" else _both(found.partial, found.hidden)
    env = SplitDictObservation(env, found.partial, visible, keep=GOALS if found.has_goals else ())
    env = noisy_with_history(env, noise_std, history, delay, drop)
    if found.has_goals and not goal_entries:
        env = AppendDesiredGoal(env, (PARTIAL, PRIVILEGED) if privileged == "state" else (PARTIAL,))
    return env


def _size_without_achieved_goal(space: Any) -> int:
    """Number of components of a Dict observation, without the achieved goal, which repeats others."""
    return sum(spaces.flatdim(entry) for key, entry in space.items() if key != ACHIEVED_GOAL)


def _both(first: Selection, second: Selection) -> Selection:
    """Union of two selections, each entry's indices in ascending order; both may share an entry if neither takes it whole."""
    shared = {key: tuple(sorted((*(first[key] or ()), *(second[key] or ())))) for key in set(first) & set(second)}
    return {**first, **second, **shared}


def _import_robotics() -> None:
    """Register gymnasium-robotics's environments, and have it compare joints' types as numbers, by :class:`_ByNumber`."""
    import gymnasium_robotics  # noqa: F401
    from gymnasium_robotics.utils import mujoco_utils

    if isinstance(mujoco_utils.mujoco, ModuleType):
        mujoco_utils.mujoco = _ByNumber(mujoco_utils.mujoco)


class _ByNumber:
    """
    MuJoCo's module, in which the members of ``mjtJoint`` are numbers.

    gymnasium-robotics looks for an element of ``model.jnt_type`` among these members, and in MuJoCo 3.12 and later such an
    element equals none of them.  This object takes the place of ``mujoco`` in ``gymnasium_robotics.utils.mujoco_utils`` alone.

    :param mujoco: MuJoCo's module
    """

    def __init__(self, mujoco: ModuleType):
        self._mujoco = mujoco
        names = ("mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE")
        self.mjtJoint = SimpleNamespace(**{name: int(getattr(mujoco.mjtJoint, name)) for name in names})

    def __getattr__(self, name: str) -> Any:
        return getattr(self._mujoco, name)


#: Id -> arguments of its registration, with its time limit
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}-v{found.env_id.rpartition('-v')[2]}": {
        "entry_point": f"{__name__}:make_robotics",
        "max_episode_steps": found.max_episode_steps,
        "kwargs": {"task": task},
        "disable_env_checker": True,  # the checker would look at every step; tests run it
        "shapes": {name: (size,) for name, size in zip((PARTIAL, PRIVILEGED, "action"), found.sizes, strict=True)},
        "whole_state": False,
    }
    for task, found in TASKS.items()
}
