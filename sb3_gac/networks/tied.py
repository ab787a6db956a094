"""Networks that have layers in common: what they hold together is written down once."""

from typing import Any

from torch import nn


def write_each_tensor_once(module: nn.Module) -> None:
    """
    Leave out of ``state_dict()`` what is there already under an earlier name, as an encoder that several networks share.

    ``load_state_dict()`` takes it with and without these repetitions.

    :param module: with all of its networks
    """
    module.register_state_dict_post_hook(_leave_repetitions_out)
    module.register_load_state_dict_pre_hook(_fill_repetitions_in)


def _repetitions(module: nn.Module) -> dict[str, str]:
    """Name of a parameter or buffer -> the first name of the same one."""
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
