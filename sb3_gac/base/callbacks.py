"""Callbacks that evaluate from the same seeds every time: the deployed policy, or guider and learner side by side."""

import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_gac.checks.arguments import constructor_arguments
from sb3_gac.checks.values import described, plain

#: Argument -> what to do with it where guider and learner are apart
_ADVICE = {
    "guider": 'use guider="residual"',
    "max_kl": "set a hard bound by max_kl",
    "kl_coef_bounds": "widen kl_coef_bounds",
    "kl_coef_learning_rate": "raise kl_coef_learning_rate",
    "largest_kl_coef": "raise largest_kl_coef",
    "target_kl": "lower target_kl",
    "behaviour": "give the learner more of the episodes by behaviour",
    "guidance": "pull it by guidance",
    "see more": "let it see more (a history, a memory)",
}
_WATCHED = ("train/kl", "train/target_kl", "train/kl_coef", "train/kl_coef_on_bound", "train/learner_mean_abs")
#: File under ``log_path``, beside SB3's "evaluations.npz"
GUIDER_EVALUATIONS = "guider_evaluations.npz"


def _rows_until(step: int, path: Path) -> dict[str, np.ndarray]:
    """
    :param step: environment step
    :param path: file of evaluations, one row of each array for each of them
    :return: name -> the rows up to that step; empty without such rows, with a warning about a file that can't be read
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            columns = dict(stored)
        kept = columns["timesteps"] <= step
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, EOFError, KeyError, BadZipFile) as error:
        warnings.warn(f"{path} can't be read, and evaluations start anew there: {described(error)}", stacklevel=2)
        return {}
    return {name: column[kept] for name, column in columns.items() if len(column) == len(kept)} if kept.any() else {}


@contextmanager
def _random_numbers_from(seed: int) -> Iterator[None]:
    """
    Draw torch's random numbers from a seed; afterwards they go on as if none had been drawn.

    :param seed: seed within the context
    """
    with th.random.fork_rng():
        th.manual_seed(seed)
        yield


class SeededEvalCallback(EvalCallback):
    """
    ``EvalCallback`` with the same initial states and sensor noise at every evaluation, and its results kept in ``history``.

    With ``deterministic=False`` actions are sampled, by random numbers that are the same at every evaluation as well. The
    random numbers of training stay what they were.

    A new callback goes on with the files under ``log_path`` where ``learn`` goes on with a training, after ``resume`` for
    example: evaluations up to the present step stay, with the best of them, and later ones are dropped.

    :param eval_env: environment for evaluation
    :param eval_seed: seed that the evaluation environments get before every evaluation
    :param kwargs: further arguments of SB3's ``EvalCallback``, such as ``eval_freq`` and ``n_eval_episodes``
    :raises ValueError: when ``learn`` goes on, if the evaluations in the files have another number of episodes
    """

    def __init__(self, eval_env: gym.Env | VecEnv, eval_seed: int = 10_000, **kwargs: Any):
        super().__init__(eval_env, **kwargs)
        self.eval_seed = eval_seed
        self.history: list[dict[str, float]] = []
        self._episode_returns: list[float] = []

    def _init_callback(self) -> None:
        # The model wraps its own environments in this way, and SB3 copies statistics between environments wrapped alike
        self.eval_env = BaseAlgorithm._wrap_env(self.eval_env)
        super()._init_callback()
        if self.log_path is not None and not self.evaluations_timesteps:
            self._go_on_from_files()

    def _go_on_from_files(self) -> None:
        """Take over the evaluations up to the present step, none for a new training: each evaluation writes the files anew."""
        stored = _rows_until(self.model.num_timesteps, Path(f"{self.log_path}.npz"))
        if not stored:
            return
        steps, returns = stored["timesteps"], stored["results"]
        if returns.shape[1] != self.n_eval_episodes:
            raise ValueError(
                f"{self.log_path}.npz has evaluations of {returns.shape[1]} episodes, but n_eval_episodes is "
                f"{self.n_eval_episodes}: give the former number, or another log_path."
            )
        self.evaluations_timesteps, self.evaluations_results = steps.tolist(), returns.tolist()
        self.evaluations_length = stored["ep_lengths"].tolist()
        self.evaluations_successes = stored["successes"].tolist() if "successes" in stored else []
        means = returns.mean(axis=1).tolist()
        self.history = [{"timesteps": step, "learner": mean} for step, mean in zip(steps.tolist(), means, strict=True)]
        self.best_mean_reward, self.last_mean_reward = max(means), means[-1]
        self.n_calls = self.model.num_timesteps // self.training_env.num_envs  # as if evaluations had never stopped

    def checkpoint_state(self) -> dict[str, Any]:
        """State that the notes of a checkpoint keep, so that a resumed training goes on with the same evaluations."""
        return {"history": plain(self.history)}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        Go on with the evaluations before a checkpoint.

        :param state: what :meth:`checkpoint_state` returned; that of an earlier version may have ``history`` alone
        """
        self.history = [dict(row) for row in state["history"]]

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        with self._random_numbers():
            self._before_evaluation()
        self.eval_env.seed(self.eval_seed)
        self._episode_returns = []
        with self._random_numbers():
            go_on = super()._on_step()
        returns = np.array(self._episode_returns)
        self.history.append({"timesteps": self.num_timesteps, "learner": returns.mean()})
        self._after_evaluation(returns)
        return go_on

    def _random_numbers(self) -> AbstractContextManager:
        return nullcontext() if self.deterministic else _random_numbers_from(self.eval_seed)

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        self._episode_returns = locals_["episode_rewards"]

    def _before_evaluation(self) -> None:
        """Called before each evaluation; a subclass evaluates other policies here."""

    def _after_evaluation(self, returns: np.ndarray) -> None:
        """
        Called after each evaluation; a subclass may add to the last row of ``history``.

        :param returns: return of each of the deployed policy's episodes, shape (n_eval_episodes,)
        """


