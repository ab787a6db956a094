"""Simulators written for JAX (Brax, MuJoCo Playground): environments side by side, in a few compiled programs."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sb3_gac.envs.suites.extras import import_extra
from sb3_gac.envs.vector.base import BatchStep, BatchVecEnv, SimulatorObservation

_CACHE = "jax_compilation_cache_dir"
_CHUNK, _CHUNKS = 8, 16  # fewest environments that are reset at once, and number of parts in which many are reset


class FunctionalEnv(Protocol):
    """
    One environment in JAX's functional form, as those of Brax and Playground are.

    Its functions return states, which are pytrees with the attributes ``obs`` (an array, or arrays by key), ``reward`` and
    ``done`` (above 0 where the episode has ended).
    """

    def reset(self, rng: Any) -> Any:
        """
        Begin an episode.

        :param rng: random key of JAX, from which all random numbers of the episode come
        :return: first state of an episode
        """

    def step(self, state: Any, action: Any) -> Any:
        """
        Compute the state after a step.

        :param state: state that ``reset`` or ``step`` returned
        :param action: action of the environment, shape (A,)
        :return: next state
        """


class JaxVecEnv(BatchVecEnv):
    """
    Environments side by side on JAX's default device.

    The simulators' own wrappers for resets (Brax's ``AutoResetWrapper``, Playground's ``wrap_for_brax_training``) throw an
    episode's last observation away and reset to the same state again and again, so they are not used.  Here every episode
    starts afresh: the first state of an environment's n-th episode follows from the environment's seed and n alone.

    A checkpoint holds the simulators' state, so that exact resume goes on in the middle of episodes.

    :param env: one environment, without wrappers
    :param n_envs: number of environments side by side
    :param extra: extra of this package that installs the simulator, for the message if JAX is missing
    :param options: further keyword arguments for :class:`~sb3_gac.envs.vector.base.BatchVecEnv`
    """

    def __init__(self, env: FunctionalEnv, n_envs: int, extra: str, **options: Any):
        super().__init__(n_envs, **options)
        jax = self._jax = import_extra("jax", extra, type(self).__name__)
        _keep_compiled_programs(jax)
        self.env = env
        self._of_seeds = np.zeros(self.num_envs, dtype=np.uint32)
        self._episodes = np.zeros(self.num_envs, dtype=np.uint32)
        self._chunk = min(self.num_envs, max(_CHUNK, self.num_envs // _CHUNKS))
        self._state: Any = None

        def first(seed: Any, episode: Any) -> Any:
            return env.reset(jax.random.fold_in(jax.random.PRNGKey(seed), episode))

        def placed(state: Any, fresh: Any, rows: Any) -> Any:
            return jax.tree.map(lambda old, new: old.at[rows].set(new, mode="drop"), state, fresh)

        # Playground's step writes into the state that it is given, unless the step is compiled
        self._first = jax.jit(lambda *episodes: self._strongly_typed(jax.vmap(first)(*episodes)))
        self._next = jax.jit(lambda state, actions: self._strongly_typed(jax.vmap(env.step)(state, actions)))
        self._placed = jax.jit(placed)

    def _strongly_typed(self, state: Any) -> Any:
        """Make all leaves strongly typed: with weak types after resets alone, the step would be compiled twice."""
        return self._jax.tree.map(lambda leaf: self._jax.lax.convert_element_type(leaf, leaf.dtype), state)

    def start(self, seeds: Sequence[int]) -> SimulatorObservation:
        """Begin the first episodes of these seeds, as :meth:`~sb3_gac.envs.vector.base.BatchVecEnv.start` requires."""
        self._of_seeds = np.asarray(seeds, dtype=np.uint64).astype(np.uint32)
        self._episodes[:] = 0
        self._state = self._blank()
        return self._place_first(np.arange(self.num_envs))

    def restart(self, indices: np.ndarray) -> SimulatorObservation:
        """Begin some environments' next episodes, as :meth:`~sb3_gac.envs.vector.base.BatchVecEnv.restart` requires."""
        self._episodes[indices] += 1
        return self._place_first(indices)

    def _place_first(self, indices: np.ndarray) -> SimulatorObservation:
        """Begin episodes of some environments, a chunk at a time: to reset all environments takes about as long as a step."""
        for start in range(0, len(indices), self._chunk):
            rows = np.full(self._chunk, self.num_envs)  # out of range: nothing is placed there
            rows[: len(indices) - start] = indices[start : start + self._chunk]
            taken = np.minimum(rows, self.num_envs - 1)
            self._state = self._placed(self._state, self._first(self._of_seeds[taken], self._episodes[taken]), rows)
        return self._jax.tree.map(lambda values: values[indices], self._observation())

    def _blank(self) -> Any:
        """A state in which no environment has begun."""
        numbers = np.zeros(self._chunk, dtype=np.uint32)
        of_chunk = self._jax.eval_shape(self._first, numbers, numbers)
        blank = self._jax.tree.map(lambda leaf: np.zeros((self.num_envs, *leaf.shape[1:]), leaf.dtype), of_chunk)
        return self._jax.device_put(blank)  # as later states are: numpy's arrays would be another kind of argument

    def advance(self, actions: np.ndarray) -> BatchStep:
        """Step all environments, as :meth:`~sb3_gac.envs.vector.base.BatchVecEnv.advance` requires."""
        self._state = self._next(self._state, np.asarray(actions, dtype=np.float32))
        return BatchStep(self._observation(), np.asarray(self._state.reward), np.asarray(self._state.done) > 0)

    def _observation(self) -> SimulatorObservation:
        return self._jax.tree.map(np.asarray, self._state.obs)

    def simulator_state(self) -> dict[str, Any]:
        """
        Write down the state of the simulators.

        :return: leaves of the simulators' state, and seed and number of episodes of each environment
        """
        leaves = [np.array(leaf) for leaf in self._jax.tree.leaves(self._state)]
        return {"leaves": leaves, "seeds": self._of_seeds, "episodes": self._episodes.copy()}

    def restore_simulator_state(self, state: dict[str, Any]) -> None:
        """
        Put the simulators back into a state.

        :param state: state that :meth:`simulator_state` returned
        """
        self._of_seeds, self._episodes = state["seeds"], state["episodes"].copy()
        if state["leaves"]:
            structure = self._jax.tree.structure(self._blank())
            self._state = self._jax.device_put(self._jax.tree.unflatten(structure, state["leaves"]))


def _keep_compiled_programs(jax: Any) -> None:
    """Keep compiled programs on disk, since a step takes 10 to 90 seconds to compile; the user may have said where."""
    if getattr(jax.config, _CACHE) is None:
        cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sb3_gac" / "jax"
        jax.config.update(_CACHE, str(cache))
