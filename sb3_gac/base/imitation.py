"""
Starting points for training: behaviour of another policy, cloned by the deployed one, or networks of another model.

Behaviour cloning (Pomerleau 1991) and DAgger (Ross et al. 2011, arXiv 1011.0686)::

    teacher = AsymmetricSAC.load("full_state")
    shown = demonstrate(teacher, env, 20_000)
    clone_behaviour(model, shown)
    for _ in range(3):  # observations that the student meets, with the actions that the teacher would take there
        shown = shown + demonstrate(teacher, env, 5_000, student=model)
        clone_behaviour(model, shown)
    model.learn(100_000)
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.scale import (
    check_same_scale,
    check_same_statistics,
    entries_normalised_in_training,
    scales_in_training,
)
from sb3_gac.checks.values import check_integer, check_positive
from sb3_gac.math.distributions import Categorical

HELD_OUT = 0.1
#: Attributes of networks that change what they compute with the same parameters
_SETTINGS = ("activation_fn", "log_std_bounds", "softplus_min_std", "normalize_images")


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """
    Observations, and the actions that a policy takes on them. ``+`` joins the demonstrations of two sources; those of a file
    or of another program are made of its arrays.

    :param observations: entry -> N values, shape (N, ...), for at least the entries that the student reads
    :param actions: actions in the environment's range, shape (N, A), or numbers of discrete actions, shape (N,)
    """

    observations: Mapping[str, np.ndarray]
    actions: np.ndarray

    def __add__(self, other: "Demonstrations") -> "Demonstrations":
        """
        Join two sets of demonstrations, by the entries that both have.

        :param other: further demonstrations
        :return: all demonstrations of both
        """
        keys = [key for key in self.observations if key in other.observations]
        joined = {key: np.concatenate([self.observations[key], other.observations[key]]) for key in keys}
        return Demonstrations(joined, np.concatenate([self.actions, other.actions]))

    def __len__(self) -> int:
        """Number of demonstrations."""
        return len(self.actions)


def demonstrate(
    teacher: BaseAlgorithm, env: VecEnv, n_steps: int, student: BaseAlgorithm | None = None, deterministic: bool = True
) -> Demonstrations:
    """
    Collect demonstrations of a teacher.

    :param teacher: trained model of this package or of SB3; where it has a guider, the guider's actions are shown
    :param env: environments to act in, from a reset on, whose observations have all entries that the teacher reads
    :param n_steps: number of steps of all environments together, rounded up to whole steps of each
    :param student: model that acts, while the teacher only says what it would have done (DAgger); ``None`` for the teacher
    :param deterministic: whether the teacher shows its most likely action instead of a sample
    :return: all observations met, with the teacher's action on each
    :raises ValueError: if ``n_steps`` is less than 1, or if teacher or student were trained on observations of another scale
        than ``env`` gives
    """
    check_integer("n_steps", n_steps, 1)
    _check_scale("teacher", teacher, env, _entries_seen(teacher, guides=hasattr(teacher, "predict_guider")))
    if student is not None:
        _check_scale("student", student, env, _entries_seen(student))
    show: Any = getattr(teacher, "predict_guider", teacher.predict)
    seen: list[Mapping[str, np.ndarray]] = []
    shown: list[np.ndarray] = []
    observation: Any = env.reset()
    state = own = None
    start = np.ones(env.num_envs, dtype=bool)
    for _ in range(-(-n_steps // env.num_envs)):
        action, state = show(observation, state=state, episode_start=start, deterministic=deterministic)
        seen.append({key: value.copy() for key, value in observation.items()})
        shown.append(action)
        if student is not None:
            action, own = student.predict(observation, state=own, episode_start=start)
        observation, _, start, _ = env.step(action)
    return Demonstrations({key: np.concatenate([row[key] for row in seen]) for key in seen[0]}, np.concatenate(shown))


def _entries_seen(model: BaseAlgorithm, guides: bool = False) -> list[str]:
    policy: Any = model.policy
    if isinstance(policy, AsymmetricPolicy):
        return list(policy.role_keys[policy.roles.behaviour] if guides else policy.deployed_entries)
    return list(policy.observation_space.spaces)


def _check_scale(name: str, model: BaseAlgorithm, env: VecEnv, entries: list[str]) -> None:
    check_same_scale(name, entries, entries_normalised_in_training(model), env)
    check_same_statistics(name, entries, scales_in_training(model), env)


def clone_behaviour(
    model: BaseAlgorithm,
    demonstrations: Demonstrations,
    gradient_steps: int = 2_000,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    seed: int = 0,
) -> dict[str, float]:
    """
    Train a model's deployed policy on demonstrations, before ``learn`` (behaviour cloning).

    Where actions are continuous, the loss is the squared error of the policy's most likely action; where they are discrete,
    it is their negative log-likelihood. The critics stay as they are. A residual guider starts at the cloned policy, GPO's
    guider changes with the layers that it shares with the policy, and an independent guider stays as it is. A Gaussian's
    standard deviation is not fitted, but changes with the hidden layers that it shares with the mean. The policy's target
    network, if it has one, is the cloned policy too. A tenth of the demonstrations is held out to measure the result.

    Critics know nothing of the cloned policy at first, and the policy's first gradient steps in ``learn`` may unlearn what
    was cloned. ``policy_delay``, where it can be set, gives the critics time.

    :param model: model of this package, whose deployed policy has no memory
    :param demonstrations: demonstrations to learn from, see :func:`demonstrate`
    :param gradient_steps: number of gradient steps, by Adam
    :param batch_size: number of demonstrations in each gradient step
    :param learning_rate: Adam's step size
    :param seed: seed of the choice of held-out demonstrations and of batches
    :return: "before" and "after" -> error on the held-out demonstrations: the mean squared error of actions in [-1, 1], or
        the fraction of discrete actions that differ
    :raises TypeError: if the model is not of this package
    :raises ValueError: if the policy has a memory, or demonstrations do not fit it
    """
    check_integer("gradient_steps", gradient_steps, 1)
    check_integer("batch_size", batch_size, 1)
    check_positive("learning_rate", learning_rate)
    policy = model.policy
    if not isinstance(policy, AsymmetricPolicy):
        raise TypeError(f"model must be of sb3_gac, got {type(model).__name__}.")
    if policy.deployed.memory is not None:
        raise ValueError("model has a memory, and demonstrations are single observations: clone a policy without one.")
    observations, actions = _as_tensors(policy, demonstrations)
    order = th.from_numpy(np.random.RandomState(seed).permutation(len(actions))).to(policy.device)
    held = max(int(HELD_OUT * len(actions)), 1)
    test, train = order[:held], order[held:]
    before = _error(policy, observations, actions, test)
    random = np.random.RandomState(seed + 1)
    optimizer = th.optim.Adam([one for one in policy.deployed.parameters() if one.requires_grad], lr=learning_rate)
    policy.deployed.train(True)
    for _ in range(gradient_steps):
        rows = train[th.from_numpy(random.randint(len(train), size=batch_size)).to(policy.device)]
        loss = _loss(policy, {key: value[rows] for key, value in observations.items()}, actions[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    policy.deployed.train(False)
    optimizer.zero_grad()
    _reset_targets(policy, policy.deployed)
    return {"before": before, "after": _error(policy, observations, actions, test)}


def copy_networks(model: BaseAlgorithm, source: BaseAlgorithm, networks: Mapping[str, str]) -> None:
    """
    Copy the parameters of another model's networks into a model's own networks and their targets.

    A guider that is relative to the learner, as GAC's default one is, stands for a guider of its own kind alone, and goes with
    its learner: ``{"learner": "learner", "guider": "guider"}``.

    :param model: model of this package, whose networks are changed
    :param source: model of this package, whose networks have the same sizes and read the same entries
    :param networks: network of ``model`` -> network of ``source``, such as ``{"guider": "actor"}``
    :raises ValueError: if there is no such network, or it would compute something else: its parameters are of other shapes,
        it has another activation, other bounds of its standard deviation, or reads other entries; it is relative to another
        policy; its actions have another range; or the model's environments normalise its entries in another way
    """
    if model.action_space != source.action_space:
        raise ValueError(
            f"source was trained for actions in {source.action_space}, and the model's are in {model.action_space}: copy "
            "networks of a model with the same actions."
        )
    for name, from_name in networks.items():
        own, other = (_network(one, role) for one, role in ((model, name), (source, from_name)))
        fault = _difference(own, other)
        if fault is None and getattr(own, "relation", None):
            fault = _difference_of_deployed(model, source, networks)
        if fault is not None:
            raise ValueError(
                f'networks: "{from_name}" of {type(source).__name__} does not fit "{name}" of {type(model).__name__}: {fault}'
            )
        if model.env is not None:
            _check_scale("source", source, model.env, [key for key, _ in _entries_of(other)])
    for name, from_name in networks.items():
        parameters = _network(source, from_name).state_dict()
        network = _network(model, name)
        network.load_state_dict(parameters)
        _reset_targets(model.policy, network)  # type: ignore[arg-type]


@th.no_grad()
def _reset_targets(policy: AsymmetricPolicy, changed: nn.Module) -> None:
    """Put a changed network's parameters into its target, and those of an encoder that it shares into the others' targets."""
    own = {id(tensor) for tensor in chain(changed.parameters(), changed.buffers())}
    for network, target in policy.pairs.values():
        followed, following = (chain(one.parameters(), one.buffers()) for one in (network, target))
        for now, before in zip(followed, following, strict=True):
            if id(now) in own:
                before.copy_(now)


def _network(model: BaseAlgorithm, name: str) -> nn.Module:
    policy = model.policy
    roles = list(policy.roles.networks) if isinstance(policy, AsymmetricPolicy) else []
    network = getattr(policy, name, None) if name in roles else None
    if network is None:
        raise ValueError(f"networks: {type(model).__name__} has no network {name!r}; it has {roles}.")
    return network


def _difference(own: nn.Module, other: nn.Module) -> str | None:
    """What keeps a network's parameters from computing the same in another network, and what to do; ``None`` for nothing."""
    relation, expected = (getattr(one, "relation", None) for one in (other, own))
    if relation != expected:
        kinds = [
            f"relative to the deployed policy, {kind}" if kind else "a policy of its own" for kind in (relation, expected)
        ]
        return (
            f"it is {kinds[0]} there, and {kinds[1]} here. Make both models with the same kind of guider, or clone the "
            "teacher by clone_behaviour(), from which a residual guider starts."
        )
    saved, needed = _made_of(other), _made_of(own)
    differ = [key for key in {**needed, **saved} if saved.get(key, "missing") != needed.get(key, "missing")]
    if not differ:
        return None
    there, here = (made_of.get(differ[0], "missing") for made_of in (saved, needed))
    return f"{differ[0]} is {there} there, and {here} here. Make both with the same policy_kwargs, on the same entries."


