"""EnvPool's tasks as SB3 expects them: on a stand-in with its traps always, on itself where it is installed."""

import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.environments import make_envs
from benchmarks.suite import RunSpec
from sb3_gac import GAC, AsymmetricSAC, preset
from sb3_gac.envs import EnvPoolVecEnv, make_vec
from sb3_gac.envs.suites.playground import TASKS, make_playground
from tests.envs import fake_envpool
from tests.envs.fake_envpool import FALL, LIMIT

SPLIT = {"partial": ["state"], "privileged": ["privileged_state"]}
ACTION = np.array([0.25, 0.5], dtype=np.float32)


@pytest.fixture
def stand_in(monkeypatch):
    monkeypatch.setitem(sys.modules, "envpool", fake_envpool)
    monkeypatch.setattr(fake_envpool, "built", [])
    return fake_envpool.built


@pytest.fixture(autouse=True)
def one_thread():
    before = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(before)


def _started(n_envs=3, seed=5, task="Walk-v1", **kwargs):
    env = EnvPoolVecEnv(task, n_envs, **SPLIT | kwargs)
    env.seed(seed)
    return env, env.reset()


def _steps(env, number):
    actions = np.tile(ACTION, (env.num_envs, 1))
    for _ in range(number):
        yield env.step(actions)


def test_a_pool_is_built_at_the_first_reset_with_a_seed_for_each_environment(stand_in):
    env = EnvPoolVecEnv("Walk-v1", 3, num_threads=1, **SPLIT)
    assert stand_in == []
    env.seed(5)
    first = env.reset()
    assert stand_in == [{"seeds": [5, 6, 7], "threads": 1}]
    again = env.reset()
    assert len(stand_in) == 1, "its random numbers go on"
    assert (again["privileged"][:, 1] != first["privileged"][:, 1]).all()
    env.seed(5)
    assert (env.reset()["privileged"] == first["privileged"]).all()
    assert len(stand_in) == 2
    env.seed(2**32 - 1)
    env.reset()
    assert all(0 <= seed < 2**31 for seed in stand_in[-1]["seeds"]), "EnvPool takes no others"


def test_rows_are_those_of_the_environments_in_their_order(stand_in):
    env, first = _started()
    assert first["privileged"][:, 3].tolist() == [0, 1, 2]
    assert first["partial"][:, 3].tolist() == [0, 0.5, 1]
    for observation, *_ in _steps(env, 3 * FALL):
        assert observation["privileged"][:, 3].tolist() == [0, 1, 2]


def test_the_next_episode_begins_at_once_and_loses_no_step(stand_in):
    env, _ = _started()
    lengths = np.zeros(3)
    for observation, rewards, dones, infos in _steps(env, 3 * FALL):
        lengths += 1
        assert rewards.tolist() == [0.75] * 3, "no action is ignored"
        assert dones.tolist() == (lengths == FALL + np.arange(3)).tolist()
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]["privileged"]
            assert last[[0, 2, 3]].tolist() == [lengths[index], 0.75, index]
            assert observation["privileged"][index, [0, 2]].tolist() == [0, 0]
            assert observation["privileged"][index, 1] != last[1]
            assert infos[index]["TimeLimit.truncated"] is False
            lengths[index] = 0
        assert observation["privileged"][:, 0].tolist() == lengths.tolist()


@pytest.mark.parametrize("limit", [FALL - 2, FALL, FALL + 1])
def test_a_limit_cuts_and_an_end_of_the_task_in_its_last_step_is_one(stand_in, limit):
    env, _ = _started(time_limit=limit)
    seen = {}
    for step, (_, _, dones, infos) in enumerate(_steps(env, limit), start=1):
        for index in np.flatnonzero(dones):
            seen.setdefault(int(index), (step, infos[index]["TimeLimit.truncated"]))
    expected = {index: min((FALL + index, False), (limit, True), key=lambda end: end[0]) for index in range(3)}
    assert seen == expected


def test_the_tasks_own_limit_counts_where_none_is_given(stand_in):
    env, _ = _started(n_envs=LIMIT)
    assert env.time_limit == LIMIT
    *_, (_, _, dones, infos) = _steps(env, LIMIT)
    longest = LIMIT - 1  # of which the fall would come later
    assert dones[longest]
    assert infos[longest]["TimeLimit.truncated"]


