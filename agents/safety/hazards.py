"""Hazards of a robot: causes, outcomes, and the state machine between them.

Pure: the causes present on a tick go in (`agents.safety.detection`), and out comes whether the robot must hold, land or
have its motors cut. `Cause` is the whole definition of each.

An outcome only becomes harder while its cause lasts: warn -> hold -> land -> cut. A hold ends when its cause has
ended; landing and cutting never end.

Quiet: `Hazards.advance`. A robot without a cause and with nothing `under_way` leaves it out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from math import inf
from typing import Final, NamedTuple

from agents.body.kinds import Kind
from agents.body.limits import Limits

QUIET_S: Final = 1.0  # absence of a cause that ends its hazard: a flickering one is reported once
ROUNDING_S: Final = 1e-9
NEVER: Final = inf
ALL: Final = -1  # bits of all causes
BY_OPERATOR = "by an operator"
OVER, UNRESOLVED = "over", "unresolved at the end"  # first words of the last incident of a hazard


class Outcome(IntEnum):
    """Response to a hazard; the numbers grow with severity."""

    NONE = 0
    WARN = 1  # goes on, within its limits; reported to people
    HOLD = 2  # stays in place
    LAND = 3  # flying robots land, ground robots halt, for good
    CUT = 4  # motors off at once


@dataclass(frozen=True)
class Rule:
    """Response to a cause."""

    words: str  # name for people
    first: Outcome  # outcome when the cause lasted for `after_s` without a break
    after_s: float = 0.0  # [s]
    then: Outcome = Outcome.NONE  # outcome after `then_s`
    then_s: float = NEVER  # [s] time since the cause began, as `after_s`
    clears_s: float = 0.0  # absence of the cause that ends a hold [s]
    repeats: bool = False  # a cause that returns within `QUIET_S` counts as lasting
    place: bool = True  # a hold keeps the place where it began; else only setpoints stop
    landing: bool = False  # checked while a robot lands as well
    grounded: Outcome | None = None  # `then` of robots that do not fly, where different
    grounded_s: float = 0.0  # delay of their `then` [s]


class Cause(IntEnum):
    """Cause of a hazard with its rule; numbers, in this order, are places in its lists and bits: append at the end."""

    rule: Rule

    def __new__(cls, rule: Rule) -> Cause:
        cause = int.__new__(cls, len(cls.__members__))
        cause._value_, cause.rule = len(cls.__members__), rule
        return cause

    ORDERED = Rule("ordered", Outcome.HOLD)
    POSITION = Rule("its own position is lost", Outcome.HOLD, then=Outcome.LAND, place=False, grounded=Outcome.HOLD)
    MARGIN = Rule("it is beyond a wall of the arena", Outcome.WARN)
    OUTSIDE = Rule("it left the arena", Outcome.LAND)
    # one wrong measurement must not drop a drone; while it lands it may still be flying away
    FAR_OUTSIDE = Rule("it flies away", Outcome.CUT, after_s=0.1, landing=True)
    SEPARATION = Rule("minimum separation", Outcome.HOLD, clears_s=0.5)
    TOUCHING = Rule("far too near to another robot", Outcome.LAND)
    OVERSPEED = Rule(
        "it moves faster than it can", Outcome.HOLD, after_s=0.2, then=Outcome.LAND, then_s=1.0, clears_s=0.5
    )
    TILT = Rule("it has tipped over", Outcome.CUT, after_s=0.1, landing=True)
    NEIGHBOUR = Rule("a neighbour is lost", Outcome.WARN)
    ALONE = Rule("all its neighbours are lost", Outcome.HOLD)
    CENTRE = Rule("it gets no goals", Outcome.HOLD)
    BATTERY = Rule("its battery is low", Outcome.LAND, after_s=1.0)  # its voltage sags under a short load
    ROUTER = Rule("no connection to a router", Outcome.HOLD, then=Outcome.LAND)
    CONDUCTOR = Rule("the conductor is gone", Outcome.WARN, after_s=2.0)  # offline robots see it first again
    FALLEN = Rule("it came down by itself", Outcome.LAND)
    SETPOINT = Rule(
        "what it wants is not a setpoint", Outcome.HOLD, then=Outcome.LAND, then_s=0.5, repeats=True, place=False
    )
    LATE = Rule("its control loop misses its ticks", Outcome.HOLD, then=Outcome.LAND, then_s=5.0, clears_s=0.5)
    LANDING = Rule("its landing takes too long", Outcome.CUT, landing=True)
    BELOW = Rule("a robot is below it", Outcome.WARN, landing=True)
    # its device lands it, or its battery is empty: neighbours must not follow
    SINKING = Rule("it comes down by itself", Outcome.LAND, after_s=0.1)
    CLOCK = Rule("the clock that stamps its positions is off", Outcome.WARN, after_s=0.5)  # not one late sample
    BEHIND = Rule("a neighbour's clock is behind", Outcome.WARN)
    FOREIGN = Rule("a tool sends poses of a neighbour", Outcome.WARN, after_s=1.0)  # not late ones of a former process
    REFUSED = Rule("all poses of a neighbour are refused", Outcome.WARN)  # it counts as lost, too
    SUSPENDED = Rule("its process stood still", Outcome.HOLD)
    # a position that does not follow is a wrong one, by which the robot would go away; on wheels it may only be stuck
    UNRESPONSIVE = Rule(
        "it does not obey commands to move", Outcome.WARN, then=Outcome.LAND, then_s=0.0, grounded_s=2.0
    )
    STRAYING = Rule("it moves without a command", Outcome.LAND)
    UNREACHABLE = Rule("its device does not answer", Outcome.WARN, after_s=0.5, landing=True)
    HOVERING = Rule("it hovers although commanded to land", Outcome.WARN, after_s=2.0, landing=True)
    UNSEEING = Rule("its range sensors are silent", Outcome.HOLD)  # avoidance would drive it against what it saw
    UNSTARTED = Rule("no start will come", Outcome.LAND)  # it would hover until its battery is empty
    # by positions that are wrong it flies away, in the air or in a landing: it falls from some decimetres instead
    STUCK = Rule("its measured height does not follow its climb", Outcome.CUT)
    TURNED = Rule("it flies beside its commands", Outcome.CUT, after_s=0.3)
    OWNER = Rule("it asked who owns its name", Outcome.HOLD, place=False, landing=True)  # noted afterwards


_LOST: Final[Mapping[str, Outcome]] = {
    "drop": Outcome.WARN,
    "finish": Outcome.WARN,
    "hold": Outcome.HOLD,
    "land": Outcome.LAND,
}


@lru_cache(16)
def rules(limits: Limits) -> list[Rule]:
    """Rules of all causes, with the numbers and the choices of an experiment."""
    chosen = {
        Cause.POSITION: {"then_s": limits.land_without_position_s if limits.hold_s is None else limits.hold_s},
        # robots of a world, which wait longer without a position, do not move while it is paused
        Cause.UNRESPONSIVE: {
            "then_s": 0.0 if limits.hold_s is None or limits.hold_s == limits.land_without_position_s else NEVER
        },
        Cause.NEIGHBOUR: {"first": _LOST[limits.lost_neighbour]},
        Cause.ROUTER: {"after_s": limits.neighbour_timeout_s, "then_s": limits.offline_s},
        Cause.CONDUCTOR: {"first": _LOST[limits.lost_conductor]},
        Cause.UNSTARTED: {"after_s": limits.offline_s},
        Cause.LANDING: {"after_s": limits.landing_s},
    }
    return [replace(cause.rule, **chosen.get(cause, {})) for cause in Cause]  # type: ignore[arg-type]


def failed(text: str) -> bool:
    """Whether an incident's text means that a robot no longer does its part of an experiment.

    Such a robot has landed, was cut, does not obey commands to move, its device does not answer, or it has no position
    at the end.
    """
    outcome, _, words = text.partition(": ")
    severe = tuple(cause.rule.words for cause in (Cause.UNRESPONSIVE, Cause.UNREACHABLE, Cause.HOVERING))
    blind = outcome == UNRESOLVED and is_blind(text)
    return outcome in {"land", "cut"} or (outcome == "warn" and words.startswith(severe)) or blind


def is_blind(text: str) -> bool:
    """Whether an incident's text is about a lost own position."""
    return text.partition(": ")[2].startswith(Cause.POSITION.rule.words)


