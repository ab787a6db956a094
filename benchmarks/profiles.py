"""Profiles: how the time of a gradient step, and of training as a whole, divides among its parts."""

import cProfile
import itertools
import pstats
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

import sb3_gac
from benchmarks.contenders import timer
from benchmarks.models import make_model, matmul_rate, step_flops

COMPILED = ("optim/compile.py", "__call__")  # losses, gradients, clipping, optimisers, dual variables and targets
SAMPLING = ("replay/buffer.py", "sample")  # no compiled code calls it


def profile_step(contender: str, sizes: tuple[int, int, int], batch: int, width: int, steps: int) -> list[dict[str, Any]]:
    """
    Profile gradient steps of a contender, on one thread.

    :param contender: key of ``CONTENDERS``
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param steps: number of gradient steps
    :return: one row for each part of a gradient step: "contender", "part", "milliseconds" and "share"; the shares add up to 1.
        Compiled code is two parts: the time of its matrix products at the rate of a plain product, and the rest of its time
    """
    th.set_num_threads(1)
    model = make_model(contender, sizes, batch, width)
    model.train(steps, batch)
    profiler = cProfile.Profile()
    profiler.enable()
    model.train(steps, batch)
    profiler.disable()
    stats = pstats.Stats(profiler)
    total = stats.total_tt  # type: ignore[attr-defined]
    products = steps * step_flops(sizes, batch, width) / matmul_rate(batch, width)
    rows = {
        "matrix products, at a plain one's rate": products,
        "the rest inside compiled code": cumulative_seconds(stats, *COMPILED) - products,
        "sampling": cumulative_seconds(stats, *SAMPLING),
    }
    rows["all else"] = total - sum(rows.values())
    return [
        {
            "contender": contender,
            "part": part,
            "milliseconds": round(1e3 * seconds / steps, 2),
            "share": round(seconds / total, 3),
        }
        for part, seconds in rows.items()
    ]


def cumulative_seconds(stats: pstats.Stats, file: str, function: str) -> float:
    """
    :param stats: statistics of a profile
    :param file: end of a file's path
    :param function: name of a function in that file
    :return: seconds spent in the function and in all functions that it calls
    """
    return sum(
        cumulative
        for (name, _, called), (_, _, _, cumulative, _) in stats.stats.items()  # type: ignore[attr-defined]
        if called == function and name.endswith(file)
    )


def env_step(env: gym.Env, n_actions: int = 100) -> Callable[[], None]:
    """
    Make a step of an environment to time. Environments with the same action space get the same actions, and so the same
    physics to compute.

    :param env: environment to step; it is reset where an episode ends
    :param n_actions: number of random actions, which are taken over and over
    :return: function that steps the environment once
    """
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(n_actions)])
    env.reset(seed=0)

    def step() -> None:
        if any(env.step(next(actions))[2:4]):
            env.reset()

    return step


def profile_rollout(n_envs: int, vec_steps: int) -> dict[str, float]:
    """
    Measure how the time of ``learn`` divides on HalfCheetah, with one gradient step per environment step.

    :param n_envs: number of environments side by side
    :param vec_steps: number of steps of the vectorised environment
    :return: environment steps per second, and the shares of the gradient steps, of the physics (with our wrappers, but without
        SB3's vectorised environment), and of everything else
    """
    vec_env = make_vec_env("sb3_gac/HalfCheetah-v5", n_envs, seed=0, env_kwargs={"noise_std": 0.1})
    small = {**sb3_gac.preset("small"), "learning_starts": 0, "buffer_size": 50_000, "device": "cpu"}
    model = sb3_gac.GAC("MultiInputPolicy", vec_env, **small)
    model.learn(4 * n_envs)
    spent = {"gradient": 0.0}
    train = model.train

    def timed_train(*args: Any, **kwargs: Any) -> None:
        start = time.perf_counter()
        train(*args, **kwargs)
        spent["gradient"] += time.perf_counter() - start

    model.train = timed_train  # type: ignore[method-assign]
    start = time.perf_counter()
    model.learn(vec_steps * n_envs)
    total = time.perf_counter() - start
    physics = n_envs * vec_steps * float(np.median([timer(env_step(vec_env.envs[0]))(300) for _ in range(5)]))  # type: ignore
    shares = {"gradient_share": spent["gradient"] / total, "physics_share": physics / total}
    rounded = {name: round(share, 3) for name, share in shares.items()}
    return {
        "steps_per_second": round(vec_steps * n_envs / total, 1),
        **rounded,
        "other_share": round(1 - sum(shares.values()), 3),
    }
