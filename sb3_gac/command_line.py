"""What the programs' command lines share: their parser, and the form of their values."""

import argparse
import re
import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any, NoReturn

import yaml

from sb3_gac.names import meant

#: Name under which all programs can be called
SCRIPT = "sb3-gac"


def called_as(module: str) -> str:
    """
    :param module: name of a program's module
    :return: words with which the process's user calls the program
    """
    return sys.argv[0] if sys.argv[0].startswith(f"{SCRIPT} ") else f"python -m {module}"


class Parser(argparse.ArgumentParser):
    """
    A parser of a program's command line. An error is told in a line of its own, without the usage that would hide it.

    :param module: name of the program's module
    :param description: docstring of the program, which the help shows as plain text
    """

    def __init__(self, module: str, description: str | None = None):
        prog = called_as(module)
        text = re.sub(r":\w+:`~?([^`]*)`", r"\1", description or "").replace("``", "").replace("::\n", ":\n")
        super().__init__(
            prog=prog,
            description=text.replace(f"python -m {module}", prog),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    def error(self, message: str) -> NoReturn:
        """
        End the program.

        :param message: description of what is wrong with the command line
        """
        self.exit(2, f"{self.prog}: error: {message}\nSee {self.prog} --help.\n")


def one_of(known: Collection[str], otherwise: str = "") -> Callable[[str], str]:
    """
    Make the type of an option whose values are names, of which there are too many for ``choices`` to list them.

    :param known: names that the option takes
    :param otherwise: sentence for names that are near none of these; by default it lists the names
    :return: function of a name that returns it, or raises an ``argparse.ArgumentTypeError`` with the name that may be meant
    """

    def checked(name: str) -> str:
        if name not in known:
            listed = otherwise or f"There are {', '.join(known)}."
            raise argparse.ArgumentTypeError(f'there is no "{name}".{meant(name, known) or f" {listed}"}')
        return name

    return checked


class _Loader(yaml.SafeLoader):
    """The safe loader, which also reads numbers with an exponent that YAML 1.1 reads as text, such as 1e-3 and 1e5."""

    def construct_exponential(self, node: yaml.ScalarNode) -> float:
        """
        :param node: plain text of a number with an exponent
        :return: integer if the text has neither a point nor a negative exponent, else a floating-point number
        """
        text = self.construct_scalar(node)
        return float(text) if "." in text or "-" in text[1:] else integer(text)


_Loader.add_implicit_resolver("!exponential", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789"))
_Loader.add_constructor("!exponential", _Loader.construct_exponential)


def integer(text: str) -> int:
    """
    :param text: text of an integer, which may have an exponent, such as 1e5
    :return: integer
    :raises ValueError: if the text is of no integer
    """
    try:
        return int(text)
    except ValueError:
        number = float(text)
    if not number.is_integer():
        raise ValueError(f"must be an integer, got {text}.")
    return int(number)


def positive(text: str) -> int:
    """
    :param text: value on the command line
    :return: number that it stands for
    :raises argparse.ArgumentTypeError: if it is no integer, or below 1
    """
    try:
        value = integer(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be an integer of at least 1, got {text}")
    return value


def from_yaml(text: str) -> Any:
    """
    :param text: value on the command line
    :return: content of the YAML, in which ``1e-3`` is a number
    :raises argparse.ArgumentTypeError: if the text is no YAML
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no YAML: {error}") from None


def mapping(text: str) -> dict[str, Any]:
    """
    :param text: value on the command line
    :return: mapping that it stands for
    :raises argparse.ArgumentTypeError: if the text is no mapping in YAML
    """
    found = from_yaml(text)
    if not isinstance(found, Mapping):
        raise argparse.ArgumentTypeError(f'must be a mapping, such as "{{key: 0.1}}", got {text!r}')
    return dict(found)
