"""Work of one process of a sweep: simulates a case with some seeds, and keeps a few numbers of each run."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from functools import cache
from inspect import getfile
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from agents.body.interface import BodyError
from agents.plugins import registry
from experiments.definition.plan import Plan
from experiments.definition.standby import without_standby
from experiments.file.choices import plugin_files, tables
from experiments.metrics.measure import ended_early, failures
from experiments.metrics.metric import (
    LEAN,
    case_values,
    foreign_metrics,
    law_metrics,
    measures_of,
    metrics_of,
    swept_metrics,
    values_of,
)
from experiments.metrics.signals import Measurement
from experiments.recording.trace import Trace
from experiments.recording.version import ROOT, engine_versions, file_digest
from experiments.virtual_time import stretch
from experiments.virtual_time.conductor import Stuck
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate

# modules that no line imports because they are, or may be, plug-ins
PLUG_INS: Final = ("agents/**/*.py", "twins/**/*.py", "bridges/*/kind.py", "bridges/*/mujoco/*.py")
WORK: Final = "experiments/sweep/runs.py"  # this module: with what it imports, all other code that determines results
# modules that draw a run or write it down: no figure depends on them
DRAWING: Final = ("experiments/scene/", "experiments/recording/writer.py", "experiments/recording/ros2/")
_IMPORT: Final = re.compile(r"^\s*(?:from\s+([\w.]+)\s+)?import\s+(\([^)]*\)|.*)", re.MULTILINE)
_COMMENT: Final = re.compile(r"\n?[^\S\n]*#[^\"'\n]*$|\n(?=\n)", re.MULTILINE)  # comments and blank lines
FAILED: Final = (Stuck, BodyError, registry.PluginError)  # what a run may end with that other runs do not


class RunMetrics(msgspec.Struct, frozen=True):
    """A run in numbers, the same to the bit as `experiments.metrics.measure.measure` makes of its whole trace."""

    seed: int  # seed of the run
    # `swept_metrics` of the case: means over robots without leaders, sums over all robots
    values: dict[str, float | None] = {}
    gap_min_s: float | None = None  # shortest time between two transmissions of any robot [s]; None if none sent twice
    duration_s: float = 0.0  # length of the run [s]
    # what kept robots from their parts, or ended the run before its time; empty: nothing. Such a run has failed
    failure: str = ""
    metric_faults: tuple[str, ...] = ()  # metrics that failed, a sentence each


class WorkResult(msgspec.Struct, frozen=True):
    """Results of some seeds."""

    runs: list[RunMetrics]  # runs that succeeded
    failed: dict[int, str] = {}  # reason by seed, of the others
    stranger: str = ""  # other digest of the code, or a missing plug-in: nothing was run


def fly(case: bytes, seeds: Sequence[int], code: str, plain_s: float = 0.0) -> bytes:
    """Simulates a case once for each seed.

    Args:
        case: An experiment as JSON.
        seeds: Of the runs.
        code: `code_of` the experiment in the process that distributes the work; nothing is run with other code.
        plain_s: Seconds that all runs of the sweep that are like these would take in plain Python, about.

    Returns:
        A `WorkResult` as JSON, runs in the order of the seeds.
    """
    try:
        plan = Plan.decoded(case)
        local = code_of(plan)
    except (msgspec.ValidationError, registry.PluginError) as error:  # another version made it, or a plug-in is missing
        return msgspec.json.encode(WorkResult([], stranger=str(error)))
    if local != code:
        return msgspec.json.encode(WorkResult([], stranger=f"{local}, not {code}"))
    stretch.expect(plain_s)
    runs, failed = fly_seeds(without_standby(plan), tuple(seeds))
    failed |= {run.seed: run.failure for run in runs if run.failure}
    whole = sorted((run for run in runs if not run.failure), key=lambda run: seeds.index(run.seed))
    return msgspec.json.encode(WorkResult(whole, failed))


def digest(plan: Plan) -> str:
    """Digest of an experiment without title, source, cases, criteria, metrics and seed.

    A file that spells out a default has the same. Robots and links keep the order of the file, which decides random
    starts and sums.
    """
    bare = plan.changed(title="", source="", cases={}, criteria=[], metrics=[], seed=0)
    return hashlib.sha256(msgspec.json.encode(tables(bare.experiment, uniform=True))).hexdigest()[:20]


def code_of(plan: Plan) -> str:
    """Digest of everything that determines the result: our code, modules of plug-ins and metrics, library versions.

    The libraries are numpy, that of the engine, which has its name, and that of the law or the trigger. Of a plug-in
    only its own module counts, not other modules that it imports.
    """
    files, library = plugin_files(plan), plan.law.LIBRARY or plan.trigger.LIBRARY
    engine = plan.engine_name
    libraries = [engine, *engine_versions(engine), *(engine_versions(library) if library else [])]
    others = sorted(file_digest(file) for file in files if file.parent.parent != ROOT)
    added = foreign_metrics() | metrics_of(plan)[0]
    others += [f"{name} {file_digest(Path(getfile(type(each))))}" for name, each in added.items()]
    return hashlib.sha256(":".join((digest_of_code(), np.__version__, *libraries, *others)).encode()).hexdigest()[:20]


@cache
def digest_of_code(root: Path = ROOT) -> str:
    """Digest of our modules that determine results, without their comments; none of reports, scenes and recordings."""
    total, seen = hashlib.sha256(), set[str]()  # names, since paths are slow
    left = [WORK, *(file.relative_to(root).as_posix() for pattern in PLUG_INS for file in root.glob(pattern))]
    texts = dict[str, str]()
    while left:
        name = left.pop()
        if name in seen or name.startswith(DRAWING):
            continue
        seen.add(name)
        if not (file := root / name).is_file():
            continue
        texts[name] = text = without_comments(file.read_text("utf-8"))
        for package, names in _IMPORT.findall(text):
            modules = (package, *(f"{package}.{each}".strip(".") for each in re.findall(r"[\w.]+", names)))
            for place in (module.replace(".", "/") for module in modules if module):
                left += [f"{place}.py", f"{place}/__init__.py"]
    for name, text in sorted(texts.items()):
        total.update(f"{name}\0{len(text)}\0{text}".encode())
    return total.hexdigest()


def without_comments(text: str) -> str:
    """A module without its comments, except those with quotes, and without blank lines."""
    parts = text.split('"""')
    parts[::2] = [_COMMENT.sub("", part) for part in parts[::2]]  # docstrings and other texts stand between them
    return '"""'.join(parts)


