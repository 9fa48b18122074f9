"""The tables of a report, from measured cases; several seeds of a case become means with 95 % intervals."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from experiments.metrics.results import Approach, CaseMetrics, RobotMetrics
from experiments.metrics.statistics import by_case, ratios, spread
from experiments.recording.trace import Trace
from experiments.report.page import Cell, Row, Table, interval, number

MOST_EVENTS: Final = 200

SUMMARY: Final = (
    ("f_hz", "Transmissions per second f [Hz]"),
    ("messages", "Transmissions"),
    ("bytes", "Payload [bytes]"),
    ("iae", "IAE [m s]"),
    ("itae", "ITAE [m s²]"),
    ("rmse", "RMSE [m]"),
    ("acquired_s", "Acquired, mean over followers [s]"),
    ("lost", "Lost samples"),
    ("dropped", "Dropped by the modelled network"),
    ("missed_deadlines", "Missed deadlines"),
)
DEFINITIONS: Final = (
    ("e(t)", "Formation error of a robot: the sum of |distance − target distance| over the links on which it listens;"
     " for one that listens to nobody, over the links on which it is listened to. Taken on true positions."),
    ("f", "Transmissions over duration. Counted by running numbers, so that what a recorder lost counts too."),
    ("IAE", "Integral of e(t) over the run (trapezoidal)."),
    ("ITAE", "Integral of t · e(t); t counts from the common start."),
    ("RMSE", "Root of the mean of e(t)²."),
    ("Acquired", "From when on the moving mean over one second of the error of each link stays within the tolerance,"
     " until the next phase or the end; 0 if it never left. \"By all\" is when the last follower was there; the mean"
     " over followers is of their own times, and is given only if every follower acquired."),
    ("Phase", "From the start, or from a leg of the timeline, to the next leg or the end."),
    ("Worst link", "Of each robot the link with the largest error, averaged over the last second of a phase."),
    ("Net rotation", "How fast the formation turns about its centroid, seen from above, after it was acquired: the"
     " slope of the angle that fits the followers' positions best to those at acquisition."),
    ("Belief", "What a listener holds of a neighbour: the newest pose heard, carried on by the prediction until the"
     " next."),
    ("J2", "0.02 · transmissions + 0.1 · decisions + 0.3 · settling time + 0.1 · IAE + 0.01 · ITAE, summed over all"
     " robots, all of the whole run; the settling time is when e(t) enters 2 % of its largest value for good (the"
     " duration if never). The weights are those of the authors' benchmark, the sums are not: theirs end at the"
     " settling time, which is of 2 % of the way from first to last of Σ(d² − r²), and take half of each robot's IAE."
     " Values of the two cannot be set beside each other."),
    ("Collision", "Robots are upright cylinders of their kind's radius and height. A collision is a contact that the"
     " world's engine saw begin, with its impulse; of robots that no such engine carries it is a maximal time in which"
     " true cylinders overlap each other, an obstacle or the arena's walls."),
    ("Closest approach", "Between surfaces, negative where they overlap; that of two robots is between their centres."),
    ("Changed by safety", "Ticks on which what had been decided was changed before it went to the body; by avoidance:"
     " those of them, and of changed goals, that kept clear of something."),
    ("Twin beside a robot", "It gets the same commands, and is put onto the robot, as measured, when that is first"
     " driven and again as often as \"ahead\" says. Differences are twin less robot: errors of predicting the robot up"
     " to so far ahead. Along and across are in the robot's heading, to the left positive."),
    ("Correlation", "Pearson's, between robot and twin, of positions and of speeds over 0.2 s; a dash where one of them"
     " hardly moved."),
    ("Missed deadline", "A tick that began more than one period late."),
    ("Known", "Share of a robot's link errors that is known. Robots whose position is known for less than 95 % of the"
     " run are left out of the means; their neighbours' errors leave out the links to them."),
    ("±", "Half-width of the 95 % confidence interval of the mean over seeds (Student's t)."),
)  # fmt: skip


def summary_table(cases: Sequence[CaseMetrics]) -> Table:
    """The indices of each case, averaged over the followers, and their ratios to the first case."""
    grouped = by_case(cases)
    first = next(iter(grouped.values()))
    rows = []
    for index, label in SUMMARY:
        if index == "dropped" and not any(case.modelled for case in cases):
            continue
        cells: list[Cell] = [label]
        for runs in grouped.values():
            found = spread([run.mean[index] for run in runs])
            share = spread(ratios(runs, first, index))
            known = f" ({found.n} of {len(runs)})" if 0 < found.n < len(runs) else ""
            text = interval(found) + known
            relative = "" if runs is first or share.mean is None else f"× {share.mean:.3f}"
            half = "" if not relative or share.ci95 is None else f" ± {share.ci95:.3f}"
            cells.append((text, relative + half) if relative else text)
        rows.append(Row(tuple(cells)))
    seeds = max(len(runs) for runs in grouped.values())
    return Table(
        ("Mean per robot", *grouped),
        tuple(rows),
        note=(f"× is relative to {next(iter(grouped))}." if len(grouped) > 1 else "")
        + (f" Means over {seeds} seeds with their 95 % confidence intervals." if seeds > 1 else ""),
    )


def whole_table(cases: Sequence[CaseMetrics]) -> Table:
    """Numbers of the formation as a whole."""
    grouped = by_case(cases)
    phases = max(len(case.starts_s) for case in cases)

    def row(label: str, value: Callable[[CaseMetrics], float | None], scale: float = 1.0) -> Row:
        cells = []
        for runs in grouped.values():
            found = spread([value(run) for run in runs])
            known = f" ({found.n} of {len(runs)})" if 0 < found.n < len(runs) else ""
            cells.append(interval(found, scale) + known)
        return Row((label, *cells))

    rows = []
    for k in range(phases):
        rows += [
            row(f"Acquired by all followers{_phase(cases, k)} [s]", lambda case, k=k: _at(case.acquired_s, k)),  # type: ignore[misc]
            row(f"Worst link{_phase_end(cases, k, phases)} [cm]", lambda case, k=k: _worst(case, k), 100.0),  # type: ignore[misc]
            row(f"Net rotation{_phase(cases, k)} [mrad/s]", lambda case, k=k: _at(case.rotation_rad_s, k), 1000.0),  # type: ignore[misc]
        ]
    rows += [
        row("Belief error, RMS [mm]", lambda case: case.belief_rms, 1000.0),
        row("Belief error, largest [mm]", lambda case: case.belief_max, 1000.0),
        row("Closest approach of two robots [m]", lambda case: case.closest),
        row("Closest approach of two surfaces [cm]", lambda case: _gap(case.near), 100.0),
        row("Closest approach to the arena [cm]", lambda case: _gap(case.near_arena), 100.0),
        row("Collisions", lambda case: float(len(case.collisions))),
        row("Hardest impulse [mN s]", lambda case: _of(max, (each.impulse for each in case.collisions)), 1000.0),
        row("Changed by safety [% of ticks]", lambda case: case.intervened_share, 100.0),
        row("Changed by avoidance [% of ticks]", lambda case: case.avoided_share, 100.0),
        row("Farthest outside the arena [mm]", lambda case: case.excursion, 1000.0),
        row("Missed deadlines [% of ticks]", lambda case: case.missed_share, 100.0),
        row("Cost J2", lambda case: case.j2),
    ]
    return Table(("Whole formation", *grouped), tuple(rows))


def robot_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case a table of all robots, with means by kind and over the followers."""
    return tuple(_robot_table(name, runs) for name, runs in by_case(cases).items())


