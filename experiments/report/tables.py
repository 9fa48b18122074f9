"""Tables of a report, from measured cases; several seeds of a case become means with 95 % intervals.

Two shapes: numbers of a case, with a column for each case (`_table_by_case`); and numbers of each robot or link
(`_table_by_row`), in a table for each case.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any, Final

from agents.network.messages import Event
from experiments.metrics.criteria import judge
from experiments.metrics.metric import ERRORS, OURS, Metric, known_metrics
from experiments.metrics.results import Approach, CaseMetrics, LinkDelivery, RobotMetrics
from experiments.metrics.statistics import Spread, by_case, ratios, spread
from experiments.recording.trace import Trace
from experiments.report.page import NONE, Cell, Table, TableRow, interval, number

Line = tuple[str, Callable[[CaseMetrics], float | None], float]  # label, value of a run, scale
Column = tuple[str, Callable[[Sequence[Any]], Cell]]  # head, cell of the same robot or link in all seeds

MOST_EVENTS: Final = 200
ALIKE_S: Final = 0.2  # [s] least difference of the same event of two cases
ROUTINE: Final = ("adopted", "body", "clock", "ready", "robot", "router", "output", "start")  # kinds that stand folded
MOST_COLLISIONS: Final = 100

FORMATION: Final = (
    ("e(t)", "Formation error of a robot: the sum of |distance − target distance| over the links on which it listens;"
     " for one without incoming links, over its outgoing ones. Taken on true positions."),
)  # fmt: skip
RUN: Final = (
    ("Phase", "From the start, or from a leg of the timeline, to the next leg or the end."),
    ("Worst link", "Of each robot the link with the largest error, averaged over the last second of a phase."),
    ("Net rotation", "How fast the formation turns about its centroid, seen from above, after it was acquired: the"
     " slope of the angle that fits the followers' positions best to those at acquisition."),
    ("Collision", "Robots are upright cylinders of their kind's radius and height. A collision is a contact that the"
     " world's engine saw begin, with its impulse; of robots that no such engine carries it is a maximal time in which"
     " true cylinders overlap each other, an obstacle or the arena's walls."),
    ("Closest approach", "Between surfaces, negative where they overlap; that of two robots is between their centres."),
    ("Changed by safety", "Ticks on which what had been decided was changed before it went to the body; by avoidance:"
     " those of them, and of changed goals, that kept clear of something."),
    ("Twin beside a robot", "A twin that gets the robot's commands and is reset to its measured pose every \"ahead\""
     " seconds. Differences are twin less robot: errors of predicting the robot up to that time ahead. Along and "
     "across are in the robot's heading, to the left positive."),
    ("Correlation", "Pearson's, between robot and twin, of positions and of speeds over 0.2 s; a dash where one of them"
     " hardly moved."),
    ("Spoiled", "A run in which a robot failed or began late, 1 % of the deadlines or of the poses were missed or lost,"
     " messages could not be read, or the world was slow. Its figures are compared with none."),
    ("×", "Over the reference with the same seed, of runs of equal length that nothing spoiled."),
    ("Known", "Known share of a robot's link errors. Robots with a position known for less than 95 % of the run"
     " are left out of the means; their neighbours' errors leave out the links to them."),
    ("±", "Half-width of the 95 % confidence interval of the mean over seeds (Student's t)."),
)  # fmt: skip


def definitions(cases: Sequence[CaseMetrics] = ()) -> tuple[tuple[str, str], ...]:
    """Terms of a report and what they mean, all metrics among them."""
    return (*FORMATION, *((metric.label, metric.meaning) for metric in known_metrics(cases).values()), *RUN)


EXTREMES: Final = "Of worst, largest, longest and closest values too the mean over seeds."
EXTREME_UNITS: Final = ("Distances [cm]", "Delay of poses [ms]", "Hardest impulse [mN s]")


# ---------------------------------------------------------------------- numbers of a case


def _table_by_case(head: str, cases: Sequence[CaseMetrics], lines: Iterable[Line]) -> Table:
    """A row for each number of a case, a column for each case."""
    grouped = by_case(cases)
    rows = [
        TableRow((label, *(_over_seeds([value(run) for run in runs], scale) for runs in grouped.values())))
        for label, value, scale in lines
    ]
    return Table((head, *grouped), tuple(rows))


def _over_seeds(values: Sequence[float | None], scale: float = 1.0) -> str:
    """Mean and interval over the seeds, and the number of seeds with a known value."""
    if len(values) == 1 and isinstance(values[0], int):
        return number(values[0], scale)
    found = spread(values)
    return interval(found, scale) + (f" ({found.n} of {len(values)})" if 0 < found.n < len(values) else "")


def summary_metrics(cases: Sequence[CaseMetrics] = ()) -> dict[str, Metric]:
    """Metrics of the first table of a report: all but those that add up over robots."""
    known = known_metrics(cases).items()
    return {name: metric for name, metric in known if metric.mean != "sum" or metric.per == "case"}


def summary_table(cases: Sequence[CaseMetrics], chosen: Sequence[str] = ()) -> Table:
    """The metrics of each case, averaged over the followers, and their ratios to the first case; some, if `chosen`.

    Metrics that are unknown in every case are left out, unless they are chosen.
    """
    grouped = by_case(cases)
    first = next(iter(grouped.values()))

    def cell(runs: Sequence[CaseMetrics], index: str) -> Cell:
        text, share = _over_seeds([run.mean.get(index) for run in runs]), spread(ratios(runs, first, index))
        if runs is first or share.mean is None:
            return text
        return text, f"× {ratio_words(share)}"

    rows = []
    for name, metric in summary_metrics(cases).items():
        if name not in chosen and (chosen or not _known_at_all(cases, name)):
            continue
        head = metric.head + " of the case" * (metric.per == "case")
        rows.append(TableRow((head, *(cell(runs, name) for runs in grouped.values()))))
    seeds = max(len(runs) for runs in grouped.values())
    note = f"× is relative to {next(iter(grouped))}." if len(grouped) > 1 else ""
    note += f" {over_seeds(seeds)}" if seeds > 1 else ""
    return Table(("Mean per robot", *grouped), tuple(rows), note=note.strip())


def _known_at_all(cases: Sequence[CaseMetrics], name: str) -> bool:
    """Whether a metric is known of any case; a formation that is never acquired is a result, too."""
    return any(case.mean.get(name) is not None or (name == "acquired_s" and case.has_errors) for case in cases)


def ratio_words(share: Spread) -> str:
    """A ratio to a per mille, by which triggers differ; over seeds with the digits that its interval bears."""
    return interval(share) if share.ci95 else number(share.mean) if share.mean is None else f"{share.mean:.3f}"


def over_seeds(seeds: int) -> str:
    """Meaning of values and intervals over several seeds."""
    return f"Means over {seeds} seeds ± half-width of the 95 % confidence interval (Student's t)."


def whole_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Numbers of the formation as a whole, a table for each unit; without rows of what did not occur in any case."""
    phases = range(max(len(case.starts_s) for case in cases))
    several = max(map(len, by_case(cases).values())) > 1

    def phased(field: str, scale: float) -> list[Line]:
        """A line for each phase."""
        of_phase = [lambda case, k=k: next(iter(getattr(case, field)[k:]), None) for k in phases]
        return [(_phase(cases, k).strip() or "from the start", value, scale) for k, value in enumerate(of_phase)]

    units: dict[str, list[Line]] = {
        "Acquired by all followers [s]": phased("acquired_s", 1.0),
        "Distances [cm]": [
            *((f"Worst link{_phase_end(cases, k, len(phases))}", partial(_worst, k=k), 100.0) for k in phases),
            ("Closest robots, between surfaces", _value("near.gap"), 100.0),
            ("Closest to the arena", _value("near_arena.gap"), 100.0),
            ("Farthest outside the arena", _value("excursion"), 100.0),
        ],
        "Net rotation [mrad/s]": phased("rotation_rad_s", 1000.0),
        "Delay of poses [ms]": [
            ("mean", lambda case: _delay(case, mean_delay), 1000.0),
            ("longest", lambda case: _delay(case, lambda links: _known(max, (e.delay_max for e in links))), 1000.0),
        ],
        "Share of all ticks [%]": [
            ("Changed by safety", _value("intervened_share"), 100.0),
            ("Changed by avoidance", _value("avoided_share"), 100.0),
            ("Missed deadlines", _value("missed_share"), 100.0),
        ],
        "Collisions": [("Number", lambda case: len(case.collisions), 1.0)],
        "Hardest impulse [mN s]": [
            ("of a collision", lambda case: _known(max, (each.impulse for each in case.collisions)), 1000.0)
        ],
    }
    tables = [
        replace(_table_by_case(unit, cases, lines), note=EXTREMES if several and unit in EXTREME_UNITS else "")
        for unit, lines in units.items()
    ]
    sums = [
        TableRow((metric.head, *(number(_total(runs, name)) for runs in by_case(cases).values())))
        for name, metric in known_metrics(cases).items()
        if metric.mean == "sum" and metric.per == "robot"
    ]
    tables.append(Table((f"Sum over all robots{' and seeds' if several else ''}", *by_case(cases)), tuple(sums)))
    # a formation that was never acquired is a result; without errors of links there is none
    formed = any(case.belief and case.has_errors for case in cases)
    shown = [table if formed and table is tables[0] else _occurred(table) for table in tables]
    return tuple(table for table in shown if table.rows)


