"""
Guided Actor-Critic for Stable-Baselines3. Importing this package registers the ``sb3_gac/*`` environments with gymnasium.

Other modules are imported at their first use, since :mod:`sb3_gac.learner` runs on machines without torch and gymnasium.
"""

from sb3_gac.stopping import take_over

take_over()  # before all imports that take time

import warnings
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from sb3_gac.algorithms import ALGORITHMS
from sb3_gac.moved import find_moved_modules
from sb3_gac.version import __version__

find_moved_modules()

if find_spec("gymnasium") is not None:
    from sb3_gac import envs

if TYPE_CHECKING:
    from sb3_gac.base.callbacks import GuiderLearnerEvalCallback, SeededEvalCallback
    from sb3_gac.base.checkpoint_callback import ExactCheckpointCallback
    from sb3_gac.base.imitation import Demonstrations, clone_behaviour, copy_networks, demonstrate
    from sb3_gac.base.recording import write_recording
    from sb3_gac.baselines.asymmetric_mpo import AsymmetricMPO
    from sb3_gac.baselines.asymmetric_sac import AsymmetricSAC
    from sb3_gac.baselines.cosil import COSIL
    from sb3_gac.baselines.gpo import GPOClip, GPOPenalty
    from sb3_gac.baselines.rma import RMA
    from sb3_gac.baselines.tgrl import TGRL
    from sb3_gac.checkpoint.files import CheckpointError
    from sb3_gac.checks.divergence import DivergenceError
    from sb3_gac.checks.environments import EnvironmentFailedError
    from sb3_gac.checks.observations import InvalidStepError
    from sb3_gac.deploy.export import export_learner
    from sb3_gac.deploy.normalization import DeploymentNormalizer
    from sb3_gac.gac.ablations import GACShare, GACWithoutQ
    from sb3_gac.gac.gac import GAC
    from sb3_gac.gac.policies import GACPolicy
    from sb3_gac.learner import OnnxPolicy
    from sb3_gac.presets import PRESETS, preset
    from sb3_gac.replay.buffer import CompactDictReplayBuffer
    from sb3_gac.replay.episodes import EpisodeReplayBuffer

_WHERE = {
    **{name: module for module, _, name in (path.partition(":") for path in ALGORITHMS.values())},
    "PRESETS": "sb3_gac.presets",
    "CheckpointError": "sb3_gac.checkpoint.files",
    "CompactDictReplayBuffer": "sb3_gac.replay.buffer",
    "Demonstrations": "sb3_gac.base.imitation",
    "DeploymentNormalizer": "sb3_gac.deploy.normalization",
    "DivergenceError": "sb3_gac.checks.divergence",
    "EnvironmentFailedError": "sb3_gac.checks.environments",
    "EpisodeReplayBuffer": "sb3_gac.replay.episodes",
    "ExactCheckpointCallback": "sb3_gac.base.checkpoint_callback",
    "GACPolicy": "sb3_gac.gac.policies",
    "GuiderLearnerEvalCallback": "sb3_gac.base.callbacks",
    "InvalidStepError": "sb3_gac.checks.observations",
    "OnnxPolicy": "sb3_gac.learner",
    "SeededEvalCallback": "sb3_gac.base.callbacks",
    "clone_behaviour": "sb3_gac.base.imitation",
    "copy_networks": "sb3_gac.base.imitation",
    "demonstrate": "sb3_gac.base.imitation",
    "export_learner": "sb3_gac.deploy.export",
    "preset": "sb3_gac.presets",
    "write_recording": "sb3_gac.base.recording",
}


#: Optional module that torch may look for at its import -> extra of this package that installs the module
_EXTRAS = {"onnx": "export", "onnxruntime": "export"}
_RENAMED = {"Learner": "OnnxPolicy"}


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        warnings.warn(f"sb3_gac.{name} is sb3_gac.{_RENAMED[name]} now.", DeprecationWarning, stacklevel=2)
        name = _RENAMED[name]
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(_WHERE[name]), name)
    except ModuleNotFoundError as error:
        missing = next((module for module in _EXTRAS if str(error) == f"No module named {module!r}"), None)
        if missing is None:
            raise
        from sb3_gac.envs.suites.extras import missing_extra

        raise missing_extra(f"sb3_gac.{name}", missing, _EXTRAS[missing]) from error


def __dir__() -> list[str]:
    return sorted({*globals(), *_WHERE})


__all__ = [
    "COSIL",
    "GAC",
    "PRESETS",
    "RMA",
    "TGRL",
    "AsymmetricMPO",
    "AsymmetricSAC",
    "CheckpointError",
    "CompactDictReplayBuffer",
    "Demonstrations",
    "DeploymentNormalizer",
    "DivergenceError",
    "EnvironmentFailedError",
    "EpisodeReplayBuffer",
    "ExactCheckpointCallback",
    "GACPolicy",
    "GACShare",
    "GACWithoutQ",
    "GPOClip",
    "GPOPenalty",
    "GuiderLearnerEvalCallback",
    "InvalidStepError",
    "OnnxPolicy",
    "SeededEvalCallback",
    "__version__",
    "clone_behaviour",
    "copy_networks",
    "demonstrate",
    "envs",
    "export_learner",
    "preset",
    "write_recording",
]
