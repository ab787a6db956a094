"""MuJoCo tasks: the split against the simulator's own state, noise without effect on the dynamics, time limits, checkers."""

import pickle
import re
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env

from sb3_gac.envs import make_mujoco

DIMENSIONS = {
    "HalfCheetah": (8, 9),
    "Ant": (13, 14),
    "Humanoid": (169, 101),
    "HumanoidStandup": (169, 101),
    "InvertedDoublePendulum": (5, 3),
    "Hopper": (5, 6),
    "Walker2d": (8, 9),
    "Swimmer": (3, 5),
}
POSITIONS_LEFT_OUT = {"HalfCheetah": 1, "Hopper": 1, "Walker2d": 1, "Ant": 2, "Swimmer": 2}
CLIPPED = ("Hopper", "Walker2d", "InvertedDoublePendulum")

all_tasks = pytest.mark.parametrize("task", DIMENSIONS)


def _make(task, **kwargs):
    return gym.make(f"sb3_gac/{task}-v5", **kwargs)


def _state(task, data):
    """Blocks of the clean observation in their order, each with the name of its kind."""
    velocity = np.clip(data.qvel, -10, 10) if task in CLIPPED else data.qvel
    if task == "InvertedDoublePendulum":
        angles = data.qpos[1:]
        return [("partial", data.qpos[:1]), ("partial", np.sin(angles)), ("partial", np.cos(angles)), ("velocity", velocity)]
    if task.startswith("Humanoid"):
        inertia, velocities, forces = data.cinert[1:].ravel(), data.cvel[1:].ravel(), data.qfrc_actuator[6:]
        first = [("partial", data.qpos[2:]), ("velocity", velocity), ("partial", inertia)]
        return [*first, ("velocity", velocities), ("partial", forces)]
    return [("partial", data.qpos[POSITIONS_LEFT_OUT[task] :]), ("velocity", velocity)]


def _clean(task, env, kind="state"):
    blocks = [block for name, block in _state(task, env.unwrapped.data) if kind in ("state", name)]
    return np.concatenate(blocks).astype(np.float32)


def _random_steps(env, n):
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    for _ in range(n):
        observation, *_ = env.step(env.action_space.sample())
    return observation


@pytest.mark.parametrize("task", ["HalfCheetah", "Ant"])
@pytest.mark.parametrize("vectorized", [False, True])
def test_making_a_task_says_nothing_and_leaves_nothing_behind(task, vectorized, tmp_path, monkeypatch, capfd, recwarn):
    """gymnasium's own HalfCheetah warns on stderr, once for each environment, and in a file."""
    monkeypatch.chdir(tmp_path)
    env = make_vec_env(f"sb3_gac/{task}-v5", 2) if vectorized else _make(task)
    env.reset()
    env.close()
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
    assert not [str(warning.message) for warning in recwarn if "MuJoCo" in str(warning.message)]
    gym.make(f"{task}-v5")
    assert ("settotalmass" in capfd.readouterr().err) == (task == "HalfCheetah"), "gymnasium's own is what it was"


@pytest.fixture
def _muted(monkeypatch, tmp_path):
    """Whatever a test does to MuJoCo's handler, and what the library writes without one."""
    monkeypatch.chdir(tmp_path)
    yield
    mujoco.set_mju_user_warning(None)


def _compile_a_model_that_warns_twice(*args):
    xml = '<mujoco><compiler settotalmass="1"/><worldbody><body><geom size="1"/></body></worldbody></mujoco>'
    mujoco.MjModel.from_xml_string(xml)
    _diverge()


def _diverge():
    """MuJoCo warns of a state that is no number."""
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>')
    data = mujoco.MjData(model)
    data.qpos[:] = np.nan
    mujoco.mj_step(model, data)


