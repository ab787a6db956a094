"""All steps that were taken are stored and none is invented, whoever stops, interrupts or uses the environments."""

import os
import signal
import threading
import warnings
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    ConvertCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize

from sb3_gac import GAC, RMA, AsymmetricSAC, EnvironmentFailedError, InvalidStepError
from sb3_gac.checks import processes
from sb3_gac.checks.environments import guard_of
from sb3_gac.checks.processes import WatchedPipe, end_processes
from sb3_gac.checks.uses import SuspiciousEnds
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from tests.diary import Diary, DiaryEnv, assert_true_and_whole, stored_transitions
from tests.helpers import TwoViewBandit, small_model
from tests.registry import classes

ALGORITHMS = classes("replay")
KINDS = [
    *((cls, "MultiInputPolicy", CompactDictReplayBuffer) for cls in ALGORITHMS),
    (GAC, "MultiInputPolicy", DictReplayBuffer),
    (GAC, "MultiInputGruPolicy", None),
    (AsymmetricSAC, "MultiInputLstmPolicy", None),
]
kinds = pytest.mark.parametrize(("cls", "policy", "buffer"), KINDS)


def _model(env, cls=GAC, policy="MultiInputPolicy", buffer=None, **arguments):
    small = {"net_arch": [4]}
    if policy != "MultiInputPolicy":
        small |= {"rnn_hidden_size": 4, "rnn_net_arch": []}
    defaults = {"learning_starts": 6, "batch_size": 4, "policy_kwargs": small, "replay_buffer_class": buffer}
    return small_model(env, cls, policy=policy, **{**defaults, **arguments})


class _StopAfter(BaseCallback):
    """Ends ``learn`` after so many calls."""

    def __init__(self, calls):
        super().__init__()
        self.calls = calls

    def _on_step(self):
        return self.n_calls < self.calls


# --- a callback ends learn() ---------------------------------------------------------------------------------------------


@kinds
@pytest.mark.parametrize(
    ("n_envs", "terminates", "resets"), [(1, True, False), (1, False, True), (3, True, True), (3, False, False)]
)
def test_a_callback_that_stops_takes_no_step_away(cls, policy, buffer, n_envs, terminates, resets):
    diary = Diary()
    model = _model(diary.envs(n_envs, terminates=terminates), cls, policy, buffer)
    for calls in (1, 5, 6, 3, 5):
        model.learn(1000, callback=_StopAfter(calls), reset_num_timesteps=resets)
        assert len(diary.entries) == len(stored_transitions(model))
    assert_true_and_whole(model, diary)
    assert model.num_timesteps == n_envs * (5 if resets else 20)


