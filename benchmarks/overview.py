"""The display of a launch: a bar and a table in a terminal of any size; elsewhere a line for each start and end of a run."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from benchmarks.finished import name_of
from benchmarks.jobs import ENDED_BADLY, Clock, Job, count, in_words, last_evaluation

COLUMNS = ("run and seed", "state", "steps", "return")
_SUMMARY = 2  # lines above the table: the bar, and the number of runs in each state
_BAR_AT_LEAST = 8  # columns
_NARROW = 80  # columns, below which steps are a percentage
_BESIDE_NAMES = 36  # columns for all but the names, 12 of them for the return
_NAMES_AT_LEAST = 10
_STYLES = {"failed": "red", "not started": "red", "running": "bold"}


class Row(NamedTuple):
    """
    A line of the table.

    :param cell: name of the cell, task and noise
    :param run: algorithm and seed; for finished runs the algorithm alone
    :param state: state of the run, or the number of finished runs
    :param steps: environment steps at the last evaluation, and those of the whole run
    :param value: mean return at the last evaluation; for finished runs the return of each; for a run that failed the reason
    """

    cell: str
    run: str
    state: str
    steps: tuple[int, int]
    value: str

    def texts(self, width: int) -> tuple[str, str, str, str]:
        """
        :param width: columns of the terminal; where there are few, the cell's name is shortened first
        :return: text in each column of the table
        """
        done, of_all = self.steps
        steps = f"{done / of_all:.0%}" if width < _NARROW else f"{done:,} / {of_all:,}" if done < of_all else f"{done:,}"
        room = max(width - _BESIDE_NAMES - 12 * (width >= _NARROW), _NAMES_AT_LEAST) - len(self.run) - 1
        cell = self.cell if len(self.cell) <= room else f"{self.cell[: max(room - 1, 0)]}…"
        return f"{cell} {self.run}", self.state, steps, self.value


class Overview:
    """
    A bar with the time that is left, the number of runs in each state, and a table as high as the terminal allows. All three
    are made anew from the jobs whenever they are drawn.

    :param jobs: jobs of the launch
    :param finished_before: number of the suite's runs that were finished before the launch
    :param clock: clock that estimates the time that is left, by default one that starts now
    """

    def __init__(self, jobs: Sequence[Job], finished_before: int = 0, clock: Clock | None = None):
        self._jobs, self._finished_before = jobs, finished_before
        self._clock = clock or Clock(jobs)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the parts of the display; called by rich."""
        lines = max((options.height or console.height) - 1, 1)  # the last one is the cursor's
        rows = list(self.rows())
        room = max(lines - _SUMMARY, 0)
        has_header = room > 2
        shown = rows[: room - has_header]
        if lines >= _SUMMARY:
            yield self._bar(options.max_width)
        yield self._counts(hidden=len(rows) - len(shown))
        if shown:
            yield _table([row.texts(options.max_width) for row in shown], [row.state for row in shown], has_header)

    def rows(self) -> Iterator[Row]:
        """
        Yield the rows of the table, the most important ones first: runs that are running, runs that failed or were not
        started, and the finished runs of each cell and algorithm, the latest first.
        """
        for job in self._in_state("running", "failed", "not started"):
            steps, value = last_evaluation(job)
            said = job.reason or why_not_started(job) if job.state in ENDED_BADLY else _in_digits(value)
            yield Row(job.spec.cell, f"{job.spec.algorithm} {job.spec.seed}", job.state, (steps, job.spec.steps), said)
        cells = [list(jobs) for _, jobs in groupby(sorted(self._in_state("finished"), key=_cell), key=_cell)]
        for jobs in sorted(cells, key=lambda jobs: max(job.ended for job in jobs), reverse=True):
            returns = (_in_digits(last_evaluation(job)[1]) or "?" for job in sorted(jobs, key=lambda job: job.spec.seed))
            whole = jobs[0].spec.steps
            yield Row(*_cell(jobs[0]), f"{len(jobs)} finished", (whole, whole), ", ".join(returns))

    def _in_state(self, *states: str) -> list[Job]:
        """The jobs in the given states, in the order of the states."""
        return [job for state in states for job in self._jobs if job.state == state]

    def _bar(self, width: int) -> Table:
        """The bar, beside as much text as there is room for."""
        done, of_all = self._clock.done_of_all()
        share = done / of_all if of_all else 1.0
        left = time_left(self._clock)
        words = [f"{share:.0%}", *([left] if left else [])]
        at_length = [words[0], f"{done:,} of {of_all:,} steps", *words[1:]]
        text = ", ".join(at_length if len(", ".join(at_length)) + _BAR_AT_LEAST < width else words)
        line = Table.grid(padding=(0, 1), expand=True)
        line.add_column(ratio=1)
        line.add_column(no_wrap=True, overflow="ellipsis")
        line.add_row(ProgressBar(max(of_all, 1), done if of_all else 1), text)
        return line

    def _counts(self, hidden: int) -> Text:
        before = f", {self._finished_before} finished before" if self._finished_before else ""
        more = f"; {hidden} more {'lines' if hidden > 1 else 'line'} in a higher terminal" if hidden else ""
        return Text(f"{count(self._jobs)}{before}{more}", no_wrap=True, overflow="ellipsis")


def _table(rows: Sequence[Sequence[str]], states: Sequence[str], has_header: bool) -> Table:
    table = Table(box=None, show_header=has_header, padding=(0, 2, 0, 0), header_style="dim")
    for column in COLUMNS:
        table.add_column(column, no_wrap=column != COLUMNS[-1])  # the last column is shortened first
    for row, state in zip(rows, states, strict=True):
        table.add_row(*(Text(text, no_wrap=True, overflow="ellipsis") for text in row), style=_STYLES.get(state, ""))
    return table


def _cell(job: Job) -> tuple[str, str]:
    return job.spec.cell, job.spec.algorithm


def _in_digits(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def table(jobs: Sequence[Job]) -> Overview:
    """
    :param jobs: jobs of a launch
    :return: display of the launch for a terminal
    """
    return Overview(jobs)


def time_left(clock: Clock) -> str:
    """
    :param clock: clock of a launch
    :return: text with the time that is left, empty before the first evaluation
    """
    seconds = clock.seconds_left()
    return "" if seconds is None else f"{in_words(seconds)} left"


def line(jobs: Sequence[Job], job: Job, clock: Clock) -> str:
    """
    Describe an event in one line, for a log, where a table can't be drawn anew.

    :param jobs: jobs of the launch
    :param job: job whose state has changed, or that is tried again
    :param clock: clock of the launch
    :return: line that says what happened to the job, and how many jobs are in each state
    """
    steps, value = last_evaluation(job)
    ended = job.state != "running" or job.reason
    reached = f", {steps:,} / {job.spec.steps:,} steps, return {value:.1f}" if ended and value is not None else ""
    state = "tried again" if job.state == "running" and job.reason else job.state
    reason = f": {job.reason}" if job.reason else why_not_started(job)
    states = ", ".join(filter(None, [count(jobs), time_left(clock)]))
    return f"{name_of(job.spec)}: {state}{reached}{reason} ({states})"


def why_not_started(job: Job) -> str:
    """
    :param job: job in any state
    :return: text that names the jobs that this one needs and that failed or were not started; empty if there are none
    """
    verbs = {"failed": "failed", "not started": "was not started"}
    return "".join(f", for it needs {name_of(other.spec)}, which {verbs[other.state]}" for other in job.lacking)
