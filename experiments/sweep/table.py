"""The table of a sweep: a row for each cell, as structs, as CSV, as JSON and as text."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec

from agents.errors import replacing
from experiments.file import reference as reference_of_file
from experiments.metrics.comparable import equally_long
from experiments.metrics.metric import Metric, facts_of, from_facts, short_name, swept_metrics
from experiments.metrics.statistics import Spread, ratio, spread
from experiments.report.page import NONE, interval
from experiments.report.tables import ratio_words
from experiments.sweep.plan import Cell
from experiments.sweep.runs import RunMetrics

SHORT: Final = 5  # letters of a unit that stands behind a value
UNKNOWN: Final = Spread(None, None, None, 0)


class CellRow(msgspec.Struct, frozen=True):
    """Statistics of a cell."""

    case: str
    parameters: dict[str, Any]  # values of the axes that it has, by path
    environment: dict[str, Any]  # those of them that are no choice, see `Cell`: only cells of equal ones are compared
    units: dict[str, str]  # units of the parameters that have a short one, by path
    reference: bool  # the ratios of others are taken over it
    seeds: int  # runs that succeeded
    failed: int  # runs that failed, or in which a robot did; the statistics leave them out
    mean: dict[str, Spread]  # means over the seeds; `acquired_s` over those in which all acquired
    # of each relative metric over the reference with the same seed, then over the seeds; only of runs of equal length
    ratio: dict[str, Spread]
    acquired: float | None  # share of the seeds in which every robot but the leaders acquired
    gap_min_s: float | None  # shortest time between two transmissions of any robot, in all seeds [s]
    missing: int = 0  # runs that an interruption has left undone

    def value(self, index: str) -> Spread:
        """The ratio of a metric if it has one, else its mean; unknown if it was not measured."""
        return self.ratio.get(index, self.mean.get(index, UNKNOWN))

    @property
    def words(self) -> str:
        """The parameters in a few words: `threshold=0.01 m`."""
        return ", ".join(f"{short(path)}={self.value_of(path)}" for path in self.parameters)

    def value_of(self, path: str) -> str:
        """The value of a parameter, with its unit."""
        return f"{words_of(self.parameters[path])} {self.units.get(path, '')}".strip()

    @property
    def surroundings(self) -> str:
        """The environment in a few words: `loss=0.1`."""
        return ", ".join(f"{short(path)}={self.value_of(path)}" for path in self.environment)

    @property
    def label(self) -> str:
        """Case and parameters."""
        return f"{self.case} {self.words}".strip()


def row(
    cell: Cell,
    runs: Mapping[int, RunMetrics],
    reference: Mapping[int, RunMetrics],
    *,
    failed: int = 0,
    missing: int = 0,
    metrics: Mapping[str, Metric] | None = None,
) -> CellRow:
    """A cell's runs, by seed, and those of its reference; some `metrics` instead of those of all sweeps."""
    metrics = swept_metrics() if metrics is None else metrics
    ordered = [runs[seed] for seed in sorted(runs)]
    paired = [
        (runs[seed], reference[seed])
        for seed in sorted(runs)
        if seed in reference and equally_long((runs[seed].duration_s, reference[seed].duration_s))
    ]
    experiment = cell.plan.experiment
    units = {path: reference_of_file.unit(path, experiment) for path in cell.parameters}
    acquired = [run.values["acquired_s"] is not None for run in ordered]
    gaps = [run.gap_min_s for run in ordered if run.gap_min_s is not None]
    return CellRow(
        case=cell.case,
        parameters=dict(cell.parameters),
        environment=dict(cell.environment),
        units={path: unit for path, unit in units.items() if 0 < len(unit) <= SHORT},
        reference=cell.digest == cell.reference,
        seeds=len(ordered),
        failed=failed,
        mean={name: spread([run.values.get(name) for run in ordered]) for name in metrics},
        ratio={
            name: spread([ratio(one.values.get(name), other.values.get(name)) for one, other in paired])
            for name in relative_metrics(metrics)
        },
        acquired=sum(acquired) / len(acquired) if acquired else None,
        gap_min_s=min(gaps, default=None),
        missing=missing,
    )


def relative_metrics(metrics: Mapping[str, Metric] | None = None) -> dict[str, Metric]:
    """Metrics of all sweeps, or those of `metrics`, that are taken over the reference."""
    metrics = swept_metrics() if metrics is None else metrics
    return {name: metric for name, metric in metrics.items() if metric.relative}


def main_error(rows: Sequence[CellRow], metrics: Mapping[str, Metric]) -> str:
    """The metric of which less is better that tells cells apart: IAE; without targets the first with a known ratio."""
    drawn = [name for name, each in relative_metrics(metrics).items() if each.figure and each.better == "less"]
    known = (name for name in drawn if any(row.ratio.get(name, UNKNOWN).mean is not None for row in rows))
    return next(known, "iae")


def write_csv(path: Path, rows: Sequence[CellRow], metrics: Mapping[str, Metric]) -> None:
    """A line for each row; empty where a value is unknown, and where a case has no such parameter."""
    paths = list(dict.fromkeys(path for each in rows for path in each.parameters))
    columns = [part for name in metrics for part in (name, f"{name}_ci95")]
    columns += [part for name in relative_metrics(metrics) for part in (f"{name}_ratio", f"{name}_ratio_ci95")]
    head = ["case", *paths, "reference", "seeds", "failed", "missing", *columns, "acquired_share", "gap_min_s"]
    with replacing(path) as fresh, fresh.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, head, restval="")
        table.writeheader()
        for each in rows:
            found: dict[str, Any] = {"case": each.case, **each.parameters}
            found |= {"reference": int(each.reference), "seeds": each.seeds}
            found |= {"failed": each.failed, "missing": each.missing}
            for suffix, group in (("", each.mean), ("_ratio", each.ratio)):
                for index, value in group.items():
                    found |= {f"{index}{suffix}": value.mean, f"{index}{suffix}_ci95": value.ci95}
            table.writerow({**found, "acquired_share": each.acquired, "gap_min_s": each.gap_min_s})


