"""Surgery on traced graphs of tensor operations: parameters become inputs, and one graph becomes two."""

from collections.abc import Sequence
from typing import Any

import torch as th
from torch import fx


def lift_parameters(graph: fx.GraphModule, bases: Sequence[th.Tensor]) -> list[th.Tensor]:
    """
    Make the tensors that a function read without being given them the graph's last inputs.

    :param graph: changed in place
    :param bases: tensors in place of which views of them are lifted: an input costs more than a view
    :return: those inputs
    """
    inputs: dict[int, tuple[th.Tensor, fx.Node]] = {}
    last_input = [node for node in graph.graph.nodes if node.op == "placeholder"][-1]
    for node in [node for node in graph.graph.nodes if node.op == "get_attr"]:
        tensor = getattr(graph, node.target)
        base = next((base for base in bases if _shares_memory(tensor, base)), tensor)
        if id(base) not in inputs:
            with graph.graph.inserting_after(last_input):
                last_input = graph.graph.placeholder(f"lifted_{len(inputs)}")
            inputs[id(base)] = base, last_input
        value = inputs[id(base)][1]
        if base is not tensor:
            with graph.graph.inserting_before(node):
                shape = (list(tensor.shape), list(tensor.stride()), tensor.storage_offset())
                value = graph.graph.call_function(th.ops.aten.as_strided.default, (value, *shape))
        node.replace_all_uses_with(value)
        graph.graph.erase_node(node)
    for node in graph.graph.nodes:
        node.meta.clear()  # of the tracing, which the compiler does again in its own way
    graph.recompile()
    return [tensor for tensor, _ in inputs.values()]


def _shares_memory(tensor: th.Tensor, base: th.Tensor) -> bool:
    return tensor.untyped_storage().data_ptr() == base.untyped_storage().data_ptr()


def split(graph: fx.GraphModule, n_first: int) -> tuple[fx.GraphModule, fx.GraphModule]:
    """
    Two graphs that do what one does: the first computes its first results, and nothing else, the second the others.

    :param graph: of P inputs
    :param n_first: number of the first results
    :return: graph of the P inputs, with those results and S tensors that the second one needs; graph of P + S inputs, with
        the other results.  Views are made again and not kept.
    """
    nodes = list(graph.graph.nodes)
    results = nodes[-1].args[0]
    inputs = [node for node in nodes if node.op == "placeholder"]
    first = _ancestors(results[:n_first]) | set(inputs)
    second = _ancestors(results[n_first:]) - first
    kept: dict[fx.Node, None] = dict.fromkeys(node for node in results[n_first:] if node in first)  # in order
    views: set[fx.Node] = set()
    _sort_out([node for node in nodes if node in second], first, kept, views)
    saved = [node for node in kept if node not in inputs]
    return (
        _subgraph(graph, inputs, [node for node in nodes if node in first], [*results[:n_first], *saved]),
        _subgraph(graph, [*inputs, *saved], [node for node in nodes if node in views | second], results[n_first:]),
    )


def _sort_out(nodes: list[fx.Node], first: set[fx.Node], kept: dict[fx.Node, None], views: set[fx.Node]) -> None:
    """Which of the first graph's nodes are needed by others: to be kept, or to be made again, being views."""
    for node in nodes:
        for source in node.all_input_nodes:
            if source not in first or source in kept or source in views:
                continue
            if _is_view(source):
                views.add(source)
                _sort_out([source], first, kept, views)
            else:
                kept[source] = None


def _is_view(node: fx.Node) -> bool:
    if node.op != "call_function" or not isinstance(node.target, th._ops.OpOverload):
        return False
    returns: Any = node.target._schema.returns
    return len(returns) > 0 and all(value.alias_info is not None and not value.alias_info.is_write for value in returns)


def _ancestors(nodes: Sequence[fx.Node]) -> set[fx.Node]:
    """Those nodes and all that they are computed from."""
    found: set[fx.Node] = set()
    waiting = list(nodes)
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            waiting += node.all_input_nodes
    return found


def _subgraph(
    owner: fx.GraphModule, inputs: list[fx.Node], nodes: list[fx.Node], results: Sequence[fx.Node]
) -> fx.GraphModule:
    graph, copies = fx.Graph(), {}
    for index, node in enumerate(inputs):
        copies[node] = graph.placeholder(f"input_{index}")
    for node in nodes:
        if node not in copies:
            copies[node] = graph.node_copy(node, copies.__getitem__)
    graph.output([copies[node] for node in results])
    return fx.GraphModule(owner, graph)


def drop_unused_inputs(graph: fx.GraphModule) -> list[int]:
    """
    :param graph: changed in place
    :return: which of its inputs it needs
    """
    inputs = [node for node in graph.graph.nodes if node.op == "placeholder"]
    needed = [index for index, node in enumerate(inputs) if node.users]
    for node in inputs:
        if not node.users:
            graph.graph.erase_node(node)
    graph.recompile()
    return needed
