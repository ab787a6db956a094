"""The environment of a run: a registered task with its sensor noise, or any environment with arguments and wrappers."""

from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from benchmarks.suite import RunSpec
from sb3_gac.envs import make_vec
from sb3_gac.envs.suites import SUITES, env_id_of, suite_of, task_of
from sb3_gac.training.environments import make_envs as make_any_envs

#: Seed of the first environment of every evaluation
EVAL_SEED = 10_000


def environment(spec: RunSpec) -> tuple[str, dict[str, Any]]:
    """
    :param spec: settings of a run
    :return: id and keyword arguments of the run's environment; a task without sensor noise gets no argument for it
    :raises ValueError: if there is no such task, or if the task takes no sensor noise or no history and the run has one
    """
    if spec.environment is not None:
        return spec.environment["id"], spec.environment["kwargs"]
    env_id = env_id_of(spec.task)
    if spec.task != task_of(env_id):  # directories and tables show this name
        raise ValueError(f"task must be the name {task_of(env_id)!r}, got {spec.task!r}.")
    suite = suite_of(env_id)
    takes_noise = suite is None or SUITES[suite].sensor_noise
    if spec.noise and not takes_noise:
        raise ValueError(f"{spec.task} has no sensor noise: give noises: [0].")
    if spec.history and not (suite is None or SUITES[suite].history):
        raise ValueError(f"{spec.task} takes no history: leave it out, and give networks a memory.")
    history = {} if spec.history is None else {"history": spec.history}
    return env_id, {"noise_std": spec.noise, **history} if takes_noise else {}


def make_envs(spec: RunSpec, n_envs: int, seed: int | None = None) -> VecEnv:
    """
    :param spec: settings of a run
    :param n_envs: number of environments side by side
    :param seed: seed of the first environment, ``None`` for no seed
    :return: vectorised environment of the run
    :raises ValueError: if a wrapper can't be imported
    """
    env_id, kwargs = environment(spec)
    if spec.environment is None:
        return make_vec(env_id, n_envs, seed, **kwargs)
    return make_any_envs(env_id, kwargs, spec.environment["wrappers"], n_envs, seed)
