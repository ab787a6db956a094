"""What is installed on request, and the one sentence that says how, wherever it is missing."""

from importlib import import_module
from typing import Any


def import_extra(module: str, extra: str, user: str) -> Any:
    """
    :param module: that is imported when it is needed
    :param extra: of this package, with which it is installed
    :param user: what needs it, such as an environment's id, for the message
    :return: the module
    :raises ImportError: if it is not installed, saying how to
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise missing_extra(user, error.name or module, extra) from error


def missing_extra(user: str, missing: str, extra: str) -> ImportError:
    """
    :param user: what can't be used without the extra
    :param missing: module, or modules, that are not there
    :param extra: of this package, that has them
    :return: an error that says how to install it
    """
    return ImportError(
        f'{user} needs {missing}, which the extra sb3_gac[{extra}] has: pip install -e ".[{extra}]" in the clone of sb3_gac.',
        name=missing,
    )
