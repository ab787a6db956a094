"""
The way of an observation's entry through an environment's wrappers.

A wrapper tells by attributes what it does to entries: ``changed_entries`` are the keys of those that it changes,
``makes_anew`` says that they no longer depend on the wrapped environment's, and ``sources(key)`` names the entries that an
entry is made of, where these have other keys.
"""

from collections.abc import Iterator, Sequence

import gymnasium as gym

#: Places of wrappers of an entry, from the inside to the outside: at the sensor, on the way, and in the policy's hands
MEASURED, SENT, RECEIVED = 0, 1, 2


def entries_changed_by(layer: gym.Env) -> Sequence[str]:
    """
    :param layer: environment or wrapper
    :return: keys of the entries that it changes, if it is one of this package's wrappers of entries, else none
    """
    return getattr(layer, "changed_entries", ())


def place_of(layer: gym.Env) -> int:
    """
    :param layer: environment or wrapper
    :return: place of a wrapper among the others of its entry (``MEASURED``, ``SENT`` or ``RECEIVED``), -1 where any will do
    """
    place: int | None = getattr(type(layer), "_place", None)
    return -1 if place is None else place


def inward(layer: gym.Env, key: str) -> list[tuple[gym.Env, str]]:
    """
    Follow an entry to the next layer inward, where it may have another key.

    :param layer: environment or wrapper
    :param key: key of an entry of its observation
    :return: next layer with the key that the entry has there, once for each entry that it is made of; empty for the
        environment itself, and for a wrapper that makes the entry anew
    """
    if not isinstance(layer, gym.Wrapper) or (getattr(layer, "makes_anew", False) and key in entries_changed_by(layer)):
        return []
    sources = layer.sources(key) if hasattr(layer, "sources") else [key]
    entries = getattr(layer.env.observation_space, "spaces", ())
    return [(layer.env, source) for source in sources if source in entries]


def wrappers_of(env: gym.Env, key: str) -> Iterator[tuple[gym.Env, str]]:
    """
    Find the wrappers that an entry's values come through.

    :param env: environment in its wrappers
    :param key: key of an entry of its observation
    :return: this package's wrappers that change the entry, from the outermost inward, each with the entry's key there
    """
    if key in entries_changed_by(env):
        yield env, key
    for inner, source in inward(env, key):
        yield from wrappers_of(inner, source)


def count_wrappers(env: gym.Env, kind: type[gym.Wrapper]) -> int:
    """
    :param env: environment in its wrappers
    :param kind: class of a wrapper
    :return: number of its layers of that class
    """
    count = 0
    while isinstance(env, gym.Wrapper):
        count += isinstance(env, kind)
        env = env.env
    return count
