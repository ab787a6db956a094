"""What off-policy algorithms with a privileged view share: arguments, their checks, acting and save lists."""

from collections import deque
from collections.abc import Mapping
from copy import deepcopy
from os import PathLike
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from typing_extensions import Self, Unpack

from sb3_gac.base.arguments import ConstructorArguments, OffPolicyArguments, present_names, with_defaults
from sb3_gac.base.behaviour import Behaviour, BehaviourSpec
from sb3_gac.base.frozen import FrozenPolicy, load_frozen_policy
from sb3_gac.base.overrides import algorithm_of, check_known
from sb3_gac.base.policy import AsymmetricPolicy, BehaviourState
from sb3_gac.base.resuming import ResumableAlgorithm
from sb3_gac.base.roles import RoleKeys, resolve_lr_scales, resolve_rnn_types, resolve_role_keys, resolve_update_every
from sb3_gac.base.strict_predict import DeploymentGuard
from sb3_gac.checks.arguments import (
    KEPT_AS,
    SHARED_CHECKS,
    ArgumentCheck,
    PlainSchedule,
    check_arguments,
    check_train_freq,
    make_arguments_plain,
)
from sb3_gac.checks.entries import check_held_by
from sb3_gac.checks.requirements import check_goals, check_rewards_of_goals
from sb3_gac.checks.values import plain
from sb3_gac.networks.heads import check_action_space, resolve_target_entropy
from sb3_gac.optim.coefficients import Coefficient, DualVariable, make_coefficient
from sb3_gac.optim.compile import check_can_compile
from sb3_gac.optim.parallel import has_side_effects
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.episodes import EpisodeReplayBuffer, check_learns_from_sequences

ENT_COEF_START = 0.1
ENT_COEF_BOUNDS = (1e-8, 1e4)
#: Options of our replay buffers that say how to sample, not what is stored
SAMPLING_OPTIONS = ("n_steps", "gamma", "sequence_length", "burn_in")