@kinds
def test_one_episode_a_learn_trains_on_it(cls, policy, buffer):
    """The last step of an episode is what makes it whole."""
    diary = Diary()
    model = _model(DummyVecEnv([lambda: DiaryEnv(diary, terminates=True)]), cls, policy, buffer)
    for episodes in range(1, 5):
        model.learn(1000, callback=StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
        assert model.replay_buffer.dones.sum() == episodes
    assert model._n_updates > 0
    assert_true_and_whole(model, diary)


@pytest.mark.parametrize(
    ("train_freq", "gradient_steps"), [(1, 1), (4, -1), (4, 2), ((1, "episode"), -1), ((2, "episode"), 3)]
)
@pytest.mark.parametrize(("cls", "policy"), [(GAC, "MultiInputPolicy"), (AsymmetricSAC, "MultiInputGruPolicy")])
def test_stopping_and_going_on_is_as_not_stopping(cls, policy, train_freq, gradient_steps):
    """To the bit: the same steps, and the gradient steps between them."""
    models = []
    for stops in ((40,), (3, 4, 5, 1, 5, 12, 10)):
        settings = {"train_freq": train_freq, "gradient_steps": gradient_steps}
        model = _model(DummyVecEnv([lambda: DiaryEnv(Diary(), length=5)]), cls, policy, **settings)
        for calls in stops:
            model.learn(40 - model.num_timesteps, callback=_StopAfter(calls), reset_num_timesteps=False)
        assert model.num_timesteps == 40
        models.append(model.learn(10, reset_num_timesteps=False))
    assert models[0]._n_updates == models[1]._n_updates > 0
    for ours, theirs in zip(*(model.policy.state_dict().values() for model in models), strict=True):
        np.testing.assert_array_equal(ours.numpy(), theirs.numpy())


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_reward_threshold_stops_with_the_step_stored(n_envs):
    diary, other = Diary(), Diary()
    model = _model(diary.envs(n_envs))
    stop = StopTrainingOnRewardThreshold(-1e9, verbose=0)
    callback = EvalCallback(other.envs(1), callback_on_new_best=stop, eval_freq=7, n_eval_episodes=1, verbose=0, warn=False)
    for learned in (1, 2):
        callback.n_calls, callback.best_mean_reward = 0, -np.inf
        model.learn(1000, callback=callback, reset_num_timesteps=False)
        assert model.num_timesteps == 7 * n_envs * learned
    assert_true_and_whole(model, diary)


def test_callbacks_see_sb3s_names():
    seen = []
    model = _model(Diary().envs(2))
    model.learn(4, callback=ConvertCallback(lambda names, _: seen.append(dict(names)) or True))
    for name in ("self", "env", "actions", "buffer_actions", "new_obs", "rewards", "dones", "infos", "replay_buffer"):
        assert name in seen[-1], name
    assert (seen[-1]["num_collected_steps"], seen[-1]["num_collected_episodes"]) == (1, 0)


def test_a_new_training_begins_with_a_rollout_of_its_own():
    """Not in the middle of the one that a callback ended."""
    starts = []

    class Starts(_StopAfter):
        def _on_rollout_start(self):
            starts.append(self.model.num_timesteps)

    model = _model(Diary().envs(1), train_freq=6)
    model.learn(1000, callback=Starts(4))
    model.learn(12, callback=Starts(100))
    assert starts == [0, 0, 6]


@pytest.mark.parametrize(("log_interval", "steps"), [(3, ["16", "30", "40"]), (4, ["20", "40"]), (8, ["40"])])
def test_episodes_and_logs_are_counted(log_interval, steps, tmp_path):
    """Where two episodes end at once, either may be the one after which a log is due."""
    from stable_baselines3.common.logger import configure

    model = _model(Diary().envs(2, length=4))  # episodes of four and of five steps
    logger = configure(str(tmp_path), ["csv"])
    model.set_logger(logger)
    model.learn(40, log_interval=log_interval)  # ends at steps 4, 5, 8, 10, 12, 15, 16, 20 and 20
    assert model._episode_num == 9
    lines = (tmp_path / "progress.csv").read_text().splitlines()
    columns = lines[0].split(",")
    logged = [dict(zip(columns, line.split(","), strict=True)) for line in lines[1:]]
    assert [row["time/total_timesteps"] for row in logged] == steps


@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise_starts_anew_with_each_episode(n_envs):
    seen = []

    class Noise(NormalActionNoise):
        def reset(self):
            seen.append("reset")

    class Seen(VectorizedActionNoise):
        def reset(self, indices=None):
            seen.append(tuple(indices or ()))
            super().reset(indices)

    base = Noise(np.zeros(2), 0.1 * np.ones(2))
    model = _model(Diary().envs(n_envs, length=4), action_noise=base if n_envs == 1 else Seen(base, n_envs))
    model.learn(n_envs)
    seen.clear()
    model.learn(9 * n_envs, reset_num_timesteps=False)
    at_ends = [entry for entry in seen if entry]
    assert at_ends.count("reset") + at_ends.count((0,)) >= 2
    if n_envs == 2:
        assert [entry for entry in at_ends if entry != "reset"] == [(0,), (1,), (0,), (1,)]


# --- interrupts ------------------------------------------------------------------------------------------------------------


@kinds
@pytest.mark.parametrize(("n_envs", "at"), [(1, 0), (1, 4), (1, 5), (3, 0), (3, 12), (3, 13)])
def test_after_an_interrupt_nothing_is_invented(cls, policy, buffer, n_envs, at):
    diary = Diary()
    model = _model(diary.envs(n_envs), cls, policy, buffer)
    diary.interrupt_in = at * n_envs + n_envs // 2
    with pytest.raises(KeyboardInterrupt):
        model.learn(100)
    assert model.num_timesteps == at * n_envs
    model.learn(14 * n_envs, reset_num_timesteps=False)
    assert_true_and_whole(model, diary, but=n_envs // 2)
    assert model.num_timesteps == (at + 14) * n_envs


@pytest.mark.parametrize("where", ["train", "callback", "rollout start"])
def test_an_interrupt_between_steps_keeps_all_of_them(where, monkeypatch):
    diary = Diary()
    model = _model(diary.envs(2))

    def interrupt(*args, **kwargs):
        if model.num_timesteps >= 18:
            raise KeyboardInterrupt
        return True

    callback = BaseCallback.__new__(_StopAfter)
    BaseCallback.__init__(callback)
    callback._on_step = interrupt if where == "callback" else lambda: True
    callback._on_rollout_start = interrupt if where == "rollout start" else lambda: None
    if where == "train":
        monkeypatch.setattr(model, "train", interrupt)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=callback)
    monkeypatch.undo()
    episodes = {where[:2] for where in diary.entries}
    model.learn(20, reset_num_timesteps=False)
    assert_true_and_whole(model, diary)
    after = [where for where in diary.entries if where[:2] not in episodes]
    assert (0, max(episode for _, episode in episodes) + 1, 0) in after, "no clean reset"


class _Slow(TwoViewBandit):
    """Tells the parent that a step has begun, and takes its time; partial shows the last action."""

    def __init__(self, started=None, number=0):
        super().__init__(length=7)
        self.observation_space["partial"] = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.started, self.number, self.last = started, number, 0.0

    def step(self, action):
        self.last = float(action[0])
        if self.started is not None:
            self.started.wait(0.3)
        return super().step(action)

    def _draw(self):
        return super()._draw() | {"partial": np.array([self.number, self.last], np.float32)}


def _raise_in(seconds):
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    return timer


@pytest.mark.parametrize("start_method", ["fork", "forkserver"])
def test_answers_of_processes_belong_to_their_requests(start_method):
    """The observation shows the action: after the interrupt, that of the same step, not of the one before."""
    env = SubprocVecEnv([lambda i=i: _Slow(threading.Event(), i) for i in range(2)], start_method=start_method)
    model = _model(env)
    timer = _raise_in(0.75)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100)
    timer.join()
    stored = model.replay_buffer.pos
    model.learn(8, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.pos == stored + 4
    shown = buffer.next_observations["partial"][: buffer.pos, :, 1]
    np.testing.assert_allclose(shown, buffer.actions[: buffer.pos, :, 0], atol=1e-6)
    assert env.get_attr("number") == [0, 1]
    env.close()


def test_a_process_that_an_interrupt_ended_is_named():
    """Ctrl-C in a terminal reaches the environments' processes too."""
    env = SubprocVecEnv([lambda: _Slow(threading.Event())] * 2, start_method="fork")
    model = _model(env)

    def interrupt_all():
        for process in env.processes:
            os.kill(process.pid, signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(0.5, interrupt_all)
    timer.start()
    with pytest.raises((KeyboardInterrupt, EnvironmentFailedError)):
        model.learn(100)
    timer.join()
    stored = model.replay_buffer.pos
    with pytest.raises(EnvironmentFailedError, match=r"environment (0|1|unknown) .*set_env"):
        model.learn(10, reset_num_timesteps=False)
    assert model.replay_buffer.pos == stored
    model.set_env(SubprocVecEnv([_Slow] * 2, start_method="fork"))
    model.learn(10, reset_num_timesteps=False)
    assert model.replay_buffer.pos == stored + 5
    model.get_env().close()


class _FakePipe:
    """Answers in order; an interrupt comes when told."""

    def __init__(self):
        self.requests, self.interrupt_at = [], None

    def _maybe(self, what):
        if self.interrupt_at == what:
            self.interrupt_at = None
            raise KeyboardInterrupt

    def send(self, request):
        self._maybe("send")
        self.requests.append(request)

    def poll(self, timeout=0.0):
        self._maybe("poll")
        return bool(self.requests)

    def recv(self):
        self._maybe("recv")
        return f"answer to {self.requests.pop(0)[0]}"


def test_a_pipe_throws_away_what_nobody_fetched():
    fake = _FakePipe()
    pipe = WatchedPipe(fake, None)
    pipe.send(("step", 1))
    fake.interrupt_at = "poll"
    with pytest.raises(KeyboardInterrupt):
        pipe.recv()
    pipe.send(("reset", None))
    assert pipe.recv() == "answer to reset"
    assert pipe.recv() is None  # and does not wait for ever


@pytest.mark.parametrize("what", ["send", "recv"])
def test_a_message_that_was_cut_in_two_ends_the_pipe(what):
    fake = _FakePipe()
    pipe = WatchedPipe(fake, None)
    if what == "recv":
        pipe.send(("step", 1))
    fake.interrupt_at = what
    with pytest.raises(KeyboardInterrupt):
        pipe.send(("step", 1)) if what == "send" else pipe.recv()
    assert pipe.torn
    with pytest.raises(EOFError):
        pipe.send(("reset", None))


class _FakeProcess:
    """Has ended with an exit code, of which the parent knows once it has waited; or lives, until it is killed."""

    def __init__(self, code):
        self.code, self.exitcode, self.alive, self.sentinel = code, None, code is None, self

    def terminate(self):
        """It does not listen."""

    def join(self, timeout):
        pass

    def kill(self):
        self.alive = False


@pytest.mark.parametrize(
    ("torn", "said"), [((), "environment 1 (exit code -9) died"), ((0,), "environment 0 was interrupted")]
)
def test_who_has_died_is_waited_for_and_all_others_end(torn, said, monkeypatch):
    def wait(sentinels, timeout):
        for process in sentinels:
            process.exitcode = process.code

    monkeypatch.setattr(processes, "wait", wait)
    remotes = [SimpleNamespace(torn=index in torn, close=lambda: None) for index in range(2)]
    env = SimpleNamespace(remotes=remotes, processes=[_FakeProcess(None), _FakeProcess(-9)])
    assert said in end_processes(env)
    assert not any(process.alive for process in env.processes)
    assert (env.waiting, env.closed) == (False, True)
    env.processes[1].exitcode = -9  # one that was known to have died comes before what was interrupted
    assert "environment 1 (exit code -9) died" in end_processes(env)


# --- somebody else uses the environments -----------------------------------------------------------------------------------


@kinds
@pytest.mark.parametrize("how", ["callback", "between", "the environment itself", "reset"])
def test_evaluation_on_the_training_environments_is_said_and_not_stored(cls, policy, buffer, how):
    diary = Diary()
    inner = DiaryEnv(diary)
    model = _model(inner if how == "the environment itself" else DummyVecEnv([lambda: inner]), cls, policy, buffer)

    def evaluate(*args):
        if how == "callback" and model.num_timesteps not in (9, 18):
            return True
        diary.training = False
        if how == "reset":
            model.get_env().reset()
        else:
            env = inner if how == "the environment itself" else model.get_env()
            evaluate_policy(model, env, n_eval_episodes=1, warn=False)
        diary.training = True
        return True

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model.learn(24, callback=ConvertCallback(evaluate) if how == "callback" else None)
        if how != "callback":
            evaluate()
        model.learn(12, reset_num_timesteps=False)
    assert sum("stepped or reset from outside the training" in str(warning.message) for warning in said) == 1
    assert_true_and_whole(model, diary)
    assert len(diary.entries) == 36


def test_an_environment_of_its_own_is_no_reason_to_warn(recwarn):
    diary, other = Diary(), Diary()
    model = _model(diary.envs(2))
    model.learn(30, callback=EvalCallback(other.envs(1), eval_freq=5, n_eval_episodes=1, verbose=0, warn=False))
    evaluate_policy(model, other.envs(1), n_eval_episodes=1, warn=False)
    model.learn(10, reset_num_timesteps=False)
    model.set_env(diary.envs(2))
    model.learn(10, reset_num_timesteps=False)
    assert not [w for w in recwarn if "from outside" in str(w.message)]
    assert_true_and_whole(model, diary)


# --- environments that write into what they returned ------------------------------------------------------------------------


class _Aliased(DiaryEnv):
    def _observation(self):
        if not hasattr(self, "mine"):
            self.mine = super()._observation()
        for key, value in super()._observation().items():
            self.mine[key][...] = value
        return self.mine


class _AliasedVecEnv(VecEnvWrapper):
    """Returns the same arrays in each step, as simulators do that keep their state on a device."""

    def __init__(self, venv):
        super().__init__(venv)
        self.mine = None

    def _into_mine(self, *arrays):
        observation, *rest = arrays
        if self.mine is None:
            self.mine = (
                {key: value.copy() for key, value in observation.items()},
                np.zeros(self.num_envs),
                np.zeros(self.num_envs, bool),
            )
        for key, value in observation.items():
            self.mine[0][key][...] = value
        for mine, value in zip(self.mine[1:], rest, strict=False):
            mine[...] = value
        return self.mine

    def reset(self):
        return self._into_mine(self.venv.reset())[0]

    def step_wait(self):
        observation, rewards, dones, infos = self.venv.step_wait()
        return *self._into_mine(observation, rewards, dones), infos


class _ScribblingEnv(DiaryEnv):
    """Writes into the action that it gets."""

    def step(self, action):
        result = super().step(action)
        if isinstance(action, np.ndarray) and action.shape:
            action[...] = 2.0
        return result


@kinds
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("way", ["observations", "vectorised", "actions"])
def test_arrays_that_are_written_into_again(cls, policy, buffer, normalized, way):
    diary = Diary()
    kind = _ScribblingEnv if way == "actions" else _Aliased
    env = DummyVecEnv([lambda: kind(diary)] * 2) if way != "vectorised" else diary.envs(2)
    env = _AliasedVecEnv(env) if way == "vectorised" else env
    model = _model(VecNormalize(env) if normalized else env, cls, policy, buffer).learn(40)
    assert_true_and_whole(model, diary)


def test_a_wrapper_outside_that_writes_into_its_arrays_again():
    diary = Diary()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = _model(_AliasedVecEnv(VecNormalize(diary.envs(2), norm_obs=False, norm_reward=False))).learn(40)
    assert_true_and_whole(model, diary)


def test_an_action_that_is_written_into_is_stored_as_it_was_chosen():
    """Choices are handed on as they are, not scaled into new arrays."""

    class Scribbling(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_async(self, actions):
            self.venv.step_async(actions.copy())
            actions[...] = 0

        def step_wait(self):
            return self.venv.step_wait()

    diary = Diary()
    model = _model(Scribbling(diary.envs(2, discrete=True))).learn(40)
    assert_true_and_whole(model, diary)
    assert len(np.unique(model.replay_buffer.actions[:20])) == 3


def test_a_guard_returns_arrays_of_its_own():
    env = _AliasedVecEnv(Diary().envs(2))
    _model(env)
    first = env.reset()
    kept = {key: value.copy() for key, value in first.items()}
    results = []
    for _ in range(5):
        results.append(env.step(np.zeros((2, 2))))
    np.testing.assert_equal(first, kept)
    observation, rewards, dones, _ = results[0]
    assert observation["partial"][:, 2].tolist() == [1, 1]
    assert rewards.tolist() == [0, 0]
    assert not dones.any()
    assert results[-1][2].tolist() == [True, False]


def test_steps_of_others_count_as_resets_do():
    inner = DiaryEnv(Diary())
    guard = guard_of(_model(inner).get_env())
    assert guard.uses == 0
    inner.reset()
    assert guard.uses == 1
    inner.step(np.zeros(2))
    assert guard.uses == 2


def test_steps_of_others_count_in_processes_as_well():
    env = SubprocVecEnv([lambda: DiaryEnv(Diary())], start_method="fork")
    guard = guard_of(_model(env).get_env())
    counts = [guard.uses]
    for use in (env.reset, lambda: env.step(np.zeros((1, 2))), lambda: env.env_method("reset")):
        use()
        counts.append(guard.uses)
    assert counts[0] < counts[1] < counts[2] < counts[3]
    env.close()


def test_an_environment_in_two_vectorised_ones_ends_well_in_both():
    inner = _Aliased(Diary(), length=3)
    both = [DummyVecEnv([lambda: inner]) for _ in range(2)]
    for env in both:
        _model(env)
    for env in [*both, both[0]]:
        env.reset()
        finals = [env.step(np.zeros((1, 2)))[3][0].get("terminal_observation") for _ in range(3)]
        assert finals[:2] == [None, None]
        assert finals[2]["partial"][2] == 3


def test_equal_ends_must_be_in_a_row_to_be_suspicious(recwarn):
    ends = SuspiciousEnds()
    value = 0.0

    def end(is_equal):
        nonlocal value
        ends.look_at({"partial": np.float32([[value]])}, np.array([False]), [{}])
        value += 1
        final = {"partial": np.float32([value if is_equal else value + 0.5])}
        ends.look_at({"partial": np.float32([[value]])}, np.array([True]), [{"terminal_observation": final}])
        value += 1

    for is_equal in [True] * 4 + [False] + [True] * 4:
        end(is_equal)
    assert not recwarn
    with pytest.warns(UserWarning, match="each of the last 5 episodes"):
        end(True)


def test_one_that_does_so_in_another_process_is_said():
    env = SubprocVecEnv([lambda: _Aliased(Diary())], start_method="fork")
    with pytest.warns(UserWarning, match=r"last observation of each of the last 5 episodes is the first one of the next"):
        _model(env).learn(30)
    env.close()


def test_equal_observations_are_no_reason_to_warn(recwarn):
    class Constant(DiaryEnv):
        def _observation(self):
            return {"partial": np.ones(3, np.float32), "privileged": np.ones(1, np.float32)}

    _model(DummyVecEnv([lambda: Constant(Diary())])).learn(50)
    _model(SubprocVecEnv([lambda: DiaryEnv(Diary())], start_method="fork")).learn(50)
    assert not [w for w in recwarn if "last observation" in str(w.message)]


# --- what infos say of an episode's end --------------------------------------------------------------------------------------


class _Infos(VecEnvWrapper):
    """
    Tells of episodes' ends in one of several ways.

    :param how: "missing", "kept" (the same dicts in each step, told in even episodes only), "left" (never removed), "half"
        (the time limit alone never removed), "shared"
    """

    def __init__(self, venv, how):
        super().__init__(venv)
        self.how, self.kept = how, [{} for _ in range(venv.num_envs)]

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observation, rewards, dones, infos = self.venv.step_wait()
        if self.how == "shared":
            shared = {}
            for info in infos:
                shared.update({key: value for key, value in info.items() if value})
            return observation, rewards, dones, [shared] * self.num_envs
        for kept, info, done in zip(self.kept, infos, dones, strict=True):
            final = info.pop("terminal_observation", None)
            truncated = info.pop("TimeLimit.truncated")
            if self.how == "half":
                kept.pop("terminal_observation", None)
            if done and (self.how in ("left", "half") or (self.how == "kept" and final["partial"][1] % 2 == 0)):
                kept["terminal_observation"] = final
            if truncated:
                kept["TimeLimit.truncated"] = True
        return observation, rewards, dones, infos if self.how == "missing" else self.kept


@kinds
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("how", ["missing", "kept"])
def test_an_end_without_its_observation_is_named(cls, policy, buffer, normalized, how):
    diary = Diary()
    env = _Infos(diary.envs(2), how)
    model = _model(VecNormalize(env) if normalized else env, cls, policy, buffer)
    with pytest.raises(InvalidStepError, match=r'episode of environment [01] ended.*no "terminal_observation".*put it there'):
        model.learn(60)
    assert_true_and_whole(model, diary, but=2)


def test_as_many_infos_as_environments():
    class Fewer(_Infos):
        def step_wait(self):
            observation, rewards, dones, infos = self.venv.step_wait()
            return observation, rewards, dones, infos[:1]

    with pytest.raises(InvalidStepError, match=r"2 environments returned infos of shape \(1,\)"):
        _model(Fewer(Diary().envs(2), "")).learn(4)


class _Changed(VecEnvWrapper):
    """What a step returns goes through a function."""

    def __init__(self, venv, change):
        super().__init__(venv)
        self.change = change

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.change(*self.venv.step_wait())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda o, r, d, i: (o, r[:1], d, i), r"2 environments returned rewards of shape \(1,\)"),
        (lambda o, r, d, i: (o, r[0], d, i), r"2 environments returned rewards of shape \(\)"),
        (lambda o, r, d, i: (o, r, d[:, None], i), r"2 environments returned dones of shape \(2, 1\)"),
        (lambda o, r, d, i: (o, r, d[:1], i), r"2 environments returned dones of shape \(1,\)"),
        (lambda o, r, d, i: ({"partial": o["partial"]}, r, d, i), r'entry "privileged" is missing.*\[\'partial\'\]'),
        (lambda o, r, d, i: (o["partial"], r, d, i), r'entry "partial" is missing'),
    ],
)
@pytest.mark.parametrize("normalized", [False, True])
def test_what_is_not_there_for_each_environment_is_named(change, said, normalized):
    """Numpy would give one reward to all of them."""
    env = _Changed(Diary().envs(2), change)
    model = _model(VecNormalize(env) if normalized else env)
    with pytest.raises(InvalidStepError, match=said):
        model.learn(4)
    assert model.replay_buffer.size() == 0


