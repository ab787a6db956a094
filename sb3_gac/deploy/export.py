"""
The deployed policy as a file for the robot: ONNX or TorchScript, from raw observations to actions in the environment's range.

Nothing but the deployed policy goes into the file: no guider, no critics, and no input for privileged entries.
"""

import json
import tempfile
import warnings
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from torch import nn

from sb3_gac.base.algorithm import AsymmetricAlgorithm
from sb3_gac.checks.entries import computable
from sb3_gac.checks.scale import check_is_of_training, entries_normalised_in_training
from sb3_gac.checks.spaces import index_bounds
from sb3_gac.checks.values import check_integer
from sb3_gac.deploy.normalization import DeploymentNormalizer
from sb3_gac.deploy.verification import check_agreement, draw_observations
from sb3_gac.envs.suites.extras import missing_extra
from sb3_gac.networks.actors import DeployedPolicy
from sb3_gac.networks.recurrent import Memory
from sb3_gac.version import __version__

ACTION, STATE, NEXT_STATE = "action", "state", "next_state"
METADATA_KEY = "sb3_gac"
PASSING_NAME = "sb3_gac::value::"  # prefix of the names of inputs and outputs, until they get their own
COUNTED = ("smallest", "largest")  # keys of a discrete entry's bounds in the metadata
ACTION_MEANINGS = {  # whether actions are continuous -> their meaning
    True: "the deterministic action, between low and high, for the environment's step()",
    False: "number of the most probable action, from 0 to n - 1, for the environment's step()",
}


