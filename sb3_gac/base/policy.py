"""The base of policies with a privileged view: networks by role, target networks and optimisers."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn

from sb3_gac.base.arguments import ConstructorArguments
from sb3_gac.base.optimizers import OptimizedPolicy
from sb3_gac.base.roles import (
    DEFAULT_NET_ARCH,
    RoleKeys,
    resolve_extractors,
    resolve_net_arch,
    resolve_rnn_types,
    resolve_role_keys,
    role_space,
)
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.checks.entries import ObservationReader
from sb3_gac.checks.values import check_choice, check_integer
from sb3_gac.networks.actors import Actor, RolePolicy
from sb3_gac.networks.critics import CriticEnsemble, DiscreteCriticEnsemble
from sb3_gac.networks.encoders import EntryExtractor, VectorExtractor
from sb3_gac.networks.heads import LOG_STD_BOUNDS
from sb3_gac.networks.layers import INITIALIZATIONS, lecun_uniform_
from sb3_gac.networks.recurrent import RecurrentCore
from sb3_gac.networks.tied import write_each_tensor_once
from sb3_gac.networks.values import StateValue
from sb3_gac.optim.polyak import polyak_average


class AsymmetricPolicy(ConstructorArguments, OptimizedPolicy):
    """
    The networks of an algorithm's ``roles``, each reading the observation entries of its role, and their optimisers.

    As a policy it acts like the deployed one. Each network is the attribute of its role's name, and its target network is
    ``<role>_target``. A subclass names its ``roles``. It overrides :meth:`make_policy` where a policy's network is of
    another class, and :meth:`acting_distributions` where policies act relative to each other.

    :param observation_space: Dict space of the observations
    :param action_space: Box or Discrete space of the actions
    :param lr_schedule: schedule of the learning rate
    :param net_arch: hidden layer sizes: one list for all networks, ``{"pi": [...], "qf": [...]}``, or one list for each
        policy and one for "critic"; ``None`` for two layers of 256 units
    :param activation_fn: class of the activation between layers
    :param role_keys: role -> observation entries, see :func:`sb3_gac.base.roles.resolve_role_keys`
    :param lr_scales: network -> multiple of the learning rate, see :func:`sb3_gac.base.roles.resolve_lr_scales`
    :param n_critics: number of networks in each critic ensemble
    :param log_std_bounds: smallest and largest logarithm of the standard deviation before tanh
    :param features_extractor_class: class of the encoders, of which each role has one on its entries; or role -> class
    :param features_extractor_kwargs: keyword arguments of that class
    :param share_features_extractor: whether the other roles take the deployed policy's features of its entries as they are
        and encode only the other entries themselves, which saves most of the work where ``partial`` is an image. The
        deployed policy's loss trains the shared encoder. Roles that read none of its entries have an encoder of their own
    :param normalize_images: whether to divide images by 255
    :param optimizer_class: class of the optimisers of all networks
    :param optimizer_kwargs: keyword arguments of that class, without the learning rate
    :param rnn_type: type of the networks' memories, "gru", "lstm" or "lru" (a linear recurrent unit, for long delays), with
        which they take sequences; or role -> type, where "critic" stands for all critics and "partial" for every network
        that reads ``partial`` alone; ``None`` for the default of the policy class
    :param rnn_hidden_size: size of the recurrent layer, which comes after the layers of ``net_arch``
    :param rnn_net_arch: hidden layer sizes after the recurrent layer
    :param softplus_min_std: smallest standard deviation, to which softplus of the network's output is added (Brax has 0.001);
        ``None`` for a standard deviation that is exp of the output within ``log_std_bounds``
    :param initialization: initial weights: "torch" for torch's own, or "lecun_uniform" for Brax's, see
        :func:`sb3_gac.networks.layers.lecun_uniform_`
    """

    #: Value of the argument ``rnn_type`` where it is ``None``
    default_rnn_type: ClassVar[str | None] = None

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        role_keys: RoleKeys | None = None,
        lr_scales: Mapping[str, float] | None = None,
        n_critics: int = 2,
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
        features_extractor_class: type[BaseFeaturesExtractor] | Mapping[str, type[BaseFeaturesExtractor]] = CombinedExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = False,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        rnn_type: str | Mapping[str, str] | None = None,
        rnn_hidden_size: int = 256,
        rnn_net_arch: Sequence[int] = (256,),
        softplus_min_std: float | None = None,
        initialization: str = "torch",
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=isinstance(action_space, spaces.Box),
            normalize_images=normalize_images,
        )
        check_integer("n_critics", n_critics, 1)
        check_integer("rnn_hidden_size", rnn_hidden_size, 1)
        check_choice("initialization", initialization, INITIALIZATIONS)
        self.net_arch = list(DEFAULT_NET_ARCH) if net_arch is None else net_arch
        self.constructor_options: dict[str, Any] = {
            "net_arch": self.net_arch,
            "activation_fn": activation_fn,
            "role_keys": role_keys,
            "lr_scales": lr_scales,
            "n_critics": n_critics,
            "log_std_bounds": log_std_bounds,
            "softplus_min_std": softplus_min_std,
            "initialization": initialization,
            "share_features_extractor": share_features_extractor,
            "rnn_type": rnn_type,
            "rnn_hidden_size": rnn_hidden_size,
            "rnn_net_arch": list(rnn_net_arch),
            **self.own_options(),
        }
        self.reader = ObservationReader(observation_space)
        self.n_critics = n_critics
        self.share_features_extractor = share_features_extractor
        self.role_keys = self.complete_role_keys(resolve_role_keys(observation_space, self.roles, role_keys))
        self._role_net_arch = resolve_net_arch(self.roles, self.net_arch)
        self._role_extractors = resolve_extractors(self.roles, features_extractor_class)
        self.rnn_types = resolve_rnn_types(self.roles, rnn_type or self.default_rnn_type, self.role_keys)
        seen = {key for role in self.roles.policies for key in self.role_keys[role]}
        self._acting_reader = ObservationReader(
            role_space(observation_space, [key for key in observation_space if key in seen])
        )
        self._build_networks()
        self._build_optimizers(lr_schedule)

    def own_options(self) -> dict[str, Any]:
        """
        Constructor arguments that a subclass adds, by name, for files to hold.

        The subclass keeps them as attributes before it calls this class's constructor.
        """
        return {}

    @property
    def remembers(self) -> bool:
        """Whether a policy has a memory."""
        return any(getattr(self, role).memory is not None for role in self.roles.policies)

    # --- networks ---------------------------------------------------------------------------------------------------

    def make_policy(self, role: str, **arguments: Any) -> RolePolicy:
        """
        Make the network of a policy.

        :param role: role of the policy
        :param arguments: keyword arguments of the network's class
        :return: network
        """
        return Actor(**arguments)

    def complete_role_keys(self, role_keys: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        """
        Add the observation entries that networks need in any case; a subclass may override this method.

        :param role_keys: network -> entries that it reads by ``role_keys`` or by default
        :return: network -> all entries that it reads
        """
        return role_keys

    def tie_networks(self) -> None:
        """Called once all networks are made; a subclass whose networks have layers in common ties them here."""

    def has(self, role: str) -> bool:
        """
        Whether there is a network for a role; ablations may lack some.

        :param role: one of ``roles``
        """
        return True

    def _build_networks(self) -> None:
        shared: BaseFeaturesExtractor | None = None
        self._check_sharing()
        for role in self.roles.policies:
            policy = self.make_policy(role, **self._role_kwargs(role, shared), **self._std_options)
            setattr(self, role, policy)
            if role == self.roles.deployed and self.share_features_extractor:
                shared = policy.features_extractor
            if role in self.roles.target_policies:
                self._set_target(role, deepcopy(policy))
        ensemble = DiscreteCriticEnsemble if isinstance(self.action_space, spaces.Discrete) else CriticEnsemble
        for role in self.roles.critics:
            setattr(self, role, None)
            setattr(self, f"{role}_target", None)
            if self.has(role):
                setattr(self, role, ensemble(**self._role_kwargs(role, shared), n_critics=self.n_critics))
                self._set_target(role, ensemble(**self._role_kwargs(role, deepcopy(shared)), n_critics=self.n_critics))

        for role in self.roles.values:
            setattr(self, role, StateValue(**self._role_kwargs(role, shared)))
        self.tie_networks()
        if self.constructor_options["initialization"] == "lecun_uniform":
            lecun_uniform_(self)  # targets as well, which stay equal to their networks
        write_each_tensor_once(self)
        pairs = self.pairs.values()
        self._followed: list[th.Tensor] = [parameter for network, _ in pairs for parameter in network.parameters()]
        self._following: list[th.Tensor] = [parameter for _, target in pairs for parameter in target.parameters()]
        self._has_statistics = any(get_parameters_by_name(network, ["running_"]) for network, _ in pairs)

    @property
    def activation_fn(self) -> type[nn.Module]:
        """Class of the activation between layers."""
        return self.constructor_options["activation_fn"]

    @property
    def _std_options(self) -> dict[str, Any]:
        options = {name: self.constructor_options[name] for name in ("log_std_bounds", "softplus_min_std")}
        return {name: value for name, value in options.items() if value is not None}

    def _set_target(self, role: str, target: BaseModel) -> None:
        target.load_state_dict(getattr(self, role).state_dict())
        target.set_training_mode(False)
        setattr(self, f"{role}_target", target)

    def _role_kwargs(self, role: str, shared: BaseFeaturesExtractor | None = None) -> dict[str, Any]:
        """
        Constructor arguments of a role's network.

        :param role: one of ``roles``
        :param shared: encoder of the deployed policy, if this role is to use it; ``None`` for an encoder of the role's own
        :return: name -> argument
        """
        features_extractor, rest_extractor = shared, None
        if shared is None or not self._sees_deployed(role):
            features_extractor = self.make_extractor(role, self.role_keys[role])
        else:
            rest_extractor = self.make_extractor(role, self._keys_beside_the_deployed(role))
        extractors = [extractor for extractor in (features_extractor, rest_extractor) if extractor is not None]
        return {
            "observation_space": role_space(self.observation_space, self.role_keys[role]),  # type: ignore[arg-type]
            "action_space": self.action_space,
            "features_extractor": features_extractor,
            "rest_extractor": rest_extractor,
            "activation_fn": self.activation_fn,
            "normalize_images": self.normalize_images,
            **self.body_arguments(role, sum(extractor.features_dim for extractor in extractors)),
        }

    def body_arguments(self, role: str, features_dim: int) -> dict[str, Any]:
        """
        Constructor arguments for what follows a role's encoder: hidden layers, and a memory if the role has one.

        :param role: role of the network
        :param features_dim: size of the encoder's output
        :return: name -> argument
        """
        net_arch, options, rnn_type = self._role_net_arch[role], self.constructor_options, self.rnn_types[role]
        if rnn_type is None:
            return {"features_dim": features_dim, "net_arch": net_arch}
        hidden_size = options["rnn_hidden_size"]
        members = self.n_critics if role in self.roles.critics else 1
        memory = RecurrentCore(rnn_type, features_dim, net_arch, hidden_size, self.activation_fn, members)
        return {"memory": memory, "features_dim": hidden_size, "net_arch": options["rnn_net_arch"]}

    def make_extractor(self, role: str, keys: Sequence[str]) -> BaseFeaturesExtractor:
        """
        Make an encoder for a role.

        :param role: role of the network
        :param keys: names of the observation entries to encode
        :return: encoder of these entries
        """
        space = role_space(self.observation_space, keys)  # type: ignore[arg-type]
        extractor = self._role_extractors[role]
        if extractor is not CombinedExtractor:
            return extractor(space, **self.features_extractor_kwargs)
        known = constructor_parameters(EntryExtractor)[1:]
        unknown = [name for name in self.features_extractor_kwargs if name not in known]
        if unknown:
            raise ValueError(f"features_extractor_kwargs has {unknown}; the default encoders take {known}.")
        if VectorExtractor.fits(space):
            return VectorExtractor(space)
        return EntryExtractor(space, **self.features_extractor_kwargs)

    def _sees_deployed(self, role: str) -> bool:
        """Whether the role reads any of the deployed policy's entries."""
        return not set(self.role_keys[role]).isdisjoint(self.deployed_entries)

    def _check_sharing(self) -> None:
        others = [role for role in self.roles.others if self.has(role)]
        if self.share_features_extractor and not any(map(self._sees_deployed, others)):
            raise ValueError(
                f"share_features_extractor=True would do nothing, since none of {others} reads the {self.roles.deployed}'s "
                f"entries {list(self.deployed_entries)}: leave it out, or name them in role_keys."
            )

    def _keys_beside_the_deployed(self, role: str) -> list[str]:
        shared = self.deployed_entries
        keys = [key for key in self.role_keys[role] if key not in shared]
        if not keys or not set(shared) < set(self.role_keys[role]):
            raise ValueError(
                f"share_features_extractor=True needs a {role} that reads all of the {self.roles.deployed}'s entries "
                f"{list(shared)} and others, but it reads {list(self.role_keys[role])}."
            )
        return keys

    # --- training ---------------------------------------------------------------------------------------------------

    @property
    def pairs(self) -> dict[str, tuple[BaseModel, BaseModel]]:
        """Role -> (network, target), for each network that has one."""
        roles = (role for role in self.roles.all if getattr(self, f"{role}_target", None) is not None)
        return {role: (getattr(self, role), getattr(self, f"{role}_target")) for role in roles}

    @property
    def side_branch(self) -> tuple[str, ...]:
        """Networks whose gradient steps are independent of those of all others, so that both may run at once."""
        return ()

    def update_targets(self, tau: float) -> None:
        """
        Polyak averaging of the target networks, tau theta + (1 - tau) theta_bar; running statistics are copied.

        :param tau: weight of the networks' present parameters theta, in [0, 1]
        """
        polyak_average(self._followed, self._following, tau)
        for network, target in self.pairs.values() if self._has_statistics else ():  # a move to another device replaces them
            polyak_average(get_parameters_by_name(network, ["running_"]), get_parameters_by_name(target, ["running_"]), 1.0)

    def set_training_mode(self, mode: bool) -> None:
        """
        Put policies and critics in training or evaluation mode; target networks stay in evaluation mode.

        :param mode: whether the mode is that of training
        """
        for network in [getattr(self, role) for role in self.trained]:
            if network.training != mode:  # train() goes through all layers, which would slow down each prediction
                network.train(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return (
            super()._get_constructor_parameters()
            | self.constructor_options
            | {
                "lr_schedule": self._dummy_schedule,
                "optimizer_class": self.optimizer_class,
                "optimizer_kwargs": self.optimizer_kwargs,
                "features_extractor_class": self.features_extractor_class,
                "features_extractor_kwargs": self.features_extractor_kwargs,
            }
        )
