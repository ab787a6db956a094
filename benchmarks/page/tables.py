"""The page's tables: returns, comparisons over all cells, and the arguments in which algorithms differ."""

import html
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.intervals import mean_interval
from benchmarks.page.summary import seeds_compared
from benchmarks.tidy import NEEDED, after_needed, number

#: Largest number of seeds whose interquartile mean is their mean
SAME_MEAN = 3
_SHORT = 30  # characters of a text that is not to be broken into lines


class Field(NamedTuple):
    """
    A field of a table.

    :param text: text that is shown
    :param value: number by which rows are sorted, ``None`` to sort by the text
    """

    text: str
    value: float | None = None

    def html(self) -> str:
        """Return the HTML of the field."""
        if self.value is None:
            short = " class=short-text" if len(self.text) <= _SHORT else ""
            return f"<td{short}>{html.escape(self.text)}</td>"
        return f'<td class=number data-value="{self.value:.6g}">{html.escape(self.text)}</td>'


def field(value: float | None, shown: str = "") -> Field:
    """
    :param value: number to show, ``None`` for an empty field, which is sorted below all others
    :param shown: format of the number; where it is empty, a return of any size has at least three digits
    :return: field of the number
    """
    return Field("", -math.inf) if value is None else Field(f"{value:{shown}}" if shown else number(value), value)


def table(head: Sequence[str], rows: Sequence[tuple[Sequence[Field], bool]], sortable: bool = True) -> str:
    """
    :param head: names of the columns
    :param rows: rows, each with its fields, and whether the row is the best of its cell, which is shown in bold
    :param sortable: whether a click on a column's name sorts the rows by that column
    :return: HTML of the table
    """
    mark = " data-sortable" if sortable else ""
    names = "".join(f"<th{mark}>{html.escape(name)}</th>" for name in head)
    body = "".join(
        f"<tr{' class=best' if best else ''}>{''.join(field.html() for field in fields)}</tr>" for fields, best in rows
    )
    return f"<div class=wide><table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table></div>"


def returns_table(cells: Sequence[Mapping[str, Any]]) -> str:
    """
    :param cells: "cells" of the aggregated results: one mapping for each algorithm in each cell
    :return: HTML of a table with one row for each algorithm in each cell, the best one of a cell in bold
    """
    head = [
        "task",
        "noise",
        "algorithm",
        "mean at the end",
        "95% interval",
        "IQM [95%]",
        "each seed",
        "mean of the curve",
        "guider",
    ]
    head += ["KL / target", "steps to the reference's end"]
    best = _best(cells)
    rows = [(list(_returns(cell)), id(cell) in best) for cell in cells]
    shown = [column for column in range(len(head)) if any(fields[column].text for fields, _ in rows)]
    return table(
        [head[column] for column in shown], [([fields[column] for column in shown], is_best) for fields, is_best in rows]
    )


def _best(cells: Sequence[Mapping[str, Any]]) -> set[int]:
    by_cell: dict[Any, list[Mapping[str, Any]]] = {}
    for cell in cells:
        by_cell.setdefault((cell["task"], cell["noise"]), []).append(cell)
    return {id(max(of_cell, key=lambda one: one["final_mean"])) for of_cell in by_cell.values() if len(of_cell) > 1}


def _returns(cell: Mapping[str, Any]) -> Iterator[Field]:
    yield Field(cell["task"])
    yield field(cell["noise"], "g")
    yield Field(after_needed(cell["algorithm"], cell.get(NEEDED, 0)))
    yield field(cell["final_mean"])
    _, low, high = mean_interval(np.array(cell["final"], dtype=float))
    yield Field("one seed" if math.isinf(low) else f"{number(low)} to {number(high)}")
    iqm, low, high = cell["final_iqm"]
    interval = f"{number(iqm)} [{number(low)}, {number(high)}]"
    yield Field(interval, iqm) if len(cell["final"]) > SAME_MEAN else field(None)
    yield Field(", ".join(map(number, cell["final"])))
    yield field(cell["area_iqm"][0])
    yield field(cell.get("guider_mean"))
    yield field(cell.get("kl_over_target_mean"), ",.2f")
    yield field(cell["steps_to_reference"], ",")


