"""
The state of an environment in the middle of an episode, which is written down so that another process goes on from there.

This module knows MuJoCo's environments and two of classic control, gymnasium's wrappers around registered environments, SB3's
``Monitor``, and the wrappers of this package.  Any other environment or wrapper takes part by two methods::

    def checkpoint_state(self) -> dict[str, Any]          # numbers, strings, lists, dicts, arrays and generators
    def restore_checkpoint_state(self, state) -> None
"""

from collections import deque
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_gac.envs.attributes import arguments_of, attributes_of, restore_attributes

#: Class -> names of the attributes that a reset or a step changes
CHANGING: dict[str, tuple[str, ...]] = {
    "gymnasium.wrappers.common.TimeLimit": ("_elapsed_steps",),
    "rl_zoo3.gym_patches.PatchedTimeLimit": ("_elapsed_steps",),  # replaces gymnasium's, once rl_zoo3 is imported
    "gymnasium.wrappers.common.OrderEnforcing": ("_has_reset",),
    "gymnasium.wrappers.common.PassiveEnvChecker": (),
    "gymnasium.wrappers.common.RecordEpisodeStatistics": ("episode_count", "episode_returns", "episode_lengths"),
    "gymnasium.wrappers.transform_action.ClipAction": (),
    "gymnasium.wrappers.transform_action.RescaleAction": (),
    "gymnasium.wrappers.transform_observation.FlattenObservation": (),
    "gymnasium.envs.classic_control.pendulum.PendulumEnv": ("state", "last_u"),
    "gymnasium.envs.classic_control.cartpole.CartPoleEnv": ("state", "steps_beyond_terminated"),
    "stable_baselines3.common.monitor.Monitor": (
        "rewards",
        "needs_reset",
        "episode_returns",
        "episode_lengths",
        "episode_times",
        "total_steps",
        "current_reset_info",
    ),
    "sb3_gac.envs.wrappers.SplitObservation": (),
    "sb3_gac.envs.wrappers.SplitDictObservation": (),
    "sb3_gac.envs.wrappers.SensorNoise": ("_generator", "_drawn", "_n_used"),
    "sb3_gac.envs.wrappers.History": ("_values", "_actions"),
    "sb3_gac.envs.wrappers.PreviousAction": (),
    "sb3_gac.envs.disturbances.SensorDelay": ("_values",),
    "sb3_gac.envs.disturbances.DroppedFrames": ("_generator", "_shown"),
    "sb3_gac.envs.camera.CameraImage": (),
    "sb3_gac.envs.goals.AppendDesiredGoal": (),
    "sb3_gac.envs.suites.humanoid_bench.WithSensors": (),
    "sb3_gac.envs.suites.robotics.WithSimulatorState": (),
    "sb3_gac.envs.actions.FlattenMultiDiscrete": (),
}
#: Flags of gymnasium's checker that are set when a state is restored: an episode's first steps were checked before
_CHECKED = ("checked_reset", "checked_step", "checked_data_reuse")
_MUJOCO = "mujoco"  # key of the state of MuJoCo's model and data in a layer's state
MADE_WITH = "_settings_made_with"  # attribute of layers with settings, see settings_of
_SETTINGS = "settings"  # key of the settings in a layer's state
#: Packages whose environments change no attribute that a checkpoint can't hold, or have it restored by a wrapper
_KNOWN = ("gymnasium", "gymnasium_robotics", "humanoid_bench", "sb3_gac")
_ADDRESSES = ("plugin_data",)  # memory addresses of plugins' data, which another process can't use
#: Prefixes of the arrays in MuJoCo's model that a reset may change, beside its options
LOOKS = ("cam_", "geom_", "light_", "mat_", "site_", "tendon_")
_PARTS = (*LOOKS, "actuator_", "body_", "dof_", "eq_", "hfield_data", "jnt_", "pair_", "qpos")


class NotRestorableError(ValueError):
    """The state of an environment, or of a wrapper around it, is not known."""


