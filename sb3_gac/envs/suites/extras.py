"""Simulators that are installed on request."""

from importlib import import_module
from typing import Any


def import_extra(module: str, extra: str, environment: str) -> Any:
    """
    :param module: that is imported when an environment is made
    :param extra: of this package, with which it is installed
    :param environment: its id, for the message
    :return: the module
    :raises ImportError: if it is not installed, saying how to
    """
    try:
        return import_module(module)
    except ImportError as error:
        missing = error.name or module
        raise ImportError(f'{environment} needs {missing}: pip install -e ".[{extra}]" in the clone of sb3_gac.') from error
