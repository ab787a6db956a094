"""
Observation entries: the spaces that they may have, the rows that they come in, and the numbers that encoders get.

All code that depends on the kind of an entry's space (Box, Discrete, MultiDiscrete or MultiBinary) is here, except for the
range of its values, :func:`sb3_gac.checks.spaces.index_bounds`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape, is_image_space
from stable_baselines3.common.vec_env import VecTransposeImage

from sb3_gac.checks.spaces import held_by, index_bounds, is_finite

#: Types that torch computes little with -> types that hold all their values (those of uint64 rounded, as for networks anyway)
COMPUTABLE = {"uint16": "int32", "uint32": "int64", "uint64": "float64"}
FLOAT32 = np.dtype(np.float32)
SUPPORTED = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
#: Kinds of spaces that are not supported -> remedy
REMEDIES: dict[type[spaces.Space], str] = {
    spaces.Text: "Encode it as numbers: as Discrete if it is one of several texts, as MultiDiscrete if not.",
    spaces.Sequence: "Pad it to a Box of its largest length.",
    spaces.Graph: "Pad nodes and edges to a Box each, of their largest numbers.",
    spaces.Tuple: "Make each of its parts an entry of the observation.",
    spaces.Dict: "Make each of its parts an entry of the observation.",
    spaces.OneOf: "Make each of its choices an entry of the observation, and a Discrete one that says which of them counts.",
}


class UnsupportedObservationError(NotImplementedError, ValueError):
    """An observation entry can't be learned from. SB3 raises NotImplementedError for nested spaces, so this is one as well."""


# --- spaces -------------------------------------------------------------------------------------------------------------


def check_entries(space: spaces.Space) -> None:
    """
    Check that observation entries can be learned from.

    :param space: observation space of an environment; one that is no Dict is not checked
    :raises UnsupportedObservationError: naming the first entry that can't be learned from, and the remedy
    """
    if not isinstance(space, spaces.Dict):
        return
    for key, entry in space.spaces.items():
        if not isinstance(key, str) or not key:
            raise UnsupportedObservationError(
                f"The observation has an entry named {key!r}: name it by a string that is not empty."
            )
        fault = _unsupported(entry)
        if fault is not None:
            raise UnsupportedObservationError(f"The observation's entry \"{key}\" can't be learned from: {fault}")


def _unsupported(space: spaces.Space) -> str | None:
    """The fault of an entry's space and its remedy, in words; ``None`` if there is no fault."""
    if not isinstance(space, SUPPORTED):
        remedies = [remedy for kind, remedy in REMEDIES.items() if isinstance(space, kind)]
        remedy = remedies[0] if remedies else "Make it a Box, Discrete, MultiDiscrete or MultiBinary."
        return f"its space is {type(space).__name__}. {remedy}"
    if 0 in space.shape:  # type: ignore[operator]
        return f"its shape is {space.shape}, so that it holds no number. Leave it out."
    if np.dtype(space.dtype).itemsize > 8:
        return f"its type is {space.dtype}, which torch lacks. Make it float64 or float32."
    return None


def check_held_by(buffer_class: type[ReplayBuffer] | None, space: spaces.Dict, own: type[ReplayBuffer]) -> None:
    """
    Check that a replay buffer can hold the observation's entries.

    :param buffer_class: value of the argument ``replay_buffer_class``; ``None`` for a class of this package
    :param space: observation space of the environment
    :param own: base class of this package's buffers, which hold every supported entry
    :raises ValueError: naming the first entry that SB3's buffers can't hold
    """
    if buffer_class is not None and not issubclass(buffer_class, own):
        name = f"replay_buffer_class={buffer_class.__name__}"
        check_held_by_sb3(name, space, "leave replay_buffer_class out, or make the entry one-dimensional in the environment")


def check_held_by_sb3(buffer: str, space: spaces.Dict, remedy: str) -> None:
    """
    Check that a buffer of SB3's can hold the observation's entries.

    :param buffer: name of the buffer, for the message
    :param space: observation space of the environment
    :param remedy: text that says what to do instead
    :raises ValueError: naming the first entry that SB3's buffers can't hold
    """
    for key, entry in space.spaces.items():
        if (entry.shape == () and isinstance(entry, spaces.Box)) or get_obs_shape(entry) != stored_shape(entry):
            raise ValueError(f"{buffer} can't hold the observation's entry \"{key}\" of shape {entry.shape}: {remedy}.")


