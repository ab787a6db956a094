"""Replay of episodes and sequences, against a plain list of what happened."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac.replay.episodes import EpisodeReplayBuffer
from tests.helpers import TwoViewBandit

SPACE = spaces.Dict(
    partial=spaces.Box(-np.inf, np.inf, (2,), np.float32), privileged=spaces.Box(-np.inf, np.inf, (1,), np.float32)
)
TERMINATED, TIME_LIMIT, CUT, NONE = "terminated", "time limit", "cut", None


class Recorder:
    """Feeds a buffer with observations that are all different, and keeps what it fed."""

    def __init__(self, buffer):
        self.buffer = buffer
        self.n_envs = buffer.n_envs
        self._next_number = 0
        self.current = [self._observation() for _ in range(self.n_envs)]
        self.episodes = [[] for _ in range(self.n_envs)]  # those under way
        self.finished = []

    def _observation(self):
        self._next_number += 1
        return float(self._next_number)

    def step(self, endings):
        after = [self._observation() for _ in range(self.n_envs)]
        action = np.array([[number / 10] for number in self.current], dtype=np.float32)
        reward = np.array([number * 2 for number in self.current], dtype=np.float32)
        done = np.array([ending in (TERMINATED, TIME_LIMIT) for ending in endings])
        infos = [{"TimeLimit.truncated": ending == TIME_LIMIT} for ending in endings]
        self.buffer.add(self._entries(self.current), self._entries(after), action, reward, done, infos)
        for env, ending in enumerate(endings):
            self.episodes[env].append((self.current[env], after[env], ending))
            if ending is not NONE:
                self.finished.append((self.buffer._n_added - len(self.episodes[env]), self.episodes[env]))
                self.episodes[env] = []
                after[env] = self._observation()
        self.current = after

    @staticmethod
    def _entries(numbers):
        values = np.array(numbers, dtype=np.float32)[:, None]
        return {"partial": np.concatenate([values, -values], axis=1), "privileged": values}


def _buffer(size=40, n_envs=1, **kwargs):
    return EpisodeReplayBuffer(size * n_envs, SPACE, spaces.Box(-1e6, 1e6, (1,)), device="cpu", n_envs=n_envs, **kwargs)


def _check(samples, episodes, whole, length=None, burn_in=0):
    """Every sequence is one of the episodes, or a part of it, to its last detail."""
    by_start = {step[0]: (index, episode) for episode in episodes for index, step in enumerate(episode)}
    steps, batch = samples.mask.shape
    partial, privileged = samples.observations["partial"].numpy(), samples.observations["privileged"].numpy()
    assert partial.shape == (steps + 1, batch, 2)
    for b in range(batch):
        index, episode = by_start[privileged[0, b, 0]]
        counted = int(samples.mask[:, b].sum())
        first_counted = int(samples.mask[:, b].argmax())
        n = first_counted + counted
        part = episode[index : index + n]
        assert samples.mask[:, b].tolist() == [0.0] * first_counted + [1.0] * counted + [0.0] * (steps - n)
        if whole:
            assert (index, n) == (0, len(episode))
        else:
            assert first_counted == min(burn_in, index + first_counted)
            assert counted <= length
            assert (
                counted == length or index + first_counted == 0 or index + n == len(episode)
            ), "shorter at a start or end alone"
        numbers = [step[0] for step in part] + [part[-1][1]]
        padding = [0.0] * (steps - n)
        assert privileged[:, b, 0].tolist() == numbers + padding
        assert np.array_equal(partial[:, b], np.stack([privileged[:, b, 0], -privileged[:, b, 0]], axis=1))
        assert samples.rewards[:, b].tolist() == [2 * number for number in numbers[:-1]] + padding
        np.testing.assert_allclose(samples.actions[:, b, 0], np.array(numbers[:-1] + padding, np.float32) / 10, rtol=1e-6)
        assert samples.dones[:, b].tolist() == [float(step[2] == TERMINATED) for step in part] + padding


@settings(deadline=None, max_examples=60)
@given(data=st.data(), n_envs=st.integers(1, 3), whole=st.booleans(), burn_in=st.integers(0, 3), length=st.integers(1, 5))
def test_sequences_are_what_happened(data, n_envs, whole, burn_in, length):
    kwargs = {} if whole else {"sequence_length": length, "burn_in": burn_in}
    size = 12
    recorder = Recorder(_buffer(size, n_envs, **kwargs))
    ending = st.sampled_from([NONE, NONE, NONE, TERMINATED, TIME_LIMIT, CUT])
    for endings in data.draw(st.lists(st.lists(ending, min_size=n_envs, max_size=n_envs), min_size=1, max_size=40)):
        recorder.step(endings)
    recorder.step([TERMINATED] * n_envs)  # what was cut is noticed at the next step
    oldest = recorder.buffer._n_added - recorder.buffer.size()
    kept = [episode for first, episode in recorder.finished if first >= oldest]
    if not kept:
        with pytest.raises(ValueError, match="holds no whole episode"):
            recorder.buffer.sample(4)
        return
    _check(recorder.buffer.sample(16), kept, whole, length, burn_in)


def _of_one_and_nine_steps(**kwargs):
    """A buffer with an episode of one step and one of nine."""
    recorder = Recorder(_buffer(**kwargs))
    for step in range(10):
        recorder.step([TERMINATED if step in (0, 9) else NONE])
    np.random.seed(0)
    return recorder


def test_episodes_are_drawn_uniformly():
    recorder = _of_one_and_nine_steps()
    samples = recorder.buffer.sample(4_000)
    of_first = (samples.observations["privileged"][0, :, 0] == recorder.finished[0][1][0][0]).float().mean()
    assert of_first == pytest.approx(1 / 2, abs=0.03)


@pytest.mark.parametrize(("length", "burn_in"), [(1, 0), (2, 0), (4, 3), (9, 2), (30, 0)])
def test_of_sequences_each_step_counts_equally_often(length, burn_in):
    """The first steps and the last of an episode too: the only step of one, and every step of a short one."""
    recorder = _of_one_and_nine_steps(sequence_length=length, burn_in=burn_in)
    samples = recorder.buffer.sample(20_000)
    counted = samples.observations["privileged"][:-1, :, 0][samples.mask > 0]
    shares = [(counted == step[0]).float().mean() for _, episode in recorder.finished for step in episode]
    assert len(shares) == 10
    assert shares == pytest.approx([0.1] * 10, rel=0.08)


def test_a_long_episode_whose_start_was_overwritten_is_gone_though_shorter_ones_ended_before_it():
    """The ring holds ten steps; the first environment's episode has twelve, the second's have three."""
    recorder = Recorder(_buffer(10, n_envs=2))
    for step in range(12):
        recorder.step([TERMINATED if step == 11 else NONE, TERMINATED if step % 3 == 2 else NONE])
    assert recorder.buffer.n_episodes == 3
    _check(recorder.buffer.sample(30), [episode for first, episode in recorder.finished if first >= 2], whole=True)


def test_memory_is_that_of_single_steps():
    recorder = Recorder(_buffer(size=10_000))
    for step in range(2_000):
        recorder.step([TERMINATED if step % 100 == 99 else NONE])
    floats = 10_001 * (3 + 1 + 1)
    assert recorder.buffer.nbytes() < 4 * floats * 1.1 + 10_001


@pytest.mark.parametrize("kwargs", [{}, {"sequence_length": 3, "burn_in": 1}])
def test_normalised_by_the_environment(kwargs):
    """Observations, the final ones as well, and rewards, by hand; entries that are not to be, are not."""
    env = VecNormalize(DummyVecEnv([TwoViewBandit]), norm_obs_keys=["partial"], clip_obs=2.0, clip_reward=3.0)
    env.obs_rms["partial"].mean[:], env.obs_rms["partial"].var[:] = 5.0, 4.0
    env.ret_rms.var = np.array(9.0)
    recorder = Recorder(_buffer(**kwargs))
    for step in range(6):
        recorder.step([TIME_LIMIT if step == 5 else NONE])
    np.random.seed(0)
    plain = recorder.buffer.sample(8)
    np.random.seed(0)
    normalised = recorder.buffer.sample(8, env=env)
    counted = (plain.observations["privileged"] > 0).float()  # padding is zeros
    by_hand = ((plain.observations["partial"] - 5) / 2).clamp(-2, 2) * counted
    th.testing.assert_close(normalised.observations["partial"], by_hand)
    assert (by_hand.abs() == 2).any()
    assert ((by_hand.abs() < 2) & (by_hand != 0)).any()
    assert th.equal(normalised.observations["privileged"], plain.observations["privileged"])
    th.testing.assert_close(normalised.rewards, (plain.rewards / 3).clamp(-3, 3))
    assert (normalised.rewards == 3).any()
    assert ((normalised.rewards > 0) & (normalised.rewards < 3)).any()
    for name in ("actions", "dones", "mask"):
        assert th.equal(getattr(normalised, name), getattr(plain, name))


def test_a_cut_ends_an_episode_even_where_no_observation_tells():
    buffer = _buffer(n_envs=2)
    constant = Recorder._entries([0.0, 0.0])
    for step in range(7):
        if step in (3, 5):
            buffer.mark_reset()
        done = np.array([step == 4, False])
        buffer.add(constant, constant, np.zeros((2, 1)), np.zeros(2), done, [{}, {}])
    buffer.mark_reset()
    whole = [[0, 0, 3], [1, 0, 3], [0, 3, 2], [1, 3, 2], [0, 5, 2], [1, 5, 2]]
    assert buffer._episodes.since(0).tolist() == whole
    buffer.add(constant, constant, np.zeros((2, 1)), np.zeros(2), np.ones(2), [{}, {}])
    assert buffer._episodes.since(0).tolist() == [*whole, [0, 7, 1], [1, 7, 1]]


def test_reset_forgets_episodes():
    recorder = Recorder(_buffer())
    recorder.step([TERMINATED])
    recorder.buffer.sample(1)
    recorder.buffer.reset()
    with pytest.raises(ValueError, match="raise learning_starts above the length of an episode"):
        recorder.buffer.sample(1)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 3}, "n_steps must be 1"),
        ({"sequence_length": 0}, "sequence_length must be an integer >= 1, or None for whole episodes, got 0"),
        ({"sequence_length": 4.0}, r"sequence_length must be an integer .* got 4\.0"),
        ({"sequence_length": "4"}, "sequence_length must be an integer .* got '4'"),
        ({"burn_in": 2}, "burn_in goes with a sequence_length"),
        ({"sequence_length": 4, "burn_in": -1}, "burn_in must be an integer >= 0, got -1"),
        ({"sequence_length": 4, "burn_in": 1.0}, r"burn_in must be an integer >= 0, got 1\.0"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        _buffer(**kwargs)
