"""Arrays by step, as SB3's buffers have them, for a replay buffer that stores each observation once."""

from collections.abc import Callable

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer

from sb3_gac.replay.observation_store import ObservationLayout, Rows

#: Flags of ``endings``: the episode ended; its time limit ended it; it was cut off, as by a reset from outside
DONE, TIME_LIMIT, CUT = 1, 2, 4


class ShownByStep(DictReplayBuffer):
    """A replay buffer whose arrays are put together at each access, and can't be written to: the writing would be lost."""

    n_rows: int
    layout: ObservationLayout
    endings: np.ndarray
    _gather: Callable[[np.ndarray, np.ndarray], Rows]
    _next_rows: Callable[..., Rows]

    @property
    def observations(self) -> dict[str, np.ndarray]:  # type: ignore[override]
        """Observations, entry -> shape (rows, n_envs, \\*entry shape); the row at ``pos`` is the newest next observation."""
        return self._everywhere(self._gather)

    @property
    def next_observations(self) -> dict[str, np.ndarray]:  # type: ignore[override]
        """Next observations, entry -> shape (rows, n_envs, \\*entry shape)."""
        return self._everywhere(lambda rows, envs: self._next_rows(rows, envs, only_stored=True))

    def _everywhere(self, gather: Callable[[np.ndarray, np.ndarray], Rows]) -> dict[str, np.ndarray]:
        packed = gather(*np.divmod(np.arange(self.n_rows * self.n_envs), self.n_envs))
        shown = self.layout.unpack({group: values.reshape(*self.endings.shape, -1) for group, values in packed.items()})
        return {key: _read_only(values) for key, values in shown.items()}

    @property
    def dones(self) -> np.ndarray:  # type: ignore[override]
        """1 where an episode ended by termination or time limit, else 0, shape (rows, n_envs)."""
        return _read_only((self.endings & DONE).astype(np.float32))

    @property
    def timeouts(self) -> np.ndarray:  # type: ignore[override]
        """1 where an episode ended by its time limit, else 0, shape (rows, n_envs)."""
        return _read_only((self.endings & TIME_LIMIT > 0).astype(np.float32))


def _read_only(values: np.ndarray) -> np.ndarray:
    values.flags.writeable = False
    return values
