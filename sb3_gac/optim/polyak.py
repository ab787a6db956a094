"""Target networks that follow their networks by Polyak averaging."""

import torch as th


def polyak_average(parameters: list[th.Tensor], targets: list[th.Tensor], tau: float) -> None:
    """
    Set every target to tau parameter + (1 - tau) target, in place, with one call for all.

    :param parameters: parameters of the network; may be empty
    :param targets: parameters of its target network, in the same order
    :param tau: Polyak coefficient, in [0, 1]
    """
    if parameters:
        with th.no_grad():
            th._foreach_lerp_(targets, parameters, tau)