class AsymmetricOffPolicyAlgorithm(ConstructorArguments, DeploymentGuard, ResumableAlgorithm):
    """
    Base of the algorithms whose behaviour policy sees more than the policy that is deployed.

    A subclass names its policy class in ``policy_aliases`` and writes one gradient step. Its constructor names the arguments
    that are its own alone, see :class:`OffPolicyArguments`: each is kept as the attribute of its name, set before
    ``super().__init__()``, which sets everything up. ``argument_checks`` says what each may be, ``_check_arguments`` what
    depends on others.

    The arguments up to ``target_entropy``, which may come by position, and from ``stats_window_size`` on, are SB3's SAC's.

    :param policy: "MultiInputPolicy", or a subclass of the policy class of that name
    :param env: environment with Dict observations and Box actions
    :param learning_rate: of policies, critics and the entropy temperature; a number or a schedule
    :param buffer_size: transitions kept
    :param learning_starts: steps of uniform warm-up
    :param batch_size: transitions per gradient step
    :param tau: Polyak coefficient of the target critics
    :param gamma: discount factor
    :param train_freq: steps, or (n, "step" | "episode"), between two rounds of training
    :param gradient_steps: gradient steps per round; -1 for as many as there were environment steps
    :param action_noise: added to the behaviour policy's actions
    :param replay_buffer_class: default :class:`CompactDictReplayBuffer`, which stores each observation once
    :param replay_buffer_kwargs: keyword arguments for it
    :param optimize_memory_usage: of other replay buffers, see SB3
    :param n_steps: rewards summed up in a critic's target before it bootstraps
    :param ent_coef: entropy temperature: "auto", "auto_<start value>" or a number
    :param target_update_interval: gradient steps between two updates of the targets
    :param target_entropy: in nats: "auto", "sac" or a number, see :func:`sb3_gac.networks.heads.resolve_target_entropy`
    :param max_grad_norm: bound on the gradient norm of each network; ``None`` for none
    :param policy_delay: gradient steps to each step of a policy; critics take all
    :param update_every: network -> gradient steps to each step of its own, "critic" standing for all critics
    :param behaviour: which policy collects the data, by name, or name -> share of episodes, a number or a schedule; by
        default that of the algorithm; a frozen teacher has the name of its argument
    :param behaviour_per: "episode", or "environment" for shares of the environments
    :param lr_scales: network -> multiple of ``learning_rate``; "critic" stands for all critics
    :param role_keys: role -> observation entries, by default ``partial`` for the deployed policy and all for the others;
        "critic" stands for all critics: where ``privileged`` is the whole state, spare them the sensor noise with
        ``{"critic": ["privileged"]}``
    :param compile: compile losses and gradients: half a minute at the start (less the next time, from a cache), faster
        gradient steps from then on; needs a C++ compiler on the CPU
    :param mixed_precision: matrix products of losses and gradients in bfloat16, which pays at 256 units and more on
        hardware that has it, with ``compile``
    :param stats_window_size: episodes averaged in rollout statistics
    :param tensorboard_log: log directory, ``None`` for no log
    :param policy_kwargs: keyword arguments of the policy class
    :param verbose: 0 silent, 1 information, 2 debug
    :param seed: of the pseudo-random generators
    :param device: "auto", "cpu", "cuda", ...
    :param _init_setup_model: build the networks at construction
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {}
    #: Argument -> what raises a ValueError unless it is allowed; a subclass writes its own, its ancestors' count as well
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = SHARED_CHECKS
    #: Arguments that files hold results of: given to ``load`` or ``resume``, they count once those are restored
    restored_arguments: ClassVar[tuple[str, ...]] = ("ent_coef", "lr_scales", "stats_window_size")
    #: Arguments that are models, or their paths, and that training asks for their policies, see :attr:`frozen`
    frozen_arguments: ClassVar[tuple[str, ...]] = ()
    #: Name of such an argument -> its policy, from the first ``learn`` on
    frozen: dict[str, FrozenPolicy]
    policy_class: type[AsymmetricPolicy]
    policy: AsymmetricPolicy
    ent_coef_dual: Coefficient

    def __init__(
        self,
        policy: str | type[AsymmetricPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        **shared: Unpack[OffPolicyArguments],
    ):
        check_known(type(self), shared)
        arguments = with_defaults(sb3, shared)
        for name in ("verbose", "device"):  # SB3's constructor uses them
            SHARED_CHECKS[name](name, arguments[name])
        sets_up = arguments.pop("_init_setup_model")
        self.ent_coef: str | float = arguments.pop("ent_coef")
        self.target_entropy: str | float = arguments.pop("target_entropy")
        self.target_update_interval: int = arguments.pop("target_update_interval")
        self.max_grad_norm: float | None = arguments.pop("max_grad_norm")
        self.policy_delay: int = arguments.pop("policy_delay")
        self.update_every: Mapping[str, int] | None = arguments.pop("update_every")
        self.behaviour: BehaviourSpec = arguments.pop("behaviour")
        self.behaviour_per: str = arguments.pop("behaviour_per")
        self.lr_scales: Mapping[str, float] | None = arguments.pop("lr_scales")
        self.role_keys: RoleKeys | None = arguments.pop("role_keys")
        self.compile: bool = arguments.pop("compile")
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

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(
                f'policy must be one of {list(self.policy_aliases)} or a policy class, got "{policy_name}": '
                f'{type(self).__name__} works on Dict observations, for which SB3\'s name is "MultiInputPolicy".'
            )
        return self.policy_aliases[policy_name]

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = PlainSchedule(self.learning_rate)

    def _setup_model(self) -> None:
        make_arguments_plain(self)
        self._check_arguments()
        self.algorithm = algorithm_of(type(self))  # so that a file says whose it is
        self.algorithm_path = f"{type(self).__module__}:{type(self).__qualname__}"
        if self.replay_buffer_class is None:
            self.replay_buffer_class = EpisodeReplayBuffer if self.is_recurrent else CompactDictReplayBuffer
        self._fit_action_noise()
        if self.replay_buffer is None and self.env is not None:  # to act takes no memory for training
            self.replay_buffer = self._make_replay_buffer()
        as_given = {name: getattr(self, name) for name in ("policy_kwargs", "n_steps", "replay_buffer")}
        self.policy_kwargs = self._all_policy_kwargs()
        if issubclass(self.replay_buffer_class, CompactDictReplayBuffer):
            self.n_steps = 1  # SB3 warns that it can't pass n_steps on to this buffer: it was
        if self.replay_buffer is None:
            self.replay_buffer = object()  # type: ignore[assignment]  # SB3 would make one
        try:
            super()._setup_model()
        finally:
            self.__dict__.update(as_given)  # saved as the user gave them
        side_effects = has_side_effects(self.policy)
        self._branches_are_independent = (
            self.device.type == "cpu" and self.policy.branches_are_independent and not side_effects
        )
        if self.compile:
            self._check_can_compile(side_effects)
        self.chooses_behaviour = self._make_behaviour()
        self.coefficients = self.make_coefficients()
        self._keep_coefficients()
        self.programs = {}
        self._behaviour_state: BehaviourState = None
        self.frozen = {}
        if self.env is not None:  # to act takes no teacher
            self._load_frozen(needed=False)
        if self.env is not None:
            _ = self.replay_source  # which may refuse, or warn

    @property
    def is_recurrent(self) -> bool:
        """Whether a network has a memory, so that training takes sequences."""
        rnn_type = (self.policy_kwargs or {}).get("rnn_type") or self.policy_class.default_rnn_type
        return any(resolve_rnn_types(self.policy_class.roles, rnn_type).values())

    def _check_can_compile(self, side_effects: bool) -> None:
        if side_effects:
            raise ValueError("compile=True can't do dropout or batch normalisation: leave them out, or leave it False.")
        check_can_compile()
        for name, network in self.policy.trained.items():
            if not network.can_be_compiled:
                raise ValueError(
                    "compile=True can do torch's Adam and AdamW, without amsgrad, foreach or fused=False, but the optimiser "
                    f"of {name} is {type(network.optimizer).__name__}: choose another optimizer_class, or leave compile False."
                )

    def _check_arguments(self) -> None:
        """
        :raises ValueError: naming the argument and the remedy
        """
        if not (isinstance(self.policy_class, type) and issubclass(self.policy_class, AsymmetricPolicy)):
            names = list(self.policy_aliases)
            raise ValueError(f"policy must be one of {names} or a subclass of their classes, got {self.policy_class!r}.")
        if not hasattr(self, "observation_space"):
            raise ValueError("env must be an environment, got None: load() alone can do without.")
        check_action_space(type(self).__name__, self.action_space)
        check_arguments(self)
        check_train_freq("train_freq", self.train_freq, self.n_envs)
        if self.action_noise is not None and not isinstance(self.action_space, spaces.Box):
            raise ValueError("action_noise can be added to Box actions only: leave it out.")
        resolve_role_keys(self.observation_space, self.policy_class.roles, self.role_keys)
        assert isinstance(self.observation_space, spaces.Dict)
        check_held_by(self.replay_buffer_class, self.observation_space, CompactDictReplayBuffer)
        check_goals(self.replay_buffer_class, self.observation_space, self.env)
        resolve_lr_scales(self.policy_class.roles, self.lr_scales)
        resolve_update_every(self.policy_class.roles, self.policy_delay, self.update_every)
        self._make_behaviour()
        if self.is_recurrent:
            check_learns_from_sequences(self.replay_buffer_class, self.compile, self.n_steps)
        self.target_entropy = resolve_target_entropy(self.target_entropy, self.action_space)

    def _make_replay_buffer(self) -> ReplayBuffer:
        assert self.replay_buffer_class is not None
        options = self._replay_buffer_options()
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            options["env"] = self.env
        return self.replay_buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **options,
        )

    def _replay_buffer_options(self) -> dict[str, Any]:
        """Arguments of the replay buffer's class, those that are arguments of the algorithm included."""
        assert self.replay_buffer_class is not None
        ours = issubclass(self.replay_buffer_class, CompactDictReplayBuffer)
        return {**({"n_steps": self.n_steps, "gamma": self.gamma} if ours else {}), **self.replay_buffer_kwargs}

    def _fit_action_noise(self) -> None:
        """Noise that SB3 has made for another number of environments becomes noise for as many as there are."""
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.n_envs:
            base = deepcopy(noise.base_noise)
            base.reset()
            self.action_noise = VectorizedActionNoise(base, self.n_envs) if self.n_envs > 1 else base

    def _all_policy_kwargs(self) -> dict[str, Any]:
        return {**self._policy_options(), **present_names(self.policy_class, self.policy_kwargs, "policy_kwargs")}

    def _policy_options(self) -> dict[str, Any]:
        """Arguments of the policy class that are arguments of the algorithm."""
        return {"role_keys": self.role_keys, "lr_scales": self.lr_scales}

    def make_coefficients(self) -> dict[str, Coefficient]:
        """Name -> what a loss multiplies one of its terms with; the entropy temperature, in most algorithms."""
        return {
            "ent_coef": make_coefficient(
                "ent_coef", self.ent_coef, ENT_COEF_START, ENT_COEF_BOUNDS, self.lr_schedule(1), self.device
            )
        }

    def _keep_coefficients(self) -> None:
        """Under the names that files know them by."""
        for name, coefficient in self.coefficients.items():
            setattr(self, f"{name}_dual", coefficient)

    # --- SB3's names ------------------------------------------------------------------------------------------------

    @property
    def actor(self) -> th.nn.Module:  # type: ignore[override]
        """The deployed policy; called, it returns actions."""
        return self.policy.actor  # type: ignore[return-value]

    @property
    def critic(self) -> th.nn.Module:
        """The critics that the deployed policy climbs."""
        return self.policy.critic  # type: ignore[return-value]

    @property
    def critic_target(self) -> th.nn.Module:
        """Target of :attr:`critic`."""
        return self.policy.critic_target  # type: ignore[return-value]

    @property
    def log_ent_coef(self) -> th.Tensor | None:
        """Logarithm of a learned entropy temperature; ``None`` if it is fixed, or there is none."""
        temperature = self.coefficients.get("ent_coef")
        return temperature.log_value if isinstance(temperature, DualVariable) else None

    @property
    def ent_coef_tensor(self) -> th.Tensor:
        """The entropy temperature."""
        return self.ent_coef_dual.value

    @property
    def ent_coef_optimizer(self) -> th.optim.Optimizer | None:
        """Optimiser of a learned entropy temperature; ``None`` if it is fixed, or there is none."""
        temperature = self.coefficients.get("ent_coef")
        return None if temperature is None else temperature.optimizer

    def _scheduled_optimizers(self) -> list[th.optim.Optimizer]:
        """Optimisers that follow ``learning_rate``."""
        optimizers = [getattr(self.policy, name).optimizer for name in self.policy.trained]
        temperature = self.coefficients.get("ent_coef")
        return optimizers if temperature is None or temperature.optimizer is None else [*optimizers, temperature.optimizer]

    # --- acting -----------------------------------------------------------------------------------------------------

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Uniform during warm-up, then the behaviour policy, which sees everything.

        :param learning_starts: steps of warm-up
        :param action_noise: added to the scaled action, which is then clipped
        :param n_envs: number of environments
        :return: action for the environments, and the same scaled to [-1, 1] for the buffer
        """
        action, scaled_action = self._next_action(learning_starts, action_noise, n_envs)
        self._behaviour_state = self.policy.with_actions(self._behaviour_state, scaled_action)
        return action, scaled_action

    def _next_action(
        self, learning_starts: int, action_noise: ActionNoise | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        warms_up = self.num_timesteps < learning_starts
        episode_starts = np.ones(n_envs, dtype=bool) if self._last_episode_starts is None else self._last_episode_starts
        if len(self.acting) != n_envs:
            self._begin_episodes(n_envs)
        self.acting = self.choose_acting(episode_starts)
        self._has_warmed_up |= warms_up
        if warms_up and not (self.is_recurrent or self.policy.remembers):
            return super()._sample_action(learning_starts, action_noise, n_envs)
        assert isinstance(self._last_obs, dict)
        trained = [self.policy.roles.behaviour if role in self.frozen else role for role in self.acting]
        scaled_action, self._behaviour_state = self.policy.behaviour_action(
            self._last_obs, self._behaviour_state, episode_starts, acting=trained
        )
        for name in self.frozen.keys() & set(self.acting):
            rows = np.array([role == name for role in self.acting])
            scaled_action[rows] = self.policy.frozen_action(self.frozen[name], self._last_obs)[rows]
        if warms_up:  # the memory was brought up
            return super()._sample_action(learning_starts, action_noise, n_envs)
        if action_noise is not None:
            scaled_action = np.clip(scaled_action + action_noise(), -1, 1)
        return self._in_environments_range(scaled_action), scaled_action

    def _make_behaviour(self) -> Behaviour:
        return Behaviour(self.policy_class.roles, self.behaviour, self.behaviour_per, self.frozen_arguments)

    def choose_acting(self, episode_start: np.ndarray) -> list[str]:
        """
        Which policy acts in each environment, see ``behaviour``; to be overridden by algorithms with a rule of their own.

        :param episode_start: true where an episode starts, shape (n_envs,)
        :return: role of the policy, or name of a frozen one, of each environment; who has acted stays to the episode's end
        """
        return self.chooses_behaviour.choose(self.acting, episode_start, self._current_progress_remaining)

    def _in_environments_range(self, action: np.ndarray) -> np.ndarray:
        """
        :param action: in [-1, 1], or one of a number
        """
        return self.policy.unscale_action(action) if isinstance(self.action_space, spaces.Box) else action

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._setup_learn(*args, **kwargs)
        assert self.env is not None
        check_rewards_of_goals(self.replay_buffer_class, self.replay_buffer_kwargs, self.env)
        self._load_frozen(needed=True)
        return result

    def _load_frozen(self, needed: bool) -> None:
        """
        :param needed: whether training is about to begin
        :raises ValueError: if one is not there that is needed, or was trained on other spaces
        """
        assert isinstance(self.observation_space, spaces.Dict)
        for name in set(self.frozen_arguments) - set(self.frozen):
            source = getattr(self, name)
            if source is not None:
                self.frozen[name] = load_frozen_policy(source, self.observation_space, self.action_space, self.device, name)
            elif needed:
                raise ValueError(
                    f"{type(self).__name__} trains with a {name}: pass {name}=<a trained model or its path>, to load() and "
                    "resume() as well."
                )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """See SB3's ``OffPolicyAlgorithm.learn``; TensorBoard's runs are named after the class by default."""
        tb_log_name = tb_log_name or type(self).__name__
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    # --- save and load ----------------------------------------------------------------------------------------------

    def get_parameters(self) -> dict[str, dict]:
        """See SB3's ``get_parameters``: optimisers' options are Python's numbers, whatever a schedule or a callback left."""
        self.policy.refresh_parameters()
        parameters = super().get_parameters()
        for name, state in parameters.items():
            if "optim" in name:
                state["param_groups"] = plain(state["param_groups"], arrays=True)
        return parameters

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """See SB3's ``set_parameters``; optimisers' state of earlier versions becomes that of present ones."""
        parameters = load_path_or_dict
        if not isinstance(parameters, dict):
            _, parameters, _ = load_from_zip_file(parameters, device=device, load_data=False)
        parameters = dict(parameters)
        for role, network in self.policy.trained.items():
            name = f"policy.{role}.optimizer"
            if name in parameters:
                parameters[name] = network.in_present_layout(parameters[name])
        super().set_parameters(parameters, exact_match, device)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """See SB3's ``load_replay_buffer``; how the buffer is sampled is the model's to say, not the file's."""
        super().load_replay_buffer(path, truncate_last_traj)
        if isinstance(self.replay_buffer, CompactDictReplayBuffer):
            options = self._replay_buffer_options()
            given = {name: options[name] for name in SAMPLING_OPTIONS if name in options and hasattr(self.replay_buffer, name)}
            vars(self.replay_buffer).update(given)

    def _change_arguments(self, given: dict[str, Any]) -> None:
        """
        :param given: some of ``restored_arguments``; they take the place of what was restored. A coefficient that is learned
            before and after goes on from where it was, unless it is given a start value
        """
        if not given:
            return
        before = {name: (getattr(self, name, None), coefficient) for name, coefficient in self.coefficients.items()}
        vars(self).update({KEPT_AS.get(name, name): value for name, value in given.items()})
        make_arguments_plain(self)
        self._check_arguments()
        self.coefficients = self.make_coefficients()
        for name, (spec, coefficient) in before.items():
            spec_now = getattr(self, name, None)
            if not any(other.startswith(name) for other in given):
                self.coefficients[name] = coefficient
            elif spec_now == spec or (spec_now == "auto" and isinstance(coefficient, DualVariable)):
                self.coefficients[name].go_on_from(coefficient)
        self._keep_coefficients()
        if "lr_scales" in given:
            self.policy.scale_learning_rates(self._all_policy_kwargs()["lr_scales"])
        for buffer in ("ep_info_buffer", "ep_success_buffer"):
            if getattr(self, buffer) is not None:
                setattr(self, buffer, deque(getattr(self, buffer), maxlen=self._stats_window_size))

    def _excluded_save_params(self) -> list[str]:
        coefficients = [f"{name}_dual" for name in self.coefficients]
        others = ["coefficients", "programs", "_program_key", "chooses_behaviour", "frozen"]
        others += [name for name in self.frozen_arguments if not isinstance(getattr(self, name), (str, PathLike))]
        return [*super()._excluded_save_params(), *coefficients, *others]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", *(f"policy.{name}.optimizer" for name in self.policy.trained)]
        tensors = []
        for name, coefficient in self.coefficients.items():
            of_optimizers, of_tensors = coefficient.state_names
            state_dicts += [f"{name}_dual.{attribute}" for attribute in of_optimizers]
            tensors += [f"{name}_dual.{attribute}" for attribute in of_tensors]
        return state_dicts, tensors