def test_a_flat_observation_is_split_by_indices_and_slices(stand_in):
    _, first = _started(task="Flat-v1", partial=[0, 2], privileged=slice(0, 4))
    assert first["partial"].shape == (3, 2)
    assert (first["privileged"][:, [0, 2]] == first["partial"]).all()
    assert first["privileged"][:, 3].tolist() == [0, 1, 2]


def test_infos_and_options_of_the_task_are_passed_on(stand_in):
    env, first = _started(info_keys=["height"], scale=3.0)
    ((_, rewards, _, infos),) = _steps(env, 1)
    assert rewards.tolist() == [2.25] * 3
    assert [np.float32(info["height"]) for info in infos] == first["privileged"][:, 1].tolist()
    wrong, _ = _started(info_keys=["no_such"])
    with pytest.raises(ValueError, match=r"info_keys must be of .*'height'.*got 'no_such'"):
        list(_steps(wrong, 1))


def test_threads_are_what_torch_leaves_and_too_many_are_named(stand_in, monkeypatch):
    monkeypatch.setattr("sb3_gac.envs.subprocesses.os.sched_getaffinity", lambda _: set(range(4)), raising=False)
    assert EnvPoolVecEnv("Walk-v1", 8, **SPLIT).num_threads == 3
    assert EnvPoolVecEnv("Walk-v1", 2, **SPLIT).num_threads == 2
    with pytest.warns(UserWarning, match="4 threads of EnvPool and 1 of torch are more than the 4 cores"):
        EnvPoolVecEnv("Walk-v1", 8, num_threads=4, **SPLIT)
    with pytest.raises(ValueError, match="num_threads must be"):
        EnvPoolVecEnv("Walk-v1", 8, num_threads=0, **SPLIT)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"task_id": "Wlak-v1"}, r"task_id must be one of envpool.list_all_envs\(\), such as \['Walk-v1'"),
        ({"seed": 3}, r"\['seed'\] are set by EnvPoolVecEnv"),
        ({"partial": ["obs"]}, '"obs"'),
        ({"partial": {"state": [4]}}, "indices in 0..3"),
        ({"n_envs": 0}, "n_envs must be"),
    ],
)
def test_wrong_arguments_are_named(stand_in, wrong, message):
    with pytest.raises(ValueError, match=message):
        EnvPoolVecEnv(**{"task_id": "Walk-v1"} | SPLIT | wrong)


def test_a_checkpoint_says_that_episodes_start_anew(stand_in, tmp_path):
    def made():
        return make_vec("sb3_gac/Go1JoystickFlatTerrain-v0", n_envs=2, seed=0)

    GAC("MultiInputPolicy", made(), buffer_size=100, policy_kwargs={"net_arch": [4]}).learn(10).save_checkpoint(tmp_path)
    with pytest.warns(UserWarning, match="new episodes.*EnvPool has no way to read its simulators' state"):
        GAC.resume(tmp_path, made()).learn(10)


def test_benchmarks_have_a_pool_for_all_their_environments(stand_in):
    spec = RunSpec("gac", "Go1JoystickFlatTerrain", 0.0, 0, 100, 4, "playground", 50, 3)
    env = make_envs(spec, 4, seed=0)
    assert type(env) is EnvPoolVecEnv
    env.reset()
    assert len(stand_in) == 1


def test_tasks_are_made_by_id_alone_and_side_by_side(stand_in):
    env = make_vec("sb3_gac/Go1JoystickFlatTerrain-v0", n_envs=2, seed=3, noise_std=0.5)
    assert (type(env), env.task_id) == (EnvPoolVecEnv, "MuJoCoPlayground/Go1JoystickFlatTerrain-v1")
    single = gym.make("sb3_gac/Go1JoystickFlatTerrain-v0", noise_std=0.5).unwrapped
    check_env(single, skip_render_check=True)
    sb3_check_env(single, warn=False)
    first = env.reset()
    assert (single.reset(seed=3)[0]["privileged"] == first["privileged"][0]).all()
    with pytest.raises(ValueError, match="task must be one of"):
        make_playground("Go2")


# --- EnvPool itself ---------------------------------------------------------------------------------------------------

GO1, LEAP = "Go1JoystickFlatTerrain", "LeapCubeRotateZAxis"


@pytest.fixture
def real():
    return pytest.importorskip("envpool", reason='EnvPool is not installed: pip install -e ".[envpool]"')


