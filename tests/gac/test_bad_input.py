"""Bad input gets an error that names the argument and the remedy, and costs nothing that was there before."""

import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, GACShare, GACWithoutQ, InvalidStepError, OnnxPolicy, export_learner
from tests.helpers import TwoViewBandit, TwoViewChoice, small_model
from tests.registry import classes

ALGORITHMS = classes("replay")


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


class _Acting(TwoViewBandit):
    """With an action space of its own."""

    def __init__(self, space):
        super().__init__(length=5)
        self.action_space = space


def _box(low, high, dtype=np.float32):
    """Of these bounds, even where gymnasium would refuse them."""
    space = spaces.Box(-1, 1, np.shape(low), dtype)
    space.low, space.high = np.array(low, dtype), np.array(high, dtype)
    return space


LARGEST = np.finfo(np.float32).max
BOUNDS = {
    "no bounds": (_box([-np.inf] * 2, [np.inf] * 2), r"component 0, 1 is not bounded \(low -inf, high inf\)"),
    "no upper bound": (_box([0, -1], [np.inf, 1]), r"component 0 is not bounded \(low 0, high inf\)"),
    "no lower bound": (_box([[-1, -np.inf]], [[1, 1]]), r"component \(0, 1\) is not bounded"),
    "the largest": (_box([-1, -LARGEST], [1, LARGEST]), "component 1 is not bounded"),
    "up to the largest": (_box([0, 0], [1, LARGEST]), "component 1 is not bounded"),
    "the largest of float64": (_box([-1e308], [1e308], np.float64), "component 0 is not bounded"),
    "NaN": (_box([np.nan, 0], [1, 1]), "component 0 is not bounded .low nan, high 1."),
    "too wide": (_box([-1, -2e38], [1, 2e38]), r"component 1 is wider than float32 can say \(low -2e\+38"),
    "locked": (_box([-1, 0.5], [1, 0.5]), r"component 1 is locked \(low == high == 0.5\). Leave it out"),
    "all locked": (_box(0.0, 0.0), r"component \(\) is locked"),
    "crossed": (_box([1, -1, 3], [-1, 1, 2]), "component 0, 2 has low 1 above high -1. Swap"),
    "many": (_box([0] * 20, [0] * 20), "component 0, 1, 2, 3, 4, 5, 6, 7 and 12 more is locked"),
    "several faults": (_box([0, -np.inf], [0, 1]), "component 1 is not bounded .*; component 0 is locked"),
    "nothing": (spaces.Box(-1, 1, (0,), np.float32), "has no component"),
}


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("fault", BOUNDS)
def test_bounds_that_actions_cannot_be_scaled_to_are_named(fault, cls):
    space, message = BOUNDS[fault]
    for error in (ValueError, AssertionError):
        with pytest.raises(error, match=message):
            small_model(_Acting(space), cls, **dict.fromkeys(cls.frozen_arguments))


def test_a_vectorised_environment_or_another_one_is_refused_alike():
    space, message = BOUNDS["locked"]
    env = DummyVecEnv([lambda: _Acting(space)] * 2)
    for give in (small_model, small_model().set_env):
        with pytest.raises(ValueError, match=message):
            give(env)


@pytest.mark.parametrize("dtype", [np.int8, np.int32, np.uint8, np.float16, bool])
def test_box_actions_of_other_types_are_refused_and_the_remedy_helps(dtype):
    space = spaces.Box(0, 1 if dtype is bool else 10, (2,), dtype)
    env = _Acting(space)
    with pytest.raises(ValueError, match=rf"float32 or float64, but the action space is .* of type {space.dtype}") as raised:
        small_model(env)
    remedy = re.search(r"(lambda action: .*)\.$", str(raised.value)).group(1)
    convert = eval(remedy, {"np": np})
    wrapped = gym.wrappers.TransformAction(env, convert, spaces.Box(0, int(space.high[0]), (2,), np.float32))
    assert space.contains(convert(wrapped.action_space.sample()))
    assert small_model(wrapped).learn(14)._n_updates > 0


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(), (2, 1)])
def test_other_box_actions_are_stored_as_they_were_taken(cls, dtype, shape, tmp_path):
    """Scaled to [-1, 1], of any shape; a file gives them in the space's own type and precision."""
    space = spaces.Box(dtype(1e6 if dtype is np.float64 else 3), dtype(1e6 + 0.01 if dtype is np.float64 else 5), shape, dtype)
    env = _Recorded(space)
    noise = NormalActionNoise(np.zeros(shape), np.ones(shape)) if shape else None  # SB3's makes an array of no other
    model = small_model(env, cls, action_noise=noise).learn(30)
    taken = np.array(env.actions, np.float64)
    assert all(space.contains(action) for action in env.actions)
    scaled = 2 * (taken - space.low) / (np.float64(space.high) - space.low) - 1
    stored = model.replay_buffer.actions[:30].reshape(30, *shape)
    np.testing.assert_allclose(stored, scaled, atol=1e-6)
    assert noise is None or (np.abs(stored[10:]) == 1).any()  # where rounding would lead beyond the bounds
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", verify_on=8))
    given = np.float32([[0.3, -0.2], [2, 3]])
    actions, expected = learner.act(given), model.predict(given, deterministic=True)[0]
    assert actions.dtype == expected.dtype == dtype
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-6)
    assert not np.array_equal(actions[0], actions[1])


