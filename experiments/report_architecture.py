"""Architectures side by side: who decides, what that costs in messages, and how late it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from experiments.measured import CaseMetrics, Guidance
from experiments.report_tables import NONE, Row, Table, interval
from experiments.seeds import by_case, ratios, spread

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
    """Who decides, in words."""
    if case.guidance is None:
        return "every robot"
    guided = case.guidance.guided
    return "the centre" if len(guided) == len(case.robots) else f"the centre for {', '.join(guided)}"
