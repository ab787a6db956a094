"""Guided Actor-Critic for Stable-Baselines3. Importing it registers the ``sb3_gac/*`` environments with gymnasium."""

from sb3_gac import envs
from sb3_gac.baselines.asymmetric_sac import AsymmetricSAC
from sb3_gac.common.buffers import CompactDictReplayBuffer
from sb3_gac.common.callbacks import GuiderLearnerEvalCallback, SeededEvalCallback
from sb3_gac.common.episodes import EpisodeReplayBuffer
from sb3_gac.common.normalization import DeploymentNormalizer
from sb3_gac.gac.ablations import GACShare, GACWithoutQ
from sb3_gac.gac.gac import GAC
from sb3_gac.gac.policies import GACPolicy
from sb3_gac.gac.presets import PRESETS, preset
from sb3_gac.version import __version__

__all__ = [
    "GAC",
    "PRESETS",
    "AsymmetricSAC",
    "CompactDictReplayBuffer",
    "DeploymentNormalizer",
    "EpisodeReplayBuffer",
    "GACPolicy",
    "GACShare",
    "GACWithoutQ",
    "GuiderLearnerEvalCallback",
    "SeededEvalCallback",
    "__version__",
    "envs",
    "preset",
]