def _difference_of_deployed(model: BaseAlgorithm, source: BaseAlgorithm, networks: Mapping[str, str]) -> str | None:
    """What keeps networks relative to the deployed policies from computing the same, and what to do; ``None`` for nothing."""
    policies: list[Any] = [model.policy, source.policy]
    own, other = (policy.roles.deployed for policy in policies)
    if own in networks:
        goes_along = networks[own] == other
    else:
        present, saved = (_network(one, name) for one, name in ((model, own), (source, other)))
        values, expected = present.state_dict(), saved.state_dict()
        goes_along = _difference(present, saved) is None and all(
            values[key].equal(expected[key].to(values[key])) for key in values
        )
    if goes_along:
        return None
    return f'it is relative to the "{other}" there. Copy that too, by "{own}": "{other}" in networks.'


def _made_of(network: Any) -> dict[str, Any]:
    """Name -> shape of each parameter, and name -> value of whatever else tells what the network computes with them."""
    settings = {name: getattr(network, name) for name in _SETTINGS if hasattr(network, name)}
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
    # The bounds of a Box change nothing, and differ between noises
    entries = {f"entry {key}": space.shape if isinstance(space, spaces.Box) else space for key, space in _entries_of(network)}
    return {name: tuple(value.shape) for name, value in network.state_dict().items()} | settings | entries


