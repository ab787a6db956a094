"""The digits of recorded scores: results that were aggregated with one digit after the point say nothing of small returns."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from rliable import metrics

from benchmarks.bootstrap import interval
from benchmarks.tidy import CELL, NAMES, NO_NOISE, normalised_scores, number


def with_all_digits(results: Mapping[str, Any], tidy: pd.DataFrame) -> dict[str, Any]:
    """
    :param results: aggregated results, whose scores may be rounded
    :param tidy: evaluations from which they were aggregated
    :return: the same results, with the scores of single runs and cells as the evaluations give them
    """
    scores = normalised_scores(tidy)
    scales = {key: (float(cell.low.iloc[0]), float(cell.high.iloc[0])) for key, cell in scores.groupby(CELL)}
    of_algorithms = {key: group.sort_values("seed") for key, group in scores.groupby([*CELL, "algorithm"])}
    cells = [
        _exact(cell, of_algorithms.get((*_key(cell), cell["algorithm"]))) for cell in _with_guiders(results["cells"], tidy)
    ]
    compared = results["compared"]
    scaled = [cell | dict(zip(("low", "high"), scales.get(_key(cell), ()), strict=False)) for cell in compared["cells"]]
    return {**results, "cells": cells, "compared": compared | {"cells": scaled}}


def _key(cell: Mapping[str, Any]) -> tuple[str, float]:
    return cell["task"], NO_NOISE if cell["noise"] is None else cell["noise"]


def _with_guiders(cells: Iterable[dict[str, Any]], tidy: pd.DataFrame) -> Iterator[dict[str, Any]]:
    last = tidy[tidy.timesteps == tidy.groupby(NAMES).timesteps.transform("max")]
    means = last.groupby([*CELL, "algorithm"]).guider.mean().dropna().to_dict() if "guider" in tidy else {}
    for cell in cells:
        key = (*_key(cell), cell["algorithm"])
        yield cell | {"guider_mean": float(means[key])} if "guider_mean" in cell and key in means else cell


def _exact(cell: Mapping[str, Any], own: pd.DataFrame | None) -> dict[str, Any]:
    if own is None or own.seed.tolist() != cell["seeds"]:
        return dict(cell)
    more = {name: _interval(cell[name], own[score].to_numpy()) for name, score in _INTERVALS.items()}
    return {**cell, "final": own.final.tolist(), "final_mean": float(own.final.mean()), **more}


_INTERVALS = {"final_iqm": "final", "area_iqm": "area"}


def _interval(recorded: list[float], scores: np.ndarray) -> list[float]:
    """The recorded interval; a new bootstrap, which takes long, only where its mean shows fewer digits than it has."""
    is_precise = number(recorded[0]) == number(metrics.aggregate_iqm(scores[:, None]))
    return recorded if is_precise else interval(scores)