def _total(runs: Sequence[CaseMetrics], name: str) -> float | None:
    """Sum of a metric over all robots and seeds."""
    return _known(sum, (robot.value(name) for run in runs for robot in run.robots))


def _occurred(table: Table) -> Table:
    """A table without the rows that are zero or unknown in every column."""
    rows = [row for row in table.rows if any(cell not in (NONE, "0") for cell in row.cells[1:])]
    return replace(table, rows=tuple(rows))


def _delay(case: CaseMetrics, what: Callable[[Sequence[LinkDelivery]], float | None]) -> float | None:
    """A statistic of the delays of a case; None in virtual time without a modelled network, where they are given."""
    return what(case.link_deliveries) if case.clock == "real" or case.modelled else None


def architecture_table(cases: Sequence[CaseMetrics]) -> Table | None:
    """A column for each case; None if every robot of every case decides for itself."""
    if not any(case.guidance for case in cases):
        return None
    grouped = by_case(cases)
    reference, first = next(iter(grouped.items()))

    table = _table_by_case(
        "Architecture",
        cases,
        [
            ("Messages of the network", _value("network_messages"), 1.0),
            ("of them poses of robots", lambda case: sum(robot.messages for robot in case.robots), 1.0),
            ("of them goals of the centre", _value("guidance.goals"), 1.0),
            ("Deliveries that arrived", _value("deliveries"), 1.0),
            ("Payload [kB]", _value("network_bytes"), 0.001),
            ("Goals per second", _value("guidance.goals_hz"), 1.0),
            ("Goals that were lost", _value("guidance.goals_lost"), 1.0),
            ("Poses that the centre never got", _value("guidance.poses_lost"), 1.0),
            ("Delay, mean [ms]", _value("guidance.delay_mean_s"), 1000.0),
            ("Delay, 95 % are below [ms]", _value("guidance.delay_p95_s"), 1000.0),
            ("Delay, longest [ms]", _value("guidance.delay_max_s"), 1000.0),
            ("Load of the centre, mean [% of a core]", _value("guidance.load"), 100.0),
            ("Load of the centre, busiest second [% of a core]", _value("guidance.load_max"), 100.0),
            ("Decisions that came too late", _value("guidance.missed"), 1.0),
        ],
    )
    rows = [TableRow(("Decides", *(architecture_of(runs[0]) for runs in grouped.values()))), *table.rows]
    if len(grouped) > 1:
        for name in ERRORS:
            relative = (interval(spread(ratios(runs, first, name))) for runs in grouped.values())
            rows.append(TableRow((f"{OURS[name].label} relative to {reference}", *relative)))
    return Table(table.head, tuple(row for row in rows if any(cell != NONE for cell in row.cells[1:])))


