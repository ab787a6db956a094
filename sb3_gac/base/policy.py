"""What policies with a privileged view share: networks by role, target critics, optimisers; as a policy, the deployed one."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn

from sb3_gac.base.roles import (
    DEFAULT_NET_ARCH,
    RoleKeys,
    Roles,
    resolve_lr_scales,
    resolve_net_arch,
    resolve_role_keys,
    role_space,
)
from sb3_gac.checks.entries import ObservationReader
from sb3_gac.checks.values import check_integer
from sb3_gac.math.distributions import Distribution
from sb3_gac.networks.actors import BoundedPolicy, DeployedPolicy
from sb3_gac.networks.critics import CriticEnsemble, DiscreteCriticEnsemble
from sb3_gac.networks.encoders import EntryExtractor, VectorExtractor
from sb3_gac.networks.recurrent import Memory
from sb3_gac.optim.flat import FlatAdam, FlatParameters, TrainedParameters
from sb3_gac.optim.polyak import polyak_average

#: What each network of a behaviour policy remembers, shapes (B, S); ``None`` without memories, and before the first step
BehaviourState: TypeAlias = tuple[np.ndarray, ...] | None


class AsymmetricPolicy(BoundedPolicy):
    """
    Networks that read the observation entries of their roles, and their optimisers.

    A subclass names its ``roles``, builds a network for each as the attribute of that name, with its target as
    ``<name>_target`` where it is a critic, and then calls :meth:`_finish`.

    :param observation_space: Dict
    :param action_space: Box or Discrete
    :param net_arch: hidden layer sizes: one list, ``{"pi", "qf"}``, or one for each policy and one for "critic"
    :param activation_fn: between layers
    :param role_keys: role -> observation entries, see :func:`sb3_gac.base.roles.resolve_role_keys`
    :param lr_scales: network -> multiple of the learning rate, see :func:`sb3_gac.base.roles.resolve_lr_scales`
    :param n_critics: size of each critic ensemble
    :param features_extractor_class: encoder, made once per role on the entries of that role
    :param features_extractor_kwargs: keyword arguments for it
    :param share_features_extractor: whether the other roles see the deployed policy's features of its entries, as they
        are, and encode only the other entries themselves; the deployed policy's loss trains that encoder (saves most
        of the work where ``partial`` is an image)
    :param normalize_images: divide images by 255
    :param optimizer_class: optimiser of policies and critics
    :param optimizer_kwargs: keyword arguments for it, without the learning rate
    :param rnn_hidden_size: of recurrent policies: size of each network's recurrent layer, which comes after ``net_arch``
    :param rnn_net_arch: of recurrent policies: hidden layer sizes after the recurrent layer
    """

    roles: ClassVar[Roles]
    #: "gru" or "lstm" for networks that remember, and then take sequences
    cell: ClassVar[str | None] = None

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        role_keys: RoleKeys | None = None,
        lr_scales: Mapping[str, float] | None = None,
        n_critics: int = 2,
        features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = False,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        rnn_hidden_size: int = 256,
        rnn_net_arch: Sequence[int] = (256,),
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
        self.net_arch = list(DEFAULT_NET_ARCH) if net_arch is None else net_arch
        self.constructor_options: dict[str, Any] = {
            "net_arch": self.net_arch,
            "activation_fn": activation_fn,
            "role_keys": role_keys,
            "lr_scales": lr_scales,
            "n_critics": n_critics,
            "share_features_extractor": share_features_extractor,
            "rnn_hidden_size": rnn_hidden_size,
            "rnn_net_arch": list(rnn_net_arch),
        }
        self.reader = ObservationReader(observation_space)
        self.n_critics = n_critics
        self.share_features_extractor = share_features_extractor
        self.role_keys = resolve_role_keys(observation_space, self.roles, role_keys)
        self._role_net_arch = resolve_net_arch(self.roles, self.net_arch)

    # --- networks ---------------------------------------------------------------------------------------------------

    def _role_kwargs(self, role: str, shared: BaseFeaturesExtractor | None = None) -> dict[str, Any]:
        """
        Constructor arguments of a role's network.

        :param role: one of ``roles``
        :param shared: the deployed policy's encoder, if this role is to use it; without it the role gets one of its own
        """
        features_extractor, rest_extractor = shared, None
        if shared is None:
            features_extractor = self._make_extractor(self.role_keys[role])
        else:
            rest_extractor = self._make_extractor(self._keys_beside_the_deployed(role))
        extractors = [extractor for extractor in (features_extractor, rest_extractor) if extractor is not None]
        return {
            "observation_space": role_space(self.observation_space, self.role_keys[role]),  # type: ignore[arg-type]
            "action_space": self.action_space,
            "features_extractor": features_extractor,
            "rest_extractor": rest_extractor,
            "activation_fn": self.constructor_options["activation_fn"],
            "normalize_images": self.normalize_images,
            **self._body_kwargs(role, sum(extractor.features_dim for extractor in extractors)),
        }

    def _body_kwargs(self, role: str, features_dim: int) -> dict[str, Any]:
        """What comes after a role's encoder: hidden layers, after a memory where policies are recurrent."""
        net_arch, options = self._role_net_arch[role], self.constructor_options
        if self.cell is None:
            return {"features_dim": features_dim, "net_arch": net_arch}
        hidden_size = options["rnn_hidden_size"]
        members = self.n_critics if role in self.roles.critics else 1
        memory = Memory(self.cell, features_dim, net_arch, hidden_size, options["activation_fn"], members)
        return {"memory": memory, "features_dim": hidden_size, "net_arch": options["rnn_net_arch"]}

    def _make_extractor(self, keys: Sequence[str]) -> BaseFeaturesExtractor:
        space = role_space(self.observation_space, keys)  # type: ignore[arg-type]
        if self.features_extractor_class is CombinedExtractor:
            return (
                VectorExtractor(space)
                if VectorExtractor.fits(space)
                else EntryExtractor(space, **self.features_extractor_kwargs)
            )
        return self.features_extractor_class(space, **self.features_extractor_kwargs)

    def _keys_beside_the_deployed(self, role: str) -> list[str]:
        shared = self.role_keys[self.roles.deployed]
        keys = [key for key in self.role_keys[role] if key not in shared]
        if not keys or not set(shared) < set(self.role_keys[role]):
            raise ValueError(
                f"share_features_extractor=True needs a {role} that reads all of the {self.roles.deployed}'s entries "
                f"{list(shared)} and others, but it reads {list(self.role_keys[role])}."
            )
        return keys

    def _make_critic_and_target(
        self, role: str, shared: BaseFeaturesExtractor | None
    ) -> tuple[CriticEnsemble, CriticEnsemble]:
        ensemble = DiscreteCriticEnsemble if isinstance(self.action_space, spaces.Discrete) else CriticEnsemble
        critic = ensemble(**self._role_kwargs(role, shared), n_critics=self.n_critics)
        target = ensemble(**self._role_kwargs(role, deepcopy(shared)), n_critics=self.n_critics)
        target.load_state_dict(critic.state_dict())
        target.set_training_mode(False)
        return critic, target

    def _finish(self, lr_schedule: Schedule, unclipped: int = 0) -> None:
        """
        Once all networks are there: lay out their parameters, and give each network its optimiser, as the attribute that
        SB3's SAC has on actor and critic.

        :param lr_schedule: learning rate schedule
        :param unclipped: how many of the deployed policy's last parameters have no say in the clipping of its gradient
        """
        deployed = list(self.deployed.parameters())  # with a shared encoder, whoever else holds it
        self.flat_parameters = {self.roles.deployed: TrainedParameters(deployed, unclipped)}
        of_deployed = {id(parameter) for parameter in deployed}
        for role in self.roles.others:
            if getattr(self, role) is not None:
                own = [parameter for parameter in getattr(self, role).parameters() if id(parameter) not in of_deployed]
                self.flat_parameters[role] = TrainedParameters(own)
        optimizer_class, kwargs = self.optimizer_class, dict(self.optimizer_kwargs)
        if "foreach" not in kwargs and kwargs.get("fused", True):
            optimizer_class = FlatAdam if optimizer_class is th.optim.Adam else optimizer_class
            kwargs |= {"fused": True} if issubclass(optimizer_class, (th.optim.Adam, th.optim.AdamW)) else {}
        lr_scales = resolve_lr_scales(self.roles, self.constructor_options["lr_scales"])
        for role, parameters in self.flat_parameters.items():
            group = {"params": [parameters.flat], "lr_scale": lr_scales[role], "trained": parameters.trained}
            getattr(self, role).optimizer = optimizer_class([group], lr=lr_schedule(1), **kwargs)  # type: ignore
        self._collect_targets()

    def _collect_targets(self) -> None:
        """What Polyak averaging goes through: flat parameters, unless some are frozen or another network's."""
        self._flat_targets: list[FlatParameters] = []
        self._critic_parameters: list[th.Tensor] = []
        self._target_parameters: list[th.Tensor] = []
        for role, (critic, target) in self.critic_pairs.items():
            of_critic, of_target = list(critic.parameters()), list(target.parameters())
            if len(of_critic) == len(self.flat_parameters[role].parameters):
                self._flat_targets.append(FlatParameters(of_target))
                of_critic, of_target = [self.flat_parameters[role].flat], [self._flat_targets[-1].flat]
            self._critic_parameters += of_critic
            self._target_parameters += of_target
        self._has_statistics = any(get_parameters_by_name(critic, ["running_"]) for critic, _ in self.critic_pairs.values())

    def refresh_parameters(self) -> None:
        """
        To be called before training and before saving: parameters that have been frozen, unfrozen, moved or replaced.

        See :meth:`TrainedParameters.follow` and :meth:`FlatParameters.refresh`.
        """
        before = self.frozen
        for role, parameters in self.flat_parameters.items():
            parameters.follow(getattr(self, role).optimizer)
        if self.frozen != before:
            self._collect_targets()
        for flat in (*self.flat_parameters.values(), *self._flat_targets):
            flat.refresh()

    @property
    def frozen(self) -> tuple[tuple[str, int], ...]:
        """Role and number of each parameter that is not trained, after :meth:`refresh_parameters`."""
        flat_parameters = self.flat_parameters.items()
        return tuple((role, i) for role, flat in flat_parameters for i, trained in enumerate(flat.trained) if not trained)

    def freeze_as_saved(self) -> None:
        """To be called when a file has given the optimisers their state: see :meth:`TrainedParameters.freeze_as_in`."""
        for role, parameters in self.flat_parameters.items():
            parameters.freeze_as_in(getattr(self, role).optimizer)

    def scale_learning_rates(self, lr_scales: Mapping[str, float] | None) -> None:
        """
        :param lr_scales: network -> multiple of the learning rate, in place of those that there were
        """
        self.constructor_options["lr_scales"] = lr_scales
        for role, scale in resolve_lr_scales(self.roles, lr_scales).items():
            if role in self.flat_parameters:
                getattr(self, role).optimizer.param_groups[0]["lr_scale"] = scale

    def flat_tensors(self) -> list[th.Tensor]:
        """Those that parameters are views of, after :meth:`refresh_parameters`."""
        return [parameters.flat for parameters in (*self.flat_parameters.values(), *self._flat_targets)]

    @property
    def deployed(self) -> DeployedPolicy:
        """The policy that acts at evaluation."""
        return getattr(self, self.roles.deployed)

    @property
    def critic_pairs(self) -> dict[str, tuple[CriticEnsemble, CriticEnsemble]]:
        """Role -> (critic, target), for each critic that there is."""
        critics = [role for role in self.roles.critics if getattr(self, role) is not None]
        return {role: (getattr(self, role), getattr(self, f"{role}_target")) for role in critics}

    def update_targets(self, tau: float) -> None:
        """
        Polyak averaging of the targets, tau theta + (1 - tau) theta_bar; running statistics are copied.

        :param tau: in [0, 1]
        """
        polyak_average(self._critic_parameters, self._target_parameters, tau)
        if not self._has_statistics:
            return
        for critic, target in self.critic_pairs.values():  # not collected once: a move to another device replaces buffers
            polyak_average(get_parameters_by_name(critic, ["running_"]), get_parameters_by_name(target, ["running_"]), 1.0)

    # --- acting -----------------------------------------------------------------------------------------------------

    @property
    def halves_are_independent(self) -> bool:
        """Whether the two halves of a gradient step share nothing that either changes."""
        return not self.share_features_extractor

    def check_seen_by(self, role: str, observation: Any, where: str) -> None:
        """
        :param role: that is about to act
        :param observation: that it was handed
        :param where: the method that was called, for the message
        :raises ValueError: if an entry is missing that the role or, because it acts beside it, the deployed policy reads
        """
        reads = list(dict.fromkeys([*self.role_keys[role], *self.role_keys[self.roles.deployed]]))
        if not isinstance(observation, Mapping):
            raise ValueError(f"The {role} reads {reads}: pass {where} a dict with these entries, not an array.")
        missing = [key for key in reads if key not in observation]
        if missing:
            raise ValueError(
                f"The observation passed to {where} lacks {missing}, which the {role} reads; it has {list(observation)}. "
                f"predict() is for observations of {list(self.role_keys[self.roles.deployed])} alone."
            )

    @abstractmethod
    def behaviour_action(
        self,
        observation: dict[str, np.ndarray],
        state: BehaviourState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, BehaviourState]:
        r"""
        Action of the policy that collects the data, in [-1, 1] or one of a number.

        :param observation: full observation, B of each entry
        :param state: what the last call returned, ``None`` at the start
        :param episode_start: true where an episode starts, shape (B,)
        :param deterministic: mode instead of a sample
        :return: shape (B, \*action shape), and what recurrent policies remember
        """

    def _chosen(self, actions: Distribution, deterministic: bool) -> np.ndarray:
        r"""
        :param actions: shapes (B, A)
        :param deterministic: mode instead of a sample
        :return: shape (B, \*action shape)
        """
        chosen = actions.mode if deterministic else actions.sample()
        return chosen.cpu().numpy().reshape(-1, *self.action_space.shape)  # type: ignore[misc]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The deployed policy's action; entries that it does not read are ignored.

        :param observation: single or batched; ``{"partial": ...}``, a full dict, or the partial entry alone
        :param state: what a recurrent policy's last call returned, ``None`` at the start
        :param episode_start: true where an episode starts, shape (B,)
        :param deterministic: mode instead of a sample
        :return: action in the environment's range, and the state for the next call
        """
        return self.deployed.predict(observation, state, episode_start, deterministic)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The deployed policy's action, in [-1, 1] of shape (B, A), or one of a number of shape (B,)."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.deployed._predict(observation, deterministic)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        :param observation: dict of observation entries, single or batched; unknown entries are dropped
        :return: tensors, and whether they were batched
        :raises ValueError: naming the entry that does not fit its space, or is not as many as the others
        """
        if not isinstance(observation, Mapping):
            return self.deployed.obs_to_tensor(observation)
        return self.reader.read(observation, self.device)

    def set_training_mode(self, mode: bool) -> None:
        """
        Put policies and critics in training or evaluation mode; targets stay in evaluation mode.

        :param mode: True for training
        """
        for role in self.flat_parameters:
            getattr(self, role).set_training_mode(mode)
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