def overall_table(results: Mapping[str, Any]) -> str:
    """
    :param results: aggregated results
    :return: HTML of a table with the normalised returns over all cells, and the probability that a run of the row's algorithm
        ends above a run of the column's algorithm
    """
    names = sorted(results["normalised_iqm"], key=lambda name: -results["normalised_iqm"][name][0])
    head = ["algorithm", "normalised IQM", "95% interval", *(f"above {name}" for name in names)]
    one_seed = seeds_compared(results) == 1
    rows = []
    for name in names:
        value, low, high = results["normalised_iqm"][name]
        interval = Field("one seed" if one_seed else f"{low:.2f} to {high:.2f}")
        chances = [results["probability_of_improvement"].get(f"{name} over {other}") for other in names]
        others = [_improvement(chance, one_seed) for chance in chances]
        rows.append(([Field(name), field(value, ",.2f"), interval, *others], name == names[0]))
    return table(head, rows)


def _improvement(estimate: Sequence[float] | None, one_seed: bool) -> Field:
    if estimate is None:
        return Field("", -math.inf)
    value, low, high = estimate
    return Field(f"{value:.2f}" if one_seed else f"{value:.2f} [{low:.2f}, {high:.2f}]", value)


def with_surroundings(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """
    :param results: aggregated results
    :return: algorithm in a cell, such as "gac, Hopper, noise 0.1" -> its arguments there; ``normalize``, the arguments of the
        ``VecNormalize`` around its environments, where they were recorded; and ``needs``, the runs that it needs
    """
    particulars, normalize = results.get("particulars", {}), results.get("normalize", {})
    return {
        kind: {
            **arguments,
            **({"normalize": normalize[kind] or "nothing"} if kind in normalize else {}),
            **{name: value for name, value in particulars.get(kind, {}).items() if name == "needs"},
        }
        for kind, arguments in results.get("arguments", {}).items()
    }


def differences_table(arguments: Mapping[str, Mapping[str, Any]]) -> tuple[str, dict[str, Any]]:
    """
    :param arguments: algorithm in a cell, such as "gac, Hopper, noise 0.1" -> the algorithm's arguments there
    :return: HTML of a table of the arguments in which algorithms or cells differ, and the arguments that all algorithms share
        in all cells
    """
    flat = {kind: dict(_flat(of_kind)) for kind, of_kind in arguments.items()}
    by_algorithm: dict[str, dict[str, dict[str, Any]]] = {}
    for kind, of_kind in flat.items():
        algorithm, _, cell = kind.partition(", ")
        by_algorithm.setdefault(algorithm, {})[cell] = of_kind
    names = list(dict.fromkeys(name for of_kind in flat.values() for name in of_kind))
    shared = {name: next(iter(flat.values()))[name] for name in names if _is_shared(name, list(flat.values()))}
    rows = [
        ([Field(name), *(Field(_of_cells(name, cells)) for cells in by_algorithm.values())], False)
        for name in names
        if name not in shared
    ]
    return table(["argument", *by_algorithm], rows, sortable=False) if rows else "<p>They have the same arguments.</p>", shared


def _of_cells(name: str, cells: Mapping[str, Mapping[str, Any]]) -> str:
    """The value of an argument; if it differs from cell to cell, each value with the cells that have it."""
    having: dict[str, list[str]] = {}
    for cell, arguments in cells.items():
        having.setdefault(_in_words(arguments.get(name, "")), []).append(cell)
    if len(having) == 1:
        return next(iter(having))
    return "; ".join(f"{value or 'none'} ({', '.join(those)})" for value, those in having.items())


def _flat(arguments: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in arguments.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _is_shared(name: str, arguments: Sequence[Mapping[str, Any]]) -> bool:
    return all(name in one and one[name] == arguments[0].get(name) for one in arguments)


def _in_words(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