def architecture_of(case: CaseMetrics) -> str:
    if case.guidance is None:
        return "every robot"
    guided = case.guidance.guided
    return "the centre" if len(guided) == len(case.robots) else f"the centre for {', '.join(guided)}"


# ---------------------------------------------------------------------- numbers of each robot or link


def _table_by_row(
    case: str,
    runs: Sequence[CaseMetrics],
    columns: Sequence[Column],
    *,
    head: str = "Robot",
    items: Callable[[CaseMetrics], Iterable[Any]] = attrgetter("robots"),
    name: Callable[[Any], Cell] = attrgetter("robot"),
    sums: Mapping[Cell, Sequence[Any]] | None = None,
    totals: bool = False,
) -> Table:
    """The table of one case: a row for each robot or link, all seeds together, then rows of `sums`, or of all."""
    every = [item for run in runs for item in items(run)]
    sums = {"all": every} if totals else sums
    found: dict[Cell, list[Any]] = {}
    for item in every:
        found.setdefault(name(item), []).append(item)
    rows = [
        TableRow((what, *(cell(members) for _, cell in columns)), sum=group is sums)
        for group in (found, sums or {})
        for what, members in group.items()
    ]
    return Table((head, *(column for column, _ in columns)), tuple(rows), title=case)


def _cell(what: Callable[[Iterable[Any]], float], field: str, scale: float = 1.0) -> Callable[[Sequence[Any]], str]:
    """A statistic of the known values of a field."""
    value = attrgetter(field)
    return lambda items: number(_known(what, map(value, items)), scale)


