"""
All algorithms of the registry, each with what it takes to hold it to the contract: one line of ``LINES``.

A test of the contract takes ``algorithm``, a name, from :func:`algorithms`, and builds it with :func:`make`. What a method
does not have is named in its line with the reason, once; tests/sb3_contract/test_registry.py asks for it and is refused.
"""

import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_gac import AsymmetricSAC
from sb3_gac.algorithms import algorithm_class
from tests.helpers import Sampled, TwoViewBandit

NOTHING: Mapping[str, Any] = MappingProxyType({})
ONE_ENTRY = spaces.Dict(partial=spaces.Box(-1, 1, (2,), np.float32))


class Option(NamedTuple):
    """
    What some methods do not have.

    :param refusal: what the error says, a regular expression
    :param arguments: that ask for it
    :param make_env: the environment that asks for it
    """

    refusal: str
    arguments: Mapping[str, Any] = NOTHING
    make_env: Callable[[], gym.Env] = TwoViewBandit


class Line(NamedTuple):
    """
    An algorithm's line.

    :param arguments: to make it small, beside those of its family
    :param policy_kwargs: the same for its policy
    :param lacks: a key of ``OPTIONS`` -> why the method does not have it
    :param one_phase: arguments with which all gradient steps of a training are of one kind
    :param remembers: whether the policy that is deployed has a memory whatever its class
    """

    arguments: Mapping[str, Any] = NOTHING
    policy_kwargs: Mapping[str, Any] = NOTHING
    lacks: Mapping[str, str] = NOTHING
    one_phase: Mapping[str, Any] = NOTHING
    remembers: bool = False


#: What some methods do not have, and how it is asked for
OPTIONS = {
    "memory": Option("policy must be one of .* got .MultiInputGruPolicy", {"policy": "MultiInputGruPolicy"}),
    "replay": Option("replay_buffer_class.*is no argument", {"replay_buffer_class": DictReplayBuffer}),
    "other buffers": Option("replay_buffer_class=.*can't sample", {"replay_buffer_class": DictReplayBuffer}),
    "critics": Option("tau.*is no argument", {"tau": 0.1}),
    "temperature": Option("ent_coef must be a number|no entropy term, so ent_coef", {"ent_coef": "auto_0.5"}),
    "shared encoder": Option("share_features_extractor", {"policy_kwargs": {"share_features_extractor": True}}),
    "one entry": Option("entries that its actor does not read, but there are none", make_env=lambda: Sampled(ONE_ENTRY)),
}
NO_ENTROPY = {"temperature": "its objective has no entropy term"}
SEES_THE_SAME = {"shared encoder": "but by role_keys, its other networks see no more than the deployed one"}
ON_POLICY = {
    "memory": "there is no form with a memory",
    "replay": "it learns from what it has just collected",
    "critics": "its critic is a value of the state, without a target",
    "temperature": "the weight of the entropy is fixed",
}
OF_RMA = {
    "memory": "its actor remembers in its own way",
    "other buffers": "the estimate needs what came before a transition",
    "shared encoder": "it shares its own",
    "one entry": "it estimates what the actor does not see",
}
SMALL_RMA = {"encoder_net_arch": [8], "latent_dim": 3}

#: Name of an algorithm -> what holds it to the contract
LINES = {
    "gac": Line(),
    "gac_share": Line(),
    "gac_without_q": Line(),
    "asymmetric_sac": Line(),
    "asymmetric_mpo": Line({"n_actions": 4}, lacks=NO_ENTROPY),
    "cosil": Line(lacks=NO_ENTROPY | SEES_THE_SAME),
    "rma": Line({"history": 3}, SMALL_RMA, OF_RMA, one_phase={"phase_1_steps": 10_000}, remembers=True),
    "tgrl": Line(lacks=SEES_THE_SAME),
    "gpo_clip": Line(lacks=ON_POLICY),
    "gpo_penalty": Line(lacks=ON_POLICY),
}

SMALL_OFF_POLICY = {"buffer_size": 1000, "learning_starts": 10, "batch_size": 16, "train_freq": 5}
SMALL_ON_POLICY = {"n_steps": 10, "batch_size": 10, "n_epochs": 2}
SMALL_MEMORY = {"rnn_hidden_size": 8, "rnn_net_arch": []}


def algorithms(*options: str, but: tuple[str, ...] = ()) -> pytest.MarkDecorator:
    """
    :param options: keys of ``OPTIONS``
    :param but: names that another test of the same file is about
    :return: gives a test the names of all algorithms that have these options, one at a time, as ``algorithm``
    """
    names = [name for name, line in LINES.items() if name not in but and not set(options) & set(line.lacks)]
    return pytest.mark.parametrize("algorithm", names)