class _Mixed(DiaryEnv):
    """Every other episode runs into its time limit, and the others terminate."""

    def reset(self, **kwargs):
        self.terminates = self.episode % 2 == 0
        return super().reset(**kwargs)


@kinds
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("how", ["left", "half"])
def test_what_was_left_in_an_info_does_not_count(cls, policy, buffer, normalized, how):
    """A time limit of an earlier episode, above all, must not make a later one bootstrap."""
    diary = Diary()
    env = _Infos(DummyVecEnv([lambda: _Mixed(diary)] * 2), how)
    model = _model(VecNormalize(env) if normalized else env, cls, policy, buffer).learn(60)
    assert_true_and_whole(model, diary)
    assert {ended[4:] for ended in stored_transitions(model) if ended[4]} == {(True, False), (True, True)}


def test_one_info_for_several_ends_is_refused():
    diary = Diary()
    env = DummyVecEnv([lambda: DiaryEnv(diary), lambda: (DiaryEnv(diary), DiaryEnv(diary))[1]])
    with pytest.raises(InvalidStepError, match=r"environments 0 and 1 ended, but they share one info"):
        _model(_Infos(env, "shared")).learn(60)


def test_one_info_for_one_end_is_taken():
    diary = Diary()
    model = _model(_Infos(diary.envs(2), "shared"))
    model.learn(10)  # the first ends after five steps, the second has six
    assert_true_and_whole(model, diary)


