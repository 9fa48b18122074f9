"""The report of a run, and of several runs side by side."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import msgspec

from experiments.metrics.measure import measure
from experiments.metrics.results import CaseMetrics
from experiments.metrics.statistics import by_case, first_seed
from experiments.recording.run_folder import RunOrigin, read_origin
from experiments.recording.trace import Trace
from experiments.recording.version import provenance
from experiments.report import figures, page, replay, style, tables
from experiments.report.metrics_files import Band
from experiments.report.verdict import findings, left_out

PROOF: Final = (
    "Every pose carries a running number, so a gap proves a loss. Received poses are counted over all receivers "
    "together; a pose sent in the last instant of the run may still be under way."
)
CRITERIA: Final = "Limits that stand in the experiment file. Every seed must keep each of them."
CLOCKS: Final = (
    "What a host's clock read more than the conductor's, by the shortest of many round trips. The offset before the "
    "run was subtracted from all stamps there and from the start. Drift since then was corrected during the run; "
    "the largest error that was left in stamps until they did is taken off here."
)
FROM_WORLD: Final = "Contacts are those that the world saw begin; distances are between surfaces, on true positions."
FROM_POSITIONS: Final = (
    "Where no world watched for contacts, they are worked out from true positions; distances are between surfaces."
)
SHADOWS: Final = (
    "Robots and the twins beside them: left from above, twins dashed; right the difference, twin less robot, in the "
    "robot's heading and in height."
)
ARCHITECTURE: Final = (
    "In the centralised architecture one process decides for all robots, from the poses that they send; in a hybrid "
    "one for some. Messages are poses and goals of the whole network, leaders too; deliveries count each once for "
    "every receiver that it reached. A delay is from the measurement of a robot's pose to its acting on the first goal "
    "that rests on it: both ways through the network, and the wait for the next decision."
)
NETWORK: Final = (
    "The effects that the file asks of the network, on top of the real network's own: dropped poses did arrive, and "
    "were discarded. Delays are from the stamp of a pose to its arrival, whatever caused them."
)
SAME_STARTS: Final = (
    "All seeds begin at the same poses: intervals (±) are of noise and network alone; "
    "start.scatter in the file varies the starts."
)
FOR_A_PAPER: Final = (
    "For a paper: `./zenpark report FOLDER --pdf`, with the folder of this page, writes each figure as PDF beside the "
    "SVG in figures/; --width 7.16 makes it as wide as both columns."
)
DIFFERENCES: Final = (
    "Experiment file, options, seeds, code and versions. What follows is to be read with these in mind."
)


def write(
    folder: Path,
    traces: Sequence[Trace],
    *,
    text: str = "",
    date: str = "",
    measured: Sequence[CaseMetrics] | None = None,
    notes: Sequence[str] = (),
    run: Path | None = None,
    width: float = style.WIDTH,
    pdf: bool = False,
    drawn: bool = True,
) -> Path:
    """Writes the report of one run and its figures; how and when it was made is in `run.json` in its folder.

    Args:
        traces: The cases of the run, the reference first; several seeds of a case become means with 95 % intervals,
            and the figures of motions show the first seed.
        text: The experiment file; the experiment of the first trace as JSON if left out.
        date: When a run without `run.json` was, see `date_of`; now if left out.
        measured: `measure` of each trace, if already done; and of seeds without known traces.
        notes: What the reader should know besides: a damaged recording, robots that were lost. That runs were
            interrupted is seen from the traces.
        run: Folder of the run; the same as `folder` if left out.
        width: Width of the figures [in].
        pdf: Figures as PDF, too.
        drawn: False for a page without figures.

    Raises:
        ValueError: If there is no trace (no robot had started: there is nothing to report), or one of less than two
            samples.
    """
    if not traces:
        raise ValueError("there is no case to report: no robot had started")
    cases = [measure(trace) for trace in traces] if measured is None else measured
    first = first_seed(traces)
    experiment = traces[0].plan.experiment
    seeds = sorted({case.seed for case in cases})
    folder.mkdir(parents=True, exist_ok=True)
    made = read_origin(folder if run is None else run)
    if made is None or not made.date:  # another file of that name has no date
        made = RunOrigin(date=date or page.date_of(time.time()), made_by=provenance())
    facts = [
        ("Date", made.date),
        ("Clock", _joined(trace.clock for trace in traces)),
        ("Seed" if len(seeds) == 1 else "Seeds", page.seeds_in_words(seeds)),
        ("Duration", _joined(_length(case) for case in cases)),
        ("Robots", str(len(traces[0].robots))),
        ("Cases", ", ".join(by_case(cases))),
    ]
    bands = figures.known_bands(traces, len(seeds), Path(run or folder) / "figures")
    drawings = figures.draw(folder / "figures", cases, traces, bands, width, pdf=pdf) if drawn else {}
    pictures = _pictures(cases, traces, bands, drawings)
    short, every_event = tables.events_tables(first)
    clocks = tables.clocks_table(first)
    listing = text or msgspec.json.format(msgspec.json.encode(experiment), indent=2).decode()
    sections = [
        *_tables("Criteria", CRITERIA, [tables.criteria_table(cases)], folded=False),
        *_results(cases),
        page.Section("Figures", (FOR_A_PAPER,), pictures=pictures),
        page.Section("Events", tables=(short,), more=every_event),
        *_details(cases),
        *_of_worlds(cases, drawings, len(pictures)),
        *_tables("Clocks of other machines", CLOCKS, [clocks]),
        page.Section("Experiment file", listing=listing, folded=f"{len(listing.splitlines())} lines"),
        _defined(cases),
    ]
    verdict = findings(cases, notes)
    if len(seeds) > 1 and not (experiment.start.scatter or experiment.start.scatter_yaw):
        verdict.append(page.VerdictLine("plain", SAME_STARTS))
    return page.render(
        folder / "report.html",
        title=experiment.title,
        source=experiment.source,
        facts=facts,
        command=made.command,
        verdict=verdict,
        sections=sections,
        foot=() if made.made_by is None else made.made_by.words,  # unknown of an old run
        replay=replay.embedded(traces),
    )


def labelled(runs: Sequence[tuple[str, Sequence[CaseMetrics]]]) -> list[CaseMetrics]:
    """Metrics of all cases of several runs, by names that tell the runs apart."""
    found = []
    for name, (_, cases) in zip(_distinct([name for name, _ in runs]), runs, strict=True):
        several = len({case.case for case in cases}) > 1
        for case in cases:
            label = f"{name} · {case.case}" if several else name
            found.append(msgspec.structs.replace(case, case=label, criteria=()))
    return found


def result_tables(cases: Sequence[CaseMetrics], chosen: Sequence[str] = ()) -> list[page.Table]:
    """The tables of the section "Results", and those of each robot, each with the number of seeds; some indices alone.

    Args:
        cases: The first one is the reference.
        chosen: Indices of the first table, which is then the only one.
    """
    summary, seeds = tables.summary_table(cases, chosen), max(map(len, by_case(cases).values()))
    if chosen:
        return [summary]
    whole, robots = tables.whole_tables(cases), tables.robot_tables(cases)
    if seeds > 1:
        means = tables.over_seeds(seeds)
        whole = tuple(each if each.head[0].startswith("Sum ") else _noting(means, each) for each in whole)
        robots = tuple(_noting(f"Means over {seeds} seeds.", each) for each in robots)
    return [summary, *whole, *robots]


def _noting(text: str, table: page.Table) -> page.Table:
    return replace(table, note=f"{text} {table.note}".strip())


def compare(
    target: Path,
    runs: Sequence[tuple[str, Sequence[CaseMetrics]]],
    *,
    source: str = "",
    differences: Sequence[tuple[str, str, Sequence[str]]] = (),
) -> Path:
    """Writes several runs side by side: a column for each case of each run, the first one as the reference.

    Args:
        runs: Name and metrics of each run; several seeds of a case within one run become means with 95 % intervals.
            Runs of the same name are numbered.
        differences: Name and folder of each run, and how its file, seeds and versions differ from the first one's;
            shown before anything else.

    Raises:
        ValueError: If there is no case.
    """
    names, cases = _distinct([name for name, _ in runs]), labelled(runs)
    if not cases:
        raise ValueError("there is no run to compare")
    drawn = ((figures.global_bars(cases), _global_caption(cases)), (figures.robot_bars(cases), _robot_caption(cases)))
    facts = [("Date", page.date_of(time.time())), ("Runs", ", ".join(names)), ("Reference", cases[0].case)]
    sections = [
        *_tables("Differences", DIFFERENCES, [differences_table(differences)], folded=False),
        *_results(cases),
        page.Section("Figures", pictures=page.numbered(drawn)),
        *_details(cases),
        _defined(cases),
    ]
    target.parent.mkdir(parents=True, exist_ok=True)
    return page.render(
        target,
        title="Comparison of runs",
        source=source,
        facts=facts,
        verdict=[*_noted(differences), *findings(cases)],
        sections=sections,
    )


def differences_table(differences: Sequence[tuple[str, str, Sequence[str]]]) -> page.Table:
    """Name and folder of each run, and its differences from the first one."""
    rows: list[page.TableRow] = []
    for name, folder, found in differences:
        same = "the same file, seeds and versions" if rows else "the reference"
        rows.append(page.TableRow((name, folder, "; ".join(found) or same)))
    return page.Table(("Run", "Folder", "Differs from the first in"), tuple(rows), words=True)


def _noted(differences: Sequence[tuple[str, str, Sequence[str]]]) -> Iterator[page.VerdictLine]:
    """Differences of the runs from the first one."""
    for name, _, how in differences[1:]:
        more = f" and {len(how) - 2} more" if len(how) > 2 else ""
        same = "has the same file, seeds and versions as the reference"
        text = f"{name} differs in {'; '.join(how[:2])}{more}." if how else f"{name} {same}."
        yield page.VerdictLine("fair" if how else "plain", text)


def _tables(title: str, prose: str, given: Iterable[page.Table | None], *, folded: bool = True) -> list[page.Section]:
    """A section of tables with rows; none without any."""
    shown = tuple(table for table in given if table is not None and table.rows)
    rows = f"{sum(len(table.rows) for table in shown)} rows"
    return [page.Section(title, (prose,), shown, folded=rows if folded else "")] if shown else []


def _defined(cases: Sequence[CaseMetrics]) -> page.Section:
    terms = tables.definitions(cases)
    return page.Section("Definitions", terms=terms, folded=f"{len(terms)} terms")


def _results(cases: Sequence[CaseMetrics]) -> list[page.Section]:
    return [
        page.Section("Results", (left_out(cases),), (tables.summary_table(cases), *tables.whole_tables(cases))),
        *_tables("Architecture", ARCHITECTURE, [tables.architecture_table(cases)], folded=False),
    ]


def _details(cases: Sequence[CaseMetrics]) -> list[page.Section]:
    return [
        page.Section("Each robot", tables=tables.robot_tables(cases), folded="metrics of every robot"),
        page.Section(
            "Data integrity", (PROOF,), tables.proof_tables(cases), folded="poses sent, recorded, received, lost"
        ),
        *_tables("Network model", NETWORK, tables.network_tables(cases)),
    ]


def _pictures(
    cases: Sequence[CaseMetrics], traces: Sequence[Trace], bands: Mapping[str, Band], drawings: Mapping[str, str]
) -> tuple[page.PageFigure, ...]:
    legs = "; phases begin at dashed lines" if any(len(case.starts_s) > 1 for case in cases) else ""
    seeds = len({case.seed for case in cases})
    seed = f" Seed {traces[0].seed}." if seeds > 1 else ""
    of_cases = "all cases, the first one's robots named" if len({trace.case for trace in traces}) > 1 else "by robot"
    drawn_seeds = max((band.seeds for band in bands.values()), default=1)
    curves = f"median and range of {drawn_seeds} seeds" if drawn_seeds > 1 else "single robots thin"
    pushed = any(each.mass is not None for trace in traces for each in trace.plan.experiment.arena.obstacles.values())
    standing = " Obstacles that can be pushed are where they stood at the start." if pushed else ""
    recorded = f"{seed} Recordings of the others are not kept." if seeds > 1 and drawn_seeds == 1 else ""
    captions = {
        "global_bars": _global_caption(cases),
        "formation": f"Trajectories in space, {of_cases}; start hollow, end full, with its links.{standing}{seed}",
        "robot_bars": _robot_caption(cases),
        "errors": f"Error of the worst link of the formation, mean over the last second; {curves}{legs}.{recorded}",
        "measures": f"Measures of the law over time: median of the robots, single robots thin{legs}.{seed}",
        "events": f"Transmissions of each robot{legs}.{seed}",
        "intervals": f"Share of the times between transmissions up to a length; single robots thin.{seed}",
        "plan_view": f"From above: start hollow, end full, with its links.{standing}{seed}",
    }
    return page.numbered((svg, captions[name]) for name, svg in drawings.items() if name in captions)


def _of_worlds(cases: Sequence[CaseMetrics], drawings: Mapping[str, str], figures_before: int) -> list[page.Section]:
    """Contacts, close approaches and shadow twins, where there are any."""
    sections = []
    if any(case.near or case.near_arena or case.collisions for case in cases):
        count = sum(len(case.collisions) for case in cases)
        shown = (*((tables.collision_table(cases),) if count else ()), *tables.clearance_tables(cases))
        source = FROM_WORLD if all(case.watched for case in cases) else FROM_POSITIONS
        contacts = f"{count} collisions" if count else "closest approaches"
        sections.append(page.Section("Contacts and clearances", (source,), shown, folded=contacts))
    if shadows := tables.shadow_tables(cases):
        seed = f" Seed {cases[0].seed}." if len({case.seed for case in cases}) > 1 else ""
        drawn = ((svg, f"{SHADOWS}{seed}") for name, svg in drawings.items() if name == "shadows")
        pictures, folded = page.numbered(drawn, figures_before + 1), "shadow twins against their robots"
        sections.append(page.Section("Twins beside robots", tables=shadows, pictures=pictures, folded=folded))
    return sections


def _global_caption(cases: Sequence[CaseMetrics]) -> str:
    return f"Mean transmission rate and errors, relative to {cases[0].case}. {left_out(cases)}{_interval_note(cases)}"


def _robot_caption(cases: Sequence[CaseMetrics]) -> str:
    return f"Each robot; those in brackets are left out of the means.{_interval_note(cases)}"


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, with a number behind those that were there before."""
    found: list[str] = []
    for name in names:
        tries = (name if k == 1 else f"{name} ({k})" for k in itertools.count(1))
        found.append(next(each for each in tries if each not in found))
    return found


def _length(case: CaseMetrics) -> str:
    return f"{case.duration_s:.1f} s of {case.planned_s:g} s" if case.interrupted else f"{case.duration_s:g} s"


def _interval_note(cases: Sequence[CaseMetrics]) -> str:
    most = max(len(runs) for runs in by_case(cases).values())
    return f" Whiskers: 95 % confidence over {most} seeds." if most > 1 else ""


def _joined(words: Iterable[str]) -> str:
    return " and ".join(dict.fromkeys(words))
