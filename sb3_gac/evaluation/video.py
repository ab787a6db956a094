"""A film of an episode: the simulator, and under it the sensor's measurements beside the values that the policy got."""

from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np

from sb3_gac.envs.camera import no_rendering
from sb3_gac.envs.disturbances import Place, beneath, insert_above
from sb3_gac.envs.entries import MEASURED, RECEIVED
from sb3_gac.envs.spaces import PARTIAL
from sb3_gac.envs.state import layers
from sb3_gac.envs.suites.extras import import_extra
from sb3_gac.envs.wrappers import SplitDictObservation
from sb3_gac.evaluation.policies import EvaluatedPolicy

EXTRA, PROGRAM = "video", "sb3-gac evaluate --video"
STRIP, MARGIN, WINDOW = 140, 12, 100  # pixels, pixels, steps
TRUE, GOT, PAPER, INK = (120, 120, 120), (230, 100, 0), (255, 255, 255), (30, 30, 30)
VIDEOS = (".mp4", ".mkv", ".mov", ".avi")  # endings by which the writer knows what to write
Series = list[np.ndarray]


class Tap(gym.ObservationWrapper):
    """
    Keep the newest value of an entry.

    :param env: environment with the entry; its observations stay as they are
    :param key: key of the entry
    """

    def __init__(self, env: gym.Env, key: str):
        super().__init__(env)
        self._key = key
        self.latest = np.empty(0)

    def observation(self, observation: Any) -> Any:
        """
        :param observation: observation of the environment
        :return: the same observation, of which the entry was copied
        """
        self.latest = np.array(observation[self._key])
        return observation


def tapped(env: gym.Env) -> tuple[gym.Env, Tap, Tap]:
    """
    Put two taps into an environment, at the first sensor that ``partial`` is made of.

    :param env: environment in its wrappers, changed in place
    :return: the environment; a tap of the sensor's values without noise; and a tap of the values that arrive
    """
    arriving = beneath(env, PARTIAL, RECEIVED)[0]
    measured = beneath(arriving.layer, arriving.key, MEASURED)[0]
    between = takewhile(lambda layer: layer is not measured.layer, layers(arriving.layer))
    if splits := [layer for layer in between if isinstance(layer, SplitDictObservation)]:
        arriving = Place(splits[-1].env, measured.key)  # where both are values of the same entry
    true = Tap(measured.layer, measured.key)
    env = insert_above(env, measured.layer, lambda _: true)
    got = Tap(true if arriving.layer is measured.layer else arriving.layer, arriving.key)
    return insert_above(env, got.env, lambda _: got), true, got


def check_can_film(env: gym.Env, name: str) -> None:
    """
    Check that an environment can be filmed.

    :param env: environment made with ``render_mode="rgb_array"``
    :param name: name of the environment, for the message
    :raises ImportError: if a module that writes videos is not installed; the message says how to install it
    :raises RuntimeError: if the environment can't be drawn; the message says why
    """
    for module in ("moviepy", "PIL"):
        import_extra(module, EXTRA, PROGRAM)
    env.reset(seed=0)
    try:
        frame = env.render()
    except Exception as error:
        if "mujoco" in f"{type(env.unwrapped).__module__} {error}".lower() or "gl" in str(error).lower():
            raise no_rendering(error) from error
        raise RuntimeError(f"--video: {name} can't be drawn here ({type(error).__name__}: {error}).") from error
    if not isinstance(frame, np.ndarray):
        raise RuntimeError(f'--video: {name} has no render_mode "rgb_array": leave --video out.')


def film(policy: EvaluatedPolicy, env: gym.Env, seed: int, title: str, path: Path) -> float:
    """
    Film an episode.

    :param policy: policy that acts, deterministically
    :param env: environment made with ``render_mode="rgb_array"``, not yet reset
    :param seed: seed of the episode
    :param title: title of the setting, for the caption
    :param path: file of the video
    :return: return of the episode
    """
    from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter

    env, measured, got = tapped(env)
    steps = list(_played(policy, env, seed, measured, got))
    series = [np.stack([step[of] for step in steps]) for of in (0, 1)]
    writer, total = None, 0.0
    for step, (_, _, total) in enumerate(_played(policy, env, seed, measured, got)):
        frame = _composed(np.asarray(env.render()), series, step, f"{title}    step {step}    return {total:.1f}")
        if writer is None:
            fps = env.unwrapped.metadata.get("render_fps") or 30
            writer = FFMPEG_VideoWriter(str(path), frame.shape[1::-1], fps)
        writer.write_frame(frame)
    assert writer is not None
    for _ in range(round(fps)):  # a second to look at the end
        writer.write_frame(frame)
    writer.close()
    return total


def _played(
    policy: EvaluatedPolicy, env: gym.Env, seed: int, measured: Tap, got: Tap
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """
    Play an episode, which is the same each time.

    For the reset and for each step it yields the value that was measured, the value that arrived, and the return so far.
    """
    observation, _ = env.reset(seed=seed)
    policy.start(1)
    starts, total, is_over = np.ones(1, dtype=bool), 0.0, False
    yield measured.latest, got.latest, total
    while not is_over:
        (action,) = policy.act({key: np.asarray(value)[None] for key, value in observation.items()}, starts)
        observation, reward, terminated, truncated, _ = env.step(action)
        starts, total, is_over = np.zeros(1, dtype=bool), total + float(reward), terminated or truncated
        yield measured.latest, got.latest, total


def _composed(picture: np.ndarray, series: Series, step: int, caption: str) -> np.ndarray:
    """
    Draw a frame of the video.

    :param picture: picture of the simulator, shape (H, W, 3)
    :param series: values that were measured, and values that arrived, of shape (T, ...) each
    :param step: number of the step to show, from 0 at the reset
    :param caption: text above the picture
    :return: picture between caption and strip; its width and height are even, as video codecs need them
    """
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), 13)
    height, width = picture.shape[:2]
    top, is_vector = 2 * MARGIN + 4, series[0].ndim == 2
    size = (width + width % 2, top + height + is_vector * STRIP)
    canvas = Image.new("RGB", (size[0], size[1] + size[1] % 2), PAPER)
    canvas.paste(Image.fromarray(picture[..., :3]), (0, top))
    draw = ImageDraw.Draw(canvas)
    draw.text((MARGIN, MARGIN // 2), caption, INK, font)
    if is_vector:
        _draw_strip(draw, font, series, step, (MARGIN, top + height + 26, width - MARGIN, top + height + STRIP - MARGIN))
    return np.asarray(canvas)


def _draw_strip(draw: Any, font: Any, series: Series, step: int, box: tuple[int, int, int, int]) -> None:
    """Draw the last steps of the component that moves most, as it was measured and as it arrived."""
    left, top, right, bottom = box
    component = int(np.argmax(series[0].std(axis=0)))
    measured, got = (values[:, component] for values in series)
    low, high = min(measured.min(), got.min()), max(measured.max(), got.max())
    steps = np.arange(max(step - WINDOW, 0), step + 1)
    x = left + (steps - steps[0]) / min(WINDOW, len(measured) - 1) * (right - left)
    for values, colour in ((got, GOT), (measured, TRUE)):
        y = bottom - (values[steps] - low) / max(high - low, 1e-9) * (bottom - top)
        if len(steps) > 1:
            draw.line(list(zip(x.tolist(), y.tolist(), strict=True)), colour, 2)
    draw.text((left, top - 20), f"partial[{component}]:", INK, font)
    draw.text((left + 90, top - 20), "as it is", TRUE, font)
    draw.text((left + 160, top - 20), "as the policy gets it", GOT, font)
