"""
Opt-in compilation and mixed precision of the parts of a gradient step that change nothing: losses and their gradients.

A part is traced once, forward and backward, into one graph of tensor operations, which TorchInductor compiles: everything
between two matrix products becomes one pass over memory, and Python leaves the step.  On the CPU the code runs without
Python's lock.  What changes something (optimisers, dual variables, targets) stays outside.

A part may have two stages, with others in between: a policy's forward pass, and its backward pass, which has to wait for the
losses' gradients.  It is traced as one graph all the same and then split, so that the second goes on from where the first
one stopped.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial, wraps
from threading import Lock
from typing import Any, TypeAlias, TypeVar

import torch as th
from torch import fx

from sb3_gac.optim.graphs import drop_unused_inputs, lift_parameters, split

Method = TypeVar("Method", bound=Callable[..., Any])
Staged: TypeAlias = Generator[Any, Any, None]
Shaper: TypeAlias = Callable[[Iterator[th.Tensor]], Any]
_OPTIONS = {"cpu": {"cpp_wrapper": True}}
_compiling = Lock()  # one thread at a time


class Program:
    """
    A pure function of tensors, compiled for the shapes of its first arguments.

    :param function: of tensors in tuples, named tuples or dicts, with values that are such; it may read parameters
    :param args: its arguments, whose values are of no importance
    :param bases: tensors that parameters are views of, at all times
    """

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...], bases: Sequence[th.Tensor]):
        graph, self._shape_result = _traced(function, args)
        self._parameters = lift_parameters(graph, bases)
        self._run = _compiled(graph, [*_tensors(args), *self._parameters])

    def __call__(self, *args: Any) -> Any:
        """The function's value at other arguments, with the parameters as they are now."""
        return self._shape_result(iter(self._run([*_tensors(args), *self._parameters])))


class StagedProgram:
    """
    A pure function in two stages, compiled for the shapes of its first arguments.

    :param function: generator function of tensors as in :class:`Program`: it yields a result, is sent a value with the
        structure and shapes of the first part of that, and yields another result
    :param args: its arguments
    :param bases: see :class:`Program`
    """

    def __init__(self, function: Callable[..., Staged], args: tuple[Any, ...], bases: Sequence[th.Tensor]):
        def both_results(args: Any, sent: Any) -> tuple[Any, Any]:
            stages = function(*args)
            return next(stages), stages.send(sent)

        result = next(function(*args))
        example = result[0]
        self._n_results, self._n_sent = len(_tensors(result)), len(_tensors(example))
        graph, self._shape_results = _traced(both_results, (args, example))
        self._shape_first = _shaper(result)
        self._parameters = lift_parameters(graph, bases)
        first, second = split(graph, self._n_results)
        inputs = self._inputs(args, _tensors(example))
        self._run_first = _compiled(first, inputs)
        results = self._run_first(inputs)
        self._run_second = _compiled(second, [*inputs, *results[self._n_results :]])

    def __call__(self, *args: Any) -> tuple[Any, Callable[[Any], Any]]:
        """The first result, and what makes the second of what is sent to it."""
        results = self._run_first(self._inputs(args))
        results, saved = results[: self._n_results], results[self._n_results :]
        first = self._shape_first(iter(results))

        def finish(sent: Any) -> Any:
            others = self._run_second([*self._inputs(args, _tensors(sent)), *saved])
            return self._shape_results(iter([*results, *others]))[1]

        return first, finish

    def _inputs(self, args: Any, sent: Sequence[th.Tensor | None] = ()) -> list[Any]:
        sent = sent or [None] * self._n_sent
        return [*_tensors(args), *sent, *self._parameters]


