"""The choice of the policy that collects the data: one, or several by shares of episodes or of environments."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from stable_baselines3.common.type_aliases import Schedule

from sb3_gac.base.roles import Roles
from sb3_gac.checks.values import check_choice
from sb3_gac.schedules import as_schedule

#: A policy's name; or name -> share, a number or a schedule (which may be text). The remainder is that of the policy that
#: collects by default, or of the deployed policy where the former has a share itself
BehaviourSpec: TypeAlias = str | Mapping[str, float | str | Schedule] | None

#: Fractions of training that remain, at which shares are looked at ahead of training
MOMENTS = tuple(eighths / 8 for eighths in range(9))


class Behaviour:
    """
    Chooses which policy acts in each environment.

    :param roles: roles of the algorithm
    :param behaviour: name of a policy, or name -> share, see ``BehaviourSpec``; ``None`` for the policy that the algorithm
        collects data with
    :param per: unit of the shares: "episode", where a policy is drawn at each episode's start, or "environment", where each
        policy has a fixed part of the environments
    :param frozen: names of frozen policies, which may act as well
    :param n_envs: number of environments
    :raises ValueError: if a name is no policy's, or if, at any of ``MOMENTS``, shares are not from 0 to 1, or sum up to less
        than 1 and no policy is left for the remainder
    """

    def __init__(
        self, roles: Roles, behaviour: BehaviourSpec, per: str = "episode", frozen: Sequence[str] = (), n_envs: int = 1
    ):
        self.default = behaviour if isinstance(behaviour, str) else roles.behaviour
        shares = behaviour if isinstance(behaviour, Mapping) else {}
        self.shares: dict[str, Any] = {role: _read_share(role, share) for role, share in shares.items()}
        left = [role for role in (self.default, roles.deployed) if role not in self.shares]
        self.remainder: str | None = left[0] if left else None
        self.per = per
        self.n_envs = n_envs
        for role in (self.default, *self.shares):
            check_choice("behaviour: a policy", role, (*roles.policies, *frozen))
        for moment in MOMENTS:
            self.shares_at(moment)

    def check_parts(self) -> None:
        """
        Check that each policy with a share has a part of the environments, where shares are such parts.

        :raises ValueError: naming a policy whose part is less than one environment at any time
        """
        if not self.shares or self.per == "episode":
            return
        parts = {role for moment in MOMENTS for role in self._parts(self.shares_at(moment), self.n_envs)}
        for role in (*self.shares, *([self.remainder] if self.remainder else [])):
            if role not in parts and self.acts(role):
                raise ValueError(
                    f"behaviour gives {role} a share that is less than one of {self.n_envs} environments, so {role} would "
                    'never act: give more environments or a larger share, or leave behaviour_per "episode".'
                )

    def acts(self, role: str) -> bool:
        """
        Whether a policy ever acts; shares are looked at in nine moments of training, at equal distances.

        :param role: role of the policy
        :return: whether its share is above 0 in one of these moments
        """
        return any(self._share_of(role, moment) > 0 for moment in MOMENTS)

    def _share_of(self, role: str, progress_remaining: float) -> float:
        shares = self.shares_at(progress_remaining)
        return shares.get(role, 0.0) + (1.0 - sum(shares.values()) if role == self.remainder else 0.0)

    def shares_at(self, progress_remaining: float) -> dict[str, float]:
        """
        Shares at a moment of training.

        :param progress_remaining: fraction of training that remains, from 1 to 0
        :return: role -> share, for each policy that was given one
        :raises ValueError: if a share is not from 0 to 1, or their sum above 1, or below 1 without a policy for the remainder
        """
        now = {role: float(share(progress_remaining) if callable(share) else share) for role, share in self.shares.items()}
        when = f"{now} where {progress_remaining:.3g} of training remains"
        if not (all(0 <= share <= 1 for share in now.values()) and sum(now.values()) <= 1 + 1e-9):
            raise ValueError(f"behaviour must be shares from 0 to 1 that sum up to 1 at most, got {when}.")
        if self.shares and self.remainder is None and sum(now.values()) < 1 - 1e-9:
            raise ValueError(f"behaviour must be shares that sum up to 1, as no policy is left for the remainder; got {when}.")
        return now

    def choose(self, acting: Sequence[str], episode_start: np.ndarray, progress_remaining: float) -> list[str]:
        """
        Choose the policy that acts in each environment; where no episode starts, the policy stays.

        :param acting: role of the policy that acted last in each environment
        :param episode_start: booleans, true where an episode starts, shape (n_envs,)
        :param progress_remaining: fraction of training that remains, from 1 to 0
        :return: role of the policy that acts now in each environment
        """
        if not episode_start.any():
            return list(acting)
        n_envs = len(episode_start)
        if not self.shares:
            chosen = [self.default] * n_envs
        elif self.per == "episode":
            chosen = self._drawn(self.shares_at(progress_remaining), np.random.rand(n_envs))
        else:
            chosen = self._parts(self.shares_at(progress_remaining), n_envs)
        return [new if starts else old for new, old, starts in zip(chosen, acting, episode_start, strict=True)]

    def _parts(self, shares: Mapping[str, float], n_envs: int) -> list[str]:
        """The policy of each environment, where policies have fixed parts of them."""
        return self._drawn(shares, (np.arange(n_envs) + 0.5) / n_envs)

    def _drawn(self, shares: Mapping[str, float], numbers: np.ndarray) -> list[str]:
        """
        :param shares: role -> share
        :param numbers: numbers in [0, 1)
        :return: role of the policy in whose part of [0, 1) each number is
        """
        names, limits = list(shares), np.cumsum(list(shares.values()))
        rest = self.remainder or names[-1]  # the last one's limit may be rounded to less than 1
        return [next((name for name, limit in zip(names, limits, strict=True) if u < limit), rest) for u in numbers]


def _read_share(role: str, share: Any) -> Any:
    try:
        return as_schedule(share)
    except ValueError as error:
        raise ValueError(f"behaviour, {role}: {error}") from None
