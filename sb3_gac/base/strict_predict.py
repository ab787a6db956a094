"""The deployment guard: predict refuses what the deployed policy does not read."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.scale import entries_normalised_by


class DeploymentGuard(BaseAlgorithm):
    """
    ``predict`` of an algorithm whose deployed policy reads only some of the observation's entries.

    By default ``predict`` ignores all other entries, so that evaluations may pass it full observations.  With
    ``strict_deployment`` it refuses them::

        model = GAC.load("cheetah", strict_deployment=True)

    The attribute may be set at any time and is saved with the model.  Evaluations during training pass full observations, so
    set the attribute after training.
    """

    policy: AsymmetricPolicy
    strict_deployment: bool = False
    #: Whether the model learned from observations that ``VecNormalize`` normalised, whose statistics deployment then needs
    trained_normalised: bool = False
    #: The entries of those observations that it normalised; ``None`` if that is not known, in files of earlier versions
    normalised_entries: tuple[str, ...] | None = None

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._setup_learn(*args, **kwargs)
        now = entries_normalised_by(self.env)
        before = self.normalised_entries
        if self._n_updates and before is not None and set(now) != set(before):
            warnings.warn(
                f"The model has learned from observations whose entries {list(before)} VecNormalize normalised, and goes on "
                f"with observations whose entries {list(now)} it normalises: wrap the environments as before, with "
                "VecNormalize.load(<its statistics>, env), or train a new model.",
                stacklevel=3,
            )
        self.trained_normalised, self.normalised_entries = bool(now), now
        return result

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The deployed policy's action.

        :param observation: one observation or a batch: a dict, or the array of the one entry that the policy reads
        :param state: state that the last call returned, for a recurrent policy; ``None`` at the start
        :param episode_start: booleans, true where an episode starts, shape (B,)
        :param deterministic: whether to take the distribution's mode instead of a sample
        :return: action in the environment's range, and the state for the next call
        :raises ValueError: if an entry is missing, or, with ``strict_deployment``, if there is one that the policy does not
            read
        """
        if self.strict_deployment and isinstance(observation, Mapping):
            self._refuse_unread(observation)
        return super().predict(observation, state, episode_start, deterministic)

    def _refuse_unread(self, observation: Mapping[str, np.ndarray]) -> None:
        reads = self.policy.deployed.observation_space.spaces  # type: ignore[attr-defined]
        unread = [key for key in observation if key not in reads]
        if unread:
            raise ValueError(
                f"strict_deployment=True: the policy reads {list(reads)}, but the observation passed to predict() also has "
                f"{unread}. Nothing else belongs where the policy is deployed: leave them out."
            )
