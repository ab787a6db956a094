"""The base of on-policy algorithms with a privileged view: arguments, their checks, and the train loop."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from functools import partial
from math import ceil
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples, GymEnv, Schedule
from stable_baselines3.common.utils import explained_variance
from typing_extensions import Unpack

from sb3_gac.base.algorithm import AsymmetricAlgorithm
from sb3_gac.base.arguments import OnPolicyArguments, with_defaults
from sb3_gac.base.batch import Metrics
from sb3_gac.base.overrides import check_known
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import RoleKeys
from sb3_gac.base.rollouts import RolloutCollection
from sb3_gac.checks.arguments import COMMON_CHECKS, ArgumentCheck, PlainSchedule, check_switch, unless
from sb3_gac.checks.entries import check_held_by_sb3
from sb3_gac.checks.values import check_fraction, check_integer, check_not_negative, check_positive, check_schedule


class AsymmetricOnPolicyAlgorithm(AsymmetricAlgorithm, RolloutCollection):  # type: ignore[misc]
    """
    Base of the algorithms that learn from rollouts of their present policy, as PPO does.

    A subclass writes :meth:`update`, one gradient step on a minibatch of SB3's ``DictRolloutBufferSamples``. Continuous
    actions in it are values before tanh, as drawn from the behaviour policy's distribution. The arguments up to
    ``vf_coef``, which may be given by position, and those from ``stats_window_size`` on are those of SB3's PPO.

    :param policy: "MultiInputPolicy", or a subclass of the policy class of that name
    :param env: environment with Dict observations and Box or Discrete actions
    :param learning_rate: step size for all networks; a number or a schedule
    :param n_steps: number of steps of each environment in a rollout
    :param batch_size: number of transitions per gradient step
    :param n_epochs: number of passes over each rollout
    :param gamma: discount factor
    :param gae_lambda: lambda of generalised advantage estimation, which trades bias for variance, from 0 to 1
    :param clip_range: epsilon: ratios of probabilities are clipped to [1 - epsilon, 1 + epsilon]; a number or a schedule
    :param normalize_advantage: whether advantages are normalised in each minibatch
    :param ent_coef: weight of the entropy in the loss
    :param vf_coef: weight of the value function's loss
    :param max_grad_norm: bound on the norm of the gradient of all networks together; ``None`` for no bound
    :param reward_scale: factor of the rewards that are learned from
    :param unroll_length: number of steps after which advantages bootstrap; ``None`` for the whole rollout
    :param lr_scales: network -> multiple of ``learning_rate``
    :param role_keys: role -> observation entries, by default ``partial`` for the deployed policy and all for the others
    :param compile: whether to compile gradient steps, which needs a C++ compiler on the CPU. "auto" decides when ``learn``
        begins: steps are compiled where that is possible and 10,000 or more are to come
    :param mixed_precision: whether to compute the matrix products of losses and gradients in bfloat16
    :param stats_window_size: number of episodes that rollout statistics average over
    :param tensorboard_log: directory for TensorBoard's log; ``None`` for no log
    :param policy_kwargs: keyword arguments of the policy class
    :param verbose: level of messages: 0 for none, 1 for information, 2 for debugging
    :param seed: number from which all pseudo-random generators start; ``None`` for another one each time
    :param device: device of the networks: "auto", "cpu", "cuda", ...
    :param _init_setup_model: whether to build the networks at construction
    """

    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "n_steps": partial(check_integer, low=1),
        "batch_size": partial(check_integer, low=1),
        "n_epochs": partial(check_integer, low=1),
        "gae_lambda": check_fraction,
        "clip_range": partial(check_schedule, remedy="for example 0.2, or a schedule of such"),
        "normalize_advantage": check_switch,
        "ent_coef": check_not_negative,
        "vf_coef": check_not_negative,
        "reward_scale": check_positive,
        "unroll_length": unless(None, check_integer, low=1, remedy="or None for the whole rollout"),
    }
    fixed_arguments = (*AsymmetricAlgorithm.fixed_arguments, "n_steps")
    built_in_arguments = (*AsymmetricAlgorithm.built_in_arguments, "n_steps")
    progress = (*AsymmetricAlgorithm.progress, *RolloutCollection.collected)
    compiled_settings = (*AsymmetricAlgorithm.compiled_settings, "ent_coef", "vf_coef", "normalize_advantage")

    def __init__(
        self,
        policy: str | type[AsymmetricPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        **shared: Unpack[OnPolicyArguments],
    ):
        check_known(type(self), OnPolicyArguments, shared)
        arguments = with_defaults(OnPolicyArguments, sb3, shared)
        for name in ("verbose", "device"):  # SB3's constructor uses them
            COMMON_CHECKS[name](name, arguments[name])
        sets_up = arguments.pop("_init_setup_model")
        self.batch_size: int = arguments.pop("batch_size")
        self.n_epochs: int = arguments.pop("n_epochs")
        self.clip_range: float | Schedule = arguments.pop("clip_range")
        self.normalize_advantage: bool = arguments.pop("normalize_advantage")
        self.reward_scale: float = arguments.pop("reward_scale")
        self.unroll_length: int | None = arguments.pop("unroll_length")
        self.lr_scales: Mapping[str, float] | None = arguments.pop("lr_scales")
        self.role_keys: RoleKeys | None = arguments.pop("role_keys")
        self.compile: bool | str = arguments.pop("compile")
        self.mixed_precision: bool = arguments.pop("mixed_precision")
        super().__init__(policy, env, use_sde=False, sde_sample_freq=-1, **arguments, _init_setup_model=False)  # type: ignore
        if sets_up:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        self.clip_range_tensor = th.zeros((), device=self.device)

    def make_schedules(self) -> None:
        """See :meth:`AsymmetricAlgorithm.make_schedules`; here is that of the clip range."""
        super().make_schedules()
        self.clip_range_schedule = PlainSchedule(self.clip_range)

    def take_effect(self, changed: set[str]) -> None:
        """See :meth:`AsymmetricAlgorithm.take_effect`; the rollout buffer computes with arguments of its own."""
        super().take_effect(changed)
        vars(self.rollout_buffer).update({name: getattr(self, name) for name in ("gamma", "gae_lambda", "unroll_length")})

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.is_recurrent:
            raise ValueError(f"{type(self).__name__} has no form with a memory: leave rnn_type out.")
        assert isinstance(self.observation_space, spaces.Dict)
        check_held_by_sb3("The rollout buffer", self.observation_space, "make the entry one-dimensional in the environment")
        self.check_minibatches(self.n_envs)

    def check_minibatches(self, n_envs: int) -> None:
        """
        Check that the advantages of every minibatch can be normalised.

        :param n_envs: number of environments
        :raises ValueError: if a minibatch would have one transition; the message names the argument to change
        """
        rollout = self.n_steps * n_envs
        if self.normalize_advantage and min(self.batch_size, rollout) < 2:
            raise ValueError("normalize_advantage needs two transitions in a minibatch: raise batch_size or n_steps.")
        if self.normalize_advantage and rollout % self.batch_size == 1:
            raise ValueError(
                f"batch_size={self.batch_size} leaves a minibatch of one of the {rollout} transitions in a rollout (n_steps x "
                "environments), whose advantage can't be normalised: choose a batch_size that divides them."
            )

    # --- training ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def update(self, batch: DictRolloutBufferSamples) -> Metrics:
        """
        One gradient step of all networks.

        :param batch: B transitions of the rollout
        :return: name -> metric, scalars to log under "train/"
        """

    def train(self) -> None:
        """A round of gradient steps on the rollout that was just collected."""
        self.follow_arguments()
        with self.gradient_steps_under_way() as history:
            for batch in self._minibatches():
                history.append(self.compiled(self.update, batch) if self.compiles else self.update(batch))
            self._n_updates += self.n_epochs
        buffer = self.rollout_buffer
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", explained)

    def gradient_steps_in(self, steps: int) -> int:
        """See :meth:`Compilation.gradient_steps_in`."""
        rollout = self.n_steps * self.n_envs
        return ceil(steps / rollout) * ceil(rollout / self.batch_size) * self.n_epochs

    def _minibatches(self) -> Iterator[DictRolloutBufferSamples]:
        for _ in range(self.n_epochs):
            yield from self.rollout_buffer.get(self.batch_size)

    def refresh_schedules(self) -> None:
        """See :meth:`GradientSteps.refresh_schedules`."""
        super().refresh_schedules()
        self.clip_range_tensor.fill_(self.clip_range_schedule(self._current_progress_remaining))

    def advantages(self, batch: DictRolloutBufferSamples) -> th.Tensor:
        """
        The advantages of a minibatch, normalised if ``normalize_advantage`` is true.

        :param batch: B transitions of the rollout
        :return: advantages, shape (B,)
        """
        if not self.normalize_advantage:
            return batch.advantages
        return (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "clip_range_tensor", "_obs_after_last_step"]
