"""gymnasium-robotics: the split against the simulator's own state, goals, noise, hindsight, seeds, checkers."""

import pickle
import subprocess
import sys
from dataclasses import replace
from functools import cache

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env

from sb3_gac import PRESETS, preset
from sb3_gac.envs import make_robotics
from sb3_gac.envs.suites.robotics import ENVIRONMENTS, TASKS
from tests.helpers import small_model

TOUCH, PUSH, REACH, FINGERS, DOOR, RELOCATE = (
    "HandManipulateBlockRotateZTouch-v1",
    "FetchPush-v4",
    "FetchReach-v4",
    "HandReach-v3",
    "AdroitHandDoor-v1",
    "AdroitHandRelocate-v1",
)
ONE_OF_EACH_KIND = (TOUCH, PUSH, REACH, FINGERS, DOOR, RELOCATE)
#: partial, privileged="hidden", actions, time limit
SIZES = {
    TOUCH: (68, 92, 20, 100),
    PUSH: (17, 11, 4, 50),
    REACH: (8, 5, 4, 50),
    FINGERS: (54, 24, 20, 50),
    DOOR: (39, 51, 28, 200),
    RELOCATE: (39, 57, 30, 200),
}
kinds = pytest.mark.parametrize("name", ONE_OF_EACH_KIND)


def _make(name, **kwargs):
    return gym.make(f"sb3_gac/{name}", **kwargs)


@cache
def _one(name, **kwargs):
    """Making a robot takes a while."""
    return _make(name, **kwargs)


def _go(env, n_steps, seed=0, scale=1.0):
    """The last observation of random actions."""
    generator = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    for _ in range(n_steps):
        action = scale * generator.uniform(-1, 1, env.action_space.shape)
        observation, *_ = env.step(action.astype(np.float32))
    return observation


def _joints(env, prefix="robot"):
    """Addresses of the robot's joints, of one number each, among positions and among velocities."""
    model = env.unwrapped.model
    found = [model.joint(number) for number in range(model.njnt) if model.joint(number).name.startswith(prefix)]
    return [joint.qposadr[0] for joint in found], [joint.dofadr[0] for joint in found]


def _touched(env, is_touch):
    """Readings of the sensors of that name, by their own addresses."""
    model, data = env.unwrapped.model, env.unwrapped.data
    sensors = [model.sensor(number) for number in range(model.nsensor)]
    return np.array([data.sensordata[sensor.adr[0]] for sensor in sensors if is_touch(sensor.name)])


def _site(env, name):
    """Position, and linear and angular velocity, in the world's axes, of a site."""
    model, data = env.unwrapped.model, env.unwrapped.data
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site(name).id, velocity, 0)
    return data.site_xpos[model.site(name).id].copy(), velocity[3:], velocity[:3]


