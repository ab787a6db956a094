"""Environments in other processes: pipes whose answers belong to their requests, and the end of processes that died."""

from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from stable_baselines3.common.vec_env import SubprocVecEnv

KEPT = "The step was discarded; the model is intact."
PATIENCE = 2.0  # seconds to wait for an answer before asking whether the process is alive, or for the end of a process


class WatchedPipe:
    """
    A pipe to a process, each of whose answers belongs to the request before it.

    An interrupt between request and answer leaves an answer that nobody has fetched. The pipe throws it away before the next
    request, or all later answers would be those to earlier requests. An interrupt within a message leaves a pipe that can't
    be used any more. A process that was forked earlier holds the far end open as well, so that a death does not show in the
    pipe. Whoever waits for an answer therefore asks from time to time whether the process is alive.

    :param pipe: connection to the process
    :param process: process at the far end
    """

    def __init__(self, pipe: Connection, process: BaseProcess):
        self._pipe, self._process = pipe, process
        self._awaits_answer = False
        #: Whether a message is under way, or was under way when an interrupt came
        self.torn = False
        #: Answer to the last request; an answer to a step or a reset begins with the observation
        self.answer: Any = None
        #: Number of steps and resets that were requested, by any of SubprocVecEnv's methods
        self.uses = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pipe, name)

    def send(self, request: Any) -> None:
        """
        Send a request.

        :param request: request to the process, which answers each except the last, "close"
        :raises EOFError: if the process has died, or an exchange with it was interrupted within a message
        """
        if self._awaits_answer:
            self.recv()
        self.answer = None
        self.uses += _is_use(request)
        self._exchange(self._pipe.send, request)
        self._awaits_answer = True

    def recv(self) -> Any:
        """
        Wait for the answer to the last request.

        :return: answer of the process; ``None`` if no answer is due
        :raises EOFError: if the process has died, or an exchange with it was interrupted within a message
        """
        if not self._awaits_answer:
            return None
        while not self._pipe.poll(PATIENCE):
            if not self._process.is_alive() and not self._pipe.poll():
                raise EOFError
        self.answer = self._exchange(self._pipe.recv)
        self._awaits_answer = False
        return self.answer

    def _exchange(self, method: Callable[..., Any], *args: Any) -> Any:
        if self.torn:
            raise EOFError
        self.torn = True
        try:
            result = method(*args)
        except Exception:  # the process has died, or the whole message was read and can't be decoded
            self.torn = False
            raise
        self.torn = False
        return result


def _is_use(request: Any) -> bool:
    """Whether a request of SubprocVecEnv is for a step or a reset, directly or by ``env_method``."""
    command, data = request
    return (data[0] if command == "env_method" else command) in ("step", "reset")


def end_processes(env: SubprocVecEnv) -> str:
    """
    End all processes of environments of which one is lost; they could neither be stepped nor closed otherwise.

    :param env: environments of which a process has died, or an exchange with it was interrupted within a message
    :return: text that names the lost process and the remedy
    """
    torn = [index for index, remote in enumerate(env.remotes) if getattr(remote, "torn", False)]
    if not torn:
        wait([process.sentinel for process in env.processes], timeout=PATIENCE)
    codes = {index: process.exitcode for index, process in enumerate(env.processes) if process.exitcode is not None}
    for process, remote in zip(env.processes, env.remotes, strict=True):
        process.terminate()
        process.join(PATIENCE)
        process.kill()
        remote.close()
    env.waiting, env.closed = False, True
    others = (
        f"{KEPT} The other processes were ended: give the model new environments with set_env(...) and continue with "
        "learn(..., reset_num_timesteps=False)."
    )
    if torn and not codes:
        return f"The process of environment {torn[0]} was interrupted within a message and makes no sense any more. {others}"
    dead = ", ".join(f"{index} (exit code {code})" for index, code in codes.items()) or "unknown"
    return (
        f"The process of environment {dead} died. An exit code of 1 is an exception, whose traceback stands above. A negative "
        f"one is a signal, such as -9 for lack of memory. After an interrupt, which ends all processes, it is 0. {others}"
    )
