"""The deployment guard: predict refuses what the deployed policy does not read."""

import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.scale import Scales, entries_normalised_by, inputs_apart, scales_of


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
    #: Their scales when the model's file was written
    _saved_scales: Scales = MappingProxyType({})
    #: ``VecNormalize`` of the last training, whose statistics go on changing; ``None`` for :attr:`_saved_scales`
    _normaliser: VecNormalize | None = None

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._setup_learn(*args, **kwargs)
        now = entries_normalised_by(self.env)
        before = self.normalised_entries
        if self._n_updates and before is not None and set(now) != set(before):
            then = f"whose entries {list(before)} VecNormalize normalised" if before else "that nothing normalised"
            present = f"whose entries {list(now)} VecNormalize normalises" if now else "that nothing normalises"
            wrapped = "in VecNormalize.load(<its statistics>, env)" if before else "without VecNormalize"
            warnings.warn(
                f"The model has learned from observations {then}, and goes on with observations {present}: wrap the "
                f"environments as before, {wrapped}, or train a new model.",
                stacklevel=3,
            )
        elif self._n_updates and (found := inputs_apart(self.normalised_scales, scales_of(self.env), now)):
            warnings.warn(
                f'The model has learned from an entry "{found[0]}" that VecNormalize normalised by other statistics: what its '
                f"networks see is {found[1]:.2f} standard deviations off. Wrap the environments in VecNormalize.load(<the "
                "statistics that were saved with the model>, env), or train a new model.",
                stacklevel=3,
            )
        self.trained_normalised, self.normalised_entries = bool(now), now
        self._saved_scales, self._normaliser = {}, unwrap_vec_normalize(self.env) if self.env and now else None
        return result

    @property
    def normalised_scales(self) -> Scales:
        """Mean and standard deviation of each of :attr:`normalised_entries`, empty if files of earlier versions lack them."""
        return self._saved_scales if self._normaliser is None else scales_of(self._normaliser)

    @normalised_scales.setter
    def normalised_scales(self, scales: Scales) -> None:
        self._saved_scales, self._normaliser = scales, None

    def save(self, *args: Any, **kwargs: Any) -> None:
        """See SB3's ``save``."""
        self._saved_scales = dict(self.normalised_scales)
        super().save(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_normaliser"]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The deployed policy's action. The observation is taken as it is: a model that learned under ``VecNormalize`` needs a
        normalised one, as ``vec_normalize.normalize_obs(observation)`` or normalised environments give it.

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
