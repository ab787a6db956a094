"""Comparison of two policies of an algorithm by the returns of the episodes in which each has acted."""

import warnings
from abc import abstractmethod
from typing import Any

import numpy as np

from sb3_gac.base.behaviour import Behaviour
from sb3_gac.base.hooks import EpisodeHooks


class ReturnComparison(EpisodeHooks):
    """
    Compares the mean returns of two policies' latest ``window`` episodes every ``compare_every`` environment steps.

    Teacher-Guided RL compares policies in this way (arXiv 2307.03186). Episodes with actions of the warm-up or of frozen
    policies do not count.
    """

    compare_every: int
    window: int
    #: Role of each of the two compared policies -> returns of its latest episodes
    returns: dict[str, list[float]]
    next_comparison: int

    def start_comparing(self, first: str, second: str, compare_every: int, window: int) -> None:
        """
        Begin to collect the returns of two policies.

        :param first: role of one policy
        :param second: role of the other policy
        :param compare_every: number of environment steps between two comparisons
        :param window: number of latest episodes of each policy whose returns are compared
        """
        self.compare_every, self.window = compare_every, window
        self.returns, self.next_comparison = {first: [], second: []}, compare_every

    def idle_policies(self, behaviour: Behaviour) -> list[str]:
        """
        :param behaviour: shares of the policies in the data
        :return: roles of those of the two policies that never act, so that there would be no comparison
        """
        return [role for role in self.returns if not behaviour.acts(role)]

    def warn_of_idle_policies(self, what: str, behaviour: Behaviour) -> None:
        """
        Warn if one of the two policies never acts.

        :param what: subject of the message, which the comparison was to change
        :param behaviour: shares of the policies in the data
        """
        if idle := self.idle_policies(behaviour):
            warnings.warn(
                f"{what} stays as it is, since episodes of {' and '.join(self.returns)} are compared, but behaviour gives "
                f"none to {' and '.join(idle)}: give each a share, or leave behaviour out.",
                stacklevel=3,
            )

    @abstractmethod
    def compare(self, difference: float) -> None:
        """
        Called after each comparison.

        :param difference: mean return of the first policy minus that of the second
        """

    def on_episode_end(self, env: int, episode_return: float, role: str | None) -> None:
        """See :meth:`EpisodeHooks.on_episode_end`."""
        if role in self.returns:
            self.returns[role] = [*self.returns[role], episode_return][-self.window :]

    def on_step(self) -> None:
        """See :meth:`EpisodeHooks.on_step`."""
        is_due = self.num_timesteps >= self.next_comparison
        counts_anew = self.next_comparison > self.num_timesteps + self.compare_every  # in another learn(), from 0 again
        if is_due or counts_anew:
            self.next_comparison = self.num_timesteps - self.num_timesteps % self.compare_every + self.compare_every
        if is_due and all(self.returns.values()):
            first, second = (float(np.mean(returns)) for returns in self.returns.values())
            self.compare(first - second)

    def training_state(self) -> dict[str, Any]:
        """See :meth:`ResumableAlgorithm.training_state`."""
        return {"returns": self.returns, "next_comparison": self.next_comparison}
