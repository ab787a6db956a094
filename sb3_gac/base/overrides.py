"""Checks of arguments given to a model that comes from a file: each has its effect, or is refused by name."""

import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sb3_gac.base.arguments import SHARED
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.arguments import constructor_arguments, constructor_parameters
from sb3_gac.checks.values import plain
from sb3_gac.names import meant

#: Attributes that are kept with a model although they are no arguments of its constructor
SETTINGS = ("strict_deployment",)
_NO_GSDE = (
    "There is no state-dependent exploration (gSDE), whose standard deviation depends on the features of one policy, while "
    "guider and learner share theirs. Leave it out."
)
#: Argument of SB3's algorithms that those of this package do not have -> the reason, and what to do
_OF_SB3 = dict.fromkeys(("use_sde", "sde_sample_freq", "use_sde_at_warmup"), _NO_GSDE) | {"n_envs": "It follows from env."}
PACKAGE = __name__.partition(".")[0]


def algorithm_of(kind: type) -> str:
    """
    The name of the algorithm that a class is a form of.

    :param kind: class of an algorithm
    :return: name of its nearest concrete ancestor in this package, itself included; without one, of its furthest concrete
        ancestor
    """
    concrete = [base for base in kind.__mro__ if hasattr(base, "update") and not inspect.isabstract(base)]
    ours = [base for base in concrete if base.__module__.partition(".")[0] == PACKAGE]
    return (ours or concrete[::-1])[0].__name__


def check_whose(kind: type, saved: Mapping[str, Any], path: Any) -> None:
    """
    Check that a file holds a model of the algorithm that is to load it.

    :param kind: class that is to load the file
    :param saved: name -> attribute in the file
    :param path: path of the file, for the message
    :raises ValueError: if the file holds a model of another algorithm
    """
    name, expected = saved.get("algorithm"), algorithm_of(kind)
    if name is None:  # the file is another library's, or an earlier version's
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
    Check that a model can be given these arguments when it is loaded or resumed.

    :param kind: class of an algorithm
    :param given: names of the arguments
    :param where: call that the arguments were given to, for the message, such as "load()"
    :raises TypeError: naming the first argument that the class does not take, and the one that may be meant
    """
    known = [*constructor_arguments(kind), *SETTINGS]
    for name in given:
        if name not in known:
            raise _unknown(kind, name, where, known)


def check_known(kind: type, shared: type, given: Iterable[str]) -> None:
    """
    Check that a constructor was given no unknown arguments.

    :param kind: class of an algorithm
    :param shared: table of the arguments that on-policy, or off-policy, algorithms share, a key of ``SHARED``
    :param given: names of the arguments that no subclass's constructor has taken
    :raises TypeError: naming the first argument that is no shared one either, and the one that may be meant
    """
    for name in given:
        if name not in SHARED[shared].parameters:
            raise _unknown(kind, name, f"{kind.__name__}()", constructor_parameters(kind))


def _unknown(kind: type, name: str, where: str, known: Sequence[str]) -> TypeError:
    policy_class: type = kind.policy_aliases.get("MultiInputPolicy", AsymmetricPolicy)  # type: ignore[attr-defined]
    if name in constructor_parameters(policy_class):
        hint = "It is one of policy_kwargs."
    elif name in _OF_SB3:
        hint = _OF_SB3[name]
    elif name in SETTINGS:
        hint = "Set it on the model itself."
    else:
        hint = meant(name, known, nearness=0.6).strip() or f"It takes {', '.join(known)}."
    return TypeError(f'{where} got "{name}", which is no argument of {kind.__name__}. {hint}')


def check_unchanged(name: str, given: Any, before: Any, where: str) -> None:
    """
    Check that an argument has the value that it had when the file was written.

    :param name: name of the argument
    :param given: value of the argument now
    :param before: value of the argument in the file
    :param where: call that the argument was given to, for the message, such as "load()"
    :raises ValueError: if the values differ
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
    except ValueError:  # arrays are compared by element
        return repr(one) == repr(other)
