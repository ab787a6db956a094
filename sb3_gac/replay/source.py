"""The source of a replay buffer's data: raw observations of vectorised environments, where these can be normalised later."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
    unwrap_vec_normalize,
)

from sb3_gac.checks.environments import FINAL, RAW_FINAL
from sb3_gac.checks.observations import InvalidStepError, check_observation, entries_in

Entries = dict[str, np.ndarray]
#: Wrappers that do not change observations
OBSERVERS = (VecMonitor, VecVideoRecorder, VecCheckNan)


class RewardNormalizer:
    """
    A ``VecNormalize`` that normalises rewards alone, for observations that were stored in normalised form.

    :param normalizer: ``VecNormalize`` with the statistics of the rewards
    """

    def __init__(self, normalizer: VecNormalize):
        self._normalizer = normalizer

    def normalize_obs(self, obs: Any) -> Any:
        """
        :param obs: observations in normalised form
        :return: the same observations
        """
        return obs

    def normalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """
        :param reward: raw rewards
        :return: rewards normalised with the newest statistics, of the same shape
        """
        return self._normalizer.normalize_reward(reward)


class ReplaySource:
    """
    The source of observations and rewards for a replay buffer.

    With ``VecNormalize`` a buffer holds raw observations, which are normalised with the newest statistics when they are
    sampled. Wrappers outside of ``VecNormalize`` decide whether raw observations can be stored. Where a wrapper transposes
    images, the raw images are transposed here as well. Where another wrapper changes observations (``VecFrameStack``, or an
    unknown wrapper), observations are stored as the networks see them. Rewards are always stored raw: where such a wrapper
    changes them, ``VecNormalize`` must not normalise them.

    :param env: vectorised environments that return what the networks see
    """

    def __init__(self, env: VecEnv):
        self.env = env
        self.normalizer = unwrap_vec_normalize(env)
        outside = [] if self.normalizer is None else _wrappers_outside(env, self.normalizer)
        changing = [wrapper for wrapper in outside if type(wrapper) not in OBSERVERS]
        self._transposers = [wrapper for wrapper in reversed(changing) if type(wrapper) is VecTransposeImage]
        #: Wrapper that prevents raw observations from being stored, ``None`` if there is none
        self.in_the_way = next((wrapper for wrapper in changing if type(wrapper) is not VecTransposeImage), None)

        self._entries = entries_in(env.observation_space)

    @property
    def is_raw(self) -> bool:
        """Whether stored observations are raw, and are to be normalised when they are sampled."""
        return self.normalizer is not None and self.in_the_way is None

    @property
    def sampling_env(self) -> Any:
        """The normaliser of samples, to pass to ``ReplayBuffer.sample``; ``None`` without ``VecNormalize``."""
        if self.normalizer is None or self.is_raw:
            return self.normalizer
        return RewardNormalizer(self.normalizer)

    def observation(self, seen: Mapping[str, np.ndarray]) -> Entries:
        """
        The observations to store.

        :param seen: observations that the environments have just returned, (n_envs, ...) of each entry
        :return: observations to store, (n_envs, ...) of each entry, in arrays that no later step changes
        :raises InvalidStepError: if a wrapper outside of ``VecNormalize`` returned an observation that can't be stored
        """
        if self.in_the_way is not None:
            check_observation(seen, self._entries)  # as the guard does for the environments inside
        if not self.is_raw:
            return {key: np.array(values) for key, values in seen.items()}
        assert self.normalizer is not None
        return self._transposed(self.normalizer.get_original_obs())

    def final(self, info: Mapping[str, Any]) -> Mapping[str, np.ndarray]:
        """
        The final observation to store.

        :param info: info of an environment whose episode has just ended
        :return: final observation of the episode, in the form in which observations are stored
        :raises InvalidStepError: if a wrapper ended the episode and left the final observation out of ``info``
        """
        # Undoing VecNormalize's normalisation would leave the final observation clipped and rounded
        if self.is_raw:
            return self._transposed(info[RAW_FINAL])
        if FINAL not in info:
            raise InvalidStepError(
                f'{type(self.in_the_way).__name__} ended an episode, but its info has no "{FINAL}"; the step was not stored. '
                f'Put the episode\'s last observation into infos[i]["{FINAL}"] before the environment is reset.'
            )
        return info[FINAL]

    def reward(self, seen: np.ndarray) -> np.ndarray:
        """
        The rewards to store.

        :param seen: rewards that the environments have just returned, shape (n_envs,)
        :return: raw rewards, shape (n_envs,)
        :raises ValueError: if a wrapper changed rewards after ``VecNormalize`` normalised them
        """
        if self.normalizer is None:
            return seen
        raw = self.normalizer.get_original_reward()
        if self.in_the_way is None or np.array_equal(seen, self.normalizer.normalize_reward(raw)):
            return raw
        if not self.normalizer.norm_reward:
            return seen
        name = type(self.in_the_way).__name__
        raise ValueError(
            f"{name} stands outside VecNormalize and changes rewards that were normalised, so that there are no raw ones to "
            f"store: make it VecNormalize({name}(env)), or VecNormalize(..., norm_reward=False)."
        )

    def _transposed(self, observation: Any) -> Any:
        for wrapper in self._transposers:
            observation = wrapper.transpose_observations(observation)
        return observation


def _wrappers_outside(env: Any, normalizer: VecNormalize) -> list[VecEnvWrapper]:
    """The wrappers outside of ``VecNormalize``, the outermost first."""
    found = []
    while env is not normalizer:
        found.append(env)
        env = env.venv
    return found