# --- sequences of events --------------------------------------------------------------------------------------------------


EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("learn"), st.integers(1, 9), st.booleans()),
        st.tuples(st.just("stop"), st.integers(1, 9), st.booleans()),
        st.tuples(st.just("interrupt"), st.integers(0, 9), st.booleans()),
        st.tuples(st.just("evaluate"), st.integers(1, 2), st.booleans()),
        st.tuples(st.just("save and load"), st.integers(1, 3), st.booleans()),
        st.tuples(st.just("resume"), st.integers(0, 1), st.booleans()),
        st.tuples(st.just("set_env"), st.integers(0, 1), st.booleans()),
    ),
    min_size=2,
    max_size=7,
)


class _Story:
    """A model, its environments, and what happens to both."""

    def __init__(self, directory, kind, n_envs, length, terminates):
        self.directory, self.n_envs = directory, n_envs
        self.env_kwargs = {"length": length, "terminates": terminates, "discrete": kind[0] is AsymmetricSAC}
        self.diary, self.lost = Diary(), 0
        self.model = _model(self.diary.envs(n_envs, **self.env_kwargs), *kind, train_freq=2)

    def happens(self, event, number, flag):
        getattr(self, event.replace(" ", "_"))(number, flag)
        assert_true_and_whole(self.model, self.diary, self.lost)

    def learn(self, steps, resets):
        self.model.learn(steps * self.n_envs, reset_num_timesteps=resets)

    def stop(self, calls, resets):
        self.model.learn(1000, callback=_StopAfter(calls), reset_num_timesteps=resets)

    def interrupt(self, at, resets):
        self.diary.interrupt_in = at
        with pytest.raises(KeyboardInterrupt):
            self.model.learn(1000, reset_num_timesteps=resets)
        self.lost += at % self.n_envs

    def evaluate(self, episodes, between):
        self.diary.training = False
        evaluate_policy(self.model, self.model.get_env(), n_eval_episodes=episodes, warn=False)
        self.diary.training = True

    def save_and_load(self, n_envs, with_buffer):
        self.model.save(self.directory / "model")
        self.model.save_replay_buffer(self.directory / "buffer")
        if not with_buffer:  # another number of environments needs a new one
            self.n_envs, self.diary, self.lost = n_envs, Diary(), 0
        env = self.diary.envs(self.n_envs, **self.env_kwargs)
        self.model = type(self.model).load(self.directory / "model", env=env)
        if with_buffer:
            self.model.load_replay_buffer(self.directory / "buffer")

    def resume(self, number, flag):
        if isinstance(self.model.replay_buffer, CompactDictReplayBuffer):
            self.model.save_checkpoint(self.directory / "checkpoints")
            env = self.diary.envs(self.n_envs, **self.env_kwargs)
            self.model = type(self.model).resume(self.directory / "checkpoints", env)

    def set_env(self, number, same):
        env = self.model.get_env() if same else self.diary.envs(self.n_envs, **self.env_kwargs)
        self.model.set_env(env)


