"""Targets that follow their networks."""

import torch as th


def polyak_average(parameters: list[th.Tensor], targets: list[th.Tensor], tau: float) -> None:
    """
    target <- tau parameter + (1 - tau) target, in place, one call for all.

    :param parameters: of the network, or none
    :param targets: of its target, in the same order
    :param tau: in [0, 1]
    """
    if parameters:
        with th.no_grad():
            th._foreach_lerp_(targets, parameters, tau)