@pytest.mark.parametrize("name", SIZES)
def test_dimensions_type_and_time_limit(name):
    env = _one(name)
    n_partial, n_hidden, n_actions, limit = SIZES[name]
    shapes = {key: box.shape for key, box in env.observation_space.items()}
    assert shapes == {"partial": (n_partial,), "privileged": (n_hidden,)}
    assert env.action_space.shape == (n_actions,)
    assert ENVIRONMENTS[f"sb3_gac/{name}"]["shapes"] == {**shapes, "action": (n_actions,)}
    assert env.spec.max_episode_steps == limit == gym.spec(TASKS[name.rpartition("-v")[0]].env_id).max_episode_steps
    observation = _go(env, 2)
    assert observation in env.observation_space
    assert {value.dtype for value in observation.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("env_id", sorted(set(ENVIRONMENTS) - {f"sb3_gac/{name}" for name in ONE_OF_EACH_KIND}))
def test_the_other_tasks_have_the_layout_of_their_kind(env_id):
    env = gym.make(env_id)
    n_partial, n_hidden, n_actions, _ = SIZES[TOUCH if "Touch" in env_id else PUSH]
    observation = _go(env, 1)
    shapes = {key: value.shape for key, value in observation.items()}
    assert shapes == {"partial": (n_partial,), "privileged": (n_hidden,)}
    assert ENVIRONMENTS[env_id]["shapes"] == {**shapes, "action": (n_actions,)}
    assert env.action_space.shape == (n_actions,)
    assert env.spec.max_episode_steps == gym.spec(TASKS[env_id[8:].rpartition("-v")[0]].env_id).max_episode_steps


def test_a_touching_hand_is_split_by_what_it_feels():
    env = _one(TOUCH)
    observation = _go(env, 20)
    data, model = env.unwrapped.data, env.unwrapped.model
    positions, velocities = _joints(env)
    block = model.joint("object:joint")
    at, moving = block.qposadr[0], block.dofadr[0]
    own = [data.qpos[positions], data.qvel[velocities], data.qvel[moving : moving + 6], data.qpos[at : at + 7]]
    np.testing.assert_array_equal(observation["partial"], np.float32(np.concatenate([*own, env.unwrapped.goal])))
    touch = _touched(env, lambda name: "TS_" in name)
    assert touch.max() > 1, "it holds the block"
    assert (touch > 0).sum() >= 3
    np.testing.assert_allclose(observation["privileged"], np.log1p(touch), rtol=1e-6)


@pytest.mark.parametrize("name", [PUSH, REACH])
def test_an_arm_is_split_by_velocities(name):
    env = _one(name)
    observation = _go(env, 12)
    data = env.unwrapped.data
    model = env.unwrapped.model
    dt = 20 * model.opt.timestep  # the library's velocities are way per step
    positions, velocities = (np.array(found)[-2:] for found in _joints(env))
    grip, grip_velocity, _ = _site(env, "robot0:grip")
    partial, hidden = [grip, data.qpos[positions]], [dt * grip_velocity, dt * data.qvel[velocities]]
    if name == PUSH:
        block, velocity, turning = _site(env, "object0")
        angles = observation["partial"][11:14]  # in the library's convention of Euler's
        partial = [grip, block, block - grip, data.qpos[positions], angles]
        hidden = [dt * (velocity - grip_velocity), dt * turning, dt * grip_velocity, dt * data.qvel[velocities]]
    np.testing.assert_allclose(observation["partial"], np.concatenate([*partial, env.unwrapped.goal]), atol=1e-6)
    np.testing.assert_allclose(observation["privileged"], np.concatenate(hidden), atol=1e-6)
    assert np.abs(observation["privileged"]).max() > 1e-3
    if name == PUSH:
        angle = mujoco_angle_of(data.site_xmat[model.site("object0").id].reshape(3, 3))
        assert np.linalg.norm(angles) == pytest.approx(angle, abs=0.02)


def mujoco_angle_of(matrix):
    """By which a rotation turns, which small Euler angles agree with."""
    return np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))


def test_fingers_that_reach_are_split_by_velocities():
    env = _one(FINGERS)
    observation = _go(env, 5)
    data = env.unwrapped.data
    positions, velocities = _joints(env)
    tips = np.concatenate([_site(env, f"robot0:S_{finger}tip")[0] for finger in ("ff", "mf", "rf", "lf", "th")])
    np.testing.assert_array_equal(observation["partial"], np.float32([*data.qpos[positions], *tips, *env.unwrapped.goal]))
    np.testing.assert_array_equal(observation["privileged"], np.float32(data.qvel[velocities]))


@pytest.mark.parametrize("name", [DOOR, RELOCATE])
def test_adroit_hides_velocities_and_touch_and_no_other_sensor(name):
    env = _one(name)
    felt = 0.0
    for seed in range(3):
        observation = _go(env, 30, seed)
        unwrapped = env.unwrapped
        np.testing.assert_array_equal(observation["partial"], np.float32(unwrapped.simulated._get_obs()))
        qvel, touch = np.split(observation["privileged"], [unwrapped.model.nv])
        np.testing.assert_array_equal(qvel, np.float32(unwrapped.data.qvel))
        forces = _touched(env, lambda sensor: sensor.startswith(("ST_", "S_")))
        np.testing.assert_allclose(touch, np.log1p(forces), rtol=1e-6)
        felt = max(felt, forces.max())
    assert np.abs(qvel).max() > 1e-2
    assert felt > 0.1


