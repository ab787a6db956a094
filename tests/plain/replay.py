"""A task that writes down what it returned, and batches of that: normalised, summed up and padded one by one."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces


class Step(NamedTuple):
    """What an environment was in, was given and returned."""

    obs: dict[str, np.ndarray]
    action: Any
    reward: float
    next_obs: dict[str, np.ndarray]
    terminated: bool
    ended: bool


class Recorded(gym.Env):
    """
    Random observations and rewards; episodes of one to six steps, half of which terminate, while the others run out of time.

    :param discrete: whether actions are one of three, instead of numbers in ranges of their own
    :param n_actions: how many numbers
    """

    def __init__(self, discrete: bool = False, n_actions: int = 2):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-np.inf, np.inf, (3,), np.float32), privileged=spaces.Box(-np.inf, np.inf, (2,), np.float32)
        )
        low = -np.arange(n_actions, dtype=np.float32)
        high = 1 + np.arange(n_actions, dtype=np.float32) / 2
        self.action_space = spaces.Discrete(3) if discrete else spaces.Box(low, high)
        self.steps: list[Step] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self._left = int(self.np_random.integers(1, 7))
        self._obs = self._draw()
        return self._obs, {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        before, self._obs, reward = self._obs, self._draw(), 3.0 * self.np_random.standard_normal()
        self._left -= 1
        ended = self._left == 0
        terminated = ended and bool(self.np_random.random() < 0.5)
        self.steps.append(Step(before, action, reward, self._obs, terminated, ended))
        return self._obs, reward, terminated, ended and not terminated, {}

    def _draw(self) -> dict[str, np.ndarray]:
        entries = self.observation_space.spaces
        return {key: 1 + 2 * self.np_random.standard_normal(box.shape, np.float32) for key, box in entries.items()}


class Batch(NamedTuple):
    """
    float64; \\*E = (B,) of transitions, (T, B) of sequences.

    :param observations: of sequences, those at every step and the last next one, (T + 1, B, ...) each
    :param next_observations: ``None`` for sequences
    :param actions: in [-1, 1], or numbers of actions, shape (\\*E, A)
    :param rewards: summed up over n steps, shape (\\*E)
    :param terminated: shape (\\*E)
    :param discounts: of what follows, shape (\\*E)
    :param counts: 1, or 0 for padding, shape (\\*E)
    :param learned: by critics: 1, or 0 for the end by a time limit, if it is masked, shape (\\*E)
    """

    observations: dict[str, th.Tensor]
    next_observations: dict[str, th.Tensor] | None
    actions: th.Tensor
    rewards: th.Tensor
    terminated: th.Tensor
    discounts: th.Tensor
    counts: th.Tensor
    learned: th.Tensor

    def mean(self, values: th.Tensor) -> th.Tensor:
        """Of what counts."""
        return values[self.counts > 0].mean()


class PlainReplay:
    """
    All steps of some environments, and what a learner is to be given of them.

    :param envs: that have written down their steps
    :param vec_normalize: whose statistics normalise observations and rewards, ``None`` for none
    :param n_steps: rewards to sum up
    :param gamma: discount factor
    :param sequence_length: steps that count in a sequence, ``None`` for whole episodes
    :param mask_truncations: whether critics do not learn from the end by a time limit
    """

    def __init__(
        self,
        envs: list[Recorded],
        vec_normalize: Any,
        n_steps: int,
        gamma: float,
        sequence_length: int | None = None,
        mask_truncations: bool = False,
    ):
        self.envs, self.vec_normalize, self.n_steps, self.gamma = envs, vec_normalize, n_steps, gamma
        self.sequence_length, self.mask_truncations = sequence_length, mask_truncations
        self._places = [(env, t) for env in envs for t in range(len(env.steps))]
        self._seen = np.stack([_flat(self.normalised(env.steps[t].obs)) for env, t in self._places])

    def normalised(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """clip((x - mean) / sqrt(variance + epsilon)), entry by entry."""
        if self.vec_normalize is None:
            return obs
        bound, rms = self.vec_normalize.clip_obs, self.vec_normalize.obs_rms
        return {key: np.clip((x - rms[key].mean) / np.sqrt(rms[key].var + 1e-8), -bound, bound) for key, x in obs.items()}

    def normalised_reward(self, reward: float) -> float:
        """clip(r / sqrt(variance of returns + epsilon))."""
        if self.vec_normalize is None:
            return reward
        bound = self.vec_normalize.clip_reward
        return float(np.clip(reward / np.sqrt(self.vec_normalize.ret_rms.var + 1e-8), -bound, bound))

    def batch(self, samples: Any) -> Batch:
        """
        :param samples: that the replay buffer gave: of transitions, or with a mask, of sequences. Which ones these are is
            told by their first observations, and by the mask how many steps only bring memories up and how many count; all
            else is looked up
        """
        sequences = hasattr(samples, "mask")
        first = {key: (value[0] if sequences else value).numpy() for key, value in samples.observations.items()}
        places = [self._place({key: value[row] for key, value in first.items()}) for row in range(len(first["partial"]))]
        if not sequences:
            return self._of_transitions(places)
        return self._of_sequences(places, samples.mask.argmax(dim=0).tolist(), samples.mask.sum(dim=0).int().tolist())

    def _place(self, obs: dict[str, np.ndarray]) -> tuple[Recorded, int]:
        distances = np.abs(self._seen - _flat(obs)).max(axis=1)
        (found,) = np.flatnonzero(distances < 1e-4)
        return self._places[found]

    def _of_transitions(self, places: list[tuple[Recorded, int]]) -> Batch:
        rewards, discounts, lasts = [], [], []
        for env, t in places:
            reward, discount = 0.0, 1.0
            for last in env.steps[t : t + self.n_steps]:
                reward += discount * self.normalised_reward(last.reward)
                discount *= self.gamma
                if last.ended:
                    break
            rewards.append(reward)
            discounts.append(discount)
            lasts.append(last)
        firsts = [env.steps[t] for env, t in places]
        return Batch(
            _stacked([self.normalised(step.obs) for step in firsts]),
            _stacked([self.normalised(step.next_obs) for step in lasts]),
            th.stack([self._scaled(step.action) for step in firsts]),
            th.tensor(rewards, dtype=th.float64),
            th.tensor([float(step.terminated) for step in lasts], dtype=th.float64),
            th.tensor(discounts, dtype=th.float64),
            th.ones(len(places), dtype=th.float64),
            th.tensor([self._is_learned(step) for step in lasts], dtype=th.float64),
        )

    def _is_learned(self, step: Step) -> float:
        return float(not self.mask_truncations or step.terminated or not step.ended)

    def _of_sequences(self, places: list[tuple[Recorded, int]], burn_in: list[int], counted: list[int]) -> Batch:
        """Side by side; what pads the short ones, their last step again and again, must not matter."""
        episodes = []
        for (env, t), before, count in zip(places, burn_in, counted, strict=True):
            end = next(end for end in range(t, len(env.steps)) if env.steps[end].ended)
            rest = env.steps[t : end + 1]
            if self.sequence_length is not None:  # fewer steps at an episode's start or end alone
                is_cut = len(rest) == before + count or t + before == 0 or env.steps[t + before - 1].ended
                assert count == self.sequence_length or (count < self.sequence_length and is_cut)
                rest = rest[: before + count]
            episodes.append(rest)
        length = max(len(episode) for episode in episodes)
        padded = [episode + [episode[-1]] * (length - len(episode)) for episode in episodes]
        observations = [_stacked([self.normalised(obs) for obs in _observations(one, length + 1)]) for one in episodes]
        counts = [
            [float(before <= t < len(episode)) for t in range(length)]
            for episode, before in zip(episodes, burn_in, strict=True)
        ]
        return Batch(
            {key: th.stack([obs[key] for obs in observations], dim=1) for key in observations[0]},
            None,
            th.stack([th.stack([self._scaled(step.action) for step in one]) for one in padded], dim=1),
            th.tensor([[self.normalised_reward(step.reward) for step in one] for one in padded], dtype=th.float64).t(),
            th.tensor([[float(step.terminated) for step in one] for one in padded], dtype=th.float64).t(),
            th.full((length, len(places)), self.gamma, dtype=th.float64),
            th.tensor(counts, dtype=th.float64).t(),
            th.tensor([[self._is_learned(step) for step in one] for one in padded], dtype=th.float64).t(),
        )

    def _scaled(self, action: Any) -> th.Tensor:
        space = self.envs[0].action_space
        if isinstance(space, spaces.Discrete):
            return th.tensor([float(action)], dtype=th.float64)
        return th.as_tensor(2 * (action.astype(np.float64) - space.low) / (space.high - space.low) - 1)


def _flat(obs: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([obs["partial"], obs["privileged"]])


def _observations(episode: list[Step], length: int) -> list[dict[str, np.ndarray]]:
    """At its steps, and after the last one as often as is needed."""
    return [*(step.obs for step in episode), *[episode[-1].next_obs] * (length - len(episode))]


def _stacked(observations: list[dict[str, np.ndarray]]) -> dict[str, th.Tensor]:
    return {key: th.as_tensor(np.stack([obs[key] for obs in observations])).double() for key in observations[0]}
