"""Work of one process of a sweep: simulates a case with some seeds, and keeps a few numbers of each run."""

from __future__ import annotations

import hashlib
import math
import statistics
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from agents.body.interface import BodyError
from agents.plugins import registry
from experiments.definition.experiment import Experiment
from experiments.definition.standby import without_standby
from experiments.file.structure import plugin_files
from experiments.metrics.measure import KNOWN, WINDOW_S, bounds_of, ended_early, failures
from experiments.metrics.signals import LinkErrors, integrals, leaders, transmission_gaps, transmissions
from experiments.recording.trace import Trace
from experiments.recording.version import ROOT, engine_versions
from experiments.recording.version import digest as digest_of_code
from experiments.virtual_time.conductor import Stuck
from experiments.virtual_time.log import Logbook
from experiments.virtual_time.simulation import simulate

PACKAGES: Final = ("agents", "twins", "experiments")  # whose code decides what a run comes to
FAILED: Final = (Stuck, BodyError, registry.PluginError)  # what a run may end with that other runs do not


class Figures(msgspec.Struct, frozen=True):
    """A run in numbers, the same to the bit as `experiments.metrics.measure.measure` makes of its whole trace."""

    seed: int  # of the run
    f_hz: float | None  # transmissions per second; this and the next five are means over robots, without leaders
    messages: float | None  # transmissions
    iae: float | None  # ∫ e dt [m s]; None where no error is known
    itae: float | None  # ∫ t·e dt [m s²]
    rmse: float | None  # √(mean e²) [m]
    # when its links were within the tolerance for good [s]; None if that is missing for any robot
    acquired_s: float | None
    gap_min_s: float | None  # shortest time between two transmissions of any robot [s]; None if none sent twice
    updates: float | None  # times that a goal was computed anew; a mean as those above
    dropped: int  # samples that the modelled network dropped on all links
    duration_s: float  # of the run [s]
    # what kept robots from their parts, or ended the run before its time; empty: nothing. Such a run has failed
    failure: str = ""


class WorkResult(msgspec.Struct, frozen=True):
    """Results of some seeds."""

    runs: list[Figures]  # that succeeded
    failed: dict[int, str] = {}  # reason by seed, of the others
    stranger: str = ""  # other digest of the code, or a missing plug-in: nothing was run


def fly(case: bytes, seeds: Sequence[int], code: str) -> bytes:
    """Simulates a case once for each seed.

    Args:
        case: An experiment as JSON.
        seeds: Of the runs.
        code: `code_of` the experiment in the process that distributes the work; nothing is run with other code.

    Returns:
        A `WorkResult` as JSON, runs in the order of the seeds.
    """
    try:
        experiment = msgspec.json.decode(case, type=Experiment)
        mine = code_of(experiment)
    except (msgspec.ValidationError, registry.PluginError) as error:  # on a machine with another version, or no plug-in
        return msgspec.json.encode(WorkResult([], stranger=str(error)))
    if mine != code:
        return msgspec.json.encode(WorkResult([], stranger=f"{mine}, not {code}"))
    runs, failed = _flown(without_standby(experiment), tuple(seeds))
    failed |= {run.seed: run.failure for run in runs if run.failure}
    whole = sorted((run for run in runs if not run.failure), key=lambda run: seeds.index(run.seed))
    return msgspec.json.encode(WorkResult(whole, failed))


def digest(experiment: Experiment) -> str:
    """The same for experiments that run in the same way: title, source, cases and the file's own seed are left out.

    Robots and links count in the order of the file, by which starts are drawn and sums are formed.
    """
    bare = msgspec.structs.replace(experiment, title="", source="", cases={}, seed=0)
    return hashlib.sha256(msgspec.json.encode(bare)).hexdigest()[:20]


def code_of(experiment: Experiment) -> str:
    """The same wherever runs of this experiment come to the same: our code, that of its plug-ins, and the versions of
    numpy and of the library of the engine, which has its name.

    Of a plug-in the module counts in which it stands; another module that it imports does not.
    """
    files = plugin_files(experiment)
    engine = registry.split(experiment.world.engine)[0]
    engines = [engine, *engine_versions(engine)]
    others = sorted(_file_digest(file) for file in files if file.parent.parent != ROOT)
    return hashlib.sha256(
        ":".join((digest_of_code(packages=PACKAGES), np.__version__, *engines, *others)).encode()
    ).hexdigest()[:20]


def _flown(experiment: Experiment, seeds: tuple[int, ...]) -> tuple[list[Figures], dict[int, str]]:
    """Figures of the runs of these seeds, and why others failed."""
    runs, failed = [], {}
    for seed in seeds:
        try:
            log = simulate(experiment, seed, lean=True)
        except FAILED as error:
            failed[seed] = str(error)
        else:
            runs.append(figures_of(Logbook(log, experiment, "").trace()))
    return runs, failed


def figures_of(trace: Trace) -> Figures:
    errors = LinkErrors.of_trace(trace)
    _, begin, end = bounds_of(trace)[0]
    window = max(1, round(WINDOW_S / float(trace.time[1] - trace.time[0])))
    acquired = errors.part(begin, end).acquired(window, trace.experiment.tolerance)
    sent = transmissions(trace)[0].astype(float)
    waits = [float(wait.min()) for wait in transmission_gaps(trace) if len(wait)]
    leading = leaders(trace)
    known = errors.known()
    kept = [i for i, name in enumerate(trace.robots) if name not in leading and known[i] >= KNOWN]
    iae, itae, rmse = (_mean(each[kept].tolist()) for each in integrals(errors.per_robot(), trace.time))
    arrived = [acquired[i] for i in kept]
    return Figures(
        seed=trace.seed,
        f_hz=_mean((sent[kept] / float(trace.time[-1] - trace.time[0])).tolist()),
        messages=_mean(sent[kept].tolist()),
        iae=iae,
        itae=itae,
        rmse=rmse,
        acquired_s=None if None in arrived else _mean([when for when in arrived if when is not None]),
        gap_min_s=min(waits, default=None),
        updates=_mean(trace.decisions[kept].astype(float).tolist()),
        dropped=0 if trace.dropped is None else int(trace.dropped.sum()),
        duration_s=float(trace.time[-1] - trace.time[0]),
        failure="; ".join(failures(trace, known.tolist())) or _early_end(trace),
    )


def _early_end(trace: Trace) -> str:
    """How much of its time a run took, if it ended early."""
    return f"ended at {trace.time[-1]:.1f} s of {trace.experiment.duration_s:g} s" if ended_early(trace) else ""


def _mean(values: Sequence[float]) -> float | None:
    """Mean of the known values; None without any."""
    known = [value for value in values if math.isfinite(value)]
    return statistics.fmean(known) if known else None


@cache
def _file_digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
