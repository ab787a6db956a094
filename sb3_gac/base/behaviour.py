"""Which policy collects the data: one, or a share of episodes or of environments for each."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from stable_baselines3.common.type_aliases import Schedule

from sb3_gac.base.roles import Roles
from sb3_gac.checks.values import check_choice
from sb3_gac.schedules import as_schedule

#: A policy's name, or name -> share of episodes, a number or a schedule, which may be text; the default policy has the rest
BehaviourSpec: TypeAlias = str | Mapping[str, float | str | Schedule] | None


class Behaviour:
    """
    Chooses which policy acts in each environment.

    :param roles: of the algorithm
    :param behaviour: see ``BehaviourSpec``; ``None`` for the policy that the algorithm collects with
    :param per: "episode": drawn anew at each episode's start; "environment": the share is one of environments
    :param frozen: names of frozen policies, which may act as well
    :raises ValueError: if a name is no policy's, or shares are not from 0 to 1
    """

    def __init__(self, roles: Roles, behaviour: BehaviourSpec, per: str = "episode", frozen: Sequence[str] = ()):
        self.default = behaviour if isinstance(behaviour, str) else roles.behaviour
        shares = behaviour if isinstance(behaviour, Mapping) else {}
        self.shares: dict[str, Any] = {role: _read_share(role, share) for role, share in shares.items()}
        self.per = per
        for role in (self.default, *self.shares):
            check_choice("behaviour: a policy", role, (*roles.policies, *frozen))
        self.shares_at(1.0)

    def acts(self, role: str) -> bool:
        """
        :param role: a policy
        :return: whether it has a share at some time of training, of which nine are looked at
        """
        return any(self._share_of(role, eighths / 8) > 0 for eighths in range(9))

    def _share_of(self, role: str, progress_remaining: float) -> float:
        shares = self.shares_at(progress_remaining)
        return shares.get(role, 0.0) + (1.0 - sum(shares.values()) if role == self.default else 0.0)

    def shares_at(self, progress_remaining: float) -> dict[str, float]:
        """
        :param progress_remaining: from 1 to 0
        :return: share of each policy that has one by name
        :raises ValueError: if these are no shares
        """
        now = {role: float(share(progress_remaining) if callable(share) else share) for role, share in self.shares.items()}
        if not (all(0 <= share <= 1 for share in now.values()) and sum(now.values()) <= 1 + 1e-9):
            raise ValueError(f"behaviour must be shares from 0 to 1 that sum up to 1 at most, got {now}.")
        return now

    def choose(self, acting: Sequence[str], episode_start: np.ndarray, progress_remaining: float) -> list[str]:
        """
        :param acting: role that acted last in each environment
        :param episode_start: true where an episode starts, shape (n_envs,)
        :param progress_remaining: from 1 to 0
        :return: role that acts now in each environment; it changes at an episode's start alone
        """
        if not self.shares or not episode_start.any():
            return list(acting) if self.shares else [self.default] * len(episode_start)
        shares = self.shares_at(progress_remaining)
        names, limits = list(shares), np.cumsum(list(shares.values()))
        n_envs = len(episode_start)
        drawn = np.random.rand(n_envs) if self.per == "episode" else (np.arange(n_envs) + 0.5) / n_envs
        chosen = [next((name for name, limit in zip(names, limits, strict=True) if u < limit), self.default) for u in drawn]
        return [new if starts else old for new, old, starts in zip(chosen, acting, episode_start, strict=True)]


def _read_share(role: str, share: Any) -> Any:
    try:
        return as_schedule(share)
    except ValueError as error:
        raise ValueError(f"behaviour, {role}: {error}") from None
