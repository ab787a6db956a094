"""
The deployed policy as a file for the robot: ONNX or TorchScript, from raw observations to actions in the environment's range.

Nothing but the deployed policy goes into the file: no guider, no critics, and no input for what is privileged.
"""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_gac.common.actors import DeployedPolicy
from sb3_gac.common.memory import Memory
from sb3_gac.common.normalization import DeploymentNormalizer
from sb3_gac.common.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.version import __version__

ACTION, STATE, NEXT_STATE = "action", "state", "next_state"
METADATA_KEY = "sb3_gac"


class DeployedModule(nn.Module):
    """
    A policy's deterministic action, normalisation and scaling included.

    :param policy: to deploy
    :param normalizer: of its observations, ``None`` for none
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: DeployedPolicy, normalizer: DeploymentNormalizer | None):
        super().__init__()
        assert isinstance(policy.observation_space, spaces.Dict)
        self.policy = policy
        self.keys = list(policy.observation_space.spaces)
        self.normalised = [key for key in self.keys if normalizer is not None and key in normalizer.mean]
        for key in self.normalised:
            assert normalizer is not None
            self.register_buffer(f"mean_{key}", th.as_tensor(normalizer.mean[key], dtype=th.float64))
            std = np.sqrt(normalizer.var[key] + normalizer.epsilon)
            self.register_buffer(f"std_{key}", th.as_tensor(std, dtype=th.float64))
        self.clip_obs = 0.0 if normalizer is None else float(normalizer.clip_obs)
        if isinstance(policy.action_space, spaces.Box):
            self.register_buffer("low", th.as_tensor(policy.action_space.low, dtype=th.float32))
            self.register_buffer("high", th.as_tensor(policy.action_space.high, dtype=th.float32))

    @property
    def memory(self) -> Memory | None:
        """Of a recurrent policy."""
        return self.policy.memory  # type: ignore[return-value]

    def forward(self, *inputs: th.Tensor) -> Any:
        """
        :param inputs: the policy's entries, (B, ...) each; with a memory, also what it remembers, shape (B, S), zeros at an
            episode's start
        :return: actions, shape (B, \\*action shape); with a memory, also what it remembers now
        """
        obs = {key: self._normalize(key, value) for key, value in zip(self.keys, inputs, strict=False)}
        if self.memory is None:
            return self._in_range(self.policy(obs).mode)
        features = self.policy.extract_features(
            {key: value[None] for key, value in obs.items()}, self.policy.features_extractor
        )
        outputs, after = self.memory(features, inputs[-1][None])
        return self._in_range(self.policy.output(self.policy.latent_net(outputs[0, 0])).mode), after[0]

    def _normalize(self, key: str, value: th.Tensor) -> th.Tensor:
        if key not in self.normalised:
            return value
        standardised = (value.double() - getattr(self, f"mean_{key}")) / getattr(self, f"std_{key}")
        return standardised.clamp(-self.clip_obs, self.clip_obs).float()

    def _in_range(self, action: th.Tensor) -> th.Tensor:
        if not isinstance(self.policy.action_space, spaces.Box):
            return action
        scaled = self.low.flatten() + 0.5 * (action + 1.0) * (self.high - self.low).flatten()
        return scaled.reshape(-1, *self.policy.action_space.shape)


def export_learner(
    model: AsymmetricOffPolicyAlgorithm,
    path: str | Path,
    normalizer: DeploymentNormalizer | None = None,
    units: dict[str, str] | None = None,
) -> Path:
    """
    Write a model's deployed policy to a file: see :class:`sb3_gac.learner.Learner` for its use.

    :param model: trained
    :param path: with the suffix ".onnx", or ".pt" for TorchScript
    :param normalizer: of the observations; by default that of the model's ``VecNormalize``, if it has one
    :param units: entry, or "action" -> unit, kept in the file's metadata
    :return: the path
    :raises ValueError: if the suffix is another
    """
    path = Path(path)
    if normalizer is None and (vec_normalize := model.get_vec_normalize_env()) is not None:
        keys = model.policy.role_keys[model.policy.roles.deployed]
        normalizer = DeploymentNormalizer.from_vec_normalize(vec_normalize, keys)
    if path.suffix not in WRITERS:
        raise ValueError(f'path must end in ".onnx" or, for TorchScript, ".pt", got {str(path)!r}.')
    module = DeployedModule(deepcopy(model.policy.deployed), normalizer).cpu().eval().requires_grad_(False)
    with th.no_grad():
        WRITERS[path.suffix](module, path, json.dumps(describe(module, type(model).__name__, units or {})))
    return path


def describe(module: DeployedModule, algorithm: str, units: dict[str, str]) -> dict[str, Any]:
    """
    :param module: to export
    :param algorithm: name of its class
    :param units: entry, or "action" -> unit
    :return: what its file says of itself: entries and actions with shapes, types, bounds and units, size of its memory
    """

    def of(name: str, space: spaces.Space) -> dict[str, Any]:
        box = {}
        if isinstance(space, spaces.Box):
            box = {"low": np.ravel(space.low).tolist(), "high": np.ravel(space.high).tolist()}
        elif isinstance(space, spaces.Discrete):
            box = {"n": int(space.n)}
        return {"name": name, "shape": list(space.shape or ()), "dtype": str(space.dtype), "unit": units.get(name), **box}

    assert isinstance(module.policy.observation_space, spaces.Dict)
    return {
        "version": __version__,
        "algorithm": algorithm,
        "entries": [of(key, space) for key, space in module.policy.observation_space.items()],
        "action": of(ACTION, module.policy.action_space),
        "state_size": 0 if module.memory is None else module.memory.state_size,
        "normalised": module.normalised,
    }


def _example(module: DeployedModule) -> tuple[th.Tensor, ...]:
    """Two observations, of no importance."""
    assert isinstance(module.policy.observation_space, spaces.Dict)
    entries = [np.stack([space.sample()] * 2) for space in module.policy.observation_space.values()]
    state = [] if module.memory is None else [np.zeros((2, module.memory.state_size), dtype=np.float32)]
    return tuple(th.as_tensor(np.nan_to_num(value)) for value in (*entries, *state))


def _write_onnx(module: DeployedModule, path: Path, metadata: str) -> None:
    import onnx

    remembers = module.memory is not None
    inputs, outputs = [*module.keys, *[STATE] * remembers], [ACTION, *[NEXT_STATE] * remembers]
    batch = {name: {0: "batch"} for name in (*inputs, *outputs)}
    names: dict[str, Any] = {"input_names": inputs, "output_names": outputs, "dynamic_axes": batch}
    th.onnx.export(module, _example(module), str(path), **names, dynamo=False)
    proto = onnx.load(str(path))
    onnx.helper.set_model_props(proto, {METADATA_KEY: metadata})
    onnx.save(proto, str(path))


def _write_torchscript(module: DeployedModule, path: Path, metadata: str) -> None:
    traced = th.jit.trace(module, _example(module), check_trace=False)
    th.jit.save(traced, str(path), _extra_files={METADATA_KEY: metadata})


WRITERS = {".onnx": _write_onnx, ".pt": _write_torchscript}
