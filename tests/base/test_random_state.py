"""What is drawn within the context changes nothing outside of it, whatever happens there."""

import random

import numpy as np
import pytest
import torch as th

from sb3_gac.base.random_state import random_numbers_kept


def _drawn():
    return random.random(), np.random.rand(), th.rand(()).item()


@pytest.mark.parametrize("device", [None, th.device("cpu")])
@pytest.mark.parametrize("fails", [False, True])
def test_random_numbers_go_on_as_if_none_were_drawn(device, fails):
    for seed in (random.seed, np.random.seed, th.manual_seed):
        seed(3)
    expected = [_drawn() for _ in range(2)]
    for seed in (random.seed, np.random.seed, th.manual_seed):
        seed(3)
    first = _drawn()
    try:
        with random_numbers_kept(device):
            np.random.seed(0)
            _drawn()
            if fails:
                raise ZeroDivisionError
    except ZeroDivisionError:
        assert fails
    assert [first, _drawn()] == expected
