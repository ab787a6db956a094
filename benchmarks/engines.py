"""Engines start the processes of runs: on this machine, or on a Ray cluster that shares the directory of the runs."""

import ctypes
import os
import shlex
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.suite import HERE
from sb3_gac.envs.subprocesses import usable_processors
from sb3_gac.envs.suites.extras import missing_extra

#: Beginning of the line that stands before an attempt's output in a log
ATTEMPT = "--- attempt: "
NODE_LOSSES = 10
_PR_SET_PDEATHSIG = 1
_prctl: Any = ctypes.CDLL(None).prctl if sys.platform == "linux" else None  # on other systems runs outlive a killed launch


def run_process(command: list[str], log: Path, folder: Path | None = None) -> int:
    """
    Run a command in a process with one thread, which finds the benchmarks from every folder. The process ends with the one
    that started it, so that no run goes on training after its launch was killed or its node was lost.

    :param command: words of the command
    :param log: file to which the output is appended
    :param folder: folder in which the process starts, for the relative paths of environments; ``None`` for the present one
    :return: exit status of the process
    """
    with log.open("a", encoding="utf-8") as file:
        file.write(f"{ATTEMPT}{shlex.join(command)}\n")
        file.flush()
        return subprocess.run(
            command,
            stdout=file,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": module_path()},
            cwd=folder,
            preexec_fn=partial(end_with_parent, os.getpid()),
            check=False,
        ).returncode


def module_path() -> str:
    """Python's path for another process, which finds the benchmarks there, and all that this process's path has."""
    return os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])


def end_with_parent(parent: int) -> None:
    """
    Make the system kill this process when the thread that started it ends. It is called in the new process, and does nothing
    on systems other than Linux.

    :param parent: id of the process that started the new one, which may have ended before this call
    """
    if _prctl:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


class LocalEngine:
    """Runs processes on this machine."""

    cpus = usable_processors()

    def run(self, command: list[str], log: Path) -> int:
        """See :func:`run_process`."""
        return run_process(command, log)


class RayEngine:
    """
    Runs processes on a Ray cluster. If a node is lost, its run starts again on another node, from its last checkpoint.

    :param address: address of the cluster, "auto" for the one that this machine belongs to
    :raises ImportError: if Ray is not installed
    """

    def __init__(self, address: str):
        try:
            import ray
        except ImportError as error:
            raise missing_extra("--engine ray", error.name or "ray", "ray") from None
        environment = {"env_vars": {"PYTHONPATH": module_path()}}
        ray.init(address, log_to_driver=False, runtime_env=environment, ignore_reinit_error=True)
        self._ray = ray
        self._run: Any = ray.remote(num_cpus=1, max_retries=NODE_LOSSES)(run_process)
        self.cpus = int(ray.cluster_resources().get("CPU", 1))

    def run(self, command: list[str], log: Path) -> int:
        """See :func:`run_process`; waits until a node is free, and starts there in the folder of the same name."""
        return self._ray.get(self._run.remote(command, log, Path.cwd()))


Engine = LocalEngine | RayEngine
