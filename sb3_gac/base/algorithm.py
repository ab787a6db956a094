"""What algorithms share, on- and off-policy: networks and their files, coefficients, frozen teachers."""

from collections import deque
from collections.abc import Mapping
from copy import deepcopy
from os import PathLike
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv

from sb3_gac.base.acting import BehaviourState
from sb3_gac.base.arguments import ConstructorArguments, present_names
from sb3_gac.base.changing import ChangingArguments
from sb3_gac.base.compiling import AUTO, Compilation
from sb3_gac.base.faults import FaultTolerance
from sb3_gac.base.frozen import FrozenPolicy, load_frozen_policy
from sb3_gac.base.hooks import EpisodeHooks
from sb3_gac.base.loadable import LoadableAlgorithm
from sb3_gac.base.overrides import algorithm_of
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.resuming import ResumableAlgorithm
from sb3_gac.base.roles import MEMORY, RoleKeys, resolve_lr_scales, resolve_rnn_types, resolve_role_keys
from sb3_gac.base.strict_predict import DeploymentGuard
from sb3_gac.base.update import GradientSteps
from sb3_gac.checks.arguments import (
    COMMON_CHECKS,
    ArgumentCheck,
    PlainSchedule,
    check_arguments,
    make_arguments_plain,
)
from sb3_gac.checks.policy import check_policy_kwargs, check_taken
from sb3_gac.checks.requirements import warn_of_an_unseen_goal
from sb3_gac.checks.scale import check_same_scale, check_same_statistics
from sb3_gac.checks.values import plain
from sb3_gac.networks.heads import check_action_space
from sb3_gac.optim.coefficients import Coefficient, DualVariable
from sb3_gac.optim.compile import Programs
from sb3_gac.optim.parallel import has_side_effects
from sb3_gac.replay.source import ReplaySource


