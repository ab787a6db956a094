"""
The deployed policy on the robot: an exported ONNX file and its actions, with numpy and onnxruntime alone::

    from sb3_gac.learner import OnnxPolicy

    learner = OnnxPolicy.load("cheetah.onnx")
    action = learner.act(partial)
"""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

try:
    import onnxruntime
except ImportError as error:
    raise ImportError(
        "sb3_gac.learner needs onnxruntime: pip install onnxruntime on the robot; elsewhere the extra sb3_gac[export] has it: "
        'pip install -e ".[export]" in the clone of sb3_gac.'
    ) from error

METADATA_KEY = "sb3_gac"
_READERS = {  # suffix of another kind of file -> advice on how to read it
    ".pt": 'torch.jit.load("{}") reads TorchScript; for OnnxPolicy, export_learner(model, "<name>.onnx") writes ONNX.',
    ".zip": 'GAC.load("{}") reads a saved model; export_learner(model, "<name>.onnx") then writes ONNX.',
}


class OnnxPolicy:
    """
    A policy in an ONNX file of :func:`sb3_gac.deploy.export.export_learner`; it acts deterministically.

    :param session: onnxruntime's session of the file
    """

    def __init__(self, session: onnxruntime.InferenceSession):
        self._session = session
        self.metadata: dict[str, Any] = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
        entries = self.metadata["entries"]
        self._channels_first = {entry["name"] for entry in entries if entry.get("layout") == "channels first"}
        self._entries = {entry["name"]: (np.dtype(entry["dtype"]), tuple(entry["shape"])) for entry in entries}
        self._counted = {entry["name"]: (entry["smallest"], entry["largest"]) for entry in entries if "largest" in entry}
        self._normalised = set(self.metadata["normalised"])
        self._memory: dict[str, Any] | None = self.metadata["memory"]
        self._state: np.ndarray | None = None

    @classmethod
    def load(cls, path: str | Path) -> "OnnxPolicy":
        """
        Load the policy in a file.

        :param path: file that :func:`sb3_gac.deploy.export.export_learner` wrote
        :return: policy in the file, with an empty memory
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if it is another file, such as one for TorchScript, or a saved model
        """
        path = Path(path)
        if not path.exists():
            with_suffix = path.with_name(f"{path.name}.onnx")
            hint = f" There is {with_suffix}." if with_suffix.exists() else ""
            raise FileNotFoundError(f"There is no file {path}: sb3_gac.export_learner writes one.{hint}")
        if path.suffix in _READERS:
            raise ValueError(f"{path} is no ONNX file: {_READERS[path.suffix].format(path)}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # small networks: waking other threads takes longer than their work
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ValueError(f"{path} is not an ONNX file that onnxruntime can read: {error}") from error
        if METADATA_KEY not in session.get_modelmeta().custom_metadata_map:
            raise ValueError(f"{path} was not written by sb3_gac.export_learner: it has no description of its inputs.")
        return cls(session)

    def reset(self) -> None:
        """Forget everything: a new episode starts. Only policies with a memory need it."""
        self._state = None

    def act(self, observation: np.ndarray | Mapping[str, np.ndarray]) -> np.ndarray:
        """
        Choose the deterministic action for an observation.

        :param observation: entry -> its values as the sensors give them, single or batched; the array alone, if the policy
            reads one entry. Images may have their channels last, as cameras give them, or first, as the policy has them
        :return: action in the environment's range; for batched observations, one for each
        :raises ValueError: if an entry is missing, not one of the policy's, of another shape or type, not finite, or, where it
            is discrete, out of range; if the number of observations changes within an episode, or no finite action follows
        """
        inputs, n_rows = self._checked(observation)
        if n_rows is None:
            inputs = {name: value[None] for name, value in inputs.items()}
        state = None
        if self._memory is None:
            (action,) = self._session.run(None, inputs)
        else:
            inputs[self._memory["input"]] = self._remembered(1 if n_rows is None else n_rows)
            action, state = self._session.run(None, inputs)
        if not np.isfinite(action).all():
            largest = {name: float(np.abs(value).max()) for name, value in inputs.items() if name in self._entries}
            raise ValueError(f"The policy has no finite action for so large values: the largest of each entry are {largest}.")
        self._state = state
        return action[0] if n_rows is None else action

    def _remembered(self, n_rows: int) -> np.ndarray:
        assert self._memory is not None
        if self._state is None:
            return np.full((n_rows, self._memory["size"]), self._memory["initial"], dtype=np.float32)
        if len(self._state) != n_rows:
            raise ValueError(
                f"The policy remembers {len(self._state)} observations, but got {n_rows}: call reset() when an episode starts."
            )
        return self._state

    def _checked(self, observation: np.ndarray | Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int | None]:
        """The policy's entries as arrays, and the number of rows in each; ``None`` if they are not batched."""
        if not isinstance(observation, Mapping):
            if len(self._entries) > 1:
                raise ValueError(f"The policy reads {list(self._entries)}: pass a dict with these entries, not an array.")
            observation = {next(iter(self._entries)): observation}
        if observation.keys() != self._entries.keys():
            missing = [key for key in self._entries if key not in observation]
            unread = [key for key in observation if key not in self._entries]
            raise ValueError(
                f"The policy reads the entries {list(self._entries)}; missing: {missing}, not read: {unread}. "
                "Nothing else belongs on the robot."
            )
        entries = {name: self._checked_entry(name, observation[name]) for name in self._entries}
        n_rows = {name: len(array) if array.ndim > len(self._entries[name][1]) else None for name, array in entries.items()}
        first, *others = n_rows.values()
        if any(other != first for other in others):
            raise ValueError(f"The entries must be single, or batched alike, but their rows are {n_rows}.")
        return entries, first

    def _checked_entry(self, name: str, value: Any) -> np.ndarray:
        dtype, shape = self._entries[name]
        try:
            array = np.asarray(value)
        except Exception as error:  # lists of different lengths, or whatever objects say that are no arrays
            raise ValueError(f'The entry "{name}" is no array of numbers: {error}') from None
        if array.dtype != dtype:
            is_whole = dtype.kind in "iu" and array.dtype.kind in "iu"  # of either sign, if it holds the values
            if not (is_whole or np.can_cast(array.dtype, dtype, "same_kind")):
                raise ValueError(f'The entry "{name}" must be of type {dtype}, but is {array.dtype}: values would be lost.')
            with np.errstate(over="ignore"):  # what becomes infinite is refused below
                given, array = array, array.astype(dtype)
            if dtype.kind != "f" and not np.array_equal(given, array):
                raise ValueError(f'The entry "{name}" holds values that its type {dtype} can\'t hold.')
        if name in self._channels_first:
            array = _with_channels_first(array, shape)
        n_leading = array.ndim - len(shape)
        if array.shape[n_leading:] != shape or n_leading not in (0, 1):
            raise ValueError(f'The entry "{name}" must have the shape {shape}, or (B, ...) of it, but has {array.shape}.')
        if not self._is_computable(name, array):
            raise ValueError(
                f'The entry "{name}" holds NaN or infinite values, or values beyond float32: no action can follow from it.'
            )
        if name in self._counted:
            smallest, largest = self._counted[name]
            if not ((array >= smallest) & (array <= largest)).all():
                raise ValueError(
                    f'The entry "{name}" holds values that are not from {smallest} to {largest}: {array.tolist()}.'
                )
        return array

    def _is_computable(self, name: str, array: np.ndarray) -> bool:
        """Whether all values are finite as the policy computes with them: in float32, unless they are normalised before."""
        if array.dtype.kind == "f" and name not in self._normalised:
            with np.errstate(over="ignore"):
                array = array.astype(np.float32, copy=False)
        return bool(np.isfinite(array).all())


def _with_channels_first(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """
    Move an image's channels to the front, as SB3's ``predict`` does.

    :param array: one image or several, with channels first or last, or anything else
    :param shape: shape that an image must have, channels first
    :return: the array with channels first, if they were last; otherwise the array as it was
    """
    is_channels_last = array.shape[-3:] == (*shape[1:], shape[0]) and array.shape[-3:] != shape
    return np.moveaxis(array, -1, -3) if is_channels_last else array


def __getattr__(name: str) -> Any:
    if name != "Learner":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn("sb3_gac.learner.Learner is OnnxPolicy now.", DeprecationWarning, stacklevel=2)
    return OnnxPolicy
