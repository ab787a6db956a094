"""What SB3's ``HerReplayBuffer`` needs of an environment, looked at before training."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac.common.entries import stored_shape

GOALS = ("achieved_goal", "desired_goal")


def check_hindsight(buffer_class: Any, buffer_kwargs: Mapping[str, Any], space: spaces.Dict, env: VecEnv | None) -> None:
    """
    :param buffer_class: ``replay_buffer_class``
    :param buffer_kwargs: of it
    :param space: of the observations
    :param env: whose ``compute_reward`` rewards other goals; ``None`` where there is none
    :raises ValueError: if this is ``HerReplayBuffer`` and the observation has no goals, or ``compute_reward`` is missing or
        does not reward many goals at once
    """
    if not (isinstance(buffer_class, type) and issubclass(buffer_class, HerReplayBuffer)):
        return
    name, entries = buffer_class.__name__, space.spaces
    if not set(GOALS) <= set(entries):
        raise ValueError(
            f"replay_buffer_class={name} replaces goals in the observation's entries {list(GOALS)}, but the observation has "
            f"{list(entries)}. Leave the goal environment's observation as it is, and say with role_keys who sees what of it: "
            'role_keys={"learner": ["observation", "desired_goal"]}.'
        )
    achieved, desired = (entries[goal] for goal in GOALS)
    if stored_shape(achieved) != stored_shape(desired):
        raise ValueError(
            f'replay_buffer_class={name} puts the entry "achieved_goal" in the place of "desired_goal", but they are '
            f"{achieved} and {desired}: give them one shape."
        )
    if env is None:
        return
    remedy = (
        f"{name} calls compute_reward(achieved_goals, desired_goals, infos) with N rows of each, and needs N rewards, as an "
        "array of shape (N,): take norms and comparisons along the last axis, and return no single number."
    )
    if not env.has_attr("compute_reward"):
        raise ValueError(f"The environment has no method compute_reward. {remedy}")
    if not buffer_kwargs.get("copy_info_dict", False):  # of infos, this can't know what is in them
        _try_compute_reward(env, achieved, desired, remedy)


def _try_compute_reward(env: VecEnv, achieved: spaces.Space, desired: spaces.Space, remedy: str) -> None:
    """As the buffer will call it, on goals of zeros."""
    shape = stored_shape(achieved)
    n_rows = next(n for n in range(2, len(shape) + 3) if n not in shape)  # so that another axis shows
    goals = [np.zeros((n_rows, *shape), dtype=goal.dtype) for goal in (achieved, desired)]
    try:
        (rewards,) = env.env_method("compute_reward", *goals, [{} for _ in range(n_rows)], indices=[0])
    except Exception as error:
        raise ValueError(f"compute_reward fails on {n_rows} rows of goals ({error!r}). {remedy}") from error
    if not isinstance(rewards, np.ndarray) or rewards.size != n_rows:
        said = f"{type(rewards).__name__} of shape {np.shape(rewards)}"
        raise ValueError(f"compute_reward returns {said} for {n_rows} rows of goals. {remedy}")
