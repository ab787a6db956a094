"""Observation normalisation at deployment, where there is neither ``VecNormalize`` nor a privileged entry."""

from collections.abc import Mapping, Sequence

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gac.checks.scale import Scales
from sb3_gac.envs.spaces import PARTIAL


class DeploymentNormalizer:
    """
    Normalise the learner's entries as ``VecNormalize`` did in training: clip((x - mean) / sqrt(var + epsilon)).

    The normaliser is picklable, and independent of the environment.

    :param mean: entry -> mean, in the shape of the entry
    :param var: entry -> variance, in the shape of the entry
    :param epsilon: number that ``VecNormalize`` adds to a variance
    :param clip_obs: bound on the size of normalised values, as in ``VecNormalize``
    """

    def __init__(self, mean: Mapping[str, np.ndarray], var: Mapping[str, np.ndarray], epsilon: float, clip_obs: float):
        self.mean, self.var = dict(mean), dict(var)
        self.epsilon = epsilon
        self.clip_obs = clip_obs

    @classmethod
    def from_vec_normalize(cls, vec_normalize: VecNormalize, keys: Sequence[str] = (PARTIAL,)) -> "DeploymentNormalizer":
        """
        Make a normaliser of the statistics of ``VecNormalize``.

        :param vec_normalize: wrapper of the training environments
        :param keys: entries that the learner reads
        :return: normaliser with a copy of the wrapper's statistics; entries without statistics pass through unchanged
        :raises ValueError: if the wrapper's statistics are not those of a Dict observation
        """
        statistics: Mapping[str, RunningMeanStd] = {}
        if vec_normalize.norm_obs:
            if not isinstance(vec_normalize.obs_rms, dict):
                raise ValueError("vec_normalize must wrap environments with Dict observations.")
            statistics = {key: vec_normalize.obs_rms[key] for key in keys if key in vec_normalize.obs_rms}
        return cls(
            {key: rms.mean.copy() for key, rms in statistics.items()},
            {key: rms.var.copy() for key, rms in statistics.items()},
            vec_normalize.epsilon,
            vec_normalize.clip_obs,
        )

    @property
    def scales(self) -> Scales:
        """Mean and standard deviation of each entry that is normalised."""
        return {key: (mean, self._std(key)) for key, mean in self.mean.items()}

    def __call__(self, observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Normalise an observation.

        :param observation: entry -> raw values, single or batched; entries may be missing, and there may be others
        :return: the same observation, with the learner's entries normalised, in float32
        """
        return {key: self._normalize(key, value) if key in self.mean else value for key, value in observation.items()}

    def _std(self, key: str) -> np.ndarray:
        return np.sqrt(self.var[key] + self.epsilon)

    def _normalize(self, key: str, value: np.ndarray) -> np.ndarray:
        standardised = (value - self.mean[key]) / self._std(key)
        return np.clip(standardised, -self.clip_obs, self.clip_obs).astype(np.float32)
