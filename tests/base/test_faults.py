"""Environments, models and replay buffers that do not belong together: the error names the entry that changed."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import GAC
from tests.helpers import TwoViewBandit, TwoViewChoice, small_model


class _Changed(gym.Wrapper):
    """Declares other observation entries; ``None`` takes one away."""

    def __init__(self, **entries):
        super().__init__(TwoViewBandit())
        declared = {**self.env.observation_space.spaces, **entries}
        self.observation_space = spaces.Dict({key: space for key, space in declared.items() if space is not None})


LONGER = spaces.Box(-1, 1, (4,), np.float32)
CHANGES = {
    "shape": (_Changed(privileged=LONGER), r'entry "privileged" is Box\(.*\(4,\).*in the environment, Box\(.*\(1,\).*model\.'),
    "bounds": (_Changed(privileged=spaces.Box(-2, 1, (1,), np.float32)), r'"privileged" is Box\(-2.*Box\(-1'),
    "dtype": (_Changed(privileged=spaces.Box(-1, 1, (1,), np.float64)), r'"privileged" is .*float64.*float32'),
    "missing": (_Changed(privileged=None), r'entry "privileged" is missing in the environment'),
    "new": (_Changed(touch=LONGER), r'entry "touch" is .*in the environment, missing in the model'),
    "actions": (TwoViewChoice(), r"Action spaces do not match: the environment has Discrete\(3\), the model Box"),
    "no dict": (gym.make("Pendulum-v1"), r"Observation spaces do not match: the environment has Box"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_space_is_named(change, tmp_path):
    env, message = CHANGES[change]
    model = small_model()
    model.save(tmp_path / "model")
    before = model.get_env()
    with pytest.raises(ValueError, match=message) as raised:
        GAC.load(tmp_path / "model", env=env)
    assert '"partial"' not in str(raised.value)  # which did not change
    with pytest.raises(ValueError, match=message):
        model.set_env(env)
    assert model.get_env() is before


def test_an_opened_file_with_changed_spaces(tmp_path):
    small_model().save(tmp_path / "model.zip")
    with (tmp_path / "model.zip").open("rb") as file, pytest.raises(ValueError, match='entry "touch"'):
        GAC.load(file, env=CHANGES["new"][0])


@pytest.mark.parametrize(
    ("env", "message"),
    [(_Changed(privileged=LONGER), r'"privileged" is .*in the replay buffer'), (TwoViewChoice(), "Action.*replay buffer has")],
)
def test_a_replay_buffer_of_other_spaces_is_refused_and_the_own_one_kept(env, message, tmp_path):
    small_model(env).save_replay_buffer(tmp_path / "buffer")
    model = small_model().learn(20)
    own = model.replay_buffer
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_a_replay_buffer_of_more_environments_is_named(tmp_path):
    small_model(DummyVecEnv([TwoViewBandit] * 3)).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = small_model()
    own = model.replay_buffer
    with pytest.raises(ValueError, match="filled by 3 environments, but the model has 1"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_an_error_of_a_callback_ends_the_episode_too():
    """Its step is stored, and what follows a reset is not stored as if it came next."""

    class Stop(Exception):  # noqa: N818
        pass

    def callback(locals_, globals_):
        if locals_["self"].num_timesteps == 7:
            raise Stop
        return True

    model = small_model(TwoViewBandit(length=100), learning_starts=100)
    with pytest.raises(Stop):
        model.learn(10, callback=callback)
    model.learn(5, reset_num_timesteps=False)
    assert model.replay_buffer.pos == 12
    assert model.replay_buffer.endings[:12, 0].nonzero()[0].tolist() == [6]
