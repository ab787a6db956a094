"""An environment that raises, or whose process dies, is named, and nothing that was learned is lost."""

import os
import re
import signal

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_gac import GAC, AsymmetricSAC, EnvironmentFailedError, InvalidStepError
from tests.helpers import TwoViewBandit, small_model


class _Broken(TwoViewBandit):
    """Breaks in one step, or at its reset, in one of several ways."""

    def __init__(self, how, at_step=20, says="the simulation exploded"):
        super().__init__(length=5)
        self.how, self.at_step, self.says, self.steps = how, at_step, says, 0

    def reset(self, *, seed=None, options=None):
        if self.at_step == 0:
            self._break()
        return super().reset(seed=seed)

    def step(self, action):
        self.steps += 1
        if self.steps == self.at_step:
            self._break()
        return super().step(action)

    def _break(self):
        self.at_step = None
        if self.how == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "exit":
            os._exit(7)
        raise RuntimeError(self.says)


def _broken(how, at_step=20):
    return [TwoViewBandit, lambda: _Broken(how, at_step)]


def _subprocesses(env_fns):
    return SubprocVecEnv(env_fns, start_method="fork")


@pytest.fixture
def unbroken():
    """What takes a broken environment's place."""
    env = _subprocesses([TwoViewBandit, TwoViewBandit])
    yield env
    env.close()


def _contents(buffer):
    arrays = {**buffer.observations, "actions": buffer.actions, "rewards": buffer.rewards}
    return {name: values[: buffer.pos].copy() for name, values in arrays.items()}


def _assert_intact(model, steps, tmp_path):
    """Everything before the step that failed is there, in the model and in what it saves."""
    assert model.num_timesteps == steps
    assert model.replay_buffer.pos == steps / model.n_envs
    assert all(np.isfinite(values).all() for values in _contents(model.replay_buffer).values())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    saved = GAC.load(tmp_path / "model")
    saved.load_replay_buffer(tmp_path / "buffer")
    for name, values in _contents(model.replay_buffer).items():
        np.testing.assert_array_equal(values, _contents(saved.replay_buffer)[name])
    observation = {"partial": np.ones(2, np.float32)}
    np.testing.assert_array_equal(*(m.predict(observation, deterministic=True)[0] for m in (model, saved)))


@pytest.mark.parametrize(("how", "code"), [("kill", -signal.SIGKILL), ("exit", 7), ("raise", 1)])
def test_a_process_that_dies_is_named_and_others_take_its_place(how, code, unbroken, tmp_path):
    env = _subprocesses(_broken(how))
    model = small_model(env)
    with pytest.raises(EnvironmentFailedError, match=rf"environment 1 \(exit code {code}\) died.*set_env.*after 38 steps"):
        model.learn(100)
    _assert_intact(model, 38, tmp_path)
    assert not any(process.is_alive() for process in env.processes)
    with pytest.raises(EnvironmentFailedError, match=rf"environment 1 \(exit code {code}\)"):
        model.learn(10, reset_num_timesteps=False)
    env.close()

    before = _contents(model.replay_buffer)
    model.set_env(unbroken)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 58
    for name, values in before.items():
        np.testing.assert_array_equal(values, _contents(model.replay_buffer)[name][:19])


def test_a_process_that_a_server_forked_is_named():
    """SB3's default; there a pipe closes with its process."""
    model = small_model(SubprocVecEnv(_broken("kill", at_step=2)))
    with pytest.raises(EnvironmentFailedError, match=rf"environment 1 \(exit code {-signal.SIGKILL}\) died"):
        model.learn(100)


def test_a_process_that_dies_between_two_steps_is_named():
    env = _subprocesses([TwoViewBandit] * 2)
    model = small_model(env).learn(20)
    os.kill(env.processes[0].pid, signal.SIGKILL)
    env.processes[0].join()
    with pytest.raises(EnvironmentFailedError, match=rf"environment 0 \(exit code {-signal.SIGKILL}\)"):
        model.learn(20, reset_num_timesteps=False)


def test_a_process_that_dies_at_reset_is_named():
    model = small_model(_subprocesses(_broken("kill", at_step=0)))
    with pytest.raises(EnvironmentFailedError, match=r"environment 1 .*after 0 steps"):
        model.learn(20)


def test_normalization_survives_a_process(unbroken, tmp_path):
    env = VecNormalize(_subprocesses(_broken("kill")))
    model = small_model(env)
    with pytest.raises(EnvironmentFailedError, match="environment 1 "):
        model.learn(100)
    assert env.obs_rms["partial"].count == pytest.approx(2 * 20, abs=0.01)  # a reset and 19 steps of two
    env.save(tmp_path / "statistics")
    model.set_env(VecNormalize.load(tmp_path / "statistics", unbroken))
    model.learn(20, reset_num_timesteps=False)
    assert model.get_vec_normalize_env().obs_rms["partial"].count == pytest.approx(2 * 31, abs=0.01)


