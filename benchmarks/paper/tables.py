"""The paper's tables, with this package's values beside the paper's."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import yaml

from benchmarks.suite import HERE
from sb3_gac import GAC
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites import SUITES, env_id_of, shows_whole_state, suite_of
from sb3_gac.envs.table import in_columns
from sb3_gac.presets import preset, read_preset

OURS = "small"
NOISES = (0.0, 0.1, 0.2, 0.3)
NOT_SET = "by default"
_CONTENT = yaml.safe_load((HERE / "paper/tables.yml").read_text(encoding="utf-8"))


def settings(number: int) -> str:
    """
    :param number: number of a table of settings
    :return: text of the table: parameters, the paper's values, those of the preset with the paper's settings, and those of the
        preset ``small``
    """
    table = _CONTENT["settings"][number]
    columns = [table["preset"], OURS]
    found = {name: _arguments(name) for name in columns}
    rows = [
        [parameter, value, *(_in_words(_value_at(found[name], path)) for name in columns)]
        for parameter, (value, path) in table["rows"].items()
    ]
    notes = [f"- {note}" for note in (*_CONTENT["notes"], *table.get("notes", []))]
    head = ["parameter", "paper", *(f"preset {name}" for name in columns)]
    return "\n".join([f"Table {number}: {table['title']}", "", in_columns(head, rows), "", *notes])


def _arguments(name: str) -> dict[str, Any]:
    """The arguments of GAC in a preset, its defaults included, and the preset's numbers of environments and steps."""
    run, arguments = read_preset(name).run, preset(name)
    signatures = [inspect.signature(kind).parameters.values() for kind in reversed(GAC.__mro__[:-1])]
    defaults = {one.name: one.default for parameters in signatures for one in parameters if one.default is not one.empty}
    steps = arguments.get("gradient_steps", 1)
    per_step = 1.0 if steps == -1 else steps / run["envs"]
    return {"steps": "by suite", **defaults, **arguments, **run, "gradient_steps_per_step": per_step}


def _value_at(arguments: Any, path: str) -> Any:
    """The value at a path of keys with dots between; a value on the way that is no mapping holds for all keys below it."""
    for key in path.split("."):
        if not isinstance(arguments, Mapping):
            return arguments
        if key not in arguments:
            return None
        arguments = arguments[key]
    return arguments


def _in_words(value: Any) -> str:
    if value is None:
        return NOT_SET
    if isinstance(value, type):
        return value.__name__
    return ", ".join(map(str, value)) if isinstance(value, list) else f"{value:g}" if isinstance(value, float) else str(value)


def target_kls(number: int) -> str:
    """
    :param number: number of a table of ``target_kl`` by task and noise
    :return: text of the table: the paper's values, and those of the presets ``paper`` and ``small``
    """
    rows = []
    for task, values in _CONTENT["target_kl"][number].items():
        for noise, value in zip(NOISES, values, strict=True):
            ours = (preset(name, task=task, noise=noise).get("target_kl") for name in ("paper", OURS))
            rows.append([task, f"{noise:g}", f"{value:g}", *("0.0033 (default)" if kl is None else f"{kl:g}" for kl in ours)])
    head = ["task", "noise", "paper", "preset paper", f"preset {OURS}"]
    return f"Table {number}: target_kl by task and noise in Brax\n\n{in_columns(head, rows)}"


def missing(number: int) -> str:
    """
    :param number: number of a table whose values are missing from the paper's text
    :return: text that says so
    """
    return (
        f"Table {number}: target_kl by task in HumanoidBench. The text of the paper has its caption alone; Table 5 has the "
        "values that it chose from. The preset paper-humanoid-bench has 0.01 for all tasks, the middle one for locomotion."
    )


def observations(number: int) -> str:
    """
    :param number: number of a table of sizes of observations
    :return: text of the table: the paper's sizes, and those of this package's tasks
    """
    rows = [[task, *map(str, sizes), *_own_sizes(task)] for task, sizes in _CONTENT["observations"][number].items()]
    head = ["task", *(f"paper: {part}" for part in ("whole", PARTIAL, PRIVILEGED)), f"ours: {PARTIAL}", PRIVILEGED, "hidden"]
    note = f"hidden: numbers of our {PRIVILEGED} that {PARTIAL} does not show"
    return f"Table {number}: sizes of observations\n\n{in_columns(head, rows)}\n\n{note}"


def _own_sizes(task: str) -> Sequence[str]:
    """The sizes of the entries ``partial`` and ``privileged``, and of the part of ``privileged`` that ``partial`` lacks."""
    env_id = env_id_of(task)
    shapes = SUITES[suite_of(env_id) or ""].environments[env_id]["shapes"]
    partial_size, privileged = shapes[PARTIAL][0], shapes[PRIVILEGED][0]
    hidden = privileged - partial_size if shows_whole_state(task) else privileged
    return [str(partial_size), str(privileged), str(hidden)]


#: Number of a table -> function that makes the table's text
TABLES: dict[int, Callable[[], str]] = {
    **{number: partial(settings, number) for number in _CONTENT["settings"]},
    **{number: partial(target_kls, number) for number in _CONTENT["target_kl"]},
    6: partial(missing, 6),
    **{number: partial(observations, number) for number in _CONTENT["observations"]},
}
