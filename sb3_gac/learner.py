"""
The deployed policy on the robot: an exported ONNX file and its actions, with numpy and onnxruntime alone::

    from sb3_gac.learner import Learner

    learner = Learner.load("cheetah.onnx")
    action = learner.act(partial)
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

METADATA_KEY = "sb3_gac"


class Learner:
    """
    A policy that was written by :func:`sb3_gac.export.export_learner`; it acts deterministically.

    :param session: of onnxruntime
    """

    def __init__(self, session: onnxruntime.InferenceSession):
        self._session = session
        self.metadata: dict[str, Any] = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
        self._entries = {entry["name"]: entry for entry in self.metadata["entries"]}
        self._state: np.ndarray | None = None

    @classmethod
    def load(cls, path: str | Path) -> "Learner":
        """
        :param path: of a file that :func:`sb3_gac.export.export_learner` wrote
        :raises ValueError: if it is another file
        """
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # small networks: waking other threads takes longer than their work
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ValueError(f"{path} is not an ONNX file that onnxruntime can read: {error}") from error
        if METADATA_KEY not in session.get_modelmeta().custom_metadata_map:
            raise ValueError(f"{path} was not written by sb3_gac.export.export_learner: it has no description of its inputs.")
        return cls(session)

    def reset(self) -> None:
        """Forget everything: a new episode starts. Only policies with a memory need it."""
        self._state = None

    def act(self, observation: np.ndarray | Mapping[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: of the policy's entries, single or batched, as the sensors give it; where there is one, that alone
        :return: action in the environment's range
        :raises ValueError: if an entry is missing, not one of the policy's, of another shape, or not finite
        """
        entries = self._checked(observation)
        name, first = next(iter(entries.items()))
        batched = first.ndim > len(self._entries[name]["shape"])
        inputs = {key: value if batched else value[None] for key, value in entries.items()}
        size = self.metadata["state_size"]
        if size:
            n_rows = first.shape[0] if batched else 1
            if self._state is None or len(self._state) != n_rows:
                self._state = np.zeros((n_rows, size), dtype=np.float32)
            inputs["state"] = self._state
        action, *state = self._session.run(None, inputs)
        if size:
            self._state = state[0]
        return action if batched else action[0]

    def _checked(self, observation: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        if not isinstance(observation, Mapping):
            if len(self._entries) > 1:
                raise ValueError(f"The policy reads {list(self._entries)}: pass a dict with these entries, not an array.")
            observation = {next(iter(self._entries)): observation}
        if set(observation) != set(self._entries):
            raise ValueError(
                f"The policy reads the entries {list(self._entries)}, but the observation has {list(observation)}: "
                "nothing else belongs on the robot."
            )
        return {name: self._checked_entry(name, observation[name]) for name in self._entries}

    def _checked_entry(self, name: str, value: Any) -> np.ndarray:
        entry = self._entries[name]
        array, shape = np.asarray(value, dtype=entry["dtype"]), tuple(entry["shape"])
        if array.shape[array.ndim - len(shape) :] != shape or array.ndim - len(shape) not in (0, 1):
            raise ValueError(f'The entry "{name}" must have the shape {shape}, or (B, ...) of it, but has {array.shape}.')
        if not np.isfinite(array).all():
            raise ValueError(f'The entry "{name}" holds NaN or infinite values: no action can follow from it.')
        return array
