"""
Train GAC on a task with noisy sensors, then evaluate the learner on its partial observation alone::

    python -m sb3_gac.train --task HalfCheetah --noise 0.1 --steps 50000 --seed 0
    python -m sb3_gac.train --history 1    # the learner sees the newest observation alone, not the last four

Everything is saved under ``runs/``: the model, the learning curve as a picture, the evaluations and the resolved
configuration.  A run that was stopped, by Ctrl-C or otherwise, goes on from its last checkpoint, and ends as it would have
without that::

    python -m sb3_gac.train --resume runs/<its directory>
"""

import argparse
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch as th
import yaml
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac import GAC, PRESETS, ExactCheckpointCallback, GuiderLearnerEvalCallback, __version__, preset
from sb3_gac.checkpoint.files import checkpoints
from sb3_gac.envs import PARTIAL, make_vec
from sb3_gac.envs.suites import SUITES, Suite, env_id_of, suite_of, task_of

EVAL_SEED = 10_000
EVALUATIONS = 10
#: Noisy observations that the learner sees: with four it returned 3766 on HalfCheetah after 50,000 steps, with one 3432
HISTORY = 4
CONFIGURATION, CHECKPOINTS, RESULTS = "config.yaml", "checkpoints", "results.json"


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
    tasks = sorted(task_of(env_id) for suite in SUITES.values() if suite.sensor_noise for env_id in suite.environments)
    parser.add_argument("--task", default="HalfCheetah", choices=tasks, metavar="TASK", help=f"one of {', '.join(tasks)}")
    parser.add_argument(
        "--noise", type=float, help="standard deviation of the sensor noise, by default 0.1, or 0 where sensors have their own"
    )
    parser.add_argument("--privileged", default="state", choices=["state", "velocity"])
    parser.add_argument(
        "--history",
        type=int,
        help=f"observations that the learner sees, with the actions between, by default {HISTORY} where sensors are noisy",
    )
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--envs", type=int, help="environments side by side, by default as many as the preset is for")
    parser.add_argument("--preset", choices=sorted(PRESETS), help="arguments of GAC, by default those for the task's suite")
    parser.add_argument(
        "--compile", action="store_true", help="faster gradient steps after half a minute; needs a C++ compiler"
    )
    parser.add_argument("--episodes", type=int, default=10, help="of each evaluation")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where results go")
    parser.add_argument("--resume", type=Path, metavar="DIRECTORY", help="of a run to go on with, whose options count")
    options = parser.parse_args(arguments)
    if options.resume is not None:
        try:
            return options_of(options.resume)
        except ValueError as error:
            parser.error(str(error))
    suite = suite_with(options.task)
    options.noise = suite.noise_std if options.noise is None else options.noise
    options.preset = options.preset or suite.preset
    if options.history is None:
        options.history = HISTORY if suite.history and options.noise > 0 else 1
    if options.history != 1 and not suite.history:
        parser.error(f"--history: {options.task} takes none.")
    options.envs = options.envs or PRESETS[options.preset].envs
    return options


def suite_with(task: str) -> Suite:
    """
    :param task: of an environment
    :return: the suite that has it
    """
    return SUITES[suite_of(env_id_of(task)) or ""]


def options_of(directory: Path) -> argparse.Namespace:
    """
    :param directory: of a run that was stopped
    :return: its options, to go on with it
    :raises ValueError: if there is nothing to go on with
    """
    if (directory / RESULTS).exists():
        raise ValueError(f"--resume {directory}: this run is finished, its results are in {RESULTS}.")
    if not checkpoints(directory / CHECKPOINTS):
        raise ValueError(f"--resume {directory}: there is no checkpoint in {directory / CHECKPOINTS}; start the run again.")
    defaults = vars(parse_arguments([])) | {"history": 1}  # which runs of earlier versions had
    configuration = yaml.safe_load((directory / CONFIGURATION).read_text())
    options = {name: configuration.get(name, default) for name, default in defaults.items() if name != "resume"}
    return argparse.Namespace(**options | {"runs": Path(options["runs"]), "resume": directory})


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
    given = {name: value for name, value in vars(options).items() if name != "resume"}
    command_line = {name: str(value) if isinstance(value, Path) else value for name, value in given.items()}
    versions = {"sb3_gac": __version__, "torch": str(th.__version__)}
    shown = {**arguments, "policy_kwargs": {key: str(value) for key, value in arguments["policy_kwargs"].items()}}
    return {**command_line, "eval_seed": EVAL_SEED, "gac": shown, "versions": versions}


def start(options: argparse.Namespace) -> Path:
    """
    :param options: see :func:`parse_arguments`
    :return: a new directory for the run, with its configuration
    """
    history = "" if options.history == 1 else f"-history{options.history}"
    name = f"{options.task}-noise{options.noise:g}{history}-seed{options.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    directory = options.runs / name
    directory.mkdir(parents=True)
    configuration = resolved_configuration(options, gac_arguments(options))
    (directory / CONFIGURATION).write_text(yaml.safe_dump(configuration, sort_keys=False))
    return directory


