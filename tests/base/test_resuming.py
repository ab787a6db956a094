"""Training 2 N steps is N, a checkpoint, another process, and N: to the bit."""

import random
import shutil
import subprocess
import sys
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_gac import GAC, PRESETS, RMA, AsymmetricMPO, AsymmetricSAC, CheckpointError
from sb3_gac.envs import SensorNoise
from sb3_gac.replay.shown import CUT
from sb3_gac.training.environments import normalized
from tests.envs.rendering import needs_rendering
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model
from tests.registry import algorithms, make

N = 40


def _bandits(n_envs=1, cls=TwoViewBandit):
    return DummyVecEnv([lambda: cls(noise_std=0.2, length=7)] * n_envs)


def _hopper(n_envs=2):
    return make_vec_env("sb3_gac/Hopper-v5", n_envs, seed=1, env_kwargs={"noise_std": 0.1})


def _hopper_from_pixels():
    needs_rendering()
    return make_vec_env("sb3_gac/HopperPixels-v5", 2, seed=1, env_kwargs={"size": 36})


IMAGES = {
    "policy_kwargs": {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}},
    "role_keys": {"critic": ["privileged"], "guider": ["privileged"]},
    "replay_buffer_kwargs": {"frame_stacks": {"partial": 3}},
    "buffer_size": 50,
    "batch_size": 4,
    "random_shift": 4,
}
GRU = {
    "policy_kwargs": {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]},
    "batch_size": 4,
    "policy": "MultiInputGruPolicy",
}
CASES = {  # name -> environment, algorithm and arguments
    "mujoco": (_hopper, GAC, {}),
    "normalised": (lambda: VecNormalize(_hopper()), GAC, {}),
    "as Brax has it": (
        lambda: normalized(_bandits(), PRESETS["paper-brax"].normalization()),
        GAC,
        {
            "policy_kwargs": {"net_arch": [8], "softplus_min_std": 0.001, "initialization": "lecun_uniform"},
            "replay_buffer_kwargs": {"mask_truncations": True},
        },
    ),
    "a full buffer": (_bandits, GAC, {"buffer_size": 50}),
    "n-step, half precision": (_hopper, GAC, {"n_steps": 3, "replay_buffer_kwargs": {"storage_dtype": "float16"}}),
    "a schedule": (
        _bandits,
        GAC,
        {"learning_rate": LinearSchedule(1e-2, 1e-4, 1.0), "target_kl": LinearSchedule(0.1, 0.01, 1.0)},
    ),
    "action noise": (_bandits, GAC, {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))}),
    "by episode": (_bandits, GAC, {"train_freq": (1, "episode"), "gradient_steps": -1}),
    "independent": (_bandits, GAC, {"guider": "independent"}),
    "lagged": (_bandits, GAC, {"guider": "lagged", "guidance": "linear 0.3 -> 0.0"}),
    "asymmetric SAC": (lambda: _bandits(3), AsymmetricSAC, {"gradient_steps": 2}),
    "asymmetric MPO, recurrent": (lambda: DummyVecEnv([Recall] * 2), AsymmetricMPO, GRU),
    "discrete": (lambda: _bandits(2, TwoViewChoice), GAC, {}),
    "recurrent": (lambda: DummyVecEnv([Recall] * 2), GAC, GRU),
    "two phases, a full buffer": (lambda: _bandits(2), RMA, {"history": 4, "buffer_size": 100}),
    "two phases, discrete": (lambda: _bandits(1, TwoViewChoice), RMA, {"history": 1, "phase_1_steps": N}),
    "images": (_hopper_from_pixels, GAC, IMAGES),
    "warm-up": (_bandits, GAC, {"learning_starts": N + 20}),
}


def _model(name):
    make_env, cls, arguments = CASES[name]
    return small_model(make_env(), cls, **arguments)


def _assert_same(one, other):
    for name, parameters in one.get_parameters().items():
        th.testing.assert_close(other.get_parameters()[name], parameters, rtol=0, atol=0)
    if hasattr(one, "replay_buffer"):
        for name, rows in one.replay_buffer.rows_by_name().items():
            np.testing.assert_array_equal(other.replay_buffer.rows_by_name()[name], rows, err_msg=name)
    np.testing.assert_equal(other._last_obs, one._last_obs)
    assert (other.num_timesteps, other._n_updates, other._episode_num) == (one.num_timesteps, one._n_updates, one._episode_num)
    assert [info["r"] for info in other.ep_info_buffer] == [info["r"] for info in one.ep_info_buffer]


