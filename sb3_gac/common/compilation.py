"""
Opt-in compilation and mixed precision of the parts of a gradient step that change nothing: losses and their gradients.

A part is traced once, forward and backward, into one graph of tensor operations, which TorchInductor compiles: everything
between two matrix products becomes one pass over memory, and Python leaves the step.  On the CPU the code runs without
Python's lock.  What changes something (optimisers, dual variables, targets) stays outside.
"""

from collections.abc import Callable, Iterator
from functools import partial, wraps
from threading import Lock
from typing import Any, TypeVar

import torch as th

Method = TypeVar("Method", bound=Callable[..., Any])
_OPTIONS = {"cpu": {"cpp_wrapper": True}}
_compiling = Lock()  # one thread at a time


class Program:
    """
    A pure function of tensors, compiled for the shapes of its first arguments.

    :param function: of tensors in tuples, named tuples or dicts, with values that are such; it may read parameters
    :param args: its arguments, whose values are of no importance
    :param device_type: that all are on
    """

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...], device_type: str):
        from torch._inductor import compile as compile_graph  # slow to import
        from torch.fx.experimental.proxy_tensor import make_fx

        tensors, shape_args = _tensors(args), _shaper(args)

        def on_tensors(*tensors: th.Tensor) -> list[th.Tensor]:
            result = function(*shape_args(iter(tensors)))
            self._shape_result = _shaper(result)
            return _tensors(result)

        graph = make_fx(on_tensors)(*tensors)
        self._parameters = _lift_parameters(graph)
        with th.no_grad():
            self._run = compile_graph(graph, [*tensors, *self._parameters], options=_OPTIONS.get(device_type))

    def __call__(self, *args: Any) -> Any:
        """The function's value at other arguments, with the parameters as they are now."""
        with th.no_grad():
            results = self._run(*_tensors(args), *self._parameters)
        return self._shape_result(iter(results))


def _tensors(value: Any) -> list[th.Tensor]:
    """Those in a structure, in its order; torch's pytree takes ten times as long."""
    if value is None or isinstance(value, th.Tensor):
        return [] if value is None else [value]
    return [tensor for part in (value.values() if isinstance(value, dict) else value) for tensor in _tensors(part)]


def _shaper(value: Any) -> Callable[[Iterator[th.Tensor]], Any]:
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


def _lift_parameters(graph: th.fx.GraphModule) -> list[th.Tensor]:
    """Tensors that the function read without being given them become the graph's last inputs."""
    lifted: list[th.Tensor] = []
    last_input = [node for node in graph.graph.nodes if node.op == "placeholder"][-1]
    for node in [node for node in graph.graph.nodes if node.op == "get_attr"]:
        lifted.append(getattr(graph, node.target))
        with graph.graph.inserting_after(last_input):
            last_input = graph.graph.placeholder(f"lifted_{len(lifted)}")
        node.replace_all_uses_with(last_input)
        graph.graph.erase_node(node)
    for node in graph.graph.nodes:
        node.meta.clear()  # of the tracing, which the compiler does again in its own way
    graph.recompile()
    return lifted


def compilable(method: Method) -> Method:
    """
    Make a method run compiled on objects whose ``compile`` is true, and in bfloat16 where ``mixed_precision`` is.

    :param method: pure, of names, if any, and then tensors in tuples or dicts; its object has ``device``, a dict
        ``programs``, and a ``program_key`` of all else that the method depends on
    """

    @wraps(method)
    def in_precision(self: Any, *args: Any) -> Any:
        if not self.mixed_precision:
            return method(self, *args)
        with th.autocast(self.device.type, th.bfloat16, cache_enabled=False):
            return method(self, *args)

    @wraps(method)
    def run(self: Any, *args: Any) -> Any:
        if not self.compile:
            return in_precision(self, *args)
        names = tuple(arg for arg in args if isinstance(arg, str))
        tensors = args[len(names) :]
        key = (method.__name__, *names, *self.program_key)
        if key not in self.programs:
            with _compiling:
                self.programs[key] = Program(partial(in_precision, self, *names), tensors, self.device.type)
        return self.programs[key](*tensors)

    return run  # type: ignore[return-value]
