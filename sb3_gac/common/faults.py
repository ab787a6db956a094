"""What an off-policy algorithm does when its environments fail or are not those that it was made for: nothing is lost."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_gac.common.checks import check_same_spaces
from sb3_gac.common.env_guard import FAULTS, guard_environments
from sb3_gac.common.environments import check_environment


class FaultTolerance(OffPolicyAlgorithm):
    """
    Environments are guarded, see :mod:`sb3_gac.common.env_guard`; a fault ends the episode and costs nothing else.

    After one, the model can be saved, and ``learn(..., reset_num_timesteps=False)`` goes on from reset environments.
    """

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """
        Whatever environment the model is given comes through here.

        :raises ValueError: see :func:`check_environment`
        """
        check_environment(env)
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        guard_environments(wrapped)
        return wrapped

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        See SB3's ``set_env``.

        :raises ValueError: naming the observation entries whose spaces are not the model's
        """
        env = self._wrap_env(env, self.verbose)
        _check_spaces(self, env, "environment")
        super().set_env(env, force_reset)

    @classmethod
    def load(cls, path: Any, env: GymEnv | None = None, *args: Any, **kwargs: Any) -> Self:
        """
        See SB3's ``load``.

        :raises ValueError: naming the observation entries whose spaces have changed since the model was saved
        """
        try:
            return super().load(path, env, *args, **kwargs)
        except ValueError as error:
            if env is not None and "spaces do not match" in str(error):
                saved, _, _ = load_from_zip_file(path, custom_objects=kwargs.get("custom_objects"))
                assert saved is not None
                _check_spaces(SimpleNamespace(**saved), cls._wrap_env(env), "environment")
            raise

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """
        See SB3's ``load_replay_buffer``.

        :raises ValueError: naming the observation entries whose spaces are not the model's; the buffer stays what it was
        """
        before = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded, self.replay_buffer = self.replay_buffer, before
        assert loaded is not None
        _check_spaces(self, loaded, "replay buffer")
        self.replay_buffer = loaded

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        if self.replay_buffer is not None and self.replay_buffer.n_envs != self.n_envs:
            raise ValueError(
                f"The replay buffer was filled by {self.replay_buffer.n_envs} environments, but the model has {self.n_envs}: "
                "load the model with as many environments, or leave the buffer out."
            )
        with self._step_named():
            return super()._setup_learn(*args, **kwargs)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """See SB3's ``collect_rollouts``."""
        with self._step_named():
            return super().collect_rollouts(*args, **kwargs)

    @contextmanager
    def _step_named(self) -> Iterator[None]:
        """An error ends the episode: the next ``learn()`` resets the environments and keeps the rest."""
        try:
            yield
        except Exception as error:
            self._last_obs = None
            if isinstance(error, FAULTS):
                error.args = (f"{error} It happened after {self.num_timesteps} steps (num_timesteps).",)
            raise


def _check_spaces(model: Any, other: Any, whose: str) -> None:
    check_same_spaces("Observation", model.observation_space, other.observation_space, whose)
    check_same_spaces("Action", model.action_space, other.action_space, whose)
