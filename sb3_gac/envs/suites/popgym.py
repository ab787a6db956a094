"""
The fifteen POPGym tasks of the paper: games that are won by remembering, with a summary of the history as privileged entry.

The summary says only what a player with a perfect memory knows: never a ship, a mine or a card that was not shown.  POPGym
(extra ``popgym``) is imported when a task is made.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.actions import FlattenMultiDiscrete
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites.extras import import_extra
from sb3_gac.envs.wrappers import Observation, PreviousAction, reset_with

LEVELS = ("Easy", "Medium", "Hard")


def _one_hot(values: np.ndarray, n_values: int) -> np.ndarray:
    """
    :param values: integers from 0 to ``n_values`` - 1, of any shape
    :param n_values: number of different integers
    :return: one-hot vectors of all values, end to end, shape (number of values * n_values,)
    """
    return np.eye(n_values, dtype=np.float32)[np.ravel(values)].ravel()


class Summary(ABC):
    """
    The knowledge of a player with a perfect memory, as a vector in [0, 1].

    :param game: game of POPGym
    """

    size: int

    def __init__(self, game: Any):
        self.game = game

    @abstractmethod
    def of(self, observation: Any) -> np.ndarray:
        """
        Summarise the game after its newest observation.

        :param observation: newest observation of the game
        :return: summary of the game so far, float32, shape (size,)
        """


class CardToName(Summary):
    """Autoencode and RepeatPrevious: the suit that is to be named now, one of four or none yet."""

    size = 5

    def of(self, observation: Any) -> np.ndarray:
        """
        :param observation: newest observation of the game, which is not read
        :return: one-hot suit to be named, the last component for none, shape (5,)
        """
        card = self._card()
        named = np.zeros(5, dtype=np.float32)
        named[4 if card is None else self.game.deck.suits_idx[card]] = 1.0
        return named

    @abstractmethod
    def _card(self) -> Any:
        """The card whose suit is to be named, ``None`` if there is none."""


class LastCardLeft(CardToName):
    """Autoencode: once all cards were shown, they are named in reverse order."""

    def _card(self) -> Any:
        cards = self.game.deck["system"]
        return cards[-1] if int(self.game.mode) == 0 and cards else None


class CardBefore(CardToName):
    """RepeatPrevious: the card k steps ago."""

    def _card(self) -> Any:
        shown, k = self.game.deck["player"], self.game.k
        return shown[-k] if len(shown) >= k else None


class Guesses(Summary):
    """
    Battleship: the tiles that were shot at, and on request those of them that were ships.

    :param game: game of POPGym
    :param hits: whether to show the ships that were hit as well
    """

    def __init__(self, game: Any, hits: bool = False):
        super().__init__(game)
        self._hits = hits
        self.size = game.board_size**2 * (2 if hits else 1)

    def of(self, observation: Any) -> np.ndarray:
        """
        :param observation: newest observation of the game, which is not read
        :return: 1 for each tile that was shot at, then, with ``hits``, 1 for each that was a ship, shape (size,)
        """
        planes = [self.game.guesses, self.game.guesses * self.game.board] if self._hits else [self.game.guesses]
        return np.stack(planes).astype(np.float32).ravel()


class SeenFaces(Summary):
    """
    Concentration: the face that was last seen at each position, or that none was seen.

    The faces do not tell which pairs were found, and whether the next card is the first or the second of a pair. Observations
    tell it to a player who remembers; ``table`` tells it at once.

    :param game: game of POPGym
    :param table: whether to show the cards of found pairs and the first card of the next pair as well
    """

    def __init__(self, game: Any, table: bool = False):
        super().__init__(game)
        self._table = table
        self._n_faces = int(game.facedown_card) + 1
        self.size = game.deck.num_cards * (self._n_faces + 2 * table)
        self._seen = np.empty(0, dtype=np.int64)

    def of(self, observation: Any) -> np.ndarray:
        """
        :param observation: face of each card, ``facedown_card`` where it is hidden, shape (number of cards,)
        :return: one-hot face for each position, then, with ``table``, 1 for each card of a found pair, and 1 for the first
            card of the next pair, if it was turned, shape (size,)
        """
        cards, hidden = self.game.deck, self.game.facedown_card
        if self.game.curr_step == 0:
            self._seen = np.full(cards.num_cards, hidden, dtype=np.int64)
        self._seen = np.where(observation == hidden, self._seen, observation)
        faces = _one_hot(self._seen, self._n_faces)
        if not self._table:
            return faces
        planes = np.zeros((2, cards.num_cards), dtype=np.float32)
        planes[0, cards["face_up_idx"]] = planes[1, cards["in_play_idx"]] = 1.0
        return np.concatenate([faces, *planes])


class ViewedSquares(Summary):
    """
    MineSweeper: the number of mines around each square, or that the square was not viewed.

    :param game: game of POPGym
    """

    VIEWED = 2

    def __init__(self, game: Any):
        super().__init__(game)
        self._n_values = int(game.observation_space.n) + 1
        self.size = int(np.prod(game.dims)) * self._n_values

    def of(self, observation: Any) -> np.ndarray:
        """
        :param observation: newest observation of the game, which is not read
        :return: one-hot number of mines for each square, the last component for squares not viewed, shape (size,)
        """
        viewed = self.game.hidden_grid == self.VIEWED
        return _one_hot(np.where(viewed, self.game.neighbor_grid, self._n_values - 1), self._n_values)


SUMMARIES: dict[str, Callable[..., Summary]] = {
    "Autoencode": LastCardLeft,
    "Battleship": Guesses,
    "Concentration": SeenFaces,
    "MineSweeper": ViewedSquares,
    "RepeatPrevious": CardBefore,
}
TASKS = tuple(f"{game}{level}" for game in SUMMARIES for level in LEVELS)


class SummarisedGame(gym.Wrapper):
    """
    A game with its observation as a vector, ``partial``, and a summary of its history, ``privileged``.

    :param game: game of POPGym
    :param summary: summary of that game
    """

    def __init__(self, game: gym.Env, summary: Summary):
        super().__init__(game)
        self._summary = summary
        partial = spaces.Box(0.0, 1.0, (spaces.flatdim(game.observation_space),), np.float32)
        privileged = spaces.Box(0.0, 1.0, (summary.size,), np.float32)
        self.observation_space = spaces.Dict({PARTIAL: partial, PRIVILEGED: privileged})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: seed of the game, ``None`` to go on with its random numbers
        :param options: options of the game's reset
        :return: observation, info
        """
        observation, info = reset_with(self.env, seed, options)
        return self._views(observation), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """
        :param action: action for the game
        :return: observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._views(observation), float(reward), bool(terminated), bool(truncated), info

    def _views(self, observation: Any) -> Observation:
        partial = spaces.flatten(self.env.observation_space, observation)
        return {PARTIAL: np.asarray(partial, dtype=np.float32), PRIVILEGED: self._summary.of(observation)}


def make_popgym(task: str, previous_reward: bool = False, **summary: Any) -> gym.Env:
    """
    Build a task, whose ``partial`` has the previous action as well.

    :param task: name of the task, one of ``TASKS``
    :param previous_reward: whether ``partial`` has the previous reward beside the previous action
    :param summary: keyword arguments of the game's summary, ``hits=True`` for Battleship, ``table=True`` for Concentration
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if the task is unknown
    :raises ImportError: if POPGym is not installed; the message says how to install it
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {list(TASKS)}, got {task!r}.")
    games = import_extra("popgym.envs", "popgym", f"sb3_gac/popgym-{task}-v0")
    game = getattr(games, task)()
    name = next(name for name in SUMMARIES if task.startswith(name))
    env: gym.Env = SummarisedGame(game, SUMMARIES[name](game, **summary))
    if isinstance(env.action_space, spaces.MultiDiscrete):
        env = FlattenMultiDiscrete(env)
    return PreviousAction(env, reward=previous_reward)


#: Id -> arguments of its registration; the games end by themselves
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/popgym-{task}-v0": {"entry_point": f"{__name__}:make_popgym", "kwargs": {"task": task}} for task in TASKS
}
