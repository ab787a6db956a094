"""The paper's five tasks in Brax."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from sb3_gac.envs import make_vec
from sb3_gac.envs.suites import SUITES
from sb3_gac.envs.suites.brax import TASKS, make_brax

#: Of the paper's Table 7: the whole observation, partial, privileged; and Brax's actions
TABLE_7 = {
    "Ant": (27, 13, 14, 8),
    "HalfCheetah": (17, 8, 9, 6),
    "Humanoid": (244, 155, 89, 17),
    "HumanoidStandup": (244, 155, 89, 17),
    "InvertedDoublePendulum": (8, 5, 3, 1),
}


@pytest.fixture
def brax():
    return pytest.importorskip("brax.envs", reason="Brax comes with the extra brax")


@pytest.mark.parametrize("task", TABLE_7)
def test_the_split_is_that_of_the_papers_table_and_has_everything_once(task):
    whole, partial, velocity, _ = TABLE_7[task]
    layout = TASKS[task]
    assert (len(layout.partial), len(layout.velocity)) == (partial, velocity)
    assert sorted(layout.partial + layout.velocity) == list(range(whole))


def test_there_is_one_id_for_each_of_the_papers_tasks():
    assert set(SUITES["brax"].environments) == {f"sb3_gac/brax-{task}-v0" for task in TABLE_7}


def test_the_table_knows_their_shapes():
    for task, (whole, partial, _, actions) in TABLE_7.items():
        shapes = SUITES["brax"].environments[f"sb3_gac/brax-{task}-v0"]["shapes"]
        assert shapes == {"partial": (partial,), "privileged": (whole,), "action": (actions,)}


def test_without_brax_it_is_said_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "brax.envs", None)
    monkeypatch.setitem(sys.modules, "brax", None)
    with pytest.raises(ImportError, match=r'brax-Ant needs brax.*: pip install -e "\.\[brax\]"'):
        make_brax("Ant")
    with pytest.raises(ImportError, match=r'pip install -e "\.\[brax\]"'):
        make_vec("sb3_gac/brax-Ant-v0", n_envs=2)


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"task must be one of .*'Humanoid'.*, got 'Hopper'"):
        make_brax("Hopper")
    with pytest.raises(ValueError, match=r"privileged must be one of \['state', 'velocity'\], got 'all'"):
        make_brax("Ant", privileged="all")


@pytest.mark.parametrize("task", TABLE_7)
def test_entries_are_positions_and_velocities_of_the_simulators_own_state(brax, task):
    whole, partial, velocity, actions = TABLE_7[task]
    env = make_vec(f"sb3_gac/brax-{task}-v0", n_envs=4, noise_std=0.0, privileged="velocity", seed=0)
    env.reset()
    moved = env.action_space.sample()
    observation = env.step(np.stack([moved, -moved, 0 * moved, moved]))[0]
    assert env.observation_space["partial"].shape == (partial,)
    assert env.observation_space["privileged"].shape == (velocity,)
    assert env.action_space.shape == (actions,) == (env.env.action_size,)
    state = env._state.pipeline_state
    if task == "InvertedDoublePendulum":
        q = np.asarray(state.q)
        expected, speeds = np.concatenate([q[:, :1], np.sin(q[:, 1:]), np.cos(q[:, 1:])], axis=1), np.clip(state.qd, -10, 10)
    else:
        unseen = 1 if task == "HalfCheetah" else 2
        expected, speeds = np.asarray(state.q)[:, unseen:], np.asarray(state.qd)
    np.testing.assert_array_equal(observation["partial"][:, : expected.shape[1]], expected)
    np.testing.assert_array_equal(observation["privileged"][:, : speeds.shape[1]], speeds)
    assert (speeds[0] != speeds[1]).all()
    assert np.asarray(env._state.obs).shape == (4, whole)


def test_arguments_that_change_the_observation_are_refused(brax):
    env = make_brax("HalfCheetah", exclude_current_positions_from_observation=False)
    with pytest.raises(ValueError, match="observation has 18 components, but it is split by position as one of 17"):
        env.reset()


def test_humanoids_other_velocities_are_those_of_its_bodies_and_no_torque_is_among_them(brax):
    env = make_vec("sb3_gac/brax-Humanoid-v0", n_envs=4, noise_std=0.0, privileged="velocity", seed=0)
    env.reset()
    action = np.full((4, 17), 0.5, dtype=np.float32)
    observation = env.step(action)[0]
    angular = observation["privileged"][0, 23:].reshape(11, 6)[:, 3:]
    np.testing.assert_allclose(angular, np.asarray(env._state.pipeline_state.xd.ang)[0], atol=1e-6)
    torques = observation["partial"][0, -23:]
    assert (torques[:6] == 0).all()
    assert (torques[6:] != 0).all()


def test_the_whole_state_is_privileged_and_noise_is_on_partial_alone(brax):
    env = make_vec("sb3_gac/brax-InvertedDoublePendulum-v0", n_envs=4, noise_std=0.3, seed=0)
    env.reset()
    differences = []
    for _ in range(320):
        observation = env.step(np.zeros((4, 1)))[0]
        np.testing.assert_array_equal(observation["privileged"], np.asarray(env._state.obs))
        differences.append(observation["partial"] - observation["privileged"][:, :5])
    assert np.mean(differences) == pytest.approx(0.0, abs=0.02)  # 0.3 / sqrt(6400) = 0.004
    assert np.std(differences) == pytest.approx(0.3, abs=0.02)


def test_a_fall_is_a_termination_with_its_last_state_and_the_limit_a_truncation(brax):
    env = make_vec("sb3_gac/brax-InvertedDoublePendulum-v0", n_envs=4, noise_std=0.0, seed=0, time_limit=30)
    env.reset()
    lengths, ends = np.zeros(4, dtype=int), []
    for _ in range(60):
        push = np.array([[1.0], [-1.0], [0.0], [0.0]])  # the last two stand for longer than the limit
        observation, _, dones, infos = env.step(push)
        lengths += 1
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]["privileged"]
            height = 0.6 * (last[3] + (last[3] * last[4] - last[1] * last[2]))
            ends.append((index, lengths[index], infos[index]["TimeLimit.truncated"], height))
            assert abs(observation["privileged"][index, 1:3]).max() < 0.011, "upright again"
        lengths[dones] = 0
    fallen = [end for end in ends if not end[2]]
    assert {end[0] for end in fallen} == {0, 1}
    assert all(height <= 1.0 < length for _, length, _, height in fallen)
    assert all(length == 30 and height > 1.0 for _, length, cut, height in ends if cut)
    assert {end[0] for end in ends if end[2]} >= {2, 3}


def test_one_of_them_is_an_environment_of_gymnasiums(brax):
    env = gym.make("sb3_gac/brax-InvertedDoublePendulum-v0")
    check_env(env, warn=False)
    assert set(env.reset(seed=0)[0]) == {"partial", "privileged"}