class _GuiderPredictor:
    """A model's guider, in the form that SB3's ``evaluate_policy`` takes."""

    def __init__(self, model: Any):
        self.predict = model.predict_guider


class GuiderLearnerEvalCallback(SeededEvalCallback):
    """
    Evaluate the learner, as ``EvalCallback`` does, and the guider from the same seeds (the paper's Figure 4).

    The callback logs ``eval/mean_reward`` (learner) and ``eval/guider_mean_reward``. It keeps both in ``history`` and in
    ``guider_evaluations.npz`` under ``log_path``, with the means since the last evaluation of KL, its coefficient and
    ``learner_mean_abs`` (the size of the learner's mean action before tanh, where actions are continuous).

    It warns when the learner no longer follows the guider, that is, when ``patience`` evaluations in a row find KL more than
    twice its target, the KL coefficient on a bound, or a guider that is clearly better.

    :param eval_env: environment for evaluation
    :param eval_seed: seed that the evaluation environments get before each policy's evaluation
    :param patience: number of evaluations in a row that lead to a warning
    :param gap_tolerance: fraction of the guider's mean return that the learner may lack, beyond two standard errors
    :param log_path: directory for results; ``None`` for no files
    :param kwargs: further arguments of SB3's ``EvalCallback``, such as ``eval_freq`` and ``n_eval_episodes``
    :raises TypeError: at the start of training, if the model has no guider
    """

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        eval_seed: int = 10_000,
        patience: int = 3,
        gap_tolerance: float = 0.2,
        log_path: str | None = None,
        **kwargs: Any,
    ):
        super().__init__(eval_env, eval_seed, log_path=log_path, **kwargs)
        self.patience = patience
        self.gap_tolerance = gap_tolerance
        self._directory = None if log_path is None else Path(log_path)
        self._since_evaluation: dict[str, list[float]] = {}
        self._watched: dict[str, float] = {}
        self._in_a_row = {"kl": 0, "bound": 0, "gap": 0}
        self._guider_returns = np.array([])

    def _init_callback(self) -> None:
        if not hasattr(self.model, "predict_guider"):
            raise TypeError(
                f"GuiderLearnerEvalCallback evaluates a guider, which {type(self.model).__name__} does not have: use "
                "SeededEvalCallback, which evaluates the deployed policy in the same way."
            )
        super()._init_callback()

    def _go_on_from_files(self) -> None:
        super()._go_on_from_files()
        assert self._directory is not None
        stored = _rows_until(self.model.num_timesteps, self._directory / GUIDER_EVALUATIONS)
        columns = {name: column.tolist() for name, column in stored.items()}
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        seen = {row["timesteps"]: {name: value for name, value in row.items() if not np.isnan(value)} for row in rows}
        self.history = [row | seen.get(row["timesteps"], {}) for row in self.history]

    def checkpoint_state(self) -> dict[str, Any]:
        """See :meth:`SeededEvalCallback.checkpoint_state`; here are the metrics since the last evaluation too."""
        metrics = {"since_evaluation": self._since_evaluation, "watched": self._watched, "in_a_row": self._in_a_row}
        return super().checkpoint_state() | plain(metrics)

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """See :meth:`SeededEvalCallback.restore_checkpoint_state`."""
        super().restore_checkpoint_state(state)
        self._since_evaluation = {name: list(values) for name, values in state.get("since_evaluation", {}).items()}
        self._watched = dict(state.get("watched", {}))
        self._in_a_row |= state.get("in_a_row", {})

    def _on_rollout_start(self) -> None:
        """Collect the metrics that the last gradient steps logged, because the logger forgets them at every dump."""
        logged = self.logger.name_to_value
        for name in _WATCHED:
            if name in logged:
                self._since_evaluation.setdefault(name, []).append(logged[name])

    def _before_evaluation(self) -> None:
        self._watched.update({name: float(np.mean(values)) for name, values in self._since_evaluation.items()})
        self._since_evaluation.clear()
        self._guider_returns = self._evaluate_guider()

    def _evaluate_guider(self) -> np.ndarray:
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        self.eval_env.seed(self.eval_seed)
        returns, _ = evaluate_policy(
            _GuiderPredictor(self.model),
            self.eval_env,
            n_eval_episodes=self.n_eval_episodes,
            deterministic=self.deterministic,
            return_episode_rewards=True,
            warn=self.warn,
        )
        self.logger.record("eval/guider_mean_reward", float(np.mean(returns)))
        return np.array(returns)

    def _after_evaluation(self, returns: np.ndarray) -> None:
        guider = {"guider": self._guider_returns.mean()}
        self.history[-1].update(guider | {name.removeprefix("train/"): value for name, value in self._watched.items()})
        if self._directory is not None:
            names = {name: None for row in self.history for name in row}
            columns: dict[str, Any] = {name: np.array([row.get(name, np.nan) for row in self.history]) for name in names}
            np.savez(self._directory / GUIDER_EVALUATIONS, **columns)
        self._warn_if_not_following(self._guider_returns, returns)

    def _warn_if_not_following(self, guider_returns: np.ndarray, learner_returns: np.ndarray) -> None:
        gap = guider_returns.mean() - learner_returns.mean()
        noise = np.sqrt((guider_returns.var() + learner_returns.var()) / len(guider_returns))
        kl, target_kl = self._watched.get("train/kl", 0.0), self._watched.get("train/target_kl", np.inf)
        kl_coef = self._watched.get("train/kl_coef", np.nan)
        found = {
            "kl": (
                kl > 2 * target_kl,
                f"KL(guider || learner) is {kl:.2g} for a target of {target_kl:.2g}: the learner does not keep up. "
                + self._advice("guider", "max_kl", "kl_coef_bounds", "kl_coef_learning_rate", "largest_kl_coef"),
            ),
            "bound": (
                self._watched.get("train/kl_coef_on_bound", 0.0) > 0.5,
                f"kl_coef sits on a bound ({kl_coef:.2g}), and KL is {kl:.2g} for a target of {target_kl:.2g}. "
                + (
                    self._advice("kl_coef_bounds", "largest_kl_coef")
                    if kl > target_kl
                    else "The guider wants nothing that the learner does not do."
                ),
            ),
            "gap": (
                gap > self.gap_tolerance * abs(guider_returns.mean()) + 2 * noise,
                f"the guider returns {guider_returns.mean():.5g} and the learner {learner_returns.mean():.5g}: the learner "
                "can't do what the guider does. " + self._advice("target_kl", "behaviour", "guidance", "see more"),
            ),
        }
        for name, (is_so, message) in found.items():
            self._in_a_row[name] = self._in_a_row[name] + 1 if is_so else 0
            if self._in_a_row[name] == self.patience:
                warnings.warn(f"After {self.num_timesteps} steps, {message}", stacklevel=2)

    def _advice(self, *names: str) -> str:
        """A sentence of what to change, of those arguments that the algorithm has."""
        known = [*constructor_arguments(type(self.model)), "see more"]
        *words, last = [_ADVICE[name] for name in names if name in known] or ["change another setting"]
        text = f"{', '.join(words)}{',' * (len(words) > 1)} or {last}" if words else last
        return f"{text[0].upper()}{text[1:]}."
