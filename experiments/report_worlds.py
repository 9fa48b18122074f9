"""The tables of a report on what touched or came near, on avoidance, and on twins beside robots."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Final

from experiments.measured import Approach, CaseMetrics, RobotMetrics, ShadowMetrics
from experiments.report_tables import NONE, Row, Table, number
from experiments.seeds import by_case

MOST_COLLISIONS: Final = 100


def collision_table(cases: Sequence[CaseMetrics]) -> Table:
    """Everything that touched, case by case."""
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
    """Every robot that had a twin beside it."""
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
