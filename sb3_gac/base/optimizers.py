"""Optimisers of networks by role: each network has its own, and one of them trains a parameter that several networks hold."""

from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_gac.base.acting import ActingPolicy
from sb3_gac.base.roles import MEMORY, resolve_lr_scales
from sb3_gac.optim.trained import TrainedParameters


class OptimizedPolicy(ActingPolicy):
    """Acting policies whose networks are trained; a subclass builds the networks and then the optimisers."""

    constructor_options: dict[str, Any]

    def unclipped(self, role: str) -> int:
        """
        Number of a network's last parameters whose gradients are left out of its gradient's norm and of clipping.

        :param role: role of the network
        :return: number of parameter tensors
        """
        return 0

    def _build_optimizers(self, lr_schedule: Schedule) -> None:
        """Give each network its optimiser, as the attribute ``optimizer``, which actor and critic of SB3's SAC have."""
        optimizer_class, kwargs = self.optimizer_class, dict(self.optimizer_kwargs)
        if optimizer_class in (th.optim.Adam, th.optim.AdamW) and "foreach" not in kwargs:
            kwargs.setdefault("fused", True)
        lr_scales = resolve_lr_scales(self.roles, self.constructor_options["lr_scales"])
        self.trained: dict[str, TrainedParameters] = {}
        there = [role for role in self.roles.all if getattr(self, role) is not None]
        owners: dict[int, str] = {}
        for role in sorted(there, key=lambda role: role not in self.roles.parts):  # parts are first
            for parameter in getattr(self, role).parameters():
                owners.setdefault(id(parameter), role)
        for role in there:
            network = getattr(self, role)
            own = [parameter for parameter in network.parameters() if owners[id(parameter)] == role]
            group = {"params": own, "lr_scale": lr_scales[role]}
            try:
                network.optimizer = optimizer_class([group], lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]
            except (TypeError, ValueError) as error:
                given = f"optimizer_kwargs={self.optimizer_kwargs}"
                raise ValueError(
                    f"{given} does not fit {getattr(optimizer_class, '__name__', optimizer_class)}: {error}"
                ) from error
            self.trained[role] = TrainedParameters(own, network.optimizer, self.unclipped(role), self._memory_of(role))
            self.trained[role].scale_memory(lr_scales[MEMORY])

    def _memory_of(self, role: str) -> list[nn.Parameter]:
        """Parameters of a network's memory; none for a network without one."""
        memory = getattr(getattr(self, role), "memory", None)
        return [] if memory is None else list(memory.parameters())

    def refresh_parameters(self, compiled: bool | None = None) -> None:
        """
        Take note of which parameters are frozen by now, before training and before saving, see :class:`TrainedParameters`.

        :param compiled: whether the gradient steps to come are compiled; ``None`` if none follow
        """
        for parameters in self.trained.values():
            parameters.refresh(compiled)

    @property
    def optimizer_options(self) -> tuple[Any, ...]:
        """All that a step of the optimisers depends on except learning rates: frozen parameters and options."""
        groups = [getattr(self, role).optimizer.param_groups[0] for role in self.trained]
        return tuple(
            value if not isinstance(value, list) else tuple(value)
            for group in groups
            for name, value in group.items()
            if name not in ("params", "lr", "initial_lr", "lr_scale", "memory_lr_scale")
        )

    def freeze_as_saved(self) -> None:
        """Freeze and unfreeze parameters as they were when a file's states of the optimisers were saved."""
        for parameters in self.trained.values():
            parameters.freeze_as_saved()

    def scale_learning_rates(self, lr_scales: Mapping[str, float] | None) -> None:
        """
        Change the multiples of the learning rate.

        :param lr_scales: network -> multiple of the learning rate, in place of all former multiples; ``None`` for 1 each
        :raises ValueError: naming a multiple that can't be; all multiples are then what they were before
        """
        scales = resolve_lr_scales(self.roles, lr_scales)
        for trained in self.trained.values():
            trained.check_memory_scale(scales[MEMORY])
        self.constructor_options["lr_scales"] = lr_scales
        for role, trained in self.trained.items():
            trained.optimizer.param_groups[0]["lr_scale"] = scales[role]
            trained.scale_memory(scales[MEMORY])
