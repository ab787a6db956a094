"""
Train GAC on a noisy MuJoCo task, then evaluate the learner on its partial observation alone::

    python -m sb3_gac.train --task HalfCheetah --noise 0.1 --steps 50000 --seed 0

Everything is saved under ``runs/``: the model, the learning curve as a picture, the evaluations and the resolved
configuration.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch as th
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac import GAC, PRESETS, GuiderLearnerEvalCallback, __version__, preset
from sb3_gac.envs import PARTIAL
from sb3_gac.envs.mujoco import TASKS

EVAL_SEED = 10_000


class PartialOnly:
    """
    A model that is handed the partial entry and nothing else, as on the robot.

    :param model: with ``predict``
    """

    def __init__(self, model: GAC):
        self._model = model

    def predict(self, observation: dict[str, np.ndarray], *args: Any, **kwargs: Any) -> Any:
        """Arguments and result of the model's ``predict``."""
        return self._model.predict({PARTIAL: observation[PARTIAL]}, *args, **kwargs)


class UniformActions:
    """
    Random actions, the yardstick for a short run.

    :param env: whose actions to sample
    :param seed: of the actions
    """

    def __init__(self, env: VecEnv, seed: int = 0):
        self._space, self._n_envs = env.action_space, env.num_envs
        self._space.seed(seed)

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> Any:
        """Arguments and result of a model's ``predict``."""
        return np.stack([self._space.sample() for _ in range(self._n_envs)]), state


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """
    :param arguments: command line, by default the process's
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah", choices=sorted(TASKS))
    parser.add_argument("--noise", type=float, default=0.1, help="standard deviation of the sensor noise")
    parser.add_argument("--privileged", default="state", choices=["state", "velocity"])
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--envs", type=int, help="environments side by side, by default as many as the preset is for")
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS), help="arguments of GAC")
    parser.add_argument(
        "--compile", action="store_true", help="faster gradient steps after half a minute; needs a C++ compiler"
    )
    parser.add_argument("--episodes", type=int, default=10, help="of each evaluation")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where results go")
    options = parser.parse_args(arguments)
    options.envs = options.envs or PRESETS[options.preset].envs
    return options


def gac_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """
    :param options: see :func:`parse_arguments`
    :return: the preset's keyword arguments of GAC for this task and noise, and what the command line says on top
    """
    buffer_size = min(1_000_000, max(options.steps, 1_000))
    setting = {"task": options.task, "noise": options.noise}
    arguments = preset(options.preset, **setting, buffer_size=buffer_size, compile=options.compile)
    if options.privileged != "state":
        arguments["role_keys"] = None  # without the whole state in one entry, critics need all entries
    return arguments


def evaluate(policy: Any, env: VecEnv, episodes: int) -> tuple[float, float]:
    """
    :param policy: with ``predict``
    :param env: evaluated from ``EVAL_SEED``
    :param episodes: number of episodes
    :return: mean and standard deviation of the return
    """
    env.seed(EVAL_SEED)
    mean, std = evaluate_policy(policy, env, n_eval_episodes=episodes)
    return float(mean), float(std)  # type: ignore[arg-type]


def draw_learning_curve(history: list[dict[str, float]], title: str, path: Path) -> None:
    """
    Returns of both policies, and KL beside its target, over environment steps.

    :param history: of :class:`GuiderLearnerEvalCallback`
    :param title: of the figure
    :param path: of the picture
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (returns, kl) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    steps = [row["timesteps"] for row in history]
    returns.plot(steps, [row["learner"] for row in history], label="learner (partial alone)", marker="o")
    returns.plot(steps, [row["guider"] for row in history], label="guider (privileged)", linestyle="--")
    returns.set(xlabel="environment steps", ylabel="return", title=title)
    returns.legend()
    kl.plot(steps, [row.get("kl", np.nan) for row in history], label="KL(guider ‖ learner)", marker="o")
    kl.plot(steps, [row.get("target_kl", np.nan) for row in history], label="target", color="black", linestyle=":")
    kl.set(xlabel="environment steps", ylabel="KL, mean over action dimensions", ylim=(0, None))
    kl.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def resolved_configuration(options: argparse.Namespace, arguments: dict[str, Any]) -> dict[str, Any]:
    """All that it takes to repeat the run."""
    command_line = {name: str(value) if isinstance(value, Path) else value for name, value in vars(options).items()}
    versions = {"sb3_gac": __version__, "torch": str(th.__version__)}
    shown = {**arguments, "policy_kwargs": {key: str(value) for key, value in arguments["policy_kwargs"].items()}}
    return {**command_line, "eval_seed": EVAL_SEED, "gac": shown, "versions": versions}


