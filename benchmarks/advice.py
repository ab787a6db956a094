"""The worth of privileged information in words: what was found, which algorithm to train with, and what to do next."""

import math
from collections.abc import Mapping, Sequence

from benchmarks.headroom import ASYMMETRIC, FULL, GUIDED, PARTIAL, WORTH_SEEING, Worth, seeds_to_see
from benchmarks.intervals import CONFIDENCE, Difference, difference
from benchmarks.page.summary import listed
from benchmarks.tidy import number

#: Algorithm -> its name in sentences
TITLES = {FULL: "SAC on the full state", ASYMMETRIC: "SAC-asym", GUIDED: "GAC", PARTIAL: "SAC on partial alone"}
#: Number of seeds above which a comparison had better have more steps
MANY_SEEDS = 20


def findings(found: Worth) -> list[str]:
    """
    :param found: worth of privileged information on the task
    :return: sentences, one for each difference that the runs have
    """
    told = [(found.headroom, _HEADROOM), (found.in_training, _IN_TRAINING), (found.guider, _GUIDER)]
    return [_sentence(found, one, texts) for one, texts in told if one is not None]


_HEADROOM = {
    "more": "There is headroom. A policy that saw the privileged entries on the robot too returns {value} more than SAC-asym "
    "does without them: so much is there for a guider, a memory or more sensors to gain.",
    "same": "There is hardly any headroom, {value}: SAC-asym comes nearly as far without the privileged entries as SAC does "
    "with them. No guider and no memory can add much to that on this task.",
    "less": "SAC on the full state ends below SAC-asym, by {value}: with these steps it is not the upper bound that it should "
    "be. It has more inputs to learn from; give it more --steps before you trust the headroom.",
    "unknown": "The headroom, the full state over SAC-asym, can't be told: {value}.",
    "unlearned": "The headroom, the full state over SAC-asym, can't be told, since neither has learned: {value}.",
}
_IN_TRAINING = {
    "more": "Privileged information in training alone is worth {value}: so much do critics that see it add to SAC on partial.",
    "same": "Critics that see the privileged entries add next to nothing here, {value}: SAC on partial alone comes about as "
    "far as SAC-asym.",
    "less": "Critics that see the privileged entries do harm ({value}): what they know, the policy can't make use of.",
    "unknown": "Whether critics that see the privileged entries help can't be told: SAC-asym over SAC on partial is {value}.",
    "unlearned": "Whether critics that see the privileged entries help can't be told, since neither SAC-asym nor SAC on "
    "partial has learned: their difference is {value}.",
}
_GUIDER = {
    "more": "A guider is worth {value} on top of such critics: GAC over SAC-asym.",
    "same": "A guider changes next to nothing on top of such critics, {value}: GAC and SAC-asym come about equally far.",
    "less": "A guider costs return here: GAC over SAC-asym is {value}.",
    "unknown": "Whether a guider adds to such critics can't be told: GAC over SAC-asym is {value}.",
    "unlearned": "Whether a guider adds to such critics can't be told, since neither GAC nor SAC-asym has learned: their "
    "difference is {value}.",
}


def _sentence(found: Worth, one: Difference, texts: Mapping[str, str]) -> str:
    return texts[found.verdict(one)].format(value=in_words(found, one))


def in_words(found: Worth, one: Difference) -> str:
    """
    :param found: worth of privileged information on the task
    :param one: one of its differences
    :return: text such as "310 (120 to 500 with 95% confidence; 12% of what was learned)"
    """
    if math.isinf(one.low):
        return f"{number(one.value)} (of one seed each, which can't tell it from chance)"
    span = found.span_of(one)
    part = f"; {one.value / span:.0%} of what was learned" if span > 0 else ""
    return f"{number(one.value)} ({number(one.low)} to {number(one.high)} with {CONFIDENCE:.0%} confidence{part})"


