"""Finds the parameters of a trigger that keep the errors within limits with the fewest messages.

The search is CMA-ES (Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772, 2016) by its author's library
`cma`. It needs no slopes, only comparisons, so noise and limits do it no harm. It asks for a generation at a time,
which all cores or a cluster run side by side, and depends on numpy alone. A point that breaks a limit is worse than any
that does not, and worse the farther it is. A limit counts as kept when the upper end of the 95 % confidence interval
over the seeds keeps it.

The best of many was also the luckiest on its seeds. So a third of the tuning seeds serves the search, and the choice
among the best is made on the others. The chosen one is run on seeds that took part in no choice, and only these are
reported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from agents.errors import ExplainedError, did_you_mean
from agents.plugins.files import plain
from experiments.file.document import Document, chosen, load
from experiments.file.problems import refusal
from experiments.metrics.metric import OF_LAW, Metric, short_name, swept_metrics
from experiments.recording.run_folder import naming
from experiments.sweep.plan import FIRST_TUNING, Axis, Cell, arguments, combination, compared, seeds_of
from experiments.sweep.store import Store
from experiments.sweep.sweep import SweepRunner, folder_of, origin
from experiments.sweep.table import CellRow, words_of
from experiments.sweep.workers import workers

Progress = Callable[[str, int, int], None]  # case, evaluations done, largest number of them

FINE: Final = 0.01  # share of a range: resolution of the search
SIGMA: Final = 0.3  # share of a range: first width of the search
EVALUATIONS: Final = (20, 20)  # largest number, and the increase for each parameter
SEARCH: Final = 1 / 3  # share of the tuning seeds that serves the search
TUNING: Final = 60  # seeds, if no number is given
FEWEST: Final = 6
ROUND: Final = 6  # number of the best that are looked at again at a time, until one keeps the limits
ROUNDS: Final = 4
BROKEN: Final = 1e6  # added to what breaks a limit

_LIMIT: Final = re.compile(r"\s*((?:[^<>=,:]+\.py:)?[A-Za-z_]\w*)\s*([<>])=?\s*([0-9]+\.?[0-9]*|\.[0-9]+)\s*")


@dataclass(frozen=True)
class Limit:
    """A bound of a metric; of its ratio to the reference for those that have one."""

    index: str
    bound: float
    least: bool = False  # the metric must not be smaller; else not larger

    def words(self, metrics: Mapping[str, Metric]) -> str:
        """The limit in words, of a search with these metrics."""
        word = f"{metrics[self.index].label} ratio" if metrics[self.index].relative else plain(self.index)
        return f"{word} {'>=' if self.least else '<='} {self.bound:g}"

    def excess(self, value: float) -> float:
        """Distance beyond the bound; negative within."""
        return self.bound - value if self.least else value - self.bound


@dataclass(frozen=True)
class Objective:
    """A metric to be minimised, or maximised where more is better, within limits of others."""

    index: str
    limits: tuple[Limit, ...]
    metrics: Mapping[str, Metric] = field(default_factory=swept_metrics, compare=False)  # metrics that can be named

    def limits_in_words(self, between: str) -> str:
        """All limits, with words between two of them."""
        return between.join(limit.words(self.metrics) for limit in self.limits)

    def rank(self, row: CellRow) -> float:
        """A number, the less the better, limits first; more than any other if it cannot be known, or if runs failed."""
        aim, metrics = row.value(self.index).mean, self.metrics
        if aim is None or row.failed:
            return 3.0 * BROKEN
        excess = 0.0
        for limit in self.limits:
            value = row.value(limit.index)
            if value.mean is None or (metrics[limit.index].mean == "all" and value.n < row.seeds):
                return 2.0 * BROKEN
            excess += max(0.0, limit.excess(value.mean) + (value.ci95 or 0.0)) / max(abs(limit.bound), 1e-9)
        if excess > 0.0:
            return BROKEN * (1.0 + min(excess, 1.0))
        return -aim if metrics[self.index].better == "more" else aim

    def kept(self, row: CellRow) -> bool:
        """Whether the means of a row keep all limits."""
        means = [(limit, row.value(limit.index).mean) for limit in self.limits]
        return all(mean is not None and limit.excess(mean) <= 0.0 for limit, mean in means) and not row.failed


@dataclass(frozen=True)
class TuningResult:
    """Result of a search."""

    read: Document
    objective: Objective
    tuning: tuple[int, ...]  # seeds of the search
    seeds: tuple[int, ...]  # seeds of the report
    rows: tuple[CellRow, ...]  # the reference, and the best of each case, on `seeds`
    tried: tuple[CellRow, ...]  # cells, ordered as searched, on the first third of `tuning`
    # of each case what was chosen, on the other two thirds; its limits may be broken if nothing kept them
    chosen: tuple[CellRow, ...]
    folder: Path  # folder of the runs
    notes: tuple[str, ...]  # remarks for the user
    metrics: Mapping[str, Metric]  # metrics of the tables


def parse_objective(text: str, metrics: Mapping[str, Metric] | None = None) -> Objective:
    """`messages, iae<=1.01, itae<=1.05`: first what is to be least, then limits.

    Of these metrics; left out: of those of all sweeps. Raises DocumentError if it cannot be understood.
    """
    metrics = swept_metrics() if metrics is None else metrics
    place = f'--optimise "{text}"'
    first, *rest = (part.strip() for part in text.split(","))
    if not first or _LIMIT.fullmatch(first):
        raise refusal(
            place, "it does not say what is to be least", 'write, for example, --optimise "messages, iae<=1.01"'
        )
    limits = []
    for part in rest:
        found = _LIMIT.fullmatch(part)
        if not found or (found[2] == ">" and metrics[_known(found[1], place, metrics)].better != "more"):
            raise refusal(place, f"'{part}' is no limit", "write one as iae<=1.01")
        limits.append(Limit(_known(found[1], place, metrics), float(found[3]), found[2] == ">"))
    least = _known(first, place, metrics)
    if not metrics[least].better:
        raise refusal(place, f"neither less nor more of '{first}' is better", "name another metric, such as messages")
    if not limits:
        raise refusal(place, "without a limit the best is to say nothing", "add one, such as iae<=1.01")
    return Objective(least, tuple(limits), metrics)


def searched(tuning: Sequence[int]) -> tuple[int, ...]:
    """Tuning seeds of the search; the others are those of the choice."""
    return tuple(tuning[: round(SEARCH * len(tuning))])


def tune(
    file: str | Path,
    given: Sequence[str],
    wanted: str,
    *,
    settings: Sequence[str] = (),
    cases: Sequence[str] = (),
    out: str | Path | None = None,
    scheduler: str | None = None,
    processes: int | None = None,
    progress: Progress = lambda _case, _done, _of: None,
) -> TuningResult:
    """Seeks the parameters of each case that has any of the axes; finished runs are not repeated.

    Args (others as of `sweep`):
        given: Ranges, `seeds=` to report on and `tuning=` to seek on, as on the command line.
        wanted: As `parse_objective` takes it.
        progress: Called with the case, the evaluations done, and their largest number.

    Raises:
        DocumentError: If the file or an argument is wrong.
        ExplainedError: If the library is not installed, or the workers are lost.
        KeyboardInterrupt: After Ctrl-C; the same call goes on from there.
    """
    read = load(file, *settings)
    objective = parse_objective(wanted, swept_metrics(read.cases().values()))
    axes, words = arguments(given)
    seeds = seeds_of(words.get("seeds"), read.experiment.seed)
    tuning = seeds_of(words.get("tuning"), FIRST_TUNING, TUNING)
    if len(tuning) < FEWEST:
        raise refusal(words["tuning"], f"{len(tuning)} seeds are too few to tune on", f"give at least {FEWEST}")
    if both := sorted(set(seeds) & set(tuning)):
        hint = "name others with tuning=1001:1060: what is tuned on a seed must not be reported on it"
        raise refusal(words.get("tuning", "seeds="), f"seed {both[0]} is to be tuned and reported on", hint)
    for axis in axes:
        if axis.span is None and len(axis.values) > 1:
            raise refusal(axis.argument, "the search needs a range", f"write {axis.path}=LOW:HIGH:log (or lin)")
    spans = [axis for axis in axes if axis.span is not None]
    if not spans:
        raise refusal("--optimise", "there is nothing to change", "add a range: trigger.threshold=0.002:0.05:log")
    fixed = [f"{axis.path}={axis.values[0]}" for axis in axes if axis.span is None]
    read = load(file, *settings, *fixed)
    reference = compared(read)
    search = _Search(read, str(file), (*settings, *fixed), objective, tuning)
    ranges = {
        name: found for name in chosen(read, cases) if name != reference and (found := search.ranges(name, spans))
    }
    if not ranges:
        hint = "choose a case that has it"
        raise refusal(spans[0].argument, f"no case that is looked at has it; the reference '{reference}' is not", hint)
    cma = _library()
    folder = Path(out) if out is not None else folder_of(read, spans, "optimise")
    tried: list[CellRow] = []
    selected: list[CellRow] = []
    plan: dict[tuple[str, str], Cell] = {}
    with naming(folder), Store(folder) as store:
        notes = store.changed_since(origin(read, [read.cases()[name] for name in (reference, *ranges)]))
        with workers(scheduler, processes) as working:
            runner = SweepRunner(store, working)
            for name, bounds in ranges.items():
                rows = search.run(cma, runner, name, bounds, progress)
                tried += rows
                best = search.choose(runner, rows, bounds)
                selected.append(best)
                for cell in search.again(best, bounds):
                    plan.setdefault((cell.case, cell.digest), cell)
            final = sorted(plan.values(), key=lambda cell: cell.case != reference)
            runner.run_missing(final, seeds)
            reported = runner.rows(final, seeds)
            notes += runner.metric_faults(final, seeds)
            metrics = runner.metrics(final, seeds)
    return TuningResult(
        read, objective, tuning, seeds, tuple(reported), tuple(tried), tuple(selected), folder, tuple(notes), metrics
    )


@dataclass(frozen=True)
class _Search:
    """Settings of a search that all cases share."""

    read: Document
    file: str
    settings: tuple[str, ...]
    objective: Objective
    tuning: tuple[int, ...]

    def ranges(self, case: str, axes: Sequence[Axis]) -> list[Axis]:
        lowest = self.cells({axis: axis.at(0.0) for axis in axes}, case)[-1]
        return [axis for axis in axes if axis.path in lowest.parameters]

    def cells(self, values: Mapping[Axis, str], case: str) -> list[Cell]:
        return list(combination(self.read, self.file, self.settings, values, (case,)))

    def again(self, row: CellRow, axes: Sequence[Axis]) -> list[Cell]:
        """The reference and a case with the values of a row."""
        return self.cells({axis: words_of(row.parameters[axis.path]) for axis in axes}, row.case)

    def choose(self, runner: SweepRunner, rows: Sequence[CellRow], axes: Sequence[Axis]) -> CellRow:
        """The best point of the search, on seeds that took no part in it."""
        fresh = self.tuning[len(searched(self.tuning)) :]
        ranked = sorted(rows, key=self.objective.rank)
        looked_at: list[CellRow] = []
        for begin in range(0, min(ROUNDS * ROUND, len(ranked)), ROUND):
            pairs = [self.again(row, axes) for row in ranked[begin : begin + ROUND]]
            runner.run_missing([cell for pair in pairs for cell in pair], fresh)
            looked_at += [runner.rows(pair, fresh)[-1] for pair in pairs]
            if any(self.objective.rank(row) < BROKEN for row in looked_at):
                break
        return min(looked_at, key=self.objective.rank)

    def run(self, cma: Any, runner: SweepRunner, case: str, axes: Sequence[Axis], progress: Progress) -> list[CellRow]:  # noqa: ANN401
        """The cells tried for a case, each once."""
        first, more = EVALUATIONS
        most = first + more * len(axes)
        options = {"bounds": [0.0, 1.0], "seed": 1, "tolx": FINE, "maxfevals": most, "verbose": -9, "verb_log": 0}
        # the method is not made for one dimension: a second one, that means nothing, does it no harm
        strategy = cma.CMAEvolutionStrategy([0.5] * max(2, len(axes)), SIGMA, options)
        known: dict[tuple[str, ...], CellRow] = {}
        asked = 0
        progress(case, 0, most)
        while not strategy.stop():
            points = strategy.ask()
            wanted = [tuple(axis.at(float(x)) for axis, x in zip(axes, point, strict=False)) for point in points]
            fresh = [values for values in dict.fromkeys(wanted) if values not in known]
            cells = {values: self.cells(dict(zip(axes, values, strict=True)), case) for values in fresh}
            plan = [cell for pair in cells.values() for cell in pair]
            runner.run_missing(plan, searched(self.tuning))
            for values, pair in cells.items():
                known[values] = runner.rows(pair, searched(self.tuning))[-1]
            strategy.tell(points, [self.objective.rank(known[values]) for values in wanted])
            asked += len(points)
            progress(case, min(asked, most), most)
        return list(known.values())


def _library() -> Any:  # noqa: ANN401 - it has no types
    try:
        return import_module("cma")
    except ImportError:
        raise ExplainedError(
            "--optimise needs a library that is an extra: ./zenpark install cma, or pip install -e '.[optimize]'"
        ) from None


def _known(name: str, place: str, metrics: Mapping[str, Metric]) -> str:
    names = {word: metric for metric in metrics for word in (metric, metric.lower(), short_name(metric))}
    if name.lower() not in names:
        hint = "name the measure in MEASURES of the law" if name.startswith(OF_LAW) else did_you_mean(name, names)
        raise refusal(place, f"no metric is called '{name}'", hint)
    return names[name.lower()]
