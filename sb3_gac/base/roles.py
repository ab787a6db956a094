"""The roles of an algorithm's networks, and settings for each: entries, layers, rates and memories, checked at set-up."""

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor

from sb3_gac.checks.entries import check_entries
from sb3_gac.checks.values import check_choice, check_integer, check_positive
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.networks.recurrent import CELLS

CRITICS = "critic"
MEMORY = "memory"
DEFAULT_NET_ARCH = (256, 256)
T = TypeVar("T")

RoleKeys = Mapping[str, Sequence[str]]


class Roles(NamedTuple):
    """
    The networks of an algorithm that are trained, by kind.

    :param deployed: policy that acts without privileged entries
    :param actors: other policies
    :param critics: ensembles of Q-functions, each with a target network
    :param target_policies: those of the policies that have a target network as well
    :param unprivileged: those of the networks that read only the deployed policy's entries unless ``role_keys`` names others
    :param values: state-value networks, without target networks
    :param collects: policy that acts in training; ``None`` for the deployed one
    :param parts: parts of networks that have an optimiser of their own, each an attribute of the policy
    :param tied: those of the other policies whose hidden layers are the deployed policy's
    """

    deployed: str
    actors: tuple[str, ...] = ()
    critics: tuple[str, ...] = ()
    target_policies: tuple[str, ...] = ()
    unprivileged: tuple[str, ...] = ()
    values: tuple[str, ...] = ()
    collects: str | None = None
    parts: tuple[str, ...] = ()
    tied: tuple[str, ...] = ()

    @property
    def policies(self) -> tuple[str, ...]:
        """Every policy, the deployed one first."""
        return (self.deployed, *self.actors)

    @property
    def others(self) -> tuple[str, ...]:
        """Every network except the deployed policy's."""
        return (*self.actors, *self.critics, *self.values)

    @property
    def networks(self) -> tuple[str, ...]:
        """Every policy, critic and state-value network, the deployed policy first."""
        return (self.deployed, *self.others)

    @property
    def all(self) -> tuple[str, ...]:
        """Every network, the deployed policy first, and every part of a network that has an optimiser of its own."""
        return (*self.networks, *self.parts)

    @property
    def behaviour(self) -> str:
        """The policy that collects the data."""
        return self.collects or self.deployed


def check_observation_space(observation_space: spaces.Space) -> spaces.Dict:
    """
    Check that an observation space is a ``Dict`` of entries that can be learned from.

    :param observation_space: observation space of an environment
    :return: observation space that was given
    :raises ValueError: if the space is no such ``Dict``
    """
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f'The observation space must be a Dict with an entry "{PARTIAL}" for the learner and others, such as '
            f'"{PRIVILEGED}", for the guider, but the environment has {observation_space}. Wrap the environment in '
            "sb3_gac.envs.SplitObservation, or make one of the registered sb3_gac/* environments."
        )
    check_entries(observation_space)
    return observation_space


def resolve_role_keys(
    observation_space: spaces.Space, roles: Roles, role_keys: RoleKeys | None = None
) -> dict[str, tuple[str, ...]]:
    """
    Complete and check the mapping from roles to observation entries.

    By default the deployed policy reads ``partial`` alone, unprivileged roles read the deployed policy's entries, and every
    other role reads every entry: a guider must see what its learner sees, noise included, or it cannot stay close to it.

    :param observation_space: observation space of the environment
    :param roles: roles of the algorithm
    :param role_keys: role, or "critic" for all critics -> entries, for roles that differ from the default
    :return: role -> entries, for all networks
    :raises ValueError: if a role or an entry is unknown, a list of entries is empty, or there is no ``partial`` entry
        for the deployed policy
    """
    entries = tuple(check_observation_space(observation_space).spaces)
    role_keys = _check_roles("role_keys", roles.networks, role_keys or {})
    if roles.deployed not in role_keys and PARTIAL not in entries:
        raise ValueError(
            f'The observation has no entry "{PARTIAL}" (its entries are {list(entries)}). Rename the entry that the '
            f'{roles.deployed} may see to "{PARTIAL}", join several by sb3_gac.envs.SplitDictObservation, or '
            f'name it with role_keys={{"{roles.deployed}": ["<entry>"]}}.'
        )
    resolved = dict.fromkeys(roles.networks, entries) | {roles.deployed: (PARTIAL,)}
    resolved |= dict.fromkeys(roles.unprivileged, tuple(role_keys.get(roles.deployed, (PARTIAL,))))
    for name, keys in role_keys.items():
        if isinstance(keys, str) or not keys:
            raise ValueError(f'role_keys["{name}"] must be a non-empty list of observation entries, got {keys!r}.')
        unknown_keys = [key for key in keys if key not in entries]
        if unknown_keys:
            raise ValueError(
                f'role_keys["{name}"] names unknown observation entries {unknown_keys}; the observation has {list(entries)}.'
            )
    return resolved | {role: tuple(keys) for role, keys in _for_each_role(roles, role_keys).items()}


