"""Sweeps: cases × values × seeds in virtual time, on all cores or on a cluster, never repeating what is done.

In a notebook:

    from zenpark import sweep
    found = sweep("robotic-park", ["trigger.threshold=0.002:0.05:log12", "seeds=50"])
    print(found)
    found.rows[3].ratio["iae"].mean
    found.pareto().savefig("pareto.pdf")

In a script, what calls `sweep` stands below `if __name__ == "__main__":`, because other processes import the script.
"""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Final

from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import Document, load
from experiments.file.problems import refusal
from experiments.metrics.metric import Metric, law_metrics, measures_in, swept_metrics, unusable_metrics
from experiments.recording.run_folder import RUNS, naming
from experiments.sweep import table
from experiments.sweep.plan import Axis, Cell, arguments, cells, compared, seeds_of
from experiments.sweep.runs import RunMetrics, code_of, lean_enough
from experiments.sweep.store import Store, StoreOrigin
from experiments.sweep.table import CellRow
from experiments.sweep.workers import Work, Workers, workers
from experiments.virtual_time import machine, stretch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_SEEDS: Final = 100  # seeds of one cell side by side: more are hardly faster, with larger steps of progress
SHARE: Final = 3  # least number of pieces of a worker's part, so that all end at about the same time
MOST_BYTES: Final = 2e8  # samples that one process logs
LEAN_BYTES, WHOLE_BYTES = 48.0, 340.0  # size of a sample of a robot
LONGEST: Final = 60  # letters of a folder's name that is made up here
AROUND_S: Final = 15.0  # take-off and landing are logged, too

Progress = Callable[[int, int], None]  # runs done, of how many


@dataclass(frozen=True)
class SweepResult:
    """Result of a sweep."""

    read: Document
    axes: tuple[Axis, ...]
    seeds: tuple[int, ...]  # seeds of the runs
    rows: tuple[CellRow, ...]  # the table
    failures: tuple[str, ...]  # reasons, each once
    missing: int  # runs not done, because the sweep was interrupted
    folder: Path  # folder of the runs
    notes: tuple[str, ...]  # remarks for the user
    metrics: Mapping[str, Metric]  # metrics of the table

    def __str__(self) -> str:
        """The table, as the command prints it."""
        return "\n".join(table.text(self.rows, self.metrics))

    def pareto(self, index: str = "") -> Figure:
        """Messages against an error, see `experiments.sweep.pareto`; IAE, or what stands in its place, if left out."""
        from experiments.sweep.pareto import pareto  # noqa: PLC0415 - matplotlib takes 0.6 s

        return pareto(self.rows, index or table.main_error(self.rows, self.metrics), metrics=self.metrics)


def sweep(
    file: str | Path,
    given: Sequence[str],
    *,
    settings: Sequence[str] = (),
    cases: Sequence[str] = (),
    out: str | Path | None = None,
    scheduler: str | None = None,
    processes: int | None = None,
    most_seeds: int = MOST_SEEDS,
    progress: Progress = lambda _done, _of: None,
) -> SweepResult:
    """Runs a sweep, or its missing runs; after Ctrl-C it returns the finished ones.

    Args:
        given: Axes and seeds, as on the command line.
        settings: As behind `--set`, for all cells.
        cases: Which cases; all if none is named. The first of the file is run in any case: it is the reference.
        out: Where runs are kept and looked for.
        scheduler: Address of a dask scheduler; None: on this machine.
        processes: On this machine; None: one for each core.
        most_seeds: Of one cell side by side in a process.
        progress: Called with the runs done, and their number.

    Raises:
        DocumentError: If the file or an argument is wrong.
        ExplainedError: If the workers are lost.
    """
    read = load(file, *settings)
    axes, words = arguments(given)
    if "tuning" in words:
        raise refusal(words["tuning"], "there is nothing to tune", 'add --optimise "messages, iae<=1.01"')
    for axis in axes:
        if not axis.values:
            raise refusal(axis.argument, "how many values?", f"write {axis.argument}12; --optimise needs no number")
    seeds = seeds_of(words.get("seeds"), read.experiment.seed)
    plan = cells(read, str(file), settings, axes, cases)
    folder = Path(out) if out is not None else folder_of(read, axes, "sweep")
    with naming(folder), Store(folder) as store:
        notes = store.changed_since(origin(read, [cell.plan for cell in plan]))
        if cases and (first := compared(read)) not in cases:
            notes.append(f"'{first}' runs as well: ratios are relative to it, the first case of the file")
        with workers(scheduler, processes) as working:
            runner = SweepRunner(store, working, most_seeds)
            with suppress(KeyboardInterrupt):  # what is done is kept
                runner.run_missing(plan, seeds, progress)
        metrics = runner.metrics(plan, seeds)
        rows = runner.rows(plan, seeds)
        failures = runner.failures(plan, seeds)
        notes += runner.metric_faults(plan, seeds)
        missing = sum(len(runner.missing(cell, seeds)) for cell in _distinct(plan))
    return SweepResult(read, tuple(axes), seeds, tuple(rows), failures, missing, folder, tuple(notes), metrics)