@pytest.mark.parametrize("wrapper", [None, VecNormalize, lambda env: VecFrameStack(env, 2)], ids=["bare", "norm", "stack"])
def test_an_environment_that_raises_is_named_and_training_goes_on_with_it(wrapper, tmp_path):
    env = DummyVecEnv(_broken("raise"))
    model = small_model(env if wrapper is None else wrapper(env))
    message = "Environment 1 raised RuntimeError: the simulation exploded.*after 38 steps"
    with pytest.raises(EnvironmentFailedError, match=message) as raised:
        model.learn(100)
    assert isinstance(raised.value.__cause__, RuntimeError)
    if wrapper is None:
        _assert_intact(model, 38, tmp_path)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 58


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
@pytest.mark.parametrize(
    ("says", "said"),
    [
        ("it fell", "RuntimeError: it fell. The step"),
        ("It fell.", "RuntimeError: It fell. The step"),
        ("why?\n", "RuntimeError: why? The step"),
        ("", "raised RuntimeError. The step"),
    ],
)
def test_what_an_environment_says_stays_apart_from_what_is_said_of_it(cls, says, said):
    model = small_model(_Broken("raise", at_step=3, says=says), cls=cls)
    with pytest.raises(EnvironmentFailedError, match=re.escape(said)):
        model.learn(10)
    with pytest.raises(EnvironmentFailedError, match=re.escape(said)):
        small_model(_Broken("raise", at_step=0, says=says), cls=cls).learn(10)


def test_an_environment_is_named_whatever_else_stands_around_it():
    """Each wrapper that a model was given has a guard of its own, around one count of environments."""
    env = DummyVecEnv(_broken("raise", at_step=3))
    small_model(VecFrameStack(env, 2))
    with pytest.raises(EnvironmentFailedError, match="Environment 1 raised RuntimeError"):
        small_model(env).learn(10)
    env = DummyVecEnv(_broken("raise", at_step=3))
    small_model(env)
    with pytest.raises(EnvironmentFailedError, match="Environment 1 raised RuntimeError"):
        small_model(VecFrameStack(env, 2)).learn(10)


def test_an_environment_that_raises_at_reset_is_named():
    model = small_model(DummyVecEnv(_broken("raise", at_step=0)))
    with pytest.raises(EnvironmentFailedError, match="Environment 1 raised RuntimeError"):
        model.learn(10)
    assert model.learn(10).num_timesteps == 10


