"""
Opt-in compilation: a whole update becomes one graph of tensor operations.

``torch.compile`` traces losses, their gradients, clipping and Adam's steps together: all operations between two matrix
products become one pass over memory, and no Python code runs within a step.
"""

import os
import shutil
import sys
import sysconfig
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from types import FunctionType
from typing import Any

import torch as th

#: Number of gradient steps from which compilation saves more than the half minute that it takes
PAYS_FROM = 10_000
#: Number of programs of one function, for different settings, after which a warning is given
MANY_PROGRAMS = 3
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


class Programs(dict[tuple[Any, ...], Program]):
    """
    Programs of functions, one for each combination of all that a function depends on: (name, settings, variant, layout).

    :param setting_names: names of those settings that a user may change, for a warning where they keep changing
    """

    def __init__(self, setting_names: Sequence[str]):
        super().__init__()
        self.setting_names = setting_names
        #: Present values of what all functions depend on, beside their arguments
        self.settings: tuple[Any, ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy has no programs: those of the original read, and train, the original's networks."""
        return type(self), (self.setting_names,)

    def run(
        self,
        function: Callable[..., Any],
        *args: Any,
        device: th.device,
        variant: Hashable = None,
        when_it_fails: Callable[[Exception], None] | None = None,
    ) -> Any:
        """
        Call a function by its program, which is compiled first if there is none.

        :param function: function of tensors, see :class:`Program`, that has a name of its own
        :param args: arguments of the function
        :param device: device that the function runs on
        :param variant: what this function depends on, beside its arguments and :attr:`settings`
        :param when_it_fails: callback that gets the error if compiling fails, see :class:`Program`; ``None`` raises the error
        :return: value of the function
        """
        key = (function.__name__, self.settings, variant, tuple(_layout(args)))
        if key not in self:
            self._warn_of_many(function.__name__)
            self[key] = Program(function, device, when_it_fails)
        return self[key](*args)

    def _warn_of_many(self, name: str) -> None:
        """
        Warn when settings keep changing.

        :param name: name of the function that is about to be compiled once more
        """
        compiled_for = {settings for function, settings, *_ in self if function == name}
        if len(compiled_for) == MANY_PROGRAMS and self.settings not in compiled_for:
            warnings.warn(
                f"Gradient steps are compiled for the {MANY_PROGRAMS + 1}th time, since the number of threads has changed, or "
                f"one of {', '.join(self.setting_names)}. Each new value takes half a minute: keep to a few values, or "
                "set compile=False.",
                stacklevel=2,
            )


def _layout(value: Any) -> Iterator[Any]:
    """Shapes and types of the tensors in tuples, lists and dicts."""
    if isinstance(value, th.Tensor):
        yield value.shape, value.dtype
    elif isinstance(value, dict):
        for key, part in value.items():
            yield key
            yield from _layout(part)
    elif value is not None:
        for part in value:
            yield from _layout(part)


def _with_own_code(function: Callable[..., Any]) -> FunctionType:
    """The function with a code object of its own, since ``torch.compile`` keeps its results by code object."""

    def run(*args: Any) -> Any:
        return function(*args)

    return FunctionType(run.__code__.replace(), run.__globals__, run.__name__, None, run.__closure__)
