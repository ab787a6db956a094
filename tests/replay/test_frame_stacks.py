"""Stacks of frames: each frame is stored once, and what is sampled is what SB3's buffer samples, to the bit."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl

from sb3_gac.checkpoint.rows import read_rows, write_rows
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.episodes import EpisodeReplayBuffer

#: A stack of three frames of two channels, one of four numbers, and two entries that are no stacks
SPACE = spaces.Dict(
    partial=spaces.Box(0, 255, (6, 2, 3), np.uint8),
    sensors=spaces.Box(-np.inf, np.inf, (4,), np.float32),
    map=spaces.Box(0, 255, (1, 2, 2), np.uint8),
    privileged=spaces.Box(-np.inf, np.inf, (3,), np.float32),
)
STACKS = {"partial": 3, "sensors": 4}
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
PADDINGS = ("first", "zero", "noise")


class Camera:
    """
    Feeds buffers alike, from environments whose stacks are put together here, frame by frame.

    :param padding: what a stack is filled up with when an episode begins: its first frame, zeros, or other frames
    """

    def __init__(self, n_envs, seed, p_end=0.2, p_reset=0.0, p_lost=0.0, padding="first"):
        self.n_envs, self.p_end, self.p_reset, self.p_lost, self.padding = n_envs, p_end, p_reset, p_lost, padding
        self.rng = np.random.default_rng(seed)
        self.envs = [self._begun() for _ in range(n_envs)]

    def _frame(self, key):
        """Few values, so that frames that have nothing to do with each other are equal now and then."""
        shape, dtype = SPACE[key].shape, SPACE[key].dtype
        return self.rng.integers(0, 2, (shape[0] // STACKS.get(key, 1), *shape[1:])).astype(dtype)

    def _begun(self):
        stacks = {}
        for key in SPACE.spaces:
            first = self._frame(key)
            fillers = {"first": lambda key: first, "zero": lambda key: 0 * first, "noise": self._frame}  # noqa: B023
            stacks[key] = [fillers[self.padding](key) for _ in range(STACKS.get(key, 1) - 1)] + [first]
        return stacks

    def _moved_on(self, stacks):
        return {key: [*frames[1:], self._frame(key)] for key, frames in stacks.items()}

    def _observation(self, envs):
        return {key: np.stack([np.concatenate(env[key]) for env in envs]) for key in SPACE.spaces}

    def step(self, *buffers):
        before, after = self.envs, [self._moved_on(env) for env in self.envs]
        done = self.rng.random(self.n_envs) < self.p_end
        infos = [{"TimeLimit.truncated": bool(self.rng.random() < 0.5)} for _ in done]
        action, reward = self.rng.uniform(-1, 1, (self.n_envs, 2)), self.rng.standard_normal(self.n_envs)
        if self.rng.random() >= self.p_lost:  # a step whose storing was refused
            for buffer in buffers:
                buffer.add(self._observation(before), self._observation(after), action, reward, done, infos)
        if self.rng.random() < self.p_reset:
            done[:] = True
            for buffer in buffers:
                if hasattr(buffer, "mark_reset") and self.rng.random() < 0.5:
                    buffer.mark_reset()
        self.envs = [self._begun() if ended else env for ended, env in zip(done, after, strict=True)]


def _make(capacity, n_envs, kind=CompactDictReplayBuffer, **kwargs):
    return kind(capacity * n_envs, SPACE, ACTIONS, device="cpu", n_envs=n_envs, frame_stacks=STACKS, **kwargs)


def _assert_equal_samples(ours, sb3s, n_added, seed=0):
    """All steps that are kept, of environments drawn alike."""
    steps = np.repeat(np.arange(max(n_added - ours.buffer_size, 0), n_added), 2 * ours.n_envs)
    samples = []
    for buffer, rows in ((ours, ours.n_rows), (sb3s, sb3s.buffer_size)):
        np.random.seed(seed)
        samples.append(buffer._get_samples(steps % rows))
    mine, theirs = samples
    for key in SPACE.spaces:
        np.testing.assert_array_equal(mine.observations[key], theirs.observations[key])
        np.testing.assert_array_equal(mine.next_observations[key], theirs.next_observations[key])
        assert mine.observations[key].dtype == theirs.observations[key].dtype
    for name in ("actions", "rewards", "dones"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))


@given(
    capacity=st.integers(1, 12),
    n_envs=st.integers(1, 3),
    n_steps=st.integers(1, 50),
    p_end=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    p_reset=st.sampled_from([0.0, 0.3]),
    p_lost=st.sampled_from([0.0, 0.3]),
    padding=st.sampled_from(PADDINGS),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None, max_examples=60)
def test_samples_are_those_of_sb3s_buffer(capacity, n_envs, n_steps, p_end, p_reset, p_lost, padding, seed):
    ours, sb3s = _make(capacity, n_envs), DictReplayBuffer(capacity * n_envs, SPACE, ACTIONS, "cpu", n_envs)
    camera = Camera(n_envs, seed, p_end, p_reset, p_lost, padding)
    for step in range(n_steps):
        camera.step(ours, sb3s)
        if ours.n_added and (step % 8 == 0 or step == n_steps - 1):
            _assert_equal_samples(ours, sb3s, ours.n_added)


def test_episodes_of_any_length():
    """Longer than an age can count."""
    ours, sb3s = _make(40, 1), DictReplayBuffer(40, SPACE, ACTIONS, "cpu", 1)
    camera = Camera(1, seed=0, p_end=0.0, padding="noise")
    for step in range(270):
        camera.step(ours, sb3s)
        if step in (127, 128, 129, 256, 269):
            _assert_equal_samples(ours, sb3s, ours.n_added)


@pytest.mark.parametrize("how", ["pickle", "checkpoint"])
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("n_before", [0, 1, 5, 9, 23])
def test_a_saved_buffer_goes_on_to_the_bit(how, padding, n_before, tmp_path):
    ours, sb3s = _make(7, 2), DictReplayBuffer(14, SPACE, ACTIONS, "cpu", 2)
    camera = Camera(2, seed=n_before, p_end=0.3, padding=padding)
    for _ in range(n_before):
        camera.step(ours, sb3s)
    if how == "pickle":
        save_to_pkl(tmp_path / "buffer.pkl", ours)
        again = load_from_pkl(tmp_path / "buffer.pkl")
    else:
        again = _make(7, 2)
        again.restore_bookkeeping(ours.bookkeeping())
        read_rows(again, tmp_path, write_rows(ours, tmp_path, None).names)
    for _ in range(12):
        camera.step(ours, again, sb3s)
        _assert_equal_samples(again, sb3s, again.n_added)
    for name, array in ours.rows_by_name().items():
        np.testing.assert_array_equal(array[: ours.n_added], again.rows_by_name()[name][: ours.n_added])


@pytest.mark.parametrize("padding", PADDINGS)
def test_sequences_and_histories_have_whole_stacks(padding):
    camera, plain = Camera(2, seed=1, padding=padding), CompactDictReplayBuffer(60, SPACE, ACTIONS, "cpu", n_envs=2)
    sequences = [
        EpisodeReplayBuffer(60, SPACE, ACTIONS, "cpu", n_envs=2, sequence_length=4, burn_in=2, frame_stacks=stacks)
        for stacks in (None, STACKS)
    ]
    ours = _make(30, 2)
    for _ in range(45):
        camera.step(ours, plain, *sequences)
    drawn = []
    for buffer, n_rows in ((plain, 31), (ours, 34), (sequences[0], 31), (sequences[1], 34)):
        assert buffer.n_rows == n_rows
        np.random.seed(0)
        is_sequence = isinstance(buffer, EpisodeReplayBuffer)
        drawn.append(buffer.sample(64).observations if is_sequence else buffer.sample_with_histories(64, 5)[1].observations)
    for key in SPACE.spaces:
        np.testing.assert_array_equal(drawn[0][key], drawn[1][key])
        np.testing.assert_array_equal(drawn[2][key], drawn[3][key])


def test_memory_is_a_fifth_of_sb3s_with_short_episodes_too():
    """HalfCheetah from three frames of 64 x 64; episodes of 25 steps, each of whose last frames is kept apart."""
    space = spaces.Dict(
        partial=spaces.Box(0, 255, (9, 64, 64), np.uint8), privileged=spaces.Box(-np.inf, np.inf, (17,), np.float32)
    )
    actions = spaces.Box(-1, 1, (6,), np.float32)
    ours = CompactDictReplayBuffer(200, space, actions, "cpu", frame_stacks={"partial": 3})
    sb3s = DictReplayBuffer(200, space, actions, "cpu")
    frames = [np.full((1, 3, 64, 64), 1, np.uint8)] * 3
    state, number = np.zeros((1, 17), np.float32), 1
    for step in range(450):
        number += 1
        stack, frames = np.concatenate(frames, axis=1), [*frames[1:], np.full((1, 3, 64, 64), number % 256, np.uint8)]
        after, done = np.concatenate(frames, axis=1), np.array([step % 25 == 24])
        for buffer in (ours, sb3s):
            observations = ({"partial": images, "privileged": state} for images in (stack, after))
            buffer.add(*observations, np.zeros((1, 6)), np.zeros(1), done, [{}])
        frames = [frames[-1]] * 3 if done else frames
    arrays = [*sb3s.observations.values(), *sb3s.next_observations.values()]
    arrays += [sb3s.actions, sb3s.rewards, sb3s.dones, sb3s.timeouts]
    assert ours.nbytes() <= 0.2 * sum(array.nbytes for array in arrays)
    stored = [rows for name, rows in ours.rows_by_name().items() if name == "frames of partial"]
    assert [(rows.dtype, rows.shape) for rows in stored] == [(np.uint8, (203, 1, 3 * 64 * 64))]


def test_what_begins_episodes_otherwise_does_not_pile_up():
    ours, camera = _make(50, 2), Camera(2, seed=0, padding="noise")
    for _ in range(300):
        camera.step(ours)
    for state in ours.bookkeeping()["frames"].values():
        assert 0 < len(state["times"]) < 60


def test_a_buffer_that_was_reset_forgets_what_it_kept_apart():
    ours, camera = _make(50, 2), Camera(2, seed=0, padding="noise")
    for _ in range(40):
        camera.step(ours)
    ours.reset()
    assert all(len(state["times"]) == 0 for state in ours.bookkeeping()["frames"].values())
    sb3s = DictReplayBuffer(100, SPACE, ACTIONS, "cpu", 2)
    for _ in range(10):
        camera.step(ours, sb3s)
    _assert_equal_samples(ours, sb3s, 10)


def test_float16_storage_of_stacks():
    ours, plain = _make(20, 1, storage_dtype="float16"), _make(20, 1)
    camera = Camera(1, seed=2)
    for _ in range(15):
        camera.step(ours, plain)
    assert ours.rows_by_name()["frames of sensors"].dtype == np.float16
    np.testing.assert_array_equal(ours.observations["sensors"], plain.observations["sensors"])
    assert ours.sample(3).observations["sensors"].numpy().dtype == np.float32


@pytest.mark.parametrize(
    ("stacks", "said"),
    [
        ({"camera": 3}, r'frame_stacks\["camera"\] names no entry of the observation, which has \[.*partial'),
        ({"partial": 4}, r'frame_stacks\["partial"\] is 4 frames, joined along the first axis, but the entry is Box'),
        ({"partial": 0}, r'frame_stacks\["partial"\] must be an integer'),
        ({"partial": 1.5}, r'frame_stacks\["partial"\] must be an integer'),
        ({"partial": 128}, r'frame_stacks\["partial"\] must be an integer'),
        (3, "frame_stacks must be a mapping from entries to their numbers of frames, got 3"),
        (["partial"], "frame_stacks must be a mapping"),
        ({"phase": 1}, r'frame_stacks\["phase"\] is 1 frames, .* Discrete'),
    ],
)
def test_what_can_be_no_stack_is_refused(stacks, said):
    space = spaces.Dict({**SPACE.spaces, "phase": spaces.Discrete(3)})
    with pytest.raises(ValueError, match=said):
        CompactDictReplayBuffer(20, space, ACTIONS, "cpu", frame_stacks=stacks)


def test_what_is_no_stack_is_refused_with_its_step():
    ours, camera = _make(20, 2), Camera(2, seed=0, p_end=0.0)
    camera.step(ours)
    before = {name: array.copy() for name, array in ours.rows_by_name().items()}
    obs, other = (camera._observation(envs) for envs in (camera.envs, [*map(camera._moved_on, camera.envs)]))
    other["sensors"] = other["sensors"][:, ::-1] + 2
    with pytest.raises(ValueError, match=r'"frame_stacks": \{"sensors": 4\}.*leave it out.*The step was not stored'):
        ours.add(obs, other, np.zeros((2, 2)), np.zeros(2), np.zeros(2, bool), [{}, {}])
    assert ours.n_added == 1
    for name, array in ours.rows_by_name().items():
        np.testing.assert_array_equal(array, before[name])


def test_one_frame_is_no_stack():
    one = CompactDictReplayBuffer(20, SPACE, ACTIONS, "cpu", frame_stacks={"partial": 1})
    assert one.rows_by_name().keys() == CompactDictReplayBuffer(20, SPACE, ACTIONS, "cpu").rows_by_name().keys()
    assert one.n_rows == 21


def test_a_step_whose_storing_was_interrupted_is_as_if_it_had_not_been(monkeypatch):
    """It begins an episode with frames that are kept apart."""
    ours, sb3s = _make(20, 2), DictReplayBuffer(40, SPACE, ACTIONS, "cpu", 2)
    camera = Camera(2, seed=0, p_end=1.0, padding="noise")
    camera.step(ours, sb3s)
    begun = camera.envs
    write = ours._ring.write

    def interrupted(*args):
        write(*args)
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(ours._ring, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            camera.step(ours)
    camera.envs = begun
    for _ in range(4):
        camera.step(ours, sb3s)
    _assert_equal_samples(ours, sb3s, 5)
