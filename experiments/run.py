"""Runs experiments in virtual time, and reads back what any run has left: from Python and from the command line.

In a notebook:

    from experiments.run import load, simulate
    run = simulate(load("robotic-park", "cases.event.trigger.threshold=0.02"))
    run.traces["event"].true_position      # (T, N, 3) [m]
    run.metrics["event"].mean["iae"]
    run.figures()["errors"].savefig("errors.pdf")

An experiment may stand in the notebook itself: `loads` takes its text. `experiments.notebook` shows figures there.
"""

from __future__ import annotations

import itertools
import math
import shutil
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from experiments import document, metrics, playback, reserves, results, virtual
from experiments.document import Document
from experiments.experiment import Experiment
from experiments.logbook import Logbook
from experiments.measured import CaseMetrics
from experiments.problem import DocumentError, Problem
from experiments.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RUNS: Final = Path("runs")
SOURCE: Final = "experiment.toml"
MOST_SAMPLES: Final = 2e7  # states of one robot; each takes about 300 bytes


@dataclass(frozen=True)
class Run:
    """What a run leaves.

    Attributes:
        title: Of the experiment.
        seed: Of its noise.
        traces: What happened, per case.
        metrics: What it comes to, per case.
        folder: Where the recordings are; None if none were made.
        source: The experiment file.
        notes: What the reader should know: robots lost, a damaged recording, a case that never began.
        made: When, UTC [s].
    """

    title: str
    seed: int
    traces: dict[str, Trace]
    metrics: dict[str, CaseMetrics]
    folder: Path | None = None
    source: str = ""
    notes: tuple[str, ...] = ()
    made: float = field(default_factory=time.time)

    def figures(self) -> dict[str, Figure]:
        """The figures of the report, by name."""
        from experiments import figures, shadow_figures  # noqa: PLC0415 - matplotlib takes 0.6 s

        traces = list(self.traces.values())
        return figures.every(list(self.metrics.values()), traces) | shadow_figures.every(traces)

    def summary(self) -> dict[str, Any]:
        """The figures for scripts, as `zenpark run --json` prints them."""
        return results.document(str(self.folder or ""), self.seed, list(self.metrics.values()))


def load(file: str | Path, *changes: str) -> Document:
    """An experiment by its file or its name in the catalogue, with fields changed as behind `--set`.

    Raises:
        DocumentError: With everything that is wrong and where.
    """
    return document.read(file, changes)


def loads(text: str, *changes: str) -> Document:
    """As `load`, of an experiment that is written where it is used, in a notebook or a script.

    Raises:
        DocumentError: With everything that is wrong and where.
    """
    return document.read_text(text, changes)


def chosen(read: Document, names: Sequence[str] = ()) -> dict[str, Experiment]:
    """The cases of an experiment, all or those named, in the order of the file.

    Raises:
        DocumentError: If it has no case of that name.
    """
    cases = read.cases()
    for name in names:
        if name not in cases:
            hint = f"its cases: {', '.join(cases)}"
            raise DocumentError([Problem(f"--case {name}", 0, 0, "no such case in this experiment", hint)])
    return {name: case for name, case in cases.items() if not names or name in names}


Told = Callable[[str, int, int], None]  # a case, seconds of it that are simulated, and how many it has


def simulate(read: Document, *, cases: Sequence[str] = (), seed: int | None = None, folder: Path | None = None) -> Run:
    """Runs an experiment in virtual time.

    Args:
        read: The experiment.
        cases: Which of its cases; all if none is named.
        seed: Of the noise; the file's if left out.
        folder: Where recordings go; None: none are made.

    Raises:
        Stuck: If robots do not become ready, airborne or done.
        RecordingError: If a recording cannot be written.
    """
    return simulate_seeds(read, [read.experiment.seed if seed is None else seed], cases=cases, folder=folder)[0]


def simulate_seeds(
    read: Document,
    seeds: Sequence[int],
    *,
    cases: Sequence[str] = (),
    folder: Path | None = None,
    tell: Told = lambda *_: None,
) -> list[Run]:
    """As `simulate`, once for each seed, side by side; recordings are made of the first seed only.

    `tell` is called again and again with how far it is.
    """
    _refuse_too_much(read.experiment, len(seeds))
    traces: list[dict[str, Trace]] = [{} for _ in seeds]
    for name, experiment in chosen(read, cases).items():
        experiment = reserves.taking_part(experiment)  # noqa: PLW2901
        log = virtual.simulate(experiment, seeds, tell=partial(_pass_on, tell, name, experiment.duration_s))
        _pass_on(tell, name, experiment.duration_s, math.inf)
        for copy in range(len(seeds)):
            logbook = Logbook(log, experiment, name, copy)
            traces[copy][name] = logbook.trace()
            if folder is not None and copy == 0:
                logbook.record(folder / f"{name}.mcap", read.text)
    return [_measured(read.experiment.title, mine, folder, read.listing) for mine in traces]


