"""The statistics of ``VecNormalize`` that lie beside a model's file, for what evaluates or exports the model."""

import pickle
from collections.abc import Collection
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecNormalize

from sb3_gac.checks.scale import check_is_of_training, entries_normalised_in_training
from sb3_gac.deploy.normalization import DeploymentNormalizer

#: Name of the file of ``VecNormalize``'s statistics beside a model, the same as in rl_zoo3
STATISTICS = "vecnormalize.pkl"


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
    normalizer = DeploymentNormalizer.from_vec_normalize(_read_statistics(statistics, model, entries), normalised)
    check_is_of_training(model, normalizer.scales, normalised, f"--vec-normalize: {statistics}")
    return normalizer


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