@pytest.mark.usefixtures("_muted")
def test_other_warnings_of_mujoco_are_passed_on(monkeypatch):
    monkeypatch.setattr("sb3_gac.envs.suites.mujoco.make_task", _compile_a_model_that_warns_twice)
    with pytest.warns(UserWarning, match="MuJoCo: .*Nan") as caught:
        make_mujoco("HalfCheetah")
    assert not [warning for warning in caught if "settotalmass" in str(warning.message)]
    assert mujoco.get_mju_user_warning() is None
    heard = []
    mujoco.set_mju_user_warning(heard.append)
    make_mujoco("HalfCheetah")
    assert len(heard) == 1
    assert "Nan" in heard[0]
    mujoco.MjModel.from_xml_string('<mujoco><compiler settotalmass="1"/></mujoco>')
    assert len(heard) == 2, "the handler is the one that it was"


@pytest.mark.usefixtures("_muted")
def test_a_task_that_cannot_be_made_leaves_the_handler_alone():
    with pytest.raises(OSError, match="does not exist"):
        make_mujoco("HalfCheetah", xml_file="/no/such.xml")
    assert mujoco.get_mju_user_warning() is None


@all_tasks
@pytest.mark.parametrize("privileged", ["velocity", "state"])
def test_dimensions_and_type(task, privileged):
    env = _make(task, privileged=privileged)
    n_partial, n_velocity = DIMENSIONS[task]
    n_privileged = n_velocity if privileged == "velocity" else n_partial + n_velocity
    for key, size in (("partial", n_partial), ("privileged", n_privileged)):
        assert env.observation_space[key].shape == (size,)
        assert env.observation_space[key].dtype == np.float32
        assert env.reset(seed=0)[0][key].dtype == env.step(env.action_space.sample())[0][key].dtype == np.float32
    assert env.reset(seed=0)[0] in env.observation_space


@all_tasks
@pytest.mark.parametrize("privileged", ["velocity", "state"])
def test_split_is_the_simulators_state(task, privileged):
    env = _make(task, noise_std=0.0, privileged=privileged)
    observation = _random_steps(env, 7)
    assert np.array_equal(observation["partial"], _clean(task, env, "partial"))
    assert np.array_equal(observation["privileged"], _clean(task, env, privileged))
    assert np.all(env.unwrapped.data.qvel != 0)


@pytest.mark.parametrize("task", CLIPPED)
def test_velocities_are_clipped(task):
    env = _make(task, noise_std=0.0, privileged="velocity")
    env.reset(seed=0)
    env.unwrapped.set_state(env.unwrapped.init_qpos, np.full_like(env.unwrapped.init_qvel, 30.0))
    observation, *_ = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    assert np.abs(env.unwrapped.data.qvel).max() > 10
    assert np.abs(observation["privileged"]).max() == 10
    assert np.array_equal(observation["privileged"], _clean(task, env, "velocity"))


@all_tasks
def test_by_default_partial_is_noisy_and_privileged_is_the_clean_state(task):
    env = _make(task)
    for n_steps in (0, 5):
        observation = _random_steps(env, n_steps)
        noise = observation["partial"] - _clean(task, env, "partial")
        assert np.array_equal(observation["privileged"], _clean(task, env, "state"))
        assert np.all(noise != 0)
        assert np.abs(noise).max() < 0.6
        assert np.abs(noise).max() > 0.02
    assert np.isinf(env.observation_space["partial"].low).all()


@all_tasks
def test_sigma_changes_neither_dynamics_nor_privileged(task):
    def roll_out(sigma):
        env = _make(task, noise_std=sigma)
        env.action_space.seed(3)
        trace, noisy = [], []
        for seed in (11, None):
            observation, reward = env.reset(seed=seed)[0], 0.0
            for _ in range(8):
                data = env.unwrapped.data
                trace.append(np.concatenate([data.qpos, data.qvel, [reward], observation["privileged"]]))
                noisy.append(observation["partial"])
                observation, reward, *_ = env.step(env.action_space.sample())
        return np.array(trace), np.array(noisy)

    (trace, partial), *others = (roll_out(sigma) for sigma in (0.0, 0.1, 1.0))
    for other_trace, other_partial in others:
        assert np.array_equal(trace, other_trace)
        assert not np.isclose(partial, other_partial).all(axis=1).any()
    assert not np.array_equal(trace[0], trace[8])  # the second episode starts elsewhere


