"""The speed of environments from pixels, beside the bare simulator and renderer, and of gradient steps on images."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import CombinedExtractor

import sb3_gac
from benchmarks.contenders import alternate, timer
from benchmarks.profiles import env_step
from sb3_gac.algorithms import algorithm_class
from sb3_gac.base.augmentation import shifted
from sb3_gac.envs import History
from sb3_gac.envs.camera import make_renderer
from sb3_gac.envs.suites.pixels import TASKS

SIZE, FRAMES, CAPACITY = 64, 3, 1_000


class OneFrame(gym.Env):
    """An environment with random images and states of HalfCheetah's sizes, in episodes without an end."""

    observation_space = spaces.Dict(
        partial=spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8), privileged=spaces.Box(-np.inf, np.inf, (17,), np.float32)
    )
    action_space = spaces.Box(-1, 1, (6,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Return a random observation."""
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return a random observation, and a reward of 0."""
        return self.observation_space.sample(), 0.0, False, False, {}


def compare_pixels(task: str, steps: int, rounds: int) -> dict[str, Any]:
    """
    :param task: one of ``TASKS``
    :param steps: environment steps in a block
    :param rounds: number of blocks of each contender
    :return: environment steps per second; their rate as a multiple of the rate of the bare simulator and renderer; and images
        that the renderer alone draws per second
    """
    bare, env = gym.make(f"{task}-v5"), gym.make(f"sb3_gac/{task}Pixels-v5")
    simulator: Any = bare.unwrapped
    renderer, step = make_renderer(simulator.model, SIZE), env_step(bare)

    def draw() -> None:
        renderer.update_scene(simulator.data, camera="track")
        renderer.render()

    def step_and_draw() -> None:
        step()
        draw()

    timers = {"ours": timer(env_step(env)), "bare": timer(step_and_draw), "draw": timer(draw)}
    seconds = alternate(timers, repetitions=steps, rounds=rounds)
    return {
        "task": task,
        "steps_per_second": round(1 / float(np.median(seconds["ours"])), 1),
        "over_bare": round(float(np.median(np.array(seconds["bare"]) / np.array(seconds["ours"]))), 3),
        "images_per_second": round(1 / float(np.median(seconds["draw"])), 1),
    }


def compare_image_steps(name: str, steps: int, rounds: int) -> dict[str, Any]:
    """
    :param name: name of an algorithm
    :param steps: gradient steps in a block
    :param rounds: number of blocks of each contender
    :return: gradient steps per second with the preset ``pixels`` on one thread; the shares of their time that sampling and
        random shifts take; and, as multiples of SB3's, the time of the encoder with its gradient, the bytes of the
        replay buffer and its sampling time
    """
    th.set_num_threads(1)
    options = sb3_gac.preset("pixels", algorithm=name) | {"buffer_size": CAPACITY, "learning_starts": 10**9}
    model: Any = algorithm_class(name)("MultiInputPolicy", History(OneFrame(), FRAMES), device="cpu", seed=0, **options)
    model.set_logger(Logger(None, []))
    model.learn(CAPACITY)
    batch, samples = model.batch_size, model.replay_buffer.sample(model.batch_size)
    twice = DictReplayBuffer(CAPACITY, model.observation_space, model.action_space, device="cpu")
    twice.full = True
    for images in (twice.observations["partial"], twice.next_observations["partial"]):
        images[:] = 1  # reading memory that was never written to takes no time
    arrays = [*twice.observations.values(), *twice.next_observations.values()]
    arrays += [twice.actions, twice.rewards, twice.dones, twice.timeouts]
    actor = model.policy.deployed
    seen = {"partial": samples.observations["partial"]}
    in_sb3 = CombinedExtractor(actor.observation_space, actor.features_extractor.features_dim)
    timers = {
        "step": timer(lambda: model.train(1, batch)),
        "sample": timer(lambda: model.replay_buffer.sample(batch)),
        "sb3": timer(lambda: twice.sample(batch)),
        "shift": timer(lambda: shifted(samples, ["partial"], model.random_shift)),
        "encoder": timer(lambda: actor.extract_features(seen, actor.features_extractor).sum().backward()),
        "sb3s encoder": timer(lambda: in_sb3(preprocess_obs(seen, actor.observation_space)).sum().backward()),
    }
    median = {each: float(np.median(values)) for each, values in alternate(timers, repetitions=steps, rounds=rounds).items()}
    return {
        "algorithm": name,
        "batch": batch,
        "gradient_steps_per_second": round(1 / median["step"], 2),
        "sampling_share": round(median["sample"] / median["step"], 3),
        "shift_share": round(median["shift"] / median["step"], 3),
        "encoder_time_over_sb3": round(median["encoder"] / median["sb3s encoder"], 3),
        "bytes_over_sb3": round(model.replay_buffer.nbytes() / sum(array.nbytes for array in arrays), 3),
        "sampling_time_over_sb3": round(median["sample"] / median["sb3"], 2),
    }


def tabulate_pixels(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate the speed of environments from pixels.

    :param threads: numbers of torch's threads, which are not used
    :param quick: whether to measure one task, in few rounds
    :return: one row for each task
    """
    return [compare_pixels(task, 20 if quick else 200, 2 if quick else 9) for task in (TASKS[1:2] if quick else TASKS)]


def tabulate_image_steps(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps on images.

    :param threads: numbers of torch's threads, which are not used: there is one thread
    :param quick: whether to measure few rounds
    :return: one row for each algorithm
    """
    return [compare_image_steps(name, 1 if quick else 3, 2 if quick else 9) for name in ("asymmetric_sac", "gac")]