@settings(
    max_examples=30,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    database=None,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
)
@given(
    events=EVENTS,
    kind=st.sampled_from(KINDS),
    n_envs=st.integers(1, 3),
    length=st.integers(1, 6),
    terminates=st.booleans(),
)
@example(
    events=[("learn", 1, False), ("evaluate", 1, False), ("resume", 0, False)],
    kind=KINDS[0],
    n_envs=1,
    length=1,
    terminates=False,
)
def test_whatever_happens_the_buffer_holds_what_was_done(tmp_path_factory, events, kind, n_envs, length, terminates):
    story = _Story(tmp_path_factory.mktemp("story"), kind, n_envs, length, terminates)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for event in [*events, ("learn", 6, False)]:
            story.happens(*event)


# --- wrappers outside VecNormalize -------------------------------------------------------------------------------------------


class _Camera(DiaryEnv):
    """With an image, channels last, each channel with a value of its own, and the step in its first pixel."""

    def __init__(self, diary, **kwargs):
        super().__init__(diary, **kwargs)
        entries = {"camera": gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)}
        self.observation_space = gym.spaces.Dict({**self.observation_space.spaces, **entries})

    def _observation(self):
        image = np.broadcast_to(np.uint8([10, 20, 30]), (36, 36, 3)).copy()
        image[0, 0] = self.t
        return super()._observation() | {"camera": image}


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
@pytest.mark.parametrize("buffer", [CompactDictReplayBuffer, DictReplayBuffer])
def test_images_that_sb3_transposes_outside_vec_normalize(cls, buffer):
    """They are stored transposed, and all else raw, to be normalised with the newest statistics."""
    diary = Diary()
    env = VecNormalize(DummyVecEnv([lambda: _Camera(diary)] * 2), norm_obs_keys=["partial", "privileged"])
    model = _model(env, cls, buffer=buffer, role_keys={cls.policy_aliases["MultiInputPolicy"].roles.deployed: ["camera"]})
    model.learn(24)
    assert model.observation_space["camera"].shape == (3, 36, 36)
    assert_true_and_whole(model, diary)
    rows = model.replay_buffer.size()
    for held in (model.replay_buffer.observations, model.replay_buffer.next_observations):
        images = held["camera"][:rows]
        np.testing.assert_array_equal(
            images[..., 1:, 1:], np.broadcast_to(np.uint8([10, 20, 30])[:, None, None], (rows, 2, 3, 35, 35))
        )
        np.testing.assert_array_equal(images[..., 0, 0], np.broadcast_to(held["partial"][:rows, :, 2:], (rows, 2, 3)))
    sample = model._sample_batch(50)
    rms = env.obs_rms["partial"]
    raw = sample.observations["partial"].numpy() * np.sqrt(rms.var + env.epsilon) + rms.mean
    np.testing.assert_allclose(raw, raw.round(), atol=1e-4)


