"""The table of evaluations that ``aggregate`` writes and other programs read."""

from pathlib import Path

import pandas as pd

#: Value that stands for the noise of environments that take no sensor noise; in files the field is empty
NO_NOISE = -1.0
#: Column with the environment steps of the runs that a run needs
NEEDED = "needed_steps"


def read_tidy(path: Path) -> pd.DataFrame:
    """
    :param path: CSV file of aggregated evaluations
    :return: table of evaluations, with ``NO_NOISE`` where the noise is empty
    """
    return pd.read_csv(path, dtype={"noise": float}).fillna({"noise": NO_NOISE})


def with_needed_steps(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    :param tidy: evaluations, see :func:`read_tidy`
    :return: the same table, with ``timesteps`` counted from the start of the first run that a run needs
    """
    return tidy.assign(timesteps=tidy.timesteps + tidy[NEEDED]) if NEEDED in tidy else tidy
