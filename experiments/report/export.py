"""`zenpark export RUN`: a run as a MATLAB file, or as one long table of trajectories.

In a notebook: `export.write_mat(run, Path("run.mat"))`, with what `experiments.run` returned.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Any, Final, get_args, get_type_hints

import numpy as np

from agents.arrays import Array, Index
from agents.formation.graph import Links, adjacency
from experiments.metrics.results import CaseMetrics, RobotMetrics
from experiments.metrics.signals import formation_errors, links_of, phase_starts
from experiments.recording.trace import Trace
from experiments.run import Run, reopen

STEM: Final = "run"  # of the file, if none is named
LONGEST: Final = 63  # letters of a name in MATLAB
LARGEST: Final = 2**31  # bytes of a variable that MATLAB reads from a file of this version
KEYWORDS: Final = frozenset(
    {
        *("break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if"),
        *("otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while"),
    }
)
UNITS: Final[dict[str, Any]] = {
    "time": "s since the common start",
    "position": "m, as measured; time x robot x axis",
    "yaw": "rad, as measured; time x robot",
    "true_position": "m; time x robot x axis",
    "goal": "m; time x robot x axis",
    "setpoint": "m, m, m, rad, or m/s, m/s, m/s, rad/s, or m/s, rad/s, 0, 0, as the robot takes it; time x robot x 4",
    "error": "m, sum over the links of the robot; time x robot",
    "tolerance": "m",
    "phase_start": "s",
    "adjacency": "1 where the robot of the row hears that of the column",
    "sent": {
        "time": "s",
        "robot": "row in robots",
        "position": "m",
        "velocity": "m/s",
        "yaw": "rad",
        "bytes": "bytes",
    },
    "links": {
        "listener": "row in robots",
        "speaker": "row in robots",
        "distance": "m",
        "gain": "1/(m^2 decision) for distances, 1/decision for others",
        "relative": "m, listener less speaker",
        "bearing": "1, from the speaker to the listener",
    },
    "metrics": {
        "f_hz": "1/s",
        "bytes": "bytes",
        "iae": "m s",
        "itae": "m s^2",
        "rmse": "m",
        "acquired_s": "s",
        "residual": "m",
        "settle_s": "s",
        "gap_min_s": "s",
        "gap_median_s": "s",
        "gap_max_s": "s",
        "impulse": "N s",
        "overlap": "m",
        "short": "m",
        "formation_acquired_s": "s, for each phase",
        "rotation_rad_s": "rad/s, for each phase",
        "belief_rms": "m",
        "belief_max": "m",
    },
}
COLUMNS: Final = ("x", "y", "z", "yaw", "true_x", "true_y", "true_z", "goal_x", "goal_y", "goal_z", "error")


class ExportError(RuntimeError):
    """What cannot be exported, with the remedy."""


def command(folder: str, target: str | None, *, as_csv: bool) -> int:
    """`zenpark export`; returns the exit code.

    Raises:
        ExportError: If the file cannot be written, or scipy is missing.
        RecordingError: If the folder holds no recording, or one cannot be read.
    """
    file = Path(target) if target else Path(folder) / f"{STEM}{'.csv' if as_csv else '.mat'}"
    suffix = file.suffix.lower()
    if suffix not in (".mat", ".csv") or (as_csv and suffix == ".mat"):
        raise ExportError(f"{file}: is no name for the {'table' if as_csv else 'file'}; let it end with .mat or .csv")
    write = write_csv if suffix == ".csv" else write_mat
    if write is write_mat:
        _savemat()  # before a long recording is read
    run = reopen(Path(folder))
    if not run.traces:
        raise ExportError(f"{folder}: no case had begun; there is nothing to export")
    write(run, file)
    print(f"{file}: {', '.join(run.traces)}")
    return 0


def write_mat(run: Run, file: Path) -> None:
    """Writes a struct for each case, named after it, into a file of MATLAB's version 5.

    Numbers are doubles, robots are counted from 1, what is unknown is NaN. What is in the structs: docs/matlab.md.

    Raises:
        ExportError: If scipy is missing, the file cannot be written, or a case is too large for it.
    """
    savemat = _savemat()
    names = matlab_names(run.traces)
    cases = {names[case]: structure(trace, run.metrics[case]) for case, trace in run.traces.items()}
    for name, case in cases.items():
        if (size := _bytes(case)) >= LARGEST:
            raise ExportError(f"{file}: {name} has {size / 1e9:.1f} GB, MATLAB reads 2.1; export a table: --csv")
    try:
        with file.open("wb") as stream:
            savemat(stream, cases, long_field_names=True, do_compression=True, oned_as="column")
    except OSError as error:
        raise _unwritable(file, error) from None


def write_csv(run: Run, file: Path) -> None:
    """Writes a table with a line for each case, time and robot; empty where a value is unknown.

    Raises:
        ExportError: If the file cannot be written.
    """
    try:
        with file.open("w", newline="", encoding="utf-8") as stream:
            table = csv.writer(stream)
            table.writerow(["case", "time", "robot", *COLUMNS])
            for case, trace in run.traces.items():
                parts = (trace.position, trace.yaw[..., None], trace.true_position, trace.goal)
                values = np.concatenate([*parts, formation_errors(trace)[..., None]], axis=2)
                told = values.astype(object)
                told[~np.isfinite(values)] = None
                for t, rows in zip(trace.time.tolist(), told.tolist(), strict=True):
                    table.writerows([case, t, robot, *row] for robot, row in zip(trace.robots, rows, strict=True))
    except OSError as error:
        raise _unwritable(file, error) from None


def structure(trace: Trace, measured: CaseMetrics) -> dict[str, Any]:
    """A case as what becomes a struct: texts, arrays of doubles, arrays of texts, and structs in it."""
    net, rows, sent = links_of(trace), len(trace.robots), trace.sent
    experiment = trace.experiment
    return {
        "case": trace.case,
        "title": experiment.title,
        "seed": float(trace.seed),
        "clock": trace.clock,
        "robots": _texts(trace.robots),
        "kinds": _texts(experiment.robots[name].kind for name in trace.robots),
        "time": trace.time,
        "position": trace.position,
        "yaw": trace.yaw,
        "true_position": trace.true_position,
        "goal": trace.goal,
        "setpoint": trace.setpoint,
        "error": formation_errors(trace),
        "tolerance": experiment.tolerance,
        "phase_start": np.array(phase_starts(trace)),
        "sent": {
            "time": sent.time,
            "robot": _from_one(sent.robot),
            "position": sent.position,
            "velocity": sent.velocity,
            "yaw": sent.yaw,
            "bytes": sent.bytes.astype(float),
        },
        "links": _links(net),
        "adjacency": adjacency(net, rows),
        "metrics": _metrics(measured),
        "units": UNITS,
    }


def matlab_names(names: Iterable[str]) -> dict[str, str]:
    """For each name one that MATLAB allows: letters, digits and _, a letter first, no keyword; each another."""
    found: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        if not re.match(r"[A-Za-z]", plain) or plain in KEYWORDS:
            plain = f"case_{plain}"
        short, number = plain[:LONGEST], 2
        while short in found.values():
            short, number = f"{plain[: LONGEST - len(str(number)) - 1]}_{number}", number + 1
        found[name] = short
    return found


def _links(net: Links) -> dict[str, Any]:
    """Whom each link is between, and what it asks for."""
    told = {"relative": net.relative, "bearing": net.bearing}
    return {
        "listener": _from_one(net.listener),
        "speaker": _from_one(net.speaker),
        "distance": net.distance,
        "gain": net.gain,
        **{name: column for name, column in told.items() if column is not None},
    }


def _metrics(measured: CaseMetrics) -> dict[str, Any]:
    """A column over the robots for each number; those of the whole; the means that leave out leaders."""
    numbers = [name for name, kind in get_type_hints(RobotMetrics).items() if _is_number(kind)]
    columns = {name: _numbers(getattr(robot, name) for robot in measured.robots) for name in numbers}
    return {
        "robot": _texts(robot.robot for robot in measured.robots),
        **columns,
        "leaders": _texts(measured.leaders),
        "mean": {index: _number(value) for index, value in measured.mean.items()},
        "formation_acquired_s": _numbers(measured.acquired_s),
        "rotation_rad_s": _numbers(measured.rotation_rad_s),
        "j2": measured.j2,
        "belief_rms": _number(measured.belief_rms),
        "belief_max": _number(measured.belief_max),
    }


def _is_number(kind: Any) -> bool:  # noqa: ANN401 - an annotation
    return set(get_args(kind) or (kind,)) <= {int, float, NoneType}


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _numbers(values: Iterable[float | None]) -> Array:
    return np.array([_number(value) for value in values])


def _texts(values: Iterable[str]) -> Any:  # noqa: ANN401 - numpy's arrays of objects become MATLAB's cell arrays
    return np.array(list(values), dtype=object)


def _from_one(rows: Index) -> Array:
    """MATLAB counts from 1."""
    return np.asarray(rows, dtype=float) + 1.0


def _unwritable(file: Path, error: OSError) -> ExportError:
    return ExportError(f"{file}: cannot be written: {error.strerror}; name another place")


def _bytes(value: Any) -> int:  # noqa: ANN401 - whatever is in a struct
    """Size of the arrays in a struct."""
    if isinstance(value, dict):
        return sum(map(_bytes, value.values()))
    return value.nbytes if isinstance(value, np.ndarray) else 0


def _savemat() -> Any:  # noqa: ANN401 - scipy has no types
    """The function that writes.

    Raises:
        ExportError: If scipy is not installed.
    """
    try:
        return import_module("scipy.io").savemat  # an extra
    except ImportError:
        raise ExportError(
            "MATLAB files need a library that is an extra: ./zenpark install scipy, or pip install -e "
            "'.[matlab]'; a table needs none: --csv"
        ) from None
