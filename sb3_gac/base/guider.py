"""Actions of an algorithm's guider, for evaluations."""

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.acting import BehaviourState
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.entries import check_is_observation


class GuiderPrediction(BaseAlgorithm):
    """``predict_guider`` of an algorithm whose data are collected by a guider."""

    policy: AsymmetricPolicy

    def predict_guider(
        self,
        observation: dict[str, np.ndarray],
        state: BehaviourState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, BehaviourState]:
        """
        The guider's action, which needs the full observation. Arguments and result are those of ``predict``.

        :param observation: full observation, one or a batch
        :param state: state that the last call returned, for a recurrent guider; ``None`` at the start
        :param episode_start: booleans, true where an episode starts, shape (B,)
        :param deterministic: whether to take the distribution's mode instead of a sample
        :return: action in the environment's range, and the state for the next call
        :raises ValueError: naming the entry that is missing, does not fit its space, or whose batch size differs from the
            others'
        """
        check_is_observation(observation)
        self.policy.check_seen_by("guider", observation, "predict_guider()")
        self.policy.set_training_mode(False)
        _, vectorized = self.policy.obs_to_tensor(observation)
        scaled_action, after = self.policy.behaviour_action(observation, state, episode_start, deterministic)
        action = self.policy.unscale_action(scaled_action) if isinstance(self.action_space, spaces.Box) else scaled_action
        return (action if vectorized else action.squeeze(axis=0)), after