def _robot_table(case: str, runs: Sequence[CaseMetrics]) -> Table:
    out = {name for run in runs for name in (*run.leaders, *run.died)}
    names = [robot.robot for robot in runs[0].robots]
    kinds = {robot.robot: robot.kind for robot in runs[0].robots}
    kept = [name for name in names if name not in out]
    later = range(max(len(run.starts_s) for run in runs) - 1)
    columns: list[tuple[str, Callable[[RobotMetrics], float | None], float]] = [
        ("f [Hz]", lambda robot: robot.f_hz, 1.0),
        ("Sent", lambda robot: robot.messages, 1.0),
        ("IAE [m s]", lambda robot: robot.iae, 1.0),
        ("ITAE [m s²]", lambda robot: robot.itae, 1.0),
        ("RMSE [m]", lambda robot: robot.rmse, 1.0),
        ("Acquired [s]", lambda robot: robot.acquired_s, 1.0),
        *((f"{_phase(runs, k + 1).strip()} [s]", lambda robot, k=k: _later(robot, k), 1.0) for k in later),
        ("Worst link [cm]", lambda robot: robot.by_the_end[0], 100.0),
    ]
    if any(robot.coverage < 1.0 for run in runs for robot in run.robots):
        columns.append(("Known [%]", lambda robot: robot.coverage, 100.0))

    def cells(group: Sequence[str], value: Callable[[RobotMetrics], float | None], scale: float) -> str:
        found = [value(robot) for run in runs for robot in run.robots if robot.robot in group]
        known = [each for each in found if each is not None]
        return number(known[0] if len(known) == 1 else _of(statistics.fmean, known), scale)

    rows = []
    for name in names:
        shown = (f"({name})" if name in out else name, kinds[name])
        rows.append(Row((shown, *(cells([name], value, scale) for _, value, scale in columns))))
    groups = {kind: [name for name in kept if kinds[name] == kind] for kind in dict.fromkeys(kinds.values())}
    groups = {kind: group for kind, group in groups.items() if 1 < len(group) < len(kept)}
    for kind, group in [*groups.items(), ("", kept)]:
        averages = (cells(group, value, scale) for _, value, scale in columns)
        rows.append(Row(((f"mean of {len(group)}", kind), *averages), sum=True))
    return Table(("Robot", *(label for label, _, _ in columns)), tuple(rows), title=case)


