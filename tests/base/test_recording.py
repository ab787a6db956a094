"""Training on the data of another run: the same to the bit, or refused."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import GAC, RMA, AsymmetricSAC, write_recording
from tests.helpers import Sampled, TwoViewBandit, TwoViewChoice, small_model

ENVS = {
    "one": TwoViewBandit,
    "choice": lambda: TwoViewChoice(length=3),
    "two, of different lengths": lambda: DummyVecEnv([lambda n=n: TwoViewBandit(noise_std=0.3, length=n) for n in (2, 3)]),
}


def _recorded(make_env, path, cls=GAC, steps=60, **arguments):
    model = small_model(make_env(), cls, **arguments).learn(steps)
    write_recording(model, path)
    return model


@pytest.mark.parametrize("name", ENVS)
def test_the_data_are_those_of_the_other_run(name, tmp_path):
    """Warm-up included, whatever the algorithm that learns from them."""
    path = tmp_path / "gac.npz"
    other = _recorded(ENVS[name], path)
    model = small_model(ENVS[name](), AsymmetricSAC, recording=path, learning_starts=20).learn(60)
    for entry, rows in other.replay_buffer.rows_by_name().items():
        np.testing.assert_array_equal(model.replay_buffer.rows_by_name()[entry], rows, err_msg=entry)
    own = small_model(ENVS[name](), AsymmetricSAC, learning_starts=20).learn(60)
    assert not np.array_equal(own.replay_buffer.actions, other.replay_buffer.actions)


def test_a_model_on_its_own_recording_is_itself(tmp_path):
    """But for random numbers that acting draws: here, without any after the warm-up."""
    path = tmp_path / "sac.npz"
    model = _recorded(TwoViewBandit, path, AsymmetricSAC, learning_starts=1000)
    again = small_model(TwoViewBandit(), AsymmetricSAC, recording=path, learning_starts=1000).learn(60)
    for one in (model, again):
        th.manual_seed(0)
        np.random.seed(0)
        one.train(5, 16)
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), again.policy.parameters(), strict=True))


def test_it_goes_on_where_it_was(tmp_path):
    path = tmp_path / "gac.npz"
    other = _recorded(TwoViewBandit, path)
    part = small_model(TwoViewBandit(), AsymmetricSAC, recording=str(path)).learn(25)
    part.save_checkpoint(tmp_path / "checkpoints")
    again = AsymmetricSAC.resume(tmp_path / "checkpoints", TwoViewBandit(), device="cpu").learn(35, reset_num_timesteps=False)
    np.testing.assert_array_equal(again.replay_buffer.actions, other.replay_buffer.actions)
    part.save(tmp_path / "model")
    path.unlink()
    obs = {"partial": np.zeros(2, np.float32)}
    assert AsymmetricSAC.load(tmp_path / "model").predict(obs)[0].shape == (1,)  # to act takes no recording


def test_what_is_another_run_is_refused(tmp_path):
    path = tmp_path / "gac.npz"
    _recorded(lambda: TwoViewBandit(noise_std=0.3), path)
    with pytest.raises(ValueError, match=r"After 1 steps of each environment the rewards are .*, and were "):
        small_model(TwoViewBandit(noise_std=0.3), AsymmetricSAC, recording=path, seed=1).learn(20)
    longer = small_model(TwoViewBandit(noise_std=0.3), AsymmetricSAC, recording=path)
    with pytest.raises(ValueError, match="recording ends after 60 steps of each environment, and training would end after 61"):
        longer.learn(61)
    assert longer.num_timesteps == 0
    with pytest.raises(ValueError, match="training would end after 80"):
        longer.learn(40).learn(40, reset_num_timesteps=False)
    assert longer.learn(20, reset_num_timesteps=False).num_timesteps == 60
    stepwise = small_model(TwoViewBandit(noise_std=0.3), AsymmetricSAC, recording=path, train_freq=50)
    with pytest.raises(ValueError, match="recording ends after 60 steps of each environment: train no longer"):
        stepwise.learn(60)  # its last rollout goes further
    with pytest.raises(ValueError, match="recording is of 1 environments, but the model has 2"):
        small_model(DummyVecEnv([TwoViewBandit] * 2), AsymmetricSAC, recording=path).learn(20)
    with pytest.raises(ValueError, match="recording needs a CompactDictReplayBuffer"):
        small_model(cls=AsymmetricSAC, recording=path, replay_buffer_class=DictReplayBuffer)
    with pytest.raises(FileNotFoundError, match=r"no_such\.npz"):
        small_model(cls=AsymmetricSAC, recording=tmp_path / "no_such.npz").learn(20)


def test_what_has_been_overwritten_is_not_written_down(tmp_path):
    model = small_model(Sampled(TwoViewBandit().observation_space), buffer_size=30).learn(31)
    with pytest.raises(ValueError, match="that holds every step of the training"):
        write_recording(model, tmp_path / "gac.npz")
    assert not (tmp_path / "gac.npz").exists()


def test_phases_go_on_on_a_recording(tmp_path):
    path, arguments = tmp_path / "rma.npz", {"history": 3, "phase_1_steps": 30}
    recorded = _recorded(TwoViewBandit, path, RMA, **arguments)
    again = small_model(TwoViewBandit(), RMA, recording=path, **arguments)
    episodes = []
    again.on_episode_end = lambda env, episode_return, role: episodes.append(role)
    again.learn(60)
    assert recorded.phase == again.phase == 2
    assert set(episodes) == {None}, "no policy of this run acted"


def test_policies_are_not_compared_by_a_recording():
    with pytest.raises(ValueError, match=r'target_kl="auto" compares episodes .* no recording'):
        small_model(target_kl="auto", behaviour={"learner": 0.25}, recording="other.npz")
