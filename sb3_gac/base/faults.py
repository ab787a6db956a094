"""What an off-policy algorithm does when its environments fail or are not those that it was made for: nothing is lost."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from typing_extensions import Self

from sb3_gac.base.arguments import needed_arguments_from, present_names
from sb3_gac.base.collecting import DataCollection
from sb3_gac.base.overrides import check_names, check_unchanged, check_whose
from sb3_gac.checks.arguments import KEPT_AS, check_train_freq, merged
from sb3_gac.checks.environments import FAULTS
from sb3_gac.checks.values import as_sentence, check_same_spaces


class OtherNumberOfEnvironmentsError(AssertionError, ValueError):
    """The replay buffer was filled by as many environments as the model does not have. SB3 raises AssertionError here."""


class FaultTolerance(DataCollection):
    """
    Environments are guarded, see :mod:`sb3_gac.checks.environments`; a fault ends the episode and costs nothing else.

    After one, the model can be saved, and ``learn(..., reset_num_timesteps=False)`` goes on from reset environments.
    """

    restored_arguments: ClassVar[tuple[str, ...]]
    _behaviour_state: Any
    _make_replay_buffer: Callable[[], ReplayBuffer]
    _fit_action_noise: Callable[[], None]
    _change_arguments: Callable[[dict[str, Any]], None]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        See SB3's ``set_env``; as long as nothing is in the replay buffer, the number of environments may be another one.

        :raises ValueError: naming the observation entries whose spaces are not the model's, or if the replay buffer was
            filled by another number of environments
        """
        env = self._wrap_env(env, self.verbose)
        _check_spaces(self, env, "environment")
        buffer = self.replay_buffer
        if buffer is not None and buffer.n_envs != env.num_envs:
            if buffer.size() > 0:
                _check_number(buffer, env.num_envs, f"{type(self).__name__}.load(path, env=...) takes any number")
            self.replay_buffer = None
        if env.num_envs != self.n_envs:
            check_train_freq("train_freq", self.train_freq, env.num_envs)
            self.n_envs, self._last_obs, self._behaviour_state = env.num_envs, None, None
            self._fit_action_noise()
        super().set_env(env, force_reset)
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        if isinstance(self.replay_buffer, HerReplayBuffer):
            self.replay_buffer.env = self.env  # which rewards goals: SB3 would ask the one before
        _ = self.replay_source  # which may refuse, or warn

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
            _check_spaces(SimpleNamespace(**saved), env, "environment")
            force_reset = force_reset or env.num_envs != saved["n_envs"]
        former = {name: saved.pop(name) for name in merged(cls, "renamed_arguments") if name in saved}
        present = {name: value for name, value in present_names(cls, former, None).items() if name not in saved}
        attributes = {KEPT_AS.get(name, name): value for name, value in (present | given).items()}
        with networks_named(path, [*given, *custom_objects]), needed_arguments_from(saved | attributes, cls):
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **attributes)
        for name in former:
            del vars(model)[name]
        model.policy.freeze_as_saved()  # type: ignore[operator]
        model._change_arguments(later)
        return model

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """
        See SB3's ``load_replay_buffer``.

        :raises ValueError: naming the observation entries whose spaces are not the model's, or if another number of
            environments filled it; the buffer stays what it was
        """
        before = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        finally:
            loaded, self.replay_buffer = self.replay_buffer, before
        assert loaded is not None
        _check_spaces(self, loaded, "replay buffer")
        if self.env is not None:
            _check_number(loaded, self.n_envs)
        self.replay_buffer = loaded

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        if self.replay_buffer is None and self.env is not None:
            self.replay_buffer = self._make_replay_buffer()
        if self.replay_buffer is not None:
            _check_number(self.replay_buffer, self.n_envs)
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
        except BaseException as error:
            self._last_obs = None
            if isinstance(error, FAULTS):
                error.args = (f"{as_sentence(error)} It happened after {self.num_timesteps} steps (num_timesteps).",)
            raise


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


def _check_number(buffer: Any, n_envs: int, remedy: str = "load the model with as many environments") -> None:
    if buffer.n_envs != n_envs:
        raise OtherNumberOfEnvironmentsError(
            f"The replay buffer was filled by {buffer.n_envs} environments, but the model has {n_envs}: {remedy}, or leave "
            "the buffer out."
        )


def _check_spaces(model: Any, other: Any, whose: str) -> None:
    check_same_spaces("Observation", model.observation_space, other.observation_space, whose)
    check_same_spaces("Action", model.action_space, other.action_space, whose)
