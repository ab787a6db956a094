"""Contenders of the speed benchmark: gradient steps of several algorithms on random data, and their arithmetic."""

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
from sb3_gac.networks.recurrent import GRU

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
BASELINES: dict[str, tuple[Any, dict[str, Any]]] = {  # name -> class and arguments
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
    An environment whose observations and rewards are random.

    :param partial: size of the entry ``partial``
    :param privileged: size of the entry ``privileged``
    :param actions: dimensions of an action, or number of discrete actions
    :param length: steps of each episode, ``None`` for episodes without an end
    :param discrete: whether actions are discrete
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
        """Return a random observation."""
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return a random observation and a random reward."""
        self.steps += 1
        ends = self.steps == self.length
        return self.observation_space.sample(), float(self.np_random.standard_normal()), ends, False, {}


def make_model(contender: str, sizes: tuple[int, int, int], batch: int, width: int, buffer_size: int = 4_000) -> Any:
    """
    :param contender: key of ``CONTENDERS``
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param buffer_size: capacity of the replay buffer, in transitions
    :return: model whose replay buffer holds random transitions
    """
    algorithm, arguments = CONTENDERS[contender]
    settings = {"batch_size": batch, "learning_starts": 10**9, "buffer_size": buffer_size, "seed": 0, "device": "cpu"}
    settings |= arguments
    if algorithm.__module__.startswith("sbx"):  # it takes no dict observations
        env: gym.Env = gym.wrappers.FlattenObservation(SpacesOnly(*sizes))
        model = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [width, width]}, **settings)
    else:
        kwargs = {"net_arch": [width, width], "activation_fn": th.nn.SiLU}
        model = algorithm("MultiInputPolicy", SpacesOnly(*sizes), policy_kwargs=kwargs, **settings)
    model.set_logger(Logger(None, []))
    return model.learn(2_000)


def make_step(contender: str, sizes: tuple[int, int, int], batch: int, width: int) -> Callable[[], None]:
    """
    :param contender: key of ``CONTENDERS``
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :return: function that makes one gradient step of :func:`make_model`'s model, as ``learn`` does
    """
    model = make_model(contender, sizes, batch, width)
    return lambda: model.train(1, batch)


def make_baseline_step(name: str, sizes: tuple[int, int, int], batch: int, width: int, compiled: bool) -> Callable[[], None]:
    """
    :param name: key of ``BASELINES``
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param compiled: whether to compile the gradient step
    :return: function that makes one gradient step, as ``learn`` does; an on-policy algorithm's minibatch is a whole rollout
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
    Floating-point operations of the matrix products in one GAC step, without those of gradients that are not used.

    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size B
    :param width: units H of each of the two hidden layers
    :return: number of floating-point operations
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
    """
    :param batch: batch size B
    :param width: units H of a layer
    :return: floating-point operations per second of one plain product of matrices of the shapes (B, H) and (H, H)
    """
    x, weight = th.randn(batch, width), th.randn(width, width)
    seconds = alternate({"mm": timer(lambda: th.mm(x, weight))}, repetitions=100, rounds=5)["mm"]
    return 2.0 * batch * width * width / float(np.median(seconds))


class LoopedGRU(GRU):
    """A GRU without a fused pass over time: it is called once for each step."""

    def forward(self, x: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:  # type: ignore[override]
        """
        :param x: inputs, shape (T, B, F)
        :param state: hidden state before the first step, shape (1, B, H)
        :return: outputs, shape (T, B, H), and the hidden state after the last step, shape (1, B, H)
        """
        outputs = []
        for step in x.split(1):
            output, state = super().forward(step, state)
            outputs.append(output)
        return th.cat(outputs), state


def make_recurrent_step(what: str, sizes: tuple[int, int, int], length: int, batch: int, width: int) -> Callable[[], Any]:
    """
    :param what: contender: "ours"; "looped", whose GRUs loop over time in Python; or "sampling", the part of a gradient step
        that samples from the replay buffer
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and number of discrete actions
    :param length: steps T of each episode
    :param batch: episodes B in a batch
    :param width: units of every layer
    :return: function that makes one gradient step of GAC with GRUs, or that samples for it
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
            if isinstance(module, GRU):
                module.__class__ = LoopedGRU
    return lambda: model.train(1, batch)


def recurrent_step_flops(sizes: tuple[int, int, int], length: int, batch: int, width: int) -> float:
    """
    Floating-point operations of the matrix products in one step of :func:`make_recurrent_step`'s model.

    A policy has a forward pass over T + 1 steps, and a backward pass that costs twice as much. A critic has the same for its
    own loss, one more forward pass, frozen, for a policy's loss, and one of its target network.

    :param sizes: sizes of the entries ``partial`` and ``privileged``, and number of discrete actions
    :param length: steps T of each episode
    :param batch: episodes B in a batch
    :param width: units of every layer
    :return: number of floating-point operations
    """
    partial, privileged, actions = sizes

    def forward(inputs: int) -> float:
        return inputs * width + 6 * width * width + width * width + width * actions

    guider, learner, critic = forward(partial + privileged), forward(partial), forward(partial + privileged)
    return 2.0 * batch * (length + 1) * (3 * guider + 3 * learner + 4 * (3 + 1 + 1) * critic)