def _entries_of(network: Any) -> Iterable[tuple[str, spaces.Space]]:
    return network.observation_space.spaces.items()


def _as_tensors(policy: AsymmetricPolicy, demonstrations: Demonstrations) -> tuple[dict[str, th.Tensor], th.Tensor]:
    """The entries that the deployed policy reads, and the actions in its own range, [-1, 1], or numbers of discrete ones."""
    if len(demonstrations) < 2:
        raise ValueError(f"demonstrations must be at least two, got {len(demonstrations)}.")
    keys = policy.deployed_entries
    missing = [key for key in keys if key not in demonstrations.observations]
    if missing:
        raise ValueError(
            f"demonstrations lack the entries {missing}, which the deployed policy reads; they have "
            f"{list(demonstrations.observations)}."
        )
    observations, _ = policy.deployed.reader.read({key: demonstrations.observations[key] for key in keys}, policy.device)
    space = policy.action_space
    count = len(next(iter(observations.values())))
    actions = np.asarray(demonstrations.actions).reshape(len(demonstrations), -1)
    if count != len(actions):
        raise ValueError(f"demonstrations have {count} observations and {len(actions)} actions: there must be one for each.")
    inside = _are_in(space, actions)
    if not inside.all():
        index = int(inside.argmin())
        raise ValueError(f"demonstrations: action {index} is {actions[index]}, which is not in {space}.")
    if isinstance(space, spaces.Box):
        actions = np.clip(actions.reshape(-1, *space.shape), space.low, space.high)  # rounding may exceed them
        actions = policy.scale_action(actions).reshape(count, -1)
        return observations, th.as_tensor(actions, dtype=th.float32, device=policy.device)
    return observations, th.as_tensor(actions[:, 0].astype(np.int64), device=policy.device)


