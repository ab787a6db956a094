"""Recurrent parts: the same step by step as at once, and the same as torch's own cells."""

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_gac.networks.recurrent import RecurrentCore


@pytest.mark.parametrize("cell", ["gru", "lstm"])
@pytest.mark.parametrize("net_arch", [[], [5]])
def test_step_by_step_as_at_once(cell, net_arch):
    th.manual_seed(0)
    memory = RecurrentCore(cell, 3, net_arch, 4, n_members=2)
    x = th.randn(6, 7, 3)
    outputs, last = memory(x)
    assert outputs.shape == (2, 6, 7, 4)
    state = None
    for step in range(6):
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
