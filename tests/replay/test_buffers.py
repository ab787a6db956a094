"""The compact buffer holds and returns exactly what a list of transitions would, in half the memory."""

import numpy as np
import psutil
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.episodes import EpisodeReplayBuffer
from tests.helpers import TwoViewBandit, small_model
from tests.plain.replay import PlainReplay, Recorded

SPACE = spaces.Dict(
    partial=spaces.Box(-np.inf, np.inf, (2,), np.float32),
    image=spaces.Box(0, 255, (1, 2, 2), np.uint8),
    privileged=spaces.Box(-np.inf, np.inf, (3,), np.float32),
    phase=spaces.Discrete(7),
)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


class Feeder:
    """Feeds a buffer with episodes of random lengths, and keeps every transition in a list of its own."""

    def __init__(self, buffer, n_envs, seed=0, p_end=0.2, p_reset=0.0):
        self.buffer, self.n_envs, self.p_end, self.p_reset = buffer, n_envs, p_end, p_reset
        self.rng = np.random.default_rng(seed)
        self.count = 0
        self.transitions: list[list[dict]] = []  # one list per step, one entry per environment
        self.obs = self._observation()

    def _observation(self):
        """Every observation is unlike any other."""
        self.count += 1
        ids = self.count * self.n_envs + np.arange(self.n_envs)
        return {
            "partial": np.stack([ids, -ids], axis=1).astype(np.float32),
            "image": np.stack([[[[i % 256, i // 256 % 256], [1, 2]]] for i in ids]).astype(np.uint8),
            "privileged": np.stack([ids, ids + 0.5, ids + 0.25], axis=1).astype(np.float32),
            "phase": (ids % 7).astype(np.int64),
        }

    def step(self):
        following, fresh = self._observation(), self._observation()
        action = self.rng.uniform(-1, 1, (self.n_envs, 2)).astype(np.float32)
        reward = self.rng.standard_normal(self.n_envs).astype(np.float32)
        done = self.rng.random(self.n_envs) < self.p_end
        timeout = done & (self.rng.random(self.n_envs) < 0.5)
        infos = [{"TimeLimit.truncated": bool(value)} for value in timeout]
        self.buffer.add(dict(self.obs), dict(following), action, reward, done, infos)
        columns = {"action": action, "reward": reward, "done": done & ~timeout, "ended": done}
        self.transitions.append(
            [
                {
                    "obs": {key: value[i] for key, value in self.obs.items()},
                    "next": {key: value[i] for key, value in following.items()},
                    **{key: value[i] for key, value in columns.items()},
                }
                for i in range(self.n_envs)
            ]
        )
        reset = done | (self.rng.random() < self.p_reset)
        for i in np.flatnonzero(reset & ~done):
            self.transitions[-1][i]["ended"] = True
        self.obs = {key: np.where(_like(reset, value), fresh[key], value) for key, value in following.items()}

    def kept(self):
        return self.transitions[-self.buffer.buffer_size :]


def _like(flags, values):
    return flags.reshape(-1, *[1] * (values.ndim - 1))


def _make(capacity, n_envs, **kwargs):
    return CompactDictReplayBuffer(capacity * n_envs, SPACE, ACTIONS, device="cpu", n_envs=n_envs, **kwargs)


def _by_id(feeder):
    return {
        int(transition["obs"]["partial"][0]): (step, env, transition)
        for step, row in enumerate(feeder.kept())
        for env, transition in enumerate(row)
    }


@given(
    capacity=st.integers(1, 12),
    n_envs=st.integers(1, 3),
    n_steps_added=st.integers(1, 60),
    p_end=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    p_reset=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None, max_examples=60)
def test_returns_exactly_what_was_added(capacity, n_envs, n_steps_added, p_end, p_reset, seed):
    buffer = _make(capacity, n_envs)
    feeder = Feeder(buffer, n_envs, seed, p_end, p_reset)
    for _ in range(n_steps_added):
        feeder.step()
    assert buffer.size() == min(n_steps_added, capacity)
    wanted = _by_id(feeder)
    batch = buffer.sample(300)
    ids = batch.observations["partial"][:, 0].int().tolist()
    assert set(ids) <= set(wanted), "only what is still kept"
    if len(wanted) <= 10:
        assert set(ids) == set(wanted), "and all of it"
    for i, key in enumerate(ids):
        transition = wanted[key][2]
        for entry in SPACE.spaces:
            for name, tensors in (("obs", batch.observations), ("next", batch.next_observations)):
                np.testing.assert_array_equal(tensors[entry][i].numpy().ravel(), np.ravel(transition[name][entry]))
        np.testing.assert_array_equal(batch.actions[i], transition["action"])
        assert batch.rewards[i].item() == transition["reward"]
        assert batch.dones[i].item() == transition["done"], "a time limit is not a termination"
    assert batch.discounts is None


@given(
    capacity=st.integers(1, 12),
    n_envs=st.integers(1, 3),
    n=st.integers(2, 5),
    n_steps_added=st.integers(1, 40),
    p_reset=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None, max_examples=60)
def test_n_step_targets_match_brute_force(capacity, n_envs, n, n_steps_added, p_reset, seed):
    buffer = _make(capacity, n_envs, n_steps=n, gamma=0.9)
    feeder = Feeder(buffer, n_envs, seed, p_reset=p_reset)
    for _ in range(n_steps_added):
        feeder.step()
    kept, wanted = feeder.kept(), _by_id(feeder)
    batch = buffer.sample(100)
    for i, key in enumerate(batch.observations["partial"][:, 0].int().tolist()):
        step, env, transition = wanted[key]
        reward, discount = 0.0, 1.0
        for row in kept[step : step + n]:
            transition = row[env]
            reward += discount * transition["reward"]
            discount *= 0.9
            if transition["ended"]:
                break
        assert batch.rewards[i].item() == pytest.approx(reward, rel=1e-5, abs=1e-6)
        assert batch.discounts[i].item() == pytest.approx(discount, rel=1e-5)
        assert batch.dones[i].item() == transition["done"]
        np.testing.assert_array_equal(batch.next_observations["partial"][i], transition["next"]["partial"])


def test_shows_what_sb3s_buffer_shows():
    """Before the ring wraps, arrays equal those of the buffer that stores everything twice."""
    compact = _make(20, 2)
    twice = DictReplayBuffer(40, SPACE, ACTIONS, device="cpu", n_envs=2)
    feeders = [Feeder(buffer, 2, seed=3) for buffer in (compact, twice)]
    for _ in range(15):
        for feeder in feeders:
            feeder.step()
    assert (compact.pos, compact.full, compact.size()) == (twice.pos, twice.full, twice.size())
    for name in ("actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(compact, name)[:15], getattr(twice, name)[:15])
    for name in ("observations", "next_observations"):
        for key in SPACE.spaces:
            np.testing.assert_array_equal(getattr(compact, name)[key][:15], getattr(twice, name)[key][:15])


@pytest.mark.parametrize("name", ["observations", "next_observations", "dones", "timeouts"])
def test_arrays_that_are_put_together_can_not_be_written_to(name):
    """The values written would be in no batch."""
    buffer = _make(20, 2)
    feeder = Feeder(buffer, 2)
    for _ in range(5):
        feeder.step()
    shown = getattr(buffer, name)
    for values in shown.values() if isinstance(shown, dict) else [shown]:
        with pytest.raises(ValueError, match="read-only"):
            values[:] = 1
    buffer.rewards[:] = 7.0
    assert buffer.sample(4).rewards.unique().tolist() == [7.0]


def test_samples_are_uniform_over_steps_and_environments():
    buffer = _make(5, 2)
    feeder = Feeder(buffer, 2)
    for _ in range(8):
        feeder.step()
    np.random.seed(0)
    ids = buffer.sample(20_000).observations["partial"][:, 0].int().numpy()
    _, counts = np.unique(ids, return_counts=True)
    assert len(counts) == 10
    assert np.abs(counts / 20_000 - 0.1).max() < 0.01


def test_types_and_shapes_are_those_of_sb3s_buffer():
    compact, twice = _make(20, 2), DictReplayBuffer(40, SPACE, ACTIONS, device="cpu", n_envs=2)
    for buffer in (compact, twice):
        feeder = Feeder(buffer, 2)
        for _ in range(10):
            feeder.step()
    ours, theirs = compact.sample(8), twice.sample(8)
    for name in ("actions", "rewards", "dones"):
        assert (getattr(ours, name).shape, getattr(ours, name).dtype) == (
            getattr(theirs, name).shape,
            getattr(theirs, name).dtype,
        )
    for name in ("observations", "next_observations"):
        for key in SPACE.spaces:
            mine, other = getattr(ours, name)[key], getattr(theirs, name)[key]
            assert (mine.shape, mine.dtype) == (other.shape, other.dtype)


def test_survives_a_pickle(tmp_path):
    buffer = _make(7, 2)
    feeder = Feeder(buffer, 2)
    for _ in range(20):
        feeder.step()
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    feeder.buffer = loaded = load_from_pkl(tmp_path / "buffer.pkl")
    for _ in range(5):
        feeder.step()
    wanted = _by_id(feeder)
    batch = loaded.sample(100)
    for i, key in enumerate(batch.observations["partial"][:, 0].int().tolist()):
        np.testing.assert_array_equal(batch.next_observations["partial"][i], wanted[key][2]["next"]["partial"])


def test_float16_storage_rounds_floats_alone():
    buffer = _make(50, 2, storage_dtype="float16")
    feeder = Feeder(buffer, 2)
    for _ in range(30):
        feeder.step()
    batch = buffer.sample(64)
    assert batch.observations["privileged"].dtype == th.float32
    assert batch.observations["image"].dtype == th.uint8
    wanted = {float(np.float16(t["obs"]["partial"][0])): t for row in feeder.kept() for t in row}
    for i, key in enumerate(batch.observations["partial"][:, 0].tolist()):
        np.testing.assert_allclose(batch.observations["privileged"][i], wanted[key]["obs"]["privileged"], rtol=1e-3)
    assert not (buffer.endings == 4).any(), "rounding does not look like a reset from outside"


@pytest.mark.parametrize("n_envs", [1, 4])
def test_memory_is_about_half_and_linear_in_the_capacity(n_envs):
    wide = spaces.Dict(partial=spaces.Box(-1, 1, (169,)), privileged=spaces.Box(-1, 1, (270,)))
    humanoid_actions = spaces.Box(-0.4, 0.4, (17,))
    twice = DictReplayBuffer(40_000, wide, humanoid_actions, n_envs=n_envs)
    arrays = [*twice.observations.values(), *twice.next_observations.values()]
    arrays += [twice.actions, twice.rewards, twice.dones, twice.timeouts]
    sizes = []
    for capacity in (20_000, 40_000):
        compact = CompactDictReplayBuffer(capacity, wide, humanoid_actions, n_envs=n_envs)
        sizes.append(compact.nbytes())
    assert sizes[1] <= 0.52 * sum(array.nbytes for array in arrays)
    assert sizes[1] / sizes[0] == pytest.approx(2.0, rel=1e-2)


def test_final_observations_do_not_pile_up():
    buffer = _make(50, 2)
    feeder = Feeder(buffer, 2, p_end=0.1)
    for _ in range(2_000):
        feeder.step()
    assert len(buffer._finals) <= 100
    assert len(buffer._finals._times) <= 4 * 100


def test_many_environments_end_at_once():
    """More final observations in one step than there were before it."""
    buffer = _make(6, 40)
    feeder = Feeder(buffer, 40, p_end=0.9)
    for _ in range(9):
        feeder.step()
    wanted = _by_id(feeder)
    batch = buffer.sample(500)
    for i, key in enumerate(batch.observations["partial"][:, 0].int().tolist()):
        np.testing.assert_array_equal(batch.next_observations["partial"][i], wanted[key][2]["next"]["partial"])


@pytest.mark.parametrize("n_envs", [1, 4])
def test_too_large_a_buffer_is_refused_with_the_numbers(n_envs, monkeypatch):
    """Those of all environments together: a quarter of them would fit."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 200_000}))
    with pytest.raises(MemoryError, match=r"10,000 transitions needs 0\.00 GB.*lower buffer_size to at most 4,444"):
        _make(10_000 // n_envs, n_envs)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_works_with_vec_normalize(n_steps):
    """Observations and next ones, clipped, and sums of normalised, clipped rewards, all by hand."""
    envs = [Recorded() for _ in range(2)]
    env = VecNormalize(DummyVecEnv([lambda env=env: env for env in envs]), clip_obs=1.3, clip_reward=0.9)
    model = small_model(env, learning_starts=1000, n_steps=n_steps, gamma=0.8).learn(60)
    samples = model.replay_buffer.sample(100, env=env)
    plain = PlainReplay(envs, env, n_steps, 0.8).batch(samples)
    for ours, by_hand in ((samples.observations, plain.observations), (samples.next_observations, plain.next_observations)):
        for key, value in by_hand.items():
            np.testing.assert_allclose(ours[key], value, rtol=1e-4, atol=1e-5)
            assert (value.abs() == 1.3).any()
    np.testing.assert_allclose(samples.rewards[:, 0], plain.rewards, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(samples.actions, plain.actions, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(samples.dones[:, 0], plain.terminated)
    assert plain.rewards.abs().max() >= 0.9
    if n_steps > 1:
        np.testing.assert_allclose(samples.discounts[:, 0], plain.discounts, rtol=1e-5)
        assert len(np.unique(plain.discounts)) == n_steps


def test_is_gacs_default_and_takes_its_n_steps(tmp_path):
    model = small_model(TwoViewBandit(length=5), n_steps=3, gamma=0.9)
    assert isinstance(model.replay_buffer, CompactDictReplayBuffer)
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 0.9)
    model.learn(60)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=TwoViewBandit())
    assert (loaded.n_steps, loaded.replay_buffer.n_steps) == (3, 3)
    assert loaded.replay_buffer_kwargs == {}


def test_an_outside_reset_keeps_the_last_transition_whole():
    """learn() with reset_num_timesteps=True resets the environments in the middle of an episode."""
    model = small_model(TwoViewBandit(length=100), learning_starts=1000)
    model.learn(10)
    reached = {key: value.copy() for key, value in model._last_obs.items()}
    model.learn(10)
    np.testing.assert_array_equal(model.replay_buffer.next_observations["partial"][9], reached["partial"])
    assert model.replay_buffer.dones[9, 0] == 0


class Unchanging(TwoViewBandit):
    """Every observation is the same."""

    def _draw(self):
        return {key: np.zeros_like(value) for key, value in super()._draw().items()}


def test_learning_again_cuts_an_episode_even_where_no_observation_tells():
    model = small_model(Unchanging(length=100), learning_starts=1000, n_steps=3)
    model.learn(5)
    model.learn(3, reset_num_timesteps=False)
    assert not model.replay_buffer.endings.any(), "the episode went on"
    model.learn(5)
    assert np.flatnonzero(model.replay_buffer.endings[:, 0]).tolist() == [7]


def _add(buffer, reward, done=False):
    constant = {key: np.zeros((buffer.n_envs, *space.shape), space.dtype) for key, space in SPACE.spaces.items()}
    shape = (buffer.n_envs,)
    action, infos = np.zeros((*shape, 2)), [{}] * buffer.n_envs
    buffer.add(constant, constant, action, np.full(shape, reward), np.full(shape, done), infos)


def test_no_sum_of_rewards_crosses_a_cut():
    buffer = _make(10, 2, n_steps=3, gamma=1.0)
    buffer.mark_reset()
    for reward in (1.0, 1.0, 1.0):
        _add(buffer, reward)
    buffer.mark_reset()
    buffer.mark_reset()
    for reward in (100.0, 100.0):
        _add(buffer, reward, done=True)
    buffer.mark_reset()
    assert set(buffer.sample(200).rewards.flatten().tolist()) == {3.0, 2.0, 1.0, 100.0}
    assert buffer.endings[:5, 0].tolist() == [0, 0, 4, 1, 1]
    assert len(buffer._finals) == 2 * 3


@pytest.mark.parametrize("n_steps", [0, -1])
def test_bad_n_steps(n_steps):
    with pytest.raises(ValueError, match="n_steps must be an integer >= 1"):
        small_model(n_steps=n_steps)


def test_memory_is_exactly_linear_in_the_capacity():
    space = spaces.Dict(partial=spaces.Box(-1, 1, (3,), np.float32), privileged=spaces.Box(-1, 1, (5,), np.float32))
    one, two, four = (
        CompactDictReplayBuffer(rows, space, spaces.Box(-1, 1, (2,)), device="cpu").nbytes() for rows in (1_000, 2_000, 4_000)
    )
    per_transition = 4 * (3 + 5 + 2 + 1) + 1
    assert two - one == 1_000 * per_transition
    assert four - two == 2_000 * per_transition


# --- what does not fit -----------------------------------------------------------------------------------------------------

ODD_SPACE = spaces.Dict(
    partial=spaces.Box(-1e9, 1e9, (2, 3), np.float32), gear=spaces.Discrete(4), ticks=spaces.Box(-1e9, 1e9, (6,), np.float64)
)


def _odd_observation(n_envs=2, **changed):
    entries = {
        "partial": np.ones((n_envs, 2, 3), np.float32),
        "gear": np.zeros(n_envs, np.int64),
        "ticks": np.ones((n_envs, 6)),
    }
    return {key: value for key, value in {**entries, **changed}.items() if value is not None}


def _add_pair(buffer, obs, next_obs):
    buffer.add(obs, next_obs, np.zeros((2, 1)), np.zeros(2), np.zeros(2, bool), [{}, {}])


@pytest.mark.parametrize("kind", [CompactDictReplayBuffer, EpisodeReplayBuffer])
@pytest.mark.parametrize("which", ["obs", "next_obs"])
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"partial": np.ones((2, 3, 2), np.float32)}, r'entry "partial" in the shape \(2, 2, 3\).*got \(2, 3, 2\)'),
        ({"partial": np.ones((2, 6), np.float32)}, r'entry "partial" in the shape \(2, 2, 3\).*got \(2, 6\)'),
        ({"partial": np.ones((2, 3, 2, 3), np.float32)}, r'entry "partial" in the shape'),
        ({"ticks": np.ones((6, 2))}, r'entry "ticks" in the shape \(2, 6\).*got \(6, 2\)'),
        ({"ticks": np.ones((2, 3))}, r'entry "ticks" in the shape'),
        ({"ticks": np.ones((1, 12))}, r'entry "ticks" in the shape'),
        ({"gear": np.zeros((2, 2), np.int64)}, r'entry "gear" in the shape'),
        (
            {"gear": None},
            r"stores the entries \['gear', 'partial', 'ticks'\], but got an observation with \['partial', 'ticks'\]",
        ),
        ({"camera": np.zeros((2, 3))}, r"got an observation with \['camera', "),
    ],
)
def test_what_has_another_shape_or_name_is_not_reshaped_until_it_fits(kind, which, changed, said):
    buffer = kind(20, ODD_SPACE, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2)
    _add_pair(buffer, _odd_observation(), _odd_observation())
    before = {name: array.copy() for name, array in buffer.rows_by_name().items()}
    pair = {"obs": _odd_observation(), "next_obs": _odd_observation(), which: _odd_observation(**changed)}
    with pytest.raises(ValueError, match=said):
        _add_pair(buffer, **pair)
    assert buffer.pos == 1
    for name, array in buffer.rows_by_name().items():
        np.testing.assert_array_equal(array, before[name])
    _add_pair(buffer, _odd_observation(gear=np.zeros((2, 1), np.int64)), _odd_observation())
    assert buffer.pos == 2


@pytest.mark.parametrize("key", ["partial", "ticks"])
@pytest.mark.parametrize("value", [65_520.0, -1e6, np.float32(3e38), 70_000])
def test_what_float16_cannot_hold_is_refused_by_name(key, value):
    buffer = CompactDictReplayBuffer(20, ODD_SPACE, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2, storage_dtype="float16")
    largest = {name: entry.copy() for name, entry in _odd_observation().items()}
    largest[key].flat[3] = -65_504.0
    _add_pair(buffer, largest, largest)
    too_large = _odd_observation()
    too_large[key] = too_large[key].astype(type(value) if isinstance(value, int) else too_large[key].dtype)
    too_large[key].flat[3] = value
    with pytest.raises(ValueError, match=rf'"{key}" holds .*replay_buffer_kwargs=.*"storage_dtype": "float16".*up to 65504'):
        _add_pair(buffer, largest, too_large)
    assert buffer.pos == 1
    assert np.isfinite(buffer.observations[key]).all()


def test_a_buffer_that_was_saved_before_shapes_were_compared(tmp_path):
    buffer = CompactDictReplayBuffer(20, ODD_SPACE, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2)
    _add_pair(buffer, _odd_observation(), _odd_observation())
    del buffer.layout._given_shapes
    save_to_pkl(tmp_path / "buffer", buffer)
    loaded = load_from_pkl(tmp_path / "buffer")
    _add_pair(loaded, _odd_observation(), _odd_observation(gear=np.zeros((2, 1), np.int64)))
    assert loaded.pos == 2


def test_counted_entries_are_not_stored_in_float16():
    buffer = CompactDictReplayBuffer(20, ODD_SPACE, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2, storage_dtype="float16")
    _add_pair(buffer, _odd_observation(gear=np.array([3, 1])), _odd_observation())
    np.testing.assert_array_equal(buffer.observations["gear"][0].ravel(), [3, 1])


@pytest.mark.parametrize("given", ["int8", "flaot16"])
def test_a_storage_dtype_that_is_none(given):
    said = f'storage_dtype must be a floating-point type such as "float16", or None, got "{given}"'
    with pytest.raises(ValueError, match=said):
        CompactDictReplayBuffer(20, ODD_SPACE, spaces.Box(-1, 1, (1,)), "cpu", storage_dtype=given)


def test_a_number_of_steps_that_is_none():
    with pytest.raises(ValueError, match=r"n_steps must be an integer >= 1, got 3\.0"):
        _make(20, 1, n_steps=3.0)


@pytest.mark.parametrize("kind", [CompactDictReplayBuffer, EpisodeReplayBuffer])
def test_a_step_whose_storing_was_interrupted_is_as_if_it_had_not_been(kind, monkeypatch):
    """An interrupt comes between any two lines: here, after an episode's last observation was kept."""
    buffer = kind(20, ODD_SPACE, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2)
    a, b, c, d = (_odd_observation(ticks=np.full((2, 6), float(number))) for number in range(4))
    _add_pair(buffer, a, b)
    monkeypatch.setattr(buffer, "_keep_finals", _then_interrupt(buffer._keep_finals))
    with pytest.raises(KeyboardInterrupt):
        buffer.add(b, c, np.zeros((2, 1)), np.zeros(2), np.ones(2, bool), [{}, {}])
    monkeypatch.undo()
    buffer.mark_reset()
    buffer.add(c, d, np.zeros((2, 1)), np.zeros(2), np.ones(2, bool), [{}, {}])
    assert buffer.pos == 2
    np.testing.assert_array_equal(buffer.next_observations["ticks"][:2, 0, 0], [1.0, 3.0])


def _then_interrupt(method):
    def interrupted(*args):
        method(*args)
        raise KeyboardInterrupt

    return interrupted


@pytest.mark.parametrize("n_added", [0, 1, 6, 7, 8, 9, 14, 15, 20])
def test_a_restored_buffer_is_where_the_other_one_was(n_added):
    """Seven transitions fit: before it is full, just when it is, and after."""
    feeder, again = Feeder(_make(7, 2), 2, seed=1), _make(7, 2)
    for _ in range(n_added):
        feeder.step()
    again.restore_bookkeeping(feeder.buffer.bookkeeping())
    assert [(b.pos, b.full, b.size(), b.n_added) for b in (again,)] == [
        (b.pos, b.full, b.size(), b.n_added) for b in (feeder.buffer,)
    ]
    assert again.full == (n_added >= 7)
