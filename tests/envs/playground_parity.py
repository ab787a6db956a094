"""
Playground's tasks step by step on both simulators: EnvPool's episode, without the task's own noise, and the same actions from
the same state in MJX::

    python -m tests.envs.playground_parity Go1JoystickFlatTerrain Go1Handstand LeapCubeRotateZAxis

The first state is read from EnvPool's clean observation, up to where a robot stands and looks on flat ground, which nothing
depends on. A command that EnvPool draws anew is given to MJX as well.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_gac.envs.suites.playground import make_mjx
from tests.envs.menagerie import link_menagerie, use_menagerie

HORIZONS = (1, 2, 5, 10, 20, 50, 100)
_NEVER = 10**6  # steps


class Episode(NamedTuple):
    """Privileged observations, before the first step too, rewards, ends and the rewards' terms; of every step."""

    observations: np.ndarray
    rewards: np.ndarray
    ends: np.ndarray
    terms: dict[str, np.ndarray]


def on_envpool(task: str, actions: np.ndarray, seed: int) -> tuple[Episode, list[np.ndarray]]:
    """
    :param task: of Playground
    :param actions: shape (T, A)
    :param seed: of the first state
    :return: the episode, and the commands that counted in each step, if there are any
    """
    import envpool

    options = {"env_type": "gymnasium", "num_envs": 1, "num_threads": 1, "seed": seed, "noise_level": 0.0}
    pool = envpool.make(f"MuJoCoPlayground/{task}-v1", **options)
    observation, _ = pool.reset()
    observations, rewards, ends, terms, commands = [observation["privileged_state"][0]], [], [], [], []
    for action in actions:
        observation, reward, end, _, info = pool.step(action[None].astype(np.float64))
        observations.append(observation["privileged_state"][0])
        rewards.append(reward[0])
        ends.append(end[0])
        terms.append({name.removeprefix("reward_"): info[name][0] for name in info if name.startswith("reward_")})
        commands.append(observations[-1][45:48])
        if end[0]:
            break
    return _episode(observations, rewards, ends, terms), commands


def on_mjx(task: str, first: np.ndarray, actions: np.ndarray, commands: list[np.ndarray]) -> Episode:
    """
    :param task: of Playground
    :param first: privileged observation without noise, at rest in what it does not tell
    :param actions: shape (T, A)
    :param commands: of each step
    """
    import jax

    env = make_mjx(task, noise_level=0.0).env
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    state = state.replace(data=state.data.replace(**_STARTS[task](env, first)))
    step = jax.jit(env.step)
    observations, rewards, ends, terms = [first], [], [], []
    for action, command in zip(actions, commands, strict=False):
        if "command" in state.info:
            told = {"command": jax.numpy.float32(command), "steps_until_next_cmd": jax.numpy.int32(_NEVER)}
            state = state.replace(info=state.info | told)
        state = step(state, jax.numpy.float32(action))
        observations.append(np.asarray(state.obs["privileged_state"]))
        rewards.append(float(state.reward))
        ends.append(bool(state.done))
        terms.append({name.removeprefix("reward/"): float(state.metrics[name]) for name in state.metrics if "reward/" in name})
    return _episode(observations, rewards, ends, terms)


def _episode(observations: Any, rewards: Any, ends: Any, terms: list[dict[str, float]]) -> Episode:
    by_name = {name: np.array([of_step[name] for of_step in terms]) for name in terms[0]}
    return Episode(np.array(observations), np.array(rewards), np.array(ends), by_name)


def _go1(env: Any, first: np.ndarray) -> dict[str, Any]:
    """Upright, as after a reset: joints where a keyframe has them, the speed of the torso from that of its sensor."""
    joints, linear, angular = first[9:21] + np.asarray(env._default_pose), first[:3], first[3:6]
    frames = np.array([env.mj_model.keyframe(number).qpos for number in range(env.mj_model.nkey)])
    qpos = frames[np.abs(frames[:, 7:] - joints).sum(axis=1).argmin()]
    sensor = env.mj_model.site_pos[env._imu_site_id]
    qvel = np.concatenate([linear - np.cross(angular, sensor), angular, first[21:33]])
    return {"qpos": np.float32(qpos), "qvel": np.float32(qvel), "ctrl": np.float32(qpos[7:])}


def _leap(env: Any, first: np.ndarray) -> dict[str, Any]:
    """At rest; the hand does not move, so that its palm is where it always is."""
    import mujoco

    data = mujoco.MjData(env.mj_model)
    mujoco.mj_forward(env.mj_model, data)
    palm = data.site_xpos[env.mj_model.site("grasp_site").id]
    cube, joints = palm - first[92:95], first[32:48]
    qpos = np.concatenate([joints, cube, first[95:99]])
    return {"qpos": np.float32(qpos), "qvel": np.zeros(env.mj_model.nv, np.float32), "ctrl": np.float32(joints)}


_STARTS = {"Go1JoystickFlatTerrain": _go1, "Go1Handstand": _go1, "LeapCubeRotateZAxis": _leap}


def compare(task: str, n_steps: int = HORIZONS[-1], seed: int = 0, scale: float = 0.3) -> tuple[Episode, Episode]:
    """
    :param task: of Playground
    :param n_steps: at most
    :param seed: of the first state and the actions
    :param scale: of the actions, uniform in +-scale
    :return: the episode on EnvPool and on MJX, as long as the shorter one
    """
    n_actions = {"Go1": 12, "Lea": 16}[task[:3]]
    actions = np.random.default_rng(seed).uniform(-scale, scale, (n_steps, n_actions))
    ours, commands = on_envpool(task, actions, seed)
    return ours, on_mjx(task, ours.observations[0], actions, commands)


def report(task: str, envpool: Episode, mjx: Episode) -> None:
    """Print how far apart they are, up to each horizon: of observations relative to their spread, of rewards as they are."""
    print(f"{task}: {len(envpool.rewards)} steps, ends {envpool.ends.nonzero()[0]} and {mjx.ends.nonzero()[0]}")
    apart = np.abs(envpool.observations - mjx.observations)
    for horizon in HORIZONS:
        rows = slice(1, horizon + 1)
        worst = apart[rows].max(axis=0)
        terms = {
            name: float(np.abs(values[:horizon] - mjx.terms[name][:horizon]).max())
            for name, values in envpool.terms.items()
            if name in mjx.terms
        }
        print(
            f"  {horizon:4d} steps: observation median {np.median(apart[rows]):.1e}, worst {worst.max():.1e} "
            f"(component {worst.argmax()}), reward {np.abs(envpool.rewards - mjx.rewards)[:horizon].max():.1e} of "
            f"{np.abs(envpool.rewards[:horizon]).mean():.1e}, terms "
            + ", ".join(f"{name} {value:.0e}" for name, value in sorted(terms.items(), key=lambda item: -item[1])[:5])
        )
    missing = sorted(set(mjx.terms) ^ set(envpool.terms))
    print(f"  terms of one alone: {[name for name in missing if np.abs((mjx.terms | dict(envpool.terms))[name]).max() > 0]}")


class _Setting:
    """In the place of pytest's monkeypatch, for good."""

    setattr = staticmethod(setattr)


def main(tasks: list[str]) -> None:
    """Compare and print, task after task."""
    with tempfile.TemporaryDirectory() as folder:
        found = link_menagerie(Path(folder))
        if found is None:
            raise SystemExit("Playground's robots come with EnvPool's packages envpool-assets-mujoco-*.")
        use_menagerie(_Setting, found)
        for task in tasks or _STARTS:
            report(task, *compare(task))


if __name__ == "__main__":
    main(sys.argv[1:])