@kinds
def test_the_state_is_both_clean_and_the_noise_spares_goals(name):
    sigma, n = 0.3, 40
    noisy, clean = _make(name, noise_std=sigma, privileged="state"), _one(name)
    n_partial = SIZES[name][0]
    n_goal = 0 if name in (DOOR, RELOCATE) else {TOUCH: 7, FINGERS: 15}.get(name, 3)
    differences = []
    generator = np.random.default_rng(1)
    (observation, _), (reference, _) = noisy.reset(seed=5), clean.reset(seed=5)
    for _ in range(n):
        differences.append(observation["partial"] - reference["partial"])
        state = observation["privileged"]
        assert sorted(state) == sorted([*reference["partial"], *reference["privileged"]])
        action = generator.uniform(-1, 1, noisy.action_space.shape).astype(np.float32)
        observation, reference = noisy.step(action)[0], clean.step(action)[0]
    differences = np.array(differences)
    measured = differences[:, : n_partial - n_goal]
    assert not differences[:, n_partial - n_goal :].any()
    assert measured.std() == pytest.approx(sigma, rel=5 / np.sqrt(2 * measured.size))
    assert abs(measured.mean()) < 5 * sigma / np.sqrt(measured.size)
    assert np.corrcoef(measured[1:].ravel(), measured[:-1].ravel())[0, 1] == pytest.approx(0, abs=5 / np.sqrt(measured.size))


@kinds
def test_seeds_repeat_episodes_whatever_was_before(name):
    env = _one(name, noise_std=0.1)
    first, other, again = (_go(env, 6, seed) for seed in (3, 4, 3))
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
        assert not np.array_equal(first[key], other[key])


@pytest.mark.parametrize("name", [TOUCH, PUSH, DOOR])
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*Box observation space (minimum|maximum) value is -?infinity")
@pytest.mark.filterwarnings("error")
def test_passes_both_environment_checkers(name):
    env = _make(name, noise_std=0.1)
    gymnasium_check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)