class _Shifted(VecEnvWrapper):
    """Changes observations, and nobody knows how."""

    def _shift(self, observation):
        return {key: value + 1000 for key, value in observation.items()}

    def reset(self):
        return self._shift(self.venv.reset())

    def step_wait(self):
        observation, rewards, dones, infos = self.venv.step_wait()
        for index in np.flatnonzero(dones):
            infos[index]["terminal_observation"] = self._shift(infos[index]["terminal_observation"])
        return self._shift(observation), rewards, dones, infos


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
@pytest.mark.parametrize("buffer", [CompactDictReplayBuffer, DictReplayBuffer])
@pytest.mark.parametrize("wrapper", ["VecFrameStack", "_Shifted"])
@pytest.mark.parametrize("norm_obs_keys", [["privileged"], None])
def test_what_is_changed_outside_vec_normalize_is_stored_as_it_is_seen(cls, buffer, wrapper, norm_obs_keys):
    make = {"VecFrameStack": lambda env: VecFrameStack(env, 3), "_Shifted": _Shifted}[wrapper]
    inner = VecNormalize(Diary().envs(2), norm_obs_keys=norm_obs_keys, gamma=0.9)
    with pytest.warns(UserWarning, match=rf"{wrapper} stands outside VecNormalize.*make it VecNormalize\({wrapper}\(env\)\)"):
        model = _model(VecMonitor(make(inner)), cls, buffer=buffer, train_freq=1, learning_starts=1000)
    seen, finals, rewards = [], [], []

    def watch(names, _):
        seen.append(names["new_obs"])
        finals.append([info.get("terminal_observation") for info in names["infos"]])
        rewards.append(inner.get_original_reward())
        return True

    model.learn(40, callback=ConvertCallback(watch))
    held, after = model.replay_buffer.observations, model.replay_buffer.next_observations
    for key in held:
        for row in range(1, 20):
            np.testing.assert_array_equal(held[key][row], seen[row - 1][key])
            for env, final in enumerate(finals[row]):
                np.testing.assert_array_equal(after[key][row, env], (final or {k: v[env] for k, v in seen[row].items()})[key])
    np.testing.assert_array_equal(model.replay_buffer.rewards[:20], rewards)
    sample = model._sample_batch(200)
    stored = {row.tobytes() for row in held["partial"][:20].reshape(40, -1)}
    assert {row.tobytes() for row in sample.observations["partial"].numpy()} <= stored  # as they are: not normalised again
    scale = np.sqrt(inner.ret_rms.var + inner.epsilon)
    assert {round(float(r), 3) for r in sample.rewards} <= {
        round(float(np.clip(r / scale, -10, 10)), 3) for r in np.ravel(rewards)
    }