class _Recorded(_Acting):
    def __init__(self, space):
        super().__init__(space)
        self.actions = []

    def step(self, action):
        self.actions.append(np.array(action, self.action_space.dtype))
        return super().step(np.ravel(action))


def test_what_discrete_actions_cannot_have():
    with pytest.raises(ValueError, match="max_kl bounds the KL of Gaussians"):
        small_model(TwoViewChoice(), max_kl=0.1)
    with pytest.raises(ValueError, match="action_noise can be added to Box actions only"):
        small_model(TwoViewChoice(), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))


def _poisoned_model(key, at_step, value=np.nan, normalize=False):
    """Two environments; in the second the value comes after ``at_step`` steps. Trains from the second step on."""
    env = DummyVecEnv([lambda: TwoViewBandit(length=5), lambda: _Poisoned(key, at_step, value)])
    return small_model(VecNormalize(env) if normalize else env, learning_starts=2)


def _state(model):
    """All that a refused step must not have changed."""
    buffer, arrays = model.replay_buffer, {}
    arrays |= {f"policy {name}": tensor.numpy() for name, tensor in model.policy.state_dict().items()}
    arrays |= {f"buffer {name}": values[: buffer.pos] for name, values in buffer.observations.items()}
    arrays |= {"rewards": buffer.rewards[: buffer.pos], "actions": buffer.actions[: buffer.pos], "steps": model.num_timesteps}
    if (env := model.get_vec_normalize_env()) is not None:
        statistics = {**env.obs_rms, "returns": env.ret_rms}
        arrays |= {
            f"{name} {what}": getattr(rms, what) for name, rms in statistics.items() for what in ("mean", "var", "count")
        }
    return {name: np.array(values) for name, values in arrays.items()}


@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "VecNormalize"])
@pytest.mark.parametrize("key", ["partial", "privileged", "reward"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at_step", [3, 5], ids=["within an episode", "at its end"])
def test_what_is_not_finite_is_named_and_changes_nothing(key, value, at_step, normalize):
    """Neither buffer nor networks nor VecNormalize's statistics, and training goes on."""
    model = _poisoned_model(key, at_step, value, normalize)
    steps_before = 2 * (at_step - 1)
    with pytest.raises(InvalidStepError, match=rf'"{key}" of environment 1 holds NaN or infinite.*after {steps_before} steps'):
        model.learn(40)
    twin = _poisoned_model("nothing", at_step, normalize=normalize).learn(steps_before)
    for name, values in _state(twin).items():
        np.testing.assert_array_equal(_state(model)[name], values, err_msg=name)

    model.learn(40, reset_num_timesteps=False)
    assert model.num_timesteps == steps_before + 40
    assert model.replay_buffer.pos == model.num_timesteps / 2
    assert all(np.isfinite(values).all() for values in _state(model).values())


@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "VecNormalize"])
def test_nan_at_reset_is_named(normalize):
    model = _poisoned_model("partial", 0, normalize=normalize)
    with pytest.raises(InvalidStepError, match=r'entry "partial" of environment 1 holds NaN.*after 0 steps'):
        model.learn(10)
    assert model.replay_buffer.pos == 0
    assert model.learn(10).replay_buffer.pos == 5


def test_a_normalizer_set_later_is_guarded_too():
    env = VecNormalize(DummyVecEnv([lambda: _Poisoned("partial", 3)]))
    model = small_model()
    model.set_env(env)
    with pytest.raises(InvalidStepError, match='"partial" of environment 0'):
        model.learn(10)
    assert np.isfinite(env.obs_rms["partial"].mean).all()


class _Noise(ActionNoise):
    """NaN once, in one call."""

    calls = 0

    def __call__(self):
        self.calls += 1
        return np.full(1, np.nan if self.calls == 7 else 0.0)


