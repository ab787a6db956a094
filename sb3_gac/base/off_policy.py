"""The base of off-policy algorithms with a privileged view: arguments, their checks, and the train loop."""

from abc import abstractmethod
from collections.abc import Mapping
from math import ceil
from os import PathLike
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TrainFreq, TrainFrequencyUnit
from typing_extensions import Self, Unpack

from sb3_gac.base.algorithm import AsymmetricAlgorithm
from sb3_gac.base.arguments import OffPolicyArguments, with_defaults
from sb3_gac.base.augmentation import check_channels_first, shifted, shifted_entries
from sb3_gac.base.batch import Batch, Metrics
from sb3_gac.base.behaviour import BehaviourSpec
from sb3_gac.base.collecting import DataCollection
from sb3_gac.base.off_policy_acting import OffPolicyActing
from sb3_gac.base.overrides import check_known, check_unchanged
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.recording import Recording
from sb3_gac.base.replay_data import ReplayData
from sb3_gac.base.roles import RoleKeys, resolve_role_keys, resolve_update_every
from sb3_gac.checks.arguments import COMMON_CHECKS, OFF_POLICY_CHECKS, ArgumentCheck, check_train_freq
from sb3_gac.checks.entries import check_held_by
from sb3_gac.checks.requirements import (
    check_action_noise,
    check_goals,
    check_hindsight,
    check_rewards_of_goals,
    warn_of_no_gradient_step,
)
from sb3_gac.networks.heads import resolve_target_entropy
from sb3_gac.optim.coefficients import Coefficient, make_coefficient
from sb3_gac.replay.buffer import CompactDictReplayBuffer

ENT_COEF_START = 0.1
_EPISODE = 1_000
ENT_COEF_BOUNDS = (1e-8, 1e4)


