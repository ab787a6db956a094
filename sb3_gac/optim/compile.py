"""
Opt-in compilation: a whole update, or each of its branches, becomes one graph of tensor operations.

``torch.compile`` traces losses, their gradients, clipping and Adam's steps together: everything between two matrix products
becomes one pass over memory, and Python leaves the step.  On the CPU the code runs without Python's lock.
"""

from collections.abc import Callable
from threading import Lock
from types import FunctionType
from typing import Any

import torch as th

_OPTIONS = {"cpu": {"cpp_wrapper": True}}
_compiling = Lock()  # one thread at a time


def check_can_compile() -> None:
    """
    :raises ValueError: if this version of torch can't
    """
    import torch._dynamo.config  # slow to import

    if not hasattr(torch._dynamo.config, "trace_autograd_ops") or not hasattr(th.compiler, "skip_all_guards_unsafe"):
        raise ValueError(
            f"compile=True needs torch 2.13 or later, and this is {th.__version__}: update it, or leave it False."
        )


class Program:
    """
    A function of tensors, compiled at its first call.

    No guards are checked at later calls: whoever calls it keeps one program for each combination of all that it depends on,
    shapes included. Tensors that the function finds by attributes (parameters, coefficients) are looked up at each call;
    numbers that it finds so are part of the program.

    :param function: of tensors in tuples, named tuples, lists or dicts, with values that are such
    :param device: that it runs on
    """

    def __init__(self, function: Callable[..., Any], device: th.device):
        options: dict[str, Any] = {
            **_OPTIONS.get(device.type, {}),
            "fallback_random": True,  # the random numbers of the plain function
            "guard_filter_fn": th.compiler.skip_all_guards_unsafe,
        }
        self._run = th.compile(_with_own_code(function), fullgraph=True, dynamic=False, options=options)
        self._is_compiled = False

    def __call__(self, *args: Any) -> Any:
        """The function's value, with parameters as they are now."""
        if self._is_compiled:
            return self._run(*args)
        import torch._dynamo.config

        with _compiling, torch._dynamo.config.patch(trace_autograd_ops=True):
            result = self._run(*args)
        self._is_compiled = True
        return result


def _with_own_code(function: Callable[..., Any]) -> FunctionType:
    """``torch.compile`` keeps its results by code object: those of two programs must not be mixed up."""

    def run(*args: Any) -> Any:
        return function(*args)

    return FunctionType(run.__code__.replace(), run.__globals__, run.__name__, None, run.__closure__)