def test_nan_from_action_noise_is_named_before_the_environments_see_it():
    model = small_model(TwoViewBandit(length=5), action_noise=_Noise())
    with pytest.raises(InvalidStepError, match=r'"action" of environment 0 holds NaN.*action_noise.*after 6 steps'):
        model.learn(20)
    assert model.replay_buffer.pos == 6
    assert model.learn(20, reset_num_timesteps=False).replay_buffer.pos == 26


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_not_finite_names_its_environment(value, monkeypatch):
    model = small_model(DummyVecEnv([TwoViewBandit] * 3)).learn(15)
    actions = np.array([[0.1], [0.2], [value]], dtype=np.float32)
    monkeypatch.setattr(model, "_sample_action", lambda *args: (actions, actions))
    with pytest.raises(InvalidStepError, match=r'"action" of environment 2 holds NaN or infinite.*after 15 steps'):
        model.learn(15, reset_num_timesteps=False)
    assert model.replay_buffer.pos == 5


def test_a_behaviour_policy_that_diverged_is_named():
    model = small_model(TwoViewBandit(length=5), learning_starts=0, gradient_steps=0)
    for parameter in model.policy.guider.parameters():
        parameter.data.fill_(np.nan)
    with pytest.raises(InvalidStepError, match=r'"action" of environment 0 .*policy diverged'):
        model.learn(5)


def test_predict_names_the_missing_entry():
    with pytest.raises(ValueError, match=r"lacks \['partial'\]"):
        small_model().predict({"privileged": np.zeros(1, np.float32)})


def test_predict_with_a_bare_array_needs_a_learner_with_one_entry():
    model = small_model(role_keys={"learner": ["partial", "privileged"]})
    with pytest.raises(ValueError, match=r"reads \['partial', 'privileged'\]"):
        model.predict(np.zeros(2, np.float32))


@pytest.mark.parametrize("cls", [GAC, GACShare, GACWithoutQ])
@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputGruPolicy"])
def test_predict_guider_names_what_the_guider_lacks(cls, policy):
    model = small_model(TwoViewBandit(length=5), cls=cls, policy=policy, batch_size=2)
    partial, privileged = np.zeros(2, np.float32), np.zeros(1, np.float32)
    with pytest.raises(ValueError, match=r"predict_guider\(\) lacks \['privileged'\], which the guider reads; it has"):
        model.predict_guider({"partial": partial})
    with pytest.raises(ValueError, match=r"lacks \['partial'\]"):
        model.predict_guider({"privileged": privileged})
    with pytest.raises(ValueError, match=r"guider reads \['partial', 'privileged'\]: pass predict_guider\(\) a dict"):
        model.predict_guider(partial)
    action, _ = model.predict_guider({"partial": partial, "privileged": privileged})
    assert action.shape == (1,)


def test_a_guider_of_one_entry_still_needs_what_its_learner_reads():
    model = small_model(role_keys={"guider": ["privileged"]})
    with pytest.raises(ValueError, match=r"lacks \['partial'\]"):
        model.predict_guider({"privileged": np.zeros(1, np.float32)})


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("keys", [["priviledged"], "privileged", []])
def test_role_keys_are_named_as_they_were_written(cls, keys):
    roles = ["critic", *cls.policy_aliases["MultiInputPolicy"].roles.networks]
    for role in roles:
        with pytest.raises(ValueError, match=rf'^role_keys\["{role}"\]'):
            small_model(cls=cls, role_keys={role: keys})
    with pytest.raises(ValueError, match=r'^role_keys\["critic"\]'):
        small_model(cls=cls, role_keys={role: ["partial"] for role in roles} | {"critic": keys})


@pytest.mark.parametrize("cls", [GACShare, GACWithoutQ])
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("update_every", {"update_every": {"learner_critic": 2}}),
        ("lr_scales", {"lr_scales": {"learner_critic": 2.0}}),
        ("role_keys", {"role_keys": {"learner_critic": ["privileged"]}}),
        ("rnn_type", {"policy_kwargs": {"rnn_type": {"learner_critic": "gru"}}}),
    ],
)
def test_settings_of_critics_that_an_ablation_does_without_are_refused(cls, name, arguments):
    with pytest.raises(ValueError, match=f'{name} names "learner_critic", which {cls.__name__} does not have'):
        small_model(cls=cls, **arguments)


def test_guider_alone_is_refused_with_a_pointer():
    with pytest.raises(TypeError, match=r"GAC\.predict_guider"):
        small_model().policy.guider.predict(TwoViewBandit().reset(seed=0)[0])


def test_unknown_policy_argument_is_named():
    with pytest.raises(TypeError, match="n_critcs"):
        small_model(policy_kwargs={"n_critcs": 2})
