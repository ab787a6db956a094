"""Checkpoints on a schedule and on signals."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_gac import GAC, DivergenceError, ExactCheckpointCallback, GPOPenalty
from sb3_gac.checkpoint.files import checkpoints, step_of
from tests.helpers import TwoViewBandit, small_model


def _steps(directory):
    return [step_of(path) for path in checkpoints(directory)]


def test_schedule(tmp_path):
    model = small_model(TwoViewBandit(length=5))
    model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=30, keep=2, notes=lambda: model.num_timesteps))
    assert _steps(tmp_path) == [90, 60]
    resumed = GAC.resume(tmp_path, TwoViewBandit(length=5), device="cpu")
    assert (resumed.resumed_notes, resumed.steps_left) == (90, 10)
    resumed.learn(resumed.steps_left, reset_num_timesteps=False, callback=ExactCheckpointCallback(tmp_path, every=30))
    assert (resumed.num_timesteps, _steps(tmp_path)) == (100, [90, 60])


class _LongAtFirst(TwoViewBandit):
    """An episode of 35 steps, and then of 5."""

    def __init__(self):
        super().__init__(length=35)

    def step(self, action):
        result = super().step(action)
        self.length = 5 if result[2] else self.length
        return result


def test_after_a_late_checkpoint_the_next_one_is_as_many_steps_away(tmp_path):
    model = small_model(_LongAtFirst(), train_freq=(1, "episode"))
    model.learn(70, callback=ExactCheckpointCallback(tmp_path, every=10, keep=9))
    assert _steps(tmp_path) == [65, 55, 45, 35]


def test_an_error_after_a_signal_is_not_hidden_by_it(tmp_path):
    """The process ends by the error, unless it is that of environments that the signal has ended."""

    class Failing(TwoViewBandit):
        def step(self, action):
            os.kill(os.getpid(), signal.SIGTERM)
            return super().step(action)

    def fails(*scope):
        raise RuntimeError("of another kind")

    callback = [ExactCheckpointCallback(tmp_path, every=30), ConvertCallback(fails)]
    with pytest.warns(UserWarning, match="SIGTERM"), pytest.raises(RuntimeError, match="of another kind"):
        small_model(Failing()).learn(100, callback=callback)
    assert _steps(tmp_path) == []


def test_a_signal_in_the_last_step_ends_the_process_and_not_the_next_training(tmp_path):
    class Signalling(TwoViewBandit):
        def step(self, action):
            if model.num_timesteps == 19:
                os.kill(os.getpid(), signal.SIGTERM)
            return super().step(action)

    model = small_model(TwoViewBandit()).learn(20)
    n_updates = model._n_updates
    model = small_model(Signalling())
    callback = ExactCheckpointCallback(tmp_path, every=100)
    with pytest.warns(UserWarning, match="SIGTERM"), pytest.raises(SystemExit, match="143"):
        model.learn(20, callback=callback)
    resumed = type(model).resume(tmp_path, Signalling(), device="cpu")
    assert (resumed.num_timesteps, resumed._n_updates) == (20, n_updates), "the last round of gradient steps as well"
    assert model.learn(20, callback=callback, reset_num_timesteps=False).num_timesteps == 40


@pytest.mark.parametrize("kind", ["episodes", "rollouts"])
def test_a_signal_does_not_wait_for_the_end_of_a_rollout(kind, tmp_path):
    """And training goes on as if there had been none."""

    def made(env):
        if kind == "episodes":
            return small_model(env, train_freq=(1, "episode"))
        return GPOPenalty("MultiInputPolicy", env, policy_kwargs={"net_arch": [8]}, n_steps=64, batch_size=16, seed=0)

    class Signalling(TwoViewBandit):
        def __init__(self):
            super().__init__(length=40)

        def step(self, action):
            if self.signals and model.num_timesteps == 12:
                os.kill(os.getpid(), signal.SIGTERM)
            return super().step(action)

    Signalling.signals, model = False, None
    undisturbed = made(Signalling())
    undisturbed.learn(128)
    Signalling.signals, model = True, made(Signalling())
    with pytest.warns(UserWarning, match="SIGTERM"), pytest.raises(SystemExit, match="143"):
        model.learn(128, callback=ExactCheckpointCallback(tmp_path, every=100))
    assert model.num_timesteps == 13
    Signalling.signals = False
    resumed = type(model).resume(tmp_path, Signalling(), device="cpu")
    resumed.learn(resumed.steps_left, reset_num_timesteps=False)
    for one, other in zip(resumed.policy.parameters(), undisturbed.policy.parameters(), strict=True):
        assert th.equal(one, other)


@pytest.mark.parametrize("argument", ["every", "keep"])
def test_bad_arguments(argument, tmp_path):
    with pytest.raises(ValueError, match=f"{argument} must be at least 1, got 0"):
        ExactCheckpointCallback(tmp_path, **{"every": 10, argument: 0})


def test_a_checkpoint_that_cannot_be_written_is_a_warning(tmp_path, monkeypatch):
    model = small_model(TwoViewBandit(length=5))
    save = model.save_checkpoint

    def failing(*args, **kwargs):
        if model.num_timesteps > 30:
            raise OSError(28, "No space left on device")
        return save(*args, **kwargs)

    monkeypatch.setattr(model, "save_checkpoint", failing)
    with pytest.warns(UserWarning, match=r"after 60 steps could not be written to .*No space left.* Training goes on"):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=30))
    assert (model.num_timesteps, _steps(tmp_path)) == (100, [30])


SCRIPT = """
import sys
from sb3_gac import ExactCheckpointCallback
from tests.helpers import TwoViewBandit, small_model
class Signalling(TwoViewBandit):
    def step(self, action):
        if model.num_timesteps == 40:
            import os
            os.kill(os.getpid(), int(sys.argv[2]))
        return super().step(action)
