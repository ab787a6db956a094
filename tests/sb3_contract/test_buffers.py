"""SB3's contract: which replay buffers are accepted, and what they hold."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_gac import CompactDictReplayBuffer, EpisodeReplayBuffer
from tests.registry import algorithms, make
from tests.sb3_contract.helpers import pendulum, vectorized


class OwnBuffer(DictReplayBuffer):
    """A buffer with an argument of its own that counts its samples and discounts them all by a half."""

    def __init__(self, *args, scale=1.0, **kwargs):
        super().__init__(*args, **kwargs)
        self.scale = scale
        self.n_samples = 0

    def sample(self, batch_size, env=None):
        self.n_samples += batch_size
        return super().sample(batch_size, env)._replace(discounts=th.full((batch_size, 1), 0.5))


def _check_buffer(algorithm, buffer_class, **arguments):
    model = make(algorithm, vectorized(pendulum, 2), buffer_size=30, **arguments)
    assert type(model.replay_buffer) is buffer_class
    assert model.replay_buffer.buffer_size == 15
    model.learn(40)
    assert model.replay_buffer.full


@algorithms("replay")
def test_default_buffer(algorithm):
    _check_buffer(algorithm, CompactDictReplayBuffer)


@algorithms("replay", "other buffers")
def test_sb3s_buffer(algorithm):
    _check_buffer(algorithm, DictReplayBuffer, replay_buffer_class=DictReplayBuffer)


@algorithms("replay", "other buffers")
def test_buffer_of_ones_own_is_sampled(algorithm):
    own = {"replay_buffer_class": OwnBuffer, "replay_buffer_kwargs": {"scale": 2.0}}
    model = make(algorithm, pendulum(), batch_size=7, **own).learn(30)
    assert model.replay_buffer.scale == 2.0
    assert model.replay_buffer.n_samples == 7 * model._n_updates > 0
    assert model._sample_batch(7).discounts.tolist() == [0.5] * 7


@pytest.mark.parametrize("buffer_class", [DictReplayBuffer, HerReplayBuffer, EpisodeReplayBuffer])
def test_a_buffer_that_sums_up_no_rewards_is_refused_with_n_steps(buffer_class):
    """SB3 would ignore ``n_steps``, and advise to pass it to the buffer, which has no such argument."""
    for options in ({}, {"n_steps": 3, "gamma": 0.99}):
        with pytest.raises(
            ValueError, match=f"n_steps=3 needs a replay buffer that sums up rewards, which {buffer_class.__name__} do"
        ):
            make("gac", pendulum(), n_steps=3, replay_buffer_class=buffer_class, replay_buffer_kwargs=options)
    model = make("gac", pendulum(), replay_buffer_class=DictReplayBuffer).learn(30)
    model.n_steps = 3
    with pytest.raises(ValueError, match="n_steps=3 needs a replay buffer that sums up rewards, which DictReplayBuffer"):
        model.learn(10, reset_num_timesteps=False)
    assert model.n_steps == 1


class SummingBuffer(OwnBuffer):
    """With an option of the name that this package's buffers have."""

    def __init__(self, *args, n_steps=1, **kwargs):
        super().__init__(*args, **kwargs)
        self.n_steps = n_steps


def test_a_buffer_of_ones_own_may_sum_up_rewards(recwarn):
    model = make("gac", pendulum(), n_steps=3, replay_buffer_class=SummingBuffer, replay_buffer_kwargs={"n_steps": 3})
    assert model.n_steps == model.replay_buffer.n_steps == 3
    assert not [warning for warning in recwarn if "n_steps" in str(warning.message)]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"n_steps": 3}, "n_steps=3 needs a replay buffer that sums up rewards, which DictReplayBuffer does not"),
        ({"replay_buffer_kwargs": {"mask_truncations": True}}, "mask_truncations=True, but the replay buffer is a DictReplay"),
    ],
)
def test_a_loaded_buffer_that_can_not_be_sampled_as_told_is_refused(arguments, said, tmp_path):
    make("gac", pendulum(), replay_buffer_class=DictReplayBuffer).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = make("gac", pendulum(), **arguments)
    before = model.replay_buffer
    with pytest.raises(ValueError, match=said):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is before


def test_n_steps_that_a_loaded_buffer_does_not_have_can_not_be_set_later(tmp_path):
    make("gac", pendulum(), replay_buffer_class=DictReplayBuffer).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = make("gac", pendulum())
    model.load_replay_buffer(tmp_path / "buffer")
    model.n_steps = 3
    with pytest.raises(ValueError, match="which DictReplayBuffer does not"):
        model.learn(10, reset_num_timesteps=False)


@algorithms("replay")
def test_unknown_buffer_arguments_are_refused(algorithm):
    with pytest.raises(TypeError, match=r'has "wrong_keyword", which is no argument of .*: it takes device'):
        make(algorithm, pendulum(), replay_buffer_kwargs={"wrong_keyword": 1})


def test_the_buffers_argument_that_may_be_meant_is_named():
    with pytest.raises(
        TypeError, match=r'has "storage_dtyp", which is no argument of CompactDict.*: it .* Is "storage_dtype" meant'
    ):
        make("gac", pendulum(), replay_buffer_kwargs={"storage_dtyp": "float16"})


@pytest.mark.parametrize("handle_timeouts", [True, False])
@algorithms("replay")
def test_time_limits_are_not_terminations(algorithm, handle_timeouts):
    env = gym.wrappers.TimeLimit(pendulum(), 10)
    kwargs = {"handle_timeout_termination": handle_timeouts}
    model = make(algorithm, env, learning_starts=100, batch_size=200, replay_buffer_kwargs=kwargs).learn(50)
    assert model.replay_buffer.dones[:50].sum() == 5
    assert (model._sample_batch(200).dones.sum() == 0) == handle_timeouts


class _Recorder(gym.Wrapper):
    """Keep the actions that the environment was given."""

    def step(self, action):
        self.actions = [*getattr(self, "actions", []), action]
        return super().step(action)


@algorithms("replay")
def test_stored_transitions_chain_and_actions_are_scaled(algorithm):
    env = _Recorder(pendulum())
    buffer = make(algorithm, env, buffer_size=100).learn(40).replay_buffer
    for key, value in buffer.observations.items():
        np.testing.assert_array_equal(value[1:40], buffer.next_observations[key][:39])
    assert np.abs(buffer.actions[:40]).max() <= 1
    # Scaling adds and takes away 1, so a small action is exact to float32's step at 1, not to its own.
    np.testing.assert_allclose(env.actions, 2 * buffer.actions[:40, 0], rtol=0, atol=1e-6)
