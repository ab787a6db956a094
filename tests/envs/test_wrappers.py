"""Wrappers: what they show, the statistics of the noise, the contents of a history, and what they refuse."""

import pickle
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecTransposeImage

from sb3_gac.envs import (
    DroppedFrames,
    FlattenMultiDiscrete,
    History,
    SensorDelay,
    SensorNoise,
    SplitDictObservation,
    SplitObservation,
)


def _box(*shape, dtype=np.float32):
    return spaces.Box(0, 255 if dtype == np.uint8 else 10_000, shape, dtype)


FLAT = _box(6, dtype=np.float64)
PAIR = spaces.Dict(partial=_box(2), privileged=_box(3))
IMAGE = spaces.Dict(partial=_box(1, 36, 36, dtype=np.uint8), privileged=_box(3))
NUMBER = spaces.Dict(partial=_box(), privileged=_box())
GOAL = spaces.Dict(
    achieved_goal=_box(2, dtype=np.float64), desired_goal=_box(2, dtype=np.float64), observation=_box(6, dtype=np.float64)
)
NO_ACTION = np.zeros(1, dtype=np.float32)


class Fake(gym.Env):
    """Component i of entry j is 100 * episode + 10 * step + i + j / 4; the reward is random."""

    def __init__(self, observation_space, action_space=None):
        self.observation_space = observation_space
        self.action_space = action_space or spaces.Box(-1, 1, (1,), np.float32)
        self.episode = -1
        self.steps = 0
        self.reset_keywords = {}

    def reset(self, **keywords):
        self.reset_keywords = keywords
        super().reset(**keywords)
        self.episode = 0 if "seed" in keywords else self.episode + 1
        self.steps = 0
        return self._observe(), {}

    def step(self, action):
        self.steps += 1
        return self._observe(), self.np_random.normal(), False, self.steps == 5, {}

    def _observe(self):
        self.latest = self._fill(self.observation_space)
        return self.latest

    def _fill(self, space, offset=0.0):
        if isinstance(space, spaces.Dict):
            return {key: self._fill(entry, j / 4) for j, (key, entry) in enumerate(space.items())}
        return (self._count() + np.arange(np.prod(space.shape)) + offset).astype(space.dtype).reshape(space.shape)

    def _count(self):
        return 100 * self.episode + 10 * self.steps


