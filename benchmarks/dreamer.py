"""
DreamerV3 on the learner's observations, by the package sheeprl, as a program of :mod:`benchmarks.external`::

    python -m benchmarks.dreamer benchmarks/runs/<run>/request.json

The request's ``arguments`` may have ``size``, the size of the model ("1M" to "400M"), and ``configuration``, sheeprl's
settings by their dotted names. The algorithm is that of the paper in Nature (2025), ``dreamer_v3_5`` in sheeprl. A run that
goes on from a checkpoint has the checkpoint's networks, optimiser and replay buffer, and starts new episodes. Evaluations
take the most likely action in each state. The state itself is sampled by sheeprl in evaluations too, from the evaluation's
seed, which leaves the random numbers of training untouched.
"""

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from benchmarks.program import Request
from sb3_gac.envs.suites.extras import missing_extra

try:
    from omegaconf import OmegaConf
    from sheeprl.algos.dreamer_v3_5.agent import build_agent
    from sheeprl.cli import run as run_sheeprl
    from sheeprl.envs.wrappers import NormalizeAction
    from sheeprl.utils import fs
    from sheeprl.utils.utils import dotdict
except ImportError as error:
    raise missing_extra("benchmarks.dreamer", error.name or "sheeprl", "dreamer") from None

SIZES = ("1M", "12M", "25M", "50M", "100M", "200M", "400M")
KEY = "partial"
LARGEST_BUFFER = 5_000_000  # the capacity in sheeprl and in the paper


class LearnersView(gym.ObservationWrapper):
    """
    Reduces observations to the entry ``partial``, which the learner sees.

    :param env: environment whose observations have an entry ``partial``
    :raises ValueError: if that entry is no vector of numbers
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        space = env.observation_space[KEY]  # type: ignore[index]
        if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
            raise ValueError(f"DreamerV3 is set up for vectors here: {KEY} must be a Box with one axis, got {space}.")
        self.observation_space = spaces.Dict({KEY: space})

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """
        :param observation: observation of the environment
        :return: observation with no other entry than ``partial``
        """
        return {KEY: observation[KEY]}


def make_env(request: str) -> gym.Env:
    """
    Make an environment to train on; called by sheeprl.

    :param request: path of the request
    :return: environment whose observations are the learner's
    """
    return LearnersView(Request(request).make_env())


class Player:
    """
    The policy, with the interface of SB3's ``evaluate_policy``.

    :param player: sheeprl's player, which keeps a state for each environment
    :param env: one of the environments to train on
    """

    def __init__(self, player: Any, env: gym.Env):
        self._player = player
        self._is_continuous = isinstance(env.action_space, spaces.Box)
        self._rescaled = NormalizeAction(env).action if self._is_continuous else None

    @th.no_grad()
    def predict(
        self,
        observation: Mapping[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        :param observation: observations of n environments, each entry of shape (n, ...)
        :param state: ``None`` at the start of an evaluation, then the state that the last call returned
        :param episode_start: whether an episode has just begun, shape (n,)
        :param deterministic: whether to take the most likely action
        :return: actions in the environment's own range, shape (n, ...), and a state, which is empty
        """
        partial = th.as_tensor(observation[KEY], dtype=th.float32, device=self._player.device)
        if state is None:
            self._player.num_envs = len(partial)
            self._player.init_states()
        elif episode_start is not None and episode_start.any():
            self._player.init_states(np.flatnonzero(episode_start).tolist())
        actions = self._player.get_actions({KEY: partial[None]}, greedy=deterministic)
        if self._rescaled is None:
            choices = th.stack([one_hot.argmax(-1) for one_hot in actions], -1)[0]
            return choices.squeeze(-1).cpu().numpy(), ()
        return self._rescaled(th.cat(actions, -1)[0].cpu().numpy()), ()


