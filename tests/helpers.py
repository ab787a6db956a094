"""Small environments and models for the tests."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_gac import GAC


class TwoViewBandit(gym.Env):
    """
    One-step task with a known optimum: the target is seen exactly in ``privileged`` and through noise in ``partial``.

    Return of action a for target z: -(a - z)^2.  With z ~ U(-0.8, 0.8) and partial = z + N(0, noise_std), the best that
    a learner can do is the posterior mean of z.

    :param noise_std: standard deviation of the noise in the partial view
    :param length: steps per episode; each draws a new target
    """

    def __init__(self, noise_std: float = 0.0, length: int = 1):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-np.inf, np.inf, (2,), np.float32), privileged=spaces.Box(-1, 1, (1,), np.float32)
        )
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.noise_std, self.length = noise_std, length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self._step = 0
        return self._draw(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        reward = -float((action[0] - self._target) ** 2)
        self._step += 1
        return self._draw(), reward, self._step >= self.length, False, {}

    def checkpoint_state(self) -> dict[str, Any]:
        return {"target": self._target, "step": self._step}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        self._target, self._step = state["target"], state["step"]

    def _draw(self) -> dict[str, np.ndarray]:
        self._target = self.np_random.uniform(-0.8, 0.8)
        seen = self._target + self.noise_std * self.np_random.standard_normal()
        partial = np.array([seen, self.np_random.standard_normal()], dtype=np.float32)
        return {"partial": partial, "privileged": np.array([self._target], dtype=np.float32)}


class TwoViewChoice(TwoViewBandit):
    """
    Three actions instead of a number: 1 for the one whose third of the range holds the target, else 0.

    With ``noise_std`` = 0 both views tell it.
    """

    def __init__(self, noise_std: float = 0.0, length: int = 1):
        super().__init__(noise_std, length)
        self.action_space = spaces.Discrete(3)

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        target = self._target
        observation, _, terminated, truncated, info = super().step(np.zeros(1))
        return observation, float(action == np.digitize(target, [-0.8 / 3, 0.8 / 3])), terminated, truncated, info


class Recall(gym.Env):
    """
    Shows one of three cues in the first step, then nothing; 1 for naming it in the last step, else 0.

    ``privileged`` shows it all the time.

    :param length: steps per episode
    :param continuous: whether the answer is a number in [-1, 1], right within 1/3 of the cue's own -2/3, 0 or 2/3
    """

    def __init__(self, length: int = 4, continuous: bool = False):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(0, 1, (4,), np.float32), privileged=spaces.Box(0, 1, (3,), np.float32)
        )
        self.action_space = spaces.Box(-1, 1, (1,), np.float32) if continuous else spaces.Discrete(3)
        self.length = length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self._cue, self._step = int(self.np_random.integers(3)), 0
        return self._views(), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        if isinstance(self.action_space, spaces.Box):
            action = int(np.digitize(np.ravel(action)[0], [-1 / 3, 1 / 3]))
        self._step += 1
        last = self._step == self.length
        return self._views(), float(last and action == self._cue), last, False, {}

    def checkpoint_state(self) -> dict[str, Any]:
        return {"cue": self._cue, "step": self._step}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        self._cue, self._step = state["cue"], state["step"]

    def _views(self) -> dict[str, np.ndarray]:
        partial = np.zeros(4, dtype=np.float32)
        if self._step == 0:
            partial[self._cue] = 1.0
        partial[3] = float(self._step == self.length - 1)
        return {"partial": partial, "privileged": np.eye(3, dtype=np.float32)[self._cue]}


class Sampled(gym.Env):
    """
    Observations are drawn from their space; the reward is the action's first number, the smaller the better.

    :param observation_space: Dict
    :param action_space: Box or Discrete, by default a Box of one number
    :param length: steps per episode
    """

    def __init__(self, observation_space: spaces.Dict, action_space: spaces.Space | None = None, length: int = 5):
        self.observation_space = observation_space
        self.action_space = spaces.Box(-1, 1, (1,), np.float32) if action_space is None else action_space
        self.length = length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self._step = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        self._step += 1
        return self.observation_space.sample(), -float(np.ravel(action)[0]), self._step >= self.length, False, {}


def small_model(env: Any = None, cls: type[GAC] = GAC, **arguments: Any) -> GAC:
    """A model whose gradient steps take a few milliseconds; a student has a teacher."""
    from tests.registry import needed  # which needs the environments above

    env = TwoViewBandit() if env is None else env
    defaults = {
        "policy": "MultiInputPolicy",
        "learning_starts": 10,
        "batch_size": 16,
        "buffer_size": 1000,
        "seed": 0,
        "device": "cpu",
        "policy_kwargs": {"net_arch": [16]},
    }
    if "teacher" not in arguments:
        defaults |= needed(cls, env)
    return cls(**{"env": env, **defaults, **arguments})


def optimizers_of(policy: Any) -> list[Any]:
    """Of all its networks."""
    return [getattr(policy, name).optimizer for name in policy.trained]


def unlike_each_other(policy: Any, scale: float = 0.4, seed: int = 0) -> None:
    """Move every weight, targets' included: targets are unlike their critics, and stds differ between states and networks."""
    generator = th.Generator().manual_seed(seed)
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.add_(scale * th.randn(parameter.shape, generator=generator))


def gradient_step(model: Any, batch_size: int, seed: int) -> Any:
    """
    One gradient step, targets included.

    :param model: that has something in its replay buffer
    :param batch_size: transitions or sequences
    :param seed: seed, of which all is drawn
    :return: samples that the replay buffer gave
    """
    drawn = []
    buffer, sample = model.replay_buffer, model.replay_buffer.sample
    buffer.sample = lambda *args, **kwargs: drawn.append(sample(*args, **kwargs)) or drawn[-1]
    try:
        np.random.seed(seed)
        th.manual_seed(seed)
        model.train(gradient_steps=1, batch_size=batch_size)
    finally:
        del buffer.sample
    (samples,) = drawn
    return samples


def noise_of_step(seed: int, n: int, shape: Any) -> th.Tensor:
    """
    What :func:`gradient_step` drew for the policies' actions.

    :param seed: seed before that step
    :param n: number of actions at once
    :param shape: shape of the stored actions
    :return: shape (n, *shape)
    """
    th.manual_seed(seed)
    return th.randn(n, *shape)