def role_space(observation_space: spaces.Dict, keys: Sequence[str]) -> spaces.Dict:
    """
    The part of an observation space that a role reads.

    :param observation_space: observation space of the environment
    :param keys: names of the entries that the role reads
    :return: space of these entries
    """
    return spaces.Dict({key: observation_space.spaces[key] for key in keys})


def resolve_net_arch(roles: Roles, net_arch: list[int] | Mapping[str, list[int]]) -> dict[str, list[int]]:
    """
    Hidden layer sizes per role.

    :param roles: roles of the algorithm
    :param net_arch: one list of sizes for all roles, SB3's ``{"pi": [...], "qf": [...]}``, or one list for each policy and
        one for "critic"; a list for a policy whose layers are the deployed one's has no effect, and is warned of
    :return: role -> list of sizes, for all networks
    :raises ValueError: if ``net_arch`` has none of these forms, or a size is no integer above 0
    """
    policies = tuple(role for role in roles.policies if role not in roles.tied)
    if isinstance(net_arch, list):
        net_arch = {**dict.fromkeys(policies, net_arch), CRITICS: net_arch}
    if isinstance(net_arch, Mapping) and set(net_arch) == {"pi", "qf"}:
        net_arch = {**dict.fromkeys(policies, net_arch["pi"]), CRITICS: net_arch["qf"]}
    if isinstance(net_arch, Mapping) and (needless := sorted(set(net_arch) & set(roles.tied))):
        # Models of earlier versions have these sizes in their files
        deployed = f"those of the {roles.deployed}"
        warnings.warn(f"net_arch has {needless}, whose layers are {deployed}: leave them out.", stacklevel=2)
        net_arch = {role: sizes for role, sizes in net_arch.items() if role not in needless}
    if not isinstance(net_arch, Mapping) or set(net_arch) != {*policies, CRITICS}:
        raise ValueError(
            f'net_arch must be a list, {{"pi": [...], "qf": [...]}} or one list for each of {[*policies, CRITICS]}, '
            f"got {net_arch!r}."
        )
    for sizes in net_arch.values():
        for size in sizes:
            check_integer("net_arch: a layer's size", size, 1)
    sizes_of = dict.fromkeys(roles.networks, net_arch[CRITICS]) | dict.fromkeys(roles.tied, net_arch[roles.deployed])
    return sizes_of | {role: net_arch[role] for role in policies}


def resolve_lr_scales(roles: Roles, lr_scales: Mapping[str, float] | None) -> dict[str, float]:
    """
    Multiples of the learning rate per role.

    :param roles: roles of the algorithm
    :param lr_scales: role, or "critic" for all critics -> multiple of the learning rate, where it is not 1; and "memory" ->
        multiple of its network's rate, for the memory of every network that has one
    :return: role -> multiple, for all roles, and "memory" -> multiple for memories
    :raises ValueError: if a role is unknown or a multiple is not a number above 0
    """
    lr_scales = _check_roles("lr_scales", (*roles.all, MEMORY), lr_scales or {})
    for role, scale in lr_scales.items():
        check_positive(f'lr_scales["{role}"]', scale)
    of_roles = dict.fromkeys(roles.all, 1.0) | _for_each_role(roles, lr_scales)
    return of_roles | {MEMORY: lr_scales.get(MEMORY, 1.0)}


