"""Condition of a robot by its statuses, in one word and one row, for conductor, live table, page and replay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from agents.decision.lifecycle import FINISHED, SCRIPTED, TOLD_TO_END, Phase
from agents.network.messages import EMERGENCY, Status

Colour = tuple[int, int, int]

SILENT_S: Final = 3.0  # time without a status after which a robot counts as silent


class Condition(IntEnum):
    """Condition of a robot, as it is shown; the numbers grow with what needs attention."""

    ACTIVE = 0
    WAITING = 1  # not airborne yet
    DONE = 2
    ABSENT = 3  # the run goes on without it as its conductor or an operator wants: late, removed, on standby
    LANDING = 4
    HELD = 5
    OUT = 6  # landed before the end of its plan
    SILENT = 7  # its last status is old
    TOUCHING = 8  # overlaps another robot, an obstacle or a wall
    STOPPED = 9  # stopped by an emergency stop
    LOST = 10  # its process has ended, or its liveliness token is gone


# word, of those that have none the phase, and colour
CONDITIONS: Final[dict[Condition, tuple[str, Colour]]] = {
    Condition.ACTIVE: ("", (0, 158, 115)),
    Condition.WAITING: ("", (150, 150, 150)),
    Condition.DONE: ("done", (120, 140, 170)),
    Condition.ABSENT: ("", (150, 150, 150)),
    Condition.LANDING: ("landing", (86, 180, 233)),
    Condition.HELD: ("held", (230, 159, 0)),
    Condition.OUT: ("out of the run", (213, 94, 0)),
    Condition.SILENT: ("silent", (160, 110, 200)),
    Condition.TOUCHING: ("touches", (213, 50, 30)),
    Condition.STOPPED: ("stopped", (213, 50, 30)),
    Condition.LOST: ("lost", (213, 50, 30)),
}
RINGED: Final = (Condition.LANDING, *(each for each in Condition if each >= Condition.HELD))
AT_REST: Final = (Condition.WAITING, Condition.DONE, Condition.OUT)  # their goals are not drawn
PALED: Final = (Condition.OUT, Condition.SILENT, Condition.STOPPED, Condition.LOST)
IN_TIME: Final = (FINISHED, SCRIPTED, TOLD_TO_END, "")  # reasons of a robot that has done all of its plan


def condition(
    status: Status | None,
    phase: str | None = None,
    *,
    left: str = "",
    alive: bool = True,
    silent: bool = False,
    touches: bool = False,
) -> Condition:
    """Condition of a robot.

    Args:
        status: Last received, if any.
        phase: Word of its phase; None: that of the status.
        left: Why the run goes on without it, as its conductor says; empty while it takes part.
        alive: Its liveliness token stands.
        silent: Its last message is old.
        touches: It overlaps another robot, an obstacle or a wall.
    """
    phase = status.phase if phase is None and status is not None else phase
    done, reason = phase == Phase.DONE.word, "" if status is None else status.reason
    for case, applies in (
        (Condition.STOPPED, reason.startswith(EMERGENCY)),
        (Condition.LOST, left == "lost" or not (left or alive or done)),
        (Condition.ABSENT, bool(left)),
        (Condition.TOUCHING, touches),
        (Condition.OUT, done and reason not in IN_TIME),
        (Condition.DONE, done),
        (Condition.SILENT, silent),
        (Condition.LANDING, phase == Phase.LANDING.word),
        (Condition.WAITING, phase in (None, Phase.IDLE.word, Phase.READY.word)),
        (Condition.HELD, status is not None and status.hazard.startswith("hold")),
    ):
        if applies:
            return case
    return Condition.ACTIVE


@dataclass(frozen=True)
class RobotRow:
    """Robot in a table; None where nothing is known."""

    name: str
    condition: Condition
    phase: str = ""  # condition in a word, see `robot_row`
    error: float | None = None  # [m]
    rate: float | None = None  # [Hz] rate of transmitted poses
    late: int | None = None  # ticks that were skipped
    late_share: float = 0.0  # share of all ticks
    lost: int | None = None  # samples of neighbours
    delay: float | None = None  # [s] largest of its links
    battery: float | None = None  # 0 to 1
    sent: int | None = None  # poses
    note: str = ""
    warned: bool = False  # a hazard is present
    measures: Mapping[str, float] = field(default_factory=dict)  # measures of its law
    pid: int = 0
    cpu: float | None = None  # share of a core; of its process, if several robots share one
    growing: frozenset[str] = frozenset()  # counters "late" and "lost" that grew in the last seconds


def robot_row(
    name: str,
    condition: Condition,
    status: Status | None,
    error: float | None,
    rate: float | None = None,
    *,
    left: str = "",
    delay: float | None = None,
    ticks: bool = True,  # whether they can be missed
    touches: str = "",  # contacts in words
    measures: Mapping[str, float] | None = None,  # measures of its law
) -> RobotRow:
    """The row of a robot by its last status.

    Its word is that of its condition, or why the run goes on without it (`left`), or the phase of what goes as planned.
    """
    word = left or CONDITIONS[condition][0] or ("starting" if status is None else status.phase)
    if status is None:
        return RobotRow(name, condition, word, error, rate, delay=delay, note=touches, measures=measures or {})
    trouble = status.hazard or (status.reason if condition != Condition.DONE else "")
    if not trouble and status.missing:
        trouble = "misses " + ", ".join(status.missing)
    foreign = sum(status.foreign.values())
    counts = f"{status.malformed} malformed" * bool(status.malformed), f"{foreign} foreign" * bool(foreign)
    late, share = status.missed if ticks else None, status.missed / max(1, status.ticks + status.missed)
    return RobotRow(
        name, condition, word, error, rate, late, share, sum(status.lost.values()), delay, status.battery, status.sent,
        "; ".join(filter(None, (touches, trouble, *counts))), bool(status.hazard), measures or {},
        status.pid,
    )  # fmt: skip