def train(options: argparse.Namespace) -> Path:
    """
    The main job.

    :param options: see :func:`parse_arguments`
    :return: directory with everything that was saved
    """
    name = f"{options.task}-noise{options.noise:g}-seed{options.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    directory = options.runs / name
    directory.mkdir(parents=True)
    set_random_seed(options.seed)
    env_kwargs = {"noise_std": options.noise, "privileged": options.privileged}
    env_id = f"sb3_gac/{options.task}-v5"
    env = make_vec_env(env_id, n_envs=options.envs, seed=options.seed, env_kwargs=env_kwargs)
    eval_env = make_vec_env(env_id, n_envs=min(5, options.episodes), env_kwargs=env_kwargs)
    arguments = gac_arguments(options)
    configuration = resolved_configuration(options, arguments)
    (directory / "config.yaml").write_text(yaml.safe_dump(configuration, sort_keys=False))

    started = time.time()
    model = GAC("MultiInputPolicy", env, seed=options.seed, **arguments)
    callback = GuiderLearnerEvalCallback(
        eval_env,
        eval_seed=EVAL_SEED,
        eval_freq=max(options.steps // 10 // options.envs, 1),
        n_eval_episodes=options.episodes,
        verbose=0,
    )
    model.learn(options.steps, callback=callback, progress_bar=True)
    minutes = (time.time() - started) / 60
    model.save(directory / "model")
    draw_learning_curve(callback.history, f"{options.task}, noise {options.noise:g}", directory / "learning_curve.png")

    learner, learner_std = evaluate(PartialOnly(model), eval_env, options.episodes)
    random, random_std = evaluate(UniformActions(eval_env), eval_env, options.episodes)
    results = {
        "learner": learner,
        "learner_std": learner_std,
        "random": random,
        "random_std": random_std,
        "steps": model.num_timesteps,
        "minutes": minutes,
        "history": [{key: float(value) for key, value in row.items()} for row in callback.history],
    }
    (directory / "results.json").write_text(json.dumps(results, indent=1))
    return directory


def summary(directory: Path) -> str:
    """
    :param directory: that :func:`train` returned
    :return: what came out, and how to use it
    """
    options = yaml.safe_load((directory / "config.yaml").read_text())
    results = json.loads((directory / "results.json").read_text())
    task, noise, episodes = (options[name] for name in ("task", "noise", "episodes"))
    learner, random = (f"{results[name]:.0f} +- {results[f'{name}_std']:.0f}" for name in ("learner", "random"))
    return f"""
Trained GAC on sb3_gac/{task}-v5 (noise {noise:g}) for {results["steps"]} steps in {results["minutes"]:.1f} minutes.
Learner, seeing `{PARTIAL}` alone: return {learner} over {episodes} episodes.
Random actions, same seeds: {random}.
Saved in {directory}: model.zip, learning_curve.png, results.json, config.yaml. To use the learner:
    from sb3_gac import GAC; model = GAC.load("{directory / "model"}")
    action, _ = model.predict({{"{PARTIAL}": observation}}, deterministic=True)"""


if __name__ == "__main__":
    print(summary(train(parse_arguments())))
