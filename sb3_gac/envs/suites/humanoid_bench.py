"""
HumanoidBench: the sixteen tasks of the paper's Table 8.  Users install it by hand, since no package index has it.

==============  ====================================  ==============================================
robot           partial                               privileged="hidden"
==============  ====================================  ==============================================
h1, 19 motors   qpos 26; with a ball 33               qvel 25; with a ball 31
h1touch, 61     the standard observation, 164 to 308  53 touch sensors, 1,344 numbers, on a log scale
==============  ====================================  ==============================================

``privileged="state"`` is all of both columns, without noise.  ``insert_small`` has 190 numbers in HumanoidBench's present
version; the paper says 164.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites.layout import noisy_with_history
from sb3_gac.envs.wrappers import Observation, SplitDictObservation, reset_with

PRIVILEGED_CHOICES = ("hidden", "state")
#: Task -> size of ``partial``
LOCOMOTION = {
    "basketball": 33,
    "crawl": 26,
    "highbar_simple": 26,
    "hurdle": 26,
    "maze": 26,
    "pole": 26,
    "slide": 26,
    "walk": 26,
}
MANIPULATION = {
    "basketball": 164,
    "bookshelf_hard": 308,
    "bookshelf_simple": 308,
    "insert_normal": 190,
    "insert_small": 190,
    "room": 229,
    "spoon": 167,
    "window": 171,
}
TASKS = (*(f"h1-{task}" for task in LOCOMOTION), *(f"h1touch-{task}" for task in MANIPULATION))
_SHORT = ("basketball", "insert_normal", "insert_small")  # tasks whose time limit is 500 steps
_TOUCH_SUFFIX = "_touch"
_RANDOM_STREAM = 0x7461736B  # separates the tasks' draws from generators that others seed with the same number
INSTALL = (
    "clone github.com/carlosferrazza/humanoid-bench, pip install dm_control jax, and in the clone pip install --no-deps -e . "
    "(the versions that it pins are not needed)"
)


class SeededTask(gym.Wrapper):
    """
    A task of HumanoidBench whose resets depend on its own seed alone.

    Some tasks draw from numpy's global generator; here that generator is afterwards as it was before.  A checkpoint has the
    task's own counters, beside MuJoCo's state.

    :param robot: name of the robot, a key of ``humanoid_bench.env.ROBOTS``
    :param task: name of the task, a key of ``humanoid_bench.env.TASKS``
    :param render_mode: mode of ``render``. HumanoidBench is made without it: it would open a context of OpenGL at once, though
        nothing is to be drawn
    :param kwargs: further keyword arguments for ``HumanoidEnv``
    :raises ImportError: if HumanoidBench, or a module that it imports, is not installed
    """

    def __init__(self, robot: str, task: str, render_mode: str | None = None, **kwargs: Any):
        bench = _import_bench(f"sb3_gac/{robot}-{task}-v0")
        arguments = {"control": "pos", **bench.TASKS[task]().kwargs, **kwargs}
        super().__init__(bench.HumanoidEnv(robot=robot, task=task, render_mode=None, **arguments))
        self.unwrapped.render_mode = render_mode
        self._arguments = robot, task, {"render_mode": render_mode, **kwargs}
        self._generator = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: seed of the environment and of its task's draws, ``None`` to go on with their random numbers
        :param options: options of the environment's reset
        :return: observation, info
        """
        if seed is not None:
            self._generator = np.random.default_rng([seed, _RANDOM_STREAM])
        with _global_seed(int(self._generator.integers(2**32))):
            return reset_with(self.env, seed, options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        :param action: action for the robot
        :return: observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward), bool(terminated), bool(truncated), info

    def checkpoint_state(self) -> dict[str, Any]:
        """
        :return: state for :mod:`sb3_gac.envs.state`: the generator, and the task's attributes that are numbers, strings,
            arrays or lists of these
        """
        task = vars(self.unwrapped.task)  # type: ignore[attr-defined]
        plain = {name: _copied(value) for name, value in task.items() if _is_plain(value)}
        return {"generator": deepcopy(self._generator), "task": plain}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        Put the task back into a state.

        :param state: state that :meth:`checkpoint_state` returned
        """
        self._generator = state["generator"]
        vars(self.unwrapped.task).update(state["task"])  # type: ignore[attr-defined]

    def __reduce__(self) -> Any:
        return _make_again, self._arguments


def _make_again(robot: str, task: str, kwargs: dict[str, Any]) -> SeededTask:
    return SeededTask(robot, task, **kwargs)


class WithSensors(gym.ObservationWrapper):
    """
    A robot's observation by groups: ``qpos`` and ``qvel`` without touch sensors, ``observation`` and ``touch`` with them.

    Touch has three directions. Values x in two of them are of either sign and up to thousands, so all are shown as
    sign(x) log(1 + abs(x)).

    :param env: MuJoCo environment whose observation begins with positions and velocities
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        model = env.unwrapped.model  # type: ignore[attr-defined]
        touching = [sensor for sensor in map(model.sensor, range(model.nsensor)) if sensor.name.endswith(_TOUCH_SUFFIX)]
        self._touch = np.array([sensor.adr[0] + i for sensor in touching for i in range(sensor.dim[0])], dtype=int)
        self._n_positions = model.nq
        self.groups = ("observation", "touch") if touching else ("qpos", "qvel")
        size = int(np.prod(env.observation_space.shape))  # type: ignore[arg-type]
        sizes = (size, len(self._touch)) if touching else (model.nq, size - model.nq)
        boxes = [spaces.Box(-np.inf, np.inf, (size,), np.float64) for size in sizes]
        self.observation_space = spaces.Dict(dict(zip(self.groups, boxes, strict=True)))

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
        :param observation: observation of the environment, a vector
        :return: group -> its values, a vector
        """
        if self.groups[1] == "qvel":
            values = np.split(observation, [self._n_positions])
        else:
            touch = self.unwrapped.data.sensordata[self._touch]  # type: ignore[attr-defined]
            values = [observation, np.sign(touch) * np.log1p(np.abs(touch))]
        return dict(zip(self.groups, values, strict=True))


def make_humanoid_bench(
    task: str,
    noise_std: float = 0.0,
    privileged: str = "hidden",
    history: int = 1,
    delay: int = 0,
    drop: float = 0.0,
    **kwargs: Any,
) -> gym.Env:
    """
    Build a task without its time limit, which ``gymnasium.make("sb3_gac/<task>-v0")`` adds.

    :param task: one of ``TASKS``, such as "h1-walk"
    :param noise_std: standard deviation of the noise on ``partial``, in the observation's own units; 0 for none
    :param privileged: privileged entry: "hidden" for the components that ``partial`` lacks; "state" for these and the
        components of ``partial`` without noise
    :param history: number of observations in ``partial``, the newest last, followed by the actions between them
    :param delay: number of steps by which ``partial`` is late
    :param drop: probability that an observation of ``partial`` is lost, and the last one shown again
    :param kwargs: keyword arguments for ``humanoid_bench.env.HumanoidEnv``
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if an argument is wrong; the message names it
    :raises ImportError: if HumanoidBench is not installed; the message says how to install it
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {list(TASKS)}, got {task!r}.")
    if privileged not in PRIVILEGED_CHOICES:
        raise ValueError(f"privileged must be one of {list(PRIVILEGED_CHOICES)}, got {privileged!r}.")
    if "obs_wrapper" in kwargs:
        raise ValueError("obs_wrapper would change the observation, which is then split: leave obs_wrapper out.")
    robot, _, name = task.partition("-")
    env = WithSensors(SeededTask(robot, name, **kwargs))
    seen, hidden = env.groups
    split = SplitDictObservation(env, [seen], [hidden] if privileged == "hidden" else [seen, hidden])
    return noisy_with_history(split, noise_std, history, delay, drop)