class _Bonus(VecEnvWrapper):
    """Changes rewards, or ends all episodes after three steps and does not say where."""

    def __init__(self, venv, bonus=0.0, limit=1000):
        super().__init__(venv)
        self.bonus, self.limit = bonus, limit

    def reset(self):
        self.left = self.limit
        return self.venv.reset()

    def step_wait(self):
        observation, rewards, dones, infos = self.venv.step_wait()
        self.left -= 1
        return (observation, rewards + self.bonus, dones, infos) if self.left else (self.reset(), rewards, dones | True, infos)


@kinds
def test_rewards_that_are_changed_outside_vec_normalize_count(cls, policy, buffer):
    diary = Diary()
    model = _model(_Bonus(VecNormalize(diary.envs(2), norm_reward=False), 100.0), cls, policy, buffer).learn(24)
    for row, t in enumerate(range(4)):
        for env in range(2):
            assert model.replay_buffer.rewards[row, env] == pytest.approx(diary.entries[env, 0, t][1] + 100)


@kinds
def test_rewards_that_are_changed_after_they_were_normalised_are_refused(cls, policy, buffer):
    model = _model(_Bonus(VecNormalize(Diary().envs(2)), 100.0), cls, policy, buffer)
    with pytest.raises(ValueError, match=r"_Bonus stands outside VecNormalize and changes rewards.*VecNormalize\(_Bonus\("):
        model.learn(24)
    assert model.replay_buffer.size() == 0


def test_an_end_outside_vec_normalize_without_its_observation_is_named():
    model = _model(_Bonus(VecNormalize(Diary().envs(2)), limit=3))
    with pytest.raises(InvalidStepError, match=r'_Bonus ended an episode.*no "terminal_observation"'):
        model.learn(24)
    assert model.replay_buffer.size() == 2


@kinds
def test_raw_and_normalised_observations_are_not_mixed(cls, policy, buffer, tmp_path):
    """One of them would reach the networks as what it is not."""
    diary = Diary()
    make = [lambda: VecNormalize(diary.envs(2)), lambda: _Shifted(VecNormalize(diary.envs(2)))]
    for before, after in (make, make[::-1]):
        model = _model(before(), cls, policy, buffer).learn(12)
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")
        with pytest.raises(
            ValueError, match=r"replay buffer holds observations (raw|normalised).*wrap the environments as before"
        ):
            model.set_env(after())
        loaded = cls.load(tmp_path / "model", env=after())
        loaded.load_replay_buffer(tmp_path / "buffer")
        with pytest.raises(ValueError, match=r"replay buffer holds observations (raw|normalised).*leave the buffer out"):
            loaded.learn(4)
        again = cls.load(tmp_path / "model", env=before())
        again.load_replay_buffer(tmp_path / "buffer")
        assert again.learn(4).replay_buffer.size() == 8
        assert cls.load(tmp_path / "model", env=after()).learn(4).replay_buffer.size() == 2


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_named_outside_vec_normalize_too(value):
    class Spoils(_Shifted):
        def _shift(self, observation):
            observation = super()._shift(observation)
            observation["partial"][1, 0] = value if observation["partial"][1, 2] == 1003 else 0
            return observation

    model = _model(Spoils(VecNormalize(Diary().envs(2), norm_obs_keys=["privileged"])), learning_starts=1000)
    with pytest.raises(InvalidStepError, match=r'entry "partial" of environment 1 holds NaN or infinite'):
        model.learn(24)
    assert model.replay_buffer.size() == 2


