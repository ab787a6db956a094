"""Divergence of training: it is noticed in the metrics of a round of gradient steps, and a diagnosis is written."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.checks.arguments import constructor_parameters


class DivergenceError(RuntimeError):
    """
    A loss, a gradient norm or another metric is NaN or infinite.

    :param message: text that names the metrics, the step, and remedies to try
    :param diagnosis: diagnosis that :func:`diagnose` returned
    :param path: path of the file that holds the diagnosis; ``None`` if there is none
    """

    def __init__(self, message: str, diagnosis: dict[str, Any] | None = None, path: Path | None = None):
        super().__init__(message)
        self.diagnosis = diagnosis or {}
        self.path = path


def check_finite_metrics(
    model: BaseAlgorithm, metrics: dict[str, float], last_good: Mapping[str, float], coefficients: Mapping[str, th.Tensor]
) -> None:
    """
    Check that all metrics are finite, and write a diagnosis if they are not.

    :param model: model that was trained
    :param metrics: name -> metric of the round of gradient steps just done
    :param last_good: name -> metric of the round before
    :param coefficients: name -> value of a coefficient of the losses, learned or fixed
    :raises DivergenceError: if one of the metrics is NaN or infinite
    """
    not_finite = [name for name, value in metrics.items() if not math.isfinite(value)]
    if not not_finite:
        return
    diagnosis = diagnose(model, metrics, last_good, coefficients)
    path = write_diagnosis(diagnosis, model.logger.get_dir(), model.num_timesteps)
    raise DivergenceError(
        f"Training diverged: after {model.num_timesteps} steps (num_timesteps) and {model._n_updates} gradient steps these "
        f"metrics are NaN or infinite: {', '.join(not_finite)}. The networks can't be trusted any more: go back to the last "
        "checkpoint. The last good metrics, coefficients and the largest observations and rewards are in "
        f"{path or 'the attribute diagnosis of this error'}. Try a lower learning_rate, max_grad_norm=1.0, VecNormalize or "
        "smaller rewards.",
        diagnosis,
        path,
    )


def diagnose(
    model: BaseAlgorithm, metrics: dict[str, float], last_good: Mapping[str, float], coefficients: Mapping[str, th.Tensor]
) -> dict[str, Any]:
    """
    Gather what may explain a divergence.

    :param model: model that was trained
    :param metrics: name -> metric of the round of gradient steps just done
    :param last_good: name -> metric of the round before
    :param coefficients: name -> value of a coefficient of the losses, learned or fixed
    :return: diagnosis, in a form that JSON can hold: steps, metrics, coefficients, arguments, and the largest absolute values
        in a batch as the networks see it
    """
    entries: Mapping[str, th.Tensor] = model.example_of_data()  # type: ignore[attr-defined]
    diagnosis = {
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
        "metrics": metrics,
        "last_good_metrics": dict(last_good),
        "coefficients": {name: value.tolist() for name, value in coefficients.items()},
        "largest_in_a_batch": {name: values.float().abs().max().item() for name, values in entries.items()},
        "arguments": _arguments(model),
    }
    return json.loads(json.dumps(_without_nan(diagnosis), default=repr))


def write_diagnosis(diagnosis: dict[str, Any], directory: str | None, step: int) -> Path | None:
    """
    Write a diagnosis to a file; a failure to do so raises no error, which would hide the divergence.

    :param diagnosis: diagnosis that :func:`diagnose` returned
    :param directory: directory of the logger; ``None`` if it has none
    :param step: number of environment steps, for the file's name
    :return: path of the file; ``None`` if it was not written
    """
    if directory is None:
        return None
    path = Path(directory) / f"divergence_{step}.json"
    try:
        path.write_text(json.dumps(diagnosis, indent=2), encoding="utf-8")
    except OSError:
        return None
    return path


def _arguments(model: BaseAlgorithm) -> dict[str, Any]:
    """Name -> constructor argument, for those that the model has kept."""
    names = [name for name in constructor_parameters(type(model)) if name in vars(model) and name != "env"]
    return {name: getattr(model, name) for name in names} | {"policy": model.policy_class.__name__}


def _without_nan(value: Any) -> Any:
    """The value with text in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _without_nan(item) for key, item in value.items()}
    return [_without_nan(item) for item in value] if isinstance(value, (list, tuple)) else value
