"""Policies to evaluate: a model's deployed policy, its guider, or an exported file, each with its memory if it has one."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_gac.base.algorithm import AsymmetricAlgorithm

Observations = Mapping[str, np.ndarray]
Shapes = dict[str, tuple[int, ...]]
METADATA_KEY = "sb3_gac"
EXPORTED = (".onnx", ".pt")


class EvaluatedPolicy(ABC):
    """
    A policy that acts deterministically in several episodes at once.

    :param entries: entries of the observation that the policy is given, with their shapes; no other entry reaches it
    """

    def __init__(self, entries: Shapes):
        self.entries = entries

    @abstractmethod
    def start(self, n_envs: int) -> None:
        """
        Empty the memory of all environments.

        :param n_envs: number of environments that are stepped side by side from here on, N
        """

    @abstractmethod
    def act(self, observations: Observations, starts: np.ndarray) -> np.ndarray:
        r"""
        Choose the actions of one step in all environments.

        :param observations: entry -> its values in all environments, shape (N, ...); there may be entries that the policy does
            not read
        :param starts: whether an episode starts in each environment, shape (N,)
        :return: actions, shape (N, \*action shape)
        """


class ModelPolicy(EvaluatedPolicy):
    """
    A policy of a model.

    :param predict: method ``predict`` or ``predict_guider`` of the model
    :param entries: entries of the observation that the policy reads, with their shapes
    :param normalize: function that normalises observations as ``VecNormalize`` did in training, ``None`` if the model was
        trained without
    """

    def __init__(self, predict: Callable[..., Any], entries: Shapes, normalize: Callable[[Any], Any] | None):
        super().__init__(entries)
        self._predict, self._normalize = predict, normalize
        self._state: Any = None

    def start(self, n_envs: int) -> None:
        """Empty the memory of all environments."""
        self._state = None

    def act(self, observations: Observations, starts: np.ndarray) -> np.ndarray:
        """Act by the model, as :meth:`EvaluatedPolicy.act` requires."""
        if self._normalize is not None:
            observations = self._normalize(dict(observations))
        seen = {key: observations[key] for key in self.entries}
        actions, self._state = self._predict(seen, self._state, starts, deterministic=True)
        return np.asarray(actions)


class ExportedPolicy(EvaluatedPolicy):
    """
    A policy in a file of :func:`sb3_gac.export_learner`, loaded once for each environment, as on as many robots.

    :param metadata: metadata in the file
    :param load: function that loads the file as an object which acts on single observations, with ``act`` and ``reset``
    """

    def __init__(self, metadata: Mapping[str, Any], load: Callable[[], Any]):
        super().__init__({entry["name"]: tuple(entry["shape"]) for entry in metadata["entries"]})
        self._load = load
        self._runners: Sequence[Any] = ()

    def start(self, n_envs: int) -> None:
        """Load the file anew for each environment, with an empty memory."""
        self._runners = [self._load() for _ in range(n_envs)]

    def act(self, observations: Observations, starts: np.ndarray) -> np.ndarray:
        """Act by the file, as :meth:`EvaluatedPolicy.act` requires."""
        actions = []
        for number, runner in enumerate(self._runners):
            if starts[number]:
                runner.reset()
            actions.append(runner.act({key: observations[key][number] for key in self.entries}))
        return np.stack(actions)


class TorchScriptRunner:
    """
    A policy in an exported ``.pt`` file, used as :class:`sb3_gac.learner.OnnxPolicy` is.

    :param module: module in the file
    :param metadata: metadata in the file
    """

    def __init__(self, module: Callable[..., Any], metadata: Mapping[str, Any]):
        self._module, self._metadata = module, metadata
        self.reset()

    def reset(self) -> None:
        """Empty the memory, since an episode starts."""
        memory = self._metadata["memory"]
        self._state = [] if memory is None else [th.full((1, memory["size"]), memory["initial"])]

    @th.no_grad()
    def act(self, observation: Observations) -> np.ndarray:
        """
        Choose the action of one step.

        :param observation: entry -> its values in a single observation
        :return: action for the observation, in the environment's range
        """
        entries = [
            _in_layout(np.asarray(observation[entry["name"]], entry["dtype"]), entry) for entry in self._metadata["entries"]
        ]
        result = self._module(*(th.as_tensor(entry[None]) for entry in entries), *self._state)
        if self._state:
            result, self._state[0] = result
        action: np.ndarray = result.numpy()[0]
        return action


def _in_layout(value: np.ndarray, entry: Mapping[str, Any]) -> np.ndarray:
    """One value of an exported policy's entry; of an image, the channels as the file has them."""
    has_channels_last = entry.get("layout") == "channels first" and value.shape != tuple(entry["shape"])
    return np.moveaxis(value, -1, 0) if has_channels_last else value


def load_exported(path: Path) -> ExportedPolicy:
    """
    Load the policy in an exported file.

    :param path: file that :func:`sb3_gac.export_learner` wrote
    :return: policy in the file
    :raises ValueError: if it is another file
    :raises ImportError: if it is an ONNX file, and onnxruntime is not installed
    """
    if path.suffix == ".onnx":
        from sb3_gac.learner import OnnxPolicy

        return ExportedPolicy(OnnxPolicy.load(path).metadata, lambda: OnnxPolicy.load(path))
    extra = {METADATA_KEY: ""}
    try:
        module = th.jit.load(str(path), map_location="cpu", _extra_files=extra)
    except RuntimeError as error:
        raise ValueError(f"{path} is no TorchScript file: {str(error).splitlines()[0]}") from None
    if not extra[METADATA_KEY]:
        raise ValueError(f"{path} was not written by sb3_gac.export_learner: it has no description of its inputs.")
    metadata = json.loads(extra[METADATA_KEY])
    return ExportedPolicy(metadata, lambda: TorchScriptRunner(module, metadata))


def learner_of(model: AsymmetricAlgorithm, normalize: Callable[[Any], Any] | None = None) -> ModelPolicy:
    """
    Take the deployed policy of a model.

    :param model: trained model
    :param normalize: function that normalises observations, as in :class:`ModelPolicy`
    :return: deployed policy of the model
    """
    return ModelPolicy(model.predict, _shapes(model, [model.policy.roles.deployed]), normalize)


def guider_of(model: Any, normalize: Callable[[Any], Any] | None = None) -> ModelPolicy:
    """
    Take the guider of a model.

    :param model: trained model
    :param normalize: function that normalises observations, as in :class:`ModelPolicy`
    :return: guider of the model, the policy that sees privileged entries
    :raises ValueError: if the model's algorithm has no guider
    """
    if not hasattr(model, "predict_guider"):
        raise ValueError(
            f"{type(model).__name__} has no guider: leave --guider out. GAC, its ablations and GPO have one; a teacher is a "
            "model of its own, to be evaluated by itself."
        )
    return ModelPolicy(model.predict_guider, _shapes(model, ["guider", model.policy.roles.deployed]), normalize)


def _shapes(model: AsymmetricAlgorithm, roles: Sequence[str]) -> Shapes:
    keys = dict.fromkeys(key for role in roles for key in model.policy.role_keys[role])
    assert isinstance(model.observation_space, spaces.Dict)
    return {key: tuple(model.observation_space[key].shape or ()) for key in keys}