def stored_shape(space: spaces.Space) -> tuple[int, ...]:
    """
    The shape that replay buffers give to an entry.

    :param space: space of the entry
    :return: shape of one value
    """
    return (1,) if isinstance(space, spaces.Discrete) else space.shape  # type: ignore[return-value]


# --- encoding -----------------------------------------------------------------------------------------------------------


def encoded_size(space: spaces.Space) -> int:
    """
    The size of an encoded entry.

    :param space: space of the entry
    :return: number of numbers in one value that :func:`encode` returns
    """
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    return int(space.nvec.sum()) if isinstance(space, spaces.MultiDiscrete) else int(np.prod(stored_shape(space)))


def encode(values: th.Tensor, space: spaces.Space, normalize_images: bool) -> th.Tensor:
    """
    Encode an entry as SB3's ``preprocess_obs`` does; discrete values may also count from any number and have any shape.

    :param values: values of the entry, shape (B, ...)
    :param space: space of the entry
    :param normalize_images: whether to divide images by 255
    :return: float32: Box and MultiBinary in their own shape, or (B, 1) if that is (); Discrete and MultiDiscrete one-hot,
        shape (B, F)
    """
    choices = _choices(space)
    if choices:
        columns = [values.reshape(-1)] if isinstance(space, spaces.Discrete) else values.flatten(1).unbind(1)
        return th.cat([_one_hot(column, n, start) for column, (n, start) in zip(columns, choices, strict=True)], dim=-1)
    if space.shape == ():
        return values.float().unsqueeze(-1)
    return (values / 255.0).float() if normalize_images and _is_image(space) else values.float()


@th.compiler.assume_constant_result
def _choices(space: spaces.Space) -> list[tuple[int, int]]:
    """Number of choices, and the first choice, of each number in the space; constants for a compiled program."""
    if isinstance(space, spaces.Discrete):
        return [(int(space.n), int(space.start))]
    if isinstance(space, spaces.MultiDiscrete):
        return list(zip(space.nvec.ravel().tolist(), space.start.ravel().tolist(), strict=True))
    return []


@th.compiler.assume_constant_result
def _is_image(space: spaces.Space) -> bool:
    return is_image_space(space)


def leading_dimensions(values: th.Tensor, space: spaces.Space) -> int:
    """
    The number of leading dimensions of an entry's values.

    :param values: values of the entry, shape (B, ...), or (T, B, ...) for sequences
    :param space: space of the entry
    :return: 1, or 2 for sequences
    """
    if isinstance(space, spaces.Discrete):  # shape (B,) where a policy acts, (B, 1) or (T, B, 1) from buffers
        return max(values.dim() - 1, 1)
    return values.dim() - len(space.shape)  # type: ignore[arg-type]


def _one_hot(values: th.Tensor, n: int, start: int) -> th.Tensor:
    """One-hot vectors, shape (B, n); zeros for values that are none of the choices, such as the padding of a sequence."""
    return (values.long().unsqueeze(-1) == th.arange(start, start + n, device=values.device)).float()


def computable(array: np.ndarray) -> np.ndarray:
    """
    Convert an array to a type that torch computes with.

    :param array: array of any type that an entry may have
    :return: array of the same values, or the same array
    """
    return array.astype(COMPUTABLE[array.dtype.name]) if array.dtype.name in COMPUTABLE else array


# --- what users hand over -----------------------------------------------------------------------------------------------


