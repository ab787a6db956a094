"""A guard of vectorised environments, which names an environment that fails before its values do harm."""

import traceback
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, unwrap_vec_normalize

from sb3_gac.checks.observations import (
    GO_ON,
    REWARD,
    InvalidStepError,
    check_entries,
    check_observation,
    check_rows,
    entries_in,
)
from sb3_gac.checks.processes import KEPT, WatchedPipe, end_processes
from sb3_gac.checks.spaces import entries_of
from sb3_gac.checks.uses import FINAL, EnvironmentUse, KeepingFinal, SuspiciousEnds
from sb3_gac.checks.values import described

GUARD = "_environment_guard"
TRUNCATED = "TimeLimit.truncated"  # SB3's name of an end by time limit in an info
RAW_FINAL = "raw_terminal_observation"  # key in an info of the observation that VecNormalize replaces under FINAL
ONE_AFTER_THE_OTHER = (DummyVecEnv.step_wait.__code__, DummyVecEnv.reset.__code__)
REWARD_IS_TAKEN = (DummyVecEnv.step_wait.__code__, Monitor.step.__code__)  # where SB3 makes a number of the reward
NO_NUMBER = ("0-dimensional arrays", "size-1 arrays", "array element with a sequence", "float() argument")  # numpy's words


class EnvironmentFailedError(RuntimeError):
    """An environment raised, or its process died."""


FAULTS = (InvalidStepError, EnvironmentFailedError)


def guard_environments(env: VecEnv) -> None:
    """
    Have the environments' values checked before they are stored, and before ``VecNormalize``, if there is one, learns them.

    :param env: vectorised environments, which get a guard unless they have one
    """
    guarded = _guarded(env)
    if GUARD not in vars(guarded):  # getattr would find that of an environment further in
        vars(guarded)[GUARD] = EnvironmentGuard(guarded)


def guard_of(env: VecEnv) -> "EnvironmentGuard":
    """
    The guard of vectorised environments.

    :param env: environments that :func:`guard_environments` was given
    :return: their guard
    """
    return vars(_guarded(env))[GUARD]


def _guarded(env: VecEnv) -> VecEnv:
    normalizer = unwrap_vec_normalize(env)
    return env if normalizer is None else normalizer.venv


