"""constraints.txt: everything that the tests use is pinned, and can be installed on every Python that setup.cfg promises."""

import configparser
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LINES = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
PINS = {canonicalize_name(pin.name): pin for pin in map(Requirement, LINES)}


def _setup():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


def _promised_pythons():
    classifiers = _setup()["metadata"]["classifiers"].splitlines()
    return [line.rpartition(" :: ")[2] for line in classifiers if "Python :: 3." in line]


def test_pins_are_sorted_and_exact():
    assert list(PINS) == sorted(PINS)
    assert len(PINS) == len(LINES)
    assert all(str(pin.specifier).startswith("==") for pin in PINS.values())


def test_everything_that_the_tests_use_is_pinned():
    options, extras = _setup()["options"], _setup()["options.extras_require"]
    wanted = [*options["install_requires"].split("\n"), *extras["dev"].split("\n")]
    names = {canonicalize_name(Requirement(line).name) for line in wanted if line.strip()}
    assert not names - set(PINS)


@pytest.mark.parametrize("python", _promised_pythons())
def test_what_is_pinned_on_a_python_was_released_for_it(python):
    """As far as the installed packages tell, which on Python 3.11 with these constraints are the pinned ones."""
    refused = []
    for name, pin in PINS.items():
        applies = pin.marker is None or pin.marker.evaluate({"python_version": python})
        if applies and not _accepts(name, pin, f"{python}.99"):
            refused.append(str(pin))
    assert not refused


def _accepts(name, pin, python):
    try:
        installed = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return True
    required = installed.metadata["Requires-Python"]
    if required is None or not pin.specifier.contains(installed.version):
        return True
    return Requirement(f"python{required}").specifier.contains(python)
