"""Costs beside the gradient step: replay buffers, wrappers, actions at deployment, and checkpoints."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer

import sb3_gac
from benchmarks.contenders import alternate, median_ratio, timer
from benchmarks.models import SpacesOnly, make_model
from benchmarks.profiles import env_step


def compare_buffers(sizes: tuple[int, int, int], batch: int = 256, capacity: int = 20_000) -> dict[str, float]:
    """
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: transitions in a sample
    :param capacity: capacity of both replay buffers, in transitions
    :return: bytes and sampling time of the compact replay buffer as multiples of those of SB3's, and its sampling time in
        microseconds
    """
    env = SpacesOnly(*sizes)
    assert isinstance(env.observation_space, spaces.Dict)
    arguments = (capacity, env.observation_space, env.action_space)
    compact, twice = sb3_gac.CompactDictReplayBuffer(*arguments, device="cpu"), DictReplayBuffer(*arguments, device="cpu")
    obs = {key: value[None] for key, value in env.observation_space.sample().items()}
    for step in range(5_000):
        following = {key: value[None] for key, value in env.observation_space.sample().items()}
        for buffer in (compact, twice):
            done = np.array([step % 1_000 == 999])
            buffer.add(obs, following, env.action_space.sample()[None], np.zeros(1), done, [{}])
        obs = following
    arrays = [*twice.observations.values(), *twice.next_observations.values()]
    arrays += [twice.actions, twice.rewards, twice.dones, twice.timeouts]
    timers = {"compact": timer(lambda: compact.sample(batch)), "twice": timer(lambda: twice.sample(batch))}
    seconds = alternate(timers, repetitions=100, rounds=9)
    return {
        "bytes_over_sb3": round(compact.nbytes() / sum(array.nbytes for array in arrays), 3),
        "sampling_time_over_sb3": round(median_ratio(seconds["compact"], seconds["twice"]), 3),
        "sampling_microseconds": round(1e6 * float(np.median(seconds["compact"])), 1),
    }


def compare_wrappers(rounds: int) -> dict[str, float]:
    """
    :param rounds: number of blocks of each environment
    :return: microseconds of a step of gymnasium's HalfCheetah and of ours with sensor noise, and the time that ours adds as a
        share of gymnasium's
    """
    envs = {"gymnasium": gym.make("HalfCheetah-v5"), "ours": gym.make("sb3_gac/HalfCheetah-v5", noise_std=0.1)}
    seconds = alternate({name: timer(env_step(env)) for name, env in envs.items()}, repetitions=1_000, rounds=rounds)
    return {
        **{f"{name}_microseconds": round(1e6 * float(np.median(values)), 1) for name, values in seconds.items()},
        "added_share": round(median_ratio(seconds["ours"], seconds["gymnasium"]) - 1, 3),
    }


def compare_deployment(sizes: tuple[int, int, int], width: int, rounds: int) -> dict[str, float]:
    """
    Measure how long a policy takes for one action, with one thread, in processor time.

    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param width: units of each of the two hidden layers
    :param rounds: number of blocks of each contender
    :return: microseconds of one action from one observation by ``predict`` of SB3's SAC, by that of GAC, and by the
        exported learner; the ratio of the first to the last; and milliseconds to load the exported file
    """
    th.set_num_threads(1)
    gac, sac = (make_model(name, sizes, 256, width) for name in ("gac", "sac"))
    observation = {key: box.sample() for key, box in SpacesOnly(*sizes).observation_space.items()}  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory() as directory:
        path = sb3_gac.export_learner(gac, Path(directory) / "learner.onnx")
        learner = sb3_gac.OnnxPolicy.load(path)
        load = timer(lambda: sb3_gac.OnnxPolicy.load(path), time.process_time)
        loads = alternate({"load": load}, repetitions=10, rounds=rounds)["load"]
    partial = observation["partial"]
    timers = {
        "sac_predict": timer(lambda: sac.predict(observation, deterministic=True), time.process_time),
        "gac_predict": timer(lambda: gac.predict({"partial": partial}, deterministic=True), time.process_time),
        "exported": timer(lambda: learner.act(partial), time.process_time),
    }
    seconds = alternate(timers, repetitions=200, rounds=rounds)
    return {
        **{f"{name}_microseconds": round(1e6 * float(np.median(values)), 1) for name, values in seconds.items()},
        "exported_times_faster_than_sac": round(median_ratio(seconds["sac_predict"], seconds["exported"]), 1),
        "load_milliseconds": round(1e3 * float(np.median(loads)), 2),
    }


def compare_checkpoints(sizes: tuple[int, int, int], width: int, capacity: int, more: int) -> dict[str, float]:
    """
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param width: units of each of the two hidden layers
    :param capacity: capacity of the replay buffer in transitions; it is full at the first checkpoint
    :param more: number of transitions between the first checkpoint and the next one
    :return: seconds and megabytes of a first checkpoint, of the next one, and of SB3's ``save`` and ``save_replay_buffer``
    """
    gac, sac = (make_model(name, sizes, 256, width, buffer_size=capacity) for name in ("gac", "sac"))
    for model in (gac, sac):
        _fill(model.replay_buffer, capacity)
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        figures = {"first": _writing(lambda: gac.save_checkpoint(root / "ours"), root)}
        _fill(gac.replay_buffer, more)
        figures["next"] = _writing(lambda: gac.save_checkpoint(root / "ours"), root)
        sb3 = _writing(lambda: (sac.save(root / "model"), sac.save_replay_buffer(root / "buffer")), root)
    return {
        f"{name}_{unit}": round(value, 2)
        for name, (seconds, megabytes) in {**figures, "sb3": sb3}.items()
        for unit, value in (("seconds", seconds), ("megabytes", megabytes))
    }


def _fill(buffer: Any, steps: int) -> None:
    """Add transitions of one environment to a replay buffer, in episodes of 1,000 steps."""
    obs = {key: box.sample()[None] for key, box in buffer.observation_space.items()}
    action = buffer.action_space.sample()[None]
    for step in range(steps):
        following = {key: value + 1e-3 for key, value in obs.items()}
        buffer.add(obs, following, action, np.zeros(1), np.array([step % 1_000 == 999]), [{}])
        obs = following


def _writing(write: Callable[[], Any], directory: Path) -> tuple[float, float]:
    """
    :param write: function that writes files
    :param directory: directory in which it writes them
    :return: seconds of ``write``, and megabytes of the files that it wrote
    """
    before = {path: path.stat().st_ino for path in directory.rglob("*")}
    start = time.perf_counter()
    write()
    seconds = time.perf_counter() - start
    written = [path for path in directory.rglob("*") if path.is_file() and before.get(path) != path.stat().st_ino]
    return seconds, sum(path.stat().st_size for path in written) / 1e6
