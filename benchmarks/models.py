"""What the speed benchmark times: gradient steps of several algorithms on random data, and their arithmetic."""

import importlib.util
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

import sb3_gac
from benchmarks.contenders import alternate, timer
from sb3_gac.checks.arguments import constructor_parameters

SIZES = {"HalfCheetah": (8, 17, 6), "Ant": (13, 27, 8), "Humanoid": (169, 270, 17)}
COMPILED, MIXED = {"compile": True}, {"compile": True, "mixed_precision": True}
CONTENDERS: dict[str, tuple[Any, dict[str, Any]]] = {  # name -> class and arguments
    "sac": (SAC, {}),
    "gac": (sb3_gac.GAC, {}),
    "gac-compiled": (sb3_gac.GAC, COMPILED),
    "gac-mixed": (sb3_gac.GAC, MIXED),
    "sac-asym": (sb3_gac.AsymmetricSAC, {}),
    "sac-asym-compiled": (sb3_gac.AsymmetricSAC, COMPILED),
}
PAIRS = {"critic_groups": 2, "policy_kwargs": {"n_critics": 4}}
BASELINES: dict[str, tuple[Any, dict[str, Any]]] = {  # the same of the other algorithms
    "sac": CONTENDERS["sac"],
    "gac": CONTENDERS["gac"],
    "gac-share": (sb3_gac.GACShare, {}),
    "sac-asym": CONTENDERS["sac-asym"],
    "sac-asym-four-critics": (sb3_gac.AsymmetricSAC, PAIRS),
    "tgrl": (sb3_gac.TGRL, {}),
    "cosil": (sb3_gac.COSIL, {}),
    "rma": (sb3_gac.RMA, {}),
    "mpo-asym": (sb3_gac.AsymmetricMPO, {}),
    "gpo-clip": (sb3_gac.GPOClip, {}),
    "gpo-penalty": (sb3_gac.GPOPenalty, {}),
}
if importlib.util.find_spec("sbx"):
    import sbx  # type: ignore[import-not-found]

    CONTENDERS["sbx-sac"] = (sbx.SAC, {})


class SpacesOnly(gym.Env):
    """
    An environment that is only asked for its spaces and for random observations.

    :param partial: size of the partial entry
    :param privileged: size of the privileged entry
    :param actions: number of actions
    :param length: steps per episode, ``None`` for one without an end
    :param discrete: whether they are choices
    """

    def __init__(self, partial: int, privileged: int, actions: int, length: int | None = None, discrete: bool = False):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-np.inf, np.inf, (partial,), np.float32),
            privileged=spaces.Box(-np.inf, np.inf, (privileged,), np.float32),
        )
        self.action_space = spaces.Discrete(actions) if discrete else spaces.Box(-1, 1, (actions,), np.float32)
        self.length = length
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """A random observation."""
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """A random observation and reward."""
        self.steps += 1
        ends = self.steps == self.length
        return self.observation_space.sample(), float(self.np_random.standard_normal()), ends, False, {}


def make_model(contender: str, sizes: tuple[int, int, int], batch: int, width: int, buffer_size: int = 4_000) -> Any:
    """
    :param contender: a key of ``CONTENDERS``
    :param sizes: partial, privileged, actions
    :param batch: batch size
    :param width: of the two hidden layers
    :param buffer_size: of the replay buffer
    :return: a model with a buffer of random transitions
    """
    algorithm, arguments = CONTENDERS[contender]
    settings = {"batch_size": batch, "learning_starts": 10**9, "buffer_size": buffer_size, "seed": 0, "device": "cpu"}
    settings |= arguments
    if algorithm.__module__.startswith("sbx"):  # knows no dicts
        env: gym.Env = gym.wrappers.FlattenObservation(SpacesOnly(*sizes))
        model = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [width, width]}, **settings)
    else:
        kwargs = {"net_arch": [width, width], "activation_fn": th.nn.SiLU}
        model = algorithm("MultiInputPolicy", SpacesOnly(*sizes), policy_kwargs=kwargs, **settings)
    model.set_logger(Logger(None, []))
    return model.learn(2_000)


def make_step(contender: str, sizes: tuple[int, int, int], batch: int, width: int) -> Callable[[], None]:
    """
    :return: one gradient step of :func:`make_model`'s model, as ``learn`` makes it
    """
    model = make_model(contender, sizes, batch, width)
    return lambda: model.train(1, batch)