def classes(*options: str) -> list[type]:
    """
    :param options: keys of ``OPTIONS``
    :return: the classes of all algorithms that have these options
    """
    return [algorithm_class(name) for name, line in LINES.items() if not set(options) & set(line.lacks)]


def needed(kind: type, env: Any) -> dict[str, Any]:
    """
    :param kind: class of an algorithm
    :param env: an environment
    :return: what it can't be made without: a student's teacher, in a file
    """
    return {"teacher": teacher_for(env)} if "teacher" in getattr(kind, "frozen_arguments", ()) else {}


def on_policy(algorithm: str) -> bool:
    """Whether it learns from rollouts, of which it takes whole ones."""
    return issubclass(algorithm_class(algorithm), OnPolicyAlgorithm)


def is_taught(algorithm: str) -> bool:
    """Whether it trains with a teacher."""
    return "teacher" in algorithm_class(algorithm).frozen_arguments  # type: ignore[attr-defined]


def deployed_role(algorithm: str) -> str:
    """Name of the policy that acts without privileged entries."""
    return algorithm_class(algorithm).policy_aliases["MultiInputPolicy"].roles.deployed  # type: ignore[attr-defined]


def small_arguments(algorithm: str) -> dict[str, Any]:
    """Those that make it small, but its policy's."""
    return {**(SMALL_ON_POLICY if on_policy(algorithm) else SMALL_OFF_POLICY), **LINES[algorithm].arguments}


def make(algorithm: str, env: Any, **arguments: Any) -> Any:
    """
    :param algorithm: a key of ``LINES``
    :param env: an environment
    :param arguments: in place of those that make it small; ``policy_kwargs`` are added to them
    :return: a model whose gradient steps take a few milliseconds; a student has a teacher, in a file
    """
    kind, line = algorithm_class(algorithm), LINES[algorithm]
    recurrent = "Gru" in str(arguments.get("policy"))
    of_policy = {"net_arch": [16], **(SMALL_MEMORY if recurrent else {}), **line.policy_kwargs}
    of_policy |= arguments.pop("policy_kwargs", {})
    taught = {} if "teacher" in arguments else needed(kind, env)
    given = {"policy": "MultiInputPolicy", "device": "cpu", **small_arguments(algorithm), **taught, **arguments}
    return kind(env=env, policy_kwargs=of_policy, **given)


def load(algorithm: str, path: Any, env: Any = None, **arguments: Any) -> Any:
    """
    :param algorithm: a key of ``LINES``
    :param path: of a file of its ``save``
    :param env: an environment
    :param arguments: of its ``load``
    :return: the model in that file
    """
    return algorithm_class(algorithm).load(path, env=env, **{"device": "cpu", **arguments})  # type: ignore[attr-defined]


def save_all(model: Any, folder: Path) -> None:
    """
    :param model: to be saved, with its replay buffer if it has one
    :param folder: of the files
    """
    model.save(folder / "model")
    if not isinstance(model, OnPolicyAlgorithm):
        model.save_replay_buffer(folder / "buffer")


def load_all(algorithm: str, folder: Path, env: Any) -> Any:
    """
    :param algorithm: a key of ``LINES``
    :param folder: of :func:`save_all`
    :param env: an environment
    :return: the model, which can go on
    """
    model = load(algorithm, folder / "model", env)
    if not on_policy(algorithm):
        model.load_replay_buffer(folder / "buffer")
    return model


def parameters(model: Any) -> th.Tensor:
    """All of its policy, in one vector."""
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def teacher_for(env: Any) -> str:
    """
    :param env: of a student, or its id
    :return: file of a model that acts on all entries of its observations
    """
    env = gym.make(env) if isinstance(env, str) else env
    return str(_teacher(_Spaces(env.observation_space, env.action_space)))


class _Spaces:
    """Of an environment, equal where they are alike."""

    def __init__(self, observation_space: spaces.Dict, action_space: spaces.Space):
        self.observation_space, self.action_space = observation_space, action_space

    def __hash__(self) -> int:
        return hash(str(self.observation_space))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Spaces) and (self.observation_space, self.action_space) == (
            other.observation_space,
            other.action_space,
        )


@cache
def _files() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory()  # until the process ends


@cache
def _teacher(seen: _Spaces) -> Path:
    env: gym.Env = Sampled(seen.observation_space, seen.action_space)
    keys = {"actor": list(seen.observation_space)}
    of_policy = {"net_arch": [8]}
    path = Path(_files().name) / f"{_teacher.cache_info().currsize}.zip"
    model = AsymmetricSAC(
        "MultiInputPolicy", env, buffer_size=1, role_keys=keys, policy_kwargs=of_policy, device="cpu", seed=1
    )
    model.save(path)
    return path
