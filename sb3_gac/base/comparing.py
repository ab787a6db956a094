"""Two policies of an algorithm, compared by the returns of the episodes that each has acted in."""

from abc import abstractmethod
from typing import Any

import numpy as np

from sb3_gac.base.hooks import EpisodeHooks


class ReturnComparison(EpisodeHooks):
    """
    Every ``compare_every`` environment steps, the mean returns of two policies' latest ``window`` episodes, as Teacher-Guided
    RL has it (arXiv 2307.03186). Neither the warm-up nor frozen policies count.
    """

    compare_every: int
    window: int
    #: Role of a policy -> returns of its latest episodes, the two that are compared
    returns: dict[str, list[float]]
    next_comparison: int

    def start_comparing(self, first: str, second: str, compare_every: int, window: int) -> None:
        """
        :param first: role of a policy
        :param second: role of the other one
        :param compare_every: environment steps between two comparisons
        :param window: episodes of each that are compared
        """
        self.compare_every, self.window = compare_every, window
        self.returns, self.next_comparison = {first: [], second: []}, compare_every

    @abstractmethod
    def compare(self, difference: float) -> None:
        """
        :param difference: mean return of the first policy, less that of the second
        """

    def on_episode_end(self, env: int, episode_return: float, role: str | None) -> None:
        """See :meth:`EpisodeHooks.on_episode_end`."""
        if role in self.returns:
            self.returns[role] = [*self.returns[role], episode_return][-self.window :]

    def on_step(self) -> None:
        """See :meth:`EpisodeHooks.on_step`."""
        if self.num_timesteps < self.next_comparison:
            return
        self.next_comparison = self.num_timesteps - self.num_timesteps % self.compare_every + self.compare_every
        if all(self.returns.values()):
            first, second = (float(np.mean(returns)) for returns in self.returns.values())
            self.compare(first - second)

    def training_state(self) -> dict[str, Any]:
        """See :meth:`ResumableAlgorithm.training_state`."""
        return {"returns": self.returns, "next_comparison": self.next_comparison}
