"""The algorithms of this package by name, in one table for all programs. A class is imported when it is looked up."""

from importlib import import_module
from typing import Any

from sb3_gac.names import meant

#: Name of an algorithm -> ``module:Class``
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
#: Name of a family of algorithms, for which presets have arguments -> ``module:Class`` of their common base
FAMILIES = {
    "off_policy": "stable_baselines3.common.off_policy_algorithm:OffPolicyAlgorithm",
    "on_policy": "stable_baselines3.common.on_policy_algorithm:OnPolicyAlgorithm",
    "gpo": "sb3_gac.baselines.gpo:GPO",
}
_NAMES = {path: name for name, path in {**ALGORITHMS, **FAMILIES}.items()}


def import_path(path: str) -> Any:
    """
    Import an object by its path.

    :param path: path of the form ``module:name``, as in ``my_package.algorithms:Mine``
    :return: object of that name in the module
    :raises ValueError: if the path has another form, there is no such module, or the module has no such name
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
    :param name: name of the algorithm, a key of ``ALGORITHMS``, or ``module:Class``
    :return: class of the algorithm
    :raises ValueError: if there is no class of that name
    """
    if ":" not in name and name not in ALGORITHMS:
        raise ValueError(f"must be one of {sorted(ALGORITHMS)}, or module:Class, got {name!r}.{meant(name, ALGORITHMS)}")
    found = import_path(ALGORITHMS.get(name, name))
    if not isinstance(found, type):
        raise ValueError(f"{name!r} is no class, but {found!r}.")
    return found


def name_of(kind: type) -> str:
    """
    :param kind: class of an algorithm, or base of a family
    :return: name of the class in ``ALGORITHMS`` or ``FAMILIES``, or else ``module:Class``
    """
    path = f"{kind.__module__}:{kind.__qualname__}"
    return _NAMES.get(path, path)
