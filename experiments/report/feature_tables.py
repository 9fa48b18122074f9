"""The tables of a report on what touched or came near, on avoidance, and on twins beside robots."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Final

from experiments.metrics.results import Approach, CaseMetrics, Guidance, Passage, RobotMetrics, ShadowMetrics
from experiments.metrics.statistics import by_case, ratios, spread
from experiments.report.page import NONE, Row, Table, interval, number

MOST_COLLISIONS: Final = 100


def collision_table(cases: Sequence[CaseMetrics]) -> Table:
    """Contacts, case by case."""
    several = len({case.seed for case in cases}) > 1
    found = [(case, each) for case in cases for each in case.collisions]
    rows = []
    for case, each in found[:MOST_COLLISIONS]:
        where = (case.case, f"seed {case.seed}") if several else case.case
        depth, impulse = number(each.overlap, 1000.0), number(each.impulse, 1000.0)
        rows.append(Row((where, f"{each.time_s:.2f}", each.first, each.second, impulse, depth)))
    hidden = len(found) - MOST_COLLISIONS
    head = ("Case", "t [s]", "Who", "With", "Impulse [mN s]", "Overlap [mm]")
    return Table(head, tuple(rows), note=f"{hidden} more are in metrics.json." if hidden > 0 else "", words=True)


def clearance_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case how near each robot came to what, and how often it was kept off; over seeds the nearest and the mean."""
    tables = []
    head = (
        "Robot",
        "To a robot [cm]",
        "t [s]",
        "To the arena [cm]",
        "t [s]",
        "Collisions",
        "Changed by safety [%]",
        "By avoidance [%]",
    )
    for name, runs in by_case(cases).items():
        rows = []
        for k, robot in enumerate(runs[0].robots):
            same = [run.robots[k] for run in runs]
            near = _nearest([each.near for each in same])
            arena = _nearest([each.near_arena for each in same])
            shares = (_mean([each.intervened_share for each in same]), _mean([each.avoided_share for each in same]))
            rows.append(
                Row(
                    (
                        robot.robot,
                        *_approach(near),
                        *_approach(arena),
                        str(sum(each.collisions for each in same)),
                        *(number(share, 100.0) for share in shares),
                    )
                )
            )
        tables.append(Table(head, tuple(rows), title=name))
    return tuple(tables)


def shadow_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """Per case how far the twins beside robots agree with them, of the first seed; nothing where there are none."""
    head = (
        "Robot",
        "Ahead [s]",
        "Bias x, y, z [mm]",
        "Along, across [mm]",
        "Yaw [mrad]",
        "RMSE [mm]",
        "RMSE yaw [mrad]",
        "Largest [mm]",
        "Correlation x, y, z",
        "of speeds",
    )
    tables = []
    for name, runs in by_case(cases).items():
        rows = [Row((robot.robot, *_shadow(robot.shadow))) for robot in runs[0].robots if robot.shadow is not None]
        if rows:
            tables.append(Table(head, tuple(rows), title=name))
    return tuple(tables)


def shadowed(cases: Sequence[CaseMetrics]) -> list[tuple[CaseMetrics, RobotMetrics, ShadowMetrics]]:
    """Robots with a shadow twin."""
    return [(case, robot, robot.shadow) for case in cases for robot in case.robots if robot.shadow is not None]


def _shadow(shadow: ShadowMetrics) -> tuple[str, ...]:
    return (
        "all of it" if shadow.horizon_s is None else f"{shadow.horizon_s:g}",
        _list([_tenths(part, 1000.0) for part in shadow.bias]),
        _list([_tenths(part, 1000.0) for part in (shadow.along, shadow.across)]),
        _tenths(shadow.bias_yaw, 1000.0),
        number(shadow.rmse, 1000.0),
        number(shadow.rmse_yaw, 1000.0),
        number(shadow.largest, 1000.0),
        _list([_correlation(part) for part in shadow.correlation]),
        _correlation(shadow.correlation_speed),
    )


def _tenths(value: float, scale: float) -> str:
    return f"{round(value * scale, 1) + 0.0:.1f}".replace("-", "−")  # + 0.0 makes 0.0 of -0.0


def _correlation(value: float | None) -> str:
    return NONE if value is None else f"{value:.4f}".replace("-", "−")


def _list(words: Sequence[str]) -> str:
    return ", ".join(words)


def _approach(near: Approach | None) -> tuple[str | tuple[str, str], str]:
    if near is None:
        return NONE, NONE
    return (number(near.gap, 100.0), near.between[1]), f"{near.at_s:.2f}"


def _nearest(found: Sequence[Approach | None]) -> Approach | None:
    return min((each for each in found if each is not None), key=lambda each: each.gap, default=None)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


EXPLAINED: Final = (
    "In the centralised architecture one process decides for all robots, from the poses that they send; in a hybrid "
    "one for some. Messages are poses and goals of the whole network, leaders too; deliveries count each once for "
    "everybody who listens. A delay is from the measurement of a robot's pose to its acting on the first goal that "
    "rests on it: both ways through the network, and the wait for the next decision."
)


