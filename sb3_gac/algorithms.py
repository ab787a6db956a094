"""The algorithms of this package by name, the one table that programs read. Each is imported when it is asked for."""

from importlib import import_module
from typing import Any

#: Name -> module and class
ALGORITHMS = {
    "gac": "sb3_gac.gac.gac:GAC",
    "gac_share": "sb3_gac.gac.ablations:GACShare",
    "gac_without_q": "sb3_gac.gac.ablations:GACWithoutQ",
    "asymmetric_mpo": "sb3_gac.baselines.asymmetric_mpo:AsymmetricMPO",
    "asymmetric_sac": "sb3_gac.baselines.asymmetric_sac:AsymmetricSAC",
    "cosil": "sb3_gac.baselines.cosil:COSIL",
    "rma": "sb3_gac.baselines.rma:RMA",
    "tgrl": "sb3_gac.baselines.tgrl:TGRL",
    "gpo_clip": "sb3_gac.baselines.gpo:GPOClip",
    "gpo_penalty": "sb3_gac.baselines.gpo:GPOPenalty",
}
#: Families of algorithms, by which presets know what they share
FAMILIES = {
    "off_policy": "stable_baselines3.common.off_policy_algorithm:OffPolicyAlgorithm",
    "on_policy": "stable_baselines3.common.on_policy_algorithm:OnPolicyAlgorithm",
    "gpo": "sb3_gac.baselines.gpo:GPO",
}
_NAMES = {path: name for name, path in {**ALGORITHMS, **FAMILIES}.items()}


def import_path(path: str) -> Any:
    """
    :param path: ``module:name``, as in ``my_package.algorithms:Mine``
    :return: what has that name in that module
    :raises ValueError: if there is no such module, or it has no such name
    """
    module, colon, name = path.partition(":")
    if not (module and colon and name):
        raise ValueError(f"must be module:name, as in my_package.my_module:MyClass, got {path!r}.")
    try:
        return getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        raise ValueError(f"{path!r}: there is no module {error.name!r} on Python's path.") from None
    except AttributeError:
        raise ValueError(f"{path!r}: the module {module} has no {name!r}.") from None


def algorithm_class(name: str) -> type:
    """
    :param name: a key of ``ALGORITHMS``, or ``module:Class``
    :return: the class
    :raises ValueError: if there is none of that name
    """
    if ":" not in name and name not in ALGORITHMS:
        raise ValueError(f"must be one of {sorted(ALGORITHMS)}, or module:Class, got {name!r}.")
    found = import_path(ALGORITHMS.get(name, name))
    if not isinstance(found, type):
        raise ValueError(f"{name!r} is no class, but {found!r}.")
    return found


def name_of(kind: type) -> str:
    """
    :param kind: a class
    :return: its name in ``ALGORITHMS`` or ``FAMILIES``, or else ``module:Class``
    """
    path = f"{kind.__module__}:{kind.__qualname__}"
    return _NAMES.get(path, path)
