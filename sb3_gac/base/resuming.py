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
from sb3_gac.base.faults import networks_named
from sb3_gac.base.overrides import SETTINGS, check_names, check_unchanged
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checkpoint.files import CheckpointError, checksum, latest_whole, write_checkpoint
from sb3_gac.checkpoint.serialization import UntrustedNameError, decode, encode
from sb3_gac.checkpoint.vec_env import restore_vec_env_state, vec_env_state
from sb3_gac.checks.arguments import KEPT_AS, constructor_arguments

#: Of what a checkpoint holds, what is encoded
STATES = ("progress", "training_state", "generators", "env", "buffer")
_STATE, _ARRAYS, _TENSORS = "state.json", "arrays.npz", "tensors.pt"


class ResumableAlgorithm(BaseAlgorithm):
    """
    Adds :meth:`save_checkpoint` and :meth:`resume` to an algorithm.

    Files hold JSON, plain arrays and tensors: loading them executes nothing.
    """

    #: Attributes that training changes, besides networks, coefficients and what the data are held in
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
        "_compiles_on_auto",
    )
    #: Arguments that what a checkpoint holds was made with
    fixed_arguments: ClassVar[tuple[str, ...]] = ("policy", "policy_kwargs")
    restored_arguments: ClassVar[tuple[str, ...]]
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    policy: AsymmetricPolicy
    _change_arguments: Callable[[dict[str, Any]], None]
    note_use: Callable[[], None]
    used_elsewhere: Callable[[VecEnv], bool]
    #: Given the directory of all checkpoints: what is to be written of the data that training holds, and names of blocks
    #: that were written there
    save_data: Callable[[Path], tuple[dict[str, Any], list[str]]]
    #: Given that directory, and what ``save_data`` returned
    restore_data: Callable[[Path, dict[str, Any]], None]
    #: What :meth:`save_checkpoint` was given to keep, after :meth:`resume`
    resumed_notes: Any = None

    _resumed: bool

    #: What is to be called when ``learn`` ends, in whatever way
    learn_scope: ExitStack

    @property
    def steps_left(self) -> int:
        """Environment steps of the last ``learn`` that are still to come: what to pass to the next one after a resume."""
        return max(self._total_timesteps - self.num_timesteps, 0)

    # --- saving -----------------------------------------------------------------------------------------------------

    def save_checkpoint(self, directory: str | Path, keep: int = 2, notes: Any = None) -> Path:
        """
        Write down all that training depends on, where another process finds it with :meth:`resume`.

        To be called between two rounds of training: after ``learn``, or by a callback when a rollout starts, as
        :class:`sb3_gac.ExactCheckpointCallback` does. Of the replay buffer only what has changed is written.

        :param directory: folder with all checkpoints of this run
        :param keep: how many of the latest ones stay
        :param notes: what the caller wants kept with it, anything that JSON can hold, see :attr:`resumed_notes`
        :return: directory of this checkpoint
        :raises OSError: if it can't be written; the checkpoints before it are as they were
        :raises TypeError: if the data are held in what can't be written down, as a replay buffer of another class than this
            package's
        """
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
            "notes": notes,
        }
        files = {
            _STATE: json.dumps(state).encode(),
            _ARRAYS: _in_memory(lambda file: np.savez(file, **arrays)),  # type: ignore[arg-type]
            _TENSORS: _in_memory(lambda file: th.save(self._tensors(), file)),
        }
        return write_checkpoint(root, self.num_timesteps, files, blocks, keep)

    def _encoded_arguments(self, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
        """Of the constructor, as far as they can be written down; of the others, what can't be."""
        arguments: dict[str, Any] = {}
        for name in constructor_arguments(type(self)):
            try:
                value = getattr(self, KEPT_AS.get(name, name))
                if isinstance(value, BaseAlgorithm):
                    raise UntrustedNameError("it is a model, and not the path of one")
                if isinstance(value, TrainFreq):
                    value = (value.frequency, value.unit.value)
                if name == "policy":  # by its name, if it has one: the class may be the user's own
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
        """State of networks, optimisers and coefficients."""
        _, names = self._get_torch_save_params()
        free = {name: recursive_getattr(self, name).detach() for name in names}
        return {"parameters": self.get_parameters(), "free": free}

    def training_state(self) -> dict[str, Any]:
        """
        What an algorithm's own hooks have gathered, for checkpoints: attributes by name, of numbers, strings, arrays, lists,
        dicts and deques. :meth:`resume` sets them.
        """
        return {}

    # --- resuming ---------------------------------------------------------------------------------------------------

    @classmethod
    def resume(cls, directory: str | Path, env: GymEnv, device: th.device | str = "auto", **given: Any) -> Self:
        """
        Go on from the latest checkpoint that is whole; a later one that is incomplete or altered is named in a warning.

        The next ``learn(model.steps_left, reset_num_timesteps=False)`` does what the interrupted one would have done, to
        the bit where the environments can be put back to where they were; where they can't, a warning says why, and new
        episodes start.

        :param directory: folder that :meth:`save_checkpoint` was given
        :param env: made like the one before
        :param device: may be another one
        :param given: arguments of the constructor, which take the place of those before, and ``strict_deployment``; needed
            are those that no file can hold, such as functions and classes of your own
        :return: the model as it was
        :raises CheckpointError: if no checkpoint is whole, or it is of another algorithm
        :raises TypeError: naming what is no argument
        :raises ValueError: naming a needed argument, one that can't be changed, or the entry of a space that is another one
            now
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
        """Of those that were given: that they are what the checkpoint's networks and buffer were made with."""
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
            self.env.seed(int(generators["numpy"][1][0]) % 2**31)  # the same for the same checkpoint

    def _restore_generators(self, states: dict[str, Any]) -> None:
        """Last: whatever else is restored may draw random numbers."""
        th.set_rng_state(th.from_numpy(states["torch"]))
        if th.cuda.is_available() and len(states["cuda"]) == th.cuda.device_count():
            th.cuda.set_rng_state_all([th.from_numpy(state) for state in states["cuda"]])
        np.random.set_state(states["numpy"])
        random.setstate(states["python"])
        self.action_space._np_random = states["action_space"]

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """See SB3's ``learn``."""
        with ExitStack() as self.learn_scope:
            return super().learn(*args, **kwargs)  # type: ignore[safe-super]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "resumed_notes", "learn_scope"]


def _qualified_name(algorithm: type) -> str:
    return f"{algorithm.__module__}.{algorithm.__qualname__}"


def _in_memory(write: Any) -> bytes:
    """
    :param write: to a file
    :return: what it wrote
    """
    file = io.BytesIO()
    write(file)
    return file.getvalue()


def _decoded_arguments(stored: dict[str, Any], given: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Those that the checkpoint holds; the others must have been given."""
    missing = {name: entry["cannot"] for name, entry in stored.items() if "cannot" in entry and name not in given}
    if missing:
        reasons = "; ".join(f"{name} ({reason})" for name, reason in missing.items())
        raise ValueError(f"No checkpoint can hold these arguments, pass them to resume() as before: {reasons}.")
    return {name: decode(entry["value"], arrays) for name, entry in stored.items() if "cannot" not in entry}


def _describe_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> dict[str, str]:
    """Name -> description that is the same if and only if shape, type and bounds are."""
    assert isinstance(observation_space, spaces.Dict)
    entries = {f'the observation\'s entry "{key}"': space for key, space in observation_space.items()}
    return {name: _describe(space) for name, space in {**entries, "the actions": action_space}.items()}


def _describe(space: spaces.Space) -> str:
    if not isinstance(space, spaces.Box):
        return str(space)
    low, high = (np.array2string(bound, threshold=8) for bound in (space.low, space.high))
    all_bounds = checksum(space.low.tobytes() + space.high.tobytes())[:8]  # a long array is shown by its ends
    return f"Box of shape {space.shape}, {space.dtype}, within [{low}, {high}] ({all_bounds})".replace("\n", " ")
