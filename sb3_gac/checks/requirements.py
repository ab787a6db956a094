"""Checks, before training, of what algorithms and SB3's ``HerReplayBuffer`` need of an environment."""

import warnings
from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from math import ceil
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac.checks.entries import check_entries, stored_shape
from sb3_gac.checks.spaces import check_box_actions

_, DESIRED_GOAL = GOALS = ("achieved_goal", "desired_goal")
REWARDS_OF_GOALS = (
    "HerReplayBuffer calls compute_reward(achieved_goals, desired_goals, infos) with N rows of each, and needs N rewards, as "
    "an array of shape (N,): take norms and comparisons along the last axis, and return no single number."
)


def check_environment(env: GymEnv) -> None:
    """
    Check that a model can learn in an environment.

    :param env: environment in the form that a model is given it
    :raises ValueError: if the environment is one of gymnasium's vector environments, or naming an observation entry or a
        component of Box actions that is not supported
    """
    if isinstance(env, VectorEnv):
        raise ValueError(
            f"env is one of gymnasium's vector environments ({type(env).__name__}), but SB3's algorithms take SB3's own, "
            "VecEnv: make it with stable_baselines3.common.env_util.make_vec_env(<id or class>, n_envs=...)."
        )
    if not isinstance(env, (gym.Env, VecEnv)):
        return  # SB3 says what it expects
    check_entries(env.observation_space)
    if isinstance(env.action_space, spaces.Box):
        check_box_actions(env.action_space)


def check_action_noise(noise: ActionNoise | None, space: spaces.Space) -> None:
    """
    Check that noise can be added to an environment's actions.

    :param noise: noise, as it was given or as SB3 vectorises it; ``None`` for none
    :param space: space of the actions
    :raises ValueError: if actions are not Box, or the noise has another number of components than an action
    """
    if noise is None:
        return
    if not isinstance(space, spaces.Box):
        raise ValueError("action_noise can be added to Box actions only: leave it out.")
    mean = getattr(noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise, "_mu", None)
    n_actions = int(np.prod(space.shape))
    if mean is not None and np.size(mean) != n_actions:  # SB3's own classes have a mean
        raise ValueError(
            f"action_noise must have as many components as an action, {n_actions}, but its mean has {np.size(mean)}: for "
            f"example NormalActionNoise(numpy.zeros({n_actions}), 0.1 * numpy.ones({n_actions}))."
        )


def warn_of_an_unseen_goal(role: str, seen: Collection[str], space: spaces.Space) -> None:
    """
    Warn if the deployed policy does not read a goal that is an entry of its own: it would learn to do well on average.

    :param role: role of the deployed policy
    :param seen: names of the entries that the deployed policy reads
    :param space: observation space of the environment
    """
    if isinstance(space, spaces.Dict) and DESIRED_GOAL in space.spaces and DESIRED_GOAL not in seen:
        warnings.warn(
            f'The {role} does not read the entry "{DESIRED_GOAL}", so it can\'t know what it is to reach: '
            f'role_keys={{"{role}": {[*seen, DESIRED_GOAL]}}}, or sb3_gac.envs.AppendDesiredGoal around the environment.',
            stacklevel=3,
        )


def check_goals(buffer_class: Any, space: spaces.Dict, env: VecEnv | None) -> None:
    """
    Check that an environment has the goals that ``HerReplayBuffer`` needs.

    :param buffer_class: value of the argument ``replay_buffer_class``; only ``HerReplayBuffer`` is checked
    :param space: observation space of the environment
    :param env: environments whose ``compute_reward`` rewards other goals; ``None`` if there are none yet
    :raises ValueError: if goals are missing or of different shapes, or if there is no ``compute_reward``
    """
    if not _is_hindsight(buffer_class):
        return
    name, entries = buffer_class.__name__, space.spaces
    if not set(GOALS) <= set(entries):
        raise ValueError(
            f"replay_buffer_class={name} replaces goals in the observation's entries {list(GOALS)}, but the observation has "
            f"{list(entries)}. Leave them as they are (goal_entries=True of registered tasks, keep={list(GOALS)} of "
            "SplitDictObservation), and say with role_keys who sees what: "
            'role_keys={"learner": ["partial", "desired_goal"]}.'
        )
    achieved, desired = (entries[goal] for goal in GOALS)
    if stored_shape(achieved) != stored_shape(desired):
        raise ValueError(
            f'replay_buffer_class={name} puts the entry "achieved_goal" in the place of "desired_goal", but they are '
            f"{achieved} and {desired}: give them one shape."
        )
    if env is not None and not env.has_attr("compute_reward"):
        raise ValueError(f"The environment has no method compute_reward. {REWARDS_OF_GOALS}")


