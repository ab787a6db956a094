"""
Opt-in compilation: a whole update becomes one graph of tensor operations.

``torch.compile`` traces losses, their gradients, clipping and Adam's steps together: all operations between two matrix
products become one pass over memory, and no Python code runs within a step.
"""

import os
import shutil
import sys
import sysconfig
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from types import FunctionType
from typing import Any

import torch as th

#: Number of gradient steps from which compilation saves more than the half minute that it takes
PAYS_FROM = 10_000
_OPTIONS = {"cpu": {"cpp_wrapper": True}}
_compiling = Lock()  # held while the compiler works, see is_compiling()


class CannotCompileError(ValueError):
    """
    Compilation was asked for, but is impossible here.

    :param why: reason, as a sentence whose subject "compile=True" is left out
    :param remedy: advice to the user, an imperative
    """

    def __init__(self, why: str, remedy: str):
        super().__init__(f"compile=True {why}: {remedy}.")
        self.why = why


def check_can_compile() -> None:
    """
    Check whether this version of torch can compile gradient steps.

    :raises CannotCompileError: if the version is too old
    """
    import torch._dynamo.config  # slow to import

    if not hasattr(torch._dynamo.config, "trace_autograd_ops") or not hasattr(th.compiler, "skip_all_guards_unsafe"):
        raise CannotCompileError(f"needs torch 2.13 or later, not {th.__version__}", "update torch, or leave compile False")


def missing_compiler(device: th.device) -> str | None:
    """
    The first thing that ``torch.compile`` needs for a device and would not find. The check runs no program and does not
    import torch's compiler.

    :param device: device that the programs are to run on
    :return: name of the missing compiler or file, ``None`` if nothing is missing
    """
    if device.type == "cuda":
        if find_spec("triton") is None:
            return "Triton"
        compilers, name = [os.environ["CC"]] if "CC" in os.environ else ["gcc", "clang", "cc"], "C compiler"
    elif device.type == "cpu":
        default = {"darwin": "clang++", "win32": "cl"}.get(sys.platform, "g++")
        compilers, name = [os.environ.get("CXX", default)], "C++ compiler"
    else:
        return f"compiler for {device.type}"
    if not any(map(shutil.which, compilers)):
        return f"{name} ({' or '.join(compilers)})"
    if not (Path(sysconfig.get_path("include")) / "Python.h").exists():
        return "Python.h, which comes with Python's development files"
    return None


def is_compiling() -> bool:
    """Whether a program is being compiled in any thread, so that processes of a C++ compiler may be at work."""
    return _compiling.locked()


class Program:
    """
    A function of tensors, compiled at its first call.

    Later calls check no guards: the caller keeps one program for each combination of the things that the function depends on,
    shapes included. Tensors that the function reads from attributes (parameters, coefficients) are looked up at each call;
    numbers that the function reads from attributes are constants of the program.

    :param function: function whose arguments and value are tensors, or tuples, named tuples, lists or dicts of tensors
    :param device: device that the function runs on
    :param when_it_fails: callback that gets the error if compiling fails; the function then runs uncompiled, in this call and
        in later ones. ``None`` raises the error
    """

    def __init__(
        self,
        function: Callable[..., Any],
        device: th.device,
        when_it_fails: Callable[[Exception], None] | None = None,
    ):
        self._function, self._when_it_fails = function, when_it_fails
        options: dict[str, Any] = {
            **_OPTIONS.get(device.type, {}),
            "fallback_random": True,  # draws the same random numbers as the plain function
            "guard_filter_fn": th.compiler.skip_all_guards_unsafe,
        }
        with _compiling:  # th.compile begins to import the compiler
            self._run = th.compile(_with_own_code(function), fullgraph=True, dynamic=False, options=options)
        self._is_ready = False

    def __call__(self, *args: Any) -> Any:
        """The function's value, with the present values of all tensors that it reads."""
        if self._is_ready:
            return self._run(*args)
        with _compiling:
            import torch._dynamo.config
            from torch._dynamo.exc import TorchDynamoException

            try:
                with torch._dynamo.config.patch(trace_autograd_ops=True):
                    result = self._run(*args)
            except TorchDynamoException as error:  # nothing has run yet
                if self._when_it_fails is None:
                    raise
                self._when_it_fails(error)
                self._run = self._function
                result = self._run(*args)
        self._is_ready = True
        return result


def _with_own_code(function: Callable[..., Any]) -> FunctionType:
    """The function with a code object of its own, since ``torch.compile`` keeps its results by code object."""

    def run(*args: Any) -> Any:
        return function(*args)

    return FunctionType(run.__code__.replace(), run.__globals__, run.__name__, None, run.__closure__)
