"""The scale of observations: whether those that a policy is given are normalised as those that it was trained on."""

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

#: Entry -> mean and standard deviation that it was normalised with, in the entry's shape
Scales: TypeAlias = Mapping[str, tuple[np.ndarray, np.ndarray]]
#: Root mean square of the differences between a policy's inputs, in standard deviations, from which on they are others
FAR = 0.5
#: Standard deviation that a number has which never changes: what is left of the one that statistics begin with
CONSTANT = 1e-3


def entries_normalised_by(env: VecEnv | None) -> tuple[str, ...]:
    """
    The observation entries that a ``VecNormalize`` around environments normalises.

    :param env: vectorised environments of Dict observations, or ``None``
    :return: names of the entries; empty without a ``VecNormalize`` that normalises observations
    """
    vec_normalize = None if env is None else unwrap_vec_normalize(env)
    return tuple(vec_normalize.norm_obs_keys or ()) if vec_normalize is not None and vec_normalize.norm_obs else ()


def entries_normalised_in_training(model: Any) -> tuple[str, ...] | None:
    """
    The observation entries that a model learned from as a ``VecNormalize`` normalised them.

    :param model: model of this package or of SB3
    :return: names of the entries; ``None`` if they are not known, as of a model of SB3's without environments
    """
    if hasattr(model, "normalised_entries"):
        is_of_an_earlier_version = model.normalised_entries is None and model.trained_normalised
        return tuple(model.observation_space.spaces) if is_of_an_earlier_version else model.normalised_entries
    return None if model.env is None else entries_normalised_by(model.env)


def scales_of(env: VecEnv | None) -> Scales:
    """
    The present statistics of a ``VecNormalize`` around environments.

    :param env: vectorised environments of Dict observations, or ``None``
    :return: scale of each entry that is normalised
    """
    vec_normalize = None if env is None else unwrap_vec_normalize(env)
    if vec_normalize is None:
        return {}
    statistics: Any = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
    return {
        key: (statistics[key].mean.copy(), np.sqrt(statistics[key].var + vec_normalize.epsilon))
        for key in entries_normalised_by(env)
    }


def scales_in_training(model: Any) -> Scales:
    """
    The statistics with which observations were normalised in a model's training.

    :param model: model of this package or of SB3
    :return: scale of each entry; empty if nothing was normalised, or the statistics are not known, as of a file of SB3's
    """
    return model.normalised_scales if hasattr(model, "normalised_scales") else scales_of(model.env)


def inputs_apart(then: Scales, now: Scales, entries: Iterable[str]) -> tuple[str, float] | None:
    """
    Find an entry whose values reach a policy as other ones than in its training.

    :param then: scales in the policy's training
    :param now: present scales
    :param entries: entries that the policy reads
    :return: first entry that is far off, and how far: the root mean square of the differences between the same observation's
        values, normalised then and now, in standard deviations; ``None`` if there is no such entry
    """
    for key in entries:
        if key in then and key in now:
            (mean, std), (present_mean, present_std) = then[key], now[key]
            # An observation of then is mean + std z, where z has the variance 1; a number that never changes has no z
            varies = np.maximum(std, present_std) > CONSTANT
            off = ((mean - present_mean) / present_std) ** 2 + np.where(varies, (std / present_std - 1) ** 2, 0.0)
            apart = float(np.sqrt(np.mean(off)))
            if apart > FAR:
                return key, apart
    return None


def check_is_of_training(model: Any, now: Scales, entries: Iterable[str], what: str) -> None:
    """
    Check that a model's deployed observations are to be normalised as those of its training were.

    :param model: trained model
    :param now: scales of the normalisation that is given
    :param entries: observation entries that the policy reads
    :param what: name of what gives the normalisation, for the message
    :raises ValueError: naming an entry whose statistics are others
    """
    found = inputs_apart(scales_in_training(model), now, entries)
    if found is not None:
        raise ValueError(
            f'{what} has other statistics of "{found[0]}" than the VecNormalize that the model was trained with: what the '
            f"policy sees would be {found[1]:.2f} standard deviations off. Give the statistics that were saved with the model."
        )


def check_same_statistics(name: str, entries: Iterable[str], then: Scales, env: VecEnv | None) -> None:
    """
    Check that environments normalise observations as a policy's training did.

    :param name: name of the argument that is the policy's model, for the message
    :param entries: observation entries that the policy reads
    :param then: scales in the policy's training
    :param env: environments whose observations the policy is going to read
    :raises ValueError: naming an entry whose statistics are others
    """
    found = inputs_apart(then, scales_of(env), entries)
    if found is not None:
        raise ValueError(
            f'{name} was trained on an entry "{found[0]}" that VecNormalize normalised by other statistics than those of env: '
            f"what {name} sees would be {found[1]:.2f} standard deviations off. Wrap env in VecNormalize.load(<the statistics "
            f"of the {name}'s training>, env), and set its training to False."
        )


def check_same_scale(name: str, entries: Iterable[str], then: tuple[str, ...] | None, env: VecEnv) -> None:
    """
    Check that environments give observations of the scale that a policy was trained on.

    :param name: name of the argument that is the policy's model, for the message
    :param entries: observation entries that the policy reads
    :param then: entries that were normalised in the policy's training; ``None`` if they are not known
    :param env: environments whose observations the policy is going to read
    :raises ValueError: naming an entry that is normalised in one of the two cases alone
    """
    now, ways = entries_normalised_by(env), ("raw", "normalised by VecNormalize")
    for key in entries if then is not None else ():
        if (key in then) != (key in now):  # type: ignore[operator]
            raise ValueError(
                f'{name} was trained on an entry "{key}" that was {ways[key in then]}, but env gives it '  # type: ignore[operator]
                f"{ways[key in now]}: wrap env as in the {name}'s training, in VecNormalize.load(<its statistics>, env) if "
                f"there was a VecNormalize, or train the {name} on such observations."
            )