class EntryReader:
    """
    Reads an entry in any form that ``predict`` may be given, or says what is wrong with it.

    :param key: name of the entry
    :param space: space of the entry
    """

    def __init__(self, key: str, space: spaces.Space):
        self.key, self.space = key, space
        self.shape: tuple[int, ...] = space.shape  # type: ignore[assignment]
        self.dtype = np.dtype(space.dtype)
        self.bounds = index_bounds(space)
        self.is_image = is_image_space(space)

    def read(self, value: Any) -> tuple[np.ndarray, int | None]:
        """
        Read one value of the entry or a batch.

        :param value: value, or B of them, as an array, a tensor, a list or a number; images in either layout
        :return: copy of shape (B, \\*entry shape), and B, or ``None`` in its place for one value by itself
        :raises ValueError: naming the entry, if the value's type or shape does not fit the space, or the value is not in it
        """
        array = self._with_layout(self._as_array(value))
        if array.dtype != self.dtype or self.dtype.kind == "f":
            array = self._as_declared(array)
        if self.bounds is not None:
            inside = (array >= self.bounds[0]) & (array <= self.bounds[1])
            if not inside.all():
                raise self._fault(f"holds {array[~inside][0]}, which is not in {self.space}")
        return (array[None], None) if array.shape == self.shape else (array, len(array))

    def _as_array(self, value: Any) -> np.ndarray:
        if isinstance(value, th.Tensor):
            value = value.detach().cpu().numpy()
        try:
            array = np.array(value)
        except ValueError:  # nested lists of different lengths
            raise self._fault(f"is not an array: {value!r:.80}") from None
        if array.dtype.kind not in "biuf":
            raise self._fault(f"is of type {type(value).__name__}, expected numbers of type {self.dtype}")
        if array.dtype.itemsize > 8 or not array.dtype.isnative:  # torch knows neither
            array = array.astype(np.float64 if array.dtype.itemsize > 8 else array.dtype.newbyteorder("="))
        return array

    def _with_layout(self, array: np.ndarray) -> np.ndarray:
        """The array with an image's channels on the axis where the space has them."""
        if array.shape == self.shape or (array.shape[1:] == self.shape and array.ndim):
            return array
        if self.is_image and array.ndim in (3, 4):
            transposed = VecTransposeImage.transpose_image(array)
            if self.shape in (transposed.shape, transposed.shape[1:]):
                return transposed
        raise self._fault(f"has shape {array.shape}, expected {self.shape}, or (B, ...) of it")

    def _as_declared(self, array: np.ndarray) -> np.ndarray:
        """
        The array in the declared type.

        Floats of a Box stay as they are, whatever its type: networks take all of them, and normalised integers are floats.
        """
        if array.dtype.kind == "f" and not is_finite(array, array.dtype):
            raise self._fault("holds NaN or infinite values: no action can follow from it")
        if self.is_image and array.dtype.kind in "fb":
            raise self._fault(
                f"is an image of type {array.dtype}, expected bytes from 0 to 255, as in training. "
                "Pass (image * 255).astype(np.uint8) if its values are from 0 to 1"
            )
        if self.dtype.kind == "f" or (array.dtype.kind == "f" and self.bounds is None):
            if array.dtype.kind == "f" and not is_finite(array, FLOAT32):
                raise self._fault("holds values that float32 can't hold")
            return array
        if not held_by(self.dtype, array):
            raise self._fault(f"has type {array.dtype} and values that the expected {self.dtype} can't hold")
        return array.astype(self.dtype)

    def _fault(self, what: str) -> ValueError:
        return ValueError(f'The observation\'s entry "{self.key}" {what}.')


class ObservationReader:
    """
    Reads observations in any form that ``predict`` may be given.

    :param space: space of the entries to read
    """

    def __init__(self, space: spaces.Dict):
        self.entries = [EntryReader(key, entry) for key, entry in space.spaces.items()]

    def read(self, observation: Mapping[str, Any], device: th.device) -> tuple[dict[str, th.Tensor], bool]:
        """
        Read one observation or a batch.

        :param observation: entry -> one value, or B values; entries that are not in the space are left out
        :param device: device of the tensors
        :return: entry -> tensor of shape (B, ...), for the entries of the space that are there, and whether the observation
            was a batch
        :raises ValueError: naming the entry that does not fit its space, or whose batch size differs from the others'
        """
        tensors, counts = {}, {}
        for entry in self.entries:
            if entry.key in observation:
                rows, counts[entry.key] = entry.read(observation[entry.key])
                tensors[entry.key] = th.as_tensor(computable(rows), device=device)
        numbers = set(counts.values())
        if len(numbers) > 1:
            said = ", ".join(f'"{key}" {"one by itself" if n is None else f"a batch of {n}"}' for key, n in counts.items())
            raise ValueError(
                f"The observation's entries must each be one by itself, or batches of the same size, but {said}. "
                "A batch has one dimension more than the entry's space."
            )
        return tensors, None not in numbers


def check_is_observation(observation: Any) -> None:
    """
    Check that an observation is not the pair that a gymnasium environment's ``reset()`` returns.

    :param observation: argument that was passed as the observation
    :raises ValueError: if it is that pair
    """
    if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
        raise ValueError(
            "predict() was given the pair (observation, info) that reset() of a gymnasium environment returns: pass it the "
            "observation alone, as in: observation, info = env.reset()."
        )