def _check_resumed_is_uninterrupted(make_model, make_env, directory):
    whole = make_model().learn(3 * N)
    part = make_model()
    _learn_until(part, 3 * N, N, directory)
    again = part.resume(directory, make_env(), device="cpu")
    _learn_until(again, again.steps_left, 2 * N, directory, reset_num_timesteps=False)
    last = part.resume(directory, make_env(), device="cpu")
    assert 0 < last.steps_left < 2 * N
    last.learn(last.steps_left, reset_num_timesteps=False)
    _assert_same(whole, last)


@algorithms()
def test_resumed_training_is_the_uninterrupted_one(algorithm, tmp_path):
    _check_resumed_is_uninterrupted(lambda: make(algorithm, _bandits(2), seed=0), lambda: _bandits(2), tmp_path)


@pytest.mark.parametrize("name", CASES)
def test_resumed_training_is_the_uninterrupted_one_whatever_the_settings(name, tmp_path):
    _check_resumed_is_uninterrupted(lambda: _model(name), CASES[name][0], tmp_path)


class Succeeds(Recall):
    """Tells whether it was done right."""

    def step(self, action):
        *result, done, truncated, info = super().step(action)
        return *result, done, truncated, info | ({"is_success": self.np_random.random() < 0.5} if done else {})


#: Attributes of a model that are not what training has done so far: other objects that do the same, or a process's own
NOT_PROGRESS = {"env", "policy", "replay_buffer", "_logger", "start_time", "_vec_normalize_env", "action_noise", "_last_use"}
NOT_PROGRESS |= {"coefficients"}  # whose tensors are compared with the networks'
OF_RESUMING = {
    "_saved_blocks",
    "_resumed",
    "_resumed_noise",
    "resumed_notes",
    "learn_scope",
    "chooses_behaviour",
    "frozen",
    "_saved_scales",  # normalised_scales is compared
    "_normaliser",
    "_rewards_to_compare",
}


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_every_attribute_of_a_resumed_model_is_what_it_was(cls, tmp_path):
    """Whatever training changes: a name that is forgotten in what is written down is found here."""

    def make_env():
        return VecNormalize(DummyVecEnv([lambda n=n: Monitor(Succeeds(n)) for n in (3, 4)]))

    model = small_model(make_env(), cls, **GRU).learn(20)
    _learn_until(model, 120, 90, tmp_path, reset_num_timesteps=False)
    resumed = cls.resume(tmp_path, make_env(), device="cpu")
    assert len(model.ep_success_buffer) > 0
    assert model._behaviour_state is not None
    names = set(vars(model)) - NOT_PROGRESS - OF_RESUMING
    assert names >= {"num_timesteps", "_n_updates", "_last_obs", "ep_info_buffer", "trained_normalised"}
    for name in sorted(names | {"normalised_scales"}):
        before, after = getattr(model, name), getattr(resumed, name)
        if _can_be_compared(before):
            np.testing.assert_equal(_plain(after), _plain(before), err_msg=name)


def _can_be_compared(value):
    return isinstance(value, (int, float, str, np.ndarray, list, tuple, dict, deque, type(None)))


def _plain(value):
    return list(value) if isinstance(value, deque) else value


def _draw_of_everyone(model):
    """What each generator gives next that environments, noise, buffers and policies may draw from."""
    return random.random(), np.random.random(), th.rand(1).item(), model.action_space.sample().item()


def test_every_generator_goes_on_where_it_was(tmp_path):
    model = small_model().learn(20)
    _draw_of_everyone(model)  # so that none is where the seed puts it
    model.save_checkpoint(tmp_path)
    expected = _draw_of_everyone(model)
    resumed = GAC.resume(tmp_path, TwoViewBandit(), device="cpu")
    assert _draw_of_everyone(resumed) == expected


class _InterruptedError(Exception):
    pass


def _learn_until(model, total, stop, directory, **arguments):
    """Learn as if for all steps, and be interrupted between two rollouts."""
    collect = model.collect_rollouts

    def interrupted(*args, **kwargs):
        if model.num_timesteps >= stop:
            model.save_checkpoint(directory)
            raise _InterruptedError
        return collect(*args, **kwargs)

    model.collect_rollouts = interrupted
    with pytest.raises(_InterruptedError):
        model.learn(total, **arguments)
    del model.collect_rollouts