def _measured(name: str) -> Callable[[Sequence[RobotMetrics]], str]:
    """The mean of the known values of a metric."""
    return lambda robots: number(_known(_mean, (robot.value(name) for robot in robots)))


def _mean(values: Iterable[float]) -> float:
    """The mean; a single value as it is, so that a whole number is shown as one."""
    first, *others = values
    return statistics.fmean([first, *others]) if others else first


def robot_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case a table of all robots, with means by kind and over the followers."""
    return tuple(_robot_table(name, runs) for name, runs in by_case(cases).items())


def _robot_table(case: str, runs: Sequence[CaseMetrics]) -> Table:
    left_out = {name for run in runs for name in (*run.leaders, *run.died)}
    columns: list[Column] = [
        (metric.head, _measured(name))
        for name, metric in known_metrics(runs).items()
        if metric.per == "robot"
        and (metric.shown or metric.figure)
        and (metric.mean != "sum" or _total(runs, name))
        and (_known_at_all(runs, name) or any(robot.value(name) is not None for run in runs for robot in run.robots))
    ]
    later = range(1, max(len(run.starts_s) for run in runs))
    columns += [(f"{_phase(runs, k).strip()} [s]", partial(_acquired_again, k=k)) for k in later]
    worst = "Worst link at the end" + (", mean" if len(runs) > 1 else "")
    if any(robot.by_the_end[0] is not None for run in runs for robot in run.robots):
        columns.append(
            (f"{worst} [cm]", lambda robots: number(_known(_mean, (r.by_the_end[0] for r in robots)), 100.0))
        )
    if any(robot.coverage is not None and robot.coverage < 1.0 for run in runs for robot in run.robots):
        columns.append(("Known [%]", _cell(_mean, "coverage", 100.0)))
    kept = [robot for run in runs for robot in run.robots if robot.robot not in left_out]
    every = {robot.robot: robot.kind for robot in kept}
    kinds = {kind: [name for name in every if every[name] == kind] for kind in dict.fromkeys(every.values())}
    groups = {kind: group for kind, group in kinds.items() if 1 < len(group) < len(every)} | {"": [*every]}
    sums: dict[Cell, list[RobotMetrics]] = {
        (f"mean of {len(group)}", kind): [robot for robot in kept if robot.robot in group]
        for kind, group in groups.items()
    }

    def name(robot: RobotMetrics) -> tuple[str, str]:
        return f"({robot.robot})" if robot.robot in left_out else robot.robot, robot.kind

    table = _table_by_row(case, runs, columns, name=name, sums=sums)
    return replace(table, note="In brackets: left out of the means.") if left_out else table


def _acquired_again(robots: Sequence[RobotMetrics], k: int) -> str:
    """Mean time [s] until robots had acquired the formation in phase `k`."""
    return number(_known(_mean, (phase.acquired_s for robot in robots for phase in robot.phases[k - 1 : k])))


def proof_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case: poses sent, recorded, received, lost, and dropped by a modelled network; seeds are added up."""
    columns: list[Column] = [
        ("Receivers", lambda robots: str(robots[0].receivers) if len({r.robot for r in robots}) == 1 else ""),
        ("Sent", _cell(sum, "messages")),
        ("Recorded", _cell(sum, "recorded")),
        ("To be received", lambda robots: number(sum(robot.messages * robot.receivers for robot in robots))),
        ("Received", _cell(sum, "received")),
        ("Lost", _cell(sum, "lost")),
        ("Dropped", _cell(sum, "dropped")),
    ]
    return tuple(
        _table_by_row(name, runs, columns if runs[0].modelled else columns[:-1], totals=True)
        for name, runs in by_case(cases).items()
    )