class AsymmetricOffPolicyAlgorithm(OffPolicyActing, AsymmetricAlgorithm, DataCollection, ReplayData):  # type: ignore[override]
    """
    Base of the algorithms whose behaviour policy sees more than the policy that is deployed.

    A subclass names its policy class in ``policy_aliases`` and writes one gradient step, :meth:`update`. Its constructor
    names only the arguments of its own, see :class:`OffPolicyArguments`. It keeps each as the attribute of its name before
    it calls ``super().__init__()``, which sets everything up. ``argument_checks`` says what each argument may be by itself,
    ``_check_arguments`` what combinations there may be.

    The arguments up to ``target_entropy``, which may be given by position, and those from ``stats_window_size`` on are those
    of SB3's SAC.

    :param policy: "MultiInputPolicy", or a subclass of the policy class of that name
    :param env: environment with Dict observations and Box or Discrete actions; ``None`` in ``load`` alone
    :param learning_rate: step size for policies, critics and the entropy temperature; a number or a schedule
    :param buffer_size: number of transitions that the replay buffer holds
    :param learning_starts: number of environment steps of the warm-up, whose actions are uniform
    :param batch_size: number of transitions per gradient step
    :param tau: Polyak coefficient of the target networks
    :param gamma: discount factor
    :param train_freq: steps of each environment between two rounds of gradient steps; or (n, "step" | "episode")
    :param gradient_steps: number of gradient steps per round; -1 for as many as there were environment steps
    :param action_noise: noise that is added to the behaviour policy's actions; ``None`` for none
    :param replay_buffer_class: class of the replay buffer; ``None`` for :class:`CompactDictReplayBuffer`, which stores each
        observation once, or for recurrent networks its subclass :class:`EpisodeReplayBuffer`
    :param replay_buffer_kwargs: keyword arguments of the replay buffer's class
    :param optimize_memory_usage: argument of replay buffers of other classes, see SB3
    :param n_steps: number of rewards that a critic's target sums up before it bootstraps; more than 1 needs a
        :class:`CompactDictReplayBuffer`, or a class of one's own that takes ``n_steps`` in ``replay_buffer_kwargs``. Terms of
        the policies, entropy and KL, are in the target where it bootstraps, and not in the steps in between
    :param ent_coef: entropy temperature: "auto" or "auto_<start value>" for a learned one, or a number
    :param target_update_interval: number of gradient steps between two updates of the target networks
    :param target_entropy: entropy that a learned temperature aims at, in nats: "auto", "sac" or a number, see
        :func:`sb3_gac.networks.heads.resolve_target_entropy`
    :param max_grad_norm: bound on the gradient norm of each network; ``None`` for no bound
    :param policy_delay: number of gradient steps for each step of a policy's network; critics take a step in each
    :param update_every: network -> number of gradient steps for each step of this network; "critic" stands for all critics
    :param behaviour: policy that collects the data: its name, or name -> share of episodes, a number or a schedule. A frozen
        teacher has the name of its argument. ``None`` for the policy that the algorithm itself names
    :param behaviour_per: unit of the shares in ``behaviour``: "episode" or "environment"
    :param recording: path of a file that :func:`sb3_gac.write_recording` wrote of another run, whose actions are taken, those
        of the warm-up included. The environments must be made like that run's; their rewards are compared with the recorded
        ones. ``None`` for actions of the model's own
    :param random_shift: largest shift, in pixels and in each direction, of the images that the deployed policy reads; each
        image in a batch is shifted at random by itself (DrQ's augmentation, which has 4 pixels). 0 for no shift
    :param lr_scales: network -> multiple of ``learning_rate``; "critic" stands for all critics, "memory" for the memories of
        recurrent networks, whose multiple comes on top of their network's
    :param role_keys: role -> observation entries, by default ``partial`` for the deployed policy and all for the others;
        "critic" stands for all critics. Where ``privileged`` is the whole state, ``{"critic": ["privileged"]}`` spares the
        critics the sensor noise
    :param compile: whether to compile gradient steps: about half a minute at the start (less the next time, from a cache),
        and faster steps from then on. On the CPU it needs a C++ compiler. "auto" decides when ``learn`` begins: steps are
        compiled where that is possible and 10,000 or more are to come
    :param mixed_precision: whether to compute the matrix products of losses and gradients in bfloat16, which pays at 256
        units and more on hardware that has it, with ``compile``
    :param stats_window_size: number of episodes that rollout statistics average over
    :param tensorboard_log: directory for TensorBoard's log; ``None`` for no log
    :param policy_kwargs: keyword arguments of the policy class
    :param verbose: level of messages: 0 for none, 1 for information, 2 for debugging
    :param seed: number from which all pseudo-random generators start; ``None`` for another one each time
    :param device: device of the networks: "auto", "cpu", "cuda", ...
    :param _init_setup_model: whether to build the networks at construction
    """

    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = OFF_POLICY_CHECKS
    #: Whether the algorithm has phases in which its batches have histories, see :attr:`history_length`
    samples_histories: ClassVar[bool] = False
    compiled_settings = (*AsymmetricAlgorithm.compiled_settings, "tau")
    restored_arguments = (*AsymmetricAlgorithm.restored_arguments, "ent_coef")
    fixed_arguments = (*AsymmetricAlgorithm.fixed_arguments, "buffer_size", "replay_buffer_class")
    built_in_arguments = (
        *AsymmetricAlgorithm.built_in_arguments,
        "buffer_size",
        "replay_buffer_class",
        "replay_buffer_kwargs",
        "optimize_memory_usage",
    )
    progress = (*AsymmetricAlgorithm.progress, *DataCollection.collected)
    _shifted_entries: tuple[str, ...] = ()

    def __init__(
        self,
        policy: str | type[AsymmetricPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        **shared: Unpack[OffPolicyArguments],
    ):
        check_known(type(self), OffPolicyArguments, shared)
        arguments = with_defaults(OffPolicyArguments, sb3, shared)
        for name in ("verbose", "device"):  # SB3's constructor uses them
            COMMON_CHECKS[name](name, arguments[name])
        sets_up = arguments.pop("_init_setup_model")
        self.ent_coef: str | float = arguments.pop("ent_coef")
        self.target_entropy: str | float = arguments.pop("target_entropy")
        self.target_update_interval: int = arguments.pop("target_update_interval")
        self.max_grad_norm: float | None = arguments.pop("max_grad_norm")
        self.policy_delay: int = arguments.pop("policy_delay")
        self.update_every: Mapping[str, int] | None = arguments.pop("update_every")
        self.behaviour: BehaviourSpec = arguments.pop("behaviour")
        self.behaviour_per: str = arguments.pop("behaviour_per")
        self.recording: str | PathLike | None = arguments.pop("recording")
        self.random_shift: int = arguments.pop("random_shift")
        self.lr_scales: Mapping[str, float] | None = arguments.pop("lr_scales")
        self.role_keys: RoleKeys | None = arguments.pop("role_keys")
        self.compile: bool | str = arguments.pop("compile")
        self.mixed_precision: bool = arguments.pop("mixed_precision")
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            support_multi_env=True,
            sde_support=False,
            **arguments,
        )
        if sets_up:
            self._setup_model()

    # --- set-up -----------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        super()._setup_model()
        self.chooses_behaviour = self._make_behaviour()
        if self.env is not None:
            _ = self.replay_source  # a look at it, which may raise or warn

    def _prepare_data(self) -> dict[str, Any]:
        self.replay_buffer_class = self._present_buffer_class
        self._fit_action_noise()
        if self.replay_buffer is None and self.env is not None:  # a model without environments only acts, and needs no buffer
            self.replay_buffer = self._make_replay_buffer()
        as_given = {name: getattr(self, name) for name in ("n_steps", "replay_buffer")}
        self.n_steps = 1  # SB3 warns that it can't pass n_steps on to a buffer of a given class, which has it already
        if self.replay_buffer is None:
            self.replay_buffer = object()  # type: ignore[assignment]  # SB3 would make one
        return as_given

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_train_freq("train_freq", self.train_freq, self.n_envs)
        check_action_noise(self.action_noise, self.action_space)
        assert isinstance(self.observation_space, spaces.Dict)
        check_held_by(self.replay_buffer_class, self.observation_space, CompactDictReplayBuffer)
        self.check_samples_from(self.replay_buffer_class)
        if isinstance(self.replay_buffer, ReplayBuffer):  # which may have been loaded, and be of another class
            self.check_samples_from(type(self.replay_buffer))
        self._check_replay_buffer_kwargs()
        check_goals(self.replay_buffer_class, self.observation_space, self.env)
        roles = self.policy_class.roles
        resolve_update_every(roles, self.policy_delay, self.update_every)
        seen = resolve_role_keys(self.observation_space, roles, self.role_keys)[roles.deployed]
        self._shifted_entries = shifted_entries(self.observation_space, seen, self.random_shift)
        if self.recording is not None and not issubclass(self._present_buffer_class, CompactDictReplayBuffer):
            raise ValueError("recording needs a CompactDictReplayBuffer: leave replay_buffer_class out.")
        self._make_behaviour()
        self.target_entropy = resolve_target_entropy(self.target_entropy, self.action_space)

    def check_fixed_arguments(self, given: dict[str, Any], before: dict[str, Any]) -> None:
        """See :meth:`ResumableAlgorithm.check_fixed_arguments`; the replay buffer's storage options are fixed as well."""
        super().check_fixed_arguments(given, before)
        if "replay_buffer_kwargs" in given and "replay_buffer_kwargs" in before:
            for option in ("storage_dtype", "frame_stacks"):
                now, then = ((arguments["replay_buffer_kwargs"] or {}).get(option) for arguments in (given, before))
                check_unchanged(f"replay_buffer_kwargs' {option}", now, then, "resume()")

    def take_effect(self, changed: set[str]) -> None:
        """See :meth:`AsymmetricAlgorithm.take_effect`; here are behaviour, train_freq and the replay buffer's."""
        super().take_effect(changed)
        self.chooses_behaviour = self._make_behaviour()
        self._fit_action_noise()
        if "train_freq" in changed:
            self._convert_train_freq()
        if self.replay_buffer is not None:
            self._set_sampling_options(self.replay_buffer)

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The algorithm's coefficients by name: in most algorithms the entropy temperature alone."""
        return {
            "ent_coef": make_coefficient(
                "ent_coef", self.ent_coef, ENT_COEF_START, ENT_COEF_BOUNDS, self.lr_schedule(1), self.device
            )
        }

    def _check_coefficients(self) -> None:
        """
        Check that arguments of the entropy term were given only where there is such a term.

        :raises ValueError: if there is no entropy temperature, and an argument was given that would do nothing
        """
        if "ent_coef" in self.coefficients:
            return
        unused = {"ent_coef": "auto", "target_entropy": resolve_target_entropy("auto", self.action_space)}
        for name, default in unused.items():
            if getattr(self, name) != default:
                raise ValueError(
                    f"{type(self).__name__} has no entropy term, so {name} would do nothing: leave it out, got "
                    f"{getattr(self, name)!r}."
                )

    # --- learning ---------------------------------------------------------------------------------------------------

    def _setup_learn(
        self, total_timesteps: int, callback: MaybeCallback = None, reset_num_timesteps: bool = True, *args: Any, **kwargs: Any
    ) -> Any:
        self._check_before_training()
        self._recorded = None if self.recording is None else Recording(self.recording, self.n_envs)
        if self._recorded is not None:
            end = total_timesteps + (0 if reset_num_timesteps else self.num_timesteps)
            self._recorded.check_length(ceil(end / self.n_envs))
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        assert self.env is not None
        check_rewards_of_goals(self.replay_buffer_class, self.replay_buffer_kwargs, self.env)
        return result

    def _check_before_training(self) -> None:
        """Check what matters to training alone, so that a model that only acts, and is saved, needs none of it."""
        assert isinstance(self.observation_space, spaces.Dict)
        self.chooses_behaviour.check_parts()
        check_channels_first(self.observation_space, self._shifted_entries, self.random_shift)
        roles = self.policy_class.roles
        seen = resolve_role_keys(self.observation_space, roles, self.role_keys)
        follow = set(roles.unprivileged) - set(self.role_keys or ())  # these read what the deployed policy reads
        critics = {roles.deployed if role in follow else role: seen[role] for role in roles.critics}
        assert self.env is not None
        check_hindsight(self.replay_buffer_class, critics, roles.deployed, self.env)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """See SB3's ``OffPolicyAlgorithm.learn``; by default TensorBoard's runs have the name of the class."""
        self.follow_arguments()  # SB3 looks at train_freq first
        if reset_num_timesteps:  # otherwise further calls may go on from this one
            warn_of_no_gradient_step(self, total_timesteps)
            self.warn_of_networks_at_rest(total_timesteps)
        tb_log_name = tb_log_name or type(self).__name__
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def warn_of_networks_at_rest(self, total_timesteps: int) -> None:
        """
        Called before a training; an algorithm with phases warns if the training ends before a phase that networks need.

        :param total_timesteps: number of environment steps of the training, from its start
        """

    @property
    def history_length(self) -> int:
        """Number of steps before each transition that ``Batch.histories`` holds in the next gradient steps; 0 for none."""
        return 0

    @property
    def at_rest(self) -> frozenset[str]:
        """Networks that the next gradient steps leave as they are, because another phase of training is theirs."""
        return frozenset()

    @abstractmethod
    def update(self, batch: Batch) -> Metrics:
        """
        One gradient step of all networks and coefficients; target networks are updated elsewhere.

        :param batch: B transitions, or sequences of them
        :return: name -> metric, scalars to log under "train/"
        """

    # --- training ---------------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        A round of gradient steps on batches from the replay buffer.

        :param gradient_steps: number of gradient steps
        :param batch_size: number of transitions per gradient step, B
        """
        self.follow_arguments()
        if self._waits_for_an_episode():
            return
        update_every = resolve_update_every(self.policy.roles, self.policy_delay, self.update_every)
        at_rest = self.at_rest
        targets_follow = not set(self.policy.pairs) <= at_rest
        with self.gradient_steps_under_way() as history:
            for name in at_rest:
                getattr(self.policy, name).train(False)
            for _ in range(gradient_steps):
                batch = self._sample_batch(batch_size)
                self._resting = at_rest.union(name for name, every in update_every.items() if self._n_updates % every)
                follow_now = targets_follow and (self._n_updates + 1) % self.target_update_interval == 0
                if self.compiles:  # the update of targets as well
                    step = self._update_with_targets if follow_now else self.update
                    history.append(self.compiled(step, batch))
                else:
                    history.append(self.update(batch))
                    if follow_now:
                        self.policy.update_targets(self.tau)
                self._n_updates += 1

    def _update_with_targets(self, batch: Batch) -> Metrics:
        metrics = self.update(batch)
        self.policy.update_targets(self.tau)
        return metrics

    def gradient_steps_in(self, steps: int) -> int:
        """See :meth:`Compilation.gradient_steps_in`; where ``train_freq`` counts episodes, they count as 1,000 steps each."""
        assert isinstance(self.train_freq, TrainFreq)
        trained = max(steps - max(int(self.learning_starts) - self.num_timesteps, 0), 0)
        if self.gradient_steps < 0:
            return trained
        round_length = self.n_envs if self.train_freq.unit is TrainFrequencyUnit.STEP else _EPISODE
        return trained * self.gradient_steps // (self.train_freq.frequency * round_length)

    def example_of_data(self) -> dict[str, th.Tensor]:
        """Entries of a batch of observations and its rewards, as the networks see them, for the diagnosis of a divergence."""
        batch = self._sample_batch(self.batch_size)
        assert isinstance(batch.observations, dict)
        return {**batch.observations, "reward": batch.rewards}

    def _sample_batch(self, batch_size: int) -> Batch:
        buffer, histories = self.replay_buffer, None
        assert buffer is not None
        samples: Any
        if self.history_length:
            assert isinstance(buffer, CompactDictReplayBuffer)
            samples, histories = buffer.sample_with_histories(batch_size, self.history_length, env=self.sampling_env)
        else:
            samples = buffer.sample(batch_size, env=self.sampling_env)
        return Batch.of(shifted(samples, self._shifted_entries, self.random_shift), self.gamma, histories)