SCRIPT = """
import sys, torch
from stable_baselines3.common.env_util import make_vec_env
from sb3_gac import GAC, ExactCheckpointCallback
torch.set_num_threads(1)
directory, mode = sys.argv[1:]
env = make_vec_env("sb3_gac/HalfCheetah-v5", 1, seed=3, env_kwargs={"noise_std": 0.1})
if mode == "resume":
    model = GAC.resume(directory, env, device="cpu")
    model.learn(model.steps_left, reset_num_timesteps=False)
else:
    small = dict(learning_starts=50, batch_size=16, policy_kwargs={"net_arch": [16]})
    model = GAC("MultiInputPolicy", env, **small, seed=0, device="cpu")
    callback = ExactCheckpointCallback(directory, every=100, keep=1) if mode == "interrupt" else None
    if mode == "interrupt":
        save = model.save_checkpoint
        model.save_checkpoint = lambda *args: (save(*args), sys.exit())
    model.learn(300, callback=callback)
numbers = torch.cat([value.flatten().double() for value in model.get_parameters()["policy"].values()])
print(model.num_timesteps, model._n_updates, numbers.numpy().tobytes().hex())
"""


def _in_a_process(directory, mode):
    command = [sys.executable, "-c", SCRIPT, str(directory), mode]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1:]


def test_another_process_goes_on(tmp_path):
    assert _in_a_process(tmp_path, "interrupt") == []
    assert _in_a_process(tmp_path, "resume") == _in_a_process(tmp_path / "none", "whole")


# --- what is written --------------------------------------------------------------------------------------------------


def test_only_what_has_changed_of_the_buffer_is_written(tmp_path, monkeypatch):
    model = small_model(_bandits(), buffer_size=1_000)
    row_bytes = sum(rows[0].nbytes for rows in model.replay_buffer.rows_by_name().values())
    monkeypatch.setattr("sb3_gac.checkpoint.rows.BLOCK_BYTES", 50 * row_bytes)
    model.learn(400)
    model.save_checkpoint(tmp_path)
    before = {path.name for path in (tmp_path / "blocks").iterdir()}
    assert len(before) == 9  # 401 rows
    model.learn(30, reset_num_timesteps=False)
    model.save_checkpoint(tmp_path)
    assert len({path.name for path in (tmp_path / "blocks").iterdir()} - before) == 1
    resumed = GAC.resume(tmp_path, _bandits(), device="cpu")
    _assert_same(model, resumed)
    resumed.learn(10, reset_num_timesteps=False)
    resumed.save_checkpoint(tmp_path)
    assert len(before & {path.name for path in (tmp_path / "blocks").iterdir()}) == 8


@pytest.mark.parametrize("rows_per_block", [1, 3])
@pytest.mark.parametrize("buffer_size", [15, 1_000])
def test_each_checkpoint_has_every_row_that_changed_since_the_one_before(rows_per_block, buffer_size, tmp_path, monkeypatch):
    """The step before may have been cut since, and the newest next observation stands where the next step will be."""
    model = small_model(_bandits(), buffer_size=buffer_size)
    row_bytes = sum(rows[0].nbytes for rows in model.replay_buffer.rows_by_name().values())
    monkeypatch.setattr("sb3_gac.checkpoint.rows.BLOCK_BYTES", rows_per_block * row_bytes)
    for steps, reset in ((10, True), (1, True), (2, False), (1, False), (3, True), (20, False)):
        model.learn(steps, reset_num_timesteps=reset)
        model.save_checkpoint(tmp_path)
        _assert_same(model, GAC.resume(tmp_path, _bandits(), device="cpu"))
    assert (model.replay_buffer.endings == CUT).any() == (buffer_size == 1_000)


def _empty(model, path):
    model.replay_buffer.reset()


def _load_another(model, path):
    small_model(_bandits(), buffer_size=1_000, seed=9).learn(15).save_replay_buffer(path / "buffer")
    model.load_replay_buffer(path / "buffer")


def _relabel(model, path):
    model.replay_buffer.rewards[:] += 1
    model.replay_buffer.mark_changed()


