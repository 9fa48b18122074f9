"""The figures of a run as files and for scripts: metrics.csv, metrics.json, and what `./zenpark run --json` prints."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from agents.errors import replacing
from experiments.metrics import criteria
from experiments.metrics.results import CaseMetrics, RobotMetrics, ShadowMetrics
from experiments.metrics.statistics import ratios
from twins.arrays import Array

_NESTED: Final = ("phases", "near", "near_arena", "shadow", "extra", "measures")


def document(run_folder: str, seed: int, cases: Sequence[CaseMetrics]) -> dict[str, Any]:
    """The figures of one run for scripts: per case and robot the metrics, their means, and ratios to the first case."""
    return {
        "run": run_folder,
        "seed": seed,
        "cases": {
            case.case: {
                "robots": {robot.robot: _of_robot(robot, case) for robot in case.robots},
                "mean": dict(case.mean),
                "ratio": {index: next(iter(ratios([case], cases[:1], index))) for index in case.mean},
                "collisions": len(case.collisions),
                "network": {
                    "messages": case.network_messages,
                    "bytes": case.network_bytes,
                    "deliveries": case.deliveries,
                },
                **({} if case.guidance is None else {"guidance": msgspec.to_builtins(case.guidance)}),
                "near_m": None if case.near is None else case.near.gap,
                **({"duration_s": case.duration_s, "interrupted": True} if case.interrupted else {}),
                **({"spoiled": list(case.spoiled)} if case.spoiled else {}),
                **({"measures": msgspec.to_builtins(case.measures)} if case.measures else {}),
                **({"metric_faults": list(case.metric_faults)} if case.metric_faults else {}),
            }
            for case in cases
        },
        **criteria.document(criteria.judge(cases)),
    }


def _of_robot(robot: RobotMetrics, case: CaseMetrics) -> dict[str, float | None]:
    """Metrics of a robot by name; those of the case are left out."""
    return {name: robot.value(name) for name in case.mean if name in _PLAIN or name in robot.extra}


def write_csv(path: Path, cases: Sequence[CaseMetrics]) -> None:
    """Rows per case and robot, and a row `mean` per case; empty where a value is unknown."""
    with replacing(path) as fresh, fresh.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, _columns(cases), restval="")
        table.writeheader()
        for case in cases:
            table.writerows(_robot_rows(case))
            table.writerow({**_of_case(case), "robot": "mean", **case.mean})


def rows(cases: Sequence[CaseMetrics]) -> Iterator[dict[str, object]]:
    """A row per case and robot with all columns of `metrics.csv`; None where a value is unknown."""
    columns = dict.fromkeys(_columns(cases))
    return (columns | row for case in cases for row in _robot_rows(case))


def _columns(cases: Sequence[CaseMetrics]) -> list[str]:
    later = max((len(case.starts_s) for case in cases), default=1)
    phases = [f"phase{k}_{what}" for k in range(2, later + 1) for what in ("acquired_s", "residual", "worst")]
    near = [f"{what}_{part}" for what in ("near", "near_arena") for part in ("gap", "to", "at_s")]
    shadow = next((robot.shadow for case in cases for robot in case.robots if robot.shadow), None)
    added = dict.fromkeys(name for case in cases for name in case.mean if name not in _PLAIN)
    return ["seed", "case", "spoiled", "in_mean", *_PLAIN, *phases, *near, *_flat_shadow(shadow), *added]


_PLAIN: Final = [field for field in RobotMetrics.__struct_fields__ if field not in _NESTED]


def _of_case(case: CaseMetrics) -> dict[str, object]:
    return {"seed": case.seed, "case": case.case, "spoiled": int(bool(case.spoiled))}


def _robot_rows(case: CaseMetrics) -> Iterator[dict[str, object]]:
    out = {*case.leaders, *case.died}
    for robot in case.robots:
        row: dict[str, object] = {field: getattr(robot, field) for field in _PLAIN}
        for k, phase in enumerate(robot.phases, start=2):
            row |= {f"phase{k}_{what}": getattr(phase, what) for what in ("acquired_s", "residual", "worst")}
        for what, near in (("near", robot.near), ("near_arena", robot.near_arena)):
            if near is not None:
                row |= {f"{what}_gap": near.gap, f"{what}_to": near.between[1], f"{what}_at_s": near.at_s}
        in_mean = int(robot.robot not in out)
        yield {**_of_case(case), "in_mean": in_mean, **row, **_flat_shadow(robot.shadow), **robot.extra}


def _flat_shadow(shadow: ShadowMetrics | None) -> dict[str, object]:
    """Fields of a shadow twin as columns; those along three axes as three."""
    flat: dict[str, object] = {}
    for field, value in ({} if shadow is None else msgspec.structs.asdict(shadow)).items():
        parts = zip("xyz", value, strict=True) if isinstance(value, tuple) else [("", value)]
        flat |= {f"shadow_{field}_{axis}".rstrip("_"): part for axis, part in parts}
    return flat


def write_json(path: Path, cases: Sequence[CaseMetrics]) -> None:
    """All metrics, one object per case."""
    text = msgspec.json.encode(criteria.with_judgements(cases))
    with replacing(path) as fresh:
        fresh.write_bytes(msgspec.json.format(text, indent=2) + b"\n")


def read_json(path: Path) -> list[CaseMetrics]:
    """The metrics of a file; raises ValueError if they are those of another version."""
    return msgspec.json.decode(path.read_bytes(), type=list[CaseMetrics])


class Band(NamedTuple):
    """Error of the worst link of a formation over several seeds."""

    seeds: int
    time: Array  # (T,) [s]
    middle: Array  # (T,) [m] the median
    low: Array  # (T,) [m]
    high: Array  # (T,) [m]


BANDS: Final = "errors.csv"
_BAND: Final = ("case", "seeds", "time_s", "median_m", "lowest_m", "highest_m")


def write_bands(path: Path, bands: Mapping[str, Band]) -> None:
    """The errors over seeds of each case as a table: recordings of most seeds are not kept."""
    with replacing(path) as fresh, fresh.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_BAND)
        for case, band in bands.items():
            table.writerows(
                (case, band.seeds, *(f"{value:.6g}" for value in row)) for row in zip(*band[1:], strict=True)
            )


def read_bands(path: Path) -> dict[str, Band]:
    """Bands that `write_bands` has written; empty if there is nothing of that kind."""
    found: dict[str, list[list[float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                found.setdefault(row["case"], []).append([float(row[name]) for name in _BAND[1:]])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {case: Band(int(rows[0][0]), *np.array(rows).T[1:]) for case, rows in found.items()}