class AsymmetricAlgorithm(
    ConstructorArguments,
    ChangingArguments,
    DeploymentGuard,
    ResumableAlgorithm,
    LoadableAlgorithm,
    FaultTolerance,
    EpisodeHooks,
    GradientSteps,
    Compilation,
):
    """
    Base of all algorithms, beside SB3's ``OffPolicyAlgorithm`` or ``OnPolicyAlgorithm``.

    Each ancestor adds one ability to either of the two, and reads no attributes of other ancestors than those it declares.
    ``argument_checks`` says what each argument may be by itself, ``_check_arguments`` what combinations there may be.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {}
    #: Argument -> function that raises a ValueError unless its value is allowed; entries of ancestors count as well
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = COMMON_CHECKS
    #: Arguments whose results are in files: ``load`` and ``resume`` apply them after those results have been restored
    restored_arguments: ClassVar[tuple[str, ...]] = ("lr_scales", "stats_window_size")
    built_in_arguments = (*ResumableAlgorithm.fixed_arguments, "seed")
    #: Arguments that ``policy_kwargs`` may have in their place, since the algorithm asks the policy, or both places, for them
    policy_arguments: ClassVar[tuple[str, ...]] = ("role_keys", "lr_scales")
    #: Arguments that are trained models or their paths, whose policies training asks for actions, see :attr:`frozen`
    frozen_arguments: ClassVar[tuple[str, ...]] = ()
    #: Name of such an argument -> its policy, from the first ``learn`` on
    frozen: dict[str, FrozenPolicy]
    policy_class: type[AsymmetricPolicy]
    policy: AsymmetricPolicy
    lr_scales: Mapping[str, float] | None
    role_keys: RoleKeys | None

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

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        """See SB3's method; schedules are asked for no moment after the end, which a last rollout may go beyond."""
        super()._update_current_progress_remaining(num_timesteps, max(total_timesteps, 1))  # learn(0) is no training
        self._current_progress_remaining = max(self._current_progress_remaining, 0.0)

    def _setup_model(self) -> None:
        make_arguments_plain(self)
        self._check_arguments()
        self.algorithm = algorithm_of(type(self))  # so that a file says which algorithm wrote it
        self.algorithm_path = f"{type(self).__module__}:{type(self).__qualname__}"
        as_given = {"policy_kwargs": self.policy_kwargs, **self._prepare_data()}
        self.policy_kwargs = self._all_policy_kwargs()
        try:
            super()._setup_model()  # type: ignore[safe-super]
        finally:
            self.__dict__.update(as_given)  # so that files hold them as the user gave them
        side_effects = has_side_effects(self.policy)
        self._branches_are_independent = self.device.type == "cpu" and bool(self.policy.side_branch) and not side_effects
        if self.compile not in (False, AUTO):
            self.check_can_compile()
        self.make_schedules()
        self.coefficients = self.make_coefficients()
        self._check_coefficients()
        self._keep_coefficients()
        self.programs = Programs(self.compiled_settings)
        self._behaviour_state: BehaviourState = None
        self.frozen = {}
        if self.env is not None:  # a model without environments only acts, which takes no teacher
            self._load_frozen(needed=False)
        self.keep_in_force()

    def _prepare_data(self) -> dict[str, Any]:
        """
        Make the replay buffer, in an algorithm that has one, before SB3's set-up.

        :return: attributes that the set-up needs changed: name -> value that was given, which is put back afterwards
        """
        return {}

    @property
    def is_recurrent(self) -> bool:
        """Whether a network has a memory, so that training takes sequences."""
        roles, options = self.policy_class.roles, {"role_keys": self.role_keys, **(self.policy_kwargs or {})}
        rnn_type = options.get("rnn_type") or self.policy_class.default_rnn_type
        role_keys = resolve_role_keys(self.observation_space, roles, options["role_keys"])
        return any(resolve_rnn_types(roles, rnn_type, role_keys).values())

    def _check_arguments(self) -> None:
        """
        Check the arguments, each by itself and together.

        :raises ValueError: naming the argument and the remedy
        """
        if not (isinstance(self.policy_class, type) and issubclass(self.policy_class, AsymmetricPolicy)):
            names = list(self.policy_aliases)
            raise ValueError(f"policy must be one of {names} or a subclass of their classes, got {self.policy_class!r}.")
        if not hasattr(self, "observation_space"):
            raise ValueError("env must be an environment, got None: load() alone can do without.")
        check_action_space(type(self).__name__, self.action_space)
        check_arguments(self)
        check_policy_kwargs(self.policy_kwargs)
        roles = self.policy_class.roles
        seen = resolve_role_keys(self.observation_space, roles, self.role_keys)[roles.deployed]
        warn_of_an_unseen_goal(roles.deployed, seen, self.observation_space)
        resolve_lr_scales(roles, self.lr_scales)
        if MEMORY in (self.lr_scales or {}) and not self.is_recurrent:
            raise ValueError(f'lr_scales names "{MEMORY}", but no network has one: leave it out, or choose an rnn_type.')

    def _all_policy_kwargs(self) -> dict[str, Any]:
        own, given = self._policy_options(), present_names(self.policy_class, self.policy_kwargs, "policy_kwargs")
        check_taken("policy_kwargs", self.policy_class, given)
        for name in sorted(own.keys() & given.keys() - set(self.policy_arguments)):
            raise ValueError(f"policy_kwargs has {name}, which is an argument of {type(self).__name__}: pass it as that.")
        return {**own, **given}

    def _policy_options(self) -> dict[str, Any]:
        """The algorithm's own arguments that it hands to the policy class."""
        return {"role_keys": self.role_keys, "lr_scales": self.lr_scales}

    def make_schedules(self) -> None:
        """Make the schedules of arguments that may be schedules, besides the learning rate's."""

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The algorithm's coefficients: name -> coefficient, whose value multiplies a term of a loss."""
        return {}

    def _check_coefficients(self) -> None:
        """Check, once there are coefficients, arguments that go with them."""

    def _keep_coefficients(self) -> None:
        """Keep each coefficient as the attribute whose name files use."""
        for name, coefficient in self.coefficients.items():
            setattr(self, f"{name}_dual", coefficient)

    # --- SB3's names ------------------------------------------------------------------------------------------------

    @property
    def actor(self) -> th.nn.Module:
        """The deployed policy's network, which returns actions when it is called."""
        return self.policy.actor  # type: ignore[return-value]

    @property
    def critic(self) -> th.nn.Module:
        """The critics whose value the deployed policy is trained to increase."""
        return self.policy.critic  # type: ignore[return-value]

    @property
    def critic_target(self) -> th.nn.Module:
        """The target network of :attr:`critic`."""
        return self.policy.critic_target  # type: ignore[return-value]

    @property
    def wrapper_outside_normalisation(self) -> Any:
        """The wrapper that changes observations after ``VecNormalize`` has normalised them; ``None`` if there is none."""
        return None if self.env is None else ReplaySource(self.env).in_the_way

    @property
    def log_ent_coef(self) -> th.Tensor | None:
        """Logarithm of a learned entropy temperature; ``None`` if the temperature is fixed or absent."""
        temperature = self.coefficients.get("ent_coef")
        return temperature.log_value if isinstance(temperature, DualVariable) else None

    @property
    def ent_coef_tensor(self) -> th.Tensor:
        """The entropy temperature."""
        return self.coefficients["ent_coef"].value

    @property
    def ent_coef_optimizer(self) -> th.optim.Optimizer | None:
        """Optimiser of a learned entropy temperature; ``None`` if the temperature is fixed or absent."""
        temperature = self.coefficients.get("ent_coef")
        return None if temperature is None else temperature.optimizer

    def _scheduled_optimizers(self) -> list[th.optim.Optimizer]:
        """Optimisers that follow ``learning_rate``."""
        optimizers = [getattr(self.policy, name).optimizer for name in self.policy.trained]
        temperature = self.coefficients.get("ent_coef")
        return optimizers if temperature is None or temperature.optimizer is None else [*optimizers, temperature.optimizer]

    # --- teachers ---------------------------------------------------------------------------------------------------

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._setup_learn(*args, **kwargs)
        # SB3 leaves the end of the last training here until the first step, but the first policies to act are chosen before
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        self._load_frozen(needed=True)
        if not self._n_updates:  # later the environments' statistics may have moved on
            for name, teacher in self.frozen.items():
                check_same_statistics(name, teacher.entries, teacher.scales, self.env)
        self.decide_compilation()
        return result

    def _load_frozen(self, needed: bool) -> None:
        """
        Load the frozen teachers that are not loaded yet.

        :param needed: whether training is about to begin, for which every teacher must be there
        :raises ValueError: if a needed teacher is missing, or a teacher was trained on other spaces or on another scale
        """
        assert isinstance(self.observation_space, spaces.Dict)
        for name in set(self.frozen_arguments) - set(self.frozen):
            source = getattr(self, name)
            if source is not None:
                teacher = load_frozen_policy(source, self.observation_space, self.action_space, self.device, name)
                _check_scale(name, teacher, self.env)
                self.frozen[name] = teacher
            elif needed:
                raise ValueError(
                    f"{type(self).__name__} trains with a {name}: pass {name}=<a trained model or its path>, to load() and "
                    "resume() as well."
                )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        See SB3's ``set_env``.

        :raises ValueError: if a teacher was trained on observations of another scale; the model keeps its environments
        """
        for name, teacher in self.frozen.items():
            _check_scale(name, teacher, env)
        super().set_env(env, force_reset)

    # --- save and load ----------------------------------------------------------------------------------------------

    def get_parameters(self) -> dict[str, dict]:
        """See SB3's ``get_parameters``; options of optimisers become Python's numbers, whatever set them."""
        self.policy.refresh_parameters()
        parameters = super().get_parameters()
        for name, state in parameters.items():
            if "optim" in name:
                state["param_groups"] = plain(state["param_groups"], arrays=True)
        return parameters

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """See SB3's ``set_parameters``; states of optimisers from earlier versions are converted to the present layout."""
        parameters = load_path_or_dict
        if not isinstance(parameters, dict):
            _, parameters, _ = load_from_zip_file(parameters, device=device, load_data=False)
        parameters = {  # torch's optimisers keep the tensors of a state that they load, and another model may have them
            name: deepcopy(state) if "optimizer" in name else state for name, state in parameters.items()
        }
        for role, network in self.policy.trained.items():
            name = f"policy.{role}.optimizer"
            if name in parameters:
                parameters[name] = network.in_present_layout(parameters[name])
        super().set_parameters(parameters, exact_match, device)

    # --- changes of arguments ---------------------------------------------------------------------------------------

    def take_effect(self, changed: set[str]) -> None:
        """See :meth:`ChangingArguments.take_effect`."""
        self.make_schedules()
        if "learning_rate" in changed:
            self._setup_lr_schedule()
        if replaced := changed.intersection(self.frozen_arguments):
            self.frozen = {name: teacher for name, teacher in self.frozen.items() if name not in replaced}
            self._load_frozen(needed=True)
        if "lr_scales" in changed:
            self.policy.scale_learning_rates(self._all_policy_kwargs()["lr_scales"])
        if "stats_window_size" in changed:
            for buffer in ("ep_info_buffer", "ep_success_buffer"):
                if getattr(self, buffer) is not None:
                    setattr(self, buffer, deque(getattr(self, buffer), maxlen=self._stats_window_size))

    def _excluded_save_params(self) -> list[str]:
        coefficients = [f"{name}_dual" for name in self.coefficients]
        others = ["coefficients", "programs", "_worker", "frozen"]
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


def _check_scale(name: str, teacher: FrozenPolicy, env: Any) -> None:
    check_same_scale(name, teacher.entries, teacher.normalised, env)
