"""What came before a transition is what was added before it, in its episode, and retired transitions are history alone."""

import numpy as np
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
from sb3_gac.replay.histories import check_samples_histories
from tests.helpers import TwoViewBandit
from tests.replay.test_buffers import ACTIONS, SPACE, Feeder


def _make(capacity, n_envs, cls=CompactDictReplayBuffer, **kwargs):
    return cls(capacity * n_envs, SPACE, ACTIONS, device="cpu", n_envs=n_envs, **kwargs)


def _fed(buffer, n_envs, steps, seed=0, **chances):
    feeder = Feeder(buffer, n_envs, seed, **chances)
    for _ in range(steps):
        feeder.step()
    return feeder


def _before(kept, step, env, length):
    """Transitions of the episode before a step, as far as they are kept, the oldest first; ``None`` where there are none."""
    found = []
    for earlier in range(step - 1, step - 1 - length, -1):
        if earlier < 0 or kept[earlier][env]["ended"]:
            break
        found.append(kept[earlier][env])
    return [None] * (length - len(found)) + found[::-1]


@given(
    capacity=st.integers(1, 12),
    n_envs=st.integers(1, 3),
    steps=st.integers(1, 40),
    length=st.integers(1, 6),
    p_end=st.sampled_from([0.0, 0.1, 0.5]),
    p_reset=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None, max_examples=60)
def test_histories_are_exactly_what_was_added_before(capacity, n_envs, steps, length, p_end, p_reset, seed):
    buffer = _make(capacity, n_envs)
    kept = _fed(buffer, n_envs, steps, seed, p_end=p_end, p_reset=p_reset).kept()
    places = {int(row[env]["obs"]["partial"][0]): (step, env) for step, row in enumerate(kept) for env in range(n_envs)}
    samples, histories = buffer.sample_with_histories(50, length)
    assert histories.mask.shape == (length, 50)
    for index, name in enumerate(samples.observations["partial"][:, 0].int().tolist()):
        step, env = places[name]
        np.testing.assert_array_equal(samples.actions[index], kept[step][env]["action"])
        for row, past in enumerate(_before(kept, step, env, length)):
            assert histories.mask[row, index] == (past is not None)
            entries = {key: histories.observations[key][row, index].numpy() for key in SPACE.spaces}
            action = histories.actions[row, index].numpy()
            if past is None:
                assert not any(entry.any() for entry in [*entries.values(), action])
            else:
                np.testing.assert_array_equal(action, past["action"])
                for key, entry in entries.items():
                    np.testing.assert_array_equal(np.ravel(entry), np.ravel(past["obs"][key]))


def test_what_is_drawn_beside_histories_is_what_is_drawn_without():
    buffer = _make(30, 2, n_steps=3, gamma=0.9)
    _fed(buffer, 2, 40)
    np.random.seed(1)
    alone = buffer.sample(16)
    np.random.seed(1)
    beside, _ = buffer.sample_with_histories(16, 4)
    for one, other in zip(alone, beside, strict=True):
        th.testing.assert_close(one, other, rtol=0, atol=0)


def test_histories_are_normalised_as_observations_are_and_padded_afterwards():
    env = VecNormalize(DummyVecEnv([lambda: TwoViewBandit(0.3, length=4)]), clip_obs=1.0)
    env.reset()
    for _ in range(20):
        env.step(np.zeros((1, 1), np.float32))
    env.obs_rms["privileged"].mean += 5.0
    buffer = CompactDictReplayBuffer(50, env.observation_space, env.action_space, device="cpu")
    obs = env.venv.reset()
    for _ in range(30):
        following, reward, done, infos = env.venv.step(np.full((1, 1), 0.5, np.float32))
        final = {key: value[None] for key, value in infos[0]["terminal_observation"].items()} if done[0] else following
        buffer.add(obs, final, np.full((1, 1), 0.5), reward, done, infos)
        obs = following
    np.random.seed(0)
    _, histories = buffer.sample_with_histories(200, 2, env)
    np.random.seed(0)
    _, raw = buffer.sample_with_histories(200, 2)
    for key in ("partial", "privileged"):
        flat = raw.observations[key].reshape(400, -1).numpy()
        expected = env.normalize_obs({**{k: np.zeros((400, *s.shape)) for k, s in env.observation_space.items()}, key: flat})
        expected = expected[key].reshape(2, 200, -1) * raw.mask[..., None].numpy()
        np.testing.assert_allclose(histories.observations[key], expected, rtol=1e-6)
    assert (histories.observations["privileged"][histories.mask == 1] < -0.9).all()
    assert 0 < histories.mask.mean() < 1


