"""On whatever entries there are, training works and stores what the environments returned, or an error names the entry."""

import tempfile

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, OnnxPolicy, export_learner

PROPERTIES = settings(
    max_examples=15,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    database=None,
    phases=(Phase.explicit, Phase.generate),
)
DTYPES = {"float32": (-5, 5), "float64": (-5, 5), "float16": (-5, 5), "bool": (0, 1), "int8": (-9, 9), "int32": (-9, 9)}
DTYPES |= {"int64": (0, 7), "uint8": (0, 255), "uint16": (0, 999), "uint32": (0, 99), "uint64": (0, 9)}


def boxes():
    """Single numbers, vectors and matrices of every type."""
    shapes = st.lists(st.integers(1, 3), min_size=0, max_size=2).map(tuple)
    return st.builds(
        lambda dtype, shape: spaces.Box(*DTYPES[dtype], shape, np.dtype(dtype)), st.sampled_from(sorted(DTYPES)), shapes
    )


def counted():
    """What is not measured but counted, from any number."""
    return st.one_of(
        st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(2, 4), st.integers(-3, 3)),
        st.builds(_choices, st.lists(st.integers(2, 3), min_size=1, max_size=2), st.integers(-3, 3), st.integers(0, 2)),
        st.lists(st.integers(1, 3), min_size=1, max_size=2).map(spaces.MultiBinary),
    )


def _choices(counts, start, rows):
    """MultiDiscrete, of one dimension without rows."""
    nvec = np.array([counts] * rows if rows else counts)
    return spaces.MultiDiscrete(nvec, start=start + np.arange(nvec.size).reshape(nvec.shape))


NAMES = st.one_of(
    st.sampled_from(["type", "keys", "training", "joint.pos", "1", "low", "state", "action", "camera/front"]),
    st.text(st.characters(codec="utf-8"), min_size=1, max_size=8).filter(lambda name: name != "partial"),
)
OBSERVATIONS = st.builds(
    lambda partial, others: spaces.Dict({"partial": partial, **others}),
    boxes(),
    st.dictionaries(NAMES, st.one_of(boxes(), counted()), min_size=0, max_size=3),
)
BOUNDS = st.tuples(st.floats(-1e3, 1e3, width=32), st.floats(-1e3, 1e3, width=32)).filter(lambda b: b[1] - b[0] > 1e-3)
ACTIONS = st.one_of(
    st.integers(2, 4).map(spaces.Discrete),
    st.builds(
        lambda bounds, dtype: spaces.Box(*np.array(bounds, dtype).T, dtype=dtype),
        st.lists(BOUNDS, min_size=1, max_size=3),
        st.sampled_from([np.float32, np.float64]),
    ),
)


class _Recording(gym.Env):
    """Returns samples of its spaces and remembers each step: observation, action, reward, next observation, done."""

    def __init__(self, observation_space, action_space, length, truncates=False, spoiled=None):
        self.observation_space, self.action_space = observation_space, action_space
        self.length, self.truncates, self.spoiled = length, truncates, spoiled
        self.steps, self.transitions = 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.step_of_episode, self.observation = 0, self.observation_space.sample()
        return self.observation, {}

    def step(self, action):
        self.steps, self.step_of_episode = self.steps + 1, self.step_of_episode + 1
        after, reward = self.observation_space.sample(), float(self.np_random.standard_normal())
        if self.spoiled is not None and self.steps == self.spoiled[1]:
            after[self.spoiled[0]] = np.full(np.shape(after[self.spoiled[0]]), np.nan, np.float32)
        done = self.step_of_episode >= self.length
        self.transitions.append((self.observation, action, reward, after, done))
        self.observation = after
        return after, reward, done and not self.truncates, done and self.truncates, {}


def _model(env, **arguments):
    small = {"net_arch": [4]}
    return GAC(
        "MultiInputPolicy", env, learning_starts=8, batch_size=4, buffer_size=60, seed=0, policy_kwargs=small, **arguments
    )


def _environments(n_envs, *args, **kwargs):
    observation_space, *rest = args
    envs = [_Recording(spaces.Dict(dict(observation_space.spaces)), *rest, **kwargs) for _ in range(n_envs)]
    return envs, DummyVecEnv([lambda env=env: env for env in envs])


def _assert_stored(model, envs):
    """Each step of each environment, in the buffer as it was returned."""
    buffer, scale = model.replay_buffer, isinstance(model.action_space, spaces.Box)
    assert buffer.pos == len(envs[0].transitions)
    observations, next_observations = buffer.observations, buffer.next_observations
    for index, env in enumerate(envs):
        for row, (before, action, reward, after, done) in enumerate(env.transitions):
            for key, space in env.observation_space.spaces.items():
                shape = buffer.layout.shapes[key]
                assert observations[key].dtype == space.dtype
                np.testing.assert_array_equal(observations[key][row, index], np.reshape(before[key], shape))
                np.testing.assert_array_equal(next_observations[key][row, index], np.reshape(after[key], shape))
            stored = buffer.actions[row, index]
            taken = model.policy.unscale_action(stored) if scale else stored[0]
            np.testing.assert_allclose(
                taken, action, rtol=1e-5, atol=1e-6 * (np.ptp([env.action_space.low, env.action_space.high]) if scale else 1)
            )
            assert env.action_space.contains(action)
            assert buffer.rewards[row, index] == np.float32(reward)
            assert buffer.dones[row, index] == done
            assert buffer.timeouts[row, index] == (done and env.truncates)


