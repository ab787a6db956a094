"""Training that goes on, with all its data, when environments fail, are replaced, or are used from outside the training."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_gac.checks.environments import FAULTS, EnvironmentGuard, guard_environments, guard_of
from sb3_gac.checks.requirements import check_environment
from sb3_gac.checks.spaces import check_spaces_of
from sb3_gac.checks.values import as_sentence
from sb3_gac.envs.vector.settings import reach_layers


class FaultTolerance(BaseAlgorithm):
    """
    Guards the environments, see :mod:`sb3_gac.checks.environments`: a fault ends the episode and costs nothing else.

    After a fault the model can be saved, and ``learn(..., reset_num_timesteps=False)`` goes on from reset environments.
    """

    #: Guard of the environments that training used last, and the number of uses that the guard had counted by then
    _last_use: tuple[EnvironmentGuard | None, int] = (None, 0)
    _used_elsewhere_said = False
    begin_episodes: Callable[[int], None]
    #: Called before the environments are reset: ends the episodes under way in the stored data
    cut_episodes: Callable[[], None]
    #: Called after the environments were reset: keeps what is to be stored of ``_last_obs``
    keep_first_observations: Callable[[], None]

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """
        Wrap, check and guard environments; all environments that the model is given come through here.

        :raises ValueError: naming what the environment lacks, see :func:`check_environment`
        """
        check_environment(env)
        wrapped = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        guard_environments(wrapped)
        reach_layers(wrapped)
        return wrapped

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        See SB3's ``set_env``.

        :raises ValueError: naming the observation entries whose spaces are not the model's
        """
        env = self._wrap_env(env, self.verbose)
        check_spaces_of(self, env, "environment")
        super().set_env(env, force_reset)

    # --- episodes ---------------------------------------------------------------------------------------------------

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """See SB3's ``learn``. After an interrupt such as Ctrl-C, the next ``learn`` begins with a reset of environments."""
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
        """Begin new episodes after a reset of the environments, whose first observations are ``_last_obs``."""
        assert self.env is not None
        self.keep_first_observations()
        self._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        self.begin_episodes(self.env.num_envs)
        self.note_use()

    def note_use(self) -> None:
        """Note that training itself made all uses of the environments that were counted so far."""
        assert self.env is not None
        guard = guard_of(self.env)
        self._last_use = (guard, guard.uses)

    def used_elsewhere(self, env: VecEnv) -> bool:
        """
        Whether training has to begin new episodes, because it was not the last to use the environments.

        :param env: environments that training is about to step
        :return: whether they were stepped or reset from outside the training since its last use, or are other environments
        """
        guard = guard_of(env)
        return self._last_use != (guard, guard.uses)

    def reset_if_used_elsewhere(self, env: VecEnv) -> None:
        """
        Begin new episodes, with a warning, if the environments were used from outside the training or were replaced.

        :param env: environments that training is about to step
        """
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
        """Have an error end the episodes, so that the next ``learn`` resets the environments, and name the step in it."""
        try:
            yield
        except BaseException as error:
            self._last_obs = None
            if isinstance(error, FAULTS):
                error.args = (f"{as_sentence(error)} It happened after {self.num_timesteps} steps (num_timesteps).",)
            raise

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_last_use"]