class Evaluation:
    """
    A callback that sheeprl calls before it writes a checkpoint, so that every checkpoint has its evaluation.

    :param request: path of the request
    """

    def __init__(self, request: str):
        self._request = Request(request)
        self._env = make_env(request)

    def on_checkpoint_coupled(self, fabric: Any, ckpt_path: str, state: Mapping[str, Any], replay_buffer: Any = None) -> None:
        """
        Evaluate the policy, and write the networks to ``model.pt``.

        :param fabric: sheeprl's ``Fabric`` of the run
        :param ckpt_path: path of the checkpoint that sheeprl writes next
        :param state: state of the networks, and under "last_checkpoint" the environment steps so far
        :param replay_buffer: replay buffer of the run, which is not used
        """
        timesteps = int(state["last_checkpoint"])
        self._request.go_on_from(timesteps - 1)
        with th.random.fork_rng():
            th.manual_seed(self._request.eval_seed)
            mean_return = self._request.evaluate(timesteps, self._player(fabric, ckpt_path, state))
        th.save({name: state[name] for name in ("world_model", "actor")}, self._request.path.with_name("model.pt"))
        print(f"{timesteps} steps: {mean_return:.1f}", flush=True)

    def _player(self, fabric: Any, ckpt_path: str, state: Mapping[str, Any]) -> Player:
        """The policy, with networks of its own, made as sheeprl makes them to evaluate a checkpoint."""
        configuration = dotdict(OmegaConf.to_container(fs.load_yaml(fs.run_config(ckpt_path)), resolve=True))
        actions = self._env.action_space
        sizes = actions.shape if isinstance(actions, spaces.Box) else [actions.n]  # type: ignore[attr-defined]
        spaces_of = tuple(sizes), isinstance(actions, spaces.Box), configuration, self._env.observation_space
        *networks, _, player = build_agent(fabric, *spaces_of, state["world_model"], state["actor"])
        parameters = sum(parameter.numel() for network in networks for parameter in network.parameters())
        print(f"{parameters:,} parameters of world model, actor and critic", flush=True)
        return Player(player, self._env)


def command_line(request: Request) -> list[str]:
    """
    :param request: request for the run
    :return: command-line arguments of sheeprl
    :raises ValueError: if an argument is unknown, or sets a value that follows from the run's settings
    """
    if unknown := sorted(set(request.arguments) - {"size", "configuration"}):
        raise ValueError(f"arguments: unknown {unknown}; they are size and configuration.")
    size, own = request.arguments.get("size", "12M"), request.arguments.get("configuration", {})
    if size not in SIZES:
        raise ValueError(f"arguments, size: must be one of {SIZES}, got {size!r}.")
    settings = settings_of(request)
    if taken := sorted(set(own) & set(settings)):
        raise ValueError(f"arguments, configuration: {taken} follow from the run's settings.")
    named = {"exp": "dreamer_v3_5", "algo": "dreamer_v3_5" if size == "200M" else f"dreamer_v3_5_{size}", "env": "default"}
    words = [f"{name}={value}" for name, value in named.items()]
    return words + [f"{name}={in_hydra(value)}" for name, value in {**own, **settings}.items()]


def in_hydra(value: Any) -> str:
    """
    :param value: number, text, ``None``, or a list or mapping of these
    :return: value in the grammar of Hydra's command line
    """
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{in_hydra(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(in_hydra, value)) + "]"
    return json.dumps(value)


def settings_of(request: Request) -> dict[str, Any]:
    """
    :param request: request for the run
    :return: sheeprl's settings that follow from the request, by their dotted names
    """
    spec, path, logs = request.spec, str(request.path), request.checkpoint / "sheeprl"
    callbacks = [
        {"_target_": "benchmarks.dreamer.Evaluation", "request": path},
        {"_target_": "sheeprl.utils.callback.CheckpointCallback", "keep_last": 2},
    ]
    checkpoints = sorted(logs.rglob("*.ckpt"), key=lambda checkpoint: checkpoint.stat().st_mtime)
    return {
        "env.id": spec.cell,
        "env.num_envs": spec.envs,
        "env.sync_env": True,
        "env.capture_video": False,
        "env.wrapper": {"_target_": "benchmarks.dreamer.make_env", "request": path},
        "fabric.callbacks": callbacks,
        "algo.mlp_keys.encoder": [KEY],
        "algo.cnn_keys.encoder": [],
        "algo.total_steps": max(spec.steps, request.evaluations[-1]),
        "algo.run_test": False,
        "buffer.size": min(LARGEST_BUFFER, 2 * max(spec.steps, 1_000)),  # the last observation of an episode takes a place too
        "checkpoint.every": request.evaluations[0],
        "checkpoint.save_last": False,
        "checkpoint.resume_from": str(checkpoints[-1]) if checkpoints else None,
        "seed": spec.seed,
        "log_root": str(logs),
        "root_dir": ".",
        "run_name": "run",
        "hydra.run.dir": str(logs / "hydra"),
    }


def main() -> None:
    """Entry point of the command line, whose only argument is the path of a request."""
    request = Request(sys.argv[1])
    sys.argv = ["sheeprl", *command_line(request)]
    print(" ".join(sys.argv), flush=True)
    run_sheeprl()
    keep_logs(request.checkpoint, request.path.parent / "tensorboard")


def keep_logs(checkpoint: Path, directory: Path) -> None:
    """
    Copy TensorBoard logs out of a directory that is removed when the run is finished.

    :param checkpoint: directory that has the logs
    :param directory: directory to which the logs are copied
    """
    directory.mkdir(exist_ok=True)
    for log in sorted(checkpoint.rglob("events.out.tfevents.*")):
        shutil.copy(log, directory)


if __name__ == "__main__":
    main()