class HazardChange(NamedTuple):
    """Begin, change or end of a hazard: time [s], cause, outcome, and text."""

    time: float
    cause: Cause
    outcome: Outcome
    text: str


class Hazards:
    """State machine of one robot; a set of causes is an int with the bits `1 << cause`."""

    def __init__(self, kind: Kind, limits: Limits) -> None:
        table = rules(limits)
        self.held = False  # the robot must keep its place
        self.under_way = False  # a hazard exists, or its begin or end is pending: `update` must be called
        self.incidents: list[HazardChange] = []  # changes since the reader emptied the list
        # as in `Rule`, by the number of the cause, or as a set
        self.first, self.after_s = [int(rule.first) for rule in table], [rule.after_s for rule in table]
        self.then = [int(rule.then if kind.flies or rule.grounded is None else rule.grounded) for rule in table]
        self.then_s = [rule.then_s + (0.0 if kind.flies else rule.grounded_s) for rule in table]
        self.clears_s = [rule.clears_s for rule in table]
        self.repeats = sum(1 << cause for cause, rule in enumerate(table) if rule.repeats)
        self.place = sum(1 << cause for cause, rule in enumerate(table) if rule.place)
        self.landing = sum(1 << cause for cause, rule in enumerate(table) if rule.landing)
        # by the number of the cause, or as a set
        self.since = [NEVER] * len(table)  # begin of its presence without a break [s]; infinity: absent
        self.begun = [NEVER] * len(table)  # begin of its hazard [s]; infinity: none
        self.last = [-NEVER] * len(table)  # last presence [s]
        self.lasted_s = [0.0] * len(table)  # duration of its last hazard that ended [s]
        self.level = [0] * len(table)  # outcome
        self.present = 0  # causes on the last tick
        self.open = 0  # present on the last tick, or with a hazard
        self.unresolved = 0  # present until the robot ended, on the last tick
        self.texts: dict[Cause, str] = {}  # texts of hazards

    def update(
        self, t: float, causes: int, words: Callable[[Cause], str], *, active: bool, landing: bool
    ) -> list[HazardChange]:
        """Update at `t` [s] with the `causes` of this tick; returns landings and cuts that begin now, the hardest last.

        Hazards are for a robot that is `active`: it climbs, waits aloft or runs; those with `Rule.landing` for one that
        is `landing` as well. `words` gives the extent of one of the causes.
        """
        changed = self.advance(t, causes, active, landing)
        return self._record(t, changed, words) if changed else []

    def advance(self, t: float, causes: int, active: bool, landing: bool) -> int:
        """Advance to `t` [s], as `update`; returns the set of causes with a changed outcome."""
        watched = 0
        if active:
            watched = ALL
        elif landing:
            watched = self.landing
        causes &= watched
        changed = unresolved = number = 0
        held = False
        left, self.open = causes | self.open, causes
        while left >> number:
            bit = 1 << number
            if left & bit:
                before = self.level[number]
                if causes & bit:
                    self._worsen(t, number)
                else:
                    ended = self.present & ~watched & bit  # the cause is still there, but the robot has ended
                    unresolved |= ended
                    self._calm(t, number, ended != 0)
                    if self.begun[number] < NEVER:
                        self.open |= bit
                level = self.level[number]
                if level != before:
                    changed |= bit
                if level == Outcome.HOLD and self.place & bit:
                    # present, or absent for less than its time
                    held = held or causes & bit != 0 or t - self.last[number] < self.clears_s[number] - ROUNDING_S
            number += 1
        self.present, self.unresolved = causes, unresolved
        self.held, self.under_way = held, self.open != 0
        return changed

    def _worsen(self, t: float, number: int) -> None:
        """A cause is present at `t` [s]."""
        self.since[number] = since = min(self.since[number], t)
        self.last[number] = t
        if self.begun[number] == NEVER and t - since >= self.after_s[number] - ROUNDING_S:
            self.begun[number] = since
        begun = self.begun[number]
        if begun == NEVER:
            return
        level = max(self.level[number], self.first[number])
        if t - (begun if self.repeats >> number & 1 else since) >= self.then_s[number] - ROUNDING_S:
            level = max(level, self.then[number])
        self.level[number] = level

    def _calm(self, t: float, number: int, ended: bool) -> None:
        """A cause is absent at `t` [s], or the robot has `ended`."""
        self.since[number] = NEVER
        if self.begun[number] == NEVER or self.level[number] >= Outcome.LAND:
            return
        silence = t - self.last[number]
        if ended or silence >= max(self.clears_s[number], QUIET_S) - ROUNDING_S:
            self.lasted_s[number] = self.last[number] - self.begun[number]
            self.begun[number], self.level[number] = NEVER, 0

    def _record(self, t: float, changed: int, words: Callable[[Cause], str]) -> list[HazardChange]:
        """Record changes in words; returns landings and cuts, the hardest last."""
        news = []
        for cause in Cause:
            if not changed >> cause & 1:
                continue
            outcome, rule = Outcome(self.level[cause]), cause.rule.words
            if outcome == Outcome.NONE:
                end = f"{UNRESOLVED}: {rule}, for" if self.unresolved >> cause & 1 else f"{OVER}: {rule}, after"
                text = f"{end} {self.lasted_s[cause]:.2f} s"
                self.texts.pop(cause, None)
            else:
                text = f"{outcome.name.lower()}: {rule}: {words(cause)}"
                self.texts[cause] = text
            news.append(HazardChange(t, cause, outcome, text))
        news.sort(key=lambda incident: incident.outcome)
        self.incidents += news
        return [incident for incident in news if incident.outcome >= Outcome.LAND]

    def worst(self) -> str:
        """Text of the worst hazard, the outcome first; empty without one."""
        return self.texts[max(self.texts, key=lambda cause: self.level[cause])] if self.texts else ""

    def outcome(self) -> Outcome:
        return Outcome(max(self.level))