@pytest.mark.parametrize("change", [_empty, _load_another, _relabel])
@pytest.mark.parametrize("further_steps", [2, 30, 60])
def test_a_checkpoint_has_the_rows_of_the_present_buffer(change, further_steps, tmp_path, monkeypatch):
    """The buffer then holds fewer rows than at the checkpoint before, as many, or more."""
    model = small_model(_bandits(), buffer_size=1_000, learning_starts=1_000)
    row_bytes = sum(rows[0].nbytes for rows in model.replay_buffer.rows_by_name().values())
    monkeypatch.setattr("sb3_gac.checkpoint.rows.BLOCK_BYTES", 4 * row_bytes)
    model.learn(30)
    model.save_checkpoint(tmp_path)
    change(model, tmp_path)
    for _ in range(2):
        model.learn(further_steps, reset_num_timesteps=False)
        model.save_checkpoint(tmp_path)
        resumed = GAC.resume(tmp_path, _bandits(), device="cpu").replay_buffer
        assert resumed.n_added == model.replay_buffer.n_added
        for name, rows in model.replay_buffer.rows_by_name().items():
            np.testing.assert_array_equal(resumed.rows_by_name()[name][: resumed.n_added], rows[: resumed.n_added])


def test_notes_come_back(tmp_path):
    model = small_model().learn(20)
    model.save_checkpoint(tmp_path, notes={"evaluations": [1.5, None]})
    assert GAC.resume(tmp_path, TwoViewBandit(), device="cpu").resumed_notes == {"evaluations": [1.5, None]}


def test_nothing_in_a_checkpoint_is_a_pickle(tmp_path):
    path = small_model().learn(20).save_checkpoint(tmp_path)
    assert sorted(file.suffix for file in path.iterdir()) == [".json", ".json", ".npz", ".pt"]
    th.load(path / "tensors.pt", weights_only=True)
    with np.load(path / "arrays.npz", allow_pickle=False) as arrays:
        assert all(arrays[name].dtype != object for name in arrays.files)


# --- what can't be ----------------------------------------------------------------------------------------------------


def test_episodes_that_cannot_be_gone_on_with_are_named(tmp_path):
    class Unknown(gym.Wrapper):
        pass

    model = small_model(Unknown(TwoViewBandit(length=7))).learn(30)
    model.save_checkpoint(tmp_path)
    with pytest.warns(UserWarning, match=r"Starting new episodes: .*Unknown is: give it the methods checkpoint_state"):
        resumed = GAC.resume(tmp_path, Unknown(TwoViewBandit(length=7)), device="cpu")
    resumed.learn(30, reset_num_timesteps=False)
    assert resumed.num_timesteps == 60


def test_new_episodes_are_the_same_for_the_same_checkpoint_and_others_for_another(tmp_path):
    class Unknown(gym.Wrapper):
        pass

    starts = []
    for seed in (0, 1):
        small_model(Unknown(TwoViewBandit(length=7)), seed=seed).learn(15).save_checkpoint(tmp_path / str(seed))
        for _ in range(2):
            with pytest.warns(UserWarning, match="Starting new episodes"):
                resumed = GAC.resume(tmp_path / str(seed), Unknown(TwoViewBandit(length=7)), device="cpu")
            resumed.learn(1, reset_num_timesteps=False)
            starts.append(resumed.replay_buffer.observations["privileged"][15].item())
    assert starts[0] == starts[1]
    assert starts[2] == starts[3]
    assert starts[0] != starts[2]


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_new_training_begins_with_new_noise_and_the_resumed_one_does_not(goes_on, tmp_path):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))
    model = small_model(TwoViewBandit(length=100), action_noise=noise).learn(15)
    model.action_noise.noise_prev[:] = 1e6
    model.save_checkpoint(tmp_path)
    resumed = GAC.resume(tmp_path, TwoViewBandit(length=100), device="cpu")
    resumed.learn(3, reset_num_timesteps=not goes_on)
    assert (np.abs(resumed.action_noise.noise_prev) > 1e5) == goes_on


def test_subprocesses_start_new_episodes(tmp_path):
    env = SubprocVecEnv([TwoViewBandit] * 2)
    small_model(env).learn(30).save_checkpoint(tmp_path)
    with pytest.warns(UserWarning, match="SubprocVecEnv are in other processes"):
        resumed = GAC.resume(tmp_path, env, device="cpu")
    resumed.learn(20, reset_num_timesteps=False)
    env.close()


