"""POPGym's games with summaries: what they tell, and what they never do."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import sb3_gac.envs
from sb3_gac.envs.suites.popgym import LEVELS, TASKS, make_popgym

pytest.importorskip("popgym")

EXACT = {"Autoencode": (103, 207, 311), "RepeatPrevious": (51, 103, 155), "Concentration": (104, 208, 104)}
LONGEST = {"Battleship": (64, 100, 144), "MineSweeper": (14, 30, 54)}


def _play(task, choose, seed=0, **kwargs):
    """All steps of an episode: observation before, action, reward, observation after."""
    env = gym.make(f"sb3_gac/popgym-{task}-v0", **kwargs)
    obs, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    done = False
    while not done:
        action = choose(env, obs)
        after, reward, terminated, truncated, _ = env.step(action)
        yield env.unwrapped, obs, action, reward, after, terminated, truncated
        obs, done = after, terminated or truncated


def _random(env, obs):
    return env.action_space.sample()


def test_there_are_fifteen():
    assert len(TASKS) == 15
    assert sb3_gac.envs.make_popgym is make_popgym


@pytest.mark.parametrize("task", TASKS)
def test_checkers_and_lengths(task):
    check_env(make_popgym(task), skip_render_check=True)
    sb3_check_env(make_popgym(task), warn=False, skip_render_check=True)
    game, level = next((game, level) for game in EXACT | LONGEST for level in range(3) if task == f"{game}{LEVELS[level]}")
    length = len(list(_play(task, _random)))
    assert length == EXACT[game][level] if game in EXACT else length <= LONGEST[game][level]


@pytest.mark.parametrize("task", [task for task in TASKS if task.startswith(("Autoencode", "RepeatPrevious"))])
@pytest.mark.parametrize("seed", [0, 1])
def test_acting_on_the_signal_returns_one(task, seed):
    rewards = [step[3] for step in _play(task, lambda env, obs: int(obs["privileged"].argmax()) % 4, seed)]
    assert sum(rewards) == pytest.approx(1.0)


@pytest.mark.parametrize("task", ["BattleshipEasy", "BattleshipHard"])
def test_battleship_tells_guesses_and_on_request_hits_but_no_ship(task):
    for hits in (False, True):
        guesses, found = set(), set()
        for game, obs, action, *_ in _play(task, _random, hits=hits):
            planes = obs["privileged"].reshape(-1, game.board_size**2)
            assert set(np.flatnonzero(planes[0])) == guesses
            if hits:
                assert set(np.flatnonzero(planes[1])) == found
            guesses.add(int(action))
            if game.board.ravel()[action]:
                found.add(int(action))
        assert len(found) < game.board.sum() or not hits, "ships were left to hide"


@pytest.mark.parametrize(("level", "n_cards", "n_faces"), [("Easy", 52, 2), ("Medium", 104, 2), ("Hard", 52, 13)])
def test_concentration_tells_the_faces_that_were_seen(level, n_cards, n_faces):
    seen = {}
    for game, obs, action, *_ in _play(f"Concentration{level}", _random):
        faces = obs["privileged"].reshape(n_cards, n_faces + 1).argmax(axis=1)
        assert faces.tolist() == [seen.get(position, game.facedown_card) for position in range(n_cards)]
        seen[int(action)] = int(game.deck_idx_type[game.deck.idx[int(action)]])
    assert len(seen) < n_cards, "some were never turned"
    assert set(seen.values()) == set(range(n_faces))


@pytest.mark.parametrize(("level", "n_cards"), [("Easy", 52), ("Medium", 104), ("Hard", 52)])
def test_concentration_tells_on_request_what_lies_on_the_table(level, n_cards):
    """Against a game played from its rules alone: two cards are turned, and stay if their faces are the same."""
    found, first, seen_planes = set(), None, set()
    for game, obs, action, *_ in _play(f"Concentration{level}", _random, table=True):
        planes = obs["privileged"][-2 * n_cards :].reshape(2, n_cards)
        assert [set(np.flatnonzero(plane)) for plane in planes] == [found, {first} - {None}]
        seen_planes.add((bool(found), first is not None))
        card, face = int(action), game.deck_idx_type[game.deck.idx]
        if card in found:
            first = None  # and the turn is over
        elif first is None:
            first = card
        else:
            found |= {first, card} if first != card and face[first] == face[card] else set()
            first = None
    assert len(seen_planes) == 4 or level == "Hard", "with and without pairs, with and without a first card"


@pytest.mark.parametrize(("level", "n_cards"), [("Easy", 52), ("Medium", 104), ("Hard", 156)])
def test_autoencode_tells_no_card_before_all_were_shown_and_then_the_last_one_left(level, n_cards):
    shown, told = [], []
    for _, obs, *_ in _play(f"Autoencode{level}", _random):
        shown.append(int(obs["partial"][2:6].argmax()))
        told.append(int(obs["privileged"].argmax()))
    assert told == [4] * (n_cards - 1) + shown[:n_cards][::-1]


@pytest.mark.parametrize(("level", "k"), [("Easy", 4), ("Medium", 32), ("Hard", 64)])
def test_repeat_previous_tells_no_card_before_one_is_due(level, k):
    shown = []
    for _, obs, *_ in _play(f"RepeatPrevious{level}", _random):
        shown.append(int(obs["partial"][:4].argmax()))
        assert obs["privileged"].argmax() == (shown[-k] if len(shown) >= k else 4)


@pytest.mark.parametrize("task", ["MineSweeperEasy", "MineSweeperHard"])
def test_minesweeper_tells_what_was_viewed_and_no_mine(task):
    for seed in range(5):
        viewed = {}
        for game, obs, action, *_ in _play(task, _random, seed):
            squares = obs["privileged"].reshape(int(np.prod(game.dims)), -1)
            unknown = squares.shape[1] - 1
            assert squares.argmax(axis=1).tolist() == [viewed.get(square, unknown) for square in range(len(squares))]
            if game.hidden_grid.ravel()[action] != 1:
                viewed[int(action)] = int(game.neighbor_grid.ravel()[action])


def _pair_of_cards(env, obs):
    """The first card that lies face down, and then its like."""
    deck = env.unwrapped.deck
    faces = env.unwrapped.deck_idx_type[deck.idx]
    down = [card for card in range(len(faces)) if card not in deck["face_up_idx"]]
    turned = deck["in_play_idx"]
    return next(card for card in down if not turned or (card != turned[0] and faces[card] == faces[turned[0]]))


def _always_the_first_square_without_a_mine(env, obs):
    return int((env.unwrapped.hidden_grid != 1).argmax())


@pytest.mark.parametrize(
    ("game", "choose"),
    [
        ("Battleship", lambda env, obs: 0),
        ("Concentration", lambda env, obs: 0),
        ("MineSweeper", _always_the_first_square_without_a_mine),
    ],
)
@pytest.mark.parametrize("level", LEVELS)
def test_a_horizon_is_a_truncation(game, choose, level):
    steps = list(_play(f"{game}{level}", choose))
    assert len(steps) == (EXACT | LONGEST)[game][LEVELS.index(level)]
    assert steps[-1][5:] == (False, True)


@pytest.mark.parametrize(
    ("task", "choose"),
    [
        ("BattleshipEasy", lambda env, obs: int((env.unwrapped.board * (1 - env.unwrapped.guesses)).argmax())),
        ("ConcentrationEasy", _pair_of_cards),
        ("MineSweeperEasy", lambda env, obs: int((env.unwrapped.hidden_grid == 0).argmax())),
        ("MineSweeperEasy", lambda env, obs: int((env.unwrapped.hidden_grid == 1).argmax())),  # steps on a mine
        ("AutoencodeEasy", _random),
        ("RepeatPreviousEasy", _random),
    ],
)
def test_a_true_end_is_a_termination(task, choose):
    *before, last = _play(task, choose)
    assert last[5], "terminated"
    assert not any(step[5] or step[6] for step in before)


@pytest.mark.parametrize("task", TASKS)
def test_is_picklable_in_the_middle_of_an_episode(task):
    env = gym.make(f"sb3_gac/popgym-{task}-v0")
    env.reset(seed=0)
    env.step(0)
    copy = pickle.loads(pickle.dumps(env))
    for action in (1, 2, 3):
        (first, *rest), (second, *rest_of_copy) = env.step(action), copy.step(action)
        assert all(np.array_equal(first[key], second[key]) for key in ("partial", "privileged"))
        assert rest == rest_of_copy
        if rest[1]:
            return


def test_the_previous_action_is_seen():
    for _, _, action, reward, after, *_ in _play("RepeatPreviousEasy", _random, previous_reward=True):
        assert after["partial"].shape == (4 + 4 + 1,)
        assert after["partial"][4:8].argmax() == action
        assert after["partial"][8] == np.float32(reward)


def test_unknown_tasks_are_refused():
    with pytest.raises(ValueError, match="task must be one of"):
        make_popgym("CountRecallEasy")
