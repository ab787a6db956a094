"""What a run was made with: commit, versions, machine."""

import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch as th

PACKAGE = Path(__file__).resolve().parents[1]
PACKAGES = ("sb3_gac", "stable-baselines3", "torch", "numpy", "gymnasium", "mujoco")


def provenance(packages: Sequence[str] = ()) -> dict[str, Any]:
    """
    Commit, versions and machine.

    :param packages: names of further distributions whose versions count; those that are not installed are left out
    """
    return {
        "commit": commit(),
        "versions": {"python": platform.python_version(), **_versions((*PACKAGES, *packages))},
        "cpus": os.cpu_count(),
        "threads": th.get_num_threads(),
    }


def commit(package: Path = PACKAGE) -> str:
    """
    :param package: directory of the code
    :return: the commit that it is from, with "+changes" if it was changed since; "" if it is not under version control
    """
    if _git(package, "ls-files", "__init__.py") == "":
        return ""  # installed somewhere within another repository, if there is one
    return _git(package, "rev-parse", "HEAD") + ("+changes" if _git(package, "status", "--porcelain", ".") else "")


def _git(directory: Path, *words: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(directory), *words], capture_output=True, text=True, check=False)
    except OSError:  # there is no git
        return ""
    return done.stdout.strip()


def _versions(packages: Sequence[str]) -> dict[str, str]:
    found = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
