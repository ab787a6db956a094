"""A replay buffer for dict observations that stores each observation once."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gac.checks.entries import computable
from sb3_gac.checks.values import check_integer
from sb3_gac.replay.frame_stack import resolve_frame_stacks
from sb3_gac.replay.histories import Histories, steps_before, unbroken
from sb3_gac.replay.observation_ring import ObservationRing
from sb3_gac.replay.observation_store import FinalObservations, ObservationLayout, Rows, check_fits_in_memory
from sb3_gac.replay.samples import WeightedSamples
from sb3_gac.replay.shown import CUT, DONE, TIME_LIMIT, ShownByStep


class CompactDictReplayBuffer(ShownByStep):
    """
    A ring of observations: the next observation of a step is stored once, as the observation of the following step.

    A final observation is kept apart only where an episode ends, or where the environment was reset from outside.  One row
    beyond the capacity holds the newest next observation.  The buffer is exact for terminations, time limits and several
    environments, and replaces SB3's ``DictReplayBuffer``, which stores every observation twice.  Entries that are stacks of
    frames are named in ``frame_stacks``, and each of their frames is stored once.

    :param buffer_size: number of transitions kept, over all environments
    :param observation_space: Dict space of observations
    :param action_space: action space of the environments
    :param device: device of the samples
    :param n_envs: number of environments
    :param optimize_memory_usage: argument of SB3's buffers, without effect, since this buffer stores observations once anyway
    :param handle_timeout_termination: whether a time limit bootstraps, instead of counting as a termination
    :param n_steps: number of rewards summed up in a sample; the sum ends early where the episode or the data end
    :param gamma: discount factor of that sum
    :param storage_dtype: type that floating-point entries are stored in, such as "float16"; ``None`` for their own
    :param frame_stacks: entry -> number of its frames, joined along its first axis, the oldest first, as
        :class:`sb3_gac.envs.History` and SB3's ``VecFrameStack`` join them: ``{"partial": 3}``
    :param mask_truncations: whether critics learn nothing from a step that the time limit truncated, as in Brax's SAC, whose
        ``sac/losses.py`` multiplies the error by 1 - truncation and divides by the number of all steps; if not, critics
        bootstrap from the final observation. Policies learn from such steps in either case
    :raises MemoryError: if the buffer does not fit into the available memory
    """

    #: See :class:`sb3_gac.checkpoint.rows.Ring`
    filling: object
    #: Number of steps, counted from the first step ever added, that are no longer sampled
    _n_retired = 0
    mask_truncations = False

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = True,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        storage_dtype: str | None = None,
        frame_stacks: Mapping[str, int] | None = None,
        mask_truncations: bool = False,
    ):
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        check_integer("n_steps", n_steps, 1)
        if mask_truncations and not handle_timeout_termination:
            raise ValueError("mask_truncations=True needs handle_timeout_termination=True, or no truncation is known.")
        self.mask_truncations = mask_truncations
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma
        lengths = resolve_frame_stacks(observation_space, frame_stacks)
        self.layout = ObservationLayout(observation_space, storage_dtype, lengths)
        self.n_rows = self.buffer_size + max(lengths.values(), default=1)  # the frames of the oldest stack included
        action_dtype = np.dtype(self._maybe_cast_dtype(action_space.dtype))
        row_bytes = self.layout.row_bytes() + self.action_dim * action_dtype.itemsize + 5
        check_fits_in_memory(self.buffer_size * n_envs, self.n_rows * n_envs, row_bytes)
        self._ring = ObservationRing(self.layout, self.n_rows, n_envs)
        self._finals = FinalObservations(self.layout)
        self.actions = np.zeros((self.n_rows, n_envs, self.action_dim), dtype=action_dtype)
        self.rewards = np.zeros((self.n_rows, n_envs), dtype=np.float32)
        self.endings = np.zeros((self.n_rows, n_envs), dtype=np.uint8)
        self._n_added = 0
        self.mark_changed()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled buffer; buffers of earlier versions have no ring, and hold the rows themselves."""
        rows = state.pop("_rows", None)
        vars(self).update(state)
        if rows is not None:
            self._ring = ObservationRing(self.layout, self.n_rows, self.n_envs)
            self._ring.rows = rows
        self.mark_changed()

    # --- sizes ------------------------------------------------------------------------------------------------------

    def nbytes(self) -> int:
        """Number of bytes allocated."""
        arrays = (self.actions, self.rewards, self.endings)
        return sum(array.nbytes for array in arrays) + self._ring.nbytes() + self._finals.nbytes()

    def size(self) -> int:
        """Number of transitions kept for each environment."""
        return min(self._n_added, self.buffer_size)

    def newest_rewards(self) -> np.ndarray:
        """Rewards of the step that was added last, shape (n_envs,)."""
        return self.rewards[(self._n_added - 1) % self.n_rows]

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self._n_added = self._n_retired = 0
        self._finals = FinalObservations(self.layout)
        self._ring.reset()
        self.endings[:] = 0
        self.mark_changed()

    # --- checkpoints -------------------------------------------------------------------------------------------------

    @property
    def n_added(self) -> int:
        """Number of transitions ever added for each environment."""
        return self._n_added

    def rows_by_name(self) -> dict[str, np.ndarray]:
        """The ring's arrays by name, shape (rows, n_envs, \\*), not copied; a step writes its own row and the next one."""
        return {**self._ring.rows_by_name(), "actions": self.actions, "rewards": self.rewards, "endings": self.endings}

    def bookkeeping(self) -> dict[str, Any]:
        """The buffer's state apart from :meth:`rows_by_name`, for :meth:`restore_bookkeeping`."""
        counts = {"n_added": self._n_added, "n_retired": self._n_retired}
        apart = {"finals": self._finals.state(), "frames": self._ring.state()}
        return {**counts, "shape": list(self.rewards.shape), **apart}

    def restore_bookkeeping(self, state: dict[str, Any]) -> None:
        """
        Restore the state of another buffer.

        :param state: state from :meth:`bookkeeping`
        :raises ValueError: if the state is that of a buffer with another number of rows or environments
        """
        if state["shape"] != list(self.rewards.shape):
            raise ValueError(f"The buffer has (rows, environments) {list(self.rewards.shape)}, and had {state['shape']}.")
        self._n_added, self._n_retired = state["n_added"], state.get("n_retired", 0)
        self.pos = self._n_added % self.n_rows
        self.full = self._n_added >= self.buffer_size
        self._finals.restore(state["finals"])
        self._ring.restore(state.get("frames", {}))
        self.mark_changed()

    def mark_changed(self) -> None:
        """Have the next checkpoint write all rows; needed after rows were changed in place, such as rewards computed anew."""
        self.filling = object()

    # --- adding ------------------------------------------------------------------------------------------------------

    def add(  # type: ignore[override]
        self,
        obs: Mapping[str, np.ndarray],
        next_obs: Mapping[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add one transition of each environment.

        :param obs: observations before the action, (n_envs, ...) of each entry
        :param next_obs: observations after the action, (n_envs, ...) of each entry; at an episode's end its final observation,
            not the next episode's first one
        :param action: actions on the networks' scale, shape (n_envs, \\*action shape)
        :param reward: rewards, shape (n_envs,)
        :param done: true where the episode ended, shape (n_envs,)
        :param infos: info of each environment, with "TimeLimit.truncated" where a time limit ended the episode
        :raises ValueError: if an entry does not fit, see :meth:`ObservationLayout.pack`; nothing is then stored
        """
        rows, next_rows = self.layout.pack(obs, self.n_envs), self.layout.pack(next_obs, self.n_envs)
        self._ring.check_follows(rows, next_rows)
        self._finals.forget_from(self._n_added * self.n_envs)
        goes_on = np.zeros(self.n_envs, dtype=bool)
        if self._n_added:
            goes_on = self._ring.goes_on(self._n_added, rows)
            self._cut(~goes_on)  # a reset without mark_reset()
        self._ring.write(self._n_added, rows, goes_on)
        self.actions[self.pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.endings[self.pos] = np.asarray(done, dtype=np.uint8) * DONE
        if self.handle_timeout_termination:
            by_time_limit = np.array([bool(info.get("TimeLimit.truncated", False)) for info in infos])
            self.endings[self.pos] |= np.where(done, by_time_limit, False).astype(np.uint8) * np.uint8(TIME_LIMIT)
        self._keep_finals(np.flatnonzero(self.endings[self.pos]), self.layout.stored(next_rows), self._n_added)

        self._n_added += 1
        self.pos = self._n_added % self.n_rows
        self.full = self._n_added >= self.buffer_size
        self._ring.write_next(self._n_added, next_rows)
        self._finals.forget_before((self._n_added - self.size()) * self.n_envs)
        self._ring.forget_before(self._n_added - self.size())

    def mark_reset(self) -> None:
        """Cut the episodes under way, after a reset from outside: the next step does not continue the last one."""
        if self._n_added:
            self._cut(np.ones(self.n_envs, dtype=bool))

    def retire(self) -> None:
        """Stop sampling the stored transitions; they remain in the histories of later transitions."""
        self._n_retired = self._n_added

    def _cut(self, envs: np.ndarray) -> None:
        """
        Mark the step that was added last as cut, unless it ended an episode.

        :param envs: whether to cut the episode of each environment, shape (n_envs,)
        """
        previous = (self._n_added - 1) % self.n_rows
        cut = np.flatnonzero(envs & (self.endings[previous] == 0))
        self.endings[previous, cut] = CUT
        self._keep_finals(cut, {group: values[self.pos] for group, values in self._ring.rows.items()}, self._n_added - 1)

    def _keep_finals(self, envs: np.ndarray, rows: Rows, step: int) -> None:
        if len(envs):
            self._finals.append(step * self.n_envs + envs, {group: values[envs] for group, values in rows.items()})

    # --- sampling ----------------------------------------------------------------------------------------------------

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:  # type: ignore[override]
        """
        Transitions, drawn uniformly with replacement.

        :param batch_size: number of transitions, B
        :param env: ``VecNormalize`` that normalises observations and rewards; ``None`` for no normalisation
        :return: tensors of the transitions on the buffer's device, (B, ...) of each
        """
        return self._get_samples(self._draw_steps(batch_size) % self.n_rows, env)

    def sample_with_histories(
        self, batch_size: int, length: int, env: VecNormalize | None = None
    ) -> tuple[DictReplayBufferSamples, Histories]:
        """
        Transitions, drawn uniformly with replacement, and the steps before each in its episode.

        :param batch_size: number of transitions, B
        :param length: number of steps before each transition, K
        :param env: ``VecNormalize`` that normalises observations and rewards; ``None`` for no normalisation
        :return: transitions as from :meth:`sample`, and their histories, as far as these steps are stored
        """
        steps = self._draw_steps(batch_size)
        envs = np.random.randint(self.n_envs, size=batch_size)
        return self._transitions(steps % self.n_rows, envs, env), self._histories(steps, envs, length, env)

    @property
    def _first_sampled(self) -> int:
        """The oldest step that is stored and not retired."""
        return max(self._n_added - self.size(), self._n_retired)

    def _draw_steps(self, batch_size: int) -> np.ndarray:
        if self._first_sampled == self._n_added:
            raise ValueError("The replay buffer holds nothing to sample: add transitions first, after retire() new ones.")
        return np.random.randint(self._first_sampled, self._n_added, size=batch_size)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        return self._transitions(batch_inds, np.random.randint(self.n_envs, size=len(batch_inds)), env)

    def _transitions(self, batch_inds: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> Any:
        rewards, last, discounts = self._n_step_rewards(batch_inds, envs, env)
        endings = self.endings[last, envs]
        terminated = (endings & (DONE | TIME_LIMIT)) == DONE
        observations = self._gather(batch_inds, envs)
        following = self._next_rows(last, envs, before=observations if self.n_steps == 1 else None)
        samples = DictReplayBufferSamples(
            observations=self._to_tensors(observations, env),
            actions=self.to_torch(self.actions[batch_inds, envs], copy=False),
            next_observations=self._to_tensors(following, env),
            dones=self.to_torch(terminated.astype(np.float32)[:, None], copy=False),
            rewards=self.to_torch(rewards[:, None], copy=False),
            discounts=None if discounts is None else self.to_torch(discounts[:, None], copy=False),
        )
        weights = self._critic_weights(endings)
        return samples if weights is None else WeightedSamples(*samples, weights)

    def _critic_weights(self, endings: np.ndarray) -> th.Tensor | None:
        """Weights of steps by their endings, 0 for truncated ones; ``None`` without ``mask_truncations``."""
        masked = self.mask_truncations
        return self.to_torch((endings & TIME_LIMIT == 0).astype(np.float32), copy=False) if masked else None

    def _histories(self, steps: np.ndarray, envs: np.ndarray, length: int, env: VecNormalize | None) -> Histories:
        before = steps_before(steps, length)
        rows = before % self.n_rows
        valid = unbroken((before >= self._n_added - self.size()) & (self.endings[rows, envs] == 0))
        mask = self.to_torch(valid.astype(np.float32), copy=False)
        entries = self._to_tensors(self._gather(rows.ravel(), np.broadcast_to(envs, rows.shape).ravel()), env)
        actions = self.actions[rows, envs] * valid[..., None].astype(self.actions.dtype)
        return Histories.of(entries, self.to_torch(actions, copy=False), mask)

    def _n_step_rewards(
        self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """
        :return: discounted sums of rewards, rows of the last steps in the sums, and discounts of the next values, shape (B,)
            each; ``None`` in place of the discounts if ``n_steps`` is 1
        """
        if self.n_steps == 1:
            return self._normalize_reward(self.rewards[rows, envs], env).astype(np.float32), rows, None
        indices = (rows[:, None] + np.arange(self.n_steps)) % self.n_rows
        ends = (self.endings[indices, envs[:, None]] != 0) | (indices == (self._n_added - 1) % self.n_rows)
        ends[:, -1] = True
        count = ends.argmax(axis=1) + 1  # steps up to and including the first one at which the sum ends
        powers = np.power(self.gamma, np.arange(self.n_steps + 1), dtype=np.float64)
        used = np.arange(self.n_steps) < count[:, None]
        rewards = self._normalize_reward(self.rewards[indices, envs[:, None]], env) * used @ powers[:-1]
        last = np.take_along_axis(indices, count[:, None] - 1, axis=1)[:, 0]
        return rewards.astype(np.float32), last, powers[count].astype(np.float32)

    def _gather(self, rows: np.ndarray, envs: np.ndarray) -> Rows:
        # The step that a row holds is the latest step up to _n_added that falls on the row
        return self._ring.gather(self._n_added - (self._n_added - rows) % self.n_rows, envs)

    def _next_rows(self, rows: np.ndarray, envs: np.ndarray, only_stored: bool = False, before: Rows | None = None) -> Rows:
        """
        Packed next observations: from the following rows, or from the final observations that are kept apart.

        :param rows: rows of the transitions, shape (B,)
        :param envs: environments of the transitions, shape (B,)
        :param only_stored: whether rows of steps that are no longer stored are read without a final observation
        :param before: packed observations of the same transitions; ``None`` if they were not gathered
        :return: packed next observations, group -> shape (B, width)
        """
        # The step of a row is the latest step below _n_added that falls on the row
        steps = self._n_added - 1 - (self._n_added - 1 - rows) % self.n_rows
        following = self._ring.stored(steps + 1, envs)
        ended = self.endings[rows, envs] != 0
        if only_stored:
            ended &= steps >= self._n_added - self.size()
        positions = np.flatnonzero(ended)
        if len(positions):
            self._finals.replace_in(following, positions, (steps * self.n_envs + envs)[positions])
        return self._ring.with_older_frames(following, steps, envs, before)

    def to_torch(self, array: np.ndarray, copy: bool = True) -> th.Tensor:
        """The array as a tensor on the buffer's device, of a type that torch computes with, see SB3's ``to_torch``."""
        return super().to_torch(computable(array), copy)

    def _to_tensors(self, rows: Rows, env: VecNormalize | None) -> dict[str, th.Tensor]:
        """The entries as tensors: views of one tensor for each group, or a tensor for each entry if they are normalised."""
        if env is not None:
            normalized = self._normalize_obs(self.layout.unpack(rows), env)
            assert isinstance(normalized, dict)
            return {key: self.to_torch(value, copy=False) for key, value in normalized.items()}
        tensors = {group: self.to_torch(values, copy=False) for group, values in rows.items()}
        observation = {}
        for key, (group, columns) in self.layout.columns.items():
            values = tensors[group][:, columns]
            if self.layout.dtypes[key] != self.layout.group_dtypes[group]:
                values = values.to(th.float32)
            observation[key] = values.reshape(-1, *self.layout.shapes[key])
        return observation
