"""The table of evaluations that ``aggregate`` writes, and all others read."""

from pathlib import Path

import pandas as pd

#: In the place of a noise, for environments that are not asked for one; an empty field in files
NO_NOISE = -1.0
#: Column of the environment steps of the runs that a run needs
NEEDED = "needed_steps"


def read_tidy(path: Path) -> pd.DataFrame:
    """
    :param path: of an aggregated CSV
    :return: its rows
    """
    return pd.read_csv(path, dtype={"noise": float}).fillna({"noise": NO_NOISE})


def with_needed_steps(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    :param tidy: see :func:`read_tidy`
    :return: the same, with steps counted from the start of the first run that a run needs
    """
    return tidy.assign(timesteps=tidy.timesteps + tidy[NEEDED]) if NEEDED in tidy else tidy
