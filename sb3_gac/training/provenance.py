"""Provenance of a run: commit, versions and machine."""

import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch as th

from sb3_gac.envs.subprocesses import usable_processors

PACKAGE = Path(__file__).resolve().parents[1]
PACKAGES = ("sb3_gac", "stable-baselines3", "torch", "numpy", "gymnasium", "mujoco")


def provenance(packages: Sequence[str] = ()) -> dict[str, Any]:
    """
    Commit, versions and machine of this process.

    :param packages: names of further distributions whose versions are added; those that are not installed are left out
    :return: ``commit``, ``versions`` by distribution, and the numbers ``cpus`` and ``threads``
    """
    return {
        "commit": commit(),
        "versions": {"python": platform.python_version(), **_versions((*PACKAGES, *packages))},
        "cpus": usable_processors(),
        "threads": th.get_num_threads(),
    }


def commit(package: Path = PACKAGE) -> str:
    """
    :param package: directory of the code
    :return: hash of the code's commit, with "+changes" if the code was changed since; "" if it is not under version control
    """
    if _git(package, "ls-files", "__init__.py") == "":
        return ""  # not under version control, or installed inside of another repository
    return _git(package, "rev-parse", "HEAD") + ("+changes" if _git(package, "status", "--porcelain", ".") else "")


def _git(directory: Path, *words: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(directory), *words], capture_output=True, text=True, check=False)
    except OSError:  # git is not installed
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