def network_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """For each case with a modelled network the fate of the poses on each link; several seeds are added up."""
    columns: list[Column] = [
        ("Received", _cell(sum, "received")),
        ("Dropped", _cell(sum, "dropped")),
        ("Share [%]", lambda links: number(dropped_share(links))),
        ("Mean delay [ms]", lambda links: number(mean_delay(links), 1e3)),
        ("Longest [ms]", _cell(max, "delay_max", 1e3)),
    ]
    items, name = attrgetter("link_deliveries"), "{0.sender} > {0.receiver}".format
    link = partial(_table_by_row, head="Link", items=items, name=name, totals=True)
    return tuple(link(case, runs, columns) for case, runs in by_case(cases).items() if runs[0].modelled)


def dropped_share(links: Sequence[LinkDelivery]) -> float | None:
    """Share of the poses on some links that the modelled network dropped [%]; None without poses."""
    dropped = sum(link.dropped for link in links)
    every = dropped + sum(link.received for link in links)
    return 100.0 * dropped / every if every else None


def mean_delay(links: Sequence[LinkDelivery]) -> float | None:
    """Mean delay over all poses received on some links [s]; None without poses."""
    received = sum(link.received for link in links)
    total = sum(link.received * link.delay_mean for link in links if link.delay_mean is not None)
    return total / received if received else None


