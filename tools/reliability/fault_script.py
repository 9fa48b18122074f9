"""Kinds of faults, and the script of a fault laboratory: fault, victim and moment, drawn from a seed. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from signal import SIGKILL, SIGSTOP, Signals
from typing import Final, Literal

import msgspec
import numpy as np

Stage = Literal["plain", "two routers", "patient router", "motion capture"]

FORM_S: Final = 15.0  # a formation needs so long to come together: a round gets about the faults that it has time for
GAP_S: Final = (0.5, 2.0)  # from when a fault has healed to the next
LAST_S: Final = 6.0  # before the end of the run nothing new begins


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: how it is injected, and what a script must know of it."""

    meant: str  # for the report
    lasts_s: float = 0.0  # until it is lifted [s]; 0: it cannot be
    heals_s: float = 1.5  # usual time of the recovery [s]
    victim: bool = True  # one robot; else the whole run
    most: int = 1_000  # in one round
    signal: Signals | None = None  # that its process gets
    role: str = ""  # process that gets the signal; empty: that of the victim
    cuts: bool = False  # the cables of the victim
    clock: tuple[str, float] | None = None  # switch, with the role of the victim's process for {}, and direction
    reported: str = ""  # process whose end the conductor must report
    stage: Stage = "plain"  # the only one on which it can be done; "plain": on each
    never: Stage | None = None  # a stage on which it cannot be done
    size: tuple[float, float] = (0.0, 0.0)  # range of its size [s]
    signed: bool = False  # the size may be negative as well


FAULT_KINDS: Final[Mapping[str, FaultKind]] = {
    "kill": FaultKind(
        "SIGKILL to a robot's process; its body stays in the room and must come down.", most=2, signal=SIGKILL
    ),
    "freeze": FaultKind("SIGSTOP for 5 s, then SIGCONT.", 5.0, signal=SIGSTOP),
    "partition": FaultKind(
        "Nothing passes between a robot and the router for 3 s; messages of that time arrive afterwards.",
        3.0,
        cuts=True,
    ),
    "router": FaultKind(
        "SIGKILL to the only router; the conductor starts it again.",
        victim=False,
        most=3,
        never="two routers",
        signal=SIGKILL,
        role="router",
        reported="router",
    ),
    "failover": FaultKind(
        "SIGKILL to the first of two routers.",
        victim=False,
        most=1,
        stage="two routers",
        signal=SIGKILL,
        role="router",
        reported="router",
    ),
    "frozen-router": FaultKind(
        "SIGSTOP for 5 s to a router whose lease is 60 s: robots must notice by themselves, and hold.",
        5.0,
        victim=False,
        most=2,
        stage="patient router",
        signal=SIGSTOP,
        role="router",
    ),
    "conductor": FaultKind(
        "SIGKILL to the launcher: robots land by themselves, and everything ends.",
        victim=False,
        most=1,
        signal=SIGKILL,
        role="conductor",
    ),
    "clock": FaultKind(
        "The wall clock of all processes steps by 0.5 to 5 s, forward or back.",
        victim=False,
        size=(0.5, 5.0),
        signed=True,
        clock=("clock", 1.0),
    ),
    "clock-behind": FaultKind(
        "SIGKILL to a robot's process; it is started again with a clock 3 to 4.5 s behind, and must be received.",
        heals_s=12.0,
        most=2,
        size=(3.0, 4.5),
        signal=SIGKILL,
        clock=("clock-{}", -1.0),
    ),
    "mocap-clock": FaultKind(
        "The wall clock of motion capture steps by 0.5 to 4.5 s, and back after 3 s: no robot may lose its position.",
        3.0,
        victim=False,
        most=3,
        stage="motion capture",
        size=(0.5, 4.5),
        signed=True,
        clock=("clock-positioning", 1.0),
    ),
    "double": FaultKind(
        "A second process of a robot's name is started: it must be refused, and touch nothing.", heals_s=6.0
    ),
    "read-error": FaultKind(
        "Reading a robot's body raises: it must be ordered to land or to stop all the same.", heals_s=12.0, most=1
    ),
    "disk": FaultKind("The recording can grow no more.", victim=False, most=1, reported="recorder"),
    "corrupt": FaultKind("Payloads of nonsense on every key that a robot believes.", 1.0),
}
FAULTS: Final = tuple(FAULT_KINDS)


class Fault(msgspec.Struct, frozen=True):
    """A fault of a script."""

    kind: str
    after_s: float  # so long after all was well again (or, of the first, after the formation had come together) [s]
    lasts_s: float = 0.0  # until it is lifted [s]; 0: it cannot be
    victim: str = ""  # a robot; if it has ended by then, the next that is alive. Empty: the whole run
    size: float = 0.0  # clock step [s]

    @property
    def properties(self) -> FaultKind:
        return FAULT_KINDS[self.kind]


class Round(msgspec.Struct, frozen=True):
    """A run of the experiment: its stage and its faults."""

    faults: list[Fault]
    stage: Stage = "plain"


def script(robots: Sequence[str], count: int, seed: int, kinds: Sequence[str] = FAULTS) -> list[Fault]:
    """`count` faults, each kind as often as any other; the same seed gives the same script.

    Args:
        robots: Possible victims.
    """
    random = np.random.default_rng(seed)
    deck = [kinds[place % len(kinds)] for place in range(count)]
    random.shuffle(deck)
    return [_fault(kind, round(float(random.uniform(*GAP_S)), 2), robots, random) for kind in deck]


def take_round(waiting: list[Fault], duration_s: float) -> Round:
    """Take the faults of a round of `duration_s` [s] off the list, one or more; the death of the launcher ends it."""
    stage = waiting[0].properties.stage
    t, taken = FORM_S, list[Fault]()
    for fault in list(waiting):
        kind = fault.properties
        alike = sum(other.kind == fault.kind for other in taken)
        if alike < kind.most and kind.never != stage and kind.stage in ("plain", stage):
            taken.append(fault)
            waiting.remove(fault)
            t += fault.after_s + kind.lasts_s + kind.heals_s
        if t > duration_s - LAST_S:
            break
    return Round(sorted(taken, key=lambda fault: fault.kind == "conductor"), stage)


def _fault(kind: str, after_s: float, robots: Sequence[str], random: np.random.Generator) -> Fault:
    nature = FAULT_KINDS[kind]
    victim = str(random.choice(list(robots))) if nature.victim else ""
    size = round(float(random.uniform(*nature.size) * random.choice([-1.0, 1.0] if nature.signed else [1.0])), 3)
    return Fault(kind, after_s, nature.lasts_s, victim, size)
