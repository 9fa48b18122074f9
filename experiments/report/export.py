"""Traces and metrics of a run as a MATLAB file, or as one long table of trajectories.

In a notebook: `export.write_mat(run.traces, run.metrics, Path("run.mat"))`, with what `experiments.run` returned.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Container, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any, Final

import numpy as np

from agents.errors import ExplainedError, writing
from experiments.definition.graph import adjacency
from experiments.metrics.metric import FIGURES, PLAIN, known_metrics
from experiments.metrics.results import CaseMetrics, RobotMetrics
from experiments.metrics.signals import Measurement, phase_starts
from experiments.recording.trace import Trace

LONGEST: Final = 63  # letters of a name in MATLAB
MAX_VARIABLE_BYTES: Final = 2**31  # bytes of a variable that MATLAB reads from a file of this version
KEYWORDS: Final = frozenset(
    {
        *("break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if"),
        *("otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while"),
    }
)
FIELD: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)
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
    "adjacency": "1 if the robot of the row receives poses of that of the column",
    "sent": {"time": "s", "robot": "row in robots", "position": "m", "velocity": "m/s", "yaw": "rad", "bytes": "bytes"},
    "links": {
        "receiver": "row in robots",
        "sender": "row in robots",
        "distance": "m",
        "gain": "1/(m^2 decision) for distances, 1/decision for others",
        "relative": "m, receiver less sender",
        "bearing": "1, from the sender to the receiver",
    },
    "metrics": {
        "formation_acquired_s": "s, for each phase",
        "rotation_rad_s": "rad/s, for each phase",
    },
}
COLUMNS: Final = ("x", "y", "z", "yaw", "true_x", "true_y", "true_z", "goal_x", "goal_y", "goal_z", "error")


def write_mat(
    traces: Mapping[str, Trace], metrics: Mapping[str, CaseMetrics], file: Path, most_bytes: int = MAX_VARIABLE_BYTES
) -> None:
    """Writes a struct for each case, named after it, into a file of MATLAB's version 5.

    Numbers are doubles, robots are counted from 1, what is unknown is NaN. What is in the structs: docs/matlab.md.
    Raises ExplainedError if scipy is missing, the file cannot be written, or a case is too large for it.
    """
    savemat = require_savemat()
    names = matlab_names(traces)
    cases = {names[case]: structure(trace, metrics[case]) for case, trace in traces.items()}
    for name, case in cases.items():
        if (size := _bytes(case)) >= most_bytes:
            raise ExplainedError(f"{file}: {name} has {size / 1e9:.1f} GB, MATLAB reads 2.1; export a table: --csv")
    with writing(file, "name another place"), file.open("wb") as stream:
        savemat(stream, cases, long_field_names=True, do_compression=True, oned_as="column")


def write_csv(traces: Mapping[str, Trace], file: Path) -> None:
    """Writes a table with a line for each case, time and robot; empty where a value is unknown.

    Behind the columns of all runs stand those of laws that remember, see `Trace.columns`.
    """
    columns = {case: trace.columns() for case, trace in traces.items()}
    of_law = dict.fromkeys(name for found in columns.values() for name in found if name not in COLUMNS)
    with writing(file, "name another place"), file.open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream)
        table.writerow(["case", "time", "robot", *COLUMNS, *of_law])
        for case, trace in traces.items():
            blank = np.full(trace.yaw.shape, np.nan)
            values = np.stack([columns[case].get(name, blank) for name in (*COLUMNS, *of_law)], axis=2)
            cells = values.astype(object)
            cells[~np.isfinite(values)] = None
            for t, rows in zip(trace.time.tolist(), cells.tolist(), strict=True):
                table.writerows([case, t, robot, *row] for robot, row in zip(trace.robots, rows, strict=True))


FRAMES_HZ: Final = 15.0  # frames of a film


def write_video(traces: Mapping[str, Trace], file: Path, speed: float = 4.0) -> None:
    """All cases side by side as a film, `speed` times as fast as the run: .mp4 (H.264, by ffmpeg) or .gif.

    Raises ExplainedError if there is no ffmpeg for an .mp4, or the file cannot be written.
    """
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.animation import FFMpegWriter, PillowWriter  # noqa: PLC0415

    from experiments.report import style, trajectories  # noqa: PLC0415

    mp4 = file.suffix.lower() == ".mp4"
    if mp4 and not FFMpegWriter.isAvailable():
        raise ExplainedError(
            f"{file}: an .mp4 needs the program ffmpeg (Debian: apt install ffmpeg); a .gif needs nothing"
        )
    shown = list(traces.values())
    if not any(trajectories.has_positions(trace) for trace in shown):
        raise ExplainedError(f"{file}: no position is known in this run; there is nothing to show")
    figure, show = trajectories.film(shown)
    try:
        with writing(file, "name another place"), rc_context(dict(style.STYLE)):
            writer = FFMpegWriter(FRAMES_HZ, bitrate=2000) if mp4 else PillowWriter(FRAMES_HZ)  # type: ignore[arg-type]
            with writer.saving(figure, str(file), 150 if mp4 else 110):
                for t in np.arange(0.0, max(float(trace.time[-1]) for trace in shown), speed / FRAMES_HZ):
                    show(float(t))
                    writer.grab_frame(transparent=False)
    except CalledProcessError as error:  # ffmpeg has ended by itself, and said why in its last line
        last = str(error.stderr or error.output or "").strip().rpartition("\n")[2]
        raise ExplainedError(f"{file}: ffmpeg failed: {last or error}; a .gif needs no ffmpeg") from None


def structure(trace: Trace, metrics: CaseMetrics) -> dict[str, Any]:
    """A case as what becomes a struct: texts, arrays of doubles, arrays of texts, and structs in it."""
    net, sent = trace.plan.links, trace.sent
    experiment = trace.plan.experiment
    arrays = ("time", "position", "yaw", "true_position", "goal", "setpoint")
    columns = [name for name in RobotMetrics.__struct_fields__ if name in FIGURES]
    columns += [name for robot in metrics.robots[:1] for name in robot.extra]
    figures = FIGURES | known_metrics()
    measured = {name: each.unit.translate(PLAIN) for name, each in figures.items() if each.unit}
    links = {
        "receiver": net.receiver + 1,  # MATLAB counts from 1
        "sender": net.sender + 1,
        "distance": net.distance,
        "gain": net.gain,
        "relative": net.relative,
        "bearing": net.bearing,
    }
    case = {
        **{name: getattr(trace, name) for name in ("case", "seed", "clock", "robots", *arrays)},
        "title": experiment.title,
        "kinds": [experiment.robots[name].kind for name in trace.robots],
        "error": Measurement.of(trace).robot_errors,
        "tolerance": experiment.tolerance,
        "phase_start": phase_starts(trace),
        "sent": {
            "time": sent.stamp,
            "robot": sent.link + 1,
            **{name: getattr(sent, name) for name in ("position", "velocity", "yaw", "bytes")},
        },
        "links": {name: column for name, column in links.items() if column is not None},
        "adjacency": adjacency(net, len(trace.robots)),
        "metrics": {
            "robot": [robot.robot for robot in metrics.robots],
            **{name: [robot.value(name) for robot in metrics.robots] for name in columns},
            **{name: getattr(metrics, name) for name in ("leaders", "mean")},
            "formation_acquired_s": metrics.acquired_s,
            "rotation_rad_s": metrics.rotation_rad_s,
        },
        "units": UNITS | {"metrics": measured | UNITS["metrics"]},
    }
    if trace.memory or trace.measures:  # columns of a law that remembers
        case |= {what: dict(getattr(trace, what)) for what in ("memory", "measures")}
    return {name: converted(value) for name, value in case.items()}


def converted(value: Any) -> Any:  # noqa: ANN401 - any field of a struct
    """A value as `savemat` takes it: a number as double, unknown as NaN, an array of texts for a cell array."""
    match value:
        case dict():
            plain_first = sorted(value, key=lambda name: not FIELD.fullmatch(name))
            names = matlab_names(plain_first, keywords=())  # a field may have the name of one, such as `case`
            return {names[name]: converted(each) for name, each in value.items()}
        case str():
            return value
        case list() | tuple() if all(isinstance(each, str) for each in value):
            return np.array(value, dtype=object)
        case np.ndarray() | list() | tuple():
            return np.array(value, dtype=float)  # None becomes NaN
        case _:
            return math.nan if value is None else float(value)


def matlab_names(names: Iterable[str], keywords: Container[str] = KEYWORDS) -> dict[str, str]:
    """For each name one that MATLAB allows: letters, digits and _, a letter first, no keyword; each another."""
    found: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        if not re.match(r"[A-Za-z]", plain) or plain in keywords:
            plain = f"case_{plain}"
        short, number = plain[:LONGEST], 2
        while short in found.values():
            short, number = f"{plain[: LONGEST - len(str(number)) - 1]}_{number}", number + 1
        found[name] = short
    return found


def _bytes(value: Any) -> int:  # noqa: ANN401 - any field of a struct
    """Size of the arrays in a struct."""
    if isinstance(value, dict):
        return sum(map(_bytes, value.values()))
    return value.nbytes if isinstance(value, np.ndarray) else 0


def require_savemat() -> Any:  # noqa: ANN401 - scipy has no types
    """The function that writes MATLAB files."""
    try:
        return import_module("scipy.io").savemat  # an extra
    except ImportError:
        raise ExplainedError(
            "MATLAB files need a library that is an extra: ./zenpark install scipy, or pip install -e "
            "'.[matlab]'; a table needs none: --csv"
        ) from None
