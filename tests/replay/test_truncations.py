"""Steps that ended by a time limit, from which critics learn nothing where that is asked for."""

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit

from sb3_gac import AsymmetricSAC
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from tests.helpers import TwoViewBandit, small_model

MASKED = {"mask_truncations": True}


def _buffer(length, **options):
    """Episodes of at most three steps; those of two terminate."""
    env = TimeLimit(TwoViewBandit(length=length), 3)
    return small_model(env, cls=AsymmetricSAC, learning_starts=1000, replay_buffer_kwargs=options).learn(31).replay_buffer


@pytest.mark.parametrize(("length", "share"), [(9, 1 / 3), (2, 0.0)])
def test_a_time_limit_has_no_weight_and_a_termination_has(length, share):
    samples = _buffer(length, **MASKED).sample(3000)
    assert samples.critic_weights.shape == (3000,)
    assert set(samples.critic_weights.tolist()) <= {0.0, 1.0}
    assert 1 - samples.critic_weights.mean().item() == pytest.approx(share, abs=0.05)
    assert samples.dones.mean().item() == pytest.approx(0.5 * (length == 2), abs=0.05)


def test_samples_are_those_that_there_are_without_a_mask():
    masked, plain = _buffer(9, **MASKED), _buffer(9)
    samples = []
    for buffer in (masked, plain):
        np.random.seed(0)
        samples.append(buffer.sample(50))
    assert not hasattr(samples[1], "critic_weights")
    for name in ("actions", "dones", "rewards"):
        th.testing.assert_close(*(getattr(each, name) for each in samples))


def test_a_sum_of_rewards_that_a_time_limit_ends_has_no_weight():
    """Of three steps, the last two are ended by it within two."""
    model = small_model(
        TimeLimit(TwoViewBandit(length=9), 3), cls=AsymmetricSAC, learning_starts=1000, n_steps=2, replay_buffer_kwargs=MASKED
    ).learn(31)
    assert 1 - model.replay_buffer.sample(3000).critic_weights.mean().item() == pytest.approx(2 / 3, abs=0.05)


def test_critics_learn_nothing_from_it_and_policies_do():
    """Of episodes of one step, cut by a time limit, there is nothing else."""
    env = TimeLimit(TwoViewBandit(length=9), 1)
    model = small_model(env, cls=AsymmetricSAC, replay_buffer_kwargs=MASKED)
    before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
    model.learn(40)
    moved = {name for name, parameter in model.policy.named_parameters() if not th.equal(parameter, before[name])}
    assert not any(name.startswith("critic") for name in moved)
    assert any(name.startswith("actor") for name in moved)


def test_a_mask_needs_to_know_what_a_time_limit_was():
    model = small_model()
    with pytest.raises(ValueError, match="mask_truncations=True needs handle_timeout_termination=True"):
        CompactDictReplayBuffer(
            10, model.observation_space, model.action_space, handle_timeout_termination=False, mask_truncations=True
        )


def test_a_buffer_that_was_saved_is_sampled_as_the_model_says(tmp_path):
    """And one from before there were masks has none."""
    env = TimeLimit(TwoViewBandit(length=9), 3)
    plain = small_model(env, cls=AsymmetricSAC).learn(31)
    del plain.replay_buffer.mask_truncations
    plain.save_replay_buffer(tmp_path / "buffer")
    masked = small_model(env, cls=AsymmetricSAC, replay_buffer_kwargs=MASKED)
    for model, has_weights in ((plain, False), (masked, True)):
        model.load_replay_buffer(tmp_path / "buffer")
        assert hasattr(model.replay_buffer.sample(5), "critic_weights") == has_weights
