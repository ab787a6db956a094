"""What an algorithm does when its environments fail, are others than before, or are used by somebody else: nothing is lost."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_gac.base.arguments import needed_arguments_from, present_names
from sb3_gac.base.overrides import check_names, check_unchanged, check_whose
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.arguments import KEPT_AS, merged
from sb3_gac.checks.environments import FAULTS, EnvironmentGuard, guard_environments, guard_of
from sb3_gac.checks.requirements import check_environment
from sb3_gac.checks.values import as_sentence, check_same_spaces


class FaultTolerance(BaseAlgorithm):
    """
    Environments are guarded, see :mod:`sb3_gac.checks.environments`; a fault ends the episode and costs nothing else.

    After one, the model can be saved, and ``learn(..., reset_num_timesteps=False)`` goes on from reset environments.
    """

    restored_arguments: ClassVar[tuple[str, ...]]
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    policy: AsymmetricPolicy
    #: Guard of the environments that were last used from here, and what it had counted by then
    _last_use: tuple[EnvironmentGuard | None, int] = (None, 0)
    _used_elsewhere_said = False
    begin_episodes: Callable[[int], None]
    _change_arguments: Callable[[dict[str, Any]], None]
    #: The environments are about to be reset: what was stored last is not continued by what comes next
    cut_episodes: Callable[[], None]
    #: The environments were just reset: what is to be stored of ``_last_obs``
    keep_first_observations: Callable[[], None]

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """
        Whatever environment the model is given comes through here.

        :raises ValueError: see :func:`check_environment`
        """
        check_environment(env)
        wrapped = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        guard_environments(wrapped)
        return wrapped

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        See SB3's ``set_env``.

        :raises ValueError: naming the observation entries whose spaces are not the model's
        """
        env = self._wrap_env(env, self.verbose)
        check_same_spaces_as(self, env, "environment")
        super().set_env(env, force_reset)

    @classmethod
    def load(
        cls,
        path: Any,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **given: Any,
    ) -> Self:
        """
        See SB3's ``load``. Without ``env`` there is no replay buffer, until :meth:`set_env` gives one.

        :param path: of the file
        :param env: to learn on; their number may be another than before
        :param device: "auto", "cpu", "cuda", ...
        :param custom_objects: attribute -> value, in place of what the file holds
        :param print_system_info: of this system and of that on which the model was saved
        :param force_reset: start new episodes
        :param given: arguments of the constructor, which take the place of those that the model was saved with, and
            ``strict_deployment``
        :raises TypeError: naming what is no argument
        :raises ValueError: naming the observation entries whose spaces have changed since the model was saved, arguments
            that can't be changed, or the algorithm if the file is another one's
        """
        given = present_names(cls, given, "load()")
        custom_objects = dict(custom_objects or {})
        later = {name: custom_objects.pop(name) for name in cls.restored_arguments if name in custom_objects}
        saved, _, _ = load_from_zip_file(path, device="cpu", custom_objects=custom_objects)
        assert saved is not None
        check_whose(cls, saved, path)
        check_names(cls, given, "load()")
        later |= {name: given.pop(name) for name in cls.restored_arguments if name in given}
        if "policy" in given:
            policy = given.pop("policy")
            check_unchanged("policy", cls.policy_aliases.get(policy, policy), saved["policy_class"], "load()")
        if "policy_kwargs" in given:
            check_unchanged("policy_kwargs", given.pop("policy_kwargs"), saved["policy_kwargs"], "load()")
        if env is not None:
            env = cls._wrap_env(env, saved.get("verbose", 0))
            check_same_spaces_as(SimpleNamespace(**saved), env, "environment")
            force_reset = force_reset or env.num_envs != saved["n_envs"]
        former = {name: saved.pop(name) for name in merged(cls, "renamed_arguments") if name in saved}
        present = {name: value for name, value in present_names(cls, former, None).items() if name not in saved}
        attributes = {KEPT_AS.get(name, name): value for name, value in (present | given).items()}
        with networks_named(path, [*given, *custom_objects]), needed_arguments_from(saved | attributes, cls):
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **attributes)
        for name in former:
            del vars(model)[name]
        model.policy.freeze_as_saved()
        model._change_arguments(later)
        return model

    # --- episodes ---------------------------------------------------------------------------------------------------

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """See SB3's ``learn``. After an interrupt, as by Ctrl-C, the next one starts with a reset of the environments."""
        try:
            return super().learn(*args, **kwargs)  # type: ignore[safe-super]
        except BaseException as error:
            if not isinstance(error, Exception):
                self._last_obs = None
            raise

    def _setup_learn(self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *args: Any) -> Any:
        resets = reset_num_timesteps or self._last_obs is None
        if resets:
            self.cut_episodes()
        with self._step_named():
            result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args)
        if resets:
            self.note_reset()
        return result

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> Any:
        """See SB3's ``collect_rollouts``."""
        with self._step_named():
            return super().collect_rollouts(*args, **kwargs)  # type: ignore[misc]

    def note_reset(self) -> None:
        """The environments were just reset: ``_last_obs`` is their first observation."""
        assert self.env is not None
        self.keep_first_observations()
        self._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        self.begin_episodes(self.env.num_envs)
        self.note_use()

    def note_use(self) -> None:
        """Whatever was done to the environments so far was done from here."""
        assert self.env is not None
        guard = guard_of(self.env)
        self._last_use = (guard, guard.uses)

    def used_elsewhere(self, env: VecEnv) -> bool:
        """Whether somebody else has stepped or reset the environments since the last use, or they are others than then."""
        guard = guard_of(env)
        return self._last_use != (guard, guard.uses)

    def reset_if_used_elsewhere(self, env: VecEnv) -> None:
        """Episodes under way end where somebody else has stepped or reset the environments, or they are others than before."""
        if self._last_obs is not None and not self.used_elsewhere(env):
            return
        if self._last_obs is not None and not self._used_elsewhere_said:
            warnings.warn(
                "The training environments were stepped or reset from outside the training, as by an evaluation on them, or "
                "force_reset=False was given with others than before: the episodes under way end there, and new ones start. "
                "Give evaluations an environment of their own.",
                stacklevel=4,
            )
            self._used_elsewhere_said = True
        self.cut_episodes()
        self._last_obs = env.reset()  # type: ignore[assignment]
        self.note_reset()

    @contextmanager
    def _step_named(self) -> Iterator[None]:
        """An error ends the episode: the next ``learn()`` resets the environments and keeps the rest."""
        try:
            yield
        except BaseException as error:
            self._last_obs = None
            if isinstance(error, FAULTS):
                error.args = (f"{as_sentence(error)} It happened after {self.num_timesteps} steps (num_timesteps).",)
            raise

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_last_use"]


@contextmanager
def networks_named(path: Any, given: list[str]) -> Iterator[None]:
    """
    An error of networks that do not fit says what may be the reason.

    :param path: that the networks come from
    :param given: names of the arguments that are others than in the file
    """
    try:
        yield
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        raise ValueError(
            f"The networks in {path} do not fit those that the arguments make: leave out which of {given} changes networks. "
            f"{error}"
        ) from error


def check_same_spaces_as(model: Any, other: Any, whose: str) -> None:
    """
    :param model: has observation and action space
    :param other: has such as well
    :param whose: the other ones are, for the message
    :raises ValueError: naming the entries that differ
    """
    check_same_spaces("Observation", model.observation_space, other.observation_space, whose)
    check_same_spaces("Action", model.action_space, other.action_space, whose)
