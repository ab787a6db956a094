"""What a replay buffer gets of vectorised environments: raw observations where these can be normalised anew."""

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
#: Wrappers that hand on observations as they are
OBSERVERS = (VecMonitor, VecVideoRecorder, VecCheckNan)


class RewardNormalizer:
    """
    A ``VecNormalize`` for observations that were stored as they were seen, that is, normalised: rewards alone are left to do.

    :param normalizer: whose rewards these are
    """

    def __init__(self, normalizer: VecNormalize):
        self._normalizer = normalizer

    def normalize_obs(self, obs: Any) -> Any:
        """
        :param obs: as they were seen
        :return: the same
        """
        return obs

    def normalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """
        :param reward: raw
        :return: normalised with the newest statistics
        """
        return self._normalizer.normalize_reward(reward)


class ReplaySource:
    """
    Under ``VecNormalize`` a buffer holds raw observations, which are normalised with the newest statistics when they are
    sampled. Wrappers further out decide whether that can be: images that are transposed out there are transposed here as
    well; where another wrapper changes observations (``VecFrameStack``, or one that nothing is known of), what the networks
    see is stored as they see it. Rewards are raw in any case: where such a wrapper changes them, VecNormalize must not.

    :param env: vectorised environments, as the networks see them
    """

    def __init__(self, env: VecEnv):
        self.env = env
        self.normalizer = unwrap_vec_normalize(env)
        outside = [] if self.normalizer is None else _wrappers_outside(env, self.normalizer)
        changing = [wrapper for wrapper in outside if type(wrapper) not in OBSERVERS]
        self._transposers = [wrapper for wrapper in reversed(changing) if type(wrapper) is VecTransposeImage]
        #: The wrapper because of which observations are stored as they are seen, ``None`` if there is none
        self.in_the_way = next((wrapper for wrapper in changing if type(wrapper) is not VecTransposeImage), None)

        self._entries = entries_in(env.observation_space)

    @property
    def is_raw(self) -> bool:
        """Whether what is stored is still to be normalised."""
        return self.normalizer is not None and self.in_the_way is None

    @property
    def sampling_env(self) -> Any:
        """What is to be passed to ``ReplayBuffer.sample``: normalises what is stored raw."""
        if self.normalizer is None or self.is_raw:
            return self.normalizer
        return RewardNormalizer(self.normalizer)

    def observation(self, seen: Mapping[str, np.ndarray]) -> Entries:
        """
        :param seen: what the environments have just returned, (n_envs, ...) of each entry
        :return: what is to be stored of it; no later step changes these arrays
        :raises InvalidStepError: if a wrapper outside ``VecNormalize`` made something of it that can't be stored
        """
        if self.in_the_way is not None:
            check_observation(seen, self._entries)  # as the guard does beneath
        if not self.is_raw:
            return {key: np.array(values) for key, values in seen.items()}
        assert self.normalizer is not None
        return self._transposed(self.normalizer.get_original_obs())

    def final(self, info: Mapping[str, Any]) -> Mapping[str, np.ndarray]:
        """
        :param info: of an environment whose episode has just ended
        :return: what is to be stored of that episode's last observation
        :raises InvalidStepError: if a wrapper ended the episode and did not say what it was
        """
        # VecNormalize's own, normalised and then undone, would be clipped and rounded
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
        :param seen: what the environments have just returned, shape (n_envs,)
        :return: raw
        :raises ValueError: if a wrapper changed rewards after they were normalised
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
    """Outermost first."""
    found = []
    while env is not normalizer:
        found.append(env)
        env = env.venv
    return found
