"""Guider, learner and four critics: the networks of Guided Actor-Critic for Box actions."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn

from sb3_gac.common.distributions import TanhGaussian
from sb3_gac.common.networks import CriticEnsemble, VectorExtractor, polyak_average, trainable
from sb3_gac.common.roles import RoleKeys, resolve_net_arch, resolve_role_keys, role_space
from sb3_gac.gac.actors import GUIDERS, LOG_STD_BOUNDS, Guider, Learner


class GACPolicy(BasePolicy):
    """
    All networks of GAC and their optimisers. As a policy it is the learner: ``predict`` needs its entries alone.

    :param observation_space: Dict
    :param action_space: Box
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layer sizes: one list, ``{"pi", "qf"}`` or ``{"guider", "learner", "critic"}``
    :param activation_fn: between layers
    :param guider: "residual" or "independent", a key of ``GUIDERS``
    :param role_keys: role -> observation entries, see :func:`sb3_gac.common.roles.resolve_role_keys`
    :param max_kl: hard bound on KL(guider || learner), or ``None``
    :param kl_reduction: how that KL is reduced over action dimensions, "mean" or "sum"
    :param learner_critics: whether the learner has critics of its own
    :param log_std_bounds: smallest and largest log standard deviation before tanh
    :param features_extractor_class: encoder, made once per role on the entries of that role
    :param features_extractor_kwargs: keyword arguments for it
    :param guider_lr_scale: learning rate of the guider, as a multiple of that of the others
    :param share_features_extractor: whether guider and critics see the learner's features of its entries, as they are,
        and encode only the other entries themselves; the learner's loss trains that encoder (saves most of the work
        where ``partial`` is an image)
    :param normalize_images: divide images by 255
    :param optimizer_class: optimiser of policies and critics
    :param optimizer_kwargs: keyword arguments for it, without the learning rate
    :param n_critics: size of each of the two critic ensembles
    """

    learner_critic: CriticEnsemble | None
    learner_critic_target: CriticEnsemble | None

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        guider: str = "residual",
        role_keys: RoleKeys | None = None,
        max_kl: float | None = None,
        kl_reduction: str = "mean",
        learner_critics: bool = True,
        guider_lr_scale: float = 1.0,
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
        features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = False,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
            normalize_images=normalize_images,
        )
        self.constructor_options: dict[str, Any] = {
            "net_arch": net_arch,
            "activation_fn": activation_fn,
            "guider": guider,
            "role_keys": role_keys,
            "max_kl": max_kl,
            "kl_reduction": kl_reduction,
            "learner_critics": learner_critics,
            "guider_lr_scale": guider_lr_scale,
            "log_std_bounds": log_std_bounds,
            "n_critics": n_critics,
        }
        self.role_keys = resolve_role_keys(observation_space, role_keys)
        self.share_features_extractor = share_features_extractor
        self.net_arch = net_arch
        self._role_net_arch = resolve_net_arch(net_arch)
        self._build_networks(GUIDERS[guider], max_kl, kl_reduction, learner_critics, log_std_bounds, n_critics)
        self._collect_parameters()
        self._build_optimizers(lr_schedule)

    def _build_networks(
        self,
        guider_class: type[Guider],
        max_kl: float | None,
        kl_reduction: str,
        learner_critics: bool,
        log_std_bounds: tuple[float, float],
        n_critics: int,
    ) -> None:
        self.learner = Learner(**self._role_kwargs("learner"), log_std_bounds=log_std_bounds)
        shared = self.learner.features_extractor if self.share_features_extractor else None
        self.guider = guider_class(
            **self._role_kwargs("guider", shared), log_std_bounds=log_std_bounds, max_kl=max_kl, kl_reduction=kl_reduction
        )
        self.guider_critic, self.guider_critic_target = self._make_critic_and_target("guider_critic", n_critics, shared)
        self.learner_critic, self.learner_critic_target = None, None
        if learner_critics:
            self.learner_critic, self.learner_critic_target = self._make_critic_and_target("learner_critic", n_critics, shared)

    def _role_kwargs(self, role: str, shared: BaseFeaturesExtractor | None = None) -> dict[str, Any]:
        """
        Constructor arguments of a role's network.

        :param role: one of ``ROLES``
        :param shared: the learner's encoder, if this role is to use it; without it the role gets one of its own
        """
        features_extractor, rest_extractor = shared, None
        if shared is None:
            features_extractor = self._make_extractor(self.role_keys[role])
        else:
            rest_extractor = self._make_extractor(self._keys_beside_the_learners(role))
        extractors = [extractor for extractor in (features_extractor, rest_extractor) if extractor is not None]
        return {
            "observation_space": role_space(self.observation_space, self.role_keys[role]),  # type: ignore[arg-type]
            "action_space": self.action_space,
            "net_arch": self._role_net_arch[role],
            "features_extractor": features_extractor,
            "rest_extractor": rest_extractor,
            "features_dim": sum(extractor.features_dim for extractor in extractors),
            "activation_fn": self.constructor_options["activation_fn"],
            "normalize_images": self.normalize_images,
        }

    def _make_extractor(self, keys: Sequence[str]) -> BaseFeaturesExtractor:
        space = role_space(self.observation_space, keys)  # type: ignore[arg-type]
        if self.features_extractor_class is CombinedExtractor and VectorExtractor.fits(space):
            return VectorExtractor(space)
        return self.features_extractor_class(space, **self.features_extractor_kwargs)

    def _keys_beside_the_learners(self, role: str) -> list[str]:
        keys = [key for key in self.role_keys[role] if key not in self.role_keys["learner"]]
        if not keys or not set(self.role_keys["learner"]) < set(self.role_keys[role]):
            raise ValueError(
                f"share_features_extractor=True needs a {role} that reads all of the learner's entries "
                f"{list(self.role_keys['learner'])} and others, but it reads {list(self.role_keys[role])}."
            )
        return keys

    def _make_critic_and_target(
        self, role: str, n_critics: int, shared: BaseFeaturesExtractor | None
    ) -> tuple[CriticEnsemble, CriticEnsemble]:
        critic = CriticEnsemble(**self._role_kwargs(role, shared), n_critics=n_critics)
        target = CriticEnsemble(**self._role_kwargs(role, deepcopy(shared)), n_critics=n_critics)
        target.load_state_dict(critic.state_dict())
        target.set_training_mode(False)
        return critic, target

    def _collect_parameters(self) -> None:
        """Walking a module tree costs more than the update itself: it is done once."""
        critics, targets = zip(*self.critic_pairs, strict=True)
        self._critic_parameters: list[th.Tensor] = [p for critic in critics for p in critic.parameters()]
        self._target_parameters: list[th.Tensor] = [p for target in targets for p in target.parameters()]
        self._has_statistics = any(get_parameters_by_name(critic, ["running_"]) for critic in critics)
        learner_parameters = self.learner.mean_parameters()
        networks: dict[str, nn.Module] = {"guider": self.guider, "guider_critic": self.guider_critic}
        if self.learner_critic is not None:
            networks["learner_critic"] = self.learner_critic
        self.network_parameters: dict[str, list[nn.Parameter]] = {
            "learner": trainable(learner_parameters),
            "learner_log_std": trainable(self.learner.log_std.parameters()),
            # A shared encoder is the learner's, whoever else holds it
            **{name: trainable(net.parameters(), but=learner_parameters) for name, net in networks.items()},
        }

    def _build_optimizers(self, lr_schedule: Schedule) -> None:
        """One optimiser for the two policies and one for all critics: their losses never share a parameter."""
        kwargs = dict(self.optimizer_kwargs)
        if self.optimizer_class in (th.optim.Adam, th.optim.AdamW) and "foreach" not in kwargs:
            kwargs.setdefault("fused", True)
        critics = [p for name, group in self.network_parameters.items() if name.endswith("critic") for p in group]
        own = {"params": self.network_parameters["guider"], "lr_scale": self.constructor_options["guider_lr_scale"]}
        others = {"params": [*self.network_parameters["learner"], *self.network_parameters["learner_log_std"]]}
        self.actor_optimizer = self.optimizer_class([own, others], lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]
        self.critic_optimizer = self.optimizer_class(critics, lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]
        # Where SB3's SAC has them
        self.actor.optimizer = self.actor_optimizer
        self.critic.optimizer = self.critic_optimizer

    @property
    def actor(self) -> Learner:
        """SB3's name for the policy that acts at evaluation."""
        return self.learner

    @property
    def critic(self) -> CriticEnsemble:
        """SB3's name for the critic without the KL term (eq. 15); the guided one in ablations that have no other."""
        return self.guider_critic if self.learner_critic is None else self.learner_critic

    @property
    def critic_target(self) -> CriticEnsemble:
        """Target of :attr:`critic`."""
        return self.guider_critic_target if self.learner_critic_target is None else self.learner_critic_target

    @property
    def critic_pairs(self) -> list[tuple[CriticEnsemble, CriticEnsemble]]:
        """(critic, target) of the guider, then of the learner where it has one."""
        pairs = [(self.guider_critic, self.guider_critic_target)]
        if self.learner_critic is not None and self.learner_critic_target is not None:
            pairs.append((self.learner_critic, self.learner_critic_target))
        return pairs

    def distributions(self, obs: PyTorchObs) -> tuple[TanhGaussian, TanhGaussian, th.Tensor]:
        """
        Both policies' action distributions for one batch.

        :param obs: full observation, B of each entry
        :return: guider; learner with the guider's std, detached; and the learner's deployment log std, shape (B, A)
        """
        learner_mean, deployment_log_std = self.learner(obs)
        guider = self.guider(obs, learner_mean)
        return guider, TanhGaussian(learner_mean, guider.log_std.detach()), deployment_log_std

    def behaviour_action(self, observation: dict[str, np.ndarray], deterministic: bool = False) -> tuple[np.ndarray, bool]:
        """
        Action of the guider, in [-1, 1].

        :param observation: full observation, single or batched
        :param deterministic: mode instead of a sample
        :return: shape (B, \\*action shape), and whether the observation was batched
        """
        obs, vectorized = self.obs_to_tensor(observation)
        with th.no_grad():
            guider = self.distributions(obs)[0]
            action = guider.mode if deterministic else guider.sample()
        return action.cpu().numpy().reshape(-1, *self.action_space.shape), vectorized  # type: ignore[misc]

    def update_targets(self, tau: float) -> None:
        """
        Polyak averaging of the targets, tau theta + (1 - tau) theta_bar; running statistics are copied.

        :param tau: in [0, 1]
        """
        polyak_average(self._critic_parameters, self._target_parameters, tau)
        if not self._has_statistics:
            return
        for critic, target in self.critic_pairs:  # not collected once: a move to another device replaces buffers
            polyak_average(get_parameters_by_name(critic, ["running_"]), get_parameters_by_name(target, ["running_"]), 1.0)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The learner's action; entries that the learner does not read are ignored.

        :param observation: single or batched; ``{"partial": ...}``, a full dict, or the partial entry alone
        :param state: passed through
        :param episode_start: ignored
        :param deterministic: mode instead of a sample
        :return: action in the environment's range, and ``state``
        """
        return self.learner.predict(observation, state, episode_start, deterministic)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The learner's action in [-1, 1], shape (B, A)."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.learner._predict(observation, deterministic)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        :param observation: dict of observation entries, single or batched; unknown entries are dropped
        :return: tensors, and whether they were batched
        """
        if not isinstance(observation, Mapping):
            return self.learner.obs_to_tensor(observation)
        known = self.observation_space.spaces  # type: ignore[attr-defined]
        return super().obs_to_tensor({key: value for key, value in observation.items() if key in known})

    def set_training_mode(self, mode: bool) -> None:
        """
        Put policies and critics in training or evaluation mode; targets stay in evaluation mode.

        :param mode: True for training
        """
        self.guider.set_training_mode(mode)
        self.learner.set_training_mode(mode)
        for critic, _ in self.critic_pairs:
            critic.set_training_mode(mode)
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
                "share_features_extractor": self.share_features_extractor,
            }
        )


MultiInputPolicy = GACPolicy
