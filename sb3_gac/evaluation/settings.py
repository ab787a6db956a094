"""The settings of the sensor in an evaluation, and the environment that brings them about."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import yaml

from sb3_gac.algorithms import import_path
from sb3_gac.envs.disturbances import DroppedFrames, SensorDelay, disturb
from sb3_gac.envs.entries import wrappers_of
from sb3_gac.envs.spaces import PARTIAL
from sb3_gac.envs.suites import SUITES, batch_factory, env_id_of, is_batched, suite_of, without_module
from sb3_gac.envs.wrappers import SensorNoise
from sb3_gac.training.environments import creator_of, in_wrappers

CONFIGURATION = "config.yaml"
#: Part of the setting -> values that are evaluated if none are asked for
DEFAULTS: dict[str, list[Any]] = {"noise": [0.0, 0.1, 0.2, 0.3], "delay": [0, 1, 2], "drop": [0.0, 0.1, 0.3]}
#: Part of the setting -> argument of this package's environments
ARGUMENTS = {"noise": "noise_std", "delay": "delay", "drop": "drop"}


class Setting(NamedTuple):
    """
    A setting of the sensor.

    :param noise: standard deviation of the noise on ``partial``, in its own units
    :param delay: number of steps by which ``partial`` is late
    :param drop: probability that an observation is lost, and the last one shown again
    """

    noise: float = 0.0
    delay: int = 0
    drop: float = 0.0

    def __str__(self) -> str:
        return f"noise {self.noise:g}, delay {self.delay}, drop {self.drop:g}"


UNDISTURBED = Setting()


def plan(asked: Mapping[str, Sequence[Any]], trained: Setting) -> tuple[list[Setting], dict[str, list[Setting]]]:
    """
    Plan the settings of an evaluation, in which one part of the setting is varied at a time.

    A part with a single value has it in all settings but the undisturbed one. A part with several values is varied: there is a
    setting for each value and for that of training, in which each other part has its single value, or else that of training.

    :param asked: name of a part of the setting -> its values
    :param trained: setting of training
    :return: all settings, the undisturbed one first; and name of each part that is varied -> its settings, in ascending order
    """
    base = trained._replace(**{name: values[0] for name, values in asked.items() if len(set(values)) == 1})
    curves = {
        name: [base._replace(**{name: value}) for value in sorted({*values, getattr(trained, name)})]
        for name, values in asked.items()
        if len(set(values)) > 1
    }
    settings = [UNDISTURBED, *(setting for settings in curves.values() for setting in settings)]
    return list(dict.fromkeys(settings if curves else [UNDISTURBED, base])), curves


@dataclass(frozen=True)
class Environment:
    """
    The environment in which a policy is evaluated.

    :param env_id: gymnasium's id, ``module:id`` of an environment that a module registers, or ``module:name`` of a class or a
        function that makes one
    :param kwargs: keyword arguments of the environment
    :param wrappers: wrappers around the environment, from the inside to the outside, each ``module:Class`` -> its keyword
        arguments
    """

    env_id: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    wrappers: Sequence[Mapping[str, Mapping[str, Any]]] = ()

    def make(self, setting: Setting, render_mode: str | None = None) -> gym.Env:
        """
        Make the environment in a setting: one of this package by its own arguments where it has them, else by wrappers.

        :param setting: setting of the sensor
        :param render_mode: gymnasium's render mode, ``None`` for none
        :return: environment in the setting
        :raises ValueError: if there is no such environment, or its observations have no ``partial``
        """
        values = {ARGUMENTS[name]: value for name, value in setting._asdict().items()}
        own = {name: value for name, value in values.items() if name in self._own_arguments}
        rendering = {} if render_mode is None else {"render_mode": render_mode}
        env = in_wrappers(self._creator(**{**self.kwargs, **own, **rendering}), self.wrappers)
        entries = getattr(env.observation_space, "spaces", {})
        if PARTIAL not in entries:
            raise ValueError(f'{self.env_id} has no entry "{PARTIAL}" in its observations: {env.observation_space}.')
        return disturb(env, **{name: value for name, value in values.items() if name not in own})

    @property
    def trained(self) -> Setting:
        """Setting of training, as the environment's arguments or their defaults say."""
        known: dict[str, Any] = {}
        for name, argument in ARGUMENTS.items():
            value = self._own_arguments.get(argument, inspect.Parameter.empty)
            if value is inspect.Parameter.empty:
                continue
            if not isinstance(value, (int, float)):
                raise ValueError(
                    f"{argument} of {self.env_id} is {value!r}, and an evaluation has one number for all of partial: give "
                    f'one, such as --env-kwargs "{{{argument}: 0.1}}".'
                )
            known[name] = value
        return Setting(**known)

    @property
    def beside(self) -> str:
        """
        What disturbs the sensor beside the setting, in words: this package's wrappers in an undisturbed environment, noise of
        the simulator's own, or noise in an environment that nobody can ask for it. It is empty if there is nothing.
        """
        env = self.make(UNDISTURBED)
        own = [type(layer).__name__ for layer, _ in wrappers_of(env, PARTIAL) if _disturbs(layer)]
        env.close()
        if level := self.own_noise:
            own.append(f"the task's own sensor noise, which {level}=0 leaves out")
        if own:
            return f"what it has of its own: {' and '.join(own)}"
        return "" if self.has_noise else "any noise that it may have of its own"

    @property
    def own_noise(self) -> str | None:
        """Argument for the level of the simulator's own sensor noise; ``None`` if there is none, or it is left out."""
        suite = suite_of(self.env_id)
        argument = None if suite is None else SUITES[suite].own_noise
        return None if argument is None or self.kwargs.get(argument) == 0 else argument

    @property
    def has_noise(self) -> bool:
        """Whether the environment has an argument for sensor noise; if not, noise comes on top of its own."""
        return ARGUMENTS["noise"] in self._own_arguments

    @property
    def _own_arguments(self) -> Mapping[str, Any]:
        """
        Those arguments of the environment that make a setting -> their values in training. Only this package's environments
        have such: elsewhere an argument of the same name may mean something else, such as a control period.
        """
        _ = self._creator  # which imports the module that registers the environment, and says if there is none
        if suite_of(self.env_id) is None:
            return {}
        parameters = self._parameters
        defaults = {argument: parameters[argument].default for argument in ARGUMENTS.values() if argument in parameters}
        return defaults | {argument: value for argument, value in self.kwargs.items() if argument in ARGUMENTS.values()}

    @property
    def _creator(self) -> Callable[..., gym.Env]:
        try:
            return creator_of(self.env_id)
        except ModuleNotFoundError as error:
            raise ValueError(f"--env {self.env_id}: there is no module {error.name!r} on Python's path.") from None

    @property
    def _parameters(self) -> Mapping[str, inspect.Parameter]:
        """Parameters of the function that makes one of this package's environments."""
        name = without_module(self.env_id)
        if is_batched(name):
            return _of_batch(name)
        entry_point = gym.registry[name].entry_point
        made_by = import_path(entry_point) if isinstance(entry_point, str) else entry_point
        assert made_by is not None
        return inspect.signature(made_by).parameters


