"""Other environments than before, given in the middle of training, and environments that are copied or closed."""

import os
import pickle
import signal
import warnings

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_gac.checks.environments import guard_of
from sb3_gac.envs import SensorNoise
from tests.base.test_collecting import KINDS, _model, kinds
from tests.diary import Diary, DiaryEnv, assert_true_and_whole, stored_transitions
from tests.helpers import TwoViewBandit, small_model


class _Changes(BaseCallback):
    """Gives the model other environments after so many steps, as a curriculum does."""

    def __init__(self, when, at, env):
        super().__init__()
        self.when, self.at, self.env = when, at, env

    def _change_if(self, when):
        if self.when == when and self.num_timesteps >= self.at and self.model.get_env() is not self.env:
            self.model.set_env(self.env)

    def _on_training_start(self):
        self._change_if("training start")

    def _on_rollout_start(self):
        self._change_if("rollout start")

    def _on_step(self):
        self._change_if("step")
        return True


@kinds
@pytest.mark.parametrize(("when", "at"), [("training start", 0), ("rollout start", 12), ("step", 10)])
def test_a_callback_may_give_other_environments(cls, policy, buffer, when, at):
    diary = Diary()
    model = _model(diary.envs(2), cls, policy, buffer, train_freq=3)
    other = diary.envs(2)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "The training environments were stepped")
        model.learn(36, callback=_Changes(when, at, other))
    assert_true_and_whole(model, diary)
    assert {where[0] for where, *_ in stored_transitions(model)} == ({2, 3} if at == 0 else {0, 1, 2, 3})


@pytest.mark.parametrize("kind", KINDS[-3:])
@pytest.mark.parametrize("how", ["load", "set_env"])
@pytest.mark.parametrize("steps_before", [0, 7])
def test_without_a_forced_reset_other_environments_do_not_go_on_with_the_episode(kind, how, steps_before, tmp_path):
    """Not even where they were used as often as those before."""
    diary = Diary()
    env, other = diary.envs(1), diary.envs(1)
    _model(other, *kind).learn(steps_before)
    model = _model(env, *kind).learn(7)
    diary.entries = {where: entry for where, entry in diary.entries.items() if where[0] == 0}
    if how == "set_env":
        model.set_env(other, force_reset=False)
    else:
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")
        model = kind[0].load(tmp_path / "model", env=other, force_reset=False)
        model.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    with pytest.warns(UserWarning, match="force_reset=False was given with others than before"):
        model.learn(7, reset_num_timesteps=False)
    assert_true_and_whole(model, diary)


def test_without_a_forced_reset_the_same_environments_go_on():
    diary = Diary()
    env = diary.envs(2)
    model = _model(env).learn(14)
    model.set_env(env, force_reset=False)
    model.learn(14, reset_num_timesteps=False)
    assert_true_and_whole(model, diary)
    assert {where for where, *_ in stored_transitions(model) if where[0] == 0} == {(0, t // 5, t % 5) for t in range(14)}


def test_a_copy_of_an_environment_that_was_trained_in():
    """It is itself, counts its own steps, and goes to other processes, as SubprocVecEnv's closures do."""
    env = Monitor(DiaryEnv(Diary()))
    model = _model(env).learn(7)
    uses = guard_of(model.get_env()).uses
    copy = pickle.loads(pickle.dumps(env))
    assert copy.unwrapped.where == env.unwrapped.where
    copy.reset()
    copy.step(copy.action_space.sample())
    assert copy.unwrapped.where != env.unwrapped.where
    assert guard_of(model.get_env()).uses == uses
    other = Diary()
    copy.unwrapped.diary = other
    assert_true_and_whole(_model(copy).learn(14), other)


# --- environments in other processes -----------------------------------------------------------------------------------------


def _processes():
    env = SubprocVecEnv([lambda: TwoViewBandit(length=5)] * 2, start_method="fork")
    return env, _model(env).learn(4)


@pytest.mark.parametrize("why", ["died", "cut off"])
def test_environments_are_closed_whatever_became_of_their_processes(why):
    env, _ = _processes()
    if why == "died":
        os.kill(env.processes[0].pid, signal.SIGKILL)
        env.processes[0].join()
    else:
        env.remotes[1].torn = True  # as after an interrupt within a message
    env.close()
    assert not [process for process in env.processes if process.is_alive()]
    env.close()


@pytest.mark.parametrize("call", ["reset", "step"])
def test_a_reset_by_env_method_is_noticed(call):
    env, model = _processes()
    env.env_method("checkpoint_state")
    model.learn(2, reset_num_timesteps=False)
    arguments = [env.action_space.sample()] if call == "step" else []
    env.env_method(call, *arguments, indices=[1])
    with pytest.warns(UserWarning, match="stepped or reset from outside the training"):
        model.learn(4, reset_num_timesteps=False)
    env.close()


def test_environments_in_this_process_are_closed_as_before():
    env = DummyVecEnv([lambda: DiaryEnv(Diary())])
    _model(env).learn(4)
    env.close()


@pytest.mark.parametrize("cls", [DummyVecEnv, SubprocVecEnv])
def test_a_setting_is_set_on_all_of_several_sensors_and_on_nothing_else(cls):
    noisy = [lambda: Monitor(SensorNoise(SensorNoise(TwoViewBandit(), 0.1), 0.1, key="privileged"))]
    env = small_model(cls(noisy)).env
    env.set_attr("noise_std", 100.0)
    values = np.abs([np.concatenate([values[0] for values in env.reset().values()]) for _ in range(20)])
    assert (values.max(axis=0) > 50).all()
    if cls is DummyVecEnv:
        assert env.envs[0].unwrapped.noise_std == 0.0, "what the environment calls so is no setting of a wrapper"
    env.close()


@pytest.mark.parametrize(("name", "argument"), [("steps", "delay"), ("probability", "drop")])
def test_a_setting_of_a_wrapper_that_is_not_there_is_refused(name, argument):
    model = small_model(DummyVecEnv([lambda: Monitor(TwoViewBandit())]))
    with pytest.raises(ValueError, match=f"{name} can't be set, .* or make a registered task with {argument} above 0"):
        model.env.set_attr(name, 1)
    assert name not in vars(model.env.unwrapped.envs[0])


def _noisy(n_envs, cls):
    return cls([lambda: Monitor(SensorNoise(TwoViewBandit(), 0.1))] * n_envs)


@pytest.mark.parametrize("cls", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize])
def test_an_attribute_is_set_on_the_layer_that_has_it(cls, wrap):
    """SB3 sets it on Monitor, where it does nothing, and get_attr then says that it did."""
    model = small_model(wrap(_noisy(2, cls)))
    model.env.set_attr("noise_std", 0.4)
    model.env.set_attr("noise_std", 0.7, indices=1)
    assert np.ravel(model.env.get_attr("noise_std")).tolist() == pytest.approx([0.4, 0.7])
    model.learn(10)
    if cls is DummyVecEnv:
        assert [float(env.env.noise_std) for env in model.env.unwrapped.envs] == pytest.approx([0.4, 0.7])
        assert "noise_std" not in vars(model.env.unwrapped.envs[0])
    with pytest.warns(UserWarning, match="No layer of the environments has 'of_nobody'"):
        model.env.set_attr("of_nobody", 3)
    assert model.env.get_attr("of_nobody") == [3, 3]
    model.env.close()
