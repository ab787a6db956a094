"""Whether a guider adds nothing to its learner, or too much: what training shows of it, and the setting to change."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_gac.base.batch import Batch
from sb3_gac.base.comparing import ReturnComparison

#: Episodes of each policy that make a block; blocks share none, so that chance does not carry over from one to the next
BLOCK = 40
#: Blocks in a row before a warning: chance alone makes a limit of 97.5% fail three times running once in 60,000
BLOCKS_IN_A_ROW = 3
#: What a guider's episodes must return more than the learner's to count, in standard deviations of a policy's returns
SMALL_EFFECT = 0.5
#: What the guider must gain to count by the learner's critics, in standard deviations of Q over the states
SMALL_GAIN = 0.05
#: KL as a multiple of its target below which the guider does not use its freedom, and above which it is not held
LITTLE_KL, MUCH_KL = 0.1, 2.0
#: Looks in a row before a warning by critics or KL, which change slowly
LOOKS_IN_A_ROW = 10
QUANTILE = 1.96


def effect_bounds(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """
    The difference of two policies' mean returns, in standard deviations of a policy's returns.

    :param first: returns of a policy's episodes, two at least
    :param second: of the other one's
    :return: the 95% interval of the first less the second, by Welch's standard error
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
    What the guider returns more than the learner, by the performance difference lemma (Kakade & Langford 2002): the
    advantages of its actions over the learner's, by critics of the learner, in states that the guider meets.

    :param advantages: Q(s, guider's action) - Q(s, learner's action) by N critics, shape (N, B)
    :param horizon: steps that returns sum up, 1 / (1 - gamma)
    :param scale: standard deviation of Q over the states, which, other than its mean, no constant in the reward moves
    :return: the gain in units of the scale, and its standard error, of the states drawn and of critics that disagree
    """
    n_critics, n_states = advantages.shape
    over_states = advantages.mean(dim=0).var(unbiased=False) / n_states
    over_critics = advantages.mean(dim=1).var(unbiased=False) / max(n_critics - 1, 1)
    unit = horizon / max(scale, 1e-8)
    return float(advantages.mean()) * unit, math.sqrt(float(over_states + over_critics)) * unit


class GuidanceSigns(ReturnComparison):
    """
    Looks at the guider every ``compare_every`` environment steps, and whenever both policies have ended a block of episodes.

    An absent gain is no more than a lack of data unless what is left of it is small: a guider adds nothing where the upper
    95% limit of its advantage is below a small one, and too much where the lower limit of it is above nought, or KL is far
    above its target. Each warning is given once in a training. Looking changes no random number, and no network.
    """

    batch_size: int
    gamma: float
    _last_metrics: Mapping[str, float]
    _sample_batch: Callable[[int], Batch]
    #: Cause -> what happened, with places for numbers, and which setting to change
    remedies: ClassVar[Mapping[str, str]]
    #: Role of a policy -> returns of the episodes of the block under way
    block: dict[str, list[float]]
    #: Cause -> blocks or looks in a row that showed it
    signs_in_a_row: dict[str, int]
    #: Causes that were warned of
    signs_told: list[str]

    def start_comparing(self, first: str, second: str, compare_every: int, window: int) -> None:
        """
        :param first: role of the guider
        :param second: role of the learner
        :param compare_every: environment steps between two looks
        :param window: see :class:`ReturnComparison`
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
        if is_due and self._n_updates:
            self._judge_kl(self._last_metrics)
            self._judge_gain(*self.guider_gain())

    def training_state(self) -> dict[str, Any]:
        """See :meth:`ResumableAlgorithm.training_state`."""
        names = ("block", "signs_in_a_row", "signs_told")
        return super().training_state() | {name: getattr(self, name) for name in names}

    @th.no_grad()
    def guider_gain(self) -> tuple[float, float]:
        """
        What the guider's actions gain over the learner's by critics of the learner, each policy without its exploration.

        :return: see :func:`gain_and_error`
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
        """Of a policy's actions in the states that count, shape (N, B); of discrete ones by the smaller critic, (1, B)."""
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
        numbers = {"kl": metrics["kl"], "target": metrics["target_kl"], "coefficient": metrics["kl_coef"]}
        share = metrics["kl"] / metrics["target_kl"]
        is_free = metrics["kl_coef_on_bound"] > 0.5
        self._judge("nothing by kl", share < LITTLE_KL and is_free, LOOKS_IN_A_ROW, numbers)
        self._judge("held back by kl", share < LITTLE_KL and not is_free, LOOKS_IN_A_ROW, numbers)
        self._judge("too much by kl", share > MUCH_KL, LOOKS_IN_A_ROW, numbers)

    def _judge(self, cause: str, is_so: bool, patience: int, numbers: Mapping[str, Any]) -> None:
        """
        :param cause: a key of :attr:`remedies`
        :param is_so: whether this block or look shows it
        :param patience: how many in a row make a warning
        :param numbers: for its message
        """
        self.signs_in_a_row[cause] = self.signs_in_a_row.get(cause, 0) + 1 if is_so else 0
        if self.signs_in_a_row[cause] >= patience and cause not in self.signs_told:
            self.signs_told.append(cause)
            warnings.warn(f"After {self.num_timesteps} steps, {self.remedies[cause].format(**numbers)}", stacklevel=2)


@contextmanager
def random_numbers_kept(device: th.device) -> Iterator[None]:
    """
    Afterwards numpy's and torch's generators go on from where they were.

    :param device: of the networks
    """
    state = np.random.get_state()
    with th.random.fork_rng(devices=[th.cuda.current_device()] if device.type == "cuda" else []):
        yield
    np.random.set_state(state)