def counted(number: int, noun: str) -> str:
    """
    :param number: number of things
    :param noun: noun in the singular, whose plural has an s
    :return: text such as "1 run" or "2 runs"
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def recommendation(found: Worth, steps: int) -> list[str]:
    """
    :param found: worth of privileged information on the task
    :param steps: environment steps of each run
    :return: sentences that name the algorithm to train with, how sure the choice is, and the next steps
    """
    if not found.learned:
        return [
            f"No algorithm ends above {_bar(found)}: nothing was learned in {steps:,} steps, and these runs say nothing about "
            "privileged information.",
            "Give more --steps, or another --preset.",
        ]
    if min(len(end) for end in found.ends.values()) == 1:
        return [
            "One seed of each algorithm is no basis for a recommendation: which is ahead may be chance. Give more --seeds."
        ]
    return [*_choice(found), *_needed(found), *_next_steps(found)]


def _needed(found: Worth) -> list[str]:
    """A sentence for each algorithm whose runs had the steps of other runs beside their own, so that they had more."""
    return [
        f"{title(name)} had {steps:,} environment steps beside its own, those of the runs that it needs, such as a teacher's."
        for name, steps in found.needed.items()
    ]


def _bar(found: Worth) -> str:
    mean, _, high = found.untrained[found.floor]
    return (
        f"the return of {found.floor} without training, {number(mean)}, beyond the spread of its episodes (to {number(high)})"
    )


def _choice(found: Worth) -> Sequence[str]:
    """
    The simplest algorithm of those that have learned and end as far as the best, or that can't be told from it and are behind
    by less than would be worth seeing. One that is further behind, if only by chance, is no choice for few seeds. Nor is one
    that another of them leaves behind beyond chance, though neither can be told from the best.
    """
    if not found.deployable:
        return ["None of these algorithms can be deployed without the privileged entries."]
    names = [name for name in found.deployable if name in found.learned]
    without = [title(name) for name in found.deployable if name not in names]
    if not names:
        return [f"None that can be deployed has learned: {_names(without, 'does', 'do')} not end above {_bar(found)}."]
    best = max(names, key=lambda name: float(found.ends[name].mean()))
    behind = {name: difference(found.ends, best, name) for name in names}
    unknown = [name for name in names if name != best and found.verdict(behind[name]) == "unknown"]
    lower = [name for name in unknown if behind[name].value > WORTH_SEEING * found.deployable_span]
    close = [name for name in names if found.verdict(behind[name]) in ("same", "unknown") and name not in lower]
    near = [name for name in close if not _above(found, close, name)]
    told = [f"Train with {title(near[0])}.", *_why(found, near, lower)]
    if near == [best] and not lower and len(names) > 1:
        told.append(f"It ends above {listed([title(name) for name in names if name != best])}, beyond chance.")
    told += [
        f"{title(name)} ends below {listed([title(one) for one in _above(found, close, name)])}, beyond chance."
        for name in close
        if name not in near
    ]
    if without:
        told.append(f"{_names(without, 'does', 'do')} not end above {_bar(found)}.")
    return told


def _above(found: Worth, names: Sequence[str], name: str) -> list[str]:
    """Those of the names whose ends are above those of one name, beyond chance."""
    return [other for other in names if found.verdict(difference(found.ends, other, name)) == "more"]


def _names(titles: Sequence[str], one: str, several: str) -> str:
    """Titles of algorithms, and the form of a verb that goes with their number."""
    return f"{listed(titles)} {one if len(titles) == 1 else several}"


def _why(found: Worth, near: Sequence[str], lower: Sequence[str]) -> list[str]:
    """Sentences on the algorithms that end near the chosen one, the first, and on those that end lower, maybe by chance."""
    chosen, *others = near
    same = [title(name) for name in others if found.verdict(difference(found.ends, name, chosen)) == "same"]
    unknown = [title(name) for name in others if title(name) not in same]
    clauses = [f"{_names(same, 'comes', 'come')} about equally far"] if same else []
    clauses += [f"{listed(unknown)} can't be told from it with these seeds"] if unknown else []
    reasons = [f"It is the simplest of those that do best: {'; '.join(clauses)}."] if clauses else []
    if lower:
        ends = _names([title(name) for name in lower], "ends", "end")
        reasons.append(f"{ends} lower on average, which may be chance with these seeds.")
    return reasons


def _next_steps(found: Worth) -> Sequence[str]:
    least = min(len(end) for end in found.ends.values())
    needed = seeds_to_see(found)
    differences = (found.headroom, found.in_training, found.guider)
    unknown = any(one is not None and found.verdict(one) == "unknown" for one in differences)
    hints = []
    if unknown and needed is not None:
        size = f"a difference of {WORTH_SEEING:.0%} of what was learned"
        if needed > least:
            hints.append(f"What can't be told is a matter of seeds: {needed} of each algorithm would most likely show {size}.")
            if needed > MANY_SEEDS:
                hints.append("These are many. Runs that have learned more often differ less, so try more --steps first.")
        else:
            hints.append(f"What can't be told is small: {least} seeds would most likely have shown {size}.")
    if found.headroom is not None and found.verdict(found.headroom) == "more":
        hints.append(
            "Since there is headroom, try what shows the policy more: the History wrapper, a recurrent policy, another sensor."
        )
    return hints


def title(algorithm: str) -> str:
    """
    :param algorithm: name of an algorithm in a suite
    :return: name of the algorithm in sentences
    """
    return TITLES.get(algorithm, algorithm)
