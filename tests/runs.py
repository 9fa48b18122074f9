"""Runs on the virtual clock, each flown once in a process of tests; nobody writes to what they share."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import msgspec

from experiments import run
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.metrics import measure
from experiments.metrics.results import CaseMetrics
from experiments.recording.run_folder import SOURCE
from experiments.recording.trace import Trace
from experiments.virtual_time import simulation
from experiments.virtual_time.log import RunRecorder, VirtualRunLog

FOLDERS = tempfile.TemporaryDirectory(prefix="zenpark-runs-")


@dataclass(frozen=True)
class Flown:
    """Log of a run, and what is derived from it."""

    plan: Plan
    log: VirtualRunLog
    case: str

    @cached_property
    def recorder(self) -> RunRecorder:
        return RunRecorder(self.log, self.plan, self.case)

    @cached_property
    def trace(self) -> Trace:
        return self.recorder.trace()

    @cached_property
    def metrics(self) -> CaseMetrics:
        return measure.measure(self.trace)


CACHE: dict[tuple[bytes, int, str], Flown] = {}


def fly(experiment: Experiment, seed: int = 1, case: str = "") -> Flown:
    """Run of an experiment."""
    key = msgspec.json.encode(experiment), seed, case
    if key not in CACHE:
        plan = Plan(experiment)
        CACHE[key] = Flown(plan, simulation.simulate(plan, seed), case)
    return CACHE[key]


@cache
def flown(name: str, case: str, *changes: str, seed: int | None = None) -> Flown:
    """Run of a case of a file or a catalogue name, with `--set` changes, and the seed of the file if none is given."""
    plan = document.load(name, *changes).cases()[case]
    return Flown(plan, simulation.simulate(plan, plan.experiment.seed if seed is None else seed), case)


@cache
def recorded(name: str, *changes: str, cases: tuple[str, ...] = ()) -> run.Run:
    """Run of a file or a catalogue name, with its recordings and its source in `run.folder`."""
    read, folder = document.load(name, *changes), Path(tempfile.mkdtemp(dir=FOLDERS.name))
    read.keep(folder / SOURCE)
    return run.simulate(read, cases=cases, folder=folder)
