"""
Guided Actor-Critic for Stable-Baselines3. Importing it registers the ``sb3_gac/*`` environments with gymnasium.

All else is imported when it is first used: :mod:`sb3_gac.learner` runs on machines that have neither torch nor gymnasium.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from sb3_gac.version import __version__

if find_spec("gymnasium") is not None:
    from sb3_gac import envs

if TYPE_CHECKING:
    from sb3_gac.baselines.asymmetric_sac import AsymmetricSAC
    from sb3_gac.common.buffers import CompactDictReplayBuffer
    from sb3_gac.common.callbacks import GuiderLearnerEvalCallback, SeededEvalCallback
    from sb3_gac.common.checkpoint_callback import ExactCheckpointCallback
    from sb3_gac.common.checkpoint_files import CheckpointError
    from sb3_gac.common.divergence import DivergenceError
    from sb3_gac.common.env_guard import EnvironmentFailedError, InvalidStepError
    from sb3_gac.common.episodes import EpisodeReplayBuffer
    from sb3_gac.common.normalization import DeploymentNormalizer
    from sb3_gac.export import export_learner
    from sb3_gac.gac.ablations import GACShare, GACWithoutQ
    from sb3_gac.gac.gac import GAC
    from sb3_gac.gac.policies import GACPolicy
    from sb3_gac.gac.presets import PRESETS, preset
    from sb3_gac.learner import Learner

_WHERE = {
    "GAC": "gac.gac",
    "PRESETS": "gac.presets",
    "AsymmetricSAC": "baselines.asymmetric_sac",
    "CheckpointError": "common.checkpoint_files",
    "CompactDictReplayBuffer": "common.buffers",
    "DeploymentNormalizer": "common.normalization",
    "DivergenceError": "common.divergence",
    "EnvironmentFailedError": "common.env_guard",
    "EpisodeReplayBuffer": "common.episodes",
    "ExactCheckpointCallback": "common.checkpoint_callback",
    "GACPolicy": "gac.policies",
    "GACShare": "gac.ablations",
    "GACWithoutQ": "gac.ablations",
    "GuiderLearnerEvalCallback": "common.callbacks",
    "InvalidStepError": "common.env_guard",
    "Learner": "learner",
    "SeededEvalCallback": "common.callbacks",
    "export_learner": "export",
    "preset": "gac.presets",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_WHERE})


__all__ = [
    "GAC",
    "PRESETS",
    "AsymmetricSAC",
    "CheckpointError",
    "CompactDictReplayBuffer",
    "DeploymentNormalizer",
    "DivergenceError",
    "EnvironmentFailedError",
    "EpisodeReplayBuffer",
    "ExactCheckpointCallback",
    "GACPolicy",
    "GACShare",
    "GACWithoutQ",
    "GuiderLearnerEvalCallback",
    "InvalidStepError",
    "Learner",
    "SeededEvalCallback",
    "__version__",
    "envs",
    "export_learner",
    "preset",
]