class DeployedModule(nn.Module):
    """
    A policy's deterministic action, normalisation and scaling included.

    :param policy: policy to deploy
    :param normalizer: normaliser of the policy's observations, ``None`` for none
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: DeployedPolicy, normalizer: DeploymentNormalizer | None):
        super().__init__()
        assert isinstance(policy.observation_space, spaces.Dict)
        self.policy = policy
        self.keys = list(policy.observation_space.spaces)
        self.normalised = [key for key in self.keys if normalizer is not None and key in normalizer.mean]
        for index, key in enumerate(self.normalised):  # names of buffers can't have all characters of keys
            assert normalizer is not None
            self.register_buffer(f"mean_{index}", th.as_tensor(normalizer.mean[key], dtype=th.float64))
            std = np.sqrt(normalizer.var[key] + normalizer.epsilon)
            self.register_buffer(f"std_{index}", th.as_tensor(std, dtype=th.float64))
        self.action_name, self.state_name, self.next_state_name = (self._free(name) for name in (ACTION, STATE, NEXT_STATE))
        self.clip_obs = 0.0 if normalizer is None else float(normalizer.clip_obs)
        if isinstance(policy.action_space, spaces.Box):
            # one-dimensional in any case: with bounds of another shape, ONNX's exporter computes in the action's float32
            self.register_buffer("low", th.as_tensor(np.ravel(policy.action_space.low)))
            self.register_buffer("high", th.as_tensor(np.ravel(policy.action_space.high)))

    def _free(self, name: str) -> str:
        """The name, with underscores at its end if an entry has the same."""
        return self._free(f"{name}_") if name in self.keys else name

    @property
    def memory(self) -> Memory | None:
        """Memory of the policy, ``None`` if it has none."""
        return self.policy.memory

    def forward(self, *inputs: th.Tensor) -> Any:
        """
        Compute deterministic actions from raw observations.

        :param inputs: entries of the policy, shape (B, ...) each; with a memory, also its state, shape (B, S), zeros at an
            episode's start
        :return: actions, shape (B, \\*action shape); with a memory, also its next state, shape (B, S)
        """
        obs = {key: self._normalize(key, value) for key, value in zip(self.keys, inputs, strict=False)}
        if self.memory is None:
            return self._in_range(self.policy.distribution(obs).mode)
        features = self.policy.extract_features(
            {key: value[None] for key, value in obs.items()}, self.policy.features_extractor
        )
        outputs, after = self.memory(features, inputs[-1][None])
        action = self.policy.output(self.policy.latent_net(outputs[0, 0])).mode
        return self._in_range(action), self.memory.with_action(after[0], action)

    def _normalize(self, key: str, value: th.Tensor) -> th.Tensor:
        if key not in self.normalised:
            return value
        index = self.normalised.index(key)
        standardised = (value.double() - getattr(self, f"mean_{index}")) / getattr(self, f"std_{index}")
        return standardised.clamp(-self.clip_obs, self.clip_obs).float()

    def _in_range(self, action: th.Tensor) -> th.Tensor:
        if not isinstance(self.policy.action_space, spaces.Box):
            return action
        scaled = self.low + 0.5 * (action + 1.0) * (self.high - self.low)
        scaled = th.minimum(scaled, self.high)  # as BoundedPolicy.unscale_action does
        return scaled.reshape(-1, *self.policy.action_space.shape)


def export_learner(
    model: AsymmetricAlgorithm,
    path: str | Path,
    normalizer: DeploymentNormalizer | None = None,
    units: dict[str, str] | None = None,
    verify_on: int = 256,
) -> Path:
    """
    Write a model's deployed policy to a file, after a check that the file's actions are the model's.

    On the robot, :class:`sb3_gac.learner.OnnxPolicy` runs an ONNX file.

    :param model: trained model
    :param path: file to write, with the suffix ".onnx", or ".pt" for TorchScript; missing folders are made
    :param normalizer: normaliser of the observations; by default that of the model's ``VecNormalize``, if it has one
    :param units: name of an entry, or "action" -> its unit, for the file's metadata
    :param verify_on: number of observations on which the file's actions are compared with those of ``predict``, by
        :func:`sb3_gac.deploy.verification.check_agreement`
    :return: path of the file
    :raises ValueError: if the suffix is another, ``verify_on`` is no integer above 0, a unit is for an entry that the policy
        does not read, the model learned under a ``VecNormalize`` that it does not have any more, a wrapper outside of
        ``VecNormalize`` changes the observations, or the normaliser has other entries or other statistics than in training
    :raises ImportError: if an ONNX file is wanted, and onnx or onnxruntime is not installed
    :raises ExportError: if the file's actions are not those of ``predict``; no file is then written
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise ValueError(f'path must end in ".onnx" or, for TorchScript, ".pt", got {str(path)!r}.')
    check_integer("verify_on", verify_on, 1)
    if normalizer is None:
        normalizer = _normalizer_of(model)
    else:
        _check_normalizes_as_in_training(normalizer, model)
    module = DeployedModule(deepcopy(model.policy.deployed), normalizer).cpu().eval().requires_grad_(False)
    metadata = json.dumps(describe(module, type(model).__name__, units or {}), allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with th.no_grad(), tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as directory:
        written = Path(directory) / path.name
        WRITERS[path.suffix](module, written, metadata)
        check_agreement(module.policy, written, normalizer, verify_on)
        written.replace(path)
    return path


def _normalizer_of(model: AsymmetricAlgorithm) -> DeploymentNormalizer | None:
    vec_normalize = model.get_vec_normalize_env()
    keys = model.policy.deployed_entries
    if vec_normalize is None and not set(keys).isdisjoint(entries_normalised_in_training(model) or ()):
        raise ValueError(
            "The model learned from observations that VecNormalize normalised, but was loaded without it: load it with "
            'env=VecNormalize.load("<its statistics>", venv), or pass normalizer=DeploymentNormalizer.from_vec_normalize(...).'
        )
    if vec_normalize is None:
        return None
    normalizer = DeploymentNormalizer.from_vec_normalize(vec_normalize, keys)
    check_is_of_training(model, normalizer.scales, keys, "The VecNormalize around the model's environments")
    wrapper = model.wrapper_outside_normalisation
    if wrapper is not None and normalizer.mean:
        raise ValueError(
            f"{type(wrapper).__name__} stands outside VecNormalize: what the policy reads of {list(normalizer.mean)} is not "
            "what VecNormalize has statistics of. Train with it outermost, or pass normalizer=DeploymentNormalizer(...) "
            "with the statistics of what the policy reads."
        )
    return normalizer


def _check_normalizes_as_in_training(normalizer: DeploymentNormalizer, model: AsymmetricAlgorithm) -> None:
    trained, keys = entries_normalised_in_training(model), model.policy.deployed_entries
    if trained is None:
        return
    raw = [key for key in keys if key in trained and key not in normalizer.mean]
    if raw:
        raise ValueError(
            f"normalizer leaves {raw} as they are, but the policy learned from them as VecNormalize normalised them: pass "
            f"normalizer=DeploymentNormalizer.from_vec_normalize(vec_normalize, {list(keys)})."
        )
    changed = [key for key in keys if key not in trained and key in normalizer.mean]
    if changed:
        raise ValueError(
            f"normalizer changes {changed}, but the policy learned from them as the environment returns them: leave "
            "normalizer out, or make it without them."
        )
    check_is_of_training(model, normalizer.scales, keys, "normalizer")


def describe(module: DeployedModule, algorithm: str, units: dict[str, str]) -> dict[str, Any]:
    """
    Describe a module in the metadata of its file.

    :param module: module to export
    :param algorithm: name of the algorithm's class
    :param units: name of an entry, or "action" -> its unit
    :return: metadata of the module's file, as JSON holds it: entries and actions with shapes, types, bounds (``None`` where
        there is none) and units, smallest and largest value of discrete entries, and the memory to be carried from one action
        to the next (``None`` without one)
    :raises ValueError: if a unit is for an entry that the policy does not read, or an entry's name has a null character
    """
    unknown = sorted(set(units) - {*module.keys, module.action_name})
    if unknown:
        raise ValueError(f"units names {unknown}, but the policy reads {module.keys} and gives {module.action_name!r}.")

    if any("\0" in key for key in module.keys):
        raise ValueError(f"The policy reads {module.keys}, but no file can name an entry with a null character: rename it.")

    def of(name: str, space: spaces.Space) -> dict[str, Any]:
        box: dict[str, Any] = {}
        if isinstance(space, spaces.Box):
            box = {"low": _finite(space.low), "high": _finite(space.high)}
        elif isinstance(space, spaces.Discrete):
            box = {"n": int(space.n)}
        if is_image_space(space):
            box |= {"layout": "channels first" if is_image_space_channels_first(space) else "channels last"}  # type: ignore
        dtype = str(computable(np.empty(0, space.dtype)).dtype)
        return {"name": name, "shape": list(space.shape or ()), "dtype": dtype, "unit": units.get(name), **box}

    def of_entry(name: str, space: spaces.Space) -> dict[str, Any]:
        bounds = index_bounds(space)  # of a discrete entry, in its shape or for all of it
        if bounds is None:
            return of(name, space)
        return of(name, space) | {what: np.asarray(bound).tolist() for what, bound in zip(COUNTED, bounds, strict=True)}

    assert isinstance(module.policy.observation_space, spaces.Dict)
    memory = None
    if module.memory is not None:
        memory = {
            "input": module.state_name,
            "output": module.next_state_name,
            "size": module.memory.state_size,
            "initial": 0.0,
        }
    action_space = module.policy.action_space
    return {
        "version": __version__,
        "algorithm": algorithm,
        "entries": [of_entry(key, space) for key, space in module.policy.observation_space.items()],
        "action": of(module.action_name, action_space) | {"meaning": ACTION_MEANINGS[isinstance(action_space, spaces.Box)]},
        "memory": memory,
        "normalised": module.normalised,
    }


def _finite(bounds: np.ndarray) -> list[float | None]:
    return [bound if np.isfinite(bound) else None for bound in np.ravel(bounds).tolist()]


def _example(module: DeployedModule) -> tuple[th.Tensor, ...]:
    """Two observations to trace the module with; their values do not matter."""
    entries = [computable(value) for value in draw_observations(module.policy, None, 2).values()]
    state = [] if module.memory is None else [np.zeros((2, module.memory.state_size), dtype=np.float32)]
    return tuple(th.as_tensor(value) for value in (*entries, *state))


def _write_onnx(module: DeployedModule, path: Path, metadata: str) -> None:
    try:
        import onnx
        import onnxruntime  # noqa: F401, with which the file is compared
    except ImportError as error:
        raise missing_extra("A file for ONNX", error.name or "onnx and onnxruntime", "export") from error

    remembers = module.memory is not None
    inputs = [*module.keys, *[module.state_name] * remembers]
    outputs = [module.action_name, *[module.next_state_name] * remembers]
    # torch takes no number as a name, and confuses an entry with a parameter of the same name
    names = {f"{PASSING_NAME}{index}": name for index, name in enumerate([*inputs, *outputs])}
    passing = list(names)
    with warnings.catch_warnings():
        # Of initial states whose number of rows is fixed; here states are inputs, and the file's actions are compared
        warnings.filterwarnings("ignore", "Exporting a model to ONNX with a batch_size other than 1", UserWarning)
        th.onnx.export(
            module,
            _example(module),
            str(path),
            input_names=passing[: len(inputs)],
            output_names=passing[len(inputs) :],
            dynamic_axes={name: {0: "batch"} for name in passing},
            dynamo=False,
        )
    proto = onnx.load(str(path))
    _rename(proto.graph, names)
    onnx.helper.set_model_props(proto, {METADATA_KEY: metadata})
    onnx.save(proto, str(path))


def _rename(graph: Any, names: dict[str, str]) -> None:
    """
    Rename values of an ONNX graph.

    :param graph: ONNX graph, changed in place
    :param names: name of a value -> its new name; another value that has such a name already gets a different one
    """
    values = [*graph.input, *graph.output, *graph.initializer, *graph.value_info]
    known = {value.name for value in values}.union(*(set(node.output) for node in graph.node))
    renamed = dict(names)
    for name in known & set(names.values()):
        other = f"{name}_"
        while other in known or other in renamed.values():
            other += "_"
        renamed[name] = other
    for value in values:
        value.name = renamed.get(value.name, value.name)
    for node in graph.node:
        node.input[:] = [renamed.get(name, name) for name in node.input]
        node.output[:] = [renamed.get(name, name) for name in node.output]


def _write_torchscript(module: DeployedModule, path: Path, metadata: str) -> None:
    traced = th.jit.trace(module, _example(module), check_trace=False)
    th.jit.save(traced, str(path), _extra_files={METADATA_KEY: metadata})


WRITERS = {".onnx": _write_onnx, ".pt": _write_torchscript}
