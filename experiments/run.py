"""Runs from Python: simulate an experiment, reopen a folder, show figures in a notebook.

from experiments.run import show
show(run.figures()["errors"], "figures/errors")     # the last line of a cell: shown below it, and kept as a file
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from agents.errors import ExplainedError
from agents.plugins.files import plain
from experiments.arrays import data_frame
from experiments.cores import KILLED, cores, pool
from experiments.definition import standby
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import Document, chosen
from experiments.file.problems import refusal
from experiments.metrics import comparable, measure
from experiments.metrics.results import CaseMetrics
from experiments.recording import playback
from experiments.recording.cleaning import in_use, using
from experiments.recording.reader import RecordingError
from experiments.recording.run_folder import (
    METRICS,
    SOURCE,
    SWEEP,
    RunOrigin,
    case_figures,
    differences_from_first,
    keep_origin,
    new_folder,
    read_origin,
    remove_unused,
)
from experiments.recording.trace import Trace
from experiments.recording.version import provenance
from experiments.report import metrics_files
from experiments.report.page import date_of
from experiments.virtual_time import simulation, stretch
from experiments.virtual_time.log import RunRecorder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECKOUT: Final = Path(__file__).resolve().parents[1]


def show(figure: Figure, file: str | Path) -> Figure:
    """A figure for the end of a cell, which shows it if it is a `style.Drawing`; kept as `file`.svg and .pdf."""
    from experiments.report import style  # noqa: PLC0415 - matplotlib takes 0.6 s

    style.save(figure, Path(file).parent, Path(file).name, pdf=True)
    return figure


def folder(default: str) -> Path:
    """Folder for the figures of a script: its first argument; `default` if there is none, and in a notebook.

    Args:
        default: From the checkout, wherever the script or the notebook was started.
    """
    given = [] if "ipykernel" in sys.modules else sys.argv[1:]  # a kernel's arguments are its own
    return Path(given[0]) if given else CHECKOUT / default


SHARED: Final = 1e6  # robot ticks that are shared between processes, which take a second or two to begin
MOST_SAMPLES: Final = 2e7  # states of one robot; each takes about 300 bytes


class FigureSet(dict[str, "Figure"]):
    """Figures by name, which a notebook shows one below the other."""

    def _repr_html_(self) -> str:
        from experiments.report import style  # noqa: PLC0415 - matplotlib takes 0.6 s

        return "".join(f"<p>{name}</p>{style.svg(figure)}" for name, figure in self.items())


@dataclass(frozen=True, repr=False)
class Run:
    """Results of a run."""

    title: str  # title of the experiment
    seed: int  # seed of the noise
    traces: dict[str, Trace]  # traces by case
    metrics: dict[str, CaseMetrics]  # metrics by case
    folder: Path | None = None  # folder of the recordings; None if none were made
    source: str = ""  # text of the experiment file
    notes: tuple[str, ...] = ()  # robots lost, a damaged recording, a case that never began
    made: float = field(default_factory=time.time)  # [s] UTC

    def figures(self, width: float = 3.5) -> FigureSet:
        """The figures of the report by name, `width` [in] wide: 3.5 for one column, 7.16 for a whole page."""
        from experiments.report import figures  # noqa: PLC0415 - matplotlib takes 0.6 s

        return FigureSet(figures.all_figures(list(self.metrics.values()), list(self.traces.values()), width))

    def __repr__(self) -> str:
        where = f" in {self.folder}" if self.folder else ""
        alone = next((f"; {note}" for note in self.notes if note.startswith(ALONE)), "")
        return f"<Run of {self.title!r}, seed {self.seed}, cases {', '.join(self.traces) or 'none'}{where}{alone}>"

    def _repr_html_(self) -> str:
        """Verdict and table of the report, at the end of a cell."""
        from experiments.report import page, tables, verdict  # noqa: PLC0415 - for people alone

        cases = list(self.metrics.values())
        found = [*verdict.findings(cases), *(page.VerdictLine("fair", note) for note in self.notes)] if cases else []
        return page.fragment(self.title, found, [tables.summary_table(cases)] if cases else [])

    def to_frame(self) -> Any:  # noqa: ANN401 - of pandas or of polars
        """Metrics as a data frame of pandas, or of polars where only that is installed: a row per case and robot.

        Columns are those of `metrics.csv`; an unknown number is NaN, in polars null. Raises ImportError if neither is
        installed.
        """
        rows = list(metrics_files.rows(list(self.metrics.values())))
        return data_frame({name: _column([row[name] for row in rows]) for name in (rows[0] if rows else ())})

    def summary(self) -> dict[str, Any]:
        """The figures for scripts, as `./zenpark run --json` prints them."""
        return metrics_files.document(str(self.folder or ""), self.seed, list(self.metrics.values()))


def _column(values: Sequence[Any]) -> list[Any]:
    """Values of a column: numbers of one type, which for unknown ones is float; texts as they are."""
    if any(isinstance(value, str) for value in values) or all(isinstance(value, int) for value in values):
        return list(values)
    return [math.nan if value is None else float(value) for value in values]


Progress = Callable[[str, int, int], None]  # case, simulated seconds, seconds in all


def simulate(
    read: Document, *, cases: Sequence[str] = (), seed: int | None = None, folder: str | Path | None = None
) -> Run:
    """Runs an experiment in virtual time.

    Args:
        cases: Which of its cases; all if none is named.
        seed: Of the noise; the file's if left out.
        folder: Where recordings go, made if it does not exist; None: none are made.

    Raises:
        Stuck: If robots do not become ready, airborne or done.
        RecordingError: If a recording cannot be written.
    """
    return simulate_seeds(read, [read.experiment.seed if seed is None else seed], cases=cases, folder=folder)[0]


def fly(
    read: Document, *, cases: Sequence[str] = (), folder: str | Path | None = None, bodies: str | None = None
) -> Run:
    """Runs an experiment in real time, with simulated bodies: a process for each robot, as `./zenpark run`.

    Its file goes into the folder, with the Python files that it names. A law of a notebook's cell is such a file, too,
    as a printed line says. Ctrl-C, or the notebook's button, lets all robots land; a second one ends the run at once.

    Args:
        cases: Which of its cases; all if none is named.
        folder: Folder of the results; a new one below `runs` if left out.
        bodies: "twin", "world" or "protocol" in place of the file's bodies.

    Raises:
        DocumentError: If the check finds errors, for real robots or other machines, a case that is none, and a folder
            that holds something.
        RunFailed: If robots are not ready in time.
    """
    # simulations need no network
    from agents.runtime.command_line import interrupts  # noqa: PLC0415
    from experiments.check.check import check  # noqa: PLC0415
    from experiments.real_time.conductor.conduct import (  # noqa: PLC0415
        RunOptions,
        Supervision,
        conduct,
        hardware,
        with_bodies,
    )

    options = RunOptions(cases, bodies)
    if read.experiment.hosts or any(hardware(with_bodies(read, options).values()).values()):
        hint = 'write the law with `law_file`, then `./zenpark run FILE` in a terminal; or give bodies="twin"'
        raise refusal(str(read.path), "real robots and other machines are not for a notebook", hint)
    if errors := [str(each) for each in check(read, cases) if each.severity == "error"]:
        raise refusal(str(read.path), errors[0], f"`check` says more: {len(errors)} in all")
    place = new_folder(read, None if folder is None else str(Path(folder).expanduser()))
    begun, changes = time.time(), [plain(each.flag) for each in read.source.overrides]
    origin = RunOrigin(file=str(read.path), cases=[*cases], changes=changes, bodies=bodies, begun=begun,
                       title=read.experiment.title, date=date_of(begun), made_by=provenance(read.text))  # fmt: skip
    try:
        read.keep(place / SOURCE)
        keep_origin(place, origin)
        for name in sorted({plain(choice).partition(":")[0] for choice in read.plugins}):
            print(f"{place / name}: what flies of this file")
        with using(place), interrupts() as interrupted:
            user = Supervision(nullcontext(lambda _: None), interrupted, tell=lambda lines: print(*lines, sep="\n"))
            ended = conduct(read, place, options, user)
        keep_origin(place, msgspec.structs.replace(origin, ended=time.time(), failures=ended.failures))
        run = read_back(place, ended.recordings, ended.notes, ended.failures)
        metrics_files.write_json(place / METRICS, [*run.metrics.values()])
        return run
    finally:
        remove_unused(place)


class Unrecorded(RecordingError):
    """Recordings that the disk did not take; `runs` have all figures."""

    def __init__(self, why: str, runs: list[Run]) -> None:
        super().__init__(why)
        self.runs = runs


def simulate_seeds(
    read: Document,
    seeds: Sequence[int],
    *,
    cases: Sequence[str] = (),
    folder: str | Path | None = None,
    processes: int | None = None,
    progress: Progress = lambda *_: None,
) -> list[Run]:
    """As `simulate`, once for each seed; recordings are made of the first seed only.

    Many seeds are shared between processes (as many as this machine has cores), which import the script: there under
    `if __name__ == "__main__"`. `progress` is called repeatedly. Raises Unrecorded, at the end, for recordings that a
    disk did not take.
    """
    unrecorded = ""
    _refuse_too_much(read.plan, len(seeds))
    folder = None if folder is None else Path(folder).expanduser()
    if folder is not None:
        with suppress(OSError):  # the recording says so
            folder.mkdir(parents=True, exist_ok=True)
    works = {name: standby.without_standby(case) for name, case in chosen(read, cases).items()}
    runs = [Run(read.experiment.title, seed, {}, {}, folder, read.listing) for seed in seeds]
    first, *others = runs
    expected_s = {name: len(seeds) * stretch.plain_s(plan) for name, plan in works.items()}
    count = min(_profitable_processes(works, len(others)) if processes is None else processes, len(works) * len(others))
    with pool(count) as workers:
        shared = dict[tuple[str, int], Future[Flown]]()
        if workers is not None:
            for name, run in product(works, others):
                shared[name, run.seed] = workers.submit(_flown, name, works[name], run.seed, expected_s[name])
        for name, plan in works.items():
            duration_s = plan.experiment.duration_s
            stretch.expect(expected_s[name])
            passing = partial(_pass_progress, progress, name, duration_s)
            log = simulation.simulate(plan, first.seed, progress=passing)
            logbook = RunRecorder(log, plan, name)
            first.traces[name] = logbook.trace()
            first.metrics[name] = measure.measure(first.traces[name])
            if folder is not None:
                file = folder / f"{name}.mcap"
                try:
                    logbook.record(file, read.text)
                except RecordingError as error:
                    if not isinstance(error.__cause__, OSError):
                        raise
                    file.unlink(missing_ok=True)  # a part of it is of no use, and figures may need the room
                    unrecorded = unrecorded or f"{file}: cannot be written: {error.__cause__.strerror}"
            for number, run in enumerate(others, 2):
                future = shared.get((name, run.seed))
                found = _flown(name, plan, run.seed, expected_s[name], passing) if future is None else _result(future)
                run.traces[name], run.metrics[name] = found
                passing(duration_s * number / len(seeds))
            passing(math.inf)
    stretch.expect(0.0)
    if unrecorded:
        raise Unrecorded(f"{unrecorded}; make room there, or choose another place", runs)
    return runs


Flown = tuple[Trace, CaseMetrics]


def _flown(
    name: str, plan: Plan, seed: int, expected_s: float, progress: Callable[[float], object] = lambda _: None
) -> Flown:
    """Trace and metrics of a run of a case; `expected_s`: about what all its runs would take in plain Python [s]."""
    stretch.expect(expected_s)
    trace = RunRecorder(simulation.simulate(plan, seed, progress=progress), plan, name).trace()
    return trace, measure.measure(trace)


def _result(future: Future[Flown]) -> Flown:
    """Run of another process; raises ExplainedError if it was killed."""
    try:
        return future.result()
    except BrokenProcessPool:
        raise ExplainedError(f"a process of the run {KILLED}: take fewer --seeds, or `./zenpark sweep`") from None


def _profitable_processes(works: Mapping[str, Plan], seeds: int) -> int:
    """Number of processes for `seeds` more seeds of these cases; 1 if starting them would take longer."""
    ticks = sum(plan.experiment.duration_s * plan.experiment.rates.body_hz * len(plan.names) for plan in works.values())
    return 1 if seeds * ticks < SHARED else cores()


def _refuse_too_much(plan: Plan, seeds: int) -> None:
    """Raises DocumentError for a run in virtual time that no memory holds."""
    experiment = plan.experiment
    samples = experiment.duration_s * experiment.rates.state_hz * len(experiment.robots) * seeds
    if samples > MOST_SAMPLES:
        message = f"a run in virtual time of {samples:.2g} samples; {MOST_SAMPLES:.0e} fit into memory"
        hint = "take fewer --seeds (`./zenpark sweep` runs any number), a lower rates.state_hz or duration_s"
        raise refusal("--seeds" if seeds > 1 else "duration_s", message, hint)


def _pass_progress(progress: Progress, case: str, duration_s: float, elapsed: float) -> None:
    progress(case, int(min(elapsed, duration_s)) if elapsed > 0.0 else 0, math.ceil(duration_s))


ALONE: Final = "this is seed"


def reopen(folder: str | Path) -> Run:
    """The run in a folder, read back from its recordings; without traces if no case had begun.

    Raises RecordingError if there is no recording, or one cannot be read.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is no folder of a run; `./zenpark run` prints the folder that it makes")
    if in_use(folder):
        raise RecordingError(
            f"{folder}: this run is still up, and has its report at its end; `./zenpark view {folder}` shows it now"
        )
    figures = case_figures(folder / METRICS)
    order = [each.case for each in figures]  # a copy's files have other times
    files = sorted(folder.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
    files.sort(key=lambda file: order.index(file.stem) if file.stem in order else len(order))
    if not files:
        of_sweep = f"is that of a sweep, which keeps no recordings; `./zenpark report {folder}` draws its figures"
        what = of_sweep if (folder / SWEEP).is_file() else "holds no recording (.mcap); name the folder of a run"
        raise RecordingError(f"{folder}: {what}")
    failures = origin.failures if (origin := read_origin(folder)) else []
    found = read_back(folder, {file.stem: file for file in files}, [], failures)
    seeds = {each.seed for each in figures}
    if len(seeds) > 1:
        note = f"{ALONE} {found.seed} of {len(seeds)}: of the others metrics are kept, `reopen_seeds` gives them"
        return replace(found, notes=(*found.notes, note))
    return found


def reopen_seeds(folder: str | Path) -> list[Run]:
    """As `reopen`, and of seeds that were not recorded the metrics that the folder keeps, as runs without traces.

    Raises RecordingError if there is no recording, one cannot be read, or the metrics of another seed cannot.
    """
    recorded = reopen(folder)
    file = Path(folder) / METRICS
    seeds = list(dict.fromkeys(each.seed for each in case_figures(file)))
    asked = origin.seeds if (origin := read_origin(Path(folder))) else 1
    if not {*seeds} - {recorded.seed}:
        note = f"{asked} seeds were to be run; what is kept is of seed {recorded.seed} alone"
        return [replace(recorded, notes=(*recorded.notes, note)) if asked > 1 else recorded]
    try:
        kept = metrics_files.read_json(file)
    except ValueError as error:
        why = f"was written by another version ({error}), and most of its seeds are not recorded"
        raise RecordingError(f"{file}: {why}; repeat the run, or keep this report") from None
    recorded = replace(recorded, notes=tuple(note for note in recorded.notes if not note.startswith(ALONE)))
    runs = {seed: Run(recorded.title, seed, {}, {}, recorded.folder, recorded.source) for seed in seeds}
    for case in kept:
        runs[case.seed].metrics[case.case] = case
    return [recorded, *(run for seed, run in runs.items() if seed != recorded.seed)]


def read_metrics(folder: str | Path) -> list[CaseMetrics]:
    """Metrics of all cases and seeds of a run, as its folder keeps them; of another version, from its recordings.

    Raises RecordingError as `reopen_seeds`.
    """
    try:
        return metrics_files.read_json(Path(folder) / METRICS)
    except (OSError, ValueError):
        return [case for run in reopen_seeds(folder) for case in run.metrics.values()]


def pool_seeds(folders: Sequence[str], read: Sequence[Sequence[Run]]) -> list[Run]:
    """Seeds of several runs, by folder, as those of one, with the cases that all of them have.

    Raises DocumentError if experiments, clocks or bodies differ, or a seed is there twice.
    """
    every = [run for seeds in read for run in seeds]
    for folder, runs_of_one in zip(folders, read, strict=True):
        for each in (case for run in runs_of_one for case in run.metrics.values()):
            if each.interrupted or each.spoiled:
                early = [f"{each.duration_s:.1f} s of {each.planned_s:g} s"] if each.interrupted else []
                why = f"{each.case}, seed {each.seed}: {'; '.join([*early, *each.spoiled])}"
                raise refusal(folder, f"is no whole run that nothing spoiled ({why})", "repeat it, or leave it out")
    cases = [case for case in every[0].metrics if all(case in run.metrics for run in every)]
    first = {case: read[0][0].traces[case] for case in cases}
    for folder, (run, *_) in zip(folders, read, strict=True):
        for case, trace in first.items():
            same = run.traces[case]
            if same.plan.changed(seed=0) != trace.plan.changed(seed=0):
                hint = f"compare them without --pool: `./zenpark report {folders[0]} {folder}`"
                raise refusal(folder, f"differs from {folders[0]} in more than its seed", hint)
            if same.clock != trace.clock:
                raise refusal(folder, f"is of {same.clock} time, {folders[0]} of {trace.clock} time", "pool them apart")
    seeds = [run.seed for run in every]
    if twice := sorted({seed for seed in seeds if seeds.count(seed) > 1}):
        raise refusal("--pool", f"seed {twice[0]} is there twice", "give each run a --seed of its own")
    if not cases:
        raise refusal("--pool", "no case is in all of these runs", "run the same cases")
    left = dict.fromkeys(case for run in every for case in run.metrics if case not in cases)
    notes = [f"Of {len(folders)} runs together: {', '.join(folders)}."]
    notes += [f"Left out, because it is not in all of them: {', '.join(left)}."] if left else []
    for _, folder, found in differences_from_first(folders, folders):
        notes += [f"{folder}: {each}" for each in found if each.startswith("made with")]

    def alone(run: Run) -> Run:
        kept = {case: run.traces[case] for case in cases if case in run.traces}
        return replace(run, traces=kept, metrics={case: run.metrics[case] for case in cases}, folder=None)

    runs = [alone(run) for run in every]
    return [replace(runs[0], notes=(*notes, *runs[0].notes)), *runs[1:]]


def read_back(folder: Path, recordings: Mapping[str, Path], notes: Sequence[str], failures: Sequence[str] = ()) -> Run:
    """A run from its recordings, by case; those of killed recorders too, as far as they go.

    Args:
        failures: What the conductor knows to have failed, each with its case in front.
    """
    traces: dict[str, Trace] = {}
    remarks, made = list(notes), []
    for case, file in recordings.items():
        try:
            played = playback.read(file)
        except playback.NotStarted as nothing:
            remarks.append(f"{case}: {nothing}")
            continue
        if (name := played.trace.case) in traces:
            remarks.append(f"{name}: several recordings are of this case; shown is {file.name}")
        traces[name] = played.trace
        made.append(played.started if played.trace.clock == "real" else file.stat().st_mtime)
        if played.damaged:
            remarks.append(
                f"{case}: {played.damaged} bytes of the recording are damaged, and what was in them is missing"
            )
        elif not played.complete:
            remarks.append(f"{case}: the recording was cut off; `./zenpark export {file}` mends it")
    if len({trace.seed for trace in traces.values()}) > 1:
        seeds = ", ".join(f"{case} {trace.seed}" for case, trace in traces.items())
        remarks.append(f"the recordings are of different seeds: {seeds}")
    metrics = {}
    for case, trace in traces.items():
        of_case = [each.removeprefix(f"{case}: ") for each in failures if each.startswith(f"{case}: ")]
        metrics[case] = comparable.with_failures(measure.measure(trace), of_case)
    source, first = folder / SOURCE, next(iter(traces.values()), None)
    files = [source, *sorted(set(folder.glob("*.toml")) - {source})] if source.exists() else []
    text = document.join_texts([file.read_text("utf-8") for file in files])
    title, seed = ("", 0) if first is None else (first.plan.experiment.title, first.seed)
    return Run(title, seed, traces, metrics, folder, text, tuple(remarks), min(made, default=0.0))
