"""MuJoCo from pixels: images of the simulator's own state, stacks, resume to the bit, and what is said without OpenGL."""

import itertools
import pickle
import re
from copy import deepcopy

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_gac.envs import CameraImage, NoRenderingError, SplitObservation, make_pixels
from sb3_gac.envs.camera import make_renderer
from sb3_gac.envs.state import env_state, layers, restore_env_state
from sb3_gac.envs.suites.pixels import TASKS
from tests.envs.rendering import needs_rendering

STATE_SIZES = {"Ant": 27, "HalfCheetah": 17, "Hopper": 11, "Humanoid": 270, "Swimmer": 8, "Walker2d": 17}


@pytest.fixture
def _rendering():
    needs_rendering()


def _make(task="HalfCheetah", **kwargs):
    return gym.make(f"sb3_gac/{task}Pixels-v5", **kwargs)


@pytest.mark.parametrize("task", TASKS)
def test_spaces(task):
    """Which takes no OpenGL."""
    space = _make(task).observation_space
    assert space["partial"] == gym.spaces.Box(0, 255, (9, 64, 64), np.uint8)
    assert (space["privileged"].shape, space["privileged"].dtype) == ((STATE_SIZES[task],), np.float32)


@pytest.mark.usefixtures("_rendering")
@pytest.mark.parametrize("task", TASKS)
def test_the_state_is_the_state_tasks_and_images_move_with_it(task):
    env, states = _make(task), gym.make(f"sb3_gac/{task}-v5", noise_std=0.0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(5)]
    pairs = [(env.reset(seed=1)[0], states.reset(seed=1)[0])]
    for action in actions:
        (seen, reward, *ended, _), (state, expected, *end, _) = env.step(action), states.step(action)
        pairs.append((seen, state))
        assert (reward, ended) == (expected, end)
    for seen, state in pairs:
        np.testing.assert_array_equal(seen["privileged"], state["privileged"])
        assert seen["partial"] in env.observation_space["partial"]
    first, last = pairs[0][0]["partial"], pairs[-1][0]["partial"]
    assert (first[:3] == first[3:6]).all()
    assert (first[:3] == first[6:]).all(), "the first frame fills the stack"
    assert first.std() > 10, "something is to be seen"
    assert (last[:3] != last[6:]).any(), "and it moves"
    for (before, _), (after, _) in itertools.pairwise(pairs):
        np.testing.assert_array_equal(before["partial"][3:], after["partial"][:6])
    env.close()


@pytest.mark.usefixtures("_rendering")
def test_an_image_is_what_the_camera_sees_right_way_up():
    env = _make(frames=1, size=48)
    image = env.reset(seed=0)[0]["partial"]
    assert image.shape == (3, 48, 48)
    simulator = env.unwrapped
    with mujoco.Renderer(simulator.model, 48, 48) as renderer:  # with all that is slow
        renderer.update_scene(simulator.data, camera="track")
        plain = renderer.render().transpose(2, 0, 1)
    assert np.abs(image.astype(float) - plain).mean() < 25
    assert np.corrcoef(image.ravel(), plain.ravel())[0, 1] > 0.8
    assert np.corrcoef(image[:, ::-1].ravel(), plain.ravel())[0, 1] < 0.5
    other = _make(frames=1, size=48)
    np.testing.assert_array_equal(image, other.reset(seed=0)[0]["partial"])
    env.close()


@pytest.mark.usefixtures("_rendering")
def test_an_image_shows_what_the_environment_has_changed_in_its_model():
    env = _make(frames=1)
    plain, model = env.reset(seed=0)[0]["partial"], env.unwrapped.model
    for name, value in {"geom_rgba": [1, 0, 0, 1], "light_diffuse": 0.1, "geom_size": 0.2}.items():
        before = getattr(model, name).copy()
        getattr(model, name)[:] = value
        assert np.abs(env.reset(seed=0)[0]["partial"].astype(float) - plain).mean() > 1, name
        getattr(model, name)[:] = before
        np.testing.assert_array_equal(env.reset(seed=0)[0]["partial"], plain)
    env.close()


@pytest.mark.usefixtures("_rendering")
def test_an_image_shows_another_robot_once_the_environment_has_it():
    env, walker = _make("Hopper", frames=1), _make("Walker2d", frames=1)
    env.reset(seed=0)
    expected = walker.reset(seed=0)[0]["partial"]
    env.unwrapped.model, env.unwrapped.data = walker.unwrapped.model, walker.unwrapped.data
    camera = next(layer for layer in layers(env) if isinstance(layer, CameraImage))
    np.testing.assert_array_equal(camera._image(), expected)
    walker.close()


