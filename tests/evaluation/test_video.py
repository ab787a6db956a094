"""The film of an episode: it is the evaluated one, and shows what the sensor measured beside what arrived."""

import json
import os
import sys
from typing import ClassVar

import numpy as np
import pytest
from gymnasium import spaces

from sb3_gac import GAC
from sb3_gac.envs import DroppedFrames, History, SensorDelay, SensorNoise, SplitDictObservation
from sb3_gac.envs.camera import CameraImage
from sb3_gac.envs.wrappers import EntryWrapper
from sb3_gac.evaluate import main
from sb3_gac.evaluation.policies import learner_of
from sb3_gac.evaluation.settings import UNDISTURBED, Environment, Setting
from sb3_gac.evaluation.video import GOT, PAPER, TRUE, Tap, _composed, film, tapped
from tests.evaluation.helpers import ENV, Walk, noisy_walk

NOISY = "tests.evaluation.helpers:noisy_walk"
SMALL = {"buffer_size": 100, "policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "gac.zip"
    GAC("MultiInputPolicy", noisy_walk(), **SMALL).save(path)
    return path


def test_the_worst_settings_first_episode_is_filmed(model, tmp_path, capsys):
    pytest.importorskip("moviepy", reason="writes the video")
    import imageio_ffmpeg

    options = ["--env", NOISY, "--noise", "0", "3", "--episodes", "4", "--out", str(tmp_path)]
    video = tmp_path / "made" / "film.mp4"
    main([str(model), *options, "--video", str(video)])
    results = json.loads((tmp_path / "evaluation.json").read_text())["results"]
    worst = min(results, key=lambda result: result["mean"])
    said = capsys.readouterr().out.splitlines()[-1]
    assert f"noise {worst['noise']:g}, delay 0, drop 0; return {worst['returns'][0]:.5g}" in said
    frames = imageio_ffmpeg.read_frames(str(video))
    about = next(frames)
    assert (about["fps"], about["size"][0]) == (25, 60)
    assert about["size"][1] % 2 == 0
    assert sum(1 for _ in frames) == worst["lengths"][0] + 1 + 25, "from the first state to the last, and a second more"


def _stepped(env, taps, n=12):
    env.reset(seed=3)
    shown = [[tap.latest for tap in taps]]
    for _ in range(n):
        observation, *_ = env.step(np.zeros(1, np.float32))
        shown.append([tap.latest for tap in taps])
    return [np.stack(of_tap) for of_tap in zip(*shown, strict=True)], observation["partial"]


def test_taps_are_before_the_noise_and_after_the_last_loss():
    env = History(DroppedFrames(SensorDelay(SensorNoise(Walk(), 0.5), 2), 0.3), 2)
    env, measured, got = tapped(env)
    kinds = [type(layer) for layer in (env, env.env, env.env.env, measured.env)]
    assert kinds == [History, Tap, DroppedFrames, Walk]
    (true, seen), newest = _stepped(env, (measured, got))
    np.testing.assert_array_equal(true[:, 1], np.arange(13), "the number of the step, without noise")
    np.testing.assert_array_equal(seen[-1], newest[2:])
    assert not np.isclose(seen, true).any()


@pytest.mark.parametrize("make", [Walk, lambda: History(Walk(), 2), lambda: SensorNoise(Walk(), 0.0)])
def test_without_disturbance_both_are_one(make):
    env, measured, got = tapped(make())
    (true, seen), _ = _stepped(env, (measured, got))
    np.testing.assert_array_equal(seen, true)
    np.testing.assert_array_equal(true[:, 1], np.arange(13))


def test_a_frame_has_the_picture_and_both_lines_in_their_colours():
    pytest.importorskip("PIL", reason="draws the strip")
    picture = np.full((41, 301, 3), 7, np.uint8)
    rising = np.linspace(0, 1, 50)[:, None] * [[0, 1]]
    frame = _composed(picture, [rising, rising + 0.3], 49, "caption")
    assert all(side % 2 == 0 for side in frame.shape[:2])
    top = int(np.flatnonzero((frame[:, 150] == 7).all(axis=-1))[0])
    np.testing.assert_array_equal(frame[top : top + 41, :301], picture)
    strip = frame[top + 41 + 26 :]
    rows = {}
    for name, colour in (("measured", TRUE), ("got", GOT)):
        y, x = np.nonzero((strip == colour).all(axis=-1))
        assert x.max() - x.min() > 250, "from one side to the other"
        assert np.corrcoef(x, y)[0, 1] < -0.9, "it rises: component 1, which moves most"
        rows[name] = y.mean()
    assert rows["got"] < rows["measured"], "higher by 0.3"
    image = np.zeros((50, 3, 8, 8))
    assert len(_composed(picture, [image, image], 0, "caption")) < len(frame), "images have no strip"
    assert (_composed(picture, [image, image], 0, "")[:20] == PAPER).all()


def test_what_is_missing_is_said_before_anything_is_run(model, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_gac.evaluate.run_episodes", None)
    options = [str(model), "--noise", "0", "--out", str(tmp_path), "--video", str(tmp_path / "x.mp4")]
    with monkeypatch.context() as context:
        context.setitem(sys.modules, "moviepy", None)
        with pytest.raises(SystemExit, match=r"--video needs moviepy.*\.\[video\]"):
            main([*options, "--env", NOISY])
    pytest.importorskip("moviepy", reason="what is missing otherwise")
    monkeypatch.setattr(Walk, "render", lambda self: None)
    with pytest.raises(SystemExit, match='walk has no render_mode "rgb_array"'):
        main([*options, "--env", NOISY])
    monkeypatch.setattr(Walk, "render", lambda self: 1 / 0)
    with pytest.raises(SystemExit, match=r"walk can't be drawn here.*division"):
        main([*options, "--env", NOISY])
    with pytest.raises(SystemExit, match="blind_walk takes no render_mode"):
        main([*options, "--env", "tests.evaluation.helpers:blind_walk"])


@pytest.mark.parametrize(
    ("before", "library", "after"), [(None, "libEGL.so.1", "egl"), (None, None, None), ("osmesa", "x", "osmesa")]
)
def test_mujoco_draws_without_a_screen_where_it_can(before, library, after, tmp_path, monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY"):
        monkeypatch.setenv(name, "restored after the test")
        monkeypatch.delenv(name)
    if before is not None:
        monkeypatch.setenv("MUJOCO_GL", before)
    monkeypatch.setattr("sb3_gac.evaluate.find_library", lambda name: library)
    for video in ([], ["--video", "x.mp4"]):
        with pytest.raises(SystemExit):
            main([str(tmp_path / "nowhere"), *video])
        assert os.environ.get("MUJOCO_GL") == (after if video else before)


def test_a_film_is_made_where_an_environment_is_made_by_its_id():
    env = Environment("sb3_gac/Pendulum-v1").make(Setting(0.1, 1))
    env, measured, got = tapped(env)
    env.reset(seed=0)
    first = measured.latest
    env.step(np.zeros(1, np.float32))
    assert np.abs(got.latest - first).max() < 1
    assert not np.allclose(measured.latest, first)
    assert type(measured.env).__name__ == "SplitObservation"
    assert Environment(ENV).make(UNDISTURBED, "rgb_array").render_mode == "rgb_array"


def test_what_is_beneath_a_camera_is_not_what_it_shows():
    """Noise on positions, beneath the camera, is of another shape."""

    class Lens(CameraImage):
        def __init__(self, env):
            EntryWrapper.__init__(self, env, "partial")
            self._set_entry_space(spaces.Box(0, 255, (2, 2, 3), np.uint8))

        def _first(self, value, seed):
            return np.zeros((2, 2, 3), np.uint8)

        def _next(self, value, action, reward):
            return np.full((2, 2, 3), self.unwrapped.steps, np.uint8)

    env, measured, got = tapped(SensorDelay(Lens(SensorNoise(Walk(), 0.5)), 2))
    (true, seen), _ = _stepped(env, (measured, got))
    assert true.shape == seen.shape == (13, 2, 2, 3)


def test_both_taps_are_at_one_sensor_beneath_a_split():
    selected = {"partial": {"partial": [1], "privileged": None}, "privileged": ["privileged"]}
    env = History(SplitDictObservation(SensorDelay(SensorNoise(Walk(), 0.5), 2), **selected), 2)
    env, *taps = tapped(env)
    (true, seen), newest = _stepped(env, taps)
    np.testing.assert_array_equal(true[:, 1], np.arange(13))
    assert seen[-1][1] == newest[2]
    assert not np.isclose(seen, true).any()


def test_a_film_may_have_a_fraction_of_frames_in_a_second(tmp_path):
    pytest.importorskip("moviepy")

    class Drawn(Walk):
        metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 1 / 0.03}

        def render(self):
            return np.zeros((40, 60, 3), np.uint8)

    policy = learner_of(GAC("MultiInputPolicy", Walk(), **SMALL))
    film(policy, Drawn(), 0, "noise 0", tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").stat().st_size > 0
