"""Hazards of a robot: causes, outcomes, and the state machine between them.

Pure and row-wise: the causes present on a tick go in (`agents.safety.detection`), and out come the rows that must
hold, land or have their motors cut. `Cause` is the whole definition of each.

An outcome only becomes harder while its cause lasts: warn -> hold -> land -> cut. A hold ends when its cause has
ended; landing and cutting never end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.body.limits import Limits

QUIET_S: Final = 1.0  # absence of a cause that ends its hazard: a flickering one is reported once
ROUNDING_S: Final = 1e-9
NEVER: Final = np.inf
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

    words: str  # for people
    first: Outcome  # outcome when the cause lasted for `after_s` without a break
    after_s: float | Array = 0.0  # [s]; one number, or one for each row
    then: Outcome = Outcome.NONE  # outcome after `then_s`
    then_s: float | Array = NEVER  # [s] since the cause began; one number, or one for each row
    clears_s: float = 0.0  # absence of the cause that ends a hold [s]
    repeats: bool = False  # a cause that returns within `QUIET_S` counts as lasting
    place: bool = True  # a hold keeps the place where it began; else only setpoints stop
    landing: bool = False  # checked while a robot lands as well
    grounded: Outcome | None = None  # `then` of robots that do not fly, where different
    grounded_s: float = 0.0  # by which their `then` comes later [s]


class Cause(IntEnum):
    """Cause of a hazard with its rule; the numbers, in this order, are the rows of the state machine."""

    rule: Rule

    def __new__(cls, rule: Rule) -> Cause:
        cause = int.__new__(cls, len(cls.__members__))
        cause._value_, cause.rule = len(cls.__members__), rule
        return cause

    ORDERED = Rule("ordered to hold", Outcome.HOLD)
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
    CENTRE = Rule("nobody guides it", Outcome.HOLD)
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
    STANDSTILL = Rule("its process stood still", Outcome.HOLD)
    # a position that does not follow is a wrong one, by which the robot would go away; on wheels it may only be stuck
    STILL = Rule("it is told to move and does not", Outcome.WARN, then=Outcome.LAND, then_s=0.0, grounded_s=2.0)
    STRAYING = Rule("it moves and is not told to", Outcome.LAND)
    UNREACHABLE = Rule("its device does not answer", Outcome.WARN, after_s=0.5, landing=True)
    HOVERING = Rule("it is told to land and hovers", Outcome.WARN, after_s=2.0, landing=True)
    UNSEEING = Rule("its range sensors are silent", Outcome.HOLD)  # avoidance would drive it against what it saw
    UNSTARTED = Rule("nobody will start it", Outcome.LAND)  # it would hover until its battery is empty


_LOST: Final[Mapping[str, Outcome]] = {
    "drop": Outcome.WARN,
    "finish": Outcome.WARN,
    "hold": Outcome.HOLD,
    "land": Outcome.LAND,
}


def rules(limits: Limits) -> list[Rule]:
    """Rules of all causes, with the numbers and the choices of an experiment."""
    chosen = {
        Cause.POSITION: {"then_s": limits.blind_s if limits.hold_s is None else limits.hold_s},
        # robots of a world, which wait longer without a position, do not move while it is paused
        Cause.STILL: {
            "then_s": 0.0 if limits.hold_s is None else np.where(limits.hold_s == limits.blind_s, 0.0, NEVER)
        },
        Cause.NEIGHBOUR: {"first": _LOST[limits.lost_neighbour]},
        Cause.ROUTER: {"after_s": limits.link_silence_s, "then_s": limits.offline_s},
        Cause.CONDUCTOR: {"first": _LOST[limits.lost_conductor]},
        Cause.UNSTARTED: {"after_s": limits.offline_s},
        Cause.LANDING: {"after_s": limits.landing_s},
    }
    return [replace(cause.rule, **chosen.get(cause, {})) for cause in Cause]  # type: ignore[arg-type]


def failed(text: str) -> bool:
    """Whether an incident's text tells that a robot does not do its part of an experiment any more.

    It has landed, was cut, does not move although it is told to, its device does not answer, or it has no position at
    the end.
    """
    outcome, _, words = text.partition(": ")
    severe = tuple(cause.rule.words for cause in (Cause.STILL, Cause.UNREACHABLE, Cause.HOVERING))
    blind = outcome == UNRESOLVED and is_blind(text)
    return outcome in {"land", "cut"} or (outcome == "warn" and words.startswith(severe)) or blind


def is_blind(text: str) -> bool:
    """Whether an incident's text is about a lost own position."""
    return text.partition(": ")[2].startswith(Cause.POSITION.rule.words)


class Observation(NamedTuple):
    """Cause present on this tick: its rows (N,), and its extent there, in words with numbers."""

    cause: Cause
    rows: Mask
    detail: Callable[[int], str]


class Incident(NamedTuple):
    """Begin, change or end of a hazard: time [s], row, cause, outcome, and text."""

    time: float
    row: int
    cause: Cause
    outcome: Outcome
    text: str


