"""Playground itself on JAX, with the robots of EnvPool's packages, since its own are a download. Compiles for minutes."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_gac.checkpoint.vec_env import restore_vec_env_state, vec_env_state
from sb3_gac.envs import make_vec
from sb3_gac.envs.suites.playground import TASKS
from tests.envs.menagerie import link_menagerie, use_menagerie

pytest.importorskip("mujoco_playground", reason="Playground comes with the extra playground")

TASK, N_ENVS, LIMIT = "Go1Handstand", 2, 6


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    robots = link_menagerie(tmp_path_factory.mktemp("menagerie"))
    if robots is None:
        pytest.skip("the robots are those of EnvPool's packages: the extra envpool")
    with pytest.MonkeyPatch.context() as patch:
        use_menagerie(patch, robots)
        yield make_vec(f"sb3_gac/{TASK}-v0", n_envs=N_ENVS, seed=3, backend="mjx", time_limit=LIMIT, noise_std=0.1)


def _actions(step):
    return np.random.default_rng(step).uniform(-1, 1, (N_ENVS, TASKS[TASK].actions)).astype(np.float32)


def test_spaces_are_those_of_the_other_simulator(env):
    robot = TASKS[TASK]
    sizes = {"partial": (robot.partial,), "privileged": (robot.privileged,)}
    assert {key: box.shape for key, box in env.observation_space.items()} == sizes
    assert env.action_space == spaces.Box(-1.0, 1.0, (robot.actions,))


def test_noise_of_our_own_is_on_partial_alone_and_seeds_repeat(env):
    env.seed(3)
    first = env.reset()
    env.seed(3)
    again = env.reset()
    assert all((first[key] == again[key]).all() for key in first)
    sensed = first["privileged"][:, : TASKS[TASK].partial]  # what partial is without the noise of ours
    added = first["partial"] - sensed
    assert np.std(added) == pytest.approx(0.1, rel=0.4)
    assert not (first["privileged"][0] == first["privileged"][1]).all()


def test_the_limit_truncates_with_the_last_observation_and_begins_another_episode(env):
    env.seed(5)
    first = env.reset()
    for step in range(LIMIT):
        observation, rewards, dones, infos = env.step(_actions(step))
        assert dones.all() == (step == LIMIT - 1)
        assert np.isfinite(rewards).all()
    assert [info["TimeLimit.truncated"] for info in infos] == [True] * N_ENVS
    last = infos[0]["terminal_observation"]["privileged"]
    assert not (last == observation["privileged"][0]).all()
    assert not (first["privileged"] == observation["privileged"]).all()


def test_exact_resume_goes_on_in_the_middle_of_an_episode(env):
    env.seed(7)
    env.reset()
    env.step(_actions(0))
    state = vec_env_state(env)
    assert state["why"] == ""
    expected = [env.step(_actions(step))[:3] for step in range(1, LIMIT + 2)]
    assert restore_vec_env_state(env, state) == ""
    for step, (observation, rewards, dones) in enumerate(expected, start=1):
        found = env.step(_actions(step))
        assert all((found[0][key] == observation[key]).all() for key in observation)
        assert (found[1] == rewards).all()
        assert (found[2] == dones).all()
