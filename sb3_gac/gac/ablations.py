"""The paper's ablations of the learner's objective (its Figure 6)."""

from collections.abc import Mapping
from typing import Any

import torch as th

from sb3_gac.base.batch import Batch, Loss, Outputs
from sb3_gac.gac.gac import GAC
from sb3_gac.math.losses import distillation_loss


class GACShare(GAC):
    """
    GAC_share: the learner climbs the guided critics (eq. 16 with Q_theta) and has no critics of its own.

    ``learner_kl_scale="auto"`` is 1 with every kind of guider, since the ablation is about the pull of that term.
    """

    def _check_arguments(self) -> None:
        super()._check_arguments()
        by_role = {name: getattr(self, name) for name in ("update_every", "lr_scales", "role_keys")} | (
            self.policy_kwargs or {}
        )
        for name, value in by_role.items():
            if isinstance(value, Mapping) and "learner_critic" in value:
                raise ValueError(
                    f'{name} names "learner_critic", which {type(self).__name__} does not have: leave it out, since the '
                    "learner has no critics of its own."
                )

    def _auto_learner_kl_weight(self) -> float:
        return 1.0

    def _policy_options(self) -> dict[str, Any]:
        return super()._policy_options() | {"learner_critics": False}


class GACWithoutQ(GACShare):
    """GAC_wo_Q: the learner imitates the guider and does nothing else (eq. 14); ``learner_kl_scale`` has no effect."""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.is_guided:
            raise ValueError("guidance would do nothing: the learner of GACWithoutQ climbs no critics. Leave guidance out.")

    def _learner_can_train_a_std(self) -> bool:
        return False

    def learner_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """The learner's loss of eq. 14: its KL from the guider, and the fit of its deployed std."""
        now = self.policy.action_distributions(guider.now.detach(), learner.now)
        kl = now.guider.detach().kl_of_means(now.learner, self.kl_reduction)
        return self._with_deployment_losses(distillation_loss(kl, batch.mask), now, batch.mask)
