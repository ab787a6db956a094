"""Vectorised environments over a simulator of many: what SB3 expects of them, on one whose every number is known."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_gac import GAC
from sb3_gac.envs import SensorNoise, make_vec
from sb3_gac.envs.state import layers
from sb3_gac.envs.suites import SUITES, batch_factory, is_batched, register
from sb3_gac.envs.vector.settings import reach_layers
from sb3_gac.envs.vector.single import SingleEnv
from tests.envs.vector_helpers import Counters, RestorableCounters
from tests.helpers import small_model

NO_ACTION = np.zeros((3, 1), dtype=np.float32)


@pytest.fixture
def counters_are_registered(monkeypatch):
    suite = SUITES["popgym"]._replace(module="tests.envs.vector_helpers", extra=None)
    monkeypatch.setitem(SUITES, "counters", suite)
    register("counters")
    yield
    gym.registry.pop("sb3_gac/Counters-v0")


def _started(n_envs=3, seed=7, **kwargs):
    env = Counters(n_envs, **kwargs)
    env.seed(seed)
    return env, env.reset()


def test_spaces_are_of_single_precision_and_the_split_is_as_told():
    env, first = _started(partial={"steps": None, "drawn": [0]}, privileged=["index"])
    assert env.observation_space["partial"].dtype == env.action_space.dtype == np.float32
    assert {key: values.dtype for key, values in first.items()} == {"partial": np.float32, "privileged": np.float32}
    assert first["privileged"].ravel().tolist() == [0, 1, 2]
    drawn = [np.random.default_rng(7 + index).random() for index in range(3)]
    assert first["partial"].tolist() == [[0, np.float32(number)] for number in drawn]


def test_episodes_end_where_the_simulator_or_the_limit_ends_them():
    env, _ = _started(time_limit=4)  # lengths 3, 4 and 4: by itself, by both, by the limit
    drawn = [np.random.default_rng(7 + index) for index in range(3)]
    numbers = [[generator.random() for _ in range(2)] for generator in drawn]
    for step in (1, 2, 3, 4):
        observation, rewards, dones, infos = env.step(NO_ACTION)
        assert rewards.tolist() == [10.0] * 3
        assert rewards.dtype == np.float32
        assert [info["doubled"] for info in infos] == [2 * step if step < 4 or index else 2 for index in range(3)]
        assert dones.tolist() == {3: [True, False, False], 4: [False, True, True]}.get(step, [False] * 3)
        cut = [info["TimeLimit.truncated"] for info in infos]
        assert cut == ([False, False, True] if step == 4 else [False] * 3), "an end of the task is none of the limit"
        for index in range(3):
            assert ("terminal_observation" in infos[index]) == ("episode" in infos[index]) == dones[index]
            shown = observation["privileged"][index]
            if dones[index]:
                last = infos[index]["terminal_observation"]["privileged"]
                assert last.tolist() == [step, index, np.float32(numbers[index][0])]
                assert shown.tolist() == [0, index, np.float32(numbers[index][1])], "the next episode's first"
                assert infos[index]["episode"]["r"] == 10.0 * step
                assert infos[index]["episode"]["l"] == step
    _, _, dones, infos = env.step(NO_ACTION)
    _, _, dones, infos = env.step(NO_ACTION)
    assert dones.tolist() == [True, False, False]
    assert infos[0]["episode"]["l"] == 3, "lengths are counted anew"


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float32])
def test_a_simulator_may_tell_ends_by_numbers(dtype):
    class Telling(Counters):
        def advance(self, actions):
            step = super().advance(actions)
            return step._replace(terminated=step.terminated.astype(dtype), truncated=np.array([0, 0, 1], dtype))

    env = Telling(3)
    env.seed(7)
    env.reset()
    for _ in range(3):
        *_, dones, infos = env.step(NO_ACTION)
    assert dones.dtype == bool
    assert dones.tolist() == [True, False, True]
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False, True], "a fall is none of the time limit"


def test_noise_is_drawn_once_for_each_observation_and_leaves_the_simulator_alone():
    (clean, first), (noisy, first_noisy) = _started(time_limit=3), _started(time_limit=3, noise_std=0.5)
    assert (first["partial"] != first_noisy["partial"]).all()
    for step in range(7):
        actions = np.full((3, 1), 0.1 * step, dtype=np.float32)
        (plain, _, dones, infos), (observation, _, _, noisy_infos) = clean.step(actions), noisy.step(actions)
        assert (observation["privileged"] == plain["privileged"]).all()
        assert (observation["partial"] != plain["partial"]).all()
        for index in np.flatnonzero(dones):
            last, noisy_last = (some[index]["terminal_observation"] for some in (infos, noisy_infos))
            noise_of_last = noisy_last["partial"] - last["partial"]
            noise_of_next = (observation["partial"] - plain["partial"])[index]
            assert (noise_of_last != 0).all()
            assert (noise_of_last != noise_of_next).all()


def test_another_noise_std_counts_from_the_next_step_on():
    env, first = _started(partial=["steps"])
    assert not first["partial"].any()
    env.set_attr("noise_std", 0.5)
    assert (env.step(NO_ACTION)[0]["partial"] != 1).all()
    env.set_attr("noise_std", 0.0)
    assert (env.step(NO_ACTION)[0]["partial"] == 2).all()
    with pytest.raises(ValueError, match="noise_std must be a finite number >= 0"):
        env.set_attr("noise_std", -1.0)
    with pytest.raises(ValueError, match="Counters has no attribute 'noise_st' that could be set"):
        env.set_attr("noise_st", 0.1)


def test_a_single_environment_passes_settings_on_to_its_simulator():
    env = SingleEnv(Counters(1, partial=["steps"]))
    vec_env = DummyVecEnv([lambda: Monitor(SensorNoise(env, 0.1, key="privileged"))])
    reach_layers(vec_env)
    vec_env.set_attr("time_limit", 2)
    vec_env.set_attr("noise_std", 0.5)
    assert (env.time_limit, env.noise_std) == (env.vec_env.time_limit, env.vec_env.noise_std) == (2, 0.5)
    assert vec_env.get_attr("noise_std")[0] == 0.5
    vec_env.reset()
    observation, *_ = vec_env.step(NO_ACTION[:1])
    assert (observation["partial"] != 1).all()
    assert vec_env.step(NO_ACTION[:1])[2].all()


def test_noise_is_gaussian_of_the_given_size_and_independent():
    env, first = _started(n_envs=2_000, noise_std=[0.5, 0.0])
    assert not np.isfinite(env.observation_space["partial"].high[0])
    noise = first["partial"]
    following = env.step(np.zeros((2_000, 1)))[0]["partial"] - [1.0, 0.0]
    assert (noise[:, 1] == 0).all()
    for sample in (noise[:, 0], following[:, 0]):
        assert abs(sample.mean()) < 4 * 0.5 / np.sqrt(2_000)
        assert sample.std() == pytest.approx(0.5, rel=4 / np.sqrt(2 * 2_000))
        assert abs((np.abs(sample) < 0.5).mean() - 0.6827) < 4 * np.sqrt(0.6827 * 0.3173 / 2_000)
    assert abs(np.corrcoef(noise[:, 0], following[:, 0])[0, 1]) < 4 / np.sqrt(2_000)


def test_a_seed_repeats_everything_once():
    env, first = _started(noise_std=1.0)
    second = env.reset()
    assert (second["privileged"][:, 2] != first["privileged"][:, 2]).all(), "seeds count for one reset"
    env.seed(7)
    again = env.reset()
    assert all((again[key] == first[key]).all() for key in first)
    other = _started(seed=8, noise_std=1.0)[1]
    assert (other["privileged"][:2, 2] == first["privileged"][1:, 2]).all(), "each environment has the next seed"
    np.random.seed(0)
    drawn = [Counters(3).reset()["privileged"][0, 2] for _ in range(2)]
    assert drawn[0] != drawn[1], "without one, it is random"


def test_observations_are_the_callers_to_keep():
    env, first = _started()
    kept = {key: values.copy() for key, values in first.items()}
    after = env.step(NO_ACTION)[0]
    assert all((first[key] == kept[key]).all() for key in first)
    after["partial"][:] = 99.0
    assert env.step(NO_ACTION)[0]["partial"][0, 0] == 2.0


def test_actions_are_clipped_to_their_space():
    env, _ = _started()
    observation, rewards, *_ = env.step(np.array([[3.0], [-3.0], [0.5]]))
    assert observation["partial"][:, 1].tolist() == [1.0, -1.0, 0.5]
    assert rewards.tolist() == [11.0, 9.0, 10.5]


def test_attributes_and_methods_are_the_simulators():
    env, _ = _started(time_limit=9)
    assert env.get_attr("time_limit") == [9, 9, 9]
    assert env.get_attr("time_limit", indices=1) == [9]
    assert not env.has_attr("no_such")
    env.set_attr("time_limit", 2)
    assert env.time_limit == 2
    with pytest.raises(ValueError, match="time_limit is one for all environments of Counters"):
        env.set_attr("time_limit", 3, indices=[0])
    calls = []
    env.of_the_test = lambda number, times=1: calls.append(number) or number * times
    assert env.env_method("of_the_test", 4, indices=[0, 2], times=2) == [8, 8]
    assert calls == [4]
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(gym.wrappers.TimeLimit, indices=[1]) == [False]


def test_a_monitor_around_it_counts_the_same():
    with pytest.warns(UserWarning, match="already wrapped"):
        env = VecMonitor(_started(time_limit=4)[0])
    env.reset()
    for _ in range(4):
        _, _, dones, infos = env.step(NO_ACTION)
    inner = _started(time_limit=4)[0]
    for _ in range(4):
        *_, inner_infos = inner.step(NO_ACTION)
    for index in np.flatnonzero(dones):
        assert {key: infos[index]["episode"][key] for key in "rl"} == {key: inner_infos[index]["episode"][key] for key in "rl"}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"n_envs": 0}, "n_envs must be"),
        ({"n_envs": True}, "n_envs must be"),
        ({"time_limit": 2.5}, "time_limit must be"),
        ({"noise_std": -1.0}, "noise_std must be"),
        ({"noise_std": [1.0] * 5}, "noise_std must be a number or have the entry's shape"),
        ({"partial": ["no_such"]}, '"no_such"'),
        ({"privileged": {"steps": [1]}}, r'privileged\["steps"\] must be a non-empty list of indices in 0..0'),
        ({"privileged": slice(0, 2)}, "privileged must be a non-empty list of keys"),
    ],
)
def test_wrong_arguments_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        Counters(**{"n_envs": 2} | wrong)


@pytest.mark.parametrize("too_large", ["action", "drawn"])  # which one of the two entries alone shows
def test_observations_of_another_size_than_their_space_are_refused(too_large):
    env = Counters(2)
    env.values[too_large] = np.zeros((2, 2))
    with pytest.raises(ValueError, match=f'"{too_large}" has 2 components, but it is split by position as one of 1:'):
        env.reset()


def test_what_it_cannot_do_is_said():
    env = Counters(1)
    with pytest.raises(RuntimeError, match="Counters must be reset before its first step"):
        env.step(np.zeros((1, 1)))
    env.set_options({"goal": 1})
    with pytest.raises(ValueError, match=r"Counters takes no reset options, got .*goal"):
        env.reset()
    assert env.reset()["privileged"][0, 0] == 0, "the options were of that reset alone"
    with pytest.raises(ValueError, match="vec_env must be of one environment, got 2"):
        SingleEnv(Counters(2))
    with pytest.raises(ValueError, match="must be of a suite whose simulator steps a batch, got 'sb3_gac/Pendulum-v1'"):
        batch_factory("sb3_gac/Pendulum-v1")


@pytest.mark.usefixtures("counters_are_registered")
def test_an_id_makes_the_suites_own_and_one_of_them():
    assert is_batched("sb3_gac/Counters-v0")
    env = make_vec("sb3_gac/Counters-v0", n_envs=2, seed=7, noise_std=0.5)
    assert type(env) is Counters
    assert (env.num_envs, env.time_limit, float(env.noise_std)) == (2, 5, 0.5)
    assert (env.reset()["privileged"] == _started(n_envs=2)[1]["privileged"]).all()
    assert make_vec("sb3_gac/Counters-v0", time_limit=2).time_limit == 2
    assert make_vec("sb3_gac/Counters-v0", history=1, delay=0, drop=0.0).num_envs == 1, "none of them is asked for"
    for make in (make_vec, gym.make):
        with pytest.raises(ValueError, match=r"history is for environments that are stepped one at a time.*Counters"):
            make("sb3_gac/Counters-v0", history=4)
    single = gym.make("sb3_gac/Counters-v0", noise_std=0.1)
    check_env(single.unwrapped, skip_render_check=True)
    sb3_check_env(single.unwrapped, warn=False)
    assert isinstance(gym.make("sb3_gac/Counters-v0").unwrapped, SingleEnv)


def test_other_ids_are_made_by_sb3():
    env = make_vec("sb3_gac/Pendulum-v1", n_envs=2, seed=3, noise_std=0.5)
    assert type(env) is DummyVecEnv
    assert env.get_attr("noise_std")[0] == 0.5
    expected = gym.make("sb3_gac/Pendulum-v1").reset(seed=3)[0]["privileged"]
    assert (env.reset()["privileged"][0] == expected).all()


@pytest.mark.parametrize("n_envs", [0, -1, 2.5, "2", None])
def test_a_number_of_environments_that_is_none_is_named(n_envs):
    with pytest.raises(ValueError, match="n_envs must be an integer of at least 1, got"):
        make_vec("sb3_gac/Pendulum-v1", n_envs)


def test_one_environment_ends_and_begins_as_gymnasium_has_it():
    env = SingleEnv(Counters(1, time_limit=5))
    env.reset(seed=7)
    generator = np.random.default_rng(7)
    drawn = [np.float32(generator.random()) for _ in range(3)]
    for step in (1, 2, 3):
        observation, reward, terminated, truncated, info = env.step(np.array([0.5]))
        assert (reward, terminated, truncated) == (10.5, step == 3, False)
        assert info == {"doubled": 2 * step}
        assert observation["privileged"].tolist() == [step, 0, drawn[0]]
    with pytest.raises(RuntimeError, match="episode has ended"):
        env.step(np.array([0.5]))
    assert env.reset()[0]["privileged"].tolist() == [0, 0, drawn[1]], "no episode is skipped"
    env.step(np.array([0.5]))
    assert env.reset()[0]["privileged"].tolist() == [0, 0, drawn[2]]
    assert env.reset(seed=7)[0]["privileged"].tolist() == [0, 0, drawn[0]]
    cut = SingleEnv(Counters(1, time_limit=2))
    cut.reset(seed=0)
    assert [cut.step(np.array([0.0]))[2:4] for _ in range(2)] == [(False, False), (False, True)]


def _learned(env):
    small = {"batch_size": 8, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}}
    return GAC("MultiInputPolicy", env, learning_starts=24, train_freq=4, seed=0, **small).learn(30)


def test_it_is_learned_on_and_evaluated():
    model = _learned(Counters(3, time_limit=4, noise_std=0.1))
    assert model.ep_info_buffer
    assert {info["l"] for info in model.ep_info_buffer} == {3, 4}
    env, _ = _started(time_limit=4)
    returns, lengths = evaluate_policy(model, env, n_eval_episodes=6, return_episode_rewards=True)
    assert sorted(lengths) == [3, 3, 4, 4, 4, 4]
    assert all(abs(total / length - 10.0) <= 1.0 for total, length in zip(returns, lengths, strict=True))
    space = model.observation_space
    assert isinstance(space, spaces.Dict)


@pytest.mark.parametrize("make", [lambda kind: kind(3, time_limit=4, noise_std=0.1), lambda kind: SingleEnv(kind(1))])
def test_a_checkpoint_goes_on_to_the_bit_where_the_simulator_can_be_put_back(make, tmp_path):
    model = _learned(make(RestorableCounters))
    model.save_checkpoint(tmp_path)
    model.learn(20, reset_num_timesteps=False)
    resumed = GAC.resume(tmp_path, make(RestorableCounters))
    resumed.learn(20, reset_num_timesteps=False)
    pairs = zip(model.policy.parameters(), resumed.policy.parameters(), strict=True)
    assert all((a == b).all() for a, b in pairs)


def test_a_state_can_be_restored_again_and_again():
    env = RestorableCounters(3, time_limit=4, noise_std=0.1)
    env.seed(7)
    env.reset()
    env.step(NO_ACTION)
    state, seen = env.checkpoint_state(), []
    for _ in range(2):
        env.restore_checkpoint_state(state)
        steps = [env.step(NO_ACTION) for _ in range(4)]
        returns = [[info["episode"]["r"] for info in infos if "episode" in info] for *_, infos in steps]
        seen.append(([observation["partial"].tolist() for observation, *_ in steps], returns))
    assert seen[0] == seen[1]


@pytest.mark.parametrize(("noise_std", "expected"), [(0.1, 0.5), (0.2, 0.2)])
def test_a_setting_that_changed_is_restored_unless_the_environments_were_made_with_another(noise_std, expected):
    env, other = RestorableCounters(3, time_limit=4, noise_std=0.1), RestorableCounters(3, time_limit=4, noise_std=noise_std)
    env.reset()
    env.set_attr("noise_std", 0.5)
    other.restore_checkpoint_state(env.checkpoint_state())
    assert other.noise_std == pytest.approx(expected)


def test_where_it_cannot_be_a_checkpoint_says_so_and_keeps_the_settings(tmp_path):
    model = _learned(Counters(3, noise_std=0.1))
    model.env.set_attr("noise_std", 0.5)
    model.save_checkpoint(tmp_path)
    with pytest.warns(UserWarning, match="new episodes.*Counters can't write down its simulator's state"):
        resumed = GAC.resume(tmp_path, Counters(3, noise_std=0.1))
    assert resumed.env.get_attr("noise_std")[0] == 0.5


def test_an_attribute_is_set_on_the_layer_that_has_it_without_a_model_as_well():
    env = make_vec("sb3_gac/Pendulum-v1", 2, seed=0)
    env.set_attr("noise_std", 0.9)
    env.set_attr("noise_std", 0.4, indices=1)
    assert [float(one.get_wrapper_attr("noise_std")) for one in env.envs] == pytest.approx([0.9, 0.4])
    assert all("noise_std" not in vars(one) for one in env.envs), "not on Monitor"
    small_model(env).env.set_attr("noise_std", 0.2)
    found = [layer for one in env.envs for layer in layers(one) if isinstance(layer, SensorNoise)]
    assert [float(layer.noise_std) for layer in found] == pytest.approx([0.2, 0.2])
