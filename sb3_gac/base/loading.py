"""Loading of models whose algorithm is found in their files."""

from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_gac.algorithms import ALGORITHMS, import_path

MODEL = "model.zip"


def model_file(path: Path) -> Path:
    """
    Find the file of a model.

    :param path: path of a model's file, with or without its suffix ``.zip``, or of a run's directory
    :return: path of the file
    :raises FileNotFoundError: if there is no such file
    """
    if path.is_dir():
        if not (path / MODEL).exists():
            raise FileNotFoundError(f"{path} has no {MODEL}{_instead(path)}")
        return path / MODEL
    for file in (path, path.with_name(f"{path.name}.zip")):
        if file.is_file():
            return file
    raise FileNotFoundError(f"There is no file or directory {path}.")


def _instead(directory: Path) -> str:
    """The end of the message about a directory without a model: what is in it, and what to do."""
    if others := sorted(str(file) for file in directory.glob("*.zip")):
        return f", but other models: give one of {', '.join(others)}."
    if (directory / "config.yaml").is_file():
        return (
            f": the run has not finished. sb3-gac train --resume {directory} goes on with it; a run of the benchmarks goes on "
            "by the command that started it."
        )
    return ": the run has not finished, or this is another directory."


def class_of_model(path: Path, device: th.device | str = "cpu") -> Any:
    """
    The class of the model in a file.

    :param path: path of a file that ``save`` of one of this package's algorithms, or of a subclass, wrote
    :param device: device that the file's tensors are put on while it is read
    :return: class of the model
    :raises ValueError: if the file does not name an algorithm of this package, or the class can't be imported
    """
    data, _, _ = load_from_zip_file(path, device=device, load_data=True)
    saved = data or {}
    paths = [known for known in ALGORITHMS.values() if known.endswith(f":{saved.get('algorithm')}")]
    if "algorithm_path" not in saved and not paths:
        raise ValueError(f"{path} does not say which algorithm of sb3_gac its model is of.")
    return import_path(saved.get("algorithm_path") or paths[0])


def load_model(path: Path, device: th.device | str = "auto") -> Any:
    """
    Load a model of whichever algorithm.

    :param path: path of a file that an algorithm's ``save`` wrote
    :param device: device of the model's networks
    :return: loaded model
    :raises ValueError: if the file does not name an algorithm of this package, or the class can't be imported
    """
    return class_of_model(path).load(path, device=device)
