"""The paper's theory on arrays, with numpy alone: guided policy iteration, related steps, and the pull between Gaussians."""

from sb3_gac.tabular.gaussian import ascent, coefficient_for, guider_optimum, pull
from sb3_gac.tabular.improvement import (
    improved_guider,
    improved_learner,
    learner_by_likelihood,
    learner_by_mpo,
    learner_by_own_critic,
    likelihood_objective,
    mpo_objective,
)
from sb3_gac.tabular.iteration import DISTILLATION, OWN_CRITIC, GuidedIterate, guided_policy_iteration, uniform_learner
from sb3_gac.tabular.pomdp import TabularPOMDP, action_values, expected_return, tiger_door, visits
from sb3_gac.tabular.values import augmented_rewards, divergence, guided_backup, guided_objective, guided_values

__all__ = [
    "DISTILLATION",
    "OWN_CRITIC",
    "GuidedIterate",
    "TabularPOMDP",
    "action_values",
    "ascent",
    "augmented_rewards",
    "coefficient_for",
    "divergence",
    "expected_return",
    "guided_backup",
    "guided_objective",
    "guided_policy_iteration",
    "guided_values",
    "guider_optimum",
    "improved_guider",
    "improved_learner",
    "learner_by_likelihood",
    "learner_by_mpo",
    "learner_by_own_critic",
    "likelihood_objective",
    "mpo_objective",
    "pull",
    "tiger_door",
    "uniform_learner",
    "visits",
]
