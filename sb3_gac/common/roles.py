"""Which observation entries each role reads: resolved and checked once, when a model is set up."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from gymnasium import spaces

from sb3_gac.common.checks import check_positive
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED

RoleKeys = Mapping[str, Sequence[str]]


class Roles(NamedTuple):
    """
    The networks of an algorithm.

    :param deployed: the policy that acts without privileged entries
    :param others: the rest; names of critics end in "critic"
    """

    deployed: str
    others: tuple[str, ...]

    @property
    def all(self) -> tuple[str, ...]:
        """Every role, the deployed one first."""
        return (self.deployed, *self.others)

    @property
    def policies(self) -> list[str]:
        """All but the critics."""
        return [role for role in self.all if not role.endswith("critic")]


def check_observation_space(observation_space: spaces.Space) -> spaces.Dict:
    """
    :raises ValueError: unless the space is a flat ``Dict``
    """
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f'The observation space must be a Dict with an entry "{PARTIAL}" for the learner and others, such as '
            f'"{PRIVILEGED}", for the guider, but the environment has {observation_space}. Wrap the environment in '
            "sb3_gac.envs.SplitObservation, or make one of the registered sb3_gac/* environments."
        )
    return observation_space


def resolve_role_keys(
    observation_space: spaces.Space, roles: Roles, role_keys: RoleKeys | None = None
) -> dict[str, tuple[str, ...]]:
    """
    Complete and check the mapping from roles to observation entries.

    By default the deployed policy reads ``partial`` alone and every other role reads every entry: a guider must see
    what its learner sees, noise included, or it cannot stay close to it.

    :param observation_space: of the environment
    :param roles: of the algorithm
    :param role_keys: role -> entries, for the roles that differ from the default
    :return: role -> entries, for all roles
    :raises ValueError: if a role or an entry is unknown, an entry list is empty, or there is no ``partial`` entry
        for the deployed policy
    """
    entries = tuple(check_observation_space(observation_space).spaces)
    role_keys = role_keys or {}
    unknown_roles = sorted(set(role_keys) - set(roles.all))
    if unknown_roles:
        raise ValueError(f"role_keys names unknown roles {unknown_roles}; the roles are {list(roles.all)}.")
    if roles.deployed not in role_keys and PARTIAL not in entries:
        raise ValueError(
            f'The observation has no entry "{PARTIAL}" (its entries are {list(entries)}). Rename the entry that the '
            f'{roles.deployed} may see to "{PARTIAL}", or name it with role_keys={{"{roles.deployed}": ["<entry>"]}}.'
        )
    resolved = dict.fromkeys(roles.all, entries) | {roles.deployed: (PARTIAL,)}
    for role, keys in role_keys.items():
        if isinstance(keys, str) or not keys:
            raise ValueError(f'role_keys["{role}"] must be a non-empty list of observation entries, got {keys!r}.')
        unknown_keys = [key for key in keys if key not in entries]
        if unknown_keys:
            raise ValueError(
                f'role_keys["{role}"] names unknown observation entries {unknown_keys}; the observation has {list(entries)}.'
            )
        resolved[role] = tuple(keys)
    return resolved


def role_space(observation_space: spaces.Dict, keys: Sequence[str]) -> spaces.Dict:
    """The part of the observation space that a role reads."""
    return spaces.Dict({key: observation_space.spaces[key] for key in keys})


def resolve_net_arch(roles: Roles, net_arch: list[int] | Mapping[str, list[int]] | None) -> dict[str, list[int]]:
    """
    Hidden layer sizes per role.

    :param roles: of the algorithm
    :param net_arch: one list for all roles, SB3's ``{"pi": [...], "qf": [...]}``, or one list for each policy and one
        for "critic"; ``None`` for [256, 256]
    :return: role -> sizes, for all roles
    :raises ValueError: if the names are of neither form
    """
    if net_arch is None:
        net_arch = [256, 256]
    if isinstance(net_arch, list):
        return dict.fromkeys(roles.all, net_arch)
    policies = roles.policies
    if set(net_arch) == {"pi", "qf"}:
        net_arch = {**dict.fromkeys(policies, net_arch["pi"]), "critic": net_arch["qf"]}
    if set(net_arch) != {*policies, "critic"}:
        raise ValueError(
            f'net_arch must be a list, {{"pi": [...], "qf": [...]}} or one list for each of {[*policies, "critic"]}, '
            f"got {net_arch!r}."
        )
    return {role: net_arch[role if role in policies else "critic"] for role in roles.all}


def resolve_lr_scales(roles: Roles, lr_scales: Mapping[str, float] | None) -> dict[str, float]:
    """
    Learning rates per role.

    :param roles: of the algorithm
    :param lr_scales: role, or "critic" for all critics -> multiple of the learning rate, where it is not 1
    :return: role -> multiple, for all roles
    :raises ValueError: if a role is unknown or a multiple is not a number above 0
    """
    lr_scales = dict(lr_scales or {})
    unknown_roles = sorted(set(lr_scales) - {*roles.all, "critic"})
    if unknown_roles:
        raise ValueError(f'lr_scales names unknown roles {unknown_roles}; the roles are {[*roles.all, "critic"]}.')
    for role, scale in lr_scales.items():
        check_positive(f'lr_scales["{role}"]', scale)
    default = {role: 1.0 if role in roles.policies else lr_scales.get("critic", 1.0) for role in roles.all}
    return {role: lr_scales.get(role, default[role]) for role in roles.all}
