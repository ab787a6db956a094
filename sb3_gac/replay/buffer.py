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
from sb3_gac.replay.frame_stack import resolve_frame_stacks
from sb3_gac.replay.histories import Histories, steps_before, unbroken
from sb3_gac.replay.observation_ring import ObservationRing
from sb3_gac.replay.observation_store import FinalObservations, ObservationLayout, Rows, check_fits_in_memory
from sb3_gac.replay.samples import WeightedSamples
from sb3_gac.replay.shown import CUT, DONE, TIME_LIMIT, ShownByStep


class CompactDictReplayBuffer(ShownByStep):
    """
    A ring of observations: the next observation of a step is the observation of the following one.

    Only where an episode ends, or the environment was reset from outside, is a final observation kept apart.  One row
    more than the capacity holds the newest next observation.  Exact for terminations, time limits and several
    environments, and drops in for SB3's ``DictReplayBuffer``, which stores every observation twice. Of stacks of frames, named
    in ``frame_stacks``, each frame is stored once.

    :param buffer_size: transitions kept, over all environments
    :param observation_space: Dict
    :param action_space: of the environments
    :param device: of the samples
    :param n_envs: number of environments
    :param optimize_memory_usage: accepted, always so
    :param handle_timeout_termination: whether a time limit bootstraps, instead of counting as termination
    :param n_steps: rewards summed up in a sample; it ends early where the episode or the data do
    :param gamma: discount factor of that sum
    :param storage_dtype: "float16" to store floating-point entries at half precision
    :param frame_stacks: entry -> number of its frames, joined along its first axis, the oldest first, as
        :class:`sb3_gac.envs.History` and SB3's ``VecFrameStack`` join them: ``{"partial": 3}``
    :param mask_truncations: whether critics learn nothing from a step that ended by its time limit, instead of bootstrapping
        from the observation that it ended with, which Brax's SAC does not have (``sac/losses.py``: the error times 1 -
        truncation, in a mean over all); policies learn from it
    :raises MemoryError: if the buffer can't fit into the memory that is available
    """

    #: Transitions that are not sampled any more, per environment, of all that were ever added
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
        if n_steps < 1:
            raise ValueError(f"n_steps must be at least 1, got {n_steps}.")
        if mask_truncations and not handle_timeout_termination:
            raise ValueError("mask_truncations=True needs handle_timeout_termination=True, or no truncation is known.")
        self.mask_truncations = mask_truncations
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma
        lengths = resolve_frame_stacks(observation_space, frame_stacks)
        self.layout = ObservationLayout(observation_space, None if storage_dtype is None else np.dtype(storage_dtype), lengths)
        self.n_rows = self.buffer_size + max(lengths.values(), default=1)  # the oldest one's frames are there, too
        action_dtype = np.dtype(self._maybe_cast_dtype(action_space.dtype))
        row_bytes = self.layout.row_bytes() + self.action_dim * action_dtype.itemsize + 5
        check_fits_in_memory(self.buffer_size * n_envs, self.n_rows * n_envs, row_bytes)
        self._ring = ObservationRing(self.layout, self.n_rows, n_envs)
        self._finals = FinalObservations(self.layout)
        self.actions = np.zeros((self.n_rows, n_envs, self.action_dim), dtype=action_dtype)
        self.rewards = np.zeros((self.n_rows, n_envs), dtype=np.float32)
        self.endings = np.zeros((self.n_rows, n_envs), dtype=np.uint8)
        self._n_added = 0

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Buffers of earlier versions have their rows themselves."""
        rows = state.pop("_rows", None)
        vars(self).update(state)
        if rows is not None:
            self._ring = ObservationRing(self.layout, self.n_rows, self.n_envs)
            self._ring.rows = rows

    # --- sizes ------------------------------------------------------------------------------------------------------

    def nbytes(self) -> int:
        """Bytes allocated."""
        arrays = (self.actions, self.rewards, self.endings)
        return sum(array.nbytes for array in arrays) + self._ring.nbytes() + self._finals.nbytes()

    def size(self) -> int:
        """Transitions kept per environment."""
        return min(self._n_added, self.buffer_size)

    def newest_rewards(self) -> np.ndarray:
        """Of the step that was added last, shape (n_envs,)."""
        return self.rewards[(self._n_added - 1) % self.n_rows]

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._n_added = self._n_retired = 0
        self._finals = FinalObservations(self.layout)
        self._ring.reset()
        self.endings[:] = 0

    # --- checkpoints -------------------------------------------------------------------------------------------------

    @property
    def n_added(self) -> int:
        """Transitions ever added, per environment."""
        return self._n_added

    def rows_by_name(self) -> dict[str, np.ndarray]:
        """What the ring holds, by row: arrays of shape (rows, n_envs, \\*), not copied; a step writes its row and the next."""
        return {**self._ring.rows_by_name(), "actions": self.actions, "rewards": self.rewards, "endings": self.endings}

    def bookkeeping(self) -> dict[str, Any]:
        """All else that there is, for :meth:`restore_bookkeeping`."""
        counts = {"n_added": self._n_added, "n_retired": self._n_retired}
        apart = {"finals": self._finals.state(), "frames": self._ring.state()}
        return {**counts, "shape": list(self.rewards.shape), **apart}

    def restore_bookkeeping(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`bookkeeping`
        :raises ValueError: if it is of a buffer of another size
        """
        if state["shape"] != list(self.rewards.shape):
            raise ValueError(f"The buffer has (rows, environments) {list(self.rewards.shape)}, and had {state['shape']}.")
        self._n_added, self._n_retired = state["n_added"], state.get("n_retired", 0)
        self.pos = self._n_added % self.n_rows
        self.full = self._n_added >= self.buffer_size
        self._finals.restore(state["finals"])
        self._ring.restore(state.get("frames", {}))

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
        :param obs: observations, one row per environment
        :param next_obs: observations after the action; at an episode's end its last, not the next episode's first
        :param action: shape (n_envs, \\*action shape)
        :param reward: shape (n_envs,)
        :param done: shape (n_envs,)
        :param infos: with "TimeLimit.truncated" where a time limit ended the episode
        :raises ValueError: naming the entry that does not fit, see :meth:`ObservationLayout.pack`; nothing is then stored
        """
        rows, next_rows = self.layout.pack(obs, self.n_envs), self.layout.pack(next_obs, self.n_envs)
        self._ring.check_follows(rows, next_rows)
        self._finals.forget_from(self._n_added * self.n_envs)
        goes_on = np.zeros(self.n_envs, dtype=bool)
        if self._n_added:
            goes_on = self._ring.goes_on(self._n_added, rows)
            self._cut(~goes_on)  # someone did not say so
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
        """Whoever resets the environments from outside says so: what was added last is not continued by what comes next."""
        if self._n_added:
            self._cut(np.ones(self.n_envs, dtype=bool))

    def retire(self) -> None:
        """What is stored is not sampled from now on; it stays the history of what is to come."""
        self._n_retired = self._n_added

    def _cut(self, envs: np.ndarray) -> None:
        """
        :param envs: whether to cut what was added last, unless it ends an episode anyway, shape (n_envs,)
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
        :param batch_size: transitions, drawn uniformly with replacement, B
        :param env: normalises observations and rewards
        :return: tensors on the buffer's device, (B, ...) each
        """
        return self._get_samples(self._draw_steps(batch_size) % self.n_rows, env)

    def sample_with_histories(
        self, batch_size: int, length: int, env: VecNormalize | None = None
    ) -> tuple[DictReplayBufferSamples, Histories]:
        """
        :param batch_size: see :meth:`sample`
        :param length: steps before each transition, K
        :param env: see :meth:`sample`
        :return: what :meth:`sample` draws, and what came before in the episodes, as far as it is stored
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
        """Of steps that ended in these ways, if ``mask_truncations`` asks for it."""
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
        :return: discounted reward sums, (B,); rows of the last steps summed up, (B,); discounts of what follows, (B,)
        """
        if self.n_steps == 1:
            return self._normalize_reward(self.rewards[rows, envs], env).astype(np.float32), rows, None
        indices = (rows[:, None] + np.arange(self.n_steps)) % self.n_rows
        ends = (self.endings[indices, envs[:, None]] != 0) | (indices == (self._n_added - 1) % self.n_rows)
        ends[:, -1] = True
        count = ends.argmax(axis=1) + 1  # steps up to and including the first that ends
        powers = np.power(self.gamma, np.arange(self.n_steps + 1), dtype=np.float64)
        used = np.arange(self.n_steps) < count[:, None]
        rewards = self._normalize_reward(self.rewards[indices, envs[:, None]], env) * used @ powers[:-1]
        last = np.take_along_axis(indices, count[:, None] - 1, axis=1)[:, 0]
        return rewards.astype(np.float32), last, powers[count].astype(np.float32)

    def _gather(self, rows: np.ndarray, envs: np.ndarray) -> Rows:
        # Step for which a row was written: the latest one up to _n_added that falls on it
        return self._ring.gather(self._n_added - (self._n_added - rows) % self.n_rows, envs)

    def _next_rows(self, rows: np.ndarray, envs: np.ndarray, only_stored: bool = False, before: Rows | None = None) -> Rows:
        """Packed next observations: the following row, or what was kept apart; ``before``: of these rows, if gathered."""
        # Step at which a row was written: the latest one below _n_added that falls on it
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
        """See SB3's ``to_torch``; the tensor is of a type that torch computes with."""
        return super().to_torch(computable(array), copy)

    def _to_tensors(self, rows: Rows, env: VecNormalize | None) -> dict[str, th.Tensor]:
        """One tensor per group, of which the entries are views; entry by entry only where they are normalised."""
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
