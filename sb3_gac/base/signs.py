"""Signs in training that a guider adds nothing to its learner, or does too much, and warnings with the setting to change."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_gac.base.batch import Batch
from sb3_gac.base.comparing import ReturnComparison
from sb3_gac.base.random_state import random_numbers_kept
from sb3_gac.replay.episodes import holds_a_batch

#: Episodes of each policy in a block; blocks share none, so that chance does not carry over from one to the next
BLOCK = 40
#: Blocks in a row that lead to a warning: chance alone makes a limit of 97.5% fail three times running once in 60,000
BLOCKS_IN_A_ROW = 3
#: Smallest difference between the returns of guider and learner that counts, in standard deviations of a policy's returns
SMALL_EFFECT = 0.5
#: Smallest gain of the guider by the learner's critics that counts, in standard deviations of Q over the states
SMALL_GAIN = 0.05
#: KL, as a multiple of its target, below which the guider does not use its freedom, and above which KL is out of control
LITTLE_KL, MUCH_KL = 0.1, 2.0
#: Looks in a row that lead to a warning by critics or KL, which change slowly
LOOKS_IN_A_ROW = 10
QUANTILE = 1.96


def effect_bounds(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """
    The difference of two policies' mean returns, in standard deviations of a policy's returns.

    :param first: returns of one policy's episodes, two at least
    :param second: returns of the other policy's episodes, two at least
    :return: lower and upper limit of the 95% interval of the first mean minus the second, by Welch's standard error
    """
    difference = float(np.mean(first) - np.mean(second))
    variances = [float(np.var(returns, ddof=1)) for returns in (first, second)]
    spread = math.sqrt(sum(variances) / 2)
    if spread == 0:
        effect = math.copysign(math.inf, difference) if difference else 0.0
        return effect, effect
    error = math.sqrt(variances[0] / len(first) + variances[1] / len(second))
    return (difference - QUANTILE * error) / spread, (difference + QUANTILE * error) / spread


def gain_and_error(advantages: th.Tensor, horizon: float, scale: float) -> tuple[float, float]:
    """
    The difference between the returns of guider and learner, estimated from advantages.

    By the performance difference lemma (Kakade & Langford 2002) it is the advantage of the guider's actions over the
    learner's by the learner's Q, in states that the guider meets, summed up over the horizon.

    :param advantages: Q(s, guider's action) - Q(s, learner's action) by N critics in B states, shape (N, B)
    :param horizon: number of steps that returns sum up, 1 / (1 - gamma)
    :param scale: standard deviation of Q over the states; unlike the mean of Q, it does not depend on a constant in the reward
    :return: gain in units of the scale, and its standard error, from the states drawn and the critics' disagreement
    """
    n_critics, n_states = advantages.shape
    over_states = advantages.mean(dim=0).var(unbiased=False) / n_states
    over_critics = advantages.mean(dim=1).var(unbiased=False) / max(n_critics - 1, 1)
    unit = horizon / max(scale, 1e-8)
    return float(advantages.mean()) * unit, math.sqrt(float(over_states + over_critics)) * unit


class GuidanceSigns(ReturnComparison):
    """
    Looks at the guider every ``compare_every`` environment steps, and whenever both policies have ended a block of episodes.

    A gain that can't be told from zero may be due to a lack of data. The guider therefore adds nothing only if the upper 95%
    limit of its advantage is below a small one. It does too much if the lower limit of its advantage in returns is above
    zero, or if KL is far above its target. Each warning is given once in a training. Looking changes neither random numbers
    nor networks.
    """

    batch_size: int
    gamma: float
    _last_metrics: Mapping[str, float]
    _sample_batch: Callable[[int], Batch]
    replay_buffer: ReplayBuffer | None
    #: Cause -> message that says what happened, with places for numbers, and which setting to change
    remedies: ClassVar[Mapping[str, str]]
    #: Role of a policy -> returns of its episodes in the block under way
    block: dict[str, list[float]]
    #: Cause -> number of latest blocks or looks in a row that showed it
    signs_in_a_row: dict[str, int]
    #: Causes of the warnings that were given
    signs_told: list[str]

    def start_comparing(self, first: str, second: str, compare_every: int, window: int) -> None:
        """
        Begin to look at a guider and its learner.

        :param first: role of the guider
        :param second: role of the learner
        :param compare_every: number of environment steps between two looks
        :param window: number of latest episodes of each policy whose returns are compared, see :class:`ReturnComparison`
        """
        super().start_comparing(first, second, compare_every, window)
        self.block, self.signs_in_a_row, self.signs_told = {first: [], second: []}, {}, []

    def on_episode_end(self, env: int, episode_return: float, role: str | None) -> None:
        """See :meth:`EpisodeHooks.on_episode_end`."""
        super().on_episode_end(env, episode_return, role)
        if role in self.block:
            self.block[role].append(episode_return)
            if all(len(returns) >= BLOCK for returns in self.block.values()):
                self._judge_returns(*self.block.values())
                self.block = {name: [] for name in self.block}

    def on_step(self) -> None:
        """See :meth:`EpisodeHooks.on_step`."""
        is_due = self.num_timesteps >= self.next_comparison
        super().on_step()
        if is_due and self._n_updates and holds_a_batch(self.replay_buffer):  # a model that was just loaded has no data yet
            self._judge_kl(self._last_metrics)
            self._judge_gain(*self.guider_gain())

    def training_state(self) -> dict[str, Any]:
        """See :meth:`ResumableAlgorithm.training_state`."""
        names = ("block", "signs_in_a_row", "signs_told")
        return super().training_state() | {name: getattr(self, name) for name in names}

    @th.no_grad()
    def guider_gain(self) -> tuple[float, float]:
        """
        The gain of the guider's actions over the learner's by the learner's critics, each policy without exploration.

        :return: gain and its standard error, see :func:`gain_and_error`
        """
        with random_numbers_kept(self.device):
            batch = self._sample_batch(self.batch_size)
        outputs = {role: batch.outputs(getattr(self.policy, role)).now for role in self.policy.roles.policies}
        policies = self.policy.acting_distributions(outputs)
        guider, learner = (self._values(batch, policies[role]) for role in self.block)
        return gain_and_error(
            guider - learner, 1 / (1 - min(self.gamma, 1 - 1e-4)), float(learner.mean(dim=0).std(unbiased=False))
        )

    def _values(self, batch: Batch, policy: Any) -> th.Tensor:
        """Values of a policy's actions in the states that count, shape (N, B); (1, B), by the smallest critic, if discrete."""
        no_noise = th.zeros(batch.actions.shape, device=self.device)
        values, _ = policy.value_and_log_prob(batch.q_at_obs(self.policy.critic), no_noise)
        return values[:, batch.mask > 0] if batch.mask is not None else values

    def _judge_returns(self, guider: list[float], learner: list[float]) -> None:
        low, high = effect_bounds(guider, learner)
        self.logger.record("guidance/effect_low", low)
        self.logger.record("guidance/effect_high", high)
        numbers = {"guider": np.mean(guider), "learner": np.mean(learner), "low": low, "high": high}
        self._judge("nothing by returns", high < SMALL_EFFECT, BLOCKS_IN_A_ROW, numbers)
        self._judge("too much by returns", low > 0, BLOCKS_IN_A_ROW, numbers)

    def _judge_gain(self, gain: float, error: float) -> None:
        self.logger.record("guidance/gain", gain)
        self.logger.record("guidance/gain_error", error)
        upper = gain + QUANTILE * error
        self._judge("nothing by critics", upper < SMALL_GAIN, LOOKS_IN_A_ROW, {"gain": gain, "upper": upper})

    def _judge_kl(self, metrics: Mapping[str, float]) -> None:
        if not {"kl", "target_kl", "kl_coef_loss"} <= set(metrics):  # a fixed coefficient holds KL to no target
            return
        if metrics["target_kl"] <= 0:  # at a schedule's end; no KL is small or large beside it
            return
        numbers = {"kl": metrics["kl"], "target": metrics["target_kl"], "coefficient": metrics["kl_coef"]}
        share = metrics["kl"] / metrics["target_kl"]
        is_free = metrics["kl_coef_on_bound"] > 0.5
        self._judge("nothing by kl", share < LITTLE_KL and is_free, LOOKS_IN_A_ROW, numbers)
        self._judge("held back by kl", share < LITTLE_KL and not is_free, LOOKS_IN_A_ROW, numbers)
        self._judge("too much by kl", share > MUCH_KL, LOOKS_IN_A_ROW, numbers)

    def _judge(self, cause: str, is_so: bool, patience: int, numbers: Mapping[str, Any]) -> None:
        """
        Count a block or look that shows a cause, or begin anew, and warn when enough have come in a row.

        :param cause: a key of :attr:`remedies`
        :param is_so: whether this block or look shows the cause
        :param patience: number of blocks or looks in a row that lead to a warning
        :param numbers: name -> number, for the places in the message
        """
        self.signs_in_a_row[cause] = self.signs_in_a_row.get(cause, 0) + 1 if is_so else 0
        if self.signs_in_a_row[cause] >= patience and cause not in self.signs_told:
            self.signs_told.append(cause)
            warnings.warn(f"After {self.num_timesteps} steps, {self.remedies[cause].format(**numbers)}", stacklevel=2)
