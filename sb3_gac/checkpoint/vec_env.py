"""The state of vectorised environments, written down so that another process can go on from there."""

from copy import deepcopy
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize, VecTransposeImage

from sb3_gac.envs.state import NotRestorableError, env_state, layers, restore_env_state, restore_settings, settings_of

#: Wrapper -> the attributes that change from step to step
CHANGING: dict[type, tuple[str, ...]] = {
    VecNormalize: ("obs_rms", "ret_rms", "returns"),
    VecMonitor: ("episode_returns", "episode_lengths", "episode_count"),
    VecTransposeImage: (),
}


def vec_env_state(env: VecEnv) -> dict[str, Any]:
    """
    The state of vectorised environments.

    :param env: vectorised environments, between two steps
    :return: dict with "names" of all wrappers, outermost first; "wrappers", the changing attributes of each (none of an
        unknown wrapper); "episodes", the state of each environment, or ``None`` if episodes can't be taken up again;
        "why", the reason for that, else empty; and "settings", those of all layers in this process, which are kept even then
    """
    wrappers, inner = _unwrap(env)
    unknown = [type(wrapper).__name__ for wrapper in wrappers if type(wrapper) not in CHANGING]
    known = [
        {attribute: deepcopy(getattr(wrapper, attribute)) for attribute in CHANGING.get(type(wrapper), ())}
        for wrapper in wrappers
    ]
    names = [type(wrapper).__name__ for wrapper in wrappers]
    try:
        if unknown:
            raise NotRestorableError(f"it is not known what the state of {unknown[0]} is")
        episodes, why = _episodes(inner), ""
    except NotRestorableError as error:
        episodes, why = None, str(error)
    settings = [settings_of(layer) for layer in _layers(inner)]
    return {"names": names, "wrappers": known, "episodes": episodes, "why": why, "settings": settings}


def restore_vec_env_state(env: VecEnv, state: dict[str, Any]) -> str:
    """
    Restore the state of vectorised environments.

    :param env: vectorised environments, made and wrapped like those that the state was taken from
    :param state: state that :func:`vec_env_state` returned
    :return: reason why the environments can't go on with their episodes; empty if they can
    :raises NotRestorableError: if ``env`` has other wrappers
    """
    wrappers, inner = _unwrap(env)
    if [type(wrapper).__name__ for wrapper in wrappers] != state["names"]:
        raise NotRestorableError(
            f"env is wrapped in {[type(wrapper).__name__ for wrapper in wrappers]}, but the checkpoint's was wrapped in "
            f"{state['names']}: wrap it likewise."
        )
    for wrapper, attributes in zip(wrappers, state["wrappers"], strict=True):
        for name, value in attributes.items():
            setattr(wrapper, name, value)
    try:
        if state["episodes"] is None:
            raise NotRestorableError(state["why"])
        _restore_episodes(inner, state["episodes"])
    except NotRestorableError as error:
        for layer, settings in zip(
            _layers(inner), state.get("settings", []), strict=False
        ):  # files of earlier versions have none
            restore_settings(layer, settings)
        return str(error)
    return ""


def _layers(inner: Any) -> list[Any]:
    """The vectorised environments themselves, and the layers of each environment in this process."""
    return [inner, *(layer for one in getattr(inner, "envs", ()) for layer in layers(one))]


def _episodes(inner: Any) -> Any:
    """
    :param inner: vectorised environments without wrappers
    :return: state of each environment's episode, or of the one simulator of them all
    :raises NotRestorableError: if the episodes can't be taken up again
    """
    if hasattr(type(inner), "checkpoint_state"):  # one simulator of them all, see sb3_gac.envs.vector
        return {"simulator": inner.checkpoint_state()}
    _check_in_this_process(inner)
    return [env_state(one) for one in inner.envs]


def _restore_episodes(inner: Any, episodes: Any) -> None:
    if hasattr(type(inner), "restore_checkpoint_state") and isinstance(episodes, dict):
        inner.restore_checkpoint_state(episodes["simulator"])
        return
    _check_in_this_process(inner)
    for one, its_state in zip(inner.envs, episodes, strict=True):
        restore_env_state(one, its_state)


def _check_in_this_process(inner: Any) -> None:
    if type(inner) is not DummyVecEnv:
        raise NotRestorableError(f"the environments of a {type(inner).__name__} are in other processes")


def _unwrap(env: VecEnv) -> tuple[list[VecEnvWrapper], Any]:
    """The wrappers, outermost first, and the vectorised environments inside."""
    wrappers = []
    while isinstance(env, VecEnvWrapper):
        wrappers.append(env)
        env = env.venv
    return wrappers, env
