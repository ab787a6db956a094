"""POPGym's games with summaries: what they tell, and what they never do."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import sb3_gac.envs
from sb3_gac.envs.popgym import LEVELS, TASKS, make_popgym

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


def test_concentration_tells_the_faces_that_were_seen():
    seen = {}
    for game, obs, action, *_ in _play("ConcentrationEasy", _random):
        faces = obs["privileged"].reshape(52, -1).argmax(axis=1)
        assert faces.tolist() == [seen.get(position, game.facedown_card) for position in range(52)]
        seen[int(action)] = int(game.deck_idx_type[game.deck.idx[int(action)]])
    assert len(seen) < 52, "some were never turned"


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


def test_the_previous_action_is_seen():
    for _, _, action, reward, after, *_ in _play("RepeatPreviousEasy", _random, previous_reward=True):
        assert after["partial"].shape == (4 + 4 + 1,)
        assert after["partial"][4:8].argmax() == action
        assert after["partial"][8] == np.float32(reward)


def test_unknown_tasks_are_refused():
    with pytest.raises(ValueError, match="task must be one of"):
        make_popgym("CountRecallEasy")