class Hazards:
    """State machine of N rows."""

    def __init__(self, flies: Mask, limits: Limits) -> None:
        """Of rows that fly or not (N,)."""
        table, shape = rules(limits), (len(Cause), len(flies))

        def column(name: str) -> Array:
            return np.stack([np.broadcast_to(np.asarray(getattr(rule, name), float), shape[1:]) for rule in table])

        def mask(name: str) -> Mask:
            return np.array([[getattr(rule, name)] for rule in table], dtype=bool)

        self._after, self._then_s, self._clears = column("after_s"), column("then_s"), column("clears_s")
        self._first, then = column("first").astype(np.intp), column("then").astype(np.intp)
        for row, rule in enumerate(table):
            if rule.grounded is not None:
                then[row] = np.where(flies, then[row], rule.grounded)
            self._then_s[row] += np.where(flies, 0.0, rule.grounded_s)
        self._then = then
        self._repeats, self._place, self._landing = mask("repeats"), mask("place"), mask("landing")
        self._since, self._begun, self._last = np.full((3, *shape), NEVER)
        self._last[:] = -NEVER
        self._level: Index = np.zeros(shape, dtype=np.intp)
        self._present: Mask = np.zeros(shape, dtype=bool)  # on the last tick
        self._texts: list[dict[int, str]] = [{} for _ in flies]
        self._quiet = True
        self.held: Mask = np.zeros(len(flies), dtype=bool)  # (N,) rows that must keep their place
        self._no_row = self.held
        self.incidents: list[Incident] = []  # since the reader emptied the list

    def update(self, t: float, found: Sequence[Observation], active: Mask, landing: Mask) -> list[Incident]:
        """Update at `t` [s]; returns incidents of the rows that must land or be cut now, for the first time.

        Hazards are for `active` rows (N,), which climb, wait aloft or run; those with `Rule.landing` for `landing`
        rows (N,) as well. A cause that is not among those `found` is present on no row.
        """
        if self._quiet and not found:
            return []
        now = np.zeros(self._level.shape, dtype=bool)
        for cause, rows, _ in found:
            now[cause] = rows
        watched = active | (self._landing & landing)
        now &= watched
        before = self._level
        self._since = np.where(now, np.minimum(self._since, t), NEVER)
        begins = now & np.isinf(self._begun) & (t - self._since >= self._after - ROUNDING_S)
        self._begun = np.where(begins, self._since, self._begun)
        self._last = np.where(now, t, self._last)
        on = np.isfinite(self._begun)
        level = np.where(on, np.maximum(before, self._first), 0)
        from_when = np.where(self._repeats, self._begun, self._since)
        worse = on & now & (t - from_when >= self._then_s - ROUNDING_S)
        level = np.where(worse, np.maximum(level, self._then), level)
        silence = t - self._last
        over = on & ~now & (level < Outcome.LAND) & (silence >= np.maximum(self._clears, QUIET_S) - ROUNDING_S)
        # the cause is still there, but the row has ended
        unresolved = on & self._present & ~watched & (level < Outcome.LAND)
        lasted = self._last - self._begun
        self._begun = np.where(over | unresolved, NEVER, self._begun)
        self._level = level = np.where(over | unresolved, 0, level)
        self._present = now
        holds = (level == Outcome.HOLD) & self._place & (now | (silence < self._clears - ROUNDING_S))
        self.held = np.asarray(holds.any(axis=0))
        self._quiet = not (some(on) or some(now))
        if not some(level != before):
            return []
        return self._record(t, before, lasted, unresolved, {sighting.cause: sighting for sighting in found})

    def _record(
        self, t: float, before: Index, lasted: Array, unresolved: Mask, found: Mapping[int, Observation]
    ) -> list[Incident]:
        """Record changes in words; returns landings and cuts, the hardest of each row last."""
        news, causes = [], list(Cause)
        for number, row in np.argwhere(self._level != before).tolist():
            cause, outcome = causes[number], Outcome(self._level[number, row])
            words = cause.rule.words
            if outcome == Outcome.NONE:
                end = f"{UNRESOLVED}: {words}, for" if unresolved[cause, row] else f"{OVER}: {words}, after"
                text = f"{end} {lasted[cause, row]:.2f} s"
                self._texts[row].pop(cause, None)
            else:
                text = f"{outcome.name.lower()}: {words}: {found[cause].detail(row)}"
                self._texts[row][cause] = text
            news.append(Incident(t, row, cause, outcome, text))
        news.sort(key=lambda incident: incident.outcome)
        self.incidents += news
        return [incident for incident in news if incident.outcome >= Outcome.LAND]

    def worst(self, row: int) -> str:
        """Text of the worst hazard of a row, the outcome first; empty if it has none."""
        texts = self._texts[row]
        return texts[max(texts, key=lambda cause: int(self._level[cause, row]))] if texts else ""

    def outcome(self, row: int) -> Outcome:
        return Outcome(self._level[:, row].max())