class OtherSpace(TwoViewBandit):
    def __init__(self):
        super().__init__()
        entries = {**self.observation_space.spaces, "privileged": spaces.Box(-2, 1, (1,), np.float32)}
        self.observation_space = spaces.Dict(entries)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (OtherSpace, r'entry "privileged": it is Box of shape \(1,\).*\[-2.\].*and was .*\[-1.\]'),
        (lambda: _bandits(2), "env must be 1 environments, as before, but it is 2"),
        (lambda: VecNormalize(_bandits()), r"env is wrapped in \['VecNormalize'\], but the checkpoint's was wrapped in \[\]"),
    ],
)
def test_another_environment_is_refused(env, message, tmp_path):
    small_model(_bandits()).learn(20).save_checkpoint(tmp_path)
    with pytest.raises(ValueError, match=message):
        GAC.resume(tmp_path, env(), device="cpu")


class Wide(TwoViewBandit):
    """Bounds that differ in the middle of a long entry only."""

    def __init__(self, middle):
        super().__init__()
        low = np.zeros(40, dtype=np.float32)
        low[20] = middle
        entries = {**self.observation_space.spaces, "extra": spaces.Box(low, np.ones(40, dtype=np.float32))}
        self.observation_space = spaces.Dict(entries)

    def _draw(self):
        return super()._draw() | {"extra": np.full(40, 0.5, dtype=np.float32)}


def test_a_bound_in_the_middle_of_a_long_entry_counts(tmp_path):
    small_model(Wide(-1.0)).learn(20).save_checkpoint(tmp_path)
    with pytest.raises(ValueError, match="differs from the checkpoint's in the observation's entry \"extra\""):
        GAC.resume(tmp_path, Wide(-2.0), device="cpu")


class OwnGAC(GAC):
    """A subclass of a user's."""


def test_a_subclass_of_ones_own_goes_on(tmp_path):
    model = small_model(cls=OwnGAC).learn(20)
    model.strict_deployment = True
    model.save_checkpoint(tmp_path)
    resumed = OwnGAC.resume(tmp_path, TwoViewBandit(), device="cpu")
    _assert_same(model, resumed)
    assert resumed.strict_deployment
    with pytest.raises(CheckpointError, match="OwnGAC: resume it with that class, not GAC"):
        GAC.resume(tmp_path, TwoViewBandit(), device="cpu")


def test_blocks_that_somebody_removed_are_written_again(tmp_path):
    model = small_model(_bandits()).learn(40)
    model.save_checkpoint(tmp_path)
    shutil.rmtree(tmp_path)
    model.save_checkpoint(tmp_path)
    _assert_same(model, GAC.resume(tmp_path, _bandits(), device="cpu"))


def test_another_algorithm_is_refused(tmp_path):
    small_model().learn(20).save_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match=r"is of sb3_gac.gac.gac.GAC: resume it with that class, not AsymmetricSAC"):
        AsymmetricSAC.resume(tmp_path, TwoViewBandit())


def test_arguments_that_no_file_can_hold_are_asked_for(tmp_path):
    kwargs = {"net_arch": [16], "activation_fn": type("Mine", (th.nn.ReLU,), {})}
    model = small_model(policy_kwargs=kwargs, learning_rate=lambda left: 1e-3).learn(20)
    model.save_checkpoint(tmp_path)
    with pytest.raises(ValueError, match=r"pass them to resume\(\) as before: learning_rate .*; policy_kwargs .*Mine"):
        GAC.resume(tmp_path, TwoViewBandit(), device="cpu")
    resumed = GAC.resume(tmp_path, TwoViewBandit(), device="cpu", policy_kwargs=kwargs, learning_rate=1e-3)
    _assert_same(model, resumed)


def test_other_replay_buffers_are_refused(tmp_path):
    with pytest.raises(TypeError, match="but replay_buffer_class is DictReplayBuffer: leave it out, or use save"):
        small_model(replay_buffer_class=DictReplayBuffer).save_checkpoint(tmp_path)


def test_noise_goes_on_where_it_was(tmp_path):
    env = SensorNoise(TwoViewBandit(length=1_000), 0.5)
    model = small_model(env).learn(200)
    model.save_checkpoint(tmp_path)
    other = SensorNoise(TwoViewBandit(length=1_000), 0.5)
    GAC.resume(tmp_path, other, device="cpu")
    action = np.zeros(1, dtype=np.float32)
    np.testing.assert_equal(other.step(action)[0], env.step(action)[0])
