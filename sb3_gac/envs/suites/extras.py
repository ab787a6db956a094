"""Extras of this package, and the one sentence that says how to install them, wherever they are missing."""

from importlib import import_module
from typing import Any


def import_extra(module: str, extra: str, user: str) -> Any:
    """
    Import a module that an extra of this package installs.

    :param module: path of the module to import
    :param extra: extra of this package that installs the module
    :param user: name of what needs the module, such as an environment's id, for the message
    :return: imported module
    :raises ImportError: if the module is not installed; the message says how to install it
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise missing_extra(user, error.name or module, extra) from error


def missing_extra(user: str, missing: str, extra: str) -> ImportError:
    """
    :param user: name of what can't be used without the extra
    :param missing: name of the missing module, or of several
    :param extra: extra of this package that installs them
    :return: error whose message says how to install the extra
    """
    return ImportError(
        f'{user} needs {missing}, which the extra sb3_gac[{extra}] has: pip install -e ".[{extra}]" in the clone of sb3_gac.',
        name=missing,
    )
