"""The code of environments of one's own: whether it is what it was when runs were made."""

import sys
from collections.abc import Iterable, Iterator
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from benchmarks.suite import RunSpec, made_with
from sb3_gac.training.environments import creator_of

_VERSIONED = ("sb3_gac", "gymnasium")  # packages whose commit and version every run records
_KINDS = (".py", ".xml")


def code_of(spec: RunSpec) -> dict[str, str]:
    """
    Identify the code of a run's environment and of its wrappers. Of a package, all files of Python and XML count, since
    rewards or a robot's model often have a file of their own; of a module outside of any package, its file.

    :param spec: settings of a run
    :return: "code of my_module" -> eight hexadecimal digits; empty for a task that this package registers
    """
    if spec.environment is None:
        return {}
    modules = list(filter(None, _modules(spec.environment)))
    for module in modules:
        import_module(module)
    packages = {module.partition(".")[0] for module in modules} - set(_VERSIONED)
    return {f"code of {name}": found for name in sorted(packages) if (found := _digits(name)) is not None}


def _modules(environment: dict[str, Any]) -> Iterator[str]:
    """The names of the modules of an environment and of its wrappers."""
    creator = creator_of(environment["id"])
    yield environment["id"].rpartition(":")[0]
    registered = gym.registry.get(environment["id"].rpartition(":")[2])
    made_by = creator if registered is None else registered.entry_point
    yield made_by.partition(":")[0] if isinstance(made_by, str) else getattr(made_by, "__module__", "")
    for wrapper in environment["wrappers"]:
        yield from (path.partition(":")[0] for path in wrapper)


def _digits(name: str) -> str | None:
    """Digits of the files of a module that was imported; ``None`` if it has none, such as a built-in one."""
    module = sys.modules.get(name)
    file, folders = (getattr(module, attribute, None) for attribute in ("__file__", "__path__"))
    in_folders = (path for folder in folders or () for path in sorted(Path(folder).rglob("*")) if path.suffix in _KINDS)
    digest, files = sha256(), list(in_folders) if folders else [Path(file)] if file else []
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8] if files else None


def about_changed_code(specs: Iterable[RunSpec], runs: Path) -> list[str]:
    """
    :param specs: settings of runs
    :param runs: directory of all runs
    :return: a sentence for each module whose code has changed since some of these runs were made, or begun
    """
    changed: dict[str, list[Path]] = {}
    now: dict[str, dict[str, str]] = {}
    for spec in specs:
        path, key = spec.directory(runs) / "config.yaml", str(spec.environment)
        now[key] = now.get(key) or code_of(spec)
        if not now[key] or not path.exists():
            continue
        before = made_with(yaml.safe_load(path.read_text(encoding="utf-8")))
        for name, digits in now[key].items():
            if {one["versions"].get(name, digits) for one in before} != {digits}:
                changed.setdefault(name, []).append(path.parent)
    return [
        f"The {name} has changed since {len(made)} of the runs in {runs} were made, such as {made[0].relative_to(runs)}. They "
        "count as they are. If the change matters, remove them, or use another directory (--runs, or --out of a comparison)."
        for name, made in changed.items()
    ]