def lean_enough(plan: Plan) -> bool:
    """Whether a lean log has all that the metrics need."""
    return all(LEAN.issuperset(each.needs) for each in swept_metrics([plan]).values())


def fly_seeds(plan: Plan, seeds: tuple[int, ...]) -> tuple[list[RunMetrics], dict[int, str]]:
    """Metrics of the runs of these seeds, and why others failed."""
    runs, failed = [], {}
    for seed in seeds:
        try:
            log = simulate(plan, seed, lean=lean_enough(plan))
        except FAILED as error:
            failed[seed] = str(error)
        else:
            runs.append(run_metrics(RunRecorder(log, plan, "").trace()))
    return runs, failed


def run_metrics(trace: Trace) -> RunMetrics:
    """Metrics of one run, from a trace that may be lean."""
    shared, metrics = Measurement(trace), swept_metrics([trace.plan]) | law_metrics(measures_of(trace))
    values, faults = values_of(metrics, shared, lean=trace.position.shape[2] == 0)
    return RunMetrics(
        seed=trace.seed,
        values=case_values(metrics, values, shared.kept, sums=True),
        gap_min_s=min((float(wait.min()) for wait in shared.gaps_between if len(wait)), default=None),
        duration_s=float(trace.time[-1] - trace.time[0]),
        failure="; ".join(failures(trace, shared.known.tolist())) or _early_end(trace),
        metric_faults=faults,
    )


def _early_end(trace: Trace) -> str:
    """Text on the end of a run that ended early; else empty."""
    return f"ended at {trace.time[-1]:.1f} s of {trace.plan.experiment.duration_s:g} s" if ended_early(trace) else ""
