"""Recorded arguments of finished runs, in a form in which they can be compared with those of today's suite."""

import json
from collections.abc import Mapping
from typing import Any

from benchmarks.config import POLICY
from sb3_gac.base.arguments import present_names
from sb3_gac.presets.noises import defaults_of


def in_present_names(kind: type, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param kind: class of an algorithm
    :param arguments: arguments of the algorithm, as they were recorded
    :return: the same arguments, those of the policy included, by their present names
    """
    present = present_names(kind, arguments, None)
    policy_class = kind.policy_aliases.get(present.get("policy", POLICY))  # type: ignore[attr-defined]
    if present.get("policy_kwargs") and policy_class is not None:
        present["policy_kwargs"] = present_names(policy_class, present["policy_kwargs"], None)
    return present


def with_defaults(kind: type, recorded: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param kind: class of an algorithm
    :param recorded: arguments of the algorithm by their present names, as they were recorded
    :param other: arguments to compare them with
    :return: recorded arguments and, for each of the others that was not recorded, its default, with which the run was made;
        those of the policy included, without arguments whose default does not exist or is nothing that YAML can say
    """
    complete = _defaults(kind, set(other) - set(recorded) - {"policy_kwargs"}) | dict(recorded)
    policy_class = kind.policy_aliases.get(other.get("policy", POLICY))  # type: ignore[attr-defined]
    if other.get("policy_kwargs") and policy_class is not None:
        of_policy = recorded.get("policy_kwargs") or {}
        complete["policy_kwargs"] = _defaults(policy_class, set(other["policy_kwargs"]) - set(of_policy)) | dict(of_policy)
    return complete


def _defaults(kind: type, names: set[str]) -> dict[str, Any]:
    """The defaults of arguments, also of those that a constructor hands on to its ancestors', as YAML would have them."""
    found: dict[str, Any] = {}
    for ancestor in reversed(kind.__mro__):
        for name, default in defaults_of(ancestor).items() if "__init__" in vars(ancestor) else ():
            try:
                found |= {name: json.loads(json.dumps(default))} if name in names else {}  # a tuple is a list in YAML
            except TypeError:
                found.pop(name, None)
    return found


def settings_in_present_names(kind: type, settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param kind: class of the algorithm
    :param settings: settings of runs, as they were recorded
    :return: the same settings, with the arguments in ``overrides`` and ``definition`` by their present names
    """
    layers = {name: settings[name] for name in ("overrides", "definition") if settings.get(name)}
    return {**settings, **{name: in_present_names(kind, layer) for name, layer in layers.items()}}
