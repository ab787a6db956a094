"""Checkpoints of all that training depends on, from which another process goes on as if there had been no interruption."""

import io
import json
import random
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_gac.base.arguments import present_names
from sb3_gac.base.loadable import networks_named
from sb3_gac.base.overrides import SETTINGS, check_names, check_unchanged
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checkpoint.files import CheckpointError, checksum, latest_whole, write_checkpoint
from sb3_gac.checkpoint.serialization import UntrustedNameError, decode, encode
from sb3_gac.checkpoint.vec_env import restore_vec_env_state, vec_env_state
from sb3_gac.checks.arguments import KEPT_AS, constructor_arguments
from sb3_gac.checks.values import plain

#: Parts of a checkpoint's state that are encoded as JSON and arrays
STATES = ("progress", "training_state", "generators", "env", "buffer")
_STATE, _ARRAYS, _TENSORS = "state.json", "arrays.npz", "tensors.pt"


class ResumableAlgorithm(BaseAlgorithm):
    """
    Adds :meth:`save_checkpoint` and :meth:`resume` to an algorithm.

    Files hold JSON, plain arrays and tensors: loading them executes nothing.
    """

    #: Attributes that training changes, besides networks, coefficients and the replay or rollout buffer
    progress: ClassVar[tuple[str, ...]] = (
        "num_timesteps",
        "_total_timesteps",
        "_num_timesteps_at_start",
        "_n_updates",
        "_last_metrics",
        "_current_progress_remaining",
        "_last_obs",
        "_last_episode_starts",
        "_behaviour_state",
        "acting",
        "_returns_so_far",
        "_has_warmed_up",
        "ep_info_buffer",
        "ep_success_buffer",
        "strict_deployment",
        "trained_normalised",
        "normalised_entries",
        "normalised_scales",
        "_compiles_on_auto",
    )
    #: Arguments that ``resume`` can't change, because the checkpoint's networks and data were made with them
    fixed_arguments: ClassVar[tuple[str, ...]] = ("policy", "policy_kwargs")
    restored_arguments: ClassVar[tuple[str, ...]]
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    policy: AsymmetricPolicy
    _change_arguments: Callable[[dict[str, Any]], None]
    follow_arguments: Callable[[], None]
    note_use: Callable[[], None]
    used_elsewhere: Callable[[VecEnv], bool]
    #: Raises a TypeError if no checkpoint can hold the training data
    check_data_can_be_saved: Callable[[], None]
    #: Function of the folder of all checkpoints: writes blocks of training data there, and returns the rest of the data and
    #: the names of all blocks
    save_data: Callable[[Path], tuple[dict[str, Any], list[str]]]
    #: Function of that folder and of the data that ``save_data`` returned: restores the training data
    restore_data: Callable[[Path, dict[str, Any]], None]
    #: After :meth:`resume`, the notes that :meth:`save_checkpoint` was given
    resumed_notes: Any = None

    _resumed: bool

    #: Callbacks for the end of ``learn``, also for an end by an error
    learn_scope: ExitStack

    @property
    def steps_left(self) -> int:
        """Number of environment steps that the last ``learn`` has left, as argument of ``learn`` after :meth:`resume`."""
        return max(self._total_timesteps - self.num_timesteps, 0)

    # --- saving -----------------------------------------------------------------------------------------------------

    def save_checkpoint(self, directory: str | Path, keep: int = 2, notes: Any = None) -> Path:
        """
        Write a checkpoint of all that training depends on, from which :meth:`resume` goes on in another process.

        Call this method between two rounds of training: after ``learn``, or in a callback when a rollout starts, as
        :class:`sb3_gac.ExactCheckpointCallback` does. Of the replay buffer, only changed rows are written.

        :param directory: folder of all checkpoints of this run
        :param keep: number of checkpoints to keep, the latest ones
        :param notes: further data to keep in the checkpoint, see :attr:`resumed_notes`: anything that JSON can hold, and
            numbers and arrays of numpy and torch
        :return: folder of this checkpoint
        :raises OSError: if the checkpoint can't be written; the checkpoints before it are as they were
        :raises TypeError: if the replay buffer can't be written, because it is missing or of another class than this
            package's, or if JSON can't hold the notes
        :raises ValueError: naming an argument that was set on the model and can't take effect
        """
        self.follow_arguments()
        as_notes = encode_notes(notes)  # before anything is written
        root = Path(directory).absolute()
        data, blocks = self.save_data(root)
        arrays: dict[str, np.ndarray] = {}
        state = {
            "algorithm": _qualified_name(type(self)),
            "arguments": self._encoded_arguments(arrays),
            "spaces": _describe_spaces(self.observation_space, self.action_space),
            "n_envs": self.n_envs,
            "progress": encode({name: getattr(self, name) for name in self.progress}, arrays),
            "training_state": encode(self.training_state(), arrays),
            "generators": encode(self._generator_states(), arrays),
            "env": encode(None if self.env is None else vec_env_state(self.env), arrays),
            "used_elsewhere": self.env is not None and self.used_elsewhere(self.env),
            "buffer": encode(data, arrays),
            "notes": json.loads(as_notes),
        }
        files = {
            _STATE: json.dumps(state).encode(),
            _ARRAYS: _in_memory(lambda file: np.savez(file, **arrays)),  # type: ignore[arg-type]
            _TENSORS: _in_memory(lambda file: th.save(self._tensors(), file)),
        }
        return write_checkpoint(root, self.num_timesteps, files, blocks, keep)

    def _encoded_arguments(self, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
        """Name of each constructor argument -> its encoded value, or the reason why no file can hold the value."""
        arguments: dict[str, Any] = {}
        for name in constructor_arguments(type(self)):
            try:
                value = getattr(self, KEPT_AS.get(name, name))
                if isinstance(value, BaseAlgorithm):
                    raise UntrustedNameError("it is a model, and not the path of one")
                if isinstance(value, TrainFreq):
                    value = (value.frequency, value.unit.value)
                if name == "policy":  # by its alias, if it has one: the class may be the user's own
                    value = next((alias for alias, kind in self.policy_aliases.items() if kind is value), value)
                arguments[name] = {"value": encode(value, arrays)}
            except (UntrustedNameError, AttributeError, TypeError) as error:
                arguments[name] = {"cannot": str(error)}
        return arguments

    def _generator_states(self) -> dict[str, Any]:
        return {
            "torch": th.get_rng_state().numpy(),
            "cuda": [state.numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else [],
            "numpy": np.random.get_state(),
            "python": random.getstate(),
            "action_space": self.action_space.np_random,
        }

    def _tensors(self) -> dict[str, Any]:
        """The states of networks, optimisers and coefficients."""
        _, names = self._get_torch_save_params()
        free = {name: recursive_getattr(self, name).detach() for name in names}
        return {"parameters": self.get_parameters(), "free": free}

    def training_state(self) -> dict[str, Any]:
        """
        Attributes that an algorithm's own hooks change, by name, for checkpoints; :meth:`resume` sets them.

        Values are numbers, strings, arrays, and lists, dicts and deques of such.
        """
        return {}

    # --- resuming ---------------------------------------------------------------------------------------------------

    @classmethod
    def resume(cls, directory: str | Path, env: GymEnv, device: th.device | str = "auto", **given: Any) -> Self:
        """
        Go on from the latest checkpoint that is whole; a warning names later ones that are incomplete or altered.

        The next ``learn(model.steps_left, reset_num_timesteps=False)`` does what the interrupted ``learn`` would have done.
        The two agree to the bit if the state of the environments can be restored. If it can't, a warning says why, and new
        episodes start.

        :param directory: folder of all checkpoints of the run, which :meth:`save_checkpoint` was given
        :param env: environments made like those before
        :param device: device of the networks, which may be another one than before
        :param given: arguments of the constructor in place of those before, and ``strict_deployment``; arguments that no
            file can hold, such as functions and classes of your own, must be among them
        :return: the model as it was at the checkpoint
        :raises CheckpointError: if no checkpoint is whole, or the latest one is another algorithm's
        :raises TypeError: naming what is no argument
        :raises ValueError: naming an argument that is missing or can't be changed, or an entry whose space has changed
        """
        root = Path(directory).absolute()
        path, files = latest_whole(root)
        state = json.loads(files[_STATE])
        if state["algorithm"] != _qualified_name(cls):
            raise CheckpointError(f"{path} is of {state['algorithm']}: resume it with that class, not {cls.__name__}.")
        with np.load(io.BytesIO(files[_ARRAYS]), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        given = present_names(cls, given, "resume()")
        check_names(cls, given, "resume()")
        settings = {name: given.pop(name) for name in SETTINGS if name in given}
        later = {name: given.pop(name) for name in cls.restored_arguments if name in given}
        before = _decoded_arguments(present_names(cls, state["arguments"], None), given, arrays)
        model = cls(env=env, device=device, **before | given)
        model._check_same_spaces(state)
        model.check_fixed_arguments(given, before)
        tensors = th.load(io.BytesIO(files[_TENSORS]), map_location=model.device, weights_only=True)
        with networks_named(path, list(given)):
            model._restore(root, tensors, {name: decode(state[name], arrays) for name in STATES if name in state})
        if not state.get("used_elsewhere", False):
            model.note_use()
        if model.seed is not None and model.seed != before.get("seed"):
            model.set_random_seed(model.seed)
        vars(model).update(settings)
        model._change_arguments(later)
        model.resumed_notes, model._resumed = state["notes"], True
        return model

    def check_fixed_arguments(self, given: dict[str, Any], before: dict[str, Any]) -> None:
        """
        Check that given arguments do not differ from those that the checkpoint's networks and buffer were made with.

        :param given: name -> argument that :meth:`resume` was given
        :param before: name -> argument in the checkpoint
        :raises ValueError: naming the argument that can't be changed
        """
        for name in self.fixed_arguments:
            if name in given and name in before:
                then = self.policy_aliases.get(before[name], before[name]) if name == "policy" else before[name]
                check_unchanged(name, getattr(self, KEPT_AS.get(name, name)), then, "resume()")

    def _check_same_spaces(self, state: dict[str, Any]) -> None:
        now = _describe_spaces(self.observation_space, self.action_space)
        for name in sorted({*now, *state["spaces"]}):
            before, after = state["spaces"].get(name, "missing"), now.get(name, "missing")
            if before != after:
                raise ValueError(f"env differs from the checkpoint's in {name}: it is {after}, and was {before}.")
        if state["n_envs"] != self.n_envs:
            raise ValueError(f"env must be {state['n_envs']} environments, as before, but it is {self.n_envs}.")

    def _restore(self, root: Path, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        self.set_parameters(tensors["parameters"], exact_match=True, device=self.device)
        self.policy.freeze_as_saved()
        for name, value in tensors["free"].items():
            recursive_setattr(self, f"{name}.data", value.data)
        for name, value in (state["progress"] | state.get("training_state", {})).items():
            setattr(self, name, value)
        self.restore_data(root, state["buffer"])
        self._restore_env(state["env"], state["generators"])
        self._restore_generators(state["generators"])

    def _restore_env(self, state: dict[str, Any] | None, generators: dict[str, Any]) -> None:
        assert self.env is not None
        why = "there was none" if state is None else restore_vec_env_state(self.env, state)
        if why:
            warnings.warn(f"Starting new episodes: the environments cannot be restored ({why}).", stacklevel=4)
            self._last_obs = None
            self.env.seed(int(generators["numpy"][1][0]) % 2**31)  # the same seed for the same checkpoint

    def _restore_generators(self, states: dict[str, Any]) -> None:
        """Restore the random number generators, after all else, which may draw random numbers."""
        th.set_rng_state(th.from_numpy(states["torch"]))
        if th.cuda.is_available() and len(states["cuda"]) == th.cuda.device_count():
            th.cuda.set_rng_state_all([th.from_numpy(state) for state in states["cuda"]])
        np.random.set_state(states["numpy"])
        random.setstate(states["python"])
        self.action_space._np_random = states["action_space"]

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """See SB3's ``learn``; the callbacks in :attr:`learn_scope` are called at the end."""
        with ExitStack() as self.learn_scope:
            return super().learn(*args, **kwargs)  # type: ignore[safe-super]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "resumed_notes", "learn_scope"]


def encode_notes(notes: Any) -> str:
    """
    Convert the notes of a checkpoint to JSON.

    :param notes: anything that JSON can hold, and numbers and arrays of numpy and torch
    :return: notes as JSON
    :raises TypeError: if JSON can't hold them
    """
    try:
        return json.dumps(plain(notes, arrays=True))
    except (TypeError, ValueError) as error:
        held = "what JSON can hold (numbers, strings, lists, dicts)"
        raise TypeError(f"notes must be {held}, got {notes!r}: {error}") from error


def _qualified_name(algorithm: type) -> str:
    return f"{algorithm.__module__}.{algorithm.__qualname__}"


def _in_memory(write: Any) -> bytes:
    """
    :param write: function that writes to an open file
    :return: content that it wrote
    """
    file = io.BytesIO()
    write(file)
    return file.getvalue()


def _decoded_arguments(stored: dict[str, Any], given: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """
    Decode the arguments that a checkpoint holds.

    :param stored: name -> encoded value, or the reason why the checkpoint can't hold it
    :param given: name -> argument that ``resume`` was given
    :param arrays: arrays of the checkpoint by name
    :return: name -> argument
    :raises ValueError: naming the arguments that are neither in the checkpoint nor given
    """
    missing = {name: entry["cannot"] for name, entry in stored.items() if "cannot" in entry and name not in given}
    if missing:
        reasons = "; ".join(f"{name} ({reason})" for name, reason in missing.items())
        raise ValueError(f"No checkpoint can hold these arguments, so pass them to resume() as before: {reasons}.")
    return {name: decode(entry["value"], arrays) for name, entry in stored.items() if "cannot" not in entry}


def _describe_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> dict[str, str]:
    """Name of each space -> description, which is the same for two spaces only if shape, type and bounds are the same."""
    assert isinstance(observation_space, spaces.Dict)
    entries = {f'the observation\'s entry "{key}"': space for key, space in observation_space.items()}
    return {name: _describe(space) for name, space in {**entries, "the actions": action_space}.items()}


def _describe(space: spaces.Space) -> str:
    if not isinstance(space, spaces.Box):
        return str(space)
    low, high = (np.array2string(bound, threshold=8) for bound in (space.low, space.high))
    all_bounds = checksum(space.low.tobytes() + space.high.tobytes())[:8]  # the text shows only the ends of a long array
    return f"Box of shape {space.shape}, {space.dtype}, within [{low}, {high}] ({all_bounds})".replace("\n", " ")
