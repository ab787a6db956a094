"""Networks that have layers in common: a state dict holds each shared tensor once."""

from typing import Any

from torch import nn


def write_each_tensor_once(module: nn.Module) -> None:
    """
    Leave repeated tensors out of a module's ``state_dict()``, such as those of an encoder that several networks share.

    Each tensor keeps its first name. ``load_state_dict()`` accepts a state with or without the repetitions.

    :param module: module that holds all of the networks
    """
    module.register_state_dict_post_hook(_leave_repetitions_out)
    module.register_load_state_dict_pre_hook(_fill_repetitions_in)


def _repetitions(module: nn.Module) -> dict[str, str]:
    """Name of a repeated parameter or buffer -> the first name of the same tensor."""
    named = [*module.named_parameters(remove_duplicate=False), *module.named_buffers(remove_duplicate=False)]
    first: dict[int, str] = {}
    for name, tensor in named:
        first.setdefault(id(tensor), name)
    return {name: first[id(tensor)] for name, tensor in named if first[id(tensor)] != name}


def _leave_repetitions_out(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    for name in _repetitions(module):
        state.pop(prefix + name, None)


def _fill_repetitions_in(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    for name, first in _repetitions(module).items():
        if prefix + first in state:
            state.setdefault(prefix + name, state[prefix + first])