def clearance_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Closest approaches of each robot and its changed ticks, per case; over seeds the nearest and the mean."""

    def nearest(robots: Sequence[RobotMetrics], field: str) -> Approach | None:
        known = [near for near in map(attrgetter(field), robots) if near is not None]
        return min(known, key=attrgetter("gap"), default=None)

    def gap(robots: Sequence[RobotMetrics], field: str) -> Cell:
        return NONE if (near := nearest(robots, field)) is None else (number(near.gap, 100.0), near.between[1])

    def at(robots: Sequence[RobotMetrics], field: str) -> Cell:
        return NONE if (near := nearest(robots, field)) is None else f"{near.at_s:.2f}"

    columns: list[Column] = [
        ("To a robot [cm]", partial(gap, field="near")),
        ("t [s]", partial(at, field="near")),
        ("To the arena [cm]", partial(gap, field="near_arena")),
        ("t [s]", partial(at, field="near_arena")),
        ("Collisions", _cell(sum, "collisions")),
        ("Changed by safety [%]", _cell(statistics.fmean, "intervened_share", 100.0)),
        ("By avoidance [%]", _cell(statistics.fmean, "avoided_share", 100.0)),
    ]
    return tuple(_table_by_row(name, runs, columns) for name, runs in by_case(cases).items())


def shadow_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case the agreement of shadow twins with their robots, of the first seed; nothing where there are none."""

    def signed(*fields: str, scale: float = 100.0, form: str = ".2f") -> Callable[[Sequence[RobotMetrics]], str]:
        """Values with a sign, those along axes one by one; 0.0 instead of -0.0."""

        def text(value: float | None) -> str:
            return NONE if value is None else f"{round(value * scale, int(form[1])) + 0.0:{form}}".replace("-", "−")

        def cell(robots: Sequence[RobotMetrics]) -> str:
            values = [getattr(robots[0].shadow, field) for field in fields]
            return ", ".join(text(part) for each in values for part in (each if isinstance(each, tuple) else (each,)))

        return cell

    def ahead(robots: Sequence[RobotMetrics]) -> str:
        horizon_s = robots[0].shadow and robots[0].shadow.horizon_s
        return "all of it" if horizon_s is None else f"{horizon_s:g}"

    columns: list[Column] = [
        ("Ahead [s]", ahead),
        ("Bias x, y, z [cm]", signed("bias")),
        ("Along, across [cm]", signed("along", "across")),
        ("Yaw [mrad]", signed("bias_yaw", scale=1000.0, form=".1f")),
        ("RMSE [cm]", _cell(max, "shadow.rmse", 100.0)),
        ("RMSE yaw [mrad]", _cell(max, "shadow.rmse_yaw", 1000.0)),
        ("Largest [cm]", _cell(max, "shadow.largest", 100.0)),
        ("Correlation x, y, z", signed("correlation", scale=1.0, form=".4f")),
        ("of speeds", signed("correlation_speed", scale=1.0, form=".4f")),
    ]

    def shadows(run: CaseMetrics) -> list[RobotMetrics]:
        return [robot for robot in run.robots if robot.shadow is not None]

    tables = (_table_by_row(name, runs[:1], columns, items=shadows) for name, runs in by_case(cases).items())
    return tuple(table for table in tables if table.rows)


# ---------------------------------------------------------------------- lists of what happened


def collision_table(cases: Sequence[CaseMetrics]) -> Table:
    several = len({case.seed for case in cases}) > 1
    found = [(case, each) for case in cases for each in case.collisions]
    rows = []
    for case, each in found[:MOST_COLLISIONS]:
        where = (case.case, f"seed {case.seed}") if several else case.case
        depth, impulse = number(each.overlap, 100.0), number(each.impulse, 1000.0)
        rows.append(TableRow((where, f"{each.time_s:.2f}", each.first, each.second, impulse, depth)))
    head = ("Case", "t [s]", "First", "Second", "Impulse [mN s]", "Overlap [cm]")
    return Table(head, tuple(rows), note=_hidden_rows_note(len(found) - MOST_COLLISIONS, "metrics.json"), words=True)


def criteria_table(cases: Sequence[CaseMetrics]) -> Table:
    """Criteria of the file with what was reached, over the seeds, and how many seeds keep them."""
    rows = []
    for each in judge(cases):
        kept, reached = len(each.values) - len(each.failed), interval(spread([*each.values.values()]))
        answer = "not judged" if each.passed is None else f"{kept} of {len(each.values)}"
        rows.append(TableRow((each.what, each.limit, reached, answer, each.criterion.why)))
    return Table(("Criterion", "Limit", "Reached", "Seeds", "Why"), tuple(rows), words=True)