model = small_model(Signalling(length=5))
model.learn(10**6, callback=ExactCheckpointCallback(sys.argv[1], every=10**6))
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, -signal.SIGINT)])
def test_signals_finish_the_step_and_end_the_process(number, status, tmp_path):
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), str(int(number))]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == status, result.stderr
    name = signal.Signals(number).name
    assert f"Stopped by {name}; the checkpoint after 41 steps is in {tmp_path}" in result.stderr
    assert 'GAC.resume("' in result.stderr
    assert _steps(tmp_path) == [41]


def test_handlers_are_put_back(tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    seen = []
    watch = ConvertCallback(lambda scope, _: seen.append(signal.getsignal(signal.SIGTERM)) or True)
    small_model().learn(20, callback=[ExactCheckpointCallback(tmp_path, every=100), watch])
    assert before not in seen
    assert signal.getsignal(signal.SIGTERM) is before


def test_handlers_are_put_back_after_an_error(tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(DivergenceError):
        small_model(_Exploding(length=5), batch_size=64).learn(100, callback=ExactCheckpointCallback(tmp_path, every=100))
    assert signal.getsignal(signal.SIGTERM) is before


class _Exploding(TwoViewBandit):
    """Rewards whose squares are not finite, from step 41 on."""

    def step(self, action):
        observation, reward, *rest = super().step(action)
        self.steps = getattr(self, "steps", 0) + 1
        return observation, 1e30 if self.steps > 40 else reward, *rest


def test_diverged_training_leaves_the_last_good_checkpoint(tmp_path):
    model = small_model(_Exploding(length=5), batch_size=64)
    with pytest.raises(DivergenceError):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=10, keep=2))
    assert max(_steps(tmp_path)) == 40
    resumed = GAC.resume(tmp_path, TwoViewBandit(length=5), device="cpu")
    assert all(bool(value.isfinite().all()) for value in resumed.get_parameters()["policy"].values())


class _Hanging(TwoViewBandit):
    """Tells that it hangs, and does, until it is interrupted."""

    def step(self, action):
        os.kill(os.getpid(), signal.SIGINT)
        self.hung = True
        os.kill(os.getpid(), signal.SIGINT)
        raise AssertionError("the second interrupt was kept")