def train(options: argparse.Namespace, directory: Path) -> None:
    """
    The main job, or what is left of it.

    :param options: see :func:`parse_arguments`
    :param directory: where everything is saved, see :func:`start`
    """
    set_random_seed(options.seed)
    env_kwargs = {"noise_std": options.noise}
    if options.privileged != "state":  # which not every suite can change
        env_kwargs["privileged"] = options.privileged
    if options.history != 1:
        env_kwargs["history"] = options.history
    env_id = env_id_of(options.task)
    env = make_vec(env_id, options.envs, options.seed, **env_kwargs)
    eval_env = make_vec(env_id, min(5, options.episodes), **env_kwargs)
    model, history, minutes = learn(options, directory, env, eval_env)
    model.save(directory / "model")
    draw_learning_curve(history, f"{options.task}, noise {options.noise:g}", directory / "learning_curve.png")

    learner, learner_std = evaluate(PartialOnly(model), eval_env, options.episodes)
    random, random_std = evaluate(UniformActions(eval_env), eval_env, options.episodes)
    results = {
        "learner": learner,
        "learner_std": learner_std,
        "random": random,
        "random_std": random_std,
        "steps": model.num_timesteps,
        "minutes": minutes,
        "history": history,
    }
    (directory / RESULTS).write_text(json.dumps(results, indent=1))
    shutil.rmtree(directory / CHECKPOINTS)


def learn(
    options: argparse.Namespace, directory: Path, env: VecEnv, eval_env: VecEnv
) -> tuple[GAC, list[dict[str, float]], float]:
    """
    Train from the start, or from the last checkpoint. One is made after every evaluation, and when the process is told to end.

    :param options: see :func:`parse_arguments`
    :param directory: of the run
    :param env: to train in
    :param eval_env: to evaluate in
    :return: the model, its evaluations, and the minutes that it took, those of a process that was stopped included
    """
    every = max(options.steps // EVALUATIONS // options.envs, 1)
    evaluation = GuiderLearnerEvalCallback(
        eval_env, eval_seed=EVAL_SEED, eval_freq=every, n_eval_episodes=options.episodes, verbose=0
    )
    started = time.time()
    if options.resume is None:
        arguments = {"policy": "MultiInputPolicy", **gac_arguments(options)}
        model, left, before = GAC(env=env, seed=options.seed, **arguments), options.steps, 0.0
    else:
        model = GAC.resume(directory / CHECKPOINTS, env)
        evaluation.history, before = model.resumed_notes["history"], model.resumed_notes["minutes"]
        evaluation.n_calls = model.num_timesteps // options.envs  # evaluations are counted from the run's start
        left = model.steps_left

    def notes() -> dict[str, Any]:
        history = [{key: float(value) for key, value in row.items()} for row in evaluation.history]
        return {"history": history, "minutes": before + (time.time() - started) / 60}

    checkpoint = ExactCheckpointCallback(directory / CHECKPOINTS, every * options.envs, notes=notes)
    model.learn(left, callback=[evaluation, checkpoint], reset_num_timesteps=options.resume is None, progress_bar=True)
    final = notes()
    return model, final["history"], final["minutes"]


def summary(directory: Path) -> str:
    """
    :param directory: that :func:`train` returned
    :return: what came out, and how to use it
    """
    options = yaml.safe_load((directory / "config.yaml").read_text())
    results = json.loads((directory / "results.json").read_text())
    task, noise, episodes = (options[name] for name in ("task", "noise", "episodes"))
    history = f", history {options['history']}" if options.get("history", 1) > 1 else ""
    learner, random = (f"{results[name]:.0f} +- {results[f'{name}_std']:.0f}" for name in ("learner", "random"))
    return f"""
Trained GAC on {env_id_of(task)} (noise {noise:g}{history}) for {results["steps"]} steps in {results["minutes"]:.1f} minutes.
Learner, seeing `{PARTIAL}` alone: return {learner} over {episodes} episodes.
Random actions, same seeds: {random}.
Saved in {directory}: model.zip, learning_curve.png, results.json, config.yaml. To use the learner:
    from sb3_gac import GAC; model = GAC.load("{directory / "model"}")
    action, _ = model.predict({{"{PARTIAL}": observation}}, deterministic=True)"""


def main(arguments: list[str] | None = None) -> None:
    """
    Command line.

    :param arguments: by default the process's
    """
    options = parse_arguments(arguments)
    directory = options.resume or start(options)
    try:
        train(options, directory)
    except (KeyboardInterrupt, SystemExit) as stop:
        print(f"\n{how_to_go_on(directory)}", file=sys.stderr)
        sys.exit(stop.code if isinstance(stop, SystemExit) else 130)
    print(summary(directory))


def how_to_go_on(directory: Path) -> str:
    """
    :param directory: of a run that was stopped
    :return: what is left of it, and what to do with that
    """
    if not checkpoints(directory / CHECKPOINTS):
        return f"Stopped before there was anything to keep: {directory} has only its configuration."
    command = f"python -m sb3_gac.train --resume {directory}"
    return f"Stopped; the last checkpoint is in {directory / CHECKPOINTS}. To go on:\n    {command}"


if __name__ == "__main__":
    main()