def layers(env: gym.Env) -> list[gym.Env]:
    """
    List the layers of an environment in its wrappers.

    :param env: environment in its wrappers
    :return: wrappers from the outermost on, and last the environment itself
    """
    found = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    return found


def env_state(env: gym.Env) -> list[dict[str, Any]]:
    """
    Write down the state of an environment.

    :param env: environment in its wrappers, between two steps
    :return: copied state of each of its :func:`layers`, with the name of the layer's class
    :raises NotRestorableError: if the state of a layer is not known; the message names the layer
    """
    return [{"class": _name(layer), **_layer_state(layer)} for layer in layers(env)]


def restore_env_state(env: gym.Env, states: list[dict[str, Any]]) -> None:
    """
    Put an environment back into a state.

    :param env: environment in the same wrappers, changed in place
    :param states: state of each layer, as :func:`env_state` returns it; it may be restored again later
    :raises NotRestorableError: if the environment has other layers
    """
    names, expected = [_name(layer) for layer in layers(env)], [state["class"] for state in states]
    if names != expected:
        raise NotRestorableError(f"the environment is made of {names}, but the checkpoint's was made of {expected}")
    for layer, state in zip(layers(env), deepcopy(states), strict=True):  # the next steps write into arrays and generators
        _restore_layer(layer, {key: value for key, value in state.items() if key != "class"})


def _name(layer: gym.Env) -> str:
    return f"{type(layer).__module__}.{type(layer).__qualname__}"


def _layer_state(layer: gym.Env) -> dict[str, Any]:
    if hasattr(type(layer), "checkpoint_state"):
        state = dict(layer.checkpoint_state())  # type: ignore[attr-defined]
    elif _is_mujoco(layer):
        state = {_MUJOCO: _mujoco_state(layer)}
    elif _name(layer) in CHANGING:
        # Some layers have these attributes only from the first reset on
        there = [attribute for attribute in CHANGING[_name(layer)] if hasattr(layer, attribute)]
        state = {attribute: deepcopy(getattr(layer, attribute)) for attribute in there}
    else:
        raise NotRestorableError(
            f"it is not known what the state of {_name(layer)} is: give it the methods checkpoint_state() and "
            "restore_checkpoint_state(state)"
        )
    if not isinstance(layer, gym.Wrapper) and layer._np_random is not None:
        state["np_random"] = deepcopy(layer._np_random)
    if settings := settings_of(layer):
        state[_SETTINGS] = settings
    return state


def _restore_layer(layer: gym.Env, state: dict[str, Any]) -> None:
    settings = state.pop(_SETTINGS, {})
    restore_settings(layer, settings)
    _restore_values(layer, state)
    if not _made_alike(layer, settings):
        for name in vars(layer).get(MADE_WITH, ()):  # what was drawn or kept under other settings does not count
            setattr(layer, name, getattr(layer, name))


def _restore_values(layer: gym.Env, state: dict[str, Any]) -> None:
    if "np_random" in state:
        layer.np_random = state.pop("np_random")
    if hasattr(type(layer), "restore_checkpoint_state"):
        layer.restore_checkpoint_state(state)  # type: ignore[attr-defined]
    elif _MUJOCO in state:
        _restore_mujoco(layer, state[_MUJOCO])
    else:
        if isinstance(layer, gym.wrappers.PassiveEnvChecker):
            vars(layer).update(dict.fromkeys(_CHECKED, True))
        for attribute, value in state.items():
            now = getattr(layer, attribute, None)
            setattr(layer, attribute, deque(value, maxlen=now.maxlen) if isinstance(now, deque) else value)


def settings_of(layer: Any) -> dict[str, dict[str, Any]]:
    """
    Settings that may be set anew during training, such as a noise that grows with the policy's skill.

    :param layer: environment, wrapper or vectorised environment; its attribute ``_settings_made_with`` has the settings that
        it was made with, by name, and each of them is an attribute too
    :return: the settings "made_with" and "now"; an empty dict if the layer has none
    """
    made_with = vars(layer).get(MADE_WITH)
    now = {name: getattr(layer, name) for name in made_with or ()}
    return deepcopy({"made_with": made_with, "now": now}) if made_with else {}


