"""The page of a sweep, and of a search for parameters: its table, and messages against error."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from agents.plugins.files import plain
from experiments.metrics.metric import OURS, Metric
from experiments.report import page, style
from experiments.report.tables import over_seeds, ratio_words
from experiments.sweep.optimise import TuningResult, searched
from experiments.sweep.pareto import by_environment, front, pareto
from experiments.sweep.sweep import SweepResult
from experiments.sweep.table import (
    CellRow,
    known_numbers,
    main_error,
    numbers,
    parameter_columns,
    relative_metrics,
)

PAGE: Final = "sweep.html"
MOST_LINES: Final = 40  # lines of a table that stands open
LEVELS: Final = (1.01, 1.02, 1.05)  # multiples of IAE: the fewest messages within each are named
TERMS: Final = (
    ("Messages", "Transmissions of a robot, mean over all but the leaders; relative to the reference, seed by seed."),
    ("IAE, ITAE", "Of the formation error of a robot, mean over all but the leaders; likewise."),
    ("Acquired", "Mean time of the robots but the leaders, over the seeds in which all of them acquired before the "
     "first leg; in brackets how many seeds these are, if not all."),
    ("Environment", "Parameters that are not chosen, such as loss, delay and disturbance, and those that the reference "
     "shares. Only cells of the same environment are compared with each other."),
    ("Failed", "Runs in which a robot did not do its part, that ended early or never began. They are in no figure, and "
     "a cell with one is on no front. Ratios are of runs of equal length."),
    ("Gap", "Shortest time between two transmissions of any robot in any seed."),
    ("±", "Half-width of the 95 % confidence interval of the mean over seeds (Student's t)."),
)  # fmt: skip
CAPTION: Final = (
    "Messages against {}; towards the lower left is better. Full: no other of the same environment has fewer messages "
    "and no more error (grey line); hollow: another has, or runs failed. Along a curve the named parameter changes, "
    "markers tell the others; more than 7 curves or markers are not joined. Whiskers: 95 % confidence."
)


def write(found: SweepResult | TuningResult, command: str) -> Path:
    """Writes `sweep.html` and the figure into the folder of a sweep or of a search."""
    facts = [
        ("Date", page.date_of(time.time())),
        ("Clock", "virtual"),
        ("Seeds", page.seeds_in_words(found.seeds)),
        ("Duration", f"{found.read.experiment.duration_s:g} s"),
        ("Robots", str(len(found.read.experiment.robots))),
        ("Cells", str(len(found.tried if isinstance(found, TuningResult) else found.rows))),
    ]
    notes = [page.VerdictLine("fair", note) for note in found.notes]
    others = [metric for name, metric in found.metrics.items() if name not in OURS]
    if isinstance(found, TuningResult):
        title, sections = "Tuned", _searched(found)
        facts.append(("Tuning seeds", page.seeds_in_words(found.tuning)))
        notes += verdict(found)
    else:
        title, sections = "Sweep", _swept(found)
        if found.missing:
            notes.append(
                page.VerdictLine("bad", f"interrupted: {found.missing} runs are missing; the same command goes on")
            )
        if found.failures:
            text = f"{len(found.failures)} runs failed, and count in no figure; the first: {found.failures[0]}"
            notes.append(page.VerdictLine("bad", text))
        notes += fewest(found.rows, found.metrics)
    return page.render(
        found.folder / PAGE,
        title=f"{title}: {found.read.experiment.title}",
        source=found.read.experiment.source,
        facts=facts,
        command=command,
        verdict=notes,
        sections=[
            *sections,
            page.Section("The experiment", listing=found.read.listing, folded="Show the file"),
            page.Section("Definitions", terms=(*TERMS, *((added.label, added.meaning) for added in others))),
        ],
    )


def _swept(found: SweepResult) -> list[page.Section]:
    folded = "Show the table" if len(found.rows) > MOST_LINES else ""
    return [
        page.Section("Messages against error", pictures=pictures(found.folder, found.rows, found.metrics)),
        page.Section("All cells", tables=(table(found.rows, found.metrics),), folded=folded),
    ]


def _searched(tuned: TuningResult) -> list[page.Section]:
    reference = [row for row in tuned.rows if row.reference]
    seeds, tried = page.seeds_in_words(tuned.seeds), page.seeds_in_words(searched(tuned.tuning))
    drawn = pictures(tuned.folder, [*reference, *tuned.tried], tuned.metrics, joined=False)
    return [
        page.Section("Result", (f"On seeds {seeds}, which no choice has seen.",), (table(tuned.rows, tuned.metrics),)),
        page.Section("All points of the search", (f"On seeds {tried}.",), pictures=drawn),
        page.Section("Table of the search", tables=(table(tuned.tried, tuned.metrics),), folded="Show the table"),
    ]


def verdict(tuned: TuningResult) -> list[page.VerdictLine]:
    """For each case whether the limits were kept on the reporting seeds, and at how many messages."""
    limits, error = tuned.objective.limits_in_words(" and "), main_error(tuned.rows, tuned.metrics)
    found = []
    for row in (row for row in tuned.rows if not row.reference):
        kept = tuned.objective.kept(row)
        text = f"{row.label}: {_saved(row, error, tuned.metrics)}, {'keeps' if kept else 'does not keep'} {limits}"
        found.append(page.VerdictLine("good" if kept else "bad", text))
    return found


def table(
    rows: Sequence[CellRow], metrics: Mapping[str, Metric], title: str = "", chosen: Sequence[str] = ()
) -> page.Table:
    """A row for each cell: case, parameters, numbers; some of them (keys of `numbers`), if `chosen`.

    With a `title`, for a paper: a number that is the same in all cells stands in the note, with the number of seeds.
    """
    parameters = parameter_columns(rows)
    shown = numbers(metrics) if chosen else known_numbers(rows, metrics)
    columns = {shown[name][0]: [shown[name][1](row) for row in rows] for name in chosen or shown}
    alike = {head: cells[0] for head, cells in columns.items() if title and not chosen and len({*cells}) == 1}
    columns = parameters | {head: cells for head, cells in columns.items() if head not in alike}
    lines = [
        page.TableRow((row.case, *(cells[k] for cells in columns.values())), row.reference)
        for k, row in enumerate(rows)
    ]
    reference = next((row.case for row in rows if row.reference), "the reference")
    note = [f"Ratios are relative to {reference} with the same seed."]
    note += [f"In all cells: {', '.join(f'{head} {cell}' for head, cell in alike.items())}."] if alike else []
    note += [over_seeds(max((row.seeds for row in rows), default=0))] if title else []
    return page.Table(("Case", *columns), tuple(lines), title=title, note=" ".join(note))


def pictures(
    folder: Path,
    rows: Sequence[CellRow],
    metrics: Mapping[str, Metric],
    *,
    joined: bool = True,
    width: float = style.WIDTH,
    pdf: bool = False,
) -> tuple[page.PageFigure, ...]:
    """Messages against IAE, ITAE and other known metrics with a figure, so wide [in]; also as files, see `style.save`.

    Pictures of an earlier page that are not drawn any more are removed.
    """
    against = {
        name: metric
        for name, metric in relative_metrics(metrics).items()
        if metric.figure and metric.shown and any(row.value(name).mean is not None for row in rows)
    }
    files = {name: f"pareto_{plain(name).replace(':', '_')}" for name in against}
    for file in (folder / "figures").glob("pareto_*.*"):
        if file.stem not in files.values():
            file.unlink(missing_ok=True)
    drawn = {name: pareto(rows, name, metrics=metrics, joined=joined, width=width) for name in against}
    saved = [style.save(each, folder / "figures", files[name], pdf=pdf) for name, each in drawn.items()]
    more = ["; more is better" * (metric.better == "more") for metric in against.values()]
    captions = [
        f"Messages against {metric.label}, likewise{which}." if k else CAPTION.format(metric.label + which)
        for k, (metric, which) in enumerate(zip(against.values(), more, strict=True))
    ]
    return page.numbered(zip(saved, captions, strict=True))


def fewest(rows: Sequence[CellRow], metrics: Mapping[str, Metric]) -> list[page.VerdictLine]:
    """Per environment the cell with the fewest messages within each level of error; the nearest one if none is."""
    error = main_error(rows, metrics)
    others = [row for row in rows if not row.reference and not row.failed and row.ratio[error].mean is not None]
    parts = by_environment(others)
    found: list[page.VerdictLine] = []
    for where, part in parts.items():
        levels = LEVELS if len(parts) == 1 else LEVELS[-1:]
        found += _fewest_within(part, levels, f"With {where}: " if len(parts) > 1 else "", error, metrics)
    return found


def _fewest_within(
    rows: Sequence[CellRow], levels: Sequence[float], where: str, error: str, metrics: Mapping[str, Metric]
) -> list[page.VerdictLine]:
    """As `fewest`, of one environment, with words about that in front."""
    label = metrics[error].label
    found: dict[str, page.VerdictLine] = {}
    for level in levels:
        within = [row for row in front(rows, error, metrics) if (row.ratio[error].mean or 0.0) <= level]
        if within:
            what = f"{where}fewest messages with {_an(label)} ratio of at most {level:g}"
            text = f"{what[0].upper()}{what[1:]}: {within[0].label}: {_saved(within[0], error, metrics)}"
            found.setdefault(within[0].label, page.VerdictLine("good" if within[0].acquired == 1.0 else "fair", text))
    if not found:
        nearest = min(rows, key=lambda row: row.ratio[error].mean or 0.0)
        what = f"{where}no cell has {_an(label)} ratio of at most {LEVELS[-1]:g}; the nearest"
        text = f"{what[0].upper()}{what[1:]}: {nearest.label}: {_saved(nearest, error, metrics)}"
        return [page.VerdictLine("fair", text)]
    return list(found.values())


def _an(label: str) -> str:
    return f"an {label}" if label == OURS["iae"].label else f"a {label}"


def _saved(row: CellRow, error: str, metrics: Mapping[str, Metric]) -> str:
    messages = row.ratio["messages"].mean
    less = "?" if messages is None else f"{100.0 * (messages - 1.0):+.1f} %".replace("-", "\N{MINUS SIGN}")
    errors = (error, "itae") if error == "iae" else (error,)
    return ", ".join(
        [f"{less} messages", *(f"{metrics[each].label} {ratio_words(row.ratio[each])}" for each in errors)]
    )
