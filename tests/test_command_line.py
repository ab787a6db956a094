"""The form of the values on command lines."""

import argparse

import pytest

from sb3_gac.command_line import Parser, from_yaml, mapping, positive


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *[("1e-3", 1e-3), ("1E-3", 1e-3), ("-2.5e4", -2.5e4), ("1.e-3", 1e-3), (".5e1", 5.0), ("1.0e5", 1e5), ("0.1", 0.1)],
        *[("1e5", 100_000), ("-1e2", -100), ("2e+3", 2_000), ("7", 7)],
        *[("'1e-3'", "1e-3"), ("1e", "1e"), ("e5", "e5"), ("1e-3 -> 0", "1e-3 -> 0"), ("a1e5", "a1e5"), ("1e5x", "1e5x")],
    ],
)
def test_numbers_with_an_exponent_are_numbers(text, value):
    found = from_yaml(text)
    assert (found, type(found)) == (value, type(value))
    assert mapping(f"{{lr: {text}, all: [{text}]}}") == {"lr": value, "all": [value]}


@pytest.mark.parametrize(("text", "value"), [("1e5", 100_000), ("2.5e3", 2_500), ("12000", 12_000), ("5.0", 5)])
def test_numbers_of_steps_may_have_an_exponent(text, value):
    found = positive(text)
    assert (found, type(found)) == (value, int)


@pytest.mark.parametrize("text", ["0", "-1e3", "1e-3", "2.5", "inf", "nan", "many", ""])
def test_what_is_no_number_of_steps_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="must be an integer of at least 1, got"):
        positive(text)


def test_help_is_plain_text(monkeypatch):
    monkeypatch.setattr("sys.argv", ["sb3-gac train"])
    description = "Train, see :func:`sb3_gac.zoo.main`, under ``runs/``::\n\n    python -m sb3_gac.train --task Ant\n"
    text = Parser("sb3_gac.train", description).format_help()
    assert "Train, see sb3_gac.zoo.main, under runs/:\n\n    sb3-gac train --task Ant\n" in text
    assert text.startswith("usage: sb3-gac train ")