def document(
    title: str, seeds: Sequence[int], rows: Sequence[CellRow], metrics: Mapping[str, Metric], **more: object
) -> dict[str, Any]:
    """The table for programs, with what metrics of files and of laws are."""
    reference = next((each.case for each in rows if each.reference), None)
    listed = [msgspec.to_builtins(each) for each in rows]
    added = {"metrics": facts} if (facts := facts_of(metrics)) else {}
    return {"experiment": title, "reference": reference, "seeds": list(seeds), **more, **added, "cells": listed}


def write_json(path: Path, table: Mapping[str, Any]) -> None:
    """Writes a table of `document`."""
    with replacing(path) as fresh:
        fresh.write_bytes(msgspec.json.format(msgspec.json.encode(table), indent=2) + b"\n")


def read_json(path: Path) -> tuple[dict[str, Any], list[CellRow], dict[str, Metric]]:
    """A table that `write_json` has written, its rows, and its metrics.

    Raises ValueError if there is none, or that of another version.
    """
    try:
        found = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
        metrics = swept_metrics() | from_facts(msgspec.convert(found.get("metrics", {}), dict[str, dict[str, Any]]))
        return found, msgspec.convert(found.get("cells"), list[CellRow]), metrics
    except (OSError, RecursionError) as error:
        raise ValueError(str(error)) from None


def _mean_of(row: CellRow, metric: Metric, name: str) -> str:
    """Mean over the seeds; of a metric that must be known of all robots, with the number of seeds in which it is."""
    mean = row.mean.get(name, UNKNOWN)
    if metric.mean != "all":
        return interval(mean)
    if not mean.n:
        return f"never ({row.seeds} seeds)" if row.seeds else NONE
    return interval(mean) + (f" ({mean.n} of {row.seeds})" if mean.n < row.seeds else "")


def _ratio_of(row: CellRow, name: str) -> str:
    """Ratio, and of how many seeds it is, unless it is of all."""
    ratio = row.ratio.get(name, UNKNOWN)
    return ratio_words(ratio) + (f" ({ratio.n} of {row.seeds})" if ratio.n not in {0, row.seeds} else "")


def numbers(metrics: Mapping[str, Metric]) -> dict[str, tuple[str, Callable[[CellRow], str]]]:
    """Head and text of each column for people, by the name behind `--metrics`."""
    found: dict[str, tuple[str, Callable[[CellRow], str]]] = {}
    for name, metric in metrics.items():
        if metric.shown and metric.relative:
            found[short_name(name)] = (f"{metric.label} ratio", partial(_ratio_of, name=name))
        elif metric.shown:
            found[short_name(name)] = (metric.head, partial(_mean_of, metric=metric, name=name))
    found["gap"] = ("gap [ms]", lambda row: NONE if row.gap_min_s is None else f"{1e3 * row.gap_min_s:.0f}")
    return found


def known_numbers(
    rows: Sequence[CellRow], metrics: Mapping[str, Metric]
) -> dict[str, tuple[str, Callable[[CellRow], str]]]:
    """Columns of `numbers` without those of errors where no link has any."""
    errors = {short_name(name) for name in ("iae", "itae", "acquired_s")}
    bare = all(row.mean.get("iae", UNKNOWN).mean is None for row in rows)
    return {name: column for name, column in numbers(metrics).items() if not bare or name not in errors}


def text(rows: Sequence[CellRow], metrics: Mapping[str, Metric]) -> list[str]:
    """The main columns, for the terminal."""
    shown = known_numbers(rows, metrics).values()
    heads = [head for head, _ in shown]
    lines: list[tuple[str, ...]] = [("case", "parameters", "seeds", *heads)]
    for row in rows:
        fewer = [f"{count} {what}" for count, what in ((row.failed, "failed"), (row.missing, "missing")) if count]
        seeds = str(row.seeds) + (f" ({', '.join(fewer)})" if fewer else "")
        lines.append((row.case, row.words, seeds, *(number(row) for _, number in shown)))
    width = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        "  ".join(cell.ljust(width[k]) if k < 2 else cell.rjust(width[k]) for k, cell in enumerate(line)).rstrip()
        for line in lines
    ]


def parameter_columns(rows: Sequence[CellRow]) -> dict[str, list[str]]:
    """Heads of the columns of parameters, and of each the value in every row; those of several cases share a column."""
    paths: dict[str, list[str]] = {}
    most_first = sorted(rows, key=lambda row: -len(row.parameters))  # same order as the axes
    for path in dict.fromkeys(path for row in most_first for path in row.parameters):
        paths.setdefault(short(path), []).append(path)
    columns: dict[str, list[str]] = {}
    for head, group in paths.items():
        alone = all(len(row.parameters.keys() & set(group)) < 2 for row in rows)
        columns |= {head: group} if alone else {path: [path] for path in group}
    units = {path: unit for row in rows for path, unit in row.units.items()}
    return {
        f"{head} [{units[group[0]]}]" if group[0] in units else head: [
            next((words_of(row.parameters[path]) for path in group if path in row.parameters), NONE) for row in rows
        ]
        for head, group in columns.items()
    }


def short(path: str) -> str:
    """The last part of a path."""
    return path.rpartition(".")[2]


def words_of(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