@all_tasks
def test_seed_repeats_dynamics_and_noise(task):
    first, second = (_random_steps(_make(task), 3) for _ in range(2))
    other, _ = _make(task).reset(seed=1)
    for key in ("partial", "privileged"):
        assert np.array_equal(first[key], second[key])
        assert not np.array_equal(other[key], _make(task).reset(seed=2)[0][key])


@all_tasks
def test_time_limit_of_1000_steps_is_a_truncation(task):
    env = _make(task)
    env.reset(seed=0)
    start = env.unwrapped.init_qpos, env.unwrapped.init_qvel
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    for t in range(1, 1001):
        env.unwrapped.set_state(*start)  # never falls
        _, _, terminated, truncated, _ = env.step(action)
        assert not terminated
        assert truncated == (t == 1000)


@all_tasks
@pytest.mark.parametrize("kwargs", [{}, {"noise_std": 0.0, "privileged": "velocity"}])
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*Box observation space (minimum|maximum) value is -?infinity")
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box action space")  # Humanoid: 0.4
@pytest.mark.filterwarnings("error")
def test_passes_both_environment_checkers(task, kwargs):
    env = _make(task, **kwargs)
    gymnasium_check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)


@all_tasks
def test_is_picklable(task):
    env = _make(task, noise_std=0.2)
    env.reset(seed=4)
    copy = pickle.loads(pickle.dumps(env))
    first, second = env.reset(seed=5)[0], copy.reset(seed=5)[0]
    assert all(np.array_equal(first[key], second[key]) for key in ("partial", "privileged"))


def test_passes_arguments_on_to_gymnasium():
    env = _make("HalfCheetah", noise_std=0.0, reset_noise_scale=0.0, max_episode_steps=3, render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    assert env.reset(seed=0)[0]["partial"].tolist() == env.unwrapped.init_qpos[1:].tolist()
    assert [env.step(env.action_space.sample())[3] for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize(
    ("task", "kwargs", "message"),
    [
        ("Pusher", {}, "task must be one of .*HalfCheetah"),
        ("Ant", {"privileged": "everything"}, "privileged must be one of .*state"),
        ("Ant", {"noise_std": -0.1}, "noise_std"),
        ("Ant", {"noise_std": float("nan")}, "noise_std"),
        ("Ant", {"noise_std": [0.1] * 12}, "noise_std"),
        ("HalfCheetah", {"exclude_current_positions_from_observation": False}, "exclude_current_positions_from_observation"),
        ("Humanoid", {"include_cfrc_ext_in_observation": True}, "include_cfrc_ext_in_observation"),
    ],
)
def test_refuses_with_the_culprit_named(task, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_mujoco(task, **kwargs)


@pytest.mark.parametrize("task", ["Hopper", "HopperPixels"])
@pytest.mark.parametrize("privileged", ["velocity", "state"])
def test_a_robot_with_another_number_of_joints_is_refused(task, privileged, tmp_path):
    """By position, its last position would be the first velocity, and its last velocity would be shown nowhere."""
    text = (Path(gym.__file__).parent / "envs/mujoco/assets/hopper.xml").read_text()
    toes = '<body><joint name="toes" range="-9 9"/><geom size="0.01"/></body>'
    file = tmp_path / "hopper.xml"
    file.write_text(re.sub(r'(<geom [^>]*name="foot_geom"[^>]*/>)', rf"\1{toes}", text))
    with pytest.raises(ValueError, match=r"Hopper-v5 has 13 components, but it is split by position as one of 11\."):
        _make(task, xml_file=str(file), privileged=privileged)
