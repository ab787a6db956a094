"""Vectorised environments by id: a suite's own where its simulator steps a batch, SB3's for all others."""

from typing import Any

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.suites import is_batched, make_batch
from sb3_gac.envs.vector.settings import reach_layers


def make_vec(env_id: str, n_envs: int = 1, seed: int | None = None, **kwargs: Any) -> VecEnv:
    """
    Make vectorised environments by id.

    :param env_id: id of a registered environment; where its simulator steps a batch, one simulator has all ``n_envs``
        environments
    :param n_envs: number of environments side by side
    :param seed: seed of the first environment, while the others have the next ones; ``None`` for a random seed
    :param kwargs: keyword arguments of the environment, such as ``noise_std``
    :return: vectorised environments whose infos have returns and lengths of episodes, and whose ``set_attr`` reaches the
        layers that have the attribute
    :raises ImportError: if the simulator is not installed; the message says how to install it
    :raises ValueError: if ``n_envs`` is no positive integer, or if a simulator that steps a batch is asked for a history, a
        delay or losses
    """
    n_envs = check_count("n_envs", n_envs)
    if not is_batched(env_id):
        made = make_vec_env(env_id, n_envs, seed=seed, env_kwargs=kwargs)
        reach_layers(made)
        return made
    env: VecEnv = make_batch(env_id, n_envs, **kwargs)
    env.action_space.seed(seed)
    env.seed(seed)
    return env
