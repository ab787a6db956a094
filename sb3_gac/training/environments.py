"""Environments by name, with arguments and wrappers: this package's, any of gymnasium's, or a module's own."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import NameNotFound, NamespaceNotFound
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gac.algorithms import import_path
from sb3_gac.checks.values import as_sentence
from sb3_gac.deploy.statistics import STATISTICS
from sb3_gac.envs import PARTIAL, History, make_vec
from sb3_gac.envs.suites import suite_of


def make_envs(
    env_id: str,
    kwargs: Mapping[str, Any],
    wrappers: Sequence[Mapping[str, Mapping[str, Any]]],
    n_envs: int,
    seed: int | None = None,
) -> VecEnv:
    """
    Make vectorised environments.

    :param env_id: id of one of this package's environments, or a name that :func:`make_wrapped` describes
    :param kwargs: keyword arguments of the environment
    :param wrappers: wrappers from the inside to the outside, each a mapping from ``module:Class`` to its keyword arguments
    :param n_envs: number of environments
    :param seed: seed of the first environment; ``None`` for a random one
    :return: vectorised environments
    :raises ValueError: if a wrapper can't be imported
    """
    if suite_of(env_id) is not None and not wrappers:
        return make_vec(env_id, n_envs, seed, **kwargs)
    # The monitor of returns goes outside of the wrappers, since a wrapper may change rewards or end episodes
    return make_vec_env(partial(make_wrapped, env_id, kwargs, wrappers), n_envs, seed=seed)


def make_wrapped(env_id: str, kwargs: Mapping[str, Any], wrappers: Sequence[Mapping[str, Mapping[str, Any]]]) -> gym.Env:
    """
    Make one environment with its wrappers.

    :param env_id: id in gymnasium, after the name of the module that registers the environment and a colon if necessary; or
        ``module:name`` of a class or function that makes an environment
    :param kwargs: keyword arguments of the environment
    :param wrappers: wrappers from the inside to the outside, each a mapping from ``module:Class`` to its keyword arguments
    :return: wrapped environment
    :raises ValueError: if a wrapper can't be imported
    """
    return in_wrappers(creator_of(env_id)(**kwargs), wrappers)


def in_wrappers(env: gym.Env, wrappers: Sequence[Mapping[str, Mapping[str, Any]]]) -> gym.Env:
    """
    Wrap an environment.

    :param env: environment to wrap
    :param wrappers: wrappers from the inside to the outside, each a mapping from ``module:Class`` to its keyword arguments
    :return: wrapped environment
    :raises ValueError: if a wrapper can't be imported
    """
    for wrapper in wrappers:
        for path, arguments in wrapper.items():
            env = import_path(path)(env, **arguments)
    return env


def check_split(env_id: str, space: spaces.Space) -> None:
    """
    Check that the observations of an environment of one's own are split into entries, before an algorithm reads them.

    :param env_id: id of the environment, or ``module:name``, for the message
    :param space: observation space of the environment
    :raises ValueError: if the space is no Dict with the entry ``partial``; the message says how to make one
    """
    if not isinstance(space, spaces.Dict):
        found, wrapper = f"are {space}", "SplitObservation"
    elif PARTIAL not in space.spaces:
        found, wrapper = f"have the entries {list(space.spaces)}", "SplitDictObservation"
    else:
        return
    raise ValueError(
        f"--env: the observations of {env_id} {found}, and must be a Dict with the entries partial, for the learner, and "
        "privileged. Give --env my_module:make_env, a function of yours that returns "
        f"sb3_gac.envs.{wrapper}(env, partial=[...], privileged=[...]); docs/environments.md shows how."
    )


def creator_of(env_id: str) -> Callable[..., gym.Env]:
    """
    Find what makes an environment. Where a module has a class or function of the name under which it registers an environment,
    it is the registered one, with its time limit.

    :param env_id: name of an environment, as :func:`make_wrapped` describes
    :return: function that makes the environment from its keyword arguments
    :raises ModuleNotFoundError: if there is no such module
    :raises gymnasium.error.NameNotFound: if no environment has that name
    """
    module, _, name = env_id.rpartition(":")
    found = getattr(import_module(module), name, None) if module else None
    if callable(found) and name not in gym.registry:
        creator: Callable[..., gym.Env] = found
        return creator
    return partial(_make_registered, env_id)


def _make_registered(env_id: str, **kwargs: Any) -> gym.Env:
    try:
        return gym.make(env_id, **kwargs)
    except (NameNotFound, NamespaceNotFound) as error:
        if ":" in env_id:
            raise
        raise type(error)(f"{as_sentence(error)} An id that a module of yours registers is my_module:{env_id}.") from error


def with_history(env: gym.Env, length: int) -> gym.Env:
    """
    Give the learner the last observations, and the actions between them where both are vectors.

    :param env: environment with a Dict observation
    :param length: number of observations in ``partial``, the newest included
    :return: environment in a :class:`sb3_gac.envs.History`
    """
    assert isinstance(env.observation_space, spaces.Dict)
    entry = env.observation_space[PARTIAL]
    is_vector = len(entry.shape or ()) == 1 and np.issubdtype(entry.dtype, np.floating)
    return History(env, length, actions=is_vector and isinstance(env.action_space, spaces.Box))


def entries_of_floats(env: VecEnv) -> list[str]:
    """
    List the entries that can be normalised.

    :param env: vectorised environments with Dict observations
    :return: names of the entries of floating-point numbers; images and discrete values are none
    :raises ValueError: if there are none
    """
    assert isinstance(env.observation_space, spaces.Dict)
    boxes = {key: space for key, space in env.observation_space.items() if isinstance(space, spaces.Box)}
    found = [key for key, box in boxes.items() if np.issubdtype(box.dtype, np.floating)]
    if not found:
        raise ValueError("--normalize: no entry of the observations holds floating-point numbers: leave it out.")
    return found


def normalized(
    env: VecEnv, options: Mapping[str, Any] | None, training: bool = True, teacher: str | Path | None = None
) -> VecEnv:
    """
    Normalise observations.

    :param env: vectorised environments
    :param options: keyword arguments of ``VecNormalize``, which does not normalise rewards unless they say so; ``None`` for no
        normalisation
    :param training: whether ``VecNormalize`` updates its statistics
    :param teacher: file of a model that will be asked for actions. If the statistics of its training lie beside it, they are
        taken in place of ``options``, and stay as they are; ``None`` for no teacher
    :return: environments in a ``VecNormalize``, or as they were
    """
    statistics = None if teacher is None else Path(teacher).parent / STATISTICS
    if statistics is not None and statistics.is_file():
        as_taught = VecNormalize.load(str(statistics), env)
        as_taught.training, as_taught.norm_reward = False, bool((options or {}).get("norm_reward", False))
        return as_taught
    return env if options is None else VecNormalize(env, **{"norm_reward": False, "training": training, **options})


def find_modules_here() -> None:
    """Let imports find modules in the working directory, as ``python -m`` does and a console script does not."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