@pytest.mark.parametrize("task", TASKS)
def test_sizes_and_limits_are_the_tables(real, task):
    env, robot = make_vec(f"sb3_gac/{task}-v0"), TASKS[task]
    sizes = {key: space.shape for key, space in env.observation_space.items()}
    assert sizes == {"partial": (robot.partial,), "privileged": (robot.privileged,)}
    assert (env.action_space.shape, env.time_limit) == ((robot.actions,), robot.time_limit)
    assert env.action_space.dtype == np.float32
    assert env.action_space.high.tolist() == [1.0] * robot.actions


def _run(task, n_envs=2, seed=0, steps=120, **kwargs):
    """Observations, rewards, dones and infos of steps with random actions, which depend on each environment's seed alone."""
    env = make_vec(f"sb3_gac/{task}-v0", n_envs=n_envs, seed=seed, **kwargs)
    generators = [np.random.default_rng(seed + index) for index in range(n_envs)]
    found = [(env.reset(), np.zeros(n_envs), np.zeros(n_envs, dtype=bool), [{}] * n_envs)]
    for _ in range(steps):
        found.append(env.step(np.stack([one.uniform(-1, 1, env.action_space.shape) for one in generators])))
    return found


@pytest.mark.parametrize("task", [GO1, LEAP])
def test_privileged_begins_with_partial_to_the_bit(real, task):
    n_ends = 0
    for observation, _, dones, infos in _run(task, steps=200):
        size = TASKS[task].partial
        assert (observation["privileged"][:, :size] == observation["partial"]).all()
        for index in np.flatnonzero(dones):
            n_ends += 1
            last = infos[index]["terminal_observation"]
            assert (last["privileged"][:size] == last["partial"]).all()
            assert not (last["partial"] == observation["partial"][index]).all()
    assert n_ends or task == LEAP


def test_environments_side_by_side_are_those_alone(real):
    """Each to the bit, over falls and resets: rows are not mixed up, and no step is lost."""
    together = _run(GO1, n_envs=2, seed=3)
    for index in (0, 1):
        alone = _run(GO1, n_envs=1, seed=3 + index)
        ends = 0
        for (obs, rewards, dones, infos), (its, its_reward, its_done, its_info) in zip(together, alone, strict=True):
            assert all((obs[key][index] == its[key][0]).all() for key in obs)
            assert (rewards[index], dones[index]) == (its_reward[0], its_done[0])
            assert infos[index].get("TimeLimit.truncated") == its_info[0].get("TimeLimit.truncated")
            ends += its_done[0]
        assert ends >= 1


def test_noise_of_our_own_leaves_the_simulation_alone(real):
    clean, noisy = _run(GO1, noise_level=0.0, steps=30), _run(GO1, noise_level=0.0, noise_std=0.3, steps=30)
    added = [b[0]["partial"] - a[0]["partial"] for a, b in zip(clean, noisy, strict=True)]
    assert all((a[0]["privileged"] == b[0]["privileged"]).all() for a, b in zip(clean, noisy, strict=True))
    assert np.std(added) == pytest.approx(0.3, rel=0.1)
    assert abs(np.mean(added)) < 4 * 0.3 / np.sqrt(np.size(added))


def test_a_fall_is_none_of_the_limit_and_the_limit_is_none_of_a_fall(real):
    falls = [info for *_, infos in _run(GO1) for info in infos if "terminal_observation" in info]
    assert falls
    assert not any(info["TimeLimit.truncated"] for info in falls)
    cut = _run(GO1, time_limit=5, steps=10)
    assert [dones.tolist() for _, _, dones, _ in cut[1:]] == [[step % 5 == 0] * 2 for step in range(1, 11)]
    assert all(info["TimeLimit.truncated"] for step in (5, 10) for info in cut[step][3])


@pytest.mark.parametrize("algorithm", [GAC, AsymmetricSAC])
def test_robots_are_learned_on_with_the_preset(real, algorithm):
    env = VecNormalize(make_vec(f"sb3_gac/{GO1}-v0", n_envs=2, seed=0), norm_reward=False)
    model = algorithm("MultiInputPolicy", env, seed=0, **preset("playground", task=GO1, algorithm=algorithm, buffer_size=500))
    model.learning_starts = 100
    model.learn(160)
    assert model._n_updates == 4 * 30
    assert {info["l"] for info in model.ep_info_buffer} <= set(range(2, 81))
    assert all(set(model.policy.role_keys[role]) == {"privileged"} for role in model.policy.role_keys if "critic" in role)


def test_checkers_pass(real):
    env = gym.make(f"sb3_gac/{GO1}-v0").unwrapped
    check_env(env, skip_render_check=True)
    sb3_check_env(env, warn=False)
