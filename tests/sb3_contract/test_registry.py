"""Every algorithm is held to SB3's contract, by its line of tests/registry.py; what a line leaves out is refused."""

import pytest

from sb3_gac.algorithms import ALGORITHMS
from tests.registry import LINES, OPTIONS, algorithms, make

LACKING = [(name, option) for name, line in LINES.items() for option in line.lacks]


def _check_that_each_has_a_line():
    missing = [f'"{name}": Line(),' for name in ALGORITHMS if name not in LINES]
    assert not missing, f"add to LINES of tests/registry.py: {' '.join(missing)}"
    unknown = [name for name in LINES if name not in ALGORITHMS]
    assert not unknown, f"LINES of tests/registry.py has {unknown}, which sb3_gac.algorithms does not"


def test_every_algorithm_has_a_line():
    _check_that_each_has_a_line()


def test_one_that_has_none_is_told_which(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "mine", "my_package:Mine")
    with pytest.raises(AssertionError, match=r'add to LINES of tests/registry.py: "mine": Line\(\),'):
        _check_that_each_has_a_line()


@pytest.mark.parametrize(("algorithm", "option"), LACKING)
def test_what_a_method_does_not_have_is_refused(algorithm, option):
    """So no line leaves out what could be tested."""
    asked = OPTIONS[option]
    with pytest.raises((ValueError, TypeError), match=asked.refusal):
        make(algorithm, asked.make_env(), **asked.arguments)


@pytest.mark.parametrize("option", OPTIONS)
def test_only_those_that_lack_an_option_are_left_out_of_its_tests(option):
    _, names = algorithms(option).args
    assert [name for name in LINES if name not in names] == [name for name, line in LINES.items() if option in line.lacks]
    assert names, "or its tests would hold for none"
