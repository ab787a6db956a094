"""The scale of observations: whether those that a policy is given are normalised as those that it was trained on."""

from collections.abc import Iterable
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


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