def test_wrappers_that_only_watch_change_nothing():
    diary = Diary()
    env = VecMonitor(VecNormalize(diary.envs(2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = _model(env).learn(40)
    assert_true_and_whole(model, diary)


class _Goal(gym.Env):
    def __init__(self):
        box = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.observation_space = gym.spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def _observation(self):
        return {"observation": np.float32([self.x]), "achieved_goal": np.float32([self.x]), "desired_goal": np.float32([50.0])}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = 100.0 * self.np_random.integers(1, 1000), 0
        return self._observation(), {}

    def step(self, action):
        self.x, self.t = self.x + 1, self.t + 1
        return self._observation(), -1.0, False, self.t >= 6, {}

    def compute_reward(self, achieved, desired, info):
        return -(np.abs(achieved - desired).sum(-1) > 0.5).astype(np.float32)


def _her_model(env, **arguments):
    keys = {"learner": ["observation", "desired_goal"]}
    return _model(env, buffer=HerReplayBuffer, role_keys=keys, replay_buffer_kwargs={"n_sampled_goal": 4}, **arguments)


def test_goals_are_not_taken_from_another_episode():
    """A callback stops in the middle of an episode, and the next learn resets: hindsight must not look across."""
    model = _her_model(DummyVecEnv([_Goal] * 2))
    for _ in range(6):
        model.learn(1000, callback=_StopAfter(4))
    sample = model.replay_buffer.sample(400)
    relabelled = (sample.observations["desired_goal"] != 50).flatten()
    ahead = (sample.observations["desired_goal"] - sample.observations["observation"]).flatten()[relabelled]
    assert relabelled.any()
    assert ((ahead >= 1) & (ahead <= 6)).all()


@pytest.mark.parametrize("steps", [13, 20, 26, 40])
def test_goals_are_not_taken_from_another_episode_where_the_ring_begins_anew(steps):
    model = _her_model(DummyVecEnv([_Goal]), buffer_size=20).learn(steps)
    model.learn(8)
    sample = model.replay_buffer.sample(1000)
    relabelled = (sample.observations["desired_goal"] != 50).flatten()
    ahead = (sample.observations["desired_goal"] - sample.observations["observation"]).flatten()[relabelled]
    assert relabelled.any()
    assert ((ahead >= 1) & (ahead <= 6)).all()


class _Doubled(VecEnvWrapper):
    """Observations are twice what they are inside."""

    def reset(self):
        return {key: 2 * value for key, value in self.venv.reset().items()}

    def step_wait(self):
        observation, *rest = self.venv.step_wait()
        return {key: 2 * value for key, value in observation.items()}, *rest


def test_goals_that_would_be_stored_normalised_are_refused():
    with pytest.raises(ValueError, match=r"_Doubled stands outside VecNormalize.*HerReplayBuffer.*raw"):
        _her_model(_Doubled(VecNormalize(DummyVecEnv([_Goal]))))


def test_an_exported_policy_has_no_statistics_of_another_shape(tmp_path):
    from sb3_gac import export_learner

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = _model(VecFrameStack(VecNormalize(Diary().envs(1)), 3)).learn(20)
    with pytest.raises(ValueError, match=r"VecFrameStack stands outside VecNormalize.*normalizer="):
        export_learner(model, tmp_path / "policy.onnx")


def test_a_model_for_goals_that_was_just_loaded_has_no_episode_to_look_at(tmp_path):
    _her_model(_Goal(), learning_starts=20).learn(40).save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", env=_Goal(), learning_starts=100)
    loaded.compare_every, looks = 1, []
    loaded._judge_gain = lambda gain, error: looks.append(loaded.num_timesteps)
    loaded.learn(20, reset_num_timesteps=False)
    assert looks[0] == 46, "where the first episode ends"


@pytest.mark.parametrize(
    ("cls", "options", "says"),
    [
        (GAC, {"policy": "MultiInputGruPolicy"}, "give EpisodeReplayBuffer or a subclass"),
        (RMA, {"history": 2}, "can't sample what came before"),
    ],
)
def test_a_buffer_that_the_model_can_not_learn_from_is_not_loaded(cls, options, says, tmp_path):
    small_model(replay_buffer_class=DictReplayBuffer).learn(20).save_replay_buffer(tmp_path / "buffer")
    model = small_model(cls=cls, **options).learn(20)
    before = model.replay_buffer
    with pytest.raises(ValueError, match=says):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is before


SEQUENCES = {"sequence_length": 3, "burn_in": 1, "mask_truncations": True}


@pytest.mark.parametrize("own", [{}, {"sequence_length": 5}])
def test_a_loaded_buffer_is_sampled_as_the_models_arguments_say(own, tmp_path):
    options = {"policy": "MultiInputGruPolicy", "learning_starts": 1_000, "policy_kwargs": {"net_arch": [8]}}
    small_model(**options, replay_buffer_kwargs=SEQUENCES).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = small_model(**options, replay_buffer_kwargs=own)
    expected = {name: getattr(model.replay_buffer, name) for name in SEQUENCES}
    model.load_replay_buffer(tmp_path / "buffer")
    assert {name: getattr(model.replay_buffer, name) for name in SEQUENCES} == expected != SEQUENCES


@pytest.mark.parametrize("given", [{"gamma": 0.5}, {"n_steps": 3}])
def test_the_replay_buffers_discount_is_the_algorithms(given):
    (name,) = given
    with pytest.raises(ValueError, match=f"replay_buffer_kwargs has {name}=.*leave {name} out of replay_buffer_kwargs"):
        small_model(replay_buffer_kwargs=given)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_new_discount_counts_in_batches(n_steps):
    model = small_model(learning_starts=10, n_steps=n_steps).learn(20)
    model.gamma = 0.5
    model.learn(5, reset_num_timesteps=False)
    assert set(model._sample_batch(64).discounts.unique().tolist()) <= {0.5, 0.25, 0.125}