def restore_settings(layer: Any, settings: dict[str, dict[str, Any]]) -> None:
    """
    Set the settings that a layer had, unless it was made with others: whoever made it wants those.

    :param layer: environment, wrapper or vectorised environment
    :param settings: what :func:`settings_of` returned; an empty dict, as of earlier versions, changes nothing
    """
    if _made_alike(layer, settings):
        for name, value in settings.get("now", {}).items():
            setattr(layer, name, value)


def _made_alike(layer: Any, settings: dict[str, dict[str, Any]]) -> bool:
    made_with = vars(layer).get(MADE_WITH, {})
    return all(np.array_equal(made_with.get(name), value) for name, value in settings.get("made_with", {}).items())


def _is_mujoco(layer: gym.Env) -> bool:
    data = getattr(layer, "data", None) if not isinstance(layer, gym.Wrapper) else None
    return type(data).__module__.startswith("mujoco") and type(data).__name__ == "MjData"


def _mujoco_state(layer: Any) -> dict[str, Any]:
    """
    Copy MuJoCo's own state, from which a step computes the next one, and all quantities that MuJoCo derived from earlier ones.

    Observations and rewards of some tasks read positions of bodies, which MuJoCo computed at the last step's start.
    """
    import mujoco

    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(layer.model, spec))
    mujoco.mj_getState(layer.model, layer.data, state, spec)
    return {
        "state": state,
        "derived": {name: array.copy() for name, array in arrays_of(layer.data).items()},
        "model": {name: array.copy() for name, array in arrays_of(layer.model, _PARTS).items()},
        "options": _options(layer.model.opt),
        "attributes": _attributes(layer),
        "arguments": arguments_of(layer),
    }


def _attributes(layer: gym.Env) -> dict[str, Any]:
    attributes, unknown = attributes_of(layer)
    if unknown and type(layer).__module__.partition(".")[0] not in _KNOWN:
        raise NotRestorableError(
            f"the attribute {unknown[0]} of {_name(layer)} is a {type(getattr(layer, unknown[0])).__qualname__}, which a "
            "checkpoint can't hold: use numbers, strings, lists, dicts, arrays and generators of its own, or make it an "
            "attribute of the class if it never changes"
        )
    return attributes


def _restore_mujoco(layer: Any, saved: dict[str, Any]) -> None:
    import mujoco

    attributes = saved.get("attributes", saved.get("drawn", {}))  # files of earlier versions have fewer, or none
    restore_attributes(layer, attributes, saved.get("arguments"))
    _write(arrays_of(layer.model, _PARTS), saved.get("model", {}))
    for name, value in saved.get("options", {}).items():
        setattr(layer.model.opt, name, value)
    mujoco.mj_setState(layer.model, layer.data, saved["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(layer.model, layer.data)  # makes as many contacts as there were, and arrays of that size
    mujoco.mj_setState(layer.model, layer.data, saved["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
    _write(arrays_of(layer.data), saved["derived"])


def _write(arrays: dict[str, np.ndarray], saved: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        if name in saved and saved[name].shape == array.shape:
            array[...] = saved[name]


def _options(opt: Any) -> dict[str, Any]:
    """Options of MuJoCo's model, such as gravity, wind and the time step."""
    return {name: deepcopy(getattr(opt, name)) for name in dir(opt) if not name.startswith("_")}


def arrays_of(struct: Any, prefixes: tuple[str, ...] = ("",)) -> dict[str, np.ndarray]:
    """
    :param struct: MuJoCo's model or data
    :param prefixes: beginnings of the arrays' names
    :return: name -> array, not copied, of those that are not empty
    """
    names = [name for name in dir(struct) if name.startswith(prefixes) and not name.startswith(("_", *_ADDRESSES))]
    arrays = {name: getattr(struct, name) for name in names}
    return {name: array for name, array in arrays.items() if isinstance(array, np.ndarray) and array.size}