def resolve_update_every(roles: Roles, policy_delay: int, update_every: Mapping[str, int] | None) -> dict[str, int]:
    """
    Number of gradient steps for each step of a network, per role.

    :param roles: roles of the algorithm
    :param policy_delay: number of gradient steps for each step of a policy's network
    :param update_every: role, or "critic" for all critics -> number of gradient steps for each step of its network; by
        default ``policy_delay`` for policies and 1 for all others. A policy whose layers are those of other networks has
        steps as often as they have
    :return: role -> number of gradient steps, for all roles
    :raises ValueError: if a role is unknown or a number is no integer above 0
    """
    given = _check_roles("update_every", roles.all, update_every or {})
    for role, every in given.items():
        check_integer(f'update_every["{role}"]', every, 1)
    delayed = [role for role in roles.policies if role not in roles.tied]
    return dict.fromkeys(roles.all, 1) | dict.fromkeys(delayed, policy_delay) | _for_each_role(roles, given)


def resolve_rnn_types(
    roles: Roles, rnn_type: str | Mapping[str, str | None] | None, role_keys: Mapping[str, tuple[str, ...]]
) -> dict[str, str | None]:
    """
    Type of memory per role.

    :param roles: roles of the algorithm
    :param rnn_type: "gru", "lstm", "lru" or ``None`` for all roles; or role, or "critic" for all critics -> one of these, and
        "partial" -> one of these for every network that reads the entry ``partial`` alone and is not named otherwise
    :param role_keys: role -> entries that it reads, for all networks
    :return: role -> type, or ``None`` for a network without a memory, for all networks
    :raises ValueError: if a role or a type is unknown
    """
    by_role = rnn_type if isinstance(rnn_type, Mapping) else dict.fromkeys(roles.networks, rnn_type)
    given = _check_roles("rnn_type", (*roles.networks, PARTIAL), by_role)
    for value in given.values():
        if value is not None:
            check_choice("rnn_type", value, CELLS)
    sees_little = [role for role in roles.networks if role_keys[role] == (PARTIAL,)]
    return dict.fromkeys(roles.networks) | dict.fromkeys(sees_little, given.get(PARTIAL)) | _for_each_role(roles, given)


def resolve_extractors(
    roles: Roles, extractor: type[BaseFeaturesExtractor] | Mapping[str, type[BaseFeaturesExtractor]]
) -> dict[str, type[BaseFeaturesExtractor]]:
    """
    Class of the encoder per role.

    :param roles: roles of the algorithm
    :param extractor: one class for all roles; or role, or "critic" for all critics -> class, where it is not
        ``CombinedExtractor``, SB3's default
    :return: role -> class, for all networks
    :raises ValueError: if a role is unknown
    """
    if not isinstance(extractor, Mapping):
        return dict.fromkeys(roles.networks, extractor)
    given = _check_roles("features_extractor_class", roles.networks, extractor)
    return dict.fromkeys(roles.networks, CombinedExtractor) | _for_each_role(roles, given)


def _check_roles(name: str, roles: Sequence[str], given: Mapping[str, T]) -> Mapping[str, T]:
    known = list(dict.fromkeys([*roles, CRITICS]))
    unknown_roles = sorted(set(given) - set(known))
    if unknown_roles:
        raise ValueError(f"{name} names unknown roles {unknown_roles}; the roles are {known}.")
    return given


def _for_each_role(roles: Roles, values: Mapping[str, T]) -> dict[str, T]:
    """Values by role, where the value of "critic" is that of every critic that is not named itself."""
    of_critics = {role: values[CRITICS] for role in roles.critics if CRITICS in values}
    return of_critics | {role: value for role, value in values.items() if role in roles.all}