def test_an_interrupted_episode_is_cut_and_not_joined_to_the_next(tmp_path):
    model = small_model(_Broken("raise", at_step=13), learning_starts=100)
    with pytest.raises(EnvironmentFailedError):
        model.learn(20)
    model.learn(10, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.endings[:13, 0].nonzero()[0].tolist() == [4, 9, 11]  # two whole episodes, and one of which a step is lost
    assert not np.array_equal(buffer.next_observations["partial"][11, 0], buffer.observations["partial"][12, 0])


def test_a_guard_is_not_seen_by_what_compares_environments():
    """As SB3's callbacks and ``sync_envs_normalization`` do."""
    env = VecNormalize(DummyVecEnv([TwoViewBandit]))
    inner = env.venv
    models = [small_model(env) for _ in range(2)]
    models[0].set_env(env)
    assert models[0].get_env() is env
    assert env.venv is inner
    assert type(inner) is DummyVecEnv


def test_an_environment_is_guarded_once(monkeypatch):
    calls = []
    monkeypatch.setattr("sb3_gac.checks.observations.is_finite", lambda *args: calls.append(args) or True)
    env = VecNormalize(DummyVecEnv([TwoViewBandit] * 3))
    for _ in range(3):
        model = small_model(env, learning_starts=1000)
    model.set_env(env)
    model.learn(3)
    assert len(calls) == 2 + 3  # two entries at the reset; two and the reward in the step, of all environments at once


class _Rewarding(TwoViewBandit):
    """Returns its reward in some other form, or too little, from a step on."""

    def __init__(self, form, at_step=3):
        super().__init__(length=100)
        self.form, self.at_step = form, at_step

    def step(self, action):
        observation, reward, *rest = super().step(action)
        if self._step == self.at_step and self.form is None:
            return observation, reward, *rest[1:]
        return observation, self.form(reward) if self._step == self.at_step else reward, *rest


@pytest.mark.parametrize(
    "form", [lambda r: np.array([r]), lambda r: [r], lambda r: np.array([r, r]), lambda r: np.array([[r]])]
)
@pytest.mark.parametrize("vectorize", [lambda env_fns: env_fns[0](), DummyVecEnv, lambda f: VecNormalize(DummyVecEnv(f))])
def test_a_reward_that_is_no_number_is_named(form, vectorize):
    model = small_model(vectorize([lambda: _Rewarding(form)]), learning_starts=100)
    message = r"Environment 0 raised .*Its reward must be a single number, such as float\(reward\[0\]\)"
    with pytest.raises(EnvironmentFailedError, match=message):
        model.learn(10)
    assert model.replay_buffer.pos == 2


def test_a_reward_that_is_no_number_is_named_from_subprocesses():
    env = _subprocesses([lambda: _Rewarding(lambda reward: np.array([reward]), at_step=1)] * 2)
    with pytest.raises(InvalidStepError, match=r'"reward" of environment 0 has shape \(1,\), expected \(\)'):
        small_model(env, learning_starts=100).learn(20)
    env.close()


def test_other_errors_of_a_step_are_not_put_down_to_the_reward():
    with pytest.raises(EnvironmentFailedError, match="not enough values to unpack") as raised:
        small_model(_Rewarding(None)).learn(10)
    assert "reward" not in str(raised.value)


# --- shapes, types and spaces --------------------------------------------------------------------------------------------


class _Misfit(TwoViewBandit):
    """Returns something else than its space says from one step on, or as an episode's last observation."""

    def __init__(self, key, value, at_step, length=100, space=None):
        super().__init__(length=length)
        if space is not None:
            self.observation_space.spaces[key] = space
        self.key, self.value, self.at_step = key, value, at_step

    def _draw(self):
        observation = super()._draw()
        if self.observation_space[self.key].dtype.kind != "f":
            observation[self.key] = self.observation_space[self.key].sample()
        if self._step >= self.at_step:
            if self.value is None:
                del observation[self.key]
            else:
                observation[self.key] = self.value
        return observation


BYTES = spaces.Box(0, 255, (2,), np.uint8)
MISFITS = {
    "longer": ("partial", np.zeros(3, np.float32), r"has shape \(3,\), expected \(2,\)", None),
    "broadcasts": ("partial", np.zeros(1, np.float32), r"has shape \(1,\), expected \(2,\)", None),
    "scalar": ("partial", 0.5, r"has shape \(\), expected \(2,\)", None),
    "row": ("partial", np.zeros((1, 2), np.float32), r"has shape \(1, 2\), expected \(2,\)", None),
    "text": ("privileged", "far", "is of type str, expected numbers", None),
    "ragged": ("partial", [[1.0], [1.0, 2.0]], "is not an array", None),
    "missing": ("privileged", None, "is missing", None),
    "too large for float32": ("partial", np.full(2, 1e300), "has type float64 and values that the expected float32", None),
    "fractions for bytes": (
        "partial",
        np.full(2, 0.5, np.float32),
        "has type float32 and values that the expected",
        BYTES,
    ),
    "too large for bytes": ("partial", np.full(2, 300), "has type int64 and values that the expected uint8", BYTES),
    "choice out of range": ("privileged", 4, r"holds 4, which is not in Discrete\(4\)", spaces.Discrete(4)),
    "bit out of range": ("privileged", np.array([2, 0]), "holds .2, 0., which is not in MultiBinary", spaces.MultiBinary(2)),
}


@pytest.mark.parametrize("vectorize", [DummyVecEnv, _subprocesses], ids=["dummy", "subprocess"])
@pytest.mark.parametrize("misfit", MISFITS)
def test_an_observation_that_does_not_fit_its_space_is_named(misfit, vectorize):
    key, value, message, space = MISFITS[misfit]
    env = vectorize([lambda n=n: _Misfit(key, value, at_step=n, space=space) for n in (100, 7)])
    model = small_model(env, learning_starts=100)
    with pytest.raises(InvalidStepError, match=rf'entry "{key}" of environment 1 {message}.*after 12 steps'):
        model.learn(40)
    assert model.replay_buffer.pos == 6
    env.close()


@pytest.mark.parametrize("misfit", MISFITS)
def test_a_last_observation_that_does_not_fit_is_named(misfit):
    key, value, message, space = MISFITS[misfit]
    model = small_model(_Misfit(key, value, at_step=6, length=6, space=space), learning_starts=100)
    with pytest.raises(InvalidStepError, match=rf'last observation\'s entry "{key}" of environment 0 {message}'):
        model.learn(40)
    assert model.replay_buffer.pos == 5