def test_history_holds_measurements_and_the_goal_once():
    env = _make(PUSH, noise_std=0.1, history=3)
    assert env.observation_space["partial"].shape == (3 * 14 + 2 * 4 + 3,)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.float32([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_array_equal(second["partial"][14:28], first["partial"][28:42])
    np.testing.assert_array_equal(second["partial"][46:50], np.float32([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_array_equal(second["partial"][-3:], np.float32(env.unwrapped.goal))


# --- hindsight ---------------------------------------------------------------------------------------------------------


def _with_hindsight(n_envs=2, **env_kwargs):
    env = make_vec_env("sb3_gac/FetchReach-v4", n_envs, seed=0, env_kwargs={"goal_entries": True, **env_kwargs})
    return small_model(
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_starts=100,
        role_keys={"learner": ["partial", "desired_goal"]},
    )


def test_goals_as_entries_are_in_no_other_entry():
    """Or goals that are replaced would be there as they were before."""
    env = _make(PUSH, goal_entries=True, privileged="state")
    assert {key: box.shape for key, box in env.observation_space.items()} == {
        "partial": (14,),
        "privileged": (25,),
        "achieved_goal": (3,),
        "desired_goal": (3,),
    }
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation["desired_goal"], np.float32(env.unwrapped.goal))
    np.testing.assert_array_equal(observation["achieved_goal"], observation["partial"][3:6])
    across = observation["desired_goal"][:2]  # on the table is also the block
    assert not np.isin(across, [*observation["partial"], *observation["privileged"]]).any()


def test_hindsight_trains_and_its_rewards_are_those_of_the_goals_that_it_gives():
    model = _with_hindsight().learn(200)
    assert model._n_updates > 0
    assert not (model.replay_buffer.rewards[:100] == 0).all()
    batch = model.replay_buffer.sample(400)
    reached, wanted = (batch.next_observations[key].numpy() for key in ("achieved_goal", "desired_goal"))
    distance = np.linalg.norm(reached - wanted, axis=1)
    np.testing.assert_array_equal(batch.rewards.numpy()[:, 0], -(distance > 0.05).astype(np.float32))
    assert (distance < 1e-3).any(), "goals of hindsight are among them"
    np.testing.assert_array_equal(batch.observations["desired_goal"], batch.next_observations["desired_goal"])
    observation = model.env.reset()
    action, _ = model.predict({key: observation[key] for key in ("partial", "desired_goal")}, deterministic=True)
    assert action.shape == (2, 4)


def test_hindsight_without_goal_entries_says_how_to_have_them():
    with pytest.raises(ValueError, match=r"goal_entries=True.*keep="):
        small_model(_make(REACH), replay_buffer_class=HerReplayBuffer)


# --- what the library lacks on this MuJoCo -----------------------------------------------------------------------------


def test_joints_types_are_numbers_in_that_module_alone():
    from gymnasium_robotics.utils import mujoco_utils

    _one(PUSH)
    assert mujoco_utils.mujoco.mjtJoint.mjJNT_HINGE == 3
    assert type(mujoco_utils.mujoco.mjtJoint.mjJNT_FREE) is int
    assert mujoco_utils.mujoco.mj_step is mujoco.mj_step
    assert type(mujoco.mjtJoint.mjJNT_HINGE).__name__ == "mjtJoint"
    with pytest.raises(AttributeError, match="mj_no_such"):
        mujoco_utils.mujoco.mj_no_such  # noqa: B018


def test_a_copy_can_be_made_in_a_process_that_has_made_none(tmp_path):
    env = _make(REACH, noise_std=0.1)
    (tmp_path / "env.pickle").write_bytes(pickle.dumps(env))
    program = (
        "import pickle, sys\nenv = pickle.load(open(sys.argv[1], 'rb'))\n"
        "print(*env.reset(seed=4)[0]['partial'].tolist(), sep=',')"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "env.pickle")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    expected = env.reset(seed=4)[0]["partial"]
    np.testing.assert_array_equal(np.float32(printed.split(",")), expected)


# --- arguments and presets ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "kwargs", "message"),
    [
        ("HandStand", {}, "task must be one of .*AdroitHandDoor"),
        ("FetchReach", {"privileged": "velocity"}, r"privileged must be one of \['hidden', 'state'\], got 'velocity'"),
        ("FetchReach", {"noise_std": -0.1}, "noise_std"),
        ("FetchReach", {"history": 0}, "history must be an integer of at least 1, got 0"),
        ("FetchReach", {"history": True}, "history"),
        ("AdroitHandDoor", {"goal_entries": True}, "goal_entries=True, but AdroitHandDoor has no goals"),
        ("HandManipulateBlockTouch", {"touch_get_obs": "boolean"}, "touch_get_obs would change"),
    ],
)
def test_refuses_with_the_culprit_named(task, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_robotics(task, **kwargs)


@pytest.mark.parametrize(("task", "other"), [("FetchReach", "FetchPush"), ("AdroitHandDoor", "AdroitHandRelocate")])
def test_an_observation_of_another_size_is_refused(task, other, monkeypatch):
    """A later version of the library may change an observation; the split by position would then show other components."""
    monkeypatch.setitem(TASKS, task, replace(TASKS[task], env_id=TASKS[other].env_id))
    with pytest.raises(ValueError, match=rf"{other}-v\d has \d+ components, but it is split by position as one of \d+"):
        make_robotics(task)


@pytest.mark.parametrize("name", ["HandManipulatePenTouch-v1", "HandManipulatePenRotateTouch-v1", PUSH])
@pytest.mark.parametrize("n_rows", [2, 3, 5])
def test_rewards_of_many_goals_are_those_of_each(name, n_rows):
    robot = _one(name, goal_entries=True).unwrapped
    achieved, desired = np.random.default_rng(0).normal(size=(2, n_rows, *robot.observation_space["desired_goal"].shape))
    of_each = [robot.compute_reward(*goals, {}) for goals in zip(achieved, desired, strict=True)]
    np.testing.assert_allclose(robot.compute_reward(achieved, desired, [{}] * n_rows), of_each)


def test_arguments_of_the_library_are_passed_on():
    assert _make(PUSH).unwrapped.simulated.reward_type == "sparse"
    assert _make(PUSH, reward_type="dense").unwrapped.simulated.reward_type == "dense"
    assert _one(TOUCH).unwrapped.simulated.reward_type == "dense"


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_do_not_leave_critics_what_partial_lacks_alone(name):
    for algorithm in ("gac", "asymmetric_sac", "gpo_clip"):
        assert preset(name, algorithm=algorithm, task="FetchPush").get("role_keys") is None
        assert preset(name, algorithm=algorithm, task="h1-walk").get("role_keys") is None
    assert (preset(name, task="HalfCheetah").get("role_keys") is None) == (preset(name).get("role_keys") is None)


@pytest.mark.parametrize("name", [TOUCH, DOOR])
def test_a_preset_trains(name):
    env = make_vec_env(f"sb3_gac/{name}", 1, seed=0, env_kwargs={"noise_std": 0.01})
    model = small_model(env, **preset("small", task=name.rpartition("-v")[0], learning_starts=20, batch_size=8)).learn(40)
    assert model._n_updates > 0
