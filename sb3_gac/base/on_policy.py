"""What on-policy algorithms with a privileged view share: arguments, their checks, and the train loop."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from functools import partial
from math import ceil
from typing import Any, ClassVar

import torch as th
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
from sb3_gac.checks.values import check_fraction, check_integer, check_not_negative, check_positive, check_schedule


class AsymmetricOnPolicyAlgorithm(AsymmetricAlgorithm, RolloutCollection):  # type: ignore[misc]
    """
    Base of the algorithms that learn from what their present policy has just collected, as PPO does.

    A subclass writes ``update(batch)``, with a minibatch of SB3's ``DictRolloutBufferSamples``, whose actions are what the
    behaviour policy's distribution has drawn (before tanh). The arguments up to ``vf_coef``, which may come by position,
    and from ``stats_window_size`` on, are SB3's PPO's.

    :param policy: "MultiInputPolicy", or a subclass of the policy class of that name
    :param env: environment with Dict observations and Box or Discrete actions
    :param learning_rate: a number or a schedule
    :param n_steps: steps of each environment in a rollout
    :param batch_size: transitions per gradient step
    :param n_epochs: passes over each rollout
    :param gamma: discount factor
    :param gae_lambda: trade-off of bias and variance in advantages
    :param clip_range: how far a ratio of probabilities may count, epsilon; a number or a schedule
    :param normalize_advantage: whether advantages are normalised in each minibatch
    :param ent_coef: weight of the entropy
    :param vf_coef: weight of the value's loss
    :param max_grad_norm: bound on the norm of the gradient of all networks together; ``None`` for none
    :param reward_scale: multiplies the rewards that are learned from
    :param unroll_length: steps after which advantages bootstrap; ``None`` for the whole rollout
    :param lr_scales: network -> multiple of ``learning_rate``
    :param role_keys: role -> observation entries, by default ``partial`` for the deployed policy and all for the others
    :param compile: compile losses and gradients; needs a C++ compiler on the CPU. "auto" decides when ``learn`` begins: where
        it is possible, and 10,000 gradient steps or more are to come
    :param mixed_precision: matrix products of losses and gradients in bfloat16
    :param stats_window_size: episodes averaged in rollout statistics
    :param tensorboard_log: log directory, ``None`` for no log
    :param policy_kwargs: keyword arguments of the policy class
    :param verbose: 0 silent, 1 information, 2 debug
    :param seed: number from which all pseudo-random generators start; ``None`` for another one each time
    :param device: "auto", "cpu", "cuda", ...
    :param _init_setup_model: build the networks at construction
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
        self.clip_range_schedule = PlainSchedule(self.clip_range)
        self.clip_range_tensor = th.zeros((), device=self.device)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.is_recurrent:
            raise ValueError(f"{type(self).__name__} has no form with a memory: leave rnn_type out.")
        rollout = self.n_steps * self.n_envs
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
        :return: to log under "train/"
        """

    def train(self) -> None:
        """A round of gradient steps on the rollout that was just collected."""
        with self.gradient_steps_under_way() as history:
            for batch in self._minibatches():
                history.append(self._compiled("update", self.update, batch) if self.compiles else self.update(batch))
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
        :param batch: B transitions
        :return: their advantages, normalised on request, shape (B,)
        """
        if not self.normalize_advantage:
            return batch.advantages
        return (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "clip_range_tensor", "_obs_after_last_step"]
