"""Environments by name: one of this package's, any of gymnasium's, or what a module has, with arguments and wrappers."""

import os
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gac.algorithms import import_path
from sb3_gac.envs import PARTIAL, History, make_vec
from sb3_gac.envs.suites import suite_of

#: File of ``VecNormalize``'s statistics beside a model, as rl_zoo3 calls it
STATISTICS = "vecnormalize.pkl"


def make_envs(
    env_id: str,
    kwargs: Mapping[str, Any],
    wrappers: Sequence[Mapping[str, Mapping[str, Any]]],
    n_envs: int,
    seed: int | None = None,
) -> VecEnv:
    """
    :param env_id: of this package's, or see :func:`make_wrapped`
    :param kwargs: of the environment
    :param wrappers: see :func:`make_wrapped`
    :param n_envs: side by side
    :param seed: of the first one
    :raises ValueError: if a wrapper can't be imported
    """
    if suite_of(env_id) is not None and not wrappers:
        return make_vec(env_id, n_envs, seed, **kwargs)
    # What counts returns goes around the wrappers: one of them may change rewards, or end episodes
    return make_vec_env(partial(make_wrapped, env_id, kwargs, wrappers), n_envs, seed=seed)


def make_wrapped(env_id: str, kwargs: Mapping[str, Any], wrappers: Sequence[Mapping[str, Mapping[str, Any]]]) -> gym.Env:
    """
    :param env_id: of gymnasium, after the module that registers it and a colon if need be; or ``module:name`` of a class or
        function that makes an environment
    :param kwargs: of the environment
    :param wrappers: from the inside to the outside, each ``module:Class`` and its keyword arguments
    :raises ValueError: if a wrapper can't be imported
    """
    return in_wrappers(_make(env_id, kwargs), wrappers)


def in_wrappers(env: gym.Env, wrappers: Sequence[Mapping[str, Mapping[str, Any]]]) -> gym.Env:
    """
    :param env: to be wrapped
    :param wrappers: see :func:`make_wrapped`
    :raises ValueError: if a wrapper can't be imported
    """
    for wrapper in wrappers:
        for path, arguments in wrapper.items():
            env = import_path(path)(env, **arguments)
    return env


def _make(env_id: str, kwargs: Mapping[str, Any]) -> gym.Env:
    module, _, name = env_id.rpartition(":")
    if module and name.isidentifier() and callable(getattr(import_module(module), name, None)):
        env: gym.Env = import_path(env_id)(**kwargs)
        return env
    return gym.make(env_id, **kwargs)


def with_history(env: gym.Env, length: int) -> gym.Env:
    """
    :param env: with a Dict observation
    :param length: observations that ``partial`` then has, with the actions between them where it and they are vectors
    """
    assert isinstance(env.observation_space, spaces.Dict)
    entry = env.observation_space[PARTIAL]
    is_vector = len(entry.shape or ()) == 1 and np.issubdtype(entry.dtype, np.floating)
    return History(env, length, actions=is_vector and isinstance(env.action_space, spaces.Box))


def normalized(env: VecEnv, options: Mapping[str, Any] | None, training: bool = True) -> VecEnv:
    """
    :param env: vectorised environments
    :param options: of ``VecNormalize``, which leaves rewards alone; ``None`` for no normalisation
    :param training: whether it gathers statistics
    """
    return env if options is None else VecNormalize(env, **{"norm_reward": False, "training": training, **options})


def find_modules_here() -> None:
    """A console script finds no modules in the working directory, where ``python -m`` does."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
