"""What may go wrong with a robot, and what is done about it: causes, outcomes, and the state machine between them.

Pure and row-wise: what is seen of each cause on a tick goes in (`agents.safety.detection`), and out come the rows that
must hold, land or have their motors cut. The table `rules` is all there is to know about a cause.

An outcome only ever becomes harder while its cause lasts: warn -> hold -> land -> cut. A hold ends when its cause has
ended; landing and cutting do not, whatever happens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.body.limits import Limits

QUIET_S: Final = 1.0  # a hazard is over when its cause was not seen for this long: one that flickers is told once
ROUNDING_S: Final = 1e-9
NEVER: Final = np.inf


class Outcome(IntEnum):
    """What is done about a hazard; the numbers grow with severity."""

    NONE = 0
    WARN = 1  # it goes on, within its limits; people are told
    HOLD = 2  # it stays where it is
    LAND = 3  # flying robots come down, ground robots halt; neither goes on
    CUT = 4  # motors off at once


class Cause(IntEnum):
    """What may be wrong with a robot; the numbers are the rows of the state machine."""

    ORDERED = 0
    POSITION = 1
    MARGIN = 2
    OUTSIDE = 3
    FAR_OUTSIDE = 4
    SEPARATION = 5
    TOUCHING = 6
    OVERSPEED = 7
    TILT = 8
    NEIGHBOUR = 9
    ALONE = 10
    CENTRE = 11
    BATTERY = 12
    ROUTER = 13
    CONDUCTOR = 14
    FALLEN = 15
    SETPOINT = 16
    LATE = 17
    LANDING = 18
    BELOW = 19
    SINKING = 20
    CLOCK = 21
    BEHIND = 22
    STANDSTILL = 23


@dataclass(frozen=True)
class Rule:
    """What is done about a cause.

    Attributes:
        words: What people read.
        first: The outcome as soon as it has been seen for `after_s` without a break.
        after_s: [s]; one number, or one for each row.
        then: The outcome when that does not help for `then_s`.
        then_s: [s] from the first time that it was seen; one number, or one for each row.
        clears_s: A hold ends when the cause was not seen for this long [s].
        repeats: Whether what comes back within `QUIET_S` counts as lasting all the time.
        place: Whether who holds keeps the place where that began; else only its setpoints are stopped.
        landing: Whether it is looked for while a robot lands as well.
        grounded: Outcome of `then` for robots that do not fly, where it is another one.
    """

    words: str
    first: Outcome
    after_s: float | Array = 0.0
    then: Outcome = Outcome.NONE
    then_s: float | Array = NEVER
    clears_s: float = 0.0
    repeats: bool = False
    place: bool = True
    landing: bool = False
    grounded: Outcome | None = None


_LOST: Final[Mapping[str, Outcome]] = {
    "drop": Outcome.WARN,
    "finish": Outcome.WARN,
    "hold": Outcome.HOLD,
    "land": Outcome.LAND,
}

RULES: Final[Mapping[Cause, Rule]] = {
    Cause.ORDERED: Rule("ordered to hold", Outcome.HOLD),
    Cause.POSITION: Rule(
        "its own position is lost", Outcome.HOLD, then=Outcome.LAND, place=False, grounded=Outcome.HOLD
    ),
    Cause.MARGIN: Rule("it is beyond a wall of the arena", Outcome.WARN),
    Cause.OUTSIDE: Rule("it left the arena", Outcome.LAND),
    # one wrong measurement must not drop a drone; while it lands it may still be flying away
    Cause.FAR_OUTSIDE: Rule("it flies away", Outcome.CUT, after_s=0.1, landing=True),
    Cause.SEPARATION: Rule("minimum separation", Outcome.HOLD, clears_s=0.5),
    Cause.TOUCHING: Rule("far too near to another robot", Outcome.LAND),
    Cause.OVERSPEED: Rule(
        "it moves faster than it can", Outcome.HOLD, after_s=0.2, then=Outcome.LAND, then_s=1.0, clears_s=0.5
    ),
    Cause.TILT: Rule("it has tipped over", Outcome.CUT, after_s=0.1, landing=True),
    Cause.NEIGHBOUR: Rule("a neighbour is lost", Outcome.WARN),
    Cause.BEHIND: Rule("a neighbour's clock is behind", Outcome.WARN),
    Cause.ALONE: Rule("all its neighbours are lost", Outcome.HOLD),
    Cause.CENTRE: Rule("nobody guides it", Outcome.HOLD),
    Cause.BATTERY: Rule("its battery is low", Outcome.LAND, after_s=1.0),  # its voltage sags under a short load
    Cause.ROUTER: Rule("no connection to a router", Outcome.HOLD, then=Outcome.LAND),
    Cause.CONDUCTOR: Rule("the conductor is gone", Outcome.WARN, after_s=2.0),  # who was cut off sees it back first
    Cause.FALLEN: Rule("it came down by itself", Outcome.LAND),
    Cause.SETPOINT: Rule(
        "what it wants is not a setpoint", Outcome.HOLD, then=Outcome.LAND, then_s=0.5, repeats=True, place=False
    ),
    Cause.LATE: Rule("its control loop misses its ticks", Outcome.HOLD, then=Outcome.LAND, then_s=5.0, clears_s=0.5),
    Cause.LANDING: Rule("its landing takes too long", Outcome.CUT, landing=True),
    # its device lands it, or its battery carries it no more: who hears it must not follow
    Cause.SINKING: Rule("it comes down by itself", Outcome.LAND, after_s=0.1),
    Cause.BELOW: Rule("a robot is below it", Outcome.WARN, landing=True),
    Cause.STANDSTILL: Rule("its process stood still", Outcome.HOLD),
    Cause.CLOCK: Rule("the clock that stamps its positions is off", Outcome.WARN, after_s=0.5),  # not one late sample
}


def rules(limits: Limits) -> dict[Cause, Rule]:
    """The table, with the numbers and the choices of an experiment."""
    chosen = {
        Cause.POSITION: {"then_s": limits.blind_s if limits.hold_s is None else limits.hold_s},
        Cause.NEIGHBOUR: {"first": _LOST[limits.lost_neighbour]},
        Cause.ROUTER: {"after_s": limits.link_silence_s, "then_s": limits.offline_s},
        Cause.CONDUCTOR: {"first": _LOST[limits.lost_conductor]},
        Cause.LANDING: {"after_s": limits.landing_s},
    }
    return {cause: replace(rule, **chosen.get(cause, {})) for cause, rule in RULES.items()}  # type: ignore[arg-type]


class Observation(NamedTuple):
    """A cause that is seen on this tick: on which rows (N,), and how bad it is there, in words with numbers."""

    cause: Cause
    rows: Mask
    detail: Callable[[int], str]


class Incident(NamedTuple):
    """A hazard began, became worse, or is over: when [s], on which row, which cause, what is done, and all in words."""

    time: float
    row: int
    cause: Cause
    outcome: Outcome
    text: str


class Hazards:
    """The state machine of N rows.

    Attributes:
        held: (N,) rows that must keep their place.
        incidents: What has happened since whoever reads it emptied it.
    """

    def __init__(self, flies: Mask, limits: Limits) -> None:
        """Of rows that fly or not (N,)."""
        table, shape = rules(limits), (len(Cause), len(flies))
        self._words = [table[cause].words for cause in Cause]

        def column(name: str) -> Array:
            return np.stack([np.broadcast_to(np.asarray(getattr(table[c], name), float), shape[1:]) for c in Cause])

        def mask(name: str) -> Mask:
            return np.array([[getattr(table[cause], name)] for cause in Cause], dtype=bool)

        self._after, self._then_s, self._clears = column("after_s"), column("then_s"), column("clears_s")
        self._first, then = column("first").astype(np.intp), column("then").astype(np.intp)
        for cause in Cause:
            grounded = table[cause].grounded
            if grounded is not None:
                then[cause] = np.where(flies, then[cause], grounded)
        self._then = then
        self._repeats, self._place, self._landing = mask("repeats"), mask("place"), mask("landing")
        self._since, self._begun, self._last = np.full((3, *shape), NEVER)
        self._last[:] = -NEVER
        self._level: Index = np.zeros(shape, dtype=np.intp)
        self._texts: list[dict[int, str]] = [{} for _ in flies]
        self._quiet = True
        self.held: Mask = np.zeros(len(flies), dtype=bool)
        self._nobody = self.held
        self.incidents: list[Incident] = []

    def update(self, t: float, seen: Sequence[Observation], active: Mask, landing: Mask) -> list[Incident]:
        """One tick: the rows that must land or be cut now, for the first time, each with why.

        Args:
            t: Now [s].
            seen: Causes that are seen; one that is left out is not seen on any row.
            active: (N,) rows that climb, wait in the air, or run: the others have no hazards.
            landing: (N,) rows that land: they have those that are looked for then.
        """
        if self._quiet and not seen:
            return []
        now = np.zeros(self._level.shape, dtype=bool)
        for cause, rows, _ in seen:
            now[cause] = rows
        now &= active | (self._landing & landing)
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
        lasted = self._last - self._begun
        self._begun = np.where(over, NEVER, self._begun)
        self._level = level = np.where(over, 0, level)
        holds = (level == Outcome.HOLD) & self._place & (now | (silence < self._clears - ROUNDING_S))
        self.held = np.asarray(holds.any(axis=0))
        self._quiet = not (some(on) or some(now))
        if not some(level != before):
            return []
        return self._tell(t, before, lasted, {sighting.cause: sighting for sighting in seen})

    def _tell(self, t: float, before: Index, lasted: Array, seen: Mapping[int, Observation]) -> list[Incident]:
        """What has changed, in words; returns landings and cuts, the hardest of each row last."""
        news = []
        for cause, row in np.argwhere(self._level != before).tolist():
            outcome = Outcome(self._level[cause, row])
            words = self._words[cause]
            if outcome == Outcome.NONE:
                text = f"over: {words}, after {lasted[cause, row]:.2f} s"
                self._texts[row].pop(cause, None)
            else:
                text = f"{outcome.name.lower()}: {words}: {seen[cause].detail(row)}"
                self._texts[row][cause] = text
            news.append(Incident(t, row, Cause(cause), outcome, text))
        news.sort(key=lambda incident: incident.outcome)
        self.incidents += news
        return [incident for incident in news if incident.outcome >= Outcome.LAND]

    def words(self, cause: Cause) -> str:
        """Of a cause, as a robot gives its reason for landing."""
        return self._words[cause]

    def worst(self, row: int) -> str:
        """The worst hazard that a row has, the outcome first; empty if it has none."""
        texts = self._texts[row]
        return texts[max(texts, key=lambda cause: int(self._level[cause, row]))] if texts else ""

    def outcome(self, row: int) -> Outcome:
        """What is done about the worst hazard of a row."""
        return Outcome(self._level[:, row].max())
