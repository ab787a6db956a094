"""Environments on JAX, on a toy whose every number can be worked out: episodes' ends, fresh resets, seeds, exact resume."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from gymnasium import spaces

from sb3_gac.checkpoint.vec_env import restore_vec_env_state, vec_env_state

jax = pytest.importorskip("jax", reason="JAX comes with the extras brax and playground")
jnp = jax.numpy

from sb3_gac.envs.vector.jax_env import JaxVecEnv  # noqa: E402

LIMIT = 5


class State(NamedTuple):
    """Of the walk; ``info`` is written into, as in Playground, and ``reward`` is weakly typed after a reset, as in Brax."""

    position: Any
    obs: Any
    reward: Any
    done: Any
    info: dict


class Walk:
    """A position that actions move, with random pushes, until it is beyond 2; the reward is the action."""

    def reset(self, rng):
        rng, first = jax.random.split(rng)
        position = jax.random.uniform(first)
        return State(position, self._seen(position, 0.0), jnp.asarray(0.0 * 1), jnp.float32(0), {"rng": rng, "steps": 0})

    def step(self, state, action):
        rng, push = jax.random.split(state.info["rng"])
        position = state.position + action[0] + 0.01 * jax.random.normal(push)
        state.info["rng"] = rng
        state.info["steps"] += 1
        return State(position, self._seen(position, action[0]), action[0], (position > 2) * 1.0, state.info)

    def _seen(self, position, velocity):
        return {"state": jnp.stack([position]), "privileged_state": jnp.stack([position, velocity])}


def _make(n_envs=3, time_limit: int | None = LIMIT, noise_std=0.0):
    space = {"state": spaces.Box(-np.inf, np.inf, (1,)), "privileged_state": spaces.Box(-np.inf, np.inf, (2,))}
    options = {"partial": ["state"], "privileged": ["privileged_state"], "time_limit": time_limit, "noise_std": noise_std}
    actions = spaces.Box(-3.0, 3.0, (1,))
    return JaxVecEnv(Walk(), n_envs, "brax", observation_space=spaces.Dict(space), action_space=actions, **options)


def _seeded(seed=0, **kwargs):
    env = _make(**kwargs)
    env.seed(seed)
    return env, env.reset()


def _actions(*values):
    return np.array(values, dtype=np.float32)[:, None]


def _alone(seed, episode, actions):
    """Position after each action, in one environment and without any of ours."""
    walk = Walk()
    state = walk.reset(jax.random.fold_in(jax.random.PRNGKey(seed), episode))
    positions = [float(state.position)]
    for action in actions:
        state = walk.step(state, jnp.array([action], dtype=jnp.float32))
        positions.append(float(state.position))
    return positions


def test_every_environment_goes_as_it_would_alone():
    env, first = _seeded(seed=7)
    steps = [env.step(_actions(0.1, -0.2, 0.3)) for _ in range(3)]
    for index, action in enumerate((0.1, -0.2, 0.3)):
        expected = _alone(7 + index, 0, [action] * 3)
        found = [first["partial"][index, 0], *(obs["partial"][index, 0] for obs, *_ in steps)]
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(steps[-1][1], [0.1, -0.2, 0.3])
    assert not np.concatenate([dones for _, _, dones, _ in steps]).any()
    np.testing.assert_allclose(steps[-1][0]["privileged"][:, 1], [0.1, -0.2, 0.3])


def test_an_end_shows_the_last_state_and_begins_the_next_episode_there_alone():
    env, _ = _seeded(seed=3)
    observation, _, dones, infos = env.step(_actions(0.5, 3.0, 0.5))
    assert dones.tolist() == [False, True, False]
    last = infos[1]["terminal_observation"]
    assert last["partial"][0] == pytest.approx(_alone(4, 0, [3.0])[-1])
    assert last["privileged"][1] == 3.0
    assert not infos[1]["TimeLimit.truncated"]
    assert observation["partial"][1, 0] == pytest.approx(_alone(4, 1, [])[0])
    observation = env.step(_actions(0.5, 0.5, 0.5))[0]
    expected = [_alone(3, 0, [0.5, 0.5])[-1], _alone(4, 1, [0.5])[-1], _alone(5, 0, [0.5, 0.5])[-1]]
    np.testing.assert_allclose(observation["partial"][:, 0], expected, rtol=1e-6)


def test_the_time_limit_truncates_and_an_end_at_the_limit_does_not():
    env, _ = _seeded()
    for _ in range(LIMIT - 1):
        assert not env.step(_actions(0.0, 0.0, 0.0))[2].any()
    _, _, dones, infos = env.step(_actions(0.0, 3.0, 0.0))
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [True, False, True]


def test_every_episode_begins_elsewhere():
    env, first = _seeded(seed=1, time_limit=1)
    firsts = [first["partial"][:, 0], *(env.step(_actions(0.0, 0.0, 0.0))[0]["partial"][:, 0] for _ in range(4))]
    assert len(np.unique(firsts)) == 15


@pytest.mark.parametrize("n_envs", [1, 8, 11, 20])
def test_an_episode_depends_on_its_seed_and_number_alone(n_envs):
    env, first = _seeded(seed=5, n_envs=n_envs)
    observation = env.step(np.full((n_envs, 1), 3.0))[0]
    observation, _, dones, _ = env.step(_actions(*[3.0, *[-0.5] * (n_envs - 1)]))
    assert dones.tolist() == [True] + [False] * (n_envs - 1)
    assert first["partial"][-1, 0] == pytest.approx(_alone(4 + n_envs, 0, [])[0])
    assert observation["partial"][0, 0] == pytest.approx(_alone(5, 2, [])[0])
    if n_envs > 1:
        assert observation["partial"][-1, 0] == pytest.approx(_alone(4 + n_envs, 1, [-0.5])[-1])


def test_a_seed_begins_anew_and_a_reset_without_goes_on():
    env, first = _seeded(seed=2)
    other = env.reset()
    env.seed(2)
    again = env.reset()
    assert (first["partial"] == again["partial"]).all()
    assert (first["partial"] != other["partial"]).all()


def test_seeds_beyond_32_bits_are_taken():
    env = _make(n_envs=2)
    env.seed(2**32 - 1)
    assert np.isfinite(env.reset()["partial"]).all()


def test_each_program_is_compiled_once():
    env, _ = _seeded()
    for _ in range(2 * LIMIT):
        env.step(_actions(0.0, 3.0, 0.1))
    assert [program._cache_size() for program in (env._first, env._next, env._placed)] == [1, 1, 1]


def test_noise_is_on_what_is_seen_alone_and_leaves_the_dynamics():
    (clean, before), (noisy, seen) = _seeded(n_envs=200), _seeded(n_envs=200, noise_std=0.5)
    assert (before["privileged"] == seen["privileged"]).all()
    differences = [seen["partial"] - before["partial"]]
    for _ in range(LIMIT):
        before, seen = (env.step(np.full((200, 1), 0.1))[0] for env in (clean, noisy))
        assert (before["privileged"] == seen["privileged"]).all()
        differences.append(seen["partial"] - before["partial"])
    assert np.mean(differences) == pytest.approx(0.0, abs=0.06)  # 0.5 / sqrt(1200) = 0.014
    assert np.std(differences) == pytest.approx(0.5, abs=0.05)


def test_exact_resume_goes_on_in_the_middle_of_episodes():
    env, _ = _seeded(noise_std=0.1)
    moves = [_actions(0.1, 3.0, 0.2), _actions(0.1, 0.2, 0.3)]
    for actions in moves:
        env.step(actions)
    state = vec_env_state(env)
    assert state["why"] == ""
    expected = [env.step(actions)[:3] for actions in moves * 3]
    resumed = _make(noise_std=0.1)
    assert restore_vec_env_state(resumed, state) == ""
    for actions, (observation, rewards, dones) in zip(moves * 3, expected, strict=True):
        found = resumed.step(actions)
        assert all((found[0][key] == observation[key]).all() for key in observation)
        assert (found[1] == rewards).all()
        assert (found[2] == dones).all()


def test_programs_are_kept_on_disk_unless_the_user_says_where(monkeypatch, tmp_path):
    before = jax.config.jax_compilation_cache_dir
    try:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        for chosen, expected in ((None, str(tmp_path / "sb3_gac" / "jax")), ("/mine", "/mine")):
            jax.config.update("jax_compilation_cache_dir", chosen)
            _make()
            assert jax.config.jax_compilation_cache_dir == expected
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
