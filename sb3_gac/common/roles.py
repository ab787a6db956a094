"""Which observation entries each role reads: resolved and checked once, when a model is set up."""

from collections.abc import Mapping, Sequence

from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED

ROLES = ("guider", "learner", "guider_critic", "learner_critic")

RoleKeys = Mapping[str, Sequence[str]]


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


def resolve_role_keys(observation_space: spaces.Space, role_keys: RoleKeys | None = None) -> dict[str, tuple[str, ...]]:
    """
    Complete and check the mapping from roles to observation entries.

    By default the learner reads ``partial`` alone and every other role reads every entry: the guider must see what
    the learner sees, noise included, or it cannot stay close to it.

    :param observation_space: of the environment
    :param role_keys: role -> entries, for the roles that differ from the default
    :return: role -> entries, for all of ``ROLES``
    :raises ValueError: if a role or an entry is unknown, an entry list is empty, or there is no ``partial`` entry
        for the learner
    """
    entries = tuple(check_observation_space(observation_space).spaces)
    role_keys = role_keys or {}
    unknown_roles = sorted(set(role_keys) - set(ROLES))
    if unknown_roles:
        raise ValueError(f"role_keys names unknown roles {unknown_roles}; the roles are {list(ROLES)}.")
    if "learner" not in role_keys and PARTIAL not in entries:
        raise ValueError(
            f'The observation has no entry "{PARTIAL}" (its entries are {list(entries)}). Rename the entry that the '
            f'learner may see to "{PARTIAL}", or name it with role_keys={{"learner": ["<entry>"]}}.'
        )
    resolved = dict.fromkeys(ROLES, entries) | {"learner": (PARTIAL,)}
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


def resolve_net_arch(net_arch: list[int] | Mapping[str, list[int]] | None) -> dict[str, list[int]]:
    """
    Hidden layer sizes per role.

    :param net_arch: one list for all roles, SB3's ``{"pi": [...], "qf": [...]}``, or one list for each of
        ``guider``, ``learner``, ``critic``; ``None`` for [256, 256]
    :return: role -> sizes, for all of ``ROLES``
    :raises ValueError: if the names are of neither form
    """
    if net_arch is None:
        net_arch = [256, 256]
    if isinstance(net_arch, list):
        return dict.fromkeys(ROLES, net_arch)
    if set(net_arch) == {"pi", "qf"}:
        net_arch = {"guider": net_arch["pi"], "learner": net_arch["pi"], "critic": net_arch["qf"]}
    if set(net_arch) != {"guider", "learner", "critic"}:
        raise ValueError(
            'net_arch must be a list, {"pi": [...], "qf": [...]} or {"guider": [...], "learner": [...], "critic": [...]}, '
            f"got {net_arch!r}."
        )
    return {
        "guider": net_arch["guider"],
        "learner": net_arch["learner"],
        "guider_critic": net_arch["critic"],
        "learner_critic": net_arch["critic"],
    }