class Strict(Fake):
    """An environment as the checkers want it: with the signature of ``gymnasium.Env.reset``."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed) if seed is not None else super().reset()


class Still(Strict):
    """Its observation never changes."""

    def _count(self):
        return 0


class Reusing(Strict):
    """Writes every observation into the same arrays."""

    buffers = None

    def _observe(self):
        self.buffers = self.buffers or super()._observe()
        for key, value in super()._observe().items():
            self.buffers[key][...] = value
        return dict(self.buffers)


def _split(env):
    return SplitObservation(env, partial=range(2), privileged=range(6))


CHAINS = {
    "split": (FLAT, _split),
    "split dict": (GOAL, lambda env: SplitDictObservation(env, ["observation", "desired_goal"], {"achieved_goal": [1]})),
    "noise": (PAIR, lambda env: SensorNoise(env, 0.1)),
    "noise, privileged": (PAIR, lambda env: SensorNoise(env, 0.1, key="privileged")),
    "no noise": (PAIR, lambda env: SensorNoise(env, 0.0)),
    "history": (PAIR, lambda env: History(env, 3)),
    "history of images": (IMAGE, lambda env: History(env, 3)),
    "split, noise, history": (FLAT, lambda env: History(SensorNoise(_split(env), 0.1), 3, actions=True)),
    "split, history, noise": (FLAT, lambda env: SensorNoise(History(_split(env), 3, key="privileged"), 0.1)),
    "history, history": (PAIR, lambda env: History(History(env, 2, actions=True), 2)),
    "delay": (PAIR, lambda env: SensorDelay(env, 2)),
    "delay of images": (IMAGE, lambda env: SensorDelay(env, 1)),
    "drops": (PAIR, lambda env: DroppedFrames(env, 0.5)),
    "noise, delay, drops, history": (
        PAIR,
        lambda env: History(DroppedFrames(SensorDelay(SensorNoise(env, 0.1), 2), 0.5), 3, actions=True),
    ),
    "noise, noise": (PAIR, lambda env: SensorNoise(SensorNoise(env, 0.1), 0.1, key="privileged")),
}
chains = pytest.mark.parametrize(("space", "wrap"), CHAINS.values(), ids=CHAINS.keys())


def _same(first, second):
    return first.keys() == second.keys() and all(np.array_equal(first[key], second[key]) for key in first)


# --- every wrapper ---------------------------------------------------------------------------------------------------


@chains
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*Box observation space (minimum|maximum) value is -?infinity")
@pytest.mark.filterwarnings("error")
def test_passes_both_environment_checkers(space, wrap):
    gymnasium_check_env(wrap(Strict(space)), skip_render_check=True)
    sb3_check_env(wrap(Strict(space)), skip_render_check=True)


@chains
def test_observations_belong_to_the_space(space, wrap):
    env = wrap(Strict(space))
    observations = [env.reset(seed=0)[0], *(env.step(env.action_space.sample())[0] for _ in range(5)), env.reset()[0]]
    for observation in observations:
        assert observation in env.observation_space
        assert {key: value.dtype for key, value in observation.items()} == {
            key: entry.dtype for key, entry in env.observation_space.items()
        }


@chains
def test_goes_on_after_pickling_as_if_it_had_not_been_pickled(space, wrap):
    env = wrap(Strict(space))
    env.reset(seed=1)
    env.step(NO_ACTION + 0.5)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        (first, reward, *_), (second, copied_reward, *_) = env.step(NO_ACTION), copy.step(NO_ACTION)
        assert _same(first, second)
        assert reward == copied_reward
    assert _same(env.reset()[0], copy.reset()[0])


def _number_actions(env):
    env.action_space = spaces.MultiDiscrete([2, 3])
    return FlattenMultiDiscrete(env)


@pytest.mark.parametrize(("space", "wrap"), [*CHAINS.values(), (FLAT, _number_actions)], ids=[*CHAINS, "numbered actions"])
@pytest.mark.parametrize("given", [{}, {"seed": 3}, {"options": {"a": 1}}, {"seed": 3, "options": {"a": 1}}])
def test_passes_on_only_the_reset_keywords_it_was_given(space, wrap, given):
    env = wrap(Fake(space))
    env.reset(**given)
    assert env.unwrapped.reset_keywords == given


# --- splits ----------------------------------------------------------------------------------------------------------


def test_split_shows_the_chosen_components_with_their_bounds():
    inner = Strict(spaces.Box(-np.arange(6.0), 1000 + np.arange(6.0), dtype=np.float64))
    env = SplitObservation(inner, partial=(4, 1), privileged=np.array([0, 1, 5]))
    assert env.observation_space["partial"] == spaces.Box(np.float32([-4, -1]), np.float32([1004, 1001]))
    assert env.observation_space["privileged"] == spaces.Box(np.float32([0, -1, -5]), np.float32([1000, 1001, 1005]))
    env.reset(seed=0)
    observation, *_ = env.step(NO_ACTION)
    assert _same(observation, {"partial": np.float32([14, 11]), "privileged": np.float32([10, 11, 15])})
    assert {value.dtype for value in observation.values()} == {np.dtype(np.float32)}


def test_split_dict_by_keys_joins_them_in_the_order_given():
    env = SplitDictObservation(Strict(GOAL), partial=["observation", "desired_goal"], privileged=["achieved_goal"])
    observation, _ = env.reset(seed=0)
    assert _same(
        observation, {"partial": np.float32([0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 0.25, 1.25]), "privileged": np.float32([0, 1])}
    )
    assert {key: value.dtype for key, value in observation.items()} == {"partial": np.float32, "privileged": np.float32}


def test_split_dict_by_indices_takes_them_from_the_flattened_entry():
    space = spaces.Dict(touch=spaces.Box(-1, 1000, (2, 2), np.float64), joints=spaces.Box(-2, 2000, (3,), np.float32))
    env = SplitDictObservation(Strict(space), partial={"touch": [3, 0], "joints": None}, privileged={"joints": [2]})
    assert env.observation_space["partial"] == spaces.Box(
        np.float32([-1, -1, -2, -2, -2]), np.float32([1000, 1000, 2000, 2000, 2000])
    )
    assert env.observation_space["privileged"] == spaces.Box(-2, 2000, (1,))
    first_entry = 0.25 * list(space).index("touch")
    joints = 0.25 - first_entry + np.arange(3)
    observation, _ = env.reset(seed=0)
    expected = {"partial": np.float32([3 + first_entry, first_entry, *joints]), "privileged": np.float32(joints[2:])}
    assert _same(observation, expected)


# --- noise -----------------------------------------------------------------------------------------------------------


def _noise(env, n, seed=0, by="step", key="partial"):
    """``n`` draws of the noise, one per row."""
    clean, _ = env.unwrapped.reset()
    first, _ = env.reset(seed=seed)
    draws = [first, *((env.step(NO_ACTION) if by == "step" else env.reset())[0] for _ in range(n - 1))]
    return np.stack([observation[key] - clean[key] for observation in draws])


def _assert_standard_normal(z):
    """Moments and correlations of the columns within four standard errors of independent N(0, 1)."""
    n = len(z)
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(z.std(axis=0) - 1).max() < 4 / np.sqrt(2 * n)
    within_one = 0.6827
    assert np.abs((np.abs(z) < 1).mean(axis=0) - within_one).max() < 4 * np.sqrt(within_one * (1 - within_one) / n)
    correlations = np.corrcoef(z, rowvar=False) - np.eye(z.shape[1])
    assert np.abs(correlations).max() < 4 / np.sqrt(n)


@pytest.mark.parametrize("by", ["step", "reset"])
@pytest.mark.parametrize("sigma", [0.1, [0.1, 2.0, 0.5]])
def test_noise_is_gaussian_and_independent_between_components_and_steps(sigma, by):
    env = SensorNoise(Still(spaces.Dict(partial=_box(3), privileged=_box(2))), sigma)
    z = _noise(env, 4000, by=by) / sigma
    _assert_standard_normal(np.hstack([z[:-2], z[1:-1], z[2:]]))


def test_noise_on_two_entries_is_independent():
    space = spaces.Dict(partial=_box(2), privileged=_box(2))
    env = SensorNoise(SensorNoise(Still(space), 1.0), 1.0, key="privileged")
    both = np.hstack([_noise(env, 2000, key=key) for key in ("partial", "privileged")])
    _assert_standard_normal(both)


def test_noise_added_twice_to_an_entry_adds_variances():
    z = _noise(SensorNoise(SensorNoise(Still(PAIR), 3.0), 4.0), 2000) / 5
    _assert_standard_normal(z)


def test_noise_changes_its_entry_alone_and_only_where_sigma_is_positive():
    env = SensorNoise(Strict(PAIR), [0.0, 0.5])
    assert env.observation_space["partial"] == spaces.Box(np.float32([0, -np.inf]), np.float32([10_000, np.inf]))
    assert env.observation_space["privileged"] == PAIR["privileged"]
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        clean = env.unwrapped.latest
        assert observation["partial"][0] == clean["partial"][0]
        assert observation["partial"][1] != clean["partial"][1]
        assert np.array_equal(observation["privileged"], clean["privileged"])
        observation, *_ = env.step(NO_ACTION)


def test_sigma_zero_leaves_bounds_and_values():
    env = SensorNoise(Strict(PAIR), 0.0)
    assert env.observation_space == PAIR
    assert _same(env.reset(seed=0)[0], env.unwrapped.latest)
    assert _same(env.step(NO_ACTION)[0], env.unwrapped.latest)


def test_noise_keeps_a_float64_entry_float64():
    env = SensorNoise(Strict(spaces.Dict(partial=_box(2, dtype=np.float64))), 0.1)
    assert env.observation_space["partial"].dtype == env.reset(seed=0)[0]["partial"].dtype == np.float64


def test_noise_on_a_number_gives_an_array():
    env = SensorNoise(Strict(NUMBER), 0.1)
    assert isinstance(env.reset(seed=0)[0]["partial"], np.ndarray)
    assert env.step(NO_ACTION)[0]["partial"].shape == ()


def test_noise_does_not_write_into_the_observation_it_was_given():
    env = SensorNoise(Strict(PAIR), 0.5)
    observation, _ = env.reset(seed=0)
    for count in (0, 10):
        assert np.array_equal(env.unwrapped.latest["partial"], np.float32([count, count + 1]))
        assert observation is not env.unwrapped.latest
        observation, *_ = env.step(NO_ACTION)


def test_noise_is_drawn_once_per_step():
    env = History(SensorNoise(Strict(PAIR), 0.5), 2)
    seen = [env.reset(seed=0)[0], *(env.step(NO_ACTION)[0] for _ in range(4))]
    for earlier, later in pairwise(seen):
        assert np.array_equal(earlier["partial"][2:], later["partial"][:2])


def test_noise_repeats_with_its_seed_and_differs_between_seeds():
    draws = [_noise(SensorNoise(Still(PAIR), 0.1), 4, seed=seed) for seed in (0, 0, 1, 2)]
    assert np.array_equal(draws[0], draws[1])
    assert len({row.tobytes() for seed in (0, 2, 3) for row in draws[seed]}) == 3 * 4
    env = SensorNoise(Still(PAIR), 0.1)
    assert np.array_equal(_noise(env, 4, seed=1), _noise(env, 4, seed=1))  # also where it had been used before


def test_noise_of_a_large_entry_takes_little_memory():
    image = spaces.Dict(partial=_box(3, 84, 84))
    env = SensorNoise(Strict(image), 0.1)
    clean, drawn = Strict(image), np.random.default_rng([0, 0x6E6F697365])
    for seed in (0, None, None, None, None):
        noise = drawn.standard_normal((3, 84, 84), dtype=np.float32) * np.float32(0.1)
        given = {} if seed is None else {"seed": seed}
        np.testing.assert_array_equal(env.reset(**given)[0]["partial"], clean.reset(**given)[0]["partial"] + noise)
    assert len(pickle.dumps(env)) < 2e6


def test_another_noise_std_counts_from_the_next_step_on():
    env = gym.wrappers.TimeLimit(SensorNoise(Still(PAIR), 0.5), 10)
    env.reset(seed=0)
    assert env.step(NO_ACTION)[0]["partial"][0] != 0
    env.set_wrapper_attr("noise_std", [0.0, 0.5])
    seen = env.step(NO_ACTION)[0]["partial"]
    assert seen[0] == 0
    assert seen[1] != 1
    with pytest.raises(ValueError, match="noise_std must be a finite number >= 0"):
        env.set_wrapper_attr("noise_std", -1.0)


def test_noise_goes_on_after_a_reset_without_a_seed():
    env = SensorNoise(Still(PAIR), 0.1)
    first = env.reset(seed=0)[0]["partial"]
    assert not np.array_equal(first, env.reset()[0]["partial"])


def test_noise_without_any_seed_differs_between_environments():
    first, second = (SensorNoise(Still(PAIR), 0.1).reset()[0]["partial"] for _ in range(2))
    assert not np.array_equal(first, second)


def test_noise_is_apart_from_other_generators_with_the_same_seed():
    noise = _noise(SensorNoise(Still(PAIR), 1.0), 1, seed=7)[0]
    for draw in (np.random.default_rng(7).standard_normal(2, dtype=np.float32), np.random.default_rng(7).standard_normal(2)):
        assert np.abs(noise - draw).min() > 1e-3


def test_sigma_does_not_change_the_environment():
    def rewards(sigma):
        env = SensorNoise(Strict(PAIR), sigma)
        result = []
        for seed in (5, None):
            env.reset(seed=seed)
            result += [env.step(NO_ACTION)[1] for _ in range(5)]
        return result

    assert rewards(0.0) == rewards(0.1) == rewards(1.0)


# --- history ---------------------------------------------------------------------------------------------------------


def test_history_of_three():
    env = History(Strict(PAIR), 3)
    assert env.observation_space["partial"] == _box(6)
    assert env.observation_space["privileged"] == PAIR["privileged"]
    seen = [env.reset(seed=0)[0], *(env.step(NO_ACTION)[0] for _ in range(3)), env.reset()[0], env.step(NO_ACTION)[0]]
    assert [observation["partial"].tolist() for observation in seen] == [
        [0, 1, 0, 1, 0, 1],
        [0, 1, 0, 1, 10, 11],
        [0, 1, 10, 11, 20, 21],
        [10, 11, 20, 21, 30, 31],
        [100, 101, 100, 101, 100, 101],
        [100, 101, 100, 101, 110, 111],
    ]
    assert seen[-1]["privileged"].tolist() == [110.25, 111.25, 112.25]


def test_history_of_three_with_the_actions_between_them():
    env = History(Strict(PAIR, spaces.Box(-1, 1, (2,), np.float32)), 3, actions=True)
    box = env.observation_space["partial"]
    assert box.low.tolist() == [0] * 6 + [-np.inf] * 4  # actions may leave their space
    assert box.high.tolist() == [10_000] * 6 + [np.inf] * 4
    seen = [env.reset(seed=0)[0]]
    seen += [env.step(np.array([t, -t], dtype=np.float64))[0] for t in (1, 2, 3)]
    seen += [env.reset()[0], env.step(np.array([0.5, 0.25]))[0]]
    assert [observation["partial"].tolist() for observation in seen] == [
        [0, 1, 0, 1, 0, 1, 0, 0, 0, 0],
        [0, 1, 0, 1, 10, 11, 0, 0, 1, -1],
        [0, 1, 10, 11, 20, 21, 1, -1, 2, -2],
        [10, 11, 20, 21, 30, 31, 2, -2, 3, -3],
        [100, 101, 100, 101, 100, 101, 0, 0, 0, 0],
        [100, 101, 100, 101, 110, 111, 0, 0, 0.5, 0.25],
    ]
    assert {observation["partial"].dtype for observation in seen} == {np.dtype(np.float32)}


def test_history_of_images_joins_them_along_the_first_axis():
    env = History(Strict(spaces.Dict(partial=_box(2, 1, 2, dtype=np.uint8))), 3)
    assert env.observation_space["partial"] == _box(6, 1, 2, dtype=np.uint8)
    env.reset(seed=0)
    env.step(NO_ACTION)
    image = env.step(NO_ACTION)[0]["partial"]
    assert image.dtype == np.uint8
    assert image.tolist() == [[[0, 1]], [[2, 3]], [[10, 11]], [[12, 13]], [[20, 21]], [[22, 23]]]


def test_history_of_images_with_channels_last_is_what_sb3_stacks():
    space = spaces.Dict(partial=_box(8, 9, 3, dtype=np.uint8))
    ours = VecTransposeImage(DummyVecEnv([lambda: History(Strict(space), 2)]))
    stacked = VecTransposeImage(VecFrameStack(DummyVecEnv([lambda: Strict(space)]), 2))
    assert ours.observation_space == stacked.observation_space == spaces.Dict(partial=_box(6, 8, 9, dtype=np.uint8))
    ours.reset()
    stacked.reset()
    for _ in range(3):
        seen, expected = (env.step(NO_ACTION[None])[0]["partial"] for env in (ours, stacked))
        np.testing.assert_array_equal(seen, expected)


def test_history_of_the_privileged_entry_leaves_partial_alone():
    env = History(Strict(PAIR), 2, key="privileged")
    env.reset(seed=0)
    observation, *_ = env.step(NO_ACTION)
    assert observation["partial"].tolist() == [10, 11]
    assert observation["privileged"].tolist() == [0.25, 1.25, 2.25, 10.25, 11.25, 12.25]


def test_history_keeps_its_own_copies():
    env = History(Reusing(PAIR), 3, actions=True)
    action = np.array([0.5], dtype=np.float32)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(action)
    action[:] = 0.75
    third, *_ = env.step(NO_ACTION)
    assert first["partial"].tolist() == [0, 1, 0, 1, 0, 1, 0, 0]
    assert second["partial"].tolist() == [0, 1, 0, 1, 10, 11, 0, 0.5]
    assert third["partial"].tolist() == [0, 1, 10, 11, 20, 21, 0.5, 0]


@settings(max_examples=60, deadline=None)
@given(
    length=st.integers(1, 5),
    size=st.integers(1, 3),
    with_actions=st.booleans(),
    resets=st.lists(st.booleans(), max_size=12),
)
def test_history_ends_with_the_current_observation(length, size, with_actions, resets):
    space = spaces.Dict(partial=_box(size), privileged=_box(1))
    env = History(Strict(space), length, actions=with_actions)
    for move, is_reset in enumerate([True, *resets]):
        if is_reset:
            observation, _ = env.reset()
            values, actions = [env.unwrapped.latest["partial"]] * length, [NO_ACTION] * length
        else:
            actions.append(NO_ACTION + move)
            observation, *_ = env.step(actions[-1])
            values.append(env.unwrapped.latest["partial"])
        partial = observation["partial"]
        assert observation in env.observation_space
        assert np.array_equal(partial[(length - 1) * size : length * size], env.unwrapped.latest["partial"])
        assert np.array_equal(partial[: length * size], np.concatenate(values[-length:]))
        past_actions = actions[len(actions) - length + 1 :] if with_actions else []
        assert partial[length * size :].tolist() == [action.item() for action in past_actions]


# --- what they refuse ------------------------------------------------------------------------------------------------

INTEGERS = spaces.Dict(partial=_box(2, dtype=np.uint8), privileged=_box(1))
NO_BOX = spaces.Dict(partial=spaces.Discrete(3), privileged=_box(1))
SCALAR = spaces.Dict(partial=_box(), privileged=_box(1))
REFUSED = {
    "noise, negative": (PAIR, lambda env: SensorNoise(env, -0.1), "noise_std"),
    "noise, one negative": (PAIR, lambda env: SensorNoise(env, [0.1, -0.1]), "noise_std"),
    "noise, nan": (PAIR, lambda env: SensorNoise(env, float("nan")), "noise_std"),
    "noise, infinite": (PAIR, lambda env: SensorNoise(env, float("inf")), "noise_std"),
    "noise, too many": (PAIR, lambda env: SensorNoise(env, [0.1, 0.1, 0.1]), "noise_std"),
    "noise, unknown key": (PAIR, lambda env: SensorNoise(env, 0.1, key="joints"), '"joints"'),
    "noise, integers": (INTEGERS, lambda env: SensorNoise(env, 0.1), 'floating-point entry, but "partial"'),
    "noise, no box": (NO_BOX, lambda env: SensorNoise(env, 0.1), '"partial" must be a Box'),
    "noise, no dict": (FLAT, lambda env: SensorNoise(env, 0.1), 'no entry "partial"'),
    "noise, a word": (PAIR, lambda env: SensorNoise(env, "much"), "noise_std must be .*'much'"),
    "noise, a mapping": (PAIR, lambda env: SensorNoise(env, {"partial": 0.1}), "noise_std must be"),
    "noise, uneven lists": (PAIR, lambda env: SensorNoise(env, [[0.1], [0.1, 0.2]]), "noise_std must be"),
    "split, a number": (FLAT, lambda env: SplitObservation(env, 3, [0]), "partial must be .* got 3"),
    "split, none": (FLAT, lambda env: SplitObservation(env, [0], None), "privileged must be .* got None"),
    "split, uneven lists": (FLAT, lambda env: SplitObservation(env, [[0], [0, 1]], [0]), "partial must be"),
    "split, used up": (FLAT, lambda env: SplitObservation(env, (i for i in (0, 9)), [0]), r"partial must be .*\[0, 9\]"),
    "split, empty": (FLAT, lambda env: SplitObservation(env, [], [0]), "partial must be"),
    "split, negative index": (FLAT, lambda env: SplitObservation(env, [0], [-1]), "privileged must be .* 0..5"),
    "split, index too large": (FLAT, lambda env: SplitObservation(env, [0, 6], [0]), "partial must be .* 0..5"),
    "split, fraction": (FLAT, lambda env: SplitObservation(env, [0.5], [0]), "partial must be"),
    "split, mask": (FLAT, lambda env: SplitObservation(env, [0], [True] * 6), "privileged must be"),
    "split, nested": (FLAT, lambda env: SplitObservation(env, [[0, 1]], [0]), "partial must be"),
    "split, names": (FLAT, lambda env: SplitObservation(env, "01", [0]), "partial must be"),
    "split, dict": (PAIR, lambda env: SplitObservation(env, [0], [0]), "one-dimensional Box"),
    "split, image": (_box(1, 36, 36), lambda env: SplitObservation(env, [0], [0]), "one-dimensional Box"),
    "split dict, box": (FLAT, lambda env: SplitDictObservation(env, ["a"], ["b"]), "needs a Dict"),
    "split dict, unknown": (GOAL, lambda env: SplitDictObservation(env, ["joints"], ["observation"]), '"joints"'),
    "split dict, empty": (GOAL, lambda env: SplitDictObservation(env, ["observation"], []), "privileged must be"),
    "split dict, string": (GOAL, lambda env: SplitDictObservation(env, "observation", ["observation"]), "partial must be"),
    "split dict, a number": (GOAL, lambda env: SplitDictObservation(env, 3, ["observation"]), "partial must be .* got 3"),
    "split dict, a set": (GOAL, lambda env: SplitDictObservation(env, {"observation"}, ["observation"]), "partial must be"),
    "split dict, an index": (
        GOAL,
        lambda env: SplitDictObservation(env, ["observation"], {"observation": 0}),
        r'privileged\["observation"\] must be .* got 0',
    ),
    "split dict, no box": (NO_BOX, lambda env: SplitDictObservation(env, ["partial"], ["privileged"]), '"partial" must be'),
    "split dict, bad index": (
        GOAL,
        lambda env: SplitDictObservation(env, {"observation": [6]}, ["observation"]),
        r'partial\["observation"\] must be .* 0..5',
    ),
    "history, length 0": (PAIR, lambda env: History(env, 0), "length"),
    "history, length -1": (PAIR, lambda env: History(env, -1), "length"),
    "history, length 2.5": (PAIR, lambda env: History(env, 2.5), "length must be an integer .* got 2.5"),
    "history, length '2'": (PAIR, lambda env: History(env, "2"), "length must be an integer .* got '2'"),
    "history, length True": (PAIR, lambda env: History(env, True), "length must be an integer .* got True"),
    "history, unknown key": (PAIR, lambda env: History(env, 2, key="joints"), '"joints"'),
    "history, no box": (NO_BOX, lambda env: History(env, 2), '"partial" must be a Box'),
    "history, scalar": (SCALAR, lambda env: History(env, 2), "at least one axis"),
    "history, image and actions": (IMAGE, lambda env: History(env, 2, actions=True), "actions=True"),
    "history, integers and actions": (INTEGERS, lambda env: History(env, 2, actions=True), "actions=True"),
}


@pytest.mark.parametrize(("space", "wrap", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_refuses_with_the_culprit_named(space, wrap, message):
    with pytest.raises(ValueError, match=message):
        wrap(Strict(space))


def test_keys_and_lengths_of_numpys_types_are_taken():
    env = SplitDictObservation(Strict(GOAL), np.array(["observation", "desired_goal"]), np.array(["achieved_goal"]))
    assert History(env, np.int64(2)).observation_space["partial"].shape == (2 * (6 + 2),)


def test_history_refuses_to_append_discrete_actions():
    with pytest.raises(ValueError, match="actions=True needs Box actions"):
        History(Strict(PAIR, spaces.Discrete(2)), 2, actions=True)
    assert History(Strict(PAIR, spaces.Discrete(2)), 2).reset(seed=0)[0]["partial"].tolist() == [0, 1, 0, 1]
