"""The summary of a suite's results, in sentences."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.page.cells import title_of
from benchmarks.tidy import NO_NOISE

SURE = 0.5  # probability of improvement at which neither algorithm is better
#: Smallest number of seeds whose bootstrap intervals support a verdict. Where two algorithms are equal in one cell, the
#: interval of the probability of improvement leaves 0.5 out in 6 to 8% of all cases with five seeds, in 17 to 20% with three,
#: in a third with two, and always with one
ENOUGH = 5


def what_was_compared(results: dict[str, Any]) -> str:
    """
    :param results: aggregated results
    :return: sentence with the algorithms, tasks, noises, environment steps and seeds
    """
    cells = results["cells"]
    algorithms = list(dict.fromkeys(cell["algorithm"] for cell in cells))
    tasks = list(dict.fromkeys(cell["task"] for cell in cells))
    noises = sorted({cell["noise"] for cell in cells if cell["noise"] is not None})
    at = f", sensor noise {listed([f'{noise:g}' for noise in noises])}" if noises else ""
    seeds = {len(cell["seeds"]) for cell in cells}
    count = f"{min(seeds)} to {max(seeds)}" if len(seeds) > 1 else f"{min(seeds)}"
    steps = f"{results['settings']['steps']:,} environment steps, " if "settings" in results else ""
    plural = "" if seeds == {1} else "s"
    return f"{listed(algorithms)} on {listed(tasks)}{at}: {steps}{count} seed{plural} of each."


def in_short(results: dict[str, Any]) -> list[str]:
    """
    :param results: aggregated results
    :return: sentences that say which algorithm ends highest, how sure the order is, how wide intervals of few seeds are, and
        how many runs are missing
    """
    sentences = [*_highest(results), *_overall(results), *_about_seeds(results)]
    if missing := len(results.get("still_to_run", [])):
        one = missing == 1
        sentences.append(f"{missing} run{'' if one else 's'} of the suite {'is' if one else 'are'} still to make.")
    if aside := len(results.get("set_aside", {})):
        one = aside == 1
        finished = "1 finished run is" if one else f"{aside} finished runs are"
        sentences.append(f"{finished} set aside, since other runs of {'its cell' if one else 'their cells'} are missing.")
    return sentences


def _highest(results: dict[str, Any]) -> list[str]:
    best: dict[Any, Any] = {}
    several = Counter((cell["task"], cell["noise"]) for cell in results["cells"])
    for cell in results["cells"]:
        key = (cell["task"], cell["noise"])
        if several[key] > 1 and (key not in best or cell["final_mean"] > best[key]["final_mean"]):
            best[key] = cell
    if not best:
        return []
    counts = Counter(cell["algorithm"] for cell in best.values()).most_common()
    if len(best) == 1:
        ((task, noise),) = best
        title = title_of(task, NO_NOISE if noise is None else noise)
        where = f" on {title}, the only cell with several algorithms" if len(several) > 1 else ""
        return [f"{counts[0][0]} has the highest mean return at the end{where}."]
    (first, count), *others = counts
    rest = "".join(f", {name} in {number}" for name, number in others)
    return [f"{first} has the highest mean return at the end in {count} of {len(best)} cells{rest}."]


def _overall(results: dict[str, Any]) -> list[str]:
    ranked = sorted(results["normalised_iqm"], key=lambda name: -results["normalised_iqm"][name][0])
    if len(ranked) < 2:
        return []
    first, second = ranked[:2]
    value, low, high = results["probability_of_improvement"][f"{first} over {second}"]
    seeds = seeds_compared(results)
    if seeds < ENOUGH:
        sure = f": {seeds} seed{'' if seeds == 1 else 's'} of each can't tell whether that is more than chance."
    else:
        verdict = "beyond chance" if low > SURE else "which these runs can't tell from chance"
        sure = f" (95% interval {low:.2f} to {high:.2f}), {verdict}."
    return [
        f"Over all cells {first} comes first and {second} second (interquartile mean of normalised returns "
        f"{results['normalised_iqm'][first][0]:.2f} and {results['normalised_iqm'][second][0]:.2f}). A run of {first} ends "
        f"above one of {second} with probability {value:.2f}{sure}"
    ]


def seeds_compared(results: Mapping[str, Any]) -> int:
    """
    :param results: aggregated results
    :return: number of runs with which each algorithm counts in each cell of a comparison over all cells, 0 if there is none
    """
    compared = results["compared"]["algorithms"]
    return min((len(cell["seeds"]) for cell in results["cells"] if cell["algorithm"] in compared), default=0)


def about_intervals(results: Mapping[str, Any]) -> str:
    """
    :param results: aggregated results
    :return: sentences on the intervals of the comparisons over all cells, where these are too narrow; else the empty text
    """
    seeds = seeds_compared(results)
    if not 1 < seeds < ENOUGH:
        return ""
    return f"These are bootstrap intervals. Those of {seeds} seeds are too narrow for a verdict."


def _about_seeds(results: dict[str, Any]) -> list[str]:
    fewest = min(len(cell["seeds"]) for cell in results["cells"])
    if fewest >= 5:
        return []
    if fewest == 1:
        return ["One seed can't tell a difference from chance."]
    factor = {2: "12.7", 3: "4.3", 4: "3.2"}[fewest]
    return [f"{fewest} seeds are few: an interval of their mean is {factor} standard errors to either side (Student's t)."]


def listed(names: Sequence[str]) -> str:
    """
    :param names: at least one name
    :return: text such as "a, b and c"
    """
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