def _refuse_too_much(experiment: Experiment, seeds: int) -> None:
    """Raises DocumentError for a run in virtual time that no memory holds."""
    samples = experiment.duration_s * experiment.rates.state_hz * len(experiment.robots) * seeds
    if samples > MOST_SAMPLES:
        message = f"a run in virtual time of {samples:.2g} samples; {MOST_SAMPLES:.0e} fit into memory"
        hint = (
            "take fewer --seeds (`zenpark sweep` runs any number, cell by cell), a lower rates.state_hz or duration_s"
        )
        raise DocumentError([Problem("--seeds" if seeds > 1 else "duration_s", 0, 0, message, hint)])


def _pass_on(tell: Told, case: str, duration_s: float, elapsed: float) -> None:
    tell(case, int(min(elapsed, duration_s)) if elapsed > 0.0 else 0, math.ceil(duration_s))


def reopen(folder: Path) -> Run:
    """The run in a folder, read back from its recordings; without traces if no case had begun.

    Raises:
        RecordingError: If there is no recording, or one cannot be read.
    """
    from experiments.records import RecordingError  # noqa: PLC0415

    if not folder.is_dir():
        raise RecordingError(f"{folder}: is no folder of a run; `zenpark run` prints the folder that it makes")
    files = sorted(folder.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
    if not files:
        raise RecordingError(f"{folder}: holds no recording (.mcap); name the folder of a run")
    return read_back(folder, {file.stem: file for file in files}, [])


def read_back(folder: Path, recordings: Mapping[str, Path], notes: Sequence[str]) -> Run:
    """A run from its recordings, by case; those of killed recorders too, as far as they go.

    Raises:
        RecordingError: If one cannot be read.
    """
    traces: dict[str, Trace] = {}
    remarks, made = list(notes), []
    for case, file in recordings.items():
        try:
            played = playback.read(file)
        except playback.NotStarted as nothing:
            remarks.append(f"{case}: {nothing}")
            continue
        traces[played.trace.case] = played.trace
        made.append(played.started if played.trace.clock == "real" else file.stat().st_mtime)
        if not played.complete:
            remarks.append(f"{case}: the recording was cut off; `zenpark recover {file}` mends it")
    source = folder / SOURCE
    arenas = sorted(set(folder.glob("*.toml")) - {source}) if source.exists() else []
    text = document.listed([file.read_text("utf-8") for file in [source, *arenas]]) if source.exists() else ""
    title = next((trace.experiment.title for trace in traces.values()), "")
    return replace(_measured(title, traces, folder, text, remarks), made=min(made, default=0.0))


def _measured(
    title: str, traces: Mapping[str, Trace], folder: Path | None, source: str, notes: Sequence[str] = ()
) -> Run:
    measured = {case: metrics.measure(trace) for case, trace in traces.items()}
    seed = next((trace.seed for trace in traces.values()), 0)
    return Run(title, seed, dict(traces), measured, folder, source, tuple(notes))


def new_folder(read: Document, out: str | None) -> Path:
    """Makes the folder of a run: `out`, or one below `runs` that tells experiment and time.

    Raises:
        DocumentError: If it holds something already, or cannot be made.
    """
    folder = RUNS if out is None else Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if out is None:
            return _folder_of_now(folder, read.path.stem)
        taken = any(folder.iterdir())
    except OSError as error:
        hint = "choose a place that may be written to with --out"
        raise DocumentError([Problem(str(folder), 0, 0, f"cannot be made: {error.strerror}", hint)]) from None
    if taken:
        raise DocumentError([Problem(str(folder), 0, 0, "holds something already", "name a new folder with --out")])
    return folder


def _folder_of_now(runs: Path, name: str) -> Path:
    """Makes a folder that nobody else has, however many runs begin in the same second."""
    stamp = datetime.now().astimezone().strftime("%Y-%m-%dT%H-%M-%S")
    for number in itertools.count(1):
        folder = runs / (f"{name}-{stamp}" if number == 1 else f"{name}-{stamp}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError


def remove_unused(folder: Path) -> None:
    """Removes the folder of a run in which nothing was run: there is no recording, and no process has said anything."""
    if not any(folder.glob("*.mcap")) and not any(folder.glob("logs/*")):
        shutil.rmtree(folder, ignore_errors=True)


class Interrupts:
    """Ctrl-C, SIGTERM and SIGHUP as a question: the first asks to land, the second ends at once.

    A SIGHUP that `nohup` has set aside stays so.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.asked

    def _ask(self, _signal: int, _frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