class EnvironmentGuard:
    """
    Checks all that vectorised environments take and return, in place of their ``reset``, ``step_async`` and ``step_wait``.

    The guard replaces these methods of the instance and is no wrapper: SB3 goes through the wrappers of training and
    evaluation environments side by side (``sync_envs_normalization``) and compares their types.

    :param env: vectorised environments
    """

    def __init__(self, env: VecEnv):
        self.env, self.base = env, env.unwrapped
        self._entries = entries_in(env.observation_space)
        self._base_entries = entries_in(self.base.observation_space)
        self._failure: str | None = None
        #: Number of environments that DummyVecEnv, which steps one after the other, has done in the call under way
        self._done = 0
        self._calls = 0
        #: The guard that counts them: the first one, where several wrappers around the same environments have one each
        self._counting = self
        self._uses_inside: list[EnvironmentUse] = []
        self._ends = SuspiciousEnds()
        #: Whether returned arrays are new, which is known of SB3's own classes without wrappers
        self._returns_new_arrays = type(env) in (DummyVecEnv, SubprocVecEnv)
        self._reset, self._step_async, self._step_wait = env.reset, env.step_async, env.step_wait
        vars(env).update(reset=self.reset, step_async=self.step_async, step_wait=self.step_wait)
        if isinstance(self.base, DummyVecEnv):
            self._uses_inside = [EnvironmentUse.of(one) for one in self.base.envs]
            if "_save_obs" not in vars(self.base):
                self._save_obs = self.base._save_obs
                vars(self.base)["_save_obs"] = self.save_obs
                for index, one in enumerate(self.base.envs):
                    KeepingFinal.of(one).add(self.base, index)
            self._counting = vars(self.base)["_save_obs"].__self__
        if isinstance(self.base, SubprocVecEnv) and not isinstance(self.base.remotes[0], WatchedPipe):
            self.base.remotes = tuple(map(WatchedPipe, self.base.remotes, self.base.processes))
            self._close = self.base.close
            vars(self.base)["close"] = self.close

    @property
    def uses(self) -> int:
        """Number of steps and resets so far, of these vectorised environments or of an environment in them."""
        pipes = self.base.remotes if isinstance(self.base, SubprocVecEnv) else ()
        return self._calls + sum(use.count for use in self._uses_inside) + sum(pipe.uses for pipe in pipes)

    # --- in place of the environments' methods ------------------------------------------------------------------------

    def reset(self) -> Any:
        """
        Reset all environments.

        :return: the environments' observations
        :raises InvalidStepError: if an observation does not fit its space or is not finite
        :raises EnvironmentFailedError: if an environment fails
        """
        self._calls += 1
        observation = self._own(self._call(self._reset))
        check_observation(observation, self._entries)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """
        Begin a step of all environments.

        :param actions: action of each environment, shape (n_envs, ...)
        :raises InvalidStepError: if an action is not finite
        :raises EnvironmentFailedError: if an environment's process has died
        """
        finite = np.isfinite(actions)
        if not finite.all():
            raise InvalidStepError(
                f'The "action" of environment {np.argwhere(~finite)[0][0]} holds NaN or infinite values; no environment was '
                "stepped. Check action_noise, if there is one; if not, the behaviour policy diverged: load an earlier state."
            )
        self._calls += 1
        self._call(self._step_async, actions.copy())  # an environment may write into what it gets

    def step_wait(self) -> Any:
        """
        Finish the step of all environments.

        :return: the environments' observations, rewards, dones and infos
        :raises InvalidStepError: if an observation or a reward does not fit its space or is not finite, or if the infos do not
            fit the dones
        :raises EnvironmentFailedError: if an environment fails
        """
        observation, rewards, dones, infos = self._call(self._step_wait)
        observation = self._own(observation)
        if not self._returns_new_arrays:
            rewards, dones = np.array(rewards), np.array(dones)
        check_observation(observation, self._entries)
        self._check_number(rewards, dones, infos)
        check_rows('The "reward"', rewards, REWARD)
        self._check_ends(observation, dones, infos)
        return observation, rewards, dones, infos

    def save_obs(self, index: int, observation: Any) -> None:
        """
        Check an observation before DummyVecEnv copies it, and so would broadcast a wrong shape or cast a wrong type.

        :param index: index of the environment
        :param observation: observation that the environment returned
        :raises InvalidStepError: if the observation does not fit its space or is not finite
        """
        entries = entries_of(observation)
        for key, entry in self._base_entries.items():
            value = entries.get(key)
            if not (isinstance(value, np.ndarray) and value.shape == entry.shape and value.dtype == entry.dtype):
                check_entries(entries, {key: entry}, index)
        self._save_obs(index, observation)
        self._done = index + 1

    def close(self) -> None:
        """Close the environments; if a process has died or was interrupted within a message, end all processes instead."""
        try:
            self._close()
        except (EOFError, OSError):
            end_processes(self.base)  # type: ignore[arg-type]

    # --- checks -------------------------------------------------------------------------------------------------------

    def _check_number(self, rewards: Any, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """Check that there is one reward, done and info for each environment, because numpy would broadcast others."""
        n_envs = self.env.num_envs
        shapes = {"rewards": np.shape(rewards)[:1], "dones": np.shape(dones), "infos": (len(infos),)}
        for name, shape in shapes.items():
            if shape != (n_envs,):
                raise InvalidStepError(
                    f"{n_envs} environments returned {name} of shape {shape}; nothing was stored. Return one each. {GO_ON}."
                )

    def _check_ends(self, observation: Any, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """Check that the info of an ended episode holds its last observation; remove what earlier ends left in other infos."""
        for index, (done, info) in enumerate(zip(dones.tolist(), infos, strict=True)):
            if done:
                if FINAL not in info:
                    raise InvalidStepError(
                        f'The episode of environment {index} ended, but its info has no "{FINAL}"; the step was not stored, '
                        "for the observation returned with it is the next episode's first. SB3's VecEnv has an episode's last "
                        f'observation in infos[i]["{FINAL}"]: put it there before the environment is reset; {GO_ON}.'
                    )
                check_entries(info[FINAL], self._entries, index, "The last observation's entry")
                info[RAW_FINAL] = info[FINAL]
            elif (FINAL in info or info.get(TRUNCATED)) and not _is_of_another(info, index, dones, infos):
                for key in (FINAL, TRUNCATED, RAW_FINAL):  # of an earlier end, in a dict that is used again
                    info.pop(key, None)
        if dones.any():
            _check_own_infos(dones, infos)
        self._ends.look_at(observation, dones, infos)

    def _own(self, observation: Any) -> Any:
        """The observation in arrays that no later step changes."""
        if self._returns_new_arrays:
            return observation
        return deepcopy(observation)

    # --- failures -----------------------------------------------------------------------------------------------------

    def _call(self, method: Callable[..., Any], *args: Any) -> Any:
        if self._failure is not None:
            raise EnvironmentFailedError(self._failure)
        self._counting._done = 0
        try:
            return method(*args)
        except FAULTS:
            raise
        except Exception as error:
            fault = self._explained(error)
            if fault is None:
                raise
            raise fault from error

    def _explained(self, error: Exception) -> Exception | None:
        """The error to raise in place of one that came out of an environment; ``None`` if the error came from elsewhere."""
        if isinstance(self.base, SubprocVecEnv) and isinstance(error, (EOFError, OSError)):
            self._failure = end_processes(self.base)
            return EnvironmentFailedError(self._failure)
        codes = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
        if (
            isinstance(self.base, DummyVecEnv)
            and self._counting._done < self.base.num_envs
            and set(codes) & set(ONE_AFTER_THE_OTHER)
        ):
            said = described(error)
            if codes[-1] in REWARD_IS_TAKEN and any(words in str(error) for words in NO_NUMBER):
                said += " Its reward must be a single number, such as float(reward[0])."
            return EnvironmentFailedError(
                f"Environment {self._counting._done} raised {said} {KEPT} Fix the environment (or call set_env) and "
                "continue with learn(..., reset_num_timesteps=False)."
            )
        return self._fault_in_answers() if isinstance(self.base, SubprocVecEnv) else None

    def _fault_in_answers(self) -> InvalidStepError | None:
        """The fault of an observation that a process has sent and that SubprocVecEnv therefore can't put together."""
        for index, pipe in enumerate(self.base.remotes):  # type: ignore[attr-defined]
            if isinstance(pipe.answer, tuple):
                try:
                    check_entries(pipe.answer[0], self._base_entries, index)
                except InvalidStepError as fault:
                    return fault
        return None


def _is_of_another(info: dict[str, Any], index: int, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> bool:
    """Whether an info is the same dict as that of another environment whose episode has ended."""
    return any(infos[other] is info for other in np.flatnonzero(dones).tolist() if other != index)


def _check_own_infos(dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
    """
    :param dones: booleans, true where an episode has ended, shape (n_envs,)
    :param infos: info dict of each environment
    :raises InvalidStepError: if two environments whose episodes have ended share one info dict
    """
    ended = np.flatnonzero(dones).tolist()
    for position, index in enumerate(ended):
        for other in ended[:position]:
            if infos[other] is infos[index]:
                raise InvalidStepError(
                    f"The episodes of environments {other} and {index} ended, but they share one info dict, which can hold "
                    f'the "{FINAL}" of one of them only; the step was not stored. Return a dict for each environment; {GO_ON}.'
                )