def proof_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case: poses sent, recorded, received, lost, and dropped by a modelled network; seeds are added up."""
    tables = []
    for name, runs in by_case(cases).items():
        columns = 6 if runs[0].modelled else 5
        rows, total = [], [0] * columns
        for k, robot in enumerate(runs[0].robots):
            same = [run.robots[k] for run in runs]
            counts = [
                sum(each.messages for each in same),
                sum(each.recorded for each in same),
                sum(each.messages * each.listeners for each in same),
                sum(each.heard for each in same),
                sum(each.lost for each in same),
                sum(each.dropped for each in same),
            ][:columns]
            total = [a + b for a, b in zip(total, counts, strict=True)]
            rows.append(Row((robot.robot, str(robot.listeners), *(number(count) for count in counts))))
        rows.append(Row(("all", "", *(number(count) for count in total)), sum=True))
        head = ("Robot", "Listeners", "Sent", "Recorded", "To be heard", "Heard", "Lost", "Dropped")
        tables.append(Table(head[: 2 + columns], tuple(rows), title=name))
    return tuple(tables)


def gaps_table(cases: Sequence[CaseMetrics]) -> Table:
    """Shortest, median and longest time between transmissions, per robot and case."""
    grouped = by_case(cases)
    rows = []
    for robot in dict.fromkeys(robot.robot for case in cases for robot in case.robots):
        cells: list[str] = [robot]
        for runs in grouped.values():
            same = [each for run in runs for each in run.robots if each.robot == robot]
            cells += [
                number(_of(min, (each.gap_min_s for each in same))),
                number(_of(statistics.median, (each.gap_median_s for each in same))),
                number(_of(max, (each.gap_max_s for each in same))),
            ]
        rows.append(Row(tuple(cells)))
    head = [f"{name}: {what} [s]" for name in grouped for what in ("shortest", "median", "longest")]
    return Table(("Robot", *head), tuple(rows))


def links_table(cases: Sequence[CaseMetrics]) -> Table:
    """Belief error of each link, per case; the mean and the largest over several seeds."""
    grouped = by_case(cases)
    rows = []
    for k, link in enumerate(cases[0].belief):
        cells = [f"{link.listener} of {link.speaker}"]
        for runs in grouped.values():
            same = [run.belief[k] for run in runs]
            cells += [
                number(_of(statistics.fmean, (each.rms for each in same)), 1000.0),
                number(_of(max, (each.max for each in same)), 1000.0),
            ]
        rows.append(Row(tuple(cells)))
    head = [f"{name}: {what} [mm]" for name in grouped for what in ("RMS", "largest")]
    return Table(("Who holds of whom", *head), tuple(rows))


def clocks_table(traces: Sequence[Trace]) -> Table:
    """Clock offsets of other machines from the conductor's, and the error left in the stamps."""
    rows = [
        Row(
            (
                *(trace.case, lie.host, ", ".join(lie.robots)),
                *(f"{1e3 * lie.first:+.3f}", f"{1e3 * lie.last:+.3f}", f"{1e3 * lie.uncertainty:.3f}"),
                "" if lie.drift is None else f"{1e6 * lie.drift:+.1f} ± {2e6 * lie.uncertainty / lie.over:.1f}",
                *(f"{1e3 * (lie.last - lie.first):+.3f}", f"{1e3 * lie.worst:.3f}"),
            )
        )
        for trace in traces
        for lie in trace.clocks
    ]
    heading = (
        "Case",
        "Host",
        "Robots",
        "Offset before [ms]",
        "after [ms]",
        "± [ms]",
        "Drift [ppm]",
        "Added [ms]",
        "Left [ms]",
    )
    return Table(heading, tuple(rows), words=True)


def events_table(traces: Sequence[Trace]) -> Table:
    """Events of the conductor and the robots, case by case."""
    said = [(trace.case, event) for trace in traces for event in trace.events]
    rows = [
        Row((case, f"{event.stamp:.2f}", event.kind, event.source, event.text)) for case, event in said[:MOST_EVENTS]
    ]
    note = f"{len(said) - MOST_EVENTS} more are in the recording." if len(said) > MOST_EVENTS else ""
    return Table(
        ("Case", "t [s]", "What", "Who", ""), tuple(rows), note=note or ("" if rows else "Nothing."), words=True
    )


def _of(what: Callable[[Iterable[float]], float], values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return what(known) if known else None


def _gap(near: Approach | None) -> float | None:
    return None if near is None else near.gap


def _at(values: Sequence[float | None], k: int) -> float | None:
    return values[k] if k < len(values) else None


def _later(robot: RobotMetrics, k: int) -> float | None:
    return robot.phases[k].acquired_s if k < len(robot.phases) else None


def _worst(case: CaseMetrics, k: int) -> float | None:
    left = [
        robot.residual if k == 0 else robot.phases[k - 1].residual for robot in case.robots if k <= len(robot.phases)
    ]
    return _of(max, left)


def _phase(cases: Sequence[CaseMetrics], k: int) -> str:
    """Which phase: nothing for the first."""
    start = next((case.starts_s[k] for case in cases if k < len(case.starts_s)), 0.0)
    return f" after {start:g} s" if k else ""


def _phase_end(cases: Sequence[CaseMetrics], k: int, phases: int) -> str:
    return " at the end" if k == phases - 1 else f" before {_phase(cases, k + 1).removeprefix(' after ')}"
