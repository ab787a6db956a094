"""What is evaluated: a model's deployed policy, its guider, or an exported file, each with a memory if it has one."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac.base.algorithm import AsymmetricAlgorithm

Observations = Mapping[str, np.ndarray]
Shapes = dict[str, tuple[int, ...]]
METADATA_KEY = "sb3_gac"
EXPORTED = (".onnx", ".pt")


class EvaluatedPolicy(ABC):
    """
    Deterministic actions of a policy for several episodes at once.

    :param entries: those of the observation that it is given, with their shapes; nothing else reaches it
    """

    def __init__(self, entries: Shapes):
        self.entries = entries

    @abstractmethod
    def start(self, n_envs: int) -> None:
        """
        Forget everything.

        :param n_envs: number of environments that are stepped side by side from here on, N
        """

    @abstractmethod
    def act(self, observations: Observations, starts: np.ndarray) -> np.ndarray:
        r"""
        :param observations: of all environments, (N, ...) of each entry, others than the policy's as well
        :param starts: where an episode starts, shape (N,)
        :return: actions, shape (N, \*action shape)
        """


class ModelPolicy(EvaluatedPolicy):
    """
    :param predict: a model's ``predict`` or ``predict_guider``
    :param entries: that it reads, with their shapes
    :param normalize: what ``VecNormalize`` does to observations, ``None`` if the model was trained without
    """

    def __init__(self, predict: Callable[..., Any], entries: Shapes, normalize: Callable[[Any], Any] | None):
        super().__init__(entries)
        self._predict, self._normalize = predict, normalize
        self._state: Any = None

    def start(self, n_envs: int) -> None:
        """See :meth:`EvaluatedPolicy.start`."""
        self._state = None

    def act(self, observations: Observations, starts: np.ndarray) -> np.ndarray:
        """See :meth:`EvaluatedPolicy.act`."""
        if self._normalize is not None:
            observations = self._normalize(dict(observations))
        seen = {key: observations[key] for key in self.entries}
        actions, self._state = self._predict(seen, self._state, starts, deterministic=True)
        return np.asarray(actions)


class ExportedPolicy(EvaluatedPolicy):
    """
    A file of :func:`sb3_gac.export_learner`, run once for each environment, as on as many robots.

    :param metadata: that the file has
    :param load: makes what acts on single observations, with ``act`` and ``reset``
    """

    def __init__(self, metadata: Mapping[str, Any], load: Callable[[], Any]):
        super().__init__({entry["name"]: tuple(entry["shape"]) for entry in metadata["entries"]})
        self._load = load
        self._runners: Sequence[Any] = ()

    def start(self, n_envs: int) -> None:
        """See :meth:`EvaluatedPolicy.start`."""
        self._runners = [self._load() for _ in range(n_envs)]

    def act(self, observations: Observations, starts: np.ndarray) -> np.ndarray:
        """See :meth:`EvaluatedPolicy.act`."""
        actions = []
        for number, runner in enumerate(self._runners):
            if starts[number]:
                runner.reset()
            actions.append(runner.act({key: observations[key][number] for key in self.entries}))
        return np.stack(actions)


class TorchScriptRunner:
    """
    An exported ``.pt`` file, used as :class:`sb3_gac.learner.OnnxPolicy` is.

    :param module: that the file holds
    :param metadata: that the file has
    """

    def __init__(self, module: Callable[..., Any], metadata: Mapping[str, Any]):
        self._module, self._metadata = module, metadata
        self.reset()

    def reset(self) -> None:
        """An episode starts."""
        memory = self._metadata["memory"]
        self._state = [] if memory is None else [th.full((1, memory["size"]), memory["initial"])]

    @th.no_grad()
    def act(self, observation: Observations) -> np.ndarray:
        """
        :param observation: a single one of each entry
        :return: the action for it
        """
        entries = [np.asarray(observation[entry["name"]], entry["dtype"])[None] for entry in self._metadata["entries"]]
        result = self._module(*map(th.as_tensor, entries), *self._state)
        if self._state:
            result, self._state[0] = result
        action: np.ndarray = result.numpy()[0]
        return action


def load_exported(path: Path) -> ExportedPolicy:
    """
    :param path: of a file that :func:`sb3_gac.export_learner` wrote
    :raises ValueError: if it is another file
    :raises ImportError: if it is for ONNX, and onnxruntime is not installed
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
    :param model: whose deployed policy is meant
    :param normalize: see :class:`ModelPolicy`
    """
    return ModelPolicy(model.predict, _shapes(model, [model.policy.roles.deployed]), normalize)


def guider_of(model: Any, normalize: Callable[[Any], Any] | None = None) -> ModelPolicy:
    """
    :param model: whose guider is meant, the policy that sees what is privileged
    :param normalize: see :class:`ModelPolicy`
    :raises ValueError: if its algorithm has none
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


def normalizer_of(model: AsymmetricAlgorithm, statistics: Path | None, env: Any) -> Callable[[Any], Any] | None:
    """
    :param model: which says whether it learned from normalised observations
    :param statistics: file that ``VecNormalize.save`` wrote
    :param env: that the observations come from
    :return: what ``VecNormalize`` did in training to a batch of observations, ``None`` if the model was trained without
    :raises ValueError: if there is a file for a model that was trained without, or none for one that was trained with it
    """
    if not model.trained_normalised:
        if statistics is not None:
            raise ValueError("--vec-normalize: the model was trained without VecNormalize, or on observations as they are.")
        return None
    if statistics is None:
        raise ValueError(
            "The model learned from observations that VecNormalize normalised: pass --vec-normalize with the file that "
            "VecNormalize.save wrote."
        )
    if not statistics.exists():
        raise FileNotFoundError(f"--vec-normalize: there is no file {statistics}.")
    normalize: Callable[[Any], Any] = VecNormalize.load(str(statistics), DummyVecEnv([lambda: env])).normalize_obs
    return normalize
