"""Another number of environments than before, and none: what a model needs is made when there are environments to train in."""

import numpy as np
import psutil
import pytest
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import GAC
from tests.helpers import Recall, small_model
from tests.registry import classes

ALGORITHMS = classes("replay", "memory")
NOISES = {
    "no noise": lambda: None,
    "normal": lambda: NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)),
    "with a memory": lambda: OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1)),
}
RECURRENT = {
    "policy": "MultiInputGruPolicy",
    "policy_kwargs": {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]},
    "batch_size": 4,
}
KINDS = {"plain": {}, "recurrent": RECURRENT, "SB3's buffer": {"replay_buffer_class": DictReplayBuffer}}


def _envs(n):
    return DummyVecEnv([lambda: Recall(continuous=True)] * n)


def _trains(model, n_envs):
    before = model._n_updates
    model.learn(24, reset_num_timesteps=False)
    noise = model.action_noise
    assert model._n_updates > before
    assert model.replay_buffer.n_envs == model.n_envs == n_envs
    assert noise is None or np.reshape(noise(), (-1, 1)).shape == (n_envs, 1)
    return model


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kind", KINDS)
def test_there_and_back_by_load_and_by_set_env(kind, noise, tmp_path):
    model = _trains(small_model(_envs(1), action_noise=NOISES[noise](), **KINDS[kind]), 1)
    for n_envs, how in ((3, "load"), (1, "set_env"), (2, "set_env"), (1, "load")):
        model.save(tmp_path / "model")
        if how == "load":
            model = GAC.load(tmp_path / "model", env=_envs(n_envs), force_reset=n_envs != 3)
        else:
            model = GAC.load(tmp_path / "model")
            model.set_env(_envs(n_envs), force_reset=n_envs != 3)
        _trains(model, n_envs)


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputLstmPolicy"])
def test_to_act_takes_no_memory_for_training(cls, policy, tmp_path, monkeypatch):
    model = small_model(_envs(2), cls, policy=policy, policy_kwargs={"net_arch": [8]})
    model.save(tmp_path / "model")
    observation = model.get_env().reset()
    expected, _ = model.predict(observation, deterministic=True)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 10})())
    loaded = cls.load(tmp_path / "model", buffer_size=10**9)
    assert loaded.replay_buffer is None
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)
    loaded.save(tmp_path / "again")
    with pytest.raises(MemoryError, match="lower buffer_size"):
        cls.load(tmp_path / "again", env=_envs(1))
    with pytest.raises(TypeError, match=r"no replay buffer.*set_env"):
        loaded.save_checkpoint(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_buffer_may_come_before_the_environments(kind, tmp_path):
    model = _trains(small_model(_envs(2), **KINDS[kind]), 2)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = GAC.load(tmp_path / "model")
    loaded.load_replay_buffer(tmp_path / "buffer")
    size = loaded.replay_buffer.size()
    assert size == model.replay_buffer.size() > 0
    with pytest.raises(ValueError, match="filled by 2 environments, but the model has 3"):
        loaded.set_env(_envs(3))
    assert loaded.get_env() is None
    loaded.set_env(_envs(2))
    assert _trains(loaded, 2).replay_buffer.size() == size + 12


def test_a_buffer_of_another_number_is_refused_and_the_own_one_kept(tmp_path):
    small_model(_envs(3)).learn(15).save_replay_buffer(tmp_path / "buffer")
    model = small_model(_envs(2)).learn(14)
    own = model.replay_buffer
    with pytest.raises(ValueError, match="filled by 3 environments, but the model has 2"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own
    with pytest.raises(AssertionError, match=r"filled by 2 environments.*GAC\.load\(path, env="):  # as SB3 does
        model.set_env(_envs(1))
    _trains(model, 2)


def test_a_model_that_has_not_trained_takes_any_number():
    model = small_model(_envs(1), action_noise=NOISES["normal"]())
    model.set_env(_envs(4))
    _trains(model, 4)


def test_episodes_are_still_counted_in_one_environment_only(tmp_path):
    model = small_model(_envs(1), train_freq=(1, "episode"))
    model.save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model")
    for refuse in (loaded.set_env, model.set_env, lambda env: GAC.load(tmp_path / "model", env=env)):
        with pytest.raises(ValueError, match=r"train_freq.*one environment only"):
            refuse(_envs(2))
    _trains(model, 1)


def test_noise_made_for_several_environments_is_made_for_as_many_as_there_are():
    model = small_model(_envs(2), action_noise=VectorizedActionNoise(NOISES["normal"](), 3))
    assert model.action_noise.n_envs == 2


@pytest.mark.parametrize("gradient_steps", [1, 0])
def test_noise_that_is_set_in_the_middle_is_made_for_as_many_as_there_are(gradient_steps):
    model = small_model(_envs(2), learning_starts=0, gradient_steps=gradient_steps)
    said = []

    def set_noise(found, _):
        if found["self"].num_timesteps == 10:
            model.action_noise = NOISES["normal"]()
        said.append(getattr(model.action_noise, "n_envs", None))
        return True

    model.learn(40, callback=set_noise)
    assert said[-1] == 2, "and an episode has ended since"


def test_noise_with_a_memory_begins_anew_with_other_environments():
    model = small_model(_envs(2), action_noise=VectorizedActionNoise(NOISES["with a memory"](), 2))
    model.action_noise.base_noise.noise_prev[:] = 1e6
    model.set_env(_envs(3))
    assert np.abs(model.action_noise()).max() < 100
    model.action_noise.base_noise.noise_prev[:] = 1e6
    model.set_env(_envs(1))
    assert np.abs(model.action_noise()).max() < 100


def test_a_buffer_that_was_taken_away_is_made_again():
    model = small_model(_envs(1)).learn(12)
    model.replay_buffer = None
    _trains(model, 1)
