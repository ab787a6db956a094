"""Environments by name, with arguments and wrappers: this package's, any of gymnasium's, or a module's own."""

import os
import pickle
import sys
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gac.algorithms import import_path
from sb3_gac.checks.scale import entries_normalised_in_training
from sb3_gac.deploy.normalization import DeploymentNormalizer
from sb3_gac.envs import PARTIAL, History, make_vec
from sb3_gac.envs.suites import suite_of

#: Name of the file of ``VecNormalize``'s statistics beside a model, the same as in rl_zoo3
STATISTICS = "vecnormalize.pkl"


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
    return in_wrappers(_make(env_id, kwargs), wrappers)


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


def _make(env_id: str, kwargs: Mapping[str, Any]) -> gym.Env:
    module, _, name = env_id.rpartition(":")
    if module and name.isidentifier() and callable(getattr(import_module(module), name, None)):
        env: gym.Env = import_path(env_id)(**kwargs)
        return env
    return gym.make(env_id, **kwargs)


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


def normalized(env: VecEnv, options: Mapping[str, Any] | None, training: bool = True) -> VecEnv:
    """
    Normalise observations.

    :param env: vectorised environments
    :param options: keyword arguments of ``VecNormalize``, which does not normalise rewards unless they say so; ``None`` for no
        normalisation
    :param training: whether ``VecNormalize`` updates its statistics
    :return: environments in a ``VecNormalize``, or as they were
    """
    return env if options is None else VecNormalize(env, **{"norm_reward": False, "training": training, **options})


def normalizer_of(model: Any, file: Path, given: Path | None, entries: Collection[str]) -> DeploymentNormalizer | None:
    """
    Find the normalisation that policies of a model need.

    :param model: trained model, which knows whether it learned from normalised observations
    :param file: file of the model
    :param given: file that ``VecNormalize.save`` wrote, ``None`` for that beside the model
    :param entries: entries that the policies read; no others are normalised, or need to be there
    :return: function that normalises observations as ``VecNormalize`` did in training, ``None`` if nothing that the policies
        read was normalised
    :raises ValueError: if a file is given for a model trained without ``VecNormalize``; if there is none for policies that
        read what was normalised; or if it holds something else, or statistics of other observations
    :raises FileNotFoundError: if there is no file of the given name
    """
    statistics = _statistics_of(model, file, given, entries)
    if statistics is None:
        return None
    normalised = [key for key in entries if key in (entries_normalised_in_training(model) or ())]
    return DeploymentNormalizer.from_vec_normalize(_read_statistics(statistics, model, entries), normalised)


def _statistics_of(model: Any, file: Path, given: Path | None, entries: Collection[str]) -> Path | None:
    """
    Find the file with the statistics of ``VecNormalize`` that policies of a model need.

    :param model: trained model, which knows whether it learned from normalised observations
    :param file: file of the model
    :param given: file that the option ``--vec-normalize`` names; ``None`` for that beside the model
    :param entries: entries that the policies read
    :return: path of the statistics' file; ``None`` if the model was trained without ``VecNormalize``, or if there is no file
        and the policies read nothing that was normalised
    :raises ValueError: if a file is given for a model trained without ``VecNormalize``, or there is none for policies that
        read what was normalised
    :raises FileNotFoundError: if there is no file of the given name
    """
    if not model.trained_normalised:
        if given is not None:
            raise ValueError("--vec-normalize: the model was trained without VecNormalize, or on observations as they are.")
        return None
    beside = file.parent / STATISTICS
    if given is None and not beside.is_file():
        if set(entries).isdisjoint(entries_normalised_in_training(model) or ()):
            return None
        raise ValueError(
            f"The model learned from observations that VecNormalize normalised, and there is no {STATISTICS} beside {file}: "
            "pass --vec-normalize with the file that VecNormalize.save wrote."
        )
    if given is not None and not given.is_file():
        raise FileNotFoundError(f"--vec-normalize: there is no file {given}.")
    return given or beside


def _read_statistics(path: Path, model: Any, entries: Collection[str]) -> VecNormalize:
    """
    :param path: path of a file that ``VecNormalize.save`` wrote
    :param model: model whose observations are to be normalised
    :param entries: entries that are to be normalised where they were in training
    :return: what was saved, without environments
    :raises ValueError: if the file holds something else, statistics of other observations, or none of an entry that was
        normalised in training
    """
    try:
        with path.open("rb") as file:
            found = pickle.load(file)
    except OSError:
        raise
    except Exception as error:  # what bytes that are no pickle raise is as various as bytes are
        raise ValueError(f"--vec-normalize: {path} is no file that VecNormalize.save wrote: {error}") from None
    if not isinstance(found, VecNormalize):
        raise ValueError(f"--vec-normalize: {path} holds {type(found).__name__}, not what VecNormalize.save writes.")
    statistics = getattr(found, "obs_rms", None) if found.norm_obs else None  # which one of rewards alone does not have
    known = statistics if isinstance(statistics, dict) else {}
    missing = sorted(set(model.normalised_entries or ()) & set(entries) - known.keys())
    if missing:
        raise ValueError(f"--vec-normalize: {path} has no statistics of {missing}, which were normalised in training.")
    for key, space in model.observation_space.spaces.items():
        of_key = known.get(key)
        if of_key is not None and sorted(of_key.mean.shape) != sorted(space.shape):  # images may have their channels first
            raise ValueError(
                f'--vec-normalize: {path} is of another environment: its "{key}" has the shape {of_key.mean.shape}, and the '
                f"model's {space.shape}."
            )
    return found


def find_modules_here() -> None:
    """Let imports find modules in the working directory, as ``python -m`` does and a console script does not."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