def _are_in(space: spaces.Space, actions: np.ndarray) -> np.ndarray:
    """Whether each row of ``actions`` is in the space, but for rounding, shape (N,)."""
    if actions.shape[1] != int(np.prod(space.shape or ())):  # 1 for a discrete action
        return np.zeros(len(actions), dtype=bool)
    if isinstance(space, spaces.Box):
        low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
        rounding = 4 * np.finfo(np.float32).eps * np.maximum(np.abs(low), np.abs(high))  # SB3's scaling leaves the range
        return np.all((actions >= low - rounding) & (actions <= high + rounding), axis=1)
    assert isinstance(space, spaces.Discrete)
    return np.isin(actions[:, 0], np.arange(space.n))


def _loss(policy: AsymmetricPolicy, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
    """Cross-entropy of discrete actions, or squared error of the most likely action in [-1, 1]."""
    distribution = policy.deployed.distribution(observations)
    if isinstance(distribution, Categorical):
        return nn.functional.cross_entropy(distribution.logits, actions)
    return nn.functional.mse_loss(distribution.mode, actions)


@th.no_grad()
def _error(policy: AsymmetricPolicy, observations: dict[str, th.Tensor], actions: th.Tensor, rows: th.Tensor) -> float:
    distribution = policy.deployed.distribution({key: value[rows] for key, value in observations.items()})
    if isinstance(distribution, Categorical):
        return float((distribution.logits.argmax(-1) != actions[rows]).float().mean())
    return float(nn.functional.mse_loss(distribution.mode, actions[rows]))
