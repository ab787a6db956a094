"""From your own simulator to a file for the robot: a cart sees a noisy position, and in training its velocity too."""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_gac import GAC, OnnxPolicy, export_learner, preset
from sb3_gac.envs import History, SensorNoise


class Cart(gym.Env):
    """Bring a cart to rest at 0. ``partial`` is the value of its sensor, ``privileged`` the whole state of the simulator."""

    def __init__(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        whole = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict({"partial": spaces.Box(-np.inf, np.inf, (1,), np.float32), "privileged": whole})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        return self._observation(), {}

    def step(self, action):
        position, velocity = self._state
        velocity += 0.1 * float(action[0])
        self._state = np.array([position + 0.1 * velocity, velocity], np.float32)
        return self._observation(), -float(self._state @ self._state), False, False, {}

    def _observation(self):
        return {"partial": self._state[:1], "privileged": self._state.copy()}


def make_env() -> gym.Env:
    """Make the cart with a noisy sensor, whose last four values the policy sees."""
    return gym.wrappers.TimeLimit(History(SensorNoise(Cart(), noise_std=0.02), length=4, actions=True), 100)


def main(steps: int = 20_000, out: Path = Path("cart.onnx")) -> None:
    """Train, export the learner, and take an action from the exported file."""
    env = make_vec_env(make_env, n_envs=4, seed=0)
    model = GAC("MultiInputPolicy", env, seed=0, **preset("small", buffer_size=steps, learning_starts=min(1_000, steps // 2)))
    model.learn(steps)
    export_learner(model, out)
    robot = OnnxPolicy.load(out)  # only needs numpy and onnxruntime
    observation = env.reset()
    print("the robot does", robot.act(observation["partial"]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    main(parser.parse_args().steps)
