"""What may be given to a model that comes from a file: each argument counts, or is refused by name."""

import difflib
import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sb3_gac.base.arguments import SHARED
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.arguments import constructor_arguments, constructor_parameters
from sb3_gac.checks.values import plain

#: What is no argument of the constructor, and is kept with a model nevertheless
SETTINGS = ("strict_deployment",)
PACKAGE = __name__.partition(".")[0]


def algorithm_of(kind: type) -> str:
    """
    :param kind: an algorithm's class
    :return: name of the algorithm: that of this package which a subclass elsewhere adds to, or that subclass's first own
    """
    concrete = [base for base in kind.__mro__ if hasattr(base, "update") and not inspect.isabstract(base)]
    ours = [base for base in concrete if base.__module__.partition(".")[0] == PACKAGE]
    return (ours or concrete[::-1])[0].__name__


def check_whose(kind: type, saved: Mapping[str, Any], path: Any) -> None:
    """
    :param kind: class that is to load a file
    :param saved: the attributes in the file
    :param path: of the file, for the message
    :raises ValueError: if it is another algorithm's
    """
    name, expected = saved.get("algorithm"), algorithm_of(kind)
    if name is None:  # of another library, or of an earlier version
        policy_class = saved.get("policy_class")
        aliases: Mapping[str, type] = kind.policy_aliases  # type: ignore[attr-defined]
        base = aliases.get("MultiInputPolicy", AsymmetricPolicy)
        if isinstance(policy_class, type) and issubclass(policy_class, base):
            return
        policy = getattr(policy_class, "__name__", policy_class)
        raise ValueError(f"{path} does not hold a model of {expected}: its policy is {policy}. Load it with its own class.")
    if name != expected:
        raise ValueError(f"{path} holds a model of {name}, not of {expected}: load it with {name}.load().")


def check_names(kind: type, given: Iterable[str], where: str) -> None:
    """
    :param kind: an algorithm's class
    :param given: names of arguments
    :param where: they were given, for the message
    :raises TypeError: naming those that the class does not take, and what may be meant
    """
    known = [*constructor_arguments(kind), *SETTINGS]
    for name in given:
        if name not in known:
            raise _unknown(kind, name, where, known)


def check_known(kind: type, shared: type, given: Iterable[str]) -> None:
    """
    :param kind: an algorithm's class
    :param shared: table of the arguments that its family shares
    :param given: names of arguments that no constructor of its own has taken
    :raises TypeError: naming those that are not shared ones either, and what may be meant
    """
    for name in given:
        if name not in SHARED[shared].parameters:
            raise _unknown(kind, name, f"{kind.__name__}()", constructor_parameters(kind))


def _unknown(kind: type, name: str, where: str, known: Sequence[str]) -> TypeError:
    policy_class: type = kind.policy_aliases.get("MultiInputPolicy", AsymmetricPolicy)  # type: ignore[attr-defined]
    close = difflib.get_close_matches(name, known, n=1)
    if name in constructor_parameters(policy_class):
        hint = "It is one of policy_kwargs."
    elif name == "n_envs":
        hint = "It follows from env."
    else:
        hint = f'Is "{close[0]}" meant?' if close else "Set what is no argument on the model itself."
    return TypeError(f'{where} got "{name}", which is no argument of {kind.__name__}. {hint}')


def check_unchanged(name: str, given: Any, before: Any, where: str) -> None:
    """
    :param name: of an argument that can't be another than before
    :param given: its value now
    :param before: its value in the file
    :param where: it was given, for the message
    :raises ValueError: if it is another
    """
    given, before = plain(given), plain(before)
    if isinstance(given, Mapping) and isinstance(before, Mapping):
        names = [key for key in {**before, **given} if not _same(given.get(key), before.get(key))]
        difference = "; ".join(f"{key} is {given.get(key)!r}, and was {before.get(key)!r}" for key in names)
    else:
        difference = "" if _same(given, before) else f"it is {given!r}, and was {before!r}"
    if difference:
        raise ValueError(
            f"{name} can't be changed at {where}, because what the file holds was made with it: {difference}. "
            f"Leave {name} out, or make a new model."
        )


def _same(one: Any, other: Any) -> bool:
    try:
        return bool(one == other)
    except ValueError:  # arrays
        return repr(one) == repr(other)