def check_hindsight(buffer_class: Any, critics: Mapping[str, Collection[str]], deployed: str, env: VecEnv) -> None:
    """
    Check, before training, that what ``HerReplayBuffer`` relabels is all that depends on the goal, and that critics know it.

    :param buffer_class: value of the argument ``replay_buffer_class``; only ``HerReplayBuffer`` is checked
    :param critics: role whose ``role_keys`` decide what some critics read -> entries that they read
    :param deployed: role of the deployed policy
    :param env: environments
    :raises ValueError: if critics do not read the goal; or if a wrapper has changed the goals, or has put into observations
        what belongs to the former goals
    """
    if not _is_hindsight(buffer_class):
        return
    name, space = buffer_class.__name__, env.observation_space
    assert isinstance(space, spaces.Dict)
    for role, keys in critics.items():
        if DESIRED_GOAL not in keys:
            of_whom = "the critics, which read what it reads," if role == deployed else "the critics"
            raise ValueError(
                f"replay_buffer_class={name} rewards a step for other goals too, and {of_whom} would not know for which: "
                f'role_keys={{"{role}": {[*keys, DESIRED_GOAL]}}}.'
            )
    (inside,) = env.get_attr("observation_space", indices=[0])
    goal = space[DESIRED_GOAL]
    if isinstance(inside, spaces.Dict) and {*GOALS} <= {*inside.spaces} and inside[DESIRED_GOAL].shape != goal.shape:
        raise ValueError(
            f"replay_buffer_class={name} asks compute_reward about goals of the shape {goal.shape}, but the environment's are "
            f"of the shape {inside[DESIRED_GOAL].shape}: a wrapper such as VecFrameStack has changed them. Leave the wrapper "
            'out; sb3_gac.envs.History stacks "partial" alone.'
        )
    if env.has_attr("appends_reward") and any(env.get_attr("appends_reward")):
        raise ValueError(
            f"replay_buffer_class={name} replaces goals and rewards, but PreviousAction(reward=True) keeps rewards for the "
            "former goals in the observations: leave reward out."
        )


