"""
Opt-in compilation: a whole update, or each of its branches, becomes one graph of tensor operations.

``torch.compile`` traces losses, their gradients, clipping and Adam's steps together: everything between two matrix products
becomes one pass over memory, and Python leaves the step.  On the CPU the code runs without Python's lock.
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

#: As many gradient steps, compiled, save more than the half minute that compiling takes
PAYS_FROM = 10_000
_OPTIONS = {"cpu": {"cpp_wrapper": True}}
_compiling = Lock()  # one thread at a time


class CannotCompileError(ValueError):
    """
    ``compile=True`` where it can't be.

    :param why: what compilation can't do, or needs, a sentence without its subject
    :param remedy: what to do about it
    """

    def __init__(self, why: str, remedy: str):
        super().__init__(f"compile=True {why}: {remedy}.")
        self.why = why


def check_can_compile() -> None:
    """
    :raises CannotCompileError: if this version of torch can't
    """
    import torch._dynamo.config  # slow to import

    if not hasattr(torch._dynamo.config, "trace_autograd_ops") or not hasattr(th.compiler, "skip_all_guards_unsafe"):
        raise CannotCompileError(f"needs torch 2.13 or later, and this is {th.__version__}", "update it, or leave it False")


def missing_compiler(device: th.device) -> str | None:
    """
    What ``torch.compile`` would look for on a device and not find; nothing is run, and torch's compiler is not imported.

    :param device: that programs are to run on
    :return: what is missing, or ``None`` if all is there
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
    """Whether a program is being compiled, in any thread: processes of a C++ compiler may be at work."""
    return _compiling.locked()


class Program:
    """
    A function of tensors, compiled at its first call.

    No guards are checked at later calls: whoever calls it keeps one program for each combination of all that it depends on,
    shapes included. Tensors that the function finds by attributes (parameters, coefficients) are looked up at each call;
    numbers that it finds so are part of the program.

    :param function: of tensors in tuples, named tuples, lists or dicts, with values that are such
    :param device: that it runs on
    :param when_it_fails: is told why if compiling fails, and the function runs as it is, then and later; ``None`` for an error
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
            "fallback_random": True,  # the random numbers of the plain function
            "guard_filter_fn": th.compiler.skip_all_guards_unsafe,
        }
        with _compiling:  # which it begins to import
            self._run = th.compile(_with_own_code(function), fullgraph=True, dynamic=False, options=options)
        self._is_ready = False

    def __call__(self, *args: Any) -> Any:
        """The function's value, with parameters as they are now."""
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
    """``torch.compile`` keeps its results by code object: those of two programs must not be mixed up."""

    def run(*args: Any) -> Any:
        return function(*args)

    return FunctionType(run.__code__.replace(), run.__globals__, run.__name__, None, run.__closure__)