# --- what is retired --------------------------------------------------------------------------------------------------


def test_what_is_retired_is_history_and_is_not_drawn():
    buffer = _make(20, 2)
    feeder = _fed(buffer, 2, 12, p_end=0.0)
    buffer.retire()
    with pytest.raises(ValueError, match="holds nothing to sample"):
        buffer.sample(4)
    for _ in range(3):
        feeder.step()
    new = {int(row[env]["obs"]["partial"][0]) for row in feeder.transitions[12:] for env in range(2)}
    samples, histories = buffer.sample_with_histories(200, 5)
    assert set(samples.observations["partial"][:, 0].int().tolist()) == new
    assert histories.mask.all(), "back beyond what is retired"
    assert set(buffer.sample(200).observations["partial"][:, 0].int().tolist()) == new
    assert buffer.size() == 15


def test_once_the_ring_is_full_of_new_ones_there_is_nothing_retired_left():
    buffer = _make(5, 1)
    feeder = _fed(buffer, 1, 3)
    buffer.retire()
    for _ in range(20):
        feeder.step()
    drawn = set(buffer.sample(200).observations["partial"][:, 0].int().tolist())
    assert drawn == {int(row[0]["obs"]["partial"][0]) for row in feeder.kept()}


def test_whole_episodes_are_retired_too():
    buffer = _make(40, 1, EpisodeReplayBuffer)
    feeder = _fed(buffer, 1, 15, p_end=0.3)
    assert buffer.n_episodes > 0
    buffer.retire()
    assert buffer.n_episodes == 0
    for _ in range(15):
        feeder.step()
    first = 15 + next(i for i, row in enumerate(feeder.transitions[15:]) if row[0]["ended"]) + 1
    earliest = min(buffer.sample(100).observations["partial"][0, :, 0].int().tolist())
    assert earliest == int(feeder.transitions[first][0]["obs"]["partial"][0]), "the episode under way is not whole"


def test_what_was_retired_is_in_files_and_in_checkpoints_and_a_reset_forgets_it(tmp_path):
    buffer = _make(20, 1)
    feeder = _fed(buffer, 1, 8)
    buffer.retire()
    feeder.step()
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    restored = _make(20, 1)
    restored.restore_bookkeeping(buffer.bookkeeping())
    for again in (load_from_pkl(tmp_path / "buffer.pkl"), restored):
        assert again._first_sampled == 8
    before = {key: value for key, value in buffer.bookkeeping().items() if key != "n_retired"}
    restored.restore_bookkeeping(before)
    assert restored._first_sampled == 0, "of an earlier version"
    buffer.reset()
    feeder = _fed(buffer, 1, 2)
    assert buffer._first_sampled == 0


def test_buffers_that_have_no_histories_are_named():
    check_samples_histories(None)
    check_samples_histories(EpisodeReplayBuffer)
    with pytest.raises(ValueError, match=r"replay_buffer_class=DictReplayBuffer can't sample what came before"):
        check_samples_histories(DictReplayBuffer)


def test_choices_and_actions_that_are_choices_come_as_transitions_have_them():
    buffer = CompactDictReplayBuffer(10, SPACE, spaces.Discrete(4), device="cpu")
    obs = [{key: np.stack([space.sample()]) for key, space in SPACE.spaces.items()} for _ in range(7)]
    for step in range(6):
        buffer.add(obs[step], obs[step + 1], np.array([step % 4]), np.zeros(1), np.zeros(1, bool), [{}])
    samples, histories = buffer.sample_with_histories(9, 2)
    assert histories.actions.shape == (2, 9, 1)
    assert histories.actions.dtype == samples.actions.dtype
    for key, entry in samples.observations.items():
        assert histories.observations[key].shape == (2, *entry.shape)
        assert histories.observations[key].dtype == entry.dtype