def make_baseline_step(name: str, sizes: tuple[int, int, int], batch: int, width: int, compiled: bool) -> Callable[[], None]:
    """
    :param name: a key of ``BASELINES``
    :param sizes: partial, privileged, actions
    :param batch: batch size
    :param width: of the two hidden layers
    :param compiled: whether to compile
    :return: one gradient step, as ``learn`` makes it; of on-policy algorithms one minibatch, which is the whole rollout
    """
    algorithm, arguments = BASELINES[name]
    known = constructor_parameters(algorithm)
    of_policy = {"net_arch": [width, width], "activation_fn": th.nn.SiLU, **arguments.get("policy_kwargs", {})}
    settings = {"learning_starts": 10**9, "buffer_size": 4_000, "n_steps": batch, "n_epochs": 1} | arguments
    is_on_policy = "n_epochs" in known
    settings = {key: value for key, value in settings.items() if key in known and (key != "n_steps" or is_on_policy)}
    settings |= {"batch_size": batch, "policy_kwargs": of_policy, "seed": 0, "device": "cpu"}
    if compiled:
        settings["compile"] = True
    if "teacher" in known:
        keys: dict[str, Any] = {"role_keys": {"actor": ["partial", "privileged"]}, "policy_kwargs": of_policy, "device": "cpu"}
        settings["teacher"] = sb3_gac.AsymmetricSAC("MultiInputPolicy", SpacesOnly(*sizes), **keys)
    model = algorithm("MultiInputPolicy", SpacesOnly(*sizes), **settings)
    model.set_logger(Logger(None, []))
    model.learn(batch if is_on_policy else 2_000)
    return model.train if is_on_policy else lambda: model.train(1, batch)


def step_flops(sizes: tuple[int, int, int], batch: int, width: int) -> float:
    """
    Floating-point operations of the matrix products in one GAC step; gradients that nothing uses are not counted.

    :param sizes: partial, privileged, actions
    :param batch: B
    :param width: H, of both hidden layers
    """
    partial, privileged, actions = sizes
    full = partial + privileged

    def passes(inputs: int, outputs: int, forward: int, weights: int, activations: int, input_gradients: int) -> float:
        forward_cost = inputs * width + width * width + width * outputs
        behind_the_first = width * width + width * outputs
        return (forward + weights) * forward_cost + activations * behind_the_first + input_gradients * actions * width

    critics = passes(full + actions, 1, forward=12, weights=4, activations=8, input_gradients=4)
    guider = passes(full, 2 * actions, forward=2, weights=1, activations=1, input_gradients=0)
    learner = passes(partial, 2 * actions, forward=2, weights=1, activations=1, input_gradients=0)
    return 2.0 * batch * (critics + guider + learner)


def matmul_rate(batch: int, width: int) -> float:
    """Floating-point operations per second of one plain (B, H) x (H, H) product."""
    x, weight = th.randn(batch, width), th.randn(width, width)
    seconds = alternate({"mm": timer(lambda: th.mm(x, weight))}, repetitions=100, rounds=5)["mm"]
    return 2.0 * batch * width * width / float(np.median(seconds))


class LoopedGRU(th.nn.GRU):
    """A GRU as it is without a fused pass over time: one call for each step."""

    def forward(self, x: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:  # type: ignore[override]
        """
        :param x: shape (T, B, F)
        :param state: shape (1, B, H)
        :return: shapes (T, B, H) and (1, B, H)
        """
        outputs = []
        for step in x.split(1):
            output, state = super().forward(step, state)
            outputs.append(output)
        return th.cat(outputs), state


def make_recurrent_step(what: str, sizes: tuple[int, int, int], length: int, batch: int, width: int) -> Callable[[], Any]:
    """
    :param what: "ours"; "looped", with a Python loop over time; "sampling", which is a part of either
    :param sizes: partial, privileged, number of actions
    :param length: of the episodes, T
    :param batch: episodes, B
    :param width: of all layers
    :return: one gradient step of GAC with GRUs, or that part
    """
    model = sb3_gac.GAC(
        "MultiInputGruPolicy",
        SpacesOnly(*sizes, length=length, discrete=True),
        policy_kwargs={"net_arch": [width], "rnn_hidden_size": width, "rnn_net_arch": [width]},
        batch_size=batch,
        learning_starts=10**9,
        buffer_size=10_000,
        seed=0,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    model.learn(40 * length)
    if what == "sampling":
        buffer: Any = model.replay_buffer
        return lambda: buffer.sample(batch)
    if what == "looped":
        for module in model.policy.modules():
            if isinstance(module, th.nn.GRU):
                module.__class__ = LoopedGRU
    return lambda: model.train(1, batch)


def recurrent_step_flops(sizes: tuple[int, int, int], length: int, batch: int, width: int) -> float:
    """
    Floating-point operations of the matrix products in one step of :func:`make_recurrent_step`'s model.

    Policies: forward over T + 1 steps, and twice that backward. Critics: the same for their own loss; once more, frozen, for
    a policy's; their targets once.
    """
    partial, privileged, actions = sizes

    def forward(inputs: int) -> float:
        return inputs * width + 6 * width * width + width * width + width * actions

    guider, learner, critic = forward(partial + privileged), forward(partial), forward(partial + privileged)
    return 2.0 * batch * (length + 1) * (3 * guider + 3 * learner + 4 * (3 + 1 + 1) * critic)