@dataclass
class SweepRunner:
    """Runs that are done, and the workers for the missing ones."""

    store: Store
    workers: Workers
    most_seeds: int = MOST_SEEDS

    def run_missing(
        self, plan: Sequence[Cell], seeds: Sequence[int], progress: Progress = lambda _done, _of: None
    ) -> None:
        """Does what is missing; Ctrl-C keeps what is done."""
        lacking = [(cell, self.missing(cell, seeds)) for cell in _distinct(plan)]
        total = sum(len(cell_seeds) for _, cell_seeds in lacking)
        if not total:
            return
        piece = max(1, math.ceil(total / (SHARE * self.workers.count())))
        plain_s, by_case = defaultdict[str, float](float), dict[str, list[Work]]()
        for cell, missing in lacking:
            plain_s[cell.case] += len(missing) * stretch.plain_s(cell.plan)
        for cell, missing in lacking:
            size = min(piece, self.most_seeds, side_by_side(cell.plan))
            code, case = code_of(cell.plan), document.write_json(cell.plan)
            by_case.setdefault(cell.case, []).extend(
                Work(cell.digest, case, tuple(missing[k : k + size]), code, plain_s[cell.case])
                for k in range(0, len(missing), size)
            )
        # cases in turn, so that each process compiles another one
        works = [work for turn in zip_longest(*by_case.values()) for work in turn if work is not None]
        done = 0
        machine.works()  # says once if not, and not in each process
        progress(0, total)
        for work, outcome in self.workers.done(works):
            self.store.add(work.cell, work.code, outcome)
            done += len(work.seeds)
            progress(done, total)

    def missing(self, cell: Cell, seeds: Sequence[int]) -> list[int]:
        """Seeds of a cell that are still to be done."""
        known = self._known(cell, seeds)
        return [seed for seed in seeds if seed not in known]

    def rows(self, plan: Sequence[Cell], seeds: Sequence[int]) -> list[CellRow]:
        """The cells of which anything is done."""
        by_digest, metrics = {cell.digest: cell for cell in plan}, self.metrics(plan, seeds)
        found = []
        for cell in plan:
            known, runs = self._known(cell, seeds), self._runs(cell, seeds)
            if known:
                reference = self._runs(by_digest[cell.reference], seeds)
                failed, missing = len(known) - len(runs), len(seeds) - len(known)
                found.append(table.row(cell, runs, reference, failed=failed, missing=missing, metrics=metrics))
        return found

    def metrics(self, plan: Sequence[Cell], seeds: Sequence[int]) -> dict[str, Metric]:
        """Metrics of the cells: of all sweeps, of their criteria, and measures of their laws."""
        found = swept_metrics({cell.digest: cell.plan for cell in plan}.values())
        values = {name for cell in _distinct(plan) for run in self._runs(cell, seeds).values() for name in run.values}
        return found | law_metrics(measures_in(sorted(values - {*found})))

    def failures(self, plan: Sequence[Cell], seeds: Sequence[int]) -> tuple[str, ...]:
        """Reasons of failed runs."""
        return tuple(
            f"{cell.case} {' '.join(f'{path}={value}' for path, value in cell.parameters.items())}, seed {seed}: {why}"
            for cell in _distinct(plan)
            for seed, why in self._known(cell, seeds).items()
            if isinstance(why, str)
        )

    def metric_faults(self, plan: Sequence[Cell], seeds: Sequence[int]) -> list[str]:
        """Metrics of other distributions that cannot be used or failed, each once."""
        runs = (run for cell in _distinct(plan) for run in self._runs(cell, seeds).values())
        return [*unusable_metrics(), *dict.fromkeys(text for run in runs for text in run.metric_faults)]

    def _known(self, cell: Cell, seeds: Sequence[int]) -> dict[int, RunMetrics | str]:
        known = self.store.known(cell.digest, code_of(cell.plan))
        return {seed: known[seed] for seed in seeds if seed in known}

    def _runs(self, cell: Cell, seeds: Sequence[int]) -> dict[int, RunMetrics]:
        return {seed: run for seed, run in self._known(cell, seeds).items() if not isinstance(run, str)}


def side_by_side(plan: Plan) -> int:
    """Seeds of an experiment that one process simulates side by side."""
    experiment = plan.experiment
    samples = (experiment.duration_s + AROUND_S) * experiment.rates.state_hz
    size = LEAN_BYTES if lean_enough(plan) else WHOLE_BYTES
    return max(1, min(MOST_SEEDS, int(MOST_BYTES / (size * samples * len(experiment.robots)))))


def folder_of(read: Document, axes: Sequence[Axis], what: str) -> Path:
    """Default folder of the runs: the same for the same file and axes; a long name is cut, and ends with its digest."""
    name = "-".join([read.path.stem, what, *(axis.path.replace("/", "_") for axis in axes)])
    return RUNS / (name if len(name) <= LONGEST else f"{name[: LONGEST - 9]}-{_digest(name)[:8]}")


def origin(read: Document, plans: Iterable[Plan]) -> StoreOrigin:
    """Origin of runs of this process."""
    codes = sorted({code_of(plan) for plan in plans})
    text = read.listing + document.write_json(read.plan).decode()
    return StoreOrigin(version("zenpark"), _digest("".join(codes)), _digest(text))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _distinct(plan: Sequence[Cell]) -> list[Cell]:
    """Cells that run the same only once."""
    return list({cell.digest: cell for cell in reversed(plan)}.values())[::-1]