def _traced(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[fx.GraphModule, Shaper]:
    """
    :return: graph from the arguments' tensors to a list of the result's, and what makes the result of that
    """
    from torch.fx.experimental.proxy_tensor import make_fx  # slow to import

    shape_args, result = _shaper(args), None

    def on_tensors(*tensors: th.Tensor) -> list[th.Tensor]:
        nonlocal result
        result = function(*shape_args(iter(tensors)))
        return _tensors(result)

    graph = make_fx(on_tensors)(*_tensors(args))
    return graph, _shaper(result)


def _compiled(graph: fx.GraphModule, inputs: list[Any]) -> Callable[[list[Any]], Sequence[th.Tensor]]:
    """
    :param graph: is used up
    :param inputs: examples; those that the graph does not use may be anything
    """
    from torch._inductor import compile as compile_graph  # slow to import

    needed = drop_unused_inputs(graph)
    examples = [inputs[index] for index in needed]
    with th.no_grad():
        run = compile_graph(graph, examples, options=_OPTIONS.get(examples[0].device.type))

    def on_inputs(inputs: list[Any]) -> Sequence[th.Tensor]:
        with th.no_grad():
            return run(*[inputs[index] for index in needed])

    return on_inputs


def _tensors(value: Any) -> list[th.Tensor]:
    """Those in a structure, in its order; torch's pytree takes ten times as long."""
    if value is None or isinstance(value, th.Tensor):
        return [] if value is None else [value]
    return [tensor for part in (value.values() if isinstance(value, dict) else value) for tensor in _tensors(part)]


def _shaper(value: Any) -> Shaper:
    """
    The inverse of :func:`_tensors`.

    :param value: of the structure that is wanted
    :return: makes it of other tensors
    """
    if value is None:
        return lambda tensors: None
    if isinstance(value, th.Tensor):
        return next
    if isinstance(value, dict):
        by_key = {key: _shaper(part) for key, part in value.items()}
        return lambda tensors: {key: part(tensors) for key, part in by_key.items()}
    parts, kind = [_shaper(part) for part in value], getattr(type(value), "_make", type(value))
    return lambda tensors: kind(part(tensors) for part in parts)


def compilable(method: Method) -> Method:
    """
    Make a method run compiled on objects whose ``compile`` is true, and in bfloat16 where ``mixed_precision`` is.

    :param method: pure, of names, if any, and then tensors in tuples or dicts; its object has ``policy``, ``device``, a dict
        ``programs``, and a ``program_key`` of all else that the method depends on
    """

    @wraps(method)
    def plain(self: Any, *args: Any) -> Any:
        with _precision(self):
            return method(self, *args)

    return _dispatched(method, plain, plain, Program)


def compilable_in_stages(method: Callable[..., Staged]) -> Callable[..., tuple[Any, Callable[[Any], Any]]]:
    """
    The same for a generator method of two stages, see :class:`StagedProgram`.

    :param method: as for :func:`compilable`
    :return: gives the first result, and what makes the second of what is sent to it
    """

    def plain(self: Any, *args: Any) -> tuple[Any, Callable[[Any], Any]]:
        stages = method(self, *args)

        def send(sent: Any) -> Any:
            with _precision(self):
                return stages.send(sent)

        return send(None), send

    def in_precision(self: Any, *args: Any) -> Staged:
        first, finish = plain(self, *args)
        yield finish((yield first))

    return _dispatched(method, plain, in_precision, StagedProgram)


def _precision(algorithm: Any) -> AbstractContextManager:
    if algorithm.mixed_precision:
        return th.autocast(algorithm.device.type, th.bfloat16, cache_enabled=False)
    return nullcontext()


def _dispatched(method: Any, plain: Any, traceable: Any, kind: type[Program] | type[StagedProgram]) -> Any:
    """
    :param method: whose name and documentation this has
    :param plain: what to call without compilation
    :param traceable: what to compile
    :param kind: of program that it is compiled to
    """

    @wraps(method)
    def run(self: Any, *args: Any) -> Any:
        if not self.compile:
            return plain(self, *args)
        names = tuple(arg for arg in args if isinstance(arg, str))
        tensors = args[len(names) :]
        key = (method.__name__, *names, *self.program_key)
        if key not in self.programs:
            with _compiling:
                self.programs[key] = kind(partial(traceable, self, *names), tensors, self.policy.flat_tensors())
        return self.programs[key](*tensors)

    return run
