"""An off-policy algorithm's replay buffer: how it is made, what it may hold, loaded files and checkpoints."""

import inspect
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_gac.checkpoint.rows import SavedBlocks, read_rows, write_rows
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.checks.policy import check_taken
from sb3_gac.checks.spaces import check_spaces_of
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.episodes import EpisodeReplayBuffer, check_learns_from_sequences, holds_a_batch
from sb3_gac.replay.histories import check_samples_histories
from sb3_gac.replay.source import ReplaySource

#: Options of this package's replay buffers that say how to sample, not what is stored
SAMPLING_OPTIONS = ("n_steps", "gamma", "sequence_length", "burn_in", "mask_truncations")


class OtherNumberOfEnvironmentsError(AssertionError, ValueError):
    """The replay buffer was filled by another number of environments than the model has. SB3 raises AssertionError here."""


class ReplayData(OffPolicyAlgorithm):
    """
    The replay buffer of an algorithm, which follows the algorithm's arguments, and the source of what it stores.

    The attributes without a value are those of the other ancestors of off-policy algorithms.
    """

    is_recurrent: bool
    samples_histories: ClassVar[bool]
    _resumed_noise: Any
    _replay_source: ReplaySource | None = None
    _saved_blocks: SavedBlocks | None = None
    _waiting = False

    # --- the replay buffer ------------------------------------------------------------------------------------------

    @property
    def _present_buffer_class(self) -> type[ReplayBuffer]:
        """Class of the replay buffer, also before the default is chosen."""
        default = EpisodeReplayBuffer if self.is_recurrent else CompactDictReplayBuffer
        return self.replay_buffer_class or default

    def _check_replay_buffer_kwargs(self) -> None:
        check_taken("replay_buffer_kwargs", self._present_buffer_class, self.replay_buffer_kwargs)
        for name in ("n_steps", "gamma"):
            value, own = self.replay_buffer_kwargs.get(name), getattr(self, name)
            if value is not None and value != own:
                raise ValueError(
                    f"replay_buffer_kwargs has {name}={value}, but {type(self).__name__} has {name}={own}, which the replay "
                    f"buffer follows: leave {name} out of replay_buffer_kwargs."
                )

    def check_samples_from(self, replay_buffer_class: type[ReplayBuffer] | None) -> None:
        """
        Check that a class of replay buffers has the kind of batches that the algorithm learns from.

        :param replay_buffer_class: class of the replay buffer, ``None`` for the default
        :raises ValueError: if the class has none; the message names it
        """
        if self.is_recurrent:
            check_learns_from_sequences(replay_buffer_class, self.n_steps)
        check_sums_rewards(replay_buffer_class or self._present_buffer_class, self.n_steps, self.replay_buffer_kwargs)
        if self.samples_histories:
            check_samples_histories(replay_buffer_class)

    def _make_replay_buffer(self) -> ReplayBuffer:
        assert self.replay_buffer_class is not None
        options = self._replay_buffer_options()
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            options["env"] = self.env
        return self.replay_buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **options,
        )

    def _replay_buffer_options(self) -> dict[str, Any]:
        """Keyword arguments of the replay buffer's class, with those that the algorithm itself was given."""
        assert self.replay_buffer_class is not None
        ours = issubclass(self.replay_buffer_class, CompactDictReplayBuffer)
        return {**({"n_steps": self.n_steps, "gamma": self.gamma} if ours else {}), **self.replay_buffer_kwargs}

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """
        See SB3's ``load_replay_buffer``; the model's arguments say how the buffer is sampled, not the file.

        :raises ValueError: naming the observation entries whose spaces are not the model's, or the buffer's class if the model
            can't learn from it, or if another number of environments filled the buffer; the model then keeps the buffer that
            it had
        """
        before = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        finally:
            loaded, self.replay_buffer = self.replay_buffer, before
        assert loaded is not None
        check_spaces_of(self, loaded, "replay buffer")
        self.check_samples_from(type(loaded))
        self._check_has_options(loaded)
        if self.env is not None:
            check_number(loaded, self.n_envs)
        self.replay_buffer = loaded
        self._set_sampling_options(loaded)

    def _check_has_options(self, buffer: ReplayBuffer) -> None:
        """
        Check that a loaded buffer is sampled as the model's arguments say.

        :raises ValueError: naming an option that the buffer does not have
        """
        for name in SAMPLING_OPTIONS:
            value = self.replay_buffer_kwargs.get(name)
            if name not in ("n_steps", "gamma") and value and not hasattr(buffer, name):
                raise ValueError(
                    f"The model has replay_buffer_kwargs with {name}={value}, but the replay buffer is a "
                    f"{type(buffer).__name__}, which can't be sampled so: load a buffer of another class, or make the model "
                    f"without {name}."
                )

    def _set_sampling_options(self, buffer: ReplayBuffer) -> None:
        """Have the model's arguments say how one of this package's buffers is sampled."""
        if isinstance(buffer, CompactDictReplayBuffer):
            options = self._replay_buffer_options()
            defaults = {name: _default(type(buffer), name) for name in SAMPLING_OPTIONS if hasattr(buffer, name)}
            vars(buffer).update({name: options.get(name, default) for name, default in defaults.items()})

    # --- the source of what is stored ---------------------------------------------------------------------------------

    @property
    def replay_source(self) -> ReplaySource:
        """The source of what the replay buffer stores, for the present environments."""
        assert self.env is not None
        if self._replay_source is None or self._replay_source.env is not self.env:
            self._replay_source = ReplaySource(self.env)
            self._check_replay_source(self._replay_source)
        return self._replay_source

    @property
    def sampling_env(self) -> Any:
        """The argument ``env`` for ``ReplayBuffer.sample``, which normalises the samples; ``None`` without normalisation."""
        return None if self.env is None else self.replay_source.sampling_env

    def _check_replay_source(self, source: ReplaySource) -> None:
        if self.replay_buffer is not None:
            self._check_what_is_held(self.replay_buffer, source)
        if source.in_the_way is None:
            return
        names = f"{type(source.in_the_way).__name__} stands outside VecNormalize"
        remedy = f"make it VecNormalize({type(source.in_the_way).__name__}(env))"
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, HerReplayBuffer):
            raise ValueError(
                f"{names}: goals would be stored normalised, and HerReplayBuffer computes rewards from raw ones: {remedy}."
            )
        warnings.warn(
            f"{names}: the replay buffer holds observations as they were normalised when they were seen. To have them "
            f"normalised with the newest statistics whenever they are sampled, {remedy}.",
            stacklevel=4,
        )

    def _check_what_is_held(self, buffer: ReplayBuffer, source: ReplaySource) -> None:
        """
        Check that the replay buffer goes on with the kind of observations that it holds.

        :raises ValueError: if stored observations are normalised and those to come are raw, or the reverse
        """
        normalised = source.in_the_way is not None
        held = getattr(buffer, "holds_normalised", normalised) if buffer.size() else normalised
        if held != normalised:
            ways = ("raw", "normalised as they were seen")
            wrapper = f"{'no' if held else 'a'} wrapper outside VecNormalize changes them"
            raise ValueError(
                f"The replay buffer holds observations {ways[held]}, but new observations would be {ways[normalised]}, "
                f"because {wrapper}: wrap the environments as before, or leave the buffer out."
            )
        buffer.holds_normalised = normalised  # type: ignore[attr-defined]

    def _waits_for_an_episode(self) -> bool:
        """Whether there is no whole episode to learn from yet, with a warning. (In a full buffer, that is an error.)"""
        buffer = self.replay_buffer
        assert buffer is not None
        waits = buffer.size() > 0 and not buffer.full and not holds_a_batch(buffer)
        if waits and not self._waiting:
            warnings.warn(
                "There are no gradient steps until the first episode has ended, although "
                f"learning_starts={self.learning_starts} is over: {type(buffer).__name__} samples whole episodes.",
                stacklevel=3,
            )
        self._waiting = waits
        return waits

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def check_data_can_be_saved(self) -> None:
        """
        Check that a checkpoint can hold the replay buffer.

        :raises TypeError: if there is no replay buffer, or it is of another class than this package's
        """
        buffer = self.replay_buffer
        if buffer is None:
            raise TypeError("There is no replay buffer to write down: set_env() gives one to a model that was loaded without.")
        if not isinstance(buffer, CompactDictReplayBuffer):
            raise TypeError(
                f"A checkpoint can hold a CompactDictReplayBuffer or a subclass, but replay_buffer_class is "
                f"{type(buffer).__name__}: leave it out, or use save() and save_replay_buffer()."
            )

    def save_data(self, root: Path) -> tuple[dict[str, Any], list[str]]:
        """
        Write the rows of the replay buffer that have changed since the last checkpoint.

        :param root: folder of all checkpoints of a run
        :return: state of the buffer besides its rows, and the names of all blocks of rows
        :raises TypeError: see :meth:`check_data_can_be_saved`
        """
        self.check_data_can_be_saved()
        buffer = self.replay_buffer
        assert isinstance(buffer, CompactDictReplayBuffer)
        self._saved_blocks = write_rows(buffer, root, self._saved_blocks)
        return buffer.bookkeeping() | {"blocks": self._saved_blocks.names}, self._saved_blocks.names

    def restore_data(self, root: Path, saved: dict[str, Any]) -> None:
        """
        Restore the replay buffer, and keep the restored action noise, which SB3 would reset at the next ``learn``.

        :param root: folder of all checkpoints of a run
        :param saved: first value that :meth:`save_data` returned
        """
        buffer = self.replay_buffer
        assert isinstance(buffer, CompactDictReplayBuffer)
        names = saved.pop("blocks")
        buffer.restore_bookkeeping(saved)
        self._saved_blocks = read_rows(buffer, root, names)
        self._resumed_noise = self.action_noise

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_saved_blocks", "_replay_source"]