def test_a_second_interrupt_gets_through_at_once(tmp_path):
    """In the middle of a step, which may never end; what was stored stays, and the next learn starts from a reset."""
    env = _Hanging()
    model = small_model(env)
    with pytest.warns(UserWarning, match="SIGINT: the step is finished.*second one ends"), pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=30))
    assert env.hung
    assert (_steps(tmp_path), model._last_obs) == ([], None)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class _TellingAll(TwoViewBandit):
    """Sends Ctrl-C as a terminal does: to the process that trains and to its own."""

    def step(self, action):
        self._step_count = getattr(self, "_step_count", 0) + 1
        if self._step_count == 15:
            os.kill(os.getppid(), signal.SIGINT)
            raise KeyboardInterrupt
        return super().step(action)


@pytest.mark.filterwarnings("ignore:SIGINT")
def test_ctrl_c_in_a_terminal_ends_the_environments_too_and_makes_a_checkpoint(tmp_path):
    env = SubprocVecEnv([_TellingAll, TwoViewBandit], start_method="fork")
    model = small_model(env)
    with pytest.raises(KeyboardInterrupt, match="the checkpoint after 28 steps is in"):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=1000))
    assert _steps(tmp_path) == [28]
    with pytest.warns(UserWarning, match="Starting new episodes"):
        resumed = GAC.resume(tmp_path, DummyVecEnv([TwoViewBandit] * 2), device="cpu")
    assert resumed.learn(8, reset_num_timesteps=False).replay_buffer.pos == 18


def test_a_replay_buffer_that_no_checkpoint_can_hold_is_refused_before_training(tmp_path):
    model = small_model(TwoViewBandit(length=5), replay_buffer_class=DictReplayBuffer)
    with pytest.raises(TypeError, match="replay_buffer_class is DictReplayBuffer: leave it out, or use save"):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=30))
    assert model.num_timesteps == 0


def test_notes_that_no_checkpoint_can_hold_are_refused_before_training(tmp_path):
    model = small_model(TwoViewBandit(length=5))
    with pytest.raises(TypeError, match="notes must be what JSON can hold"):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=30, notes=lambda: {"env": model.env}))
    assert model.num_timesteps == 0
    with pytest.raises(TypeError, match="notes must be what JSON can hold"):
        model.save_checkpoint(tmp_path, notes={"env": model.env})
    assert list(tmp_path.iterdir()) == []


def test_notes_may_have_numbers_of_other_libraries_and_nothing_to_note_at_first(tmp_path):
    model, seen = small_model(TwoViewBandit(length=5)), []
    watch = ConvertCallback(lambda scope, _: seen.append(scope["self"].num_timesteps) or True)

    def notes():
        return {"last": np.float32(seen[-1]), "mean": th.tensor(0.5), "all": np.arange(2), "lines": ({"step": np.int64(3)},)}

    model.learn(40, callback=[watch, ExactCheckpointCallback(tmp_path, every=30, notes=notes)])
    resumed = GAC.resume(tmp_path, TwoViewBandit(length=5), device="cpu")
    assert resumed.resumed_notes == {"last": 30.0, "mean": 0.5, "all": [0, 1], "lines": [{"step": 3}]}


@pytest.mark.parametrize(
    ("every", "found"), [(1000, "no checkpoint is in"), (20, "the checkpoint before the one that failed is in")]
)
def test_a_signal_ends_the_process_whatever_keeps_the_checkpoint_from_being_made(every, found, tmp_path):
    class Signalling(TwoViewBandit):
        def step(self, action):
            if model.num_timesteps == 30:
                os.kill(os.getpid(), signal.SIGTERM)
            return super().step(action)

    def notes():
        if model.num_timesteps > 30:
            raise RuntimeError("nothing to note")

    model = small_model(Signalling(length=5))
    with (
        pytest.warns(UserWarning, match="SIGTERM: the step is finished"),
        pytest.warns(UserWarning, match=f"Stopped by SIGTERM; {found}"),
        pytest.warns(UserWarning, match="after 31 steps could not be written to .*RuntimeError: nothing to note.* is lost"),
        pytest.raises(SystemExit, match="143"),
    ):
        model.learn(100, callback=ExactCheckpointCallback(tmp_path, every=every, notes=notes))
