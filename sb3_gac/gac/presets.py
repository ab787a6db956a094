"""Named sets of arguments: ``GAC("MultiInputPolicy", env, **preset("paper"))``."""

from copy import deepcopy
from typing import Any, NamedTuple

from torch import nn


class Preset(NamedTuple):
    """
    A set of arguments, and what it goes with.

    :param envs: environments side by side, for which ``gradient_steps`` is meant
    :param arguments: of :class:`sb3_gac.GAC`
    :param target_kls: task -> noise -> ``target_kl``, where it is another than that of the arguments
    """

    envs: int
    arguments: dict[str, Any]
    target_kls: dict[str, dict[float, float]]


#: task -> noise -> ``target_kl``, where the paper's Table 3 has other than its middle value
_TABLE_3 = {
    "Ant": {0.0: 0.01, 0.3: 0.001},
    "HalfCheetah": {0.0: 0.01, 0.2: 0.001, 0.3: 0.001},
    "Humanoid": {0.1: 0.001, 0.2: 0.001, 0.3: 0.001},
    "HumanoidStandup": {0.2: 0.001, 0.3: 0.001},
    "InvertedDoublePendulum": {0.0: 0.001, 0.1: 0.001, 0.2: 0.001, 0.3: 0.001},
}

PRESETS: dict[str, Preset] = {
    # Trains HalfCheetah visibly in ten minutes on one core
    "small": Preset(
        envs=4,
        arguments={
            "learning_rate": 1e-3,
            "learning_starts": 2_000,
            "batch_size": 128,
            "tau": 0.01,
            "gradient_steps": -1,
            "role_keys": {"critic": ["privileged"]},
            "policy_kwargs": {"net_arch": [128, 128]},
        },
        target_kls=_TABLE_3,
    ),
    # Table 2; target_kl is the middle value of Table 3
    "paper": Preset(
        envs=128,
        arguments={
            "guider": "independent",
            "learner_entropy": False,
            "learning_starts": 10_000,
            "batch_size": 512,
            "buffer_size": 1_000_000,
            "train_freq": 1,
            "gradient_steps": 64,
            "target_kl": 0.005,
            "target_entropy": "auto",
            "max_grad_norm": 1.0,
            "policy_kwargs": {"net_arch": [256, 256], "activation_fn": nn.SiLU},
        },
        target_kls=_TABLE_3,
    ),
}


def preset(name: str, *, task: str | None = None, noise: float = 0.0, **overrides: Any) -> dict[str, Any]:
    """
    :param name: "small" or "paper"
    :param task: as in ``sb3_gac/<task>-v5``: with the preset's ``target_kl`` for it, if it has one
    :param noise: of that task
    :param overrides: arguments that replace those of the preset; ``policy_kwargs`` are merged
    :return: keyword arguments of :class:`sb3_gac.GAC`; ``PRESETS[name].envs`` environments go with them
    :raises ValueError: if there is no such preset
    """
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {sorted(PRESETS)}, got {name!r}.")
    arguments = deepcopy(PRESETS[name].arguments)
    target_kls = PRESETS[name].target_kls.get(task or "", {})
    if noise in target_kls:
        arguments["target_kl"] = target_kls[noise]
    policy_kwargs = {**arguments["policy_kwargs"], **(overrides.get("policy_kwargs") or {})}
    return {**arguments, **overrides, "policy_kwargs": policy_kwargs}
