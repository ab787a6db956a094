"""Modules under their names of earlier versions, for one release: saved models, checkpoints and users' imports need them."""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

#: Former name of a module -> present name
MOVED = {
    f"sb3_gac.{former}": f"sb3_gac.{present}"
    for former, present in {
        "common.actors": "networks.actors",
        "common.arguments": "checks.arguments",
        "common.buffers": "replay.buffer",
        "common.callbacks": "base.callbacks",
        "common.checkpoint_callback": "base.checkpoint_callback",
        "common.checkpoint_files": "checkpoint.files",
        "common.checks": "checks.values",
        "common.compilation": "optim.compile",
        "common.distributions": "math.distributions",
        "common.divergence": "checks.divergence",
        "common.dual": "optim.coefficients",
        "common.env_guard": "checks.environments",
        "common.episodes": "replay.episodes",
        "common.faults": "base.faults",
        "common.guard": "base.strict_predict",
        "common.heads": "networks.heads",
        "common.losses": "math.losses",
        "common.memory": "networks.recurrent",
        "common.networks": "networks.critics",
        "common.normalization": "deploy.normalization",
        "common.observation_store": "replay.observation_store",
        "common.off_policy": "base.off_policy",
        "common.parallel": "optim.parallel",
        "common.policies": "base.policy",
        "common.resuming": "base.resuming",
        "common.roles": "base.roles",
        "common.serialization": "checkpoint.serialization",
        "common.training": "base.update",
        "common.vec_state": "checkpoint.vec_env",
        "envs.layout": "envs.suites.layout",
        "envs.mujoco": "envs.suites.mujoco",
        "envs.pendulum": "envs.suites.pendulum",
        "envs.popgym": "envs.suites.popgym",
        "export": "deploy.export",
        "gac.presets": "presets",
        "gac.update": "gac.gac",
        "verification": "deploy.verification",
    }.items()
}
PACKAGE = "sb3_gac.common"


class MovedModules(MetaPathFinder, Loader):
    """A finder of modules by their former names, which warns and tells the present name."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """
        :param fullname: full name of a module that no other finder has found
        :param path: search path of its package, without effect here
        :param target: module that is reloaded, without effect here
        :return: specification of the module; ``None`` unless the name is a former one
        """
        if fullname not in MOVED and fullname != PACKAGE:
            return None
        return ModuleSpec(fullname, self, is_package=fullname == PACKAGE)

    def exec_module(self, module: ModuleType) -> None:
        """
        Fill a module of a former name.

        :param module: module to fill with the objects of the module of the present name
        """
        if module.__name__ in MOVED:
            present = MOVED[module.__name__]
            warnings.warn(f"{module.__name__} is {present} now.", DeprecationWarning, stacklevel=2)
            names = {name: value for name, value in vars(import_module(present)).items() if not name.startswith("__")}
            vars(module).update(names)


def find_moved_modules() -> None:
    """Let imports find modules by their former names from now on."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())