def _disturbs(layer: gym.Env) -> bool:
    """Whether a layer is a wrapper of this package that changes what the sensor sends."""
    values = {SensorNoise: "noise_std", SensorDelay: "steps", DroppedFrames: "probability"}
    return any(isinstance(layer, kind) and np.any(getattr(layer, name) != 0) for kind, name in values.items())


def _of_batch(env_id: str) -> Mapping[str, inspect.Parameter]:
    """Parameters of a simulator that steps a batch; it takes noise, some simulators under ``**kwargs``."""
    parameters = dict(inspect.signature(batch_factory(env_id)[0]).parameters)
    if SUITES[suite_of(env_id) or ""].sensor_noise:
        name = ARGUMENTS["noise"]
        parameters.setdefault(name, inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=0.0))
    return parameters


def environment_of_run(directory: Path) -> Environment | None:
    """
    Read from a run's configuration in which environment it was trained.

    :param directory: folder of a run of ``sb3_gac.train``, or of the benchmarks
    :return: environment of the run's training; ``None`` if the folder has no configuration of a run
    """
    run = _configuration(directory / CONFIGURATION)
    made = run.get("environment")
    if isinstance(made, Mapping) and {"id", "kwargs"} <= made.keys():
        return Environment(made["id"], made["kwargs"], made.get("wrappers", ()))
    if made is not None or not {"task", "noise"} <= run.keys():
        return None
    env_id = env_id_of(run["task"])
    suite = suite_of(env_id)
    has_noise = suite is None or SUITES[suite].sensor_noise
    given = {
        "noise_std": run["noise"] if has_noise else None,
        "history": run.get("history"),
        "privileged": run.get("privileged"),
    }
    usual = {"history": 1, "privileged": "state"}  # not every environment has these arguments
    return Environment(env_id, {name: value for name, value in given.items() if value not in (None, usual.get(name))})


def _configuration(path: Path) -> Mapping[str, Any]:
    """Settings of a run, empty where the file is missing or holds something else."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else None
    except (UnicodeDecodeError, yaml.YAMLError):
        return {}
    run = content.get("run", content) if isinstance(content, Mapping) else None
    return run if isinstance(run, Mapping) else {}


def check_fits(entries: Mapping[str, tuple[int, ...]], env: gym.Env, name: str) -> None:
    """
    Check that an environment shows the entries that a policy reads.

    :param entries: entries that the policy reads, with their shapes
    :param env: environment whose observations the policy is to get
    :param name: name of the environment, for the message
    :raises ValueError: if an entry is missing or of another shape; the message names it
    """
    shown = env.observation_space.spaces  # type: ignore[attr-defined]
    for key, shape in entries.items():
        if key not in shown:
            raise ValueError(
                f'The policy reads an entry "{key}", and {name} has {list(shown)}: evaluate it where it was trained.'
            )
        if sorted(shown[key].shape) != sorted(shape):  # images may have their channels first or last
            raise ValueError(
                f'The policy reads "{key}" of the shape {shape}, and {name} shows {tuple(shown[key].shape)}: make the '
                'environment as in training, such as by --env-kwargs "{history: 4}".'
            )


def is_real_valued(env: gym.Env) -> bool:
    """
    :param env: environment with an entry ``partial``
    :return: whether ``partial`` is of floats, to which noise can be added
    """
    return bool(np.issubdtype(env.observation_space[PARTIAL].dtype, np.floating))  # type: ignore[index]