def check_sums_rewards(buffer_class: type[ReplayBuffer], n_steps: int, options: Mapping[str, Any]) -> None:
    """
    Check that a class of replay buffers sums up as many rewards as a critic's target is to have.

    :param buffer_class: class of the replay buffer; one of neither this package nor SB3 may have an option ``n_steps``
    :param n_steps: number of rewards summed up
    :param options: keyword arguments of the class
    :raises ValueError: if the class sums up none
    """
    if issubclass(buffer_class, CompactDictReplayBuffer):
        sums = not issubclass(buffer_class, EpisodeReplayBuffer)
    else:
        sums = "n_steps" in options and "n_steps" in constructor_parameters(buffer_class)
    if n_steps > 1 and not sums:
        raise ValueError(
            f"n_steps={n_steps} needs a replay buffer that sums up rewards, which {buffer_class.__name__} does not: leave "
            "n_steps at 1, or use CompactDictReplayBuffer, the default of policies without a memory."
        )


def _default(buffer_class: type, option: str) -> Any:
    """Default of an option of a class of replay buffers, or of the ancestor to which its constructor hands the option on."""
    constructors = (vars(ancestor)["__init__"] for ancestor in buffer_class.__mro__ if "__init__" in vars(ancestor))
    parameters = (inspect.signature(constructor).parameters for constructor in constructors)
    return next(named[option].default for named in parameters if option in named)


def check_number(buffer: Any, n_envs: int, remedy: str = "load the model with as many environments") -> None:
    """
    Check that a replay buffer was filled by as many environments as a model has.

    :param buffer: replay buffer
    :param n_envs: number of the model's environments
    :param remedy: what to do, for the message
    :raises OtherNumberOfEnvironmentsError: if the numbers differ
    """
    if buffer.n_envs != n_envs:
        raise OtherNumberOfEnvironmentsError(
            f"The replay buffer was filled by {buffer.n_envs} environments, but the model has {n_envs}: {remedy}, or leave "
            "the buffer out."
        )
