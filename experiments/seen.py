"""What is seen of a run: of each robot, and of the whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Final, Literal

from agents import wire
from agents.clock import Clock
from agents.lifecycle import Phase

ORDER: Final = tuple(phase.word for phase in Phase)
FROZEN_S: Final = 3.0  # a robot whose status is older than this is shown as silent

Out = Literal["", "lost", "removed", "standby"]


@dataclass
class Seen:
    """What the conductor knows of a robot.

    Attributes:
        status: Its last status.
        error: Formation error as the robot itself sees it [m]; None of one that is guided, and sees none.
        sent: Poses that it sent, and `rate` of them over the last second [1/s].
        alive: Whether its liveliness token stands.
        out: Why the run goes on without it, if it does: its process has ended or its token vanished ("lost"), it was
            taken out ("removed"), or nobody asked for it yet ("standby").
        vanished: Since when its token is missing [s, monotonic]; infinity while it is not, and when that was told.
        behind: The least time from a stamp of it to its arrival [s]: small, if its clock is right.
        told: Number of the last incident that was said.
        place: Where it last said that it was [m].
        origin: Where it, or its plan, began, as its last process said: x, y, z [m] and yaw [rad].
        former: The process whose statuses are of the past: the robot has a new one, or will have.
        began: Stamp of its first tick in the experiment, UTC [s].
    """

    status: wire.Status | None = None
    error: float | None = 0.0
    rate: float = 0.0
    alive: bool = False
    out: Out = ""
    counted: tuple[float, int] = (0.0, 0)
    vanished: float = inf
    behind: float = inf
    told: int = 0
    place: wire.Vector | None = None
    origin: wire.Setpoint | None = None
    former: int | None = None
    began: float | None = None

    @property
    def gone(self) -> bool:
        """Whether the run goes on without it."""
        return bool(self.out)

    @property
    def phase(self) -> str:
        return self.status.phase if self.status is not None else "starting"

    def reached(self, phase: str) -> bool:
        """Whether it is in this phase or beyond."""
        return self.status is not None and ORDER.index(self.status.phase) >= ORDER.index(phase)

    def forget(self) -> None:
        """The process that it had is over: what it said last holds no more, but for where it was and began."""
        self.former = self.status.pid if self.status is not None else self.former
        self.status, self.alive, self.vanished = None, False, inf
        self.rate, self.counted, self.behind, self.told = 0.0, (0.0, 0), inf, 0
        self.began = None


@dataclass
class Progress:
    """What there is to show of a run; `silent_since` says when the routers fell silent [s, monotonic], if they have."""

    case: str
    phase: str
    elapsed: float | None
    duration: float
    robots: dict[str, Seen]
    events: list[wire.Event] = field(default_factory=list)
    silent_since: float = inf
    clock: Clock = field(default_factory=Clock)


class News:
    """Tells each event of a run once, whatever its case."""

    def __init__(self) -> None:
        self._told, self._case = 0, ""

    def of(self, progress: Progress) -> list[wire.Event]:
        """What has happened since it was asked last."""
        if progress.case != self._case:
            self._case, self._told = progress.case, 0
        events = progress.events[self._told :]
        self._told = len(progress.events)
        return events


Show = Callable[[Progress], None]