def _import_bench(environment: str) -> Any:
    try:
        _without_fields_that_are_gone(import_module("humanoid_bench.dmc_deps.dmc_sizes").array_sizes)
        return import_module("humanoid_bench.env")
    except ImportError as error:
        missing = error.name or "humanoid_bench"
        raise ImportError(f"{environment} needs {missing}. To install HumanoidBench, {INSTALL}.", name=missing) from error


def _without_fields_that_are_gone(array_sizes: dict[str, dict[str, Any]]) -> None:
    """Drop fields that the present MuJoCo lacks from HumanoidBench's table, since it asks MuJoCo for each of them."""
    import mujoco

    for struct, kind in {"mjmodel": mujoco.MjModel, "mjdata": mujoco.MjData}.items():
        for field in [field for field in array_sizes[struct] if not hasattr(kind, field)]:
            del array_sizes[struct][field]


@contextmanager
def _global_seed(seed: int) -> Iterator[None]:
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return isinstance(value, bool | int | float | str | np.ndarray | np.generic)


def _copied(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, list):
        return [_copied(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _shapes(task: str) -> dict[str, tuple[int]]:
    robot, _, name = task.partition("-")
    if robot == "h1":  # a free body's orientation is four numbers, its angular velocity three
        n_bodies = 2 if name == "basketball" else 1
        return {PARTIAL: (LOCOMOTION[name],), PRIVILEGED: (LOCOMOTION[name] - n_bodies,), "action": (19,)}
    return {PARTIAL: (MANIPULATION[name],), PRIVILEGED: (1344,), "action": (61,)}


#: Id -> arguments of its registration, with its time limit
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}-v0": {
        "entry_point": f"{__name__}:make_humanoid_bench",
        "max_episode_steps": 500 if task.partition("-")[2] in _SHORT else 1000,
        "kwargs": {"task": task},
        "disable_env_checker": True,  # the checker would look at every step; tests run it
        "shapes": _shapes(task),
        "whole_state": False,
    }
    for task in TASKS
}
