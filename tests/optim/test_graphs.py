"""Traced graphs: parameters as inputs, and a graph in two parts that does what one did, and nothing twice."""

import torch as th
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_gac.optim.flat import FlatParameters
from sb3_gac.optim.graphs import drop_unused_inputs, lift_parameters, split


def _operations(graph):
    return [node.target for node in graph.graph.nodes if node.op == "call_function"]


def test_parameters_become_inputs_and_those_of_one_flat_tensor_a_single_one():
    network, alone = th.nn.Linear(3, 2), th.nn.Parameter(th.randn(2))
    flat = FlatParameters(list(network.parameters()))
    x = th.randn(4, 3)
    graph = make_fx(lambda x: [network(x) * alone])(x)
    inputs = lift_parameters(graph, [flat.flat])
    assert {id(tensor) for tensor in inputs} == {id(flat.flat), id(alone)}
    with th.no_grad():
        flat.flat.add_(1.0)
        th.testing.assert_close(graph(x, *inputs)[0], network(x) * alone)


def _forward_and_gradient(network, x, slope):
    output = network(x)
    return [output.detach(), *th.autograd.grad(output, list(network.parameters()), slope)]


def test_two_parts_do_what_one_graph_does():
    """Forward in the first, backward in the second, which gets what it needs and computes no part of the first again."""
    network = th.nn.Sequential(th.nn.Linear(3, 8), th.nn.SiLU(), th.nn.Linear(8, 2))
    x, slope = th.randn(5, 3), th.randn(5, 2)
    graph = make_fx(lambda x, slope: _forward_and_gradient(network, x, slope))(x, slope)
    parameters = lift_parameters(graph, [])
    first, second = split(graph, 1)
    x, slope = th.randn(5, 3), th.randn(5, 2)
    output, *saved = first(x, None, *parameters)
    expected = _forward_and_gradient(network, x, slope)
    for found, value in zip([output, *second(x, slope, *parameters, *saved)], expected, strict=True):
        th.testing.assert_close(found, value)
    addmm = th.ops.aten.addmm.default
    assert _operations(first).count(addmm) == 2
    assert addmm not in _operations(second)
    assert all(tensor.data_ptr() not in {p.data_ptr() for p in parameters} for tensor in saved), "views are made again"


def test_a_result_of_the_second_part_may_be_computed_in_the_first_or_be_an_input():
    def function(a, b):
        total = a + b
        return [total * 2, total, b, total.view(2, 1) - b[0]]

    first, second = split(make_fx(function)(*th.randn(2, 2)), 1)
    a, b = th.randn(2, 2)
    doubled, *saved = first(a, b)
    for found, value in zip([doubled, *second(a, b, *saved)], function(a, b), strict=True):
        assert th.equal(found, value)


def test_inputs_without_a_use_are_dropped():
    graph = make_fx(lambda a, b, c: [a + c])(*th.randn(3, 2))
    assert drop_unused_inputs(graph) == [0, 2]
    a, c = th.randn(2, 2)
    assert th.equal(graph(a, c)[0], a + c)
