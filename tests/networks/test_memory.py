"""Recurrent parts: the same step by step as at once, and the same as torch's own cells."""

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_gac.networks.linear_recurrent_unit import CHUNK, LinearRecurrentUnit
from sb3_gac.networks.recurrent import CELLS, RecurrentCore
from tests.plain.networks import LinearRecurrence


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("net_arch", [[], [5]])
@pytest.mark.parametrize("steps", [6, 2 * CHUNK + 3])
def test_step_by_step_as_at_once(cell, net_arch, steps):
    th.manual_seed(0)
    memory = RecurrentCore(cell, 3, net_arch, 4, n_members=2)
    x = th.randn(steps, 7, 3)
    outputs, last = memory(x)
    assert outputs.shape == (2, steps, 7, 4)
    state = None
    for step in range(steps):
        one, state = memory(x[step : step + 1], state)
        th.testing.assert_close(one[:, 0], outputs[:, step])
    th.testing.assert_close(state, last)


@pytest.mark.parametrize(("cell", "module"), [("gru", nn.GRUCell), ("lstm", nn.LSTMCell)])
def test_members_are_torchs_cells(cell, module):
    memory = RecurrentCore(cell, 3, [], 4, n_members=2)
    x = th.randn(5, 2, 3)
    for member in range(2):
        reference = module(3, 4)
        reference.load_state_dict({name[:-3]: value for name, value in memory.cells[member].state_dict().items()})
        state = None
        for step in range(5):
            state = reference(x[step], state)
        expected = state if cell == "gru" else th.cat(state, dim=-1)
        th.testing.assert_close(memory(x)[1][member], expected)


def test_an_episodes_start_forgets():
    memory = RecurrentCore("gru", 3, [], 4)
    state = np.ones((3, 4), dtype=np.float32)
    before = memory.state_before(state, np.array([True, False, True]), batch=3)
    assert before[0].sum(dim=1).tolist() == [0, 4, 0]
    assert memory.state_before(None, None, batch=2).abs().sum() == 0
    assert th.equal(memory.state_before(state, None, batch=3)[0], th.ones(3, 4))


@pytest.mark.parametrize("steps", [1, CHUNK, 3 * CHUNK + 1])
def test_linear_recurrent_unit_is_its_equation(steps):
    th.manual_seed(1)
    unit = LinearRecurrentUnit(3, 5)
    nn.init.normal_(unit.bias)
    x, state = th.randn(steps, 4, 3), th.randn(4, 10)
    outputs, last = unit.unroll(x, state)
    expected, expected_last = LinearRecurrence(unit).double()(x.double(), th.complex(*state.double().chunk(2, dim=1)))
    th.testing.assert_close(outputs.double(), expected, rtol=2e-4, atol=2e-5)
    th.testing.assert_close(last.double(), th.cat([expected_last.real, expected_last.imag], dim=1), rtol=2e-4, atol=2e-5)


def test_linear_recurrent_unit_forgets_within_its_bounds_and_keeps_the_scale():
    th.manual_seed(0)
    unit = LinearRecurrentUnit(8, 256)
    decay = (-unit.nu_log.exp()).exp()
    for value, low, high in ((decay, 0.9, 0.999), (unit.theta_log.exp(), 0, 2 * np.pi)):  # uniform on a ring: both ends occur
        assert low <= value.min() < low + 0.02 * (high - low) + 0.01
        assert high - 0.02 * (high - low) < value.max() <= high
    _, last = unit.unroll(th.randn(2500, 4, 8), th.zeros(4, 512))
    modulus = last.unflatten(1, (2, 256)).square().sum(dim=1).mean()  # E|h|^2, an input of variance 1
    assert 0.9 < modulus.item() < 1.1


def test_linear_recurrent_unit_learns_a_delay():
    """The sum of two inputs, 40 and 3 steps old, by gradients through all steps."""
    th.manual_seed(0)
    core, head = RecurrentCore("lru", 2, [16], 32), nn.Linear(32, 1)
    optimizer = th.optim.Adam([*core.parameters(), *head.parameters()], lr=3e-3)
    for _ in range(200):
        x = th.randn(64, 16, 2)
        loss = (head(core(x)[0])[0, 40:, :, 0] - x[:-40, :, 0] - x[37:-3, :, 1]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.5  # 2 without a memory, 1 with one of the newer input alone


@pytest.mark.parametrize("cell", CELLS)
def test_memories_compute_alike_in_mixed_precision(cell):
    """Powers of numbers close to 1 would be lost in bfloat16."""
    th.manual_seed(0)
    memory = RecurrentCore(cell, 3, [], 4)
    x = th.randn(200, 3, 3)
    with th.autocast("cpu", dtype=th.bfloat16):
        outputs, _ = memory(x)
        of_encoded, _ = memory(x.bfloat16())  # as a linear layer before it would hand it on
    expected = memory(x)[0]
    for found in (outputs, of_encoded):
        assert found.dtype == th.float32
        assert (found - expected).abs().mean() < 0.02 * expected.abs().mean()