@pytest.mark.usefixtures("_rendering")
def test_the_environments_own_model_is_left_as_it_is():
    env = _make()
    env.reset(seed=0)
    assert env.unwrapped.model.vis.quality.shadowsize == gym.make("HalfCheetah-v5").unwrapped.model.vis.quality.shadowsize > 0
    env.close()


@pytest.mark.usefixtures("_rendering")
@pytest.mark.parametrize("task", ["HalfCheetah", "Hopper"])
def test_another_environment_goes_on_to_the_bit(task):
    env, other = _make(task, max_episode_steps=25), _make(task, max_episode_steps=25)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(40)]

    def go_on(env, actions):
        seen = []
        for action in actions:
            observation, reward, terminated, truncated, _ = env.step(action)
            seen.append((deepcopy(observation), reward, terminated, truncated))
            if terminated or truncated:
                seen.append(deepcopy(env.reset()[0]))
        return seen

    env.reset(seed=3)
    go_on(env, actions[:18])
    state = env_state(env)
    expected = go_on(env, actions[18:])
    other.reset(seed=99)
    restore_env_state(other, state)
    np.testing.assert_equal(go_on(other, actions[18:]), expected)


@pytest.mark.usefixtures("_rendering")
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*Box observation space (minimum|maximum) value is -?infinity")
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box action space")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("task", TASKS)
def test_passes_both_environment_checkers(task):
    env = _make(task)
    gymnasium_check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.usefixtures("_rendering")
def test_a_copy_draws_with_a_context_of_its_own():
    env = _make()
    env.reset(seed=4)
    copy = pickle.loads(pickle.dumps(env))
    first, second = env.reset(seed=5)[0], copy.reset(seed=5)[0]
    env.close()
    np.testing.assert_equal(first, second)
    assert copy.step(copy.action_space.sample())[0]["partial"].any(), "closing the one does not close the other"


def test_without_opengl_it_is_said_what_to_install_and_to_set(monkeypatch):
    def fail(*args):
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    env = _make()
    monkeypatch.setattr(mujoco, "Renderer", fail)
    said = re.escape("can't draw images here (AttributeError: 'NoneType' object has no attribute 'eglQueryString')")
    with pytest.raises(NoRenderingError, match=rf"{said}.*apt-get install libegl1 .*MUJOCO_GL=egl before Python starts"):
        env.reset()
    with pytest.raises(NoRenderingError):
        make_renderer(env.unwrapped.model, 8)


def test_where_mujoco_itself_fails_for_want_of_opengl(monkeypatch):
    import builtins

    real = builtins.__import__

    def fail(name, *args, **kwargs):
        if name == "mujoco":
            raise AttributeError("no EGL")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", fail)
    with pytest.raises(NoRenderingError, match=r"\(AttributeError: no EGL\).*apt-get install"):
        make_pixels("HalfCheetah")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"task": "Pusher"}, "task must be one of .*HalfCheetah"),
        ({"noise_std": 0.1}, "noise_std must be 0 for images, got 0.1"),
        ({"noise_std": np.full(3, 0.1)}, "noise_std must be 0 for images"),
        ({"history": 5}, "history is for vectors.* argument frames"),
        ({"camera": "front"}, r"camera must be one of \['track'\], got 'front'"),
        ({"size": 0}, "size must be an integer of at least 1"),
        ({"size": 64.5}, "size must be an integer of at least 1, in pixels, got 64.5"),
        ({"frames": 0}, "frames must be an integer of at least 1, got 0"),
        ({"frames": 2.5}, "frames must be an integer of at least 1, got 2.5"),
        ({"privileged": "everything"}, "privileged must be one of"),
    ],
)
def test_refuses_with_the_culprit_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_pixels(**{"task": "HalfCheetah", **kwargs})


def test_a_model_without_a_camera_is_told():
    env = SplitObservation(gym.make("Reacher-v5"), [0], [1])
    with pytest.raises(ValueError, match=r"camera='track', but the model of .* has no camera: add one to its XML file"):
        CameraImage(env)


def test_other_simulators_have_no_camera():
    with pytest.raises(ValueError, match="CameraImage needs an environment of gymnasium's MuJoCo"):
        CameraImage(gym.make("sb3_gac/Pendulum-v1"))