def architecture_table(cases: Sequence[CaseMetrics]) -> Table | None:
    """A column for each case; None if every robot of every case decides for itself."""
    if not any(case.guidance for case in cases):
        return None
    grouped = by_case(cases)
    first = next(iter(grouped.values()))

    def of_case(label: str, value: Callable[[CaseMetrics], float | None], scale: float = 1.0) -> Row:
        return Row((label, *(interval(spread([value(run) for run in runs]), scale) for runs in grouped.values())))

    def of_centre(label: str, value: Callable[[Guidance], float | None], scale: float = 1.0) -> Row:
        return of_case(label, lambda case: None if case.guidance is None else value(case.guidance), scale)

    def relative(label: str, index: str) -> Row:
        return Row((label, *(interval(spread(ratios(runs, first, index))) for runs in grouped.values())))

    who = [architecture_of(runs[0]) for runs in grouped.values()]
    rows = [
        Row(("Decides", *who)),
        of_case("Messages of the network", lambda case: case.network_messages),
        of_case("of them poses of robots", lambda case: sum(robot.messages for robot in case.robots)),
        of_centre("of them goals of the centre", lambda centre: centre.goals),
        of_case("Deliveries", lambda case: case.deliveries),
        of_case("Payload [kB]", lambda case: case.network_bytes, 0.001),
        of_centre("Goals per second", lambda centre: centre.goals_hz),
        of_centre("Goals that were lost", lambda centre: centre.goals_lost),
        of_centre("Poses that the centre never got", lambda centre: centre.poses_lost),
        of_centre("Delay, mean [ms]", lambda centre: centre.delay_mean_s, 1000.0),
        of_centre("Delay, 95 % are below [ms]", lambda centre: centre.delay_p95_s, 1000.0),
        of_centre("Delay, longest [ms]", lambda centre: centre.delay_max_s, 1000.0),
        of_centre("Load of the centre, mean [% of a core]", lambda centre: centre.load, 100.0),
        of_centre("Load of the centre, busiest second [% of a core]", lambda centre: centre.load_max, 100.0),
        of_centre("Decisions that came too late", lambda centre: centre.missed),
    ]
    if len(grouped) > 1:
        name = next(iter(grouped))
        rows += [relative(f"{index.upper()} relative to {name}", index) for index in ("iae", "itae", "rmse")]
    kept = [row for row in rows if any(cell != NONE for cell in row.cells[1:])]
    return Table(("Architecture", *grouped), tuple(kept))


def architecture_of(case: CaseMetrics) -> str:
    """The architecture, in words."""
    if case.guidance is None:
        return "every robot"
    guided = case.guidance.guided
    return "the centre" if len(guided) == len(case.robots) else f"the centre for {', '.join(guided)}"


PROSE: Final = (
    "What the file asks of the network, on top of what a real one does: poses that it dropped did come, and were not "
    "heard. Delays are from when a pose was taken until it was heard, whatever caused them."
)


def sentences(cases: Sequence[CaseMetrics]) -> list[str]:
    """One for each case with a modelled network: what it dropped, and how long the rest took."""
    found = []
    for name, runs in _modelled(cases).items():
        each = [link for run in runs for link in run.passages]
        heard, dropped = _counts(each)
        where = f" in {name}" if len(by_case(cases)) > 1 else ""
        text = f"The modelled network dropped {number(dropped)} of {number(heard + dropped)} samples{where}"
        text += f" ({_share(heard, dropped)} %)" if dropped else ""
        mean, longest = _delay(each)
        if mean is not None:
            text += f"; those heard took {number(mean, 1e3)} ms, at most {number(longest, 1e3)} ms"
        found.append(f"{text}.")
    return found


def network_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """For each case with a modelled network, what became of the poses on each link; several seeds are added up."""
    tables = []
    for name, runs in _modelled(cases).items():
        rows = []
        for k, link in enumerate(runs[0].passages):
            rows.append(Row((f"{link.speaker} > {link.listener}", *_cells([run.passages[k] for run in runs]))))
        rows.append(Row(("all", *_cells([link for run in runs for link in run.passages])), sum=True))
        head = ("Link", "Heard", "Dropped", "Share [%]", "Mean delay [ms]", "Longest [ms]")
        tables.append(Table(head, tuple(rows), title=name))
    return tuple(tables)


def _modelled(cases: Sequence[CaseMetrics]) -> dict[str, list[CaseMetrics]]:
    return {name: list(runs) for name, runs in by_case(cases).items() if runs[0].modelled}


def _cells(each: Sequence[Passage]) -> tuple[str, ...]:
    heard, dropped = _counts(each)
    mean, longest = _delay(each)
    return number(heard), number(dropped), _share(heard, dropped), number(mean, 1e3), number(longest, 1e3)


def _counts(each: Sequence[Passage]) -> tuple[int, int]:
    return sum(link.heard for link in each), sum(link.dropped for link in each)


def _share(heard: int, dropped: int) -> str:
    return number(100.0 * dropped / (heard + dropped) if heard + dropped else None)


def _delay(each: Sequence[Passage]) -> tuple[float | None, float | None]:
    """Mean and largest delay [s] over all poses received on some links; None if there are none."""
    heard = sum(link.heard for link in each)
    if not heard:
        return None, None
    total = sum(link.heard * link.delay_mean for link in each if link.delay_mean is not None)
    return total / heard, max(link.delay_max for link in each if link.delay_max is not None)