def clocks_table(traces: Sequence[Trace]) -> Table:
    """Clock offsets of other machines from the conductor's, and the error left in the stamps."""
    rows = []
    for case, offset in ((trace.case, offset) for trace in traces for offset in trace.clocks):
        drift = ""
        if offset.drift is not None:
            drift = f"{1e6 * offset.drift:+.1f} ± {2e6 * offset.uncertainty / offset.over:.1f}"
        before = (f"{1e3 * offset.first:+.3f}", f"{1e3 * offset.last:+.3f}", f"{1e3 * offset.uncertainty:.3f}")
        left = (f"{1e3 * (offset.last - offset.first):+.3f}", f"{1e3 * offset.worst:.3f}")
        rows.append(TableRow((case, offset.host, ", ".join(offset.robots), *before, drift, *left)))
    head = ("Case", "Host", "Robots", "Offset before [ms]", "after [ms]", "± [ms]", "Drift [ppm]")
    return Table((*head, "Added [ms]", "Left [ms]"), tuple(rows), words=True)


def events_tables(traces: Sequence[Trace]) -> tuple[Table, tuple[str, Table] | None]:
    """Hazards, phases and orders, case by case; and if there was more, all events behind how many they are."""
    events = _merged_events(traces)
    head = ("Case", "t [s]", "Event", "Source", "")

    def table(chosen: Sequence[tuple[str, Event]]) -> Table:
        rows = [TableRow((case, f"{e.stamp:.2f}", e.kind, e.source, e.text)) for case, e in chosen[:MOST_EVENTS]]
        return Table(head, tuple(rows), note=_hidden_rows_note(len(chosen) - MOST_EVENTS, "the recording"), words=True)

    telling = [(case, event) for case, event in events if event.kind not in ROUTINE]
    short = table(telling) if telling else Table(head, (), note="No hazard, no leg of the timeline, no order.")
    hidden = len(events) > len(telling)
    return short, (f"All {len(events)} events", table(events)) if hidden else None


def _merged_events(traces: Sequence[Trace]) -> list[tuple[str, Event]]:
    """Case and event; an event that all cases have at the same time, within `ALIKE_S`, once, as of the first."""
    of_case: list[dict[tuple[str, str, str, int], Event]] = []
    for trace in traces:
        times = Counter[tuple[str, str, str]]()
        found = {}
        for each in trace.events:
            what = (each.kind, each.source, each.text)
            times[what] += 1
            found[*what, times[what]] = each
        of_case.append(found)
    alike = set[tuple[str, str, str, int]]()
    if len(of_case) > 1:
        for key in set.intersection(*(set(found) for found in of_case)):
            stamps = [found[key].stamp for found in of_case]
            alike |= {key} if max(stamps) - min(stamps) <= ALIKE_S else set()
    return [
        ("all" if key in alike else trace.case, event)
        for k, (trace, found) in enumerate(zip(traces, of_case, strict=True))
        for key, event in found.items()
        if k == 0 or key not in alike
    ]


def _hidden_rows_note(hidden: int, where: str) -> str:
    return f"{hidden} more are in {where}." if hidden > 0 else ""


def _known(what: Callable[[Iterable[Any]], float], values: Iterable[float | None]) -> float | None:
    """A statistic of the known values; None without any."""
    known = [value for value in values if value is not None]
    return what(known) if known else None


def _value(path: str) -> Callable[[CaseMetrics], float | None]:
    """A field of a case, or one of what stands there; None where nothing stands there."""
    outer, _, inner = path.partition(".")
    return lambda case: getattr(getattr(case, outer), inner, None) if inner else getattr(case, outer)


def _worst(case: CaseMetrics, k: int) -> float | None:
    """Largest residual of a phase [m]."""
    residuals = ([robot.residual, *(phase.residual for phase in robot.phases)] for robot in case.robots)
    return _known(max, (each[k] for each in residuals if k < len(each)))


def _phase(cases: Sequence[CaseMetrics], k: int) -> str:
    """Suffix naming a later phase; empty for the first."""
    start = next((case.starts_s[k] for case in cases if k < len(case.starts_s)), 0.0)
    return f" after {start:g} s" if k else ""


def _phase_end(cases: Sequence[CaseMetrics], k: int, phases: int) -> str:
    return " at the end" if k == phases - 1 else f" before {_phase(cases, k + 1).removeprefix(' after ')}"