def check_rewards_of_goals(buffer_class: Any, buffer_kwargs: Mapping[str, Any], env: VecEnv) -> None:
    """
    Check ``compute_reward`` by calls as ``HerReplayBuffer`` will make them, on goals drawn from their spaces.

    :param buffer_class: value of the argument ``replay_buffer_class``; only ``HerReplayBuffer`` is checked
    :param buffer_kwargs: value of the argument ``replay_buffer_kwargs``
    :param env: environments, after their reset
    :raises ValueError: if ``compute_reward`` does not reward many goals at once, or otherwise than one by one
    """
    if not _is_hindsight(buffer_class) or buffer_kwargs.get("copy_info_dict", False):  # the content of infos is not known
        return
    goals_of = [env.observation_space.spaces[goal] for goal in GOALS]  # type: ignore[attr-defined]
    shape = stored_shape(goals_of[0])
    n_rows = max(shape, default=1) + 1  # so that a wrong axis shows, and an index of a row in place of a component
    goals = [_samples(goal, n_rows, seed).reshape(n_rows, *shape) for seed, goal in enumerate(goals_of)]

    def rewards_of(rows: slice) -> Any:
        given = [of_rows[rows] for of_rows in goals]
        return env.env_method("compute_reward", *given, [{} for _ in given[0]], indices=[0])[0]

    try:
        rewards = rewards_of(slice(None))
    except Exception as error:
        raise ValueError(f"compute_reward fails on {n_rows} rows of goals ({error!r}). {REWARDS_OF_GOALS}") from error
    if not isinstance(rewards, np.ndarray) or rewards.size != n_rows:
        said = f"{type(rewards).__name__} of shape {np.shape(rewards)}"
        raise ValueError(f"compute_reward returns {said} for {n_rows} rows of goals. {REWARDS_OF_GOALS}")
    alone = np.array([np.ravel(rewards_of(slice(row, row + 1)))[0] for row in range(n_rows)])
    if not np.allclose(rewards.ravel(), alone, rtol=1e-3, atol=1e-5, equal_nan=True):
        raise ValueError(
            f"compute_reward mixes rows of goals: it returns {rewards.ravel().tolist()} for {n_rows} rows at once, and "
            f"{alone.tolist()} for the same rows one by one. {REWARDS_OF_GOALS}"
        )


def _samples(space: spaces.Space, count: int, seed: int) -> np.ndarray:
    """Samples of a space, always the same ones for a seed, which leave the space's own random numbers as they are."""
    own = deepcopy(space)
    own.seed(seed)
    return np.stack([own.sample() for _ in range(count)])


def warn_of_other_rewards(
    buffer_kwargs: Mapping[str, Any],
    env: VecEnv,
    reached: Mapping[str, np.ndarray],
    rewards: np.ndarray,
    infos: Sequence[Mapping[str, Any]],
) -> bool:
    """
    Warn if the environments reward a step otherwise than ``compute_reward`` does, by which ``HerReplayBuffer`` rewards it for
    other goals.

    :param buffer_kwargs: value of the argument ``replay_buffer_kwargs``
    :param env: environments
    :param reached: observations at the step's end, of each environment
    :param rewards: rewards of the step that will be stored, shape (n_envs,)
    :param infos: infos of the step
    :return: whether there was a difference
    """
    known = list(infos) if buffer_kwargs.get("copy_info_dict", False) else [{} for _ in infos]  # as the buffer keeps them
    (computed,) = env.env_method("compute_reward", *(reached[goal] for goal in GOALS), known, indices=[0])
    computed = np.ravel(computed)
    if np.allclose(computed, rewards, rtol=1e-3, atol=1e-5):
        return False
    index = int(np.abs(computed - rewards).argmax())
    warnings.warn(
        f"The environment rewarded a step by {rewards[index]:g}, and compute_reward gives {computed[index]:g} for it. So "
        "HerReplayBuffer mixes two kinds of rewards: change compute_reward as wrappers change rewards, or leave the wrappers "
        "out.",
        stacklevel=3,
    )
    return True


def _is_hindsight(buffer_class: Any) -> bool:
    return isinstance(buffer_class, type) and issubclass(buffer_class, HerReplayBuffer)


def warn_of_no_gradient_step(model: OffPolicyAlgorithm, total_timesteps: int) -> None:
    """
    Warn before a training that ends within the warm-up.

    :param model: model that is about to learn
    :param total_timesteps: number of environment steps of the training, from its start
    """
    train_freq = model.train_freq
    assert isinstance(train_freq, TrainFreq)
    if train_freq.unit is TrainFrequencyUnit.EPISODE or total_timesteps == 0 or model.gradient_steps == 0:
        return  # an episode may be of any length; the others ask for no gradient step
    rollout = train_freq.frequency * model.n_envs
    steps = ceil(total_timesteps / rollout) * rollout
    if steps <= model.learning_starts:
        warnings.warn(
            f"learn makes no gradient step: learning_starts is {model.learning_starts}, and training ends after {steps} "
            "steps. Lower learning_starts, or raise total_timesteps.",
            stacklevel=3,
        )