@PROPERTIES
@given(space=OBSERVATIONS, actions=ACTIONS, n_envs=st.integers(1, 3), length=st.integers(1, 9), truncates=st.booleans())
def test_the_buffer_holds_what_the_environments_returned(space, actions, n_envs, length, truncates):
    envs, env = _environments(n_envs, space, actions, length, truncates)
    model = _model(env).learn(12 * n_envs)
    assert model._n_updates > 0
    _assert_stored(model, envs)
    seen = {"partial": space["partial"].sample()}
    action, _ = model.predict(seen, deterministic=True)
    assert actions.contains(action if isinstance(actions, spaces.Box) else np.int64(action))
    with tempfile.TemporaryDirectory() as directory:
        learner = OnnxPolicy.load(export_learner(model, f"{directory}/learner.onnx", verify_on=4))
    exported = learner.act(seen)
    assert actions.contains(exported)
    np.testing.assert_allclose(exported, action, rtol=1e-4, atol=1e-3)


@pytest.fixture(scope="module")
def policies():
    """That scale actions: the whole, in training, and the deployed one."""
    policy = _model(_Recording(spaces.Dict(partial=spaces.Box(-1, 1, (1,))), spaces.Box(-1, 1, (1,)), 5)).policy
    return [policy, policy.deployed]


@settings(PROPERTIES, max_examples=300)
@given(
    bounds=BOUNDS,
    dtype=st.sampled_from([np.float32, np.float64]),
    scaled=st.one_of(st.sampled_from([-1.0, 1.0]), st.floats(-1, 1, width=32)),
)
def test_no_action_leaves_its_bounds(bounds, dtype, scaled, policies):
    space = spaces.Box(*np.array([bounds], dtype).T, dtype=dtype)
    for policy in policies:
        policy.action_space = space
        assert space.contains(policy.unscale_action(np.float32([scaled])).astype(dtype))


@settings(PROPERTIES, max_examples=8)
@given(partial=st.one_of(boxes(), counted()), other=st.one_of(boxes(), counted()), name=NAMES)
def test_any_entry_of_any_name_is_read_by_a_memory_and_exported(partial, other, name):
    """Sequences are padded, with what need be none of an entry's values."""
    space = spaces.Dict({"partial": partial, name: other})
    small = {"net_arch": [4], "rnn_hidden_size": 4, "rnn_net_arch": [4]}
    model = GAC(
        "MultiInputGruPolicy",
        _Recording(space, spaces.Box(-1, 1, (1,), np.float32), 3),
        learning_starts=8,
        batch_size=2,
        buffer_size=60,
        policy_kwargs=small,
        role_keys={"learner": ["partial", name]},
    ).learn(10)
    with tempfile.TemporaryDirectory() as directory:
        model.save(f"{directory}/model")
        loaded = GAC.load(f"{directory}/model")
        if "\0" in name:
            with pytest.raises(ValueError, match="no file can name an entry with a null character"):
                export_learner(model, f"{directory}/learner.onnx", verify_on=4)
            return
        learner = OnnxPolicy.load(export_learner(model, f"{directory}/learner.onnx", verify_on=4))
    state = None
    for _ in range(3):
        seen = space.sample()
        expected, after = model.predict(seen, state, deterministic=True)
        np.testing.assert_allclose(loaded.predict(seen, state, deterministic=True)[0], expected, atol=1e-6)
        np.testing.assert_allclose(learner.act(seen), expected, atol=1e-5)
        state = after


@PROPERTIES
@given(partial=boxes(), others=st.dictionaries(NAMES, boxes(), max_size=2), n_envs=st.integers(1, 3), length=st.integers(1, 9))
def test_behind_vec_normalize_it_holds_the_same(partial, others, n_envs, length):
    space = spaces.Dict({"partial": partial, **others})
    envs, env = _environments(n_envs, space, spaces.Discrete(2), length)
    _assert_stored(_model(VecNormalize(env)).learn(12 * n_envs), envs)


@PROPERTIES
@given(space=OBSERVATIONS, n_envs=st.integers(1, 3), at_step=st.integers(1, 12), length=st.integers(1, 9), data=st.data())
def test_a_spoiled_entry_is_named_and_training_goes_on(space, n_envs, at_step, length, data):
    key = data.draw(st.sampled_from(sorted(space.spaces)))
    which = data.draw(st.integers(0, n_envs - 1))
    envs, env = _environments(n_envs, space, spaces.Discrete(2), length)
    envs[which].spoiled = (key, at_step)
    model = _model(env)
    with pytest.raises(ValueError, match="entry") as raised:
        model.learn(12 * n_envs)
    assert f'entry "{key}" of environment {which} ' in str(raised.value)
    assert f"after {(at_step - 1) * n_envs} steps" in str(raised.value)
    for each in envs:
        del each.transitions[at_step - 1 :]  # the step that was refused
    _assert_stored(model, envs)
    model.learn(4 * n_envs, reset_num_timesteps=False)
    assert model.replay_buffer.pos == at_step - 1 + 4


@PROPERTIES
@given(space=OBSERVATIONS, change=st.sampled_from(["missing", "new", "other"]), data=st.data())
def test_a_changed_entry_is_named(space, change, data):
    model = _model(_Recording(space, spaces.Discrete(2), 5))
    changed = dict(space.spaces)
    key = "brand new" if change == "new" else data.draw(st.sampled_from(sorted(changed)))
    if change == "missing" and len(changed) > 1:
        del changed[key]
    else:
        changed[key] = spaces.Box(-77, 77, (7,), np.float32)
    with pytest.raises(ValueError, match="Observation spaces do not match") as raised:
        model.set_env(_Recording(spaces.Dict(changed), spaces.Discrete(2), 5))
    named = [name for name in {*space.spaces, *changed} if f'entry "{name}" is' in str(raised.value)]
    assert named == [key]
