"""Bad input gets an error that names the argument and the remedy, and costs nothing that was there before."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC
from tests.helpers import TwoViewBandit, TwoViewChoice, small_model


class _Poisoned(TwoViewBandit):
    """Returns NaN, once, in one entry or as the reward, after a number of steps."""

    def __init__(self, key, at_step, value=np.nan):
        super().__init__(length=5)
        self.key, self.at_step, self.value, self.steps = key, at_step, value, 0

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        return self._poison(obs), info

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.steps += 1
        if self.key == "reward" and self.steps == self.at_step:
            reward = self.value
        return self._poison(obs), reward, terminated, truncated, info

    def _poison(self, obs):
        if self.steps == self.at_step and self.key in obs:
            obs[self.key] = np.full_like(obs[self.key], self.value)
            self.key = "spent"
        return obs


class _Renamed(gym.ObservationWrapper):
    def __init__(self, names):
        super().__init__(TwoViewBandit())
        self.names = names
        self.observation_space = spaces.Dict({names[k]: s for k, s in self.env.observation_space.spaces.items()})

    def observation(self, observation):
        return {self.names[key]: value for key, value in observation.items()}


def test_no_partial_entry():
    env = _Renamed({"partial": "camera", "privileged": "privileged"})
    with pytest.raises(ValueError, match=r'no entry "partial".*camera.*role_keys'):
        small_model(env)
    assert small_model(env, role_keys={"learner": ["camera"]}).predict({"camera": np.zeros(2, np.float32)})[0].shape == (1,)


def test_box_observation():
    with pytest.raises(ValueError, match=r"must be a Dict.*SplitObservation"):
        small_model("Pendulum-v1")


@pytest.mark.parametrize(
    ("space", "remedy"),
    [
        (spaces.MultiDiscrete([3, 2]), "FlattenMultiDiscrete"),
        (spaces.MultiBinary(3), "FlattenMultiDiscrete"),
        (spaces.Discrete(3, start=1), "count from 0"),
        (spaces.Text(3), "continuous"),
    ],
)
def test_other_actions(space, remedy):
    class Other(TwoViewBandit):
        def __init__(self):
            super().__init__()
            self.action_space = space

    for error in (ValueError, AssertionError):  # the second is SB3's convention
        with pytest.raises(
            error, match=rf"Box and Discrete action spaces, but the environment has {type(space).__name__}"
        ) as e:
            small_model(Other())
        assert remedy in str(e.value) or "must be an instance" in str(e.value)


def test_what_discrete_actions_cannot_have():
    with pytest.raises(ValueError, match="max_kl bounds the KL of Gaussians"):
        small_model(TwoViewChoice(), max_kl=0.1)
    with pytest.raises(ValueError, match="action_noise can be added to Box actions only"):
        small_model(TwoViewChoice(), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy", "Multi"])
def test_policy_names(policy):
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        GAC(policy, TwoViewBandit())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"target_kl": 0}, "target_kl must be a number > 0"),
        ({"target_kl": -0.1}, "target_kl must be a number > 0"),
        ({"target_kl": "small"}, "target_kl must be a number > 0"),
        ({"lr_scales": {"guider": 0}}, r'lr_scales\["guider"\] must be a number > 0'),
        ({"lr_scales": {"actor": 2.0}}, r"lr_scales names unknown roles \['actor'\]"),
        ({"learner_kl_scale": -1}, "learner_kl_scale must be a number >= 0"),
        ({"learner_kl_scale": "full"}, 'learner_kl_scale must be a number >= 0, or "auto"'),
        ({"max_kl": 0}, "max_kl must be a number > 0, or None"),
        ({"max_grad_norm": -1}, "max_grad_norm must be a number > 0, or None"),
        ({"kl_coef": "automatic"}, "kl_coef must be"),
        ({"kl_coef": -1}, "kl_coef must be"),
        ({"ent_coef": "auto_zero"}, "ent_coef must be"),
        ({"kl_coef_bounds": (1, 0.1)}, "kl_coef_bounds must be"),
        ({"kl_coef_learning_rate": 0}, "kl_coef_learning_rate must be"),
        ({"kl_reduction": "max"}, r"kl_reduction must be one of \['mean', 'sum'\]"),
        ({"guider": "teacher"}, r"guider must be one of \['independent', 'residual'\]"),
        ({"target_entropy": "high"}, 'target_entropy must be "auto", "sac" or a number'),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class=ReplayBuffer can't hold Dict"),
        ({"target_update_interval": 0}, "target_update_interval must be"),
        ({"role_keys": {"student": ["partial"]}}, r"unknown roles \['student'\]"),
        ({"role_keys": {"learner": ["touch"]}}, r'role_keys\["learner"\] names unknown.*touch'),
        ({"role_keys": {"guider": []}}, r'role_keys\["guider"\] must be a non-empty list'),
        ({"role_keys": {"guider": "partial"}}, r'role_keys\["guider"\] must be a non-empty list'),
        ({"policy_kwargs": {"net_arch": {"actor": [8]}}}, "net_arch must be"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        small_model(**arguments)


@pytest.mark.parametrize("key", ["partial", "privileged"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("at_step", [3, 5], ids=["within an episode", "at its end"])
def test_nan_in_an_observation_is_named_before_it_enters_the_buffer(key, value, at_step):
    env = DummyVecEnv([TwoViewBandit, lambda: _Poisoned(key, at_step, value)])
    model = small_model(env, learning_starts=100)
    with pytest.raises(ValueError, match=rf'entry "{key}" of environment 1 holds NaN'):
        model.learn(40)
    stored = model.replay_buffer
    assert stored.pos == at_step - 1
    for observations in (stored.observations, stored.next_observations):
        assert all(np.isfinite(values).all() for values in observations.values())
    model.learn(40, reset_num_timesteps=False)  # nothing is lost, and training goes on
    assert stored.pos > at_step


def test_nan_at_reset_is_named():
    model = small_model(_Poisoned("partial", 0))
    with pytest.raises(ValueError, match='entry "partial" of environment 0 holds NaN'):
        model.learn(10)
    assert model.replay_buffer.pos == 0


def test_nan_reward_is_named():
    model = small_model(_Poisoned("reward", 3))
    with pytest.raises(ValueError, match='"reward" of environment 0 holds NaN'):
        model.learn(10)
    assert model.replay_buffer.pos == 2


def test_nan_is_found_behind_vec_normalize():
    """Which would clip an infinite value into a plausible one."""
    env = VecNormalize(make_vec_env(lambda: _Poisoned("privileged", 3, np.inf), n_envs=1))
    with pytest.raises(ValueError, match='entry "privileged" of environment 0 holds NaN or infinite'):
        small_model(env).learn(10)


def test_predict_names_the_missing_entry():
    with pytest.raises(ValueError, match=r"lacks \['partial'\]"):
        small_model().predict({"privileged": np.zeros(1, np.float32)})


def test_predict_with_a_bare_array_needs_a_learner_with_one_entry():
    model = small_model(role_keys={"learner": ["partial", "privileged"]})
    with pytest.raises(ValueError, match=r"reads \['partial', 'privileged'\]"):
        model.predict(np.zeros(2, np.float32))


def test_guider_alone_is_refused_with_a_pointer():
    with pytest.raises(TypeError, match=r"GAC\.predict_guider"):
        small_model().policy.guider.predict(TwoViewBandit().reset(seed=0)[0])


def test_unknown_policy_argument_is_named():
    with pytest.raises(TypeError, match="n_critcs"):
        small_model(policy_kwargs={"n_critcs": 2})
