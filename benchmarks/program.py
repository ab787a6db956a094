"""The request to a program in Python that trains for :mod:`benchmarks.external`, and the program's answer."""

import csv
import io
import json
import sys
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.checkpoint import CHECKPOINT, write_atomically
from benchmarks.environments import make_envs
from benchmarks.suite import RunSpec
from sb3_gac.training.environments import make_wrapped

REQUEST, EVALUATIONS = "request.json", "evaluations.csv"
#: One mapping for each evaluation: ``timesteps``, ``learner``, and perhaps other numbers
Rows: TypeAlias = list[dict[str, float]]


def read_rows(directory: Path) -> Rows:
    """
    :param directory: directory of a run
    :return: evaluations that the run's program has made so far
    :raises ValueError: if the file is no table with the numbers ``timesteps`` and ``learner``
    """
    path = directory / CHECKPOINT / EVALUATIONS
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]
        return [{**row, "timesteps": int(row["timesteps"]), "learner": row["learner"]} for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: each row must have the numbers timesteps and learner ({error!r}).") from None


def rows_as_text(rows: Rows) -> str:
    """
    :param rows: at least one row
    :return: text of a CSV file with these rows; the columns are those of any row
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, {name: None for row in rows for name in row}, restval="nan")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


class Request:
    """
    A run that a program is asked to make.

    :param path: path of ``request.json``
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        asked = json.loads(self.path.read_text(encoding="utf-8"))
        #: Settings of the run
        self.spec = RunSpec(**asked["run"])
        #: The program's own arguments
        self.arguments: dict[str, Any] = asked["arguments"]
        #: Environment steps at which the program evaluates
        self.evaluations: list[int] = asked["evaluations"]
        #: Evaluations so far
        self.rows = read_rows(self.path.parent)
        sys.path += [place for place in asked["path"] if place not in sys.path]
        #: Seed of the first evaluation environment; the others have the following numbers
        self.eval_seed: int = asked["eval_seed"]
        self._environment = asked["environment"]
        self._eval_env: VecEnv | None = None

    @property
    def checkpoint(self) -> Path:
        """The directory for the program's own checkpoints; it is removed when the run is finished."""
        return self.path.parent / CHECKPOINT

    def make_env(self) -> gym.Env:
        """Make one of the run's environments, without a seed."""
        return make_wrapped(self._environment["id"], self._environment["kwargs"], self._environment["wrappers"])

    def go_on_from(self, timesteps: int) -> None:
        """
        Drop the evaluations after a checkpoint, since they will be made again.

        :param timesteps: environment steps at the program's last checkpoint
        """
        self.rows = [row for row in self.rows if row["timesteps"] <= timesteps]

    def evaluate(self, timesteps: int, policy: Any) -> float:
        """
        Evaluate a policy with the same environments, seeds and number of episodes as every algorithm, and write the table of
        evaluations.

        :param timesteps: environment steps so far, one of ``evaluations``
        :param policy: object with SB3's ``predict(observation, state, episode_start, deterministic)``
        :return: mean return of the episodes
        """
        if self._eval_env is None:
            self._eval_env = make_envs(self.spec, self.spec.eval_episodes)
        self._eval_env.seed(self.eval_seed)
        returns, _ = evaluate_policy(
            policy, self._eval_env, n_eval_episodes=self.spec.eval_episodes, return_episode_rewards=True
        )
        self.rows.append({"timesteps": timesteps, "learner": float(np.mean(returns))})
        write_atomically(self.checkpoint / EVALUATIONS, rows_as_text(self.rows))
        return self.rows[-1]["learner"]
