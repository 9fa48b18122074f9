"""The script of a fault laboratory: which fault befalls whom and when, drawn from a seed. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import msgspec
import numpy as np

Stage = Literal["plain", "two routers", "patient router", "motion capture"]

FORM_S: Final = (
    15.0  # what a formation takes to come together, so that a round gets about as many faults as it has time for
)
GAP_S: Final = (0.5, 2.0)  # from when a fault has healed to the next
LAST_S: Final = 6.0  # before the end of the run nothing new begins
CONDUCTOR_AFTER: Final = 3  # nothing can befall a run after the death of its launcher: it had better be late


@dataclass(frozen=True)
class FaultKind:
    """Properties of a kind of fault."""

    meant: str  # for the report
    lasts_s: float = 0.0  # until it is lifted [s]; 0: it cannot be
    heals_s: float = 1.5  # usual time of the recovery [s]
    victim: bool = True  # one robot; else the whole run
    most: int = 1_000  # in one round
    stage: Stage = "plain"  # the only one on which it can be done; "plain": on each
    never: Stage | None = None  # a stage on which it cannot be done
    size: tuple[float, float] = (0.0, 0.0)  # range of its size
    signed: bool = False  # the size may be negative as well


FAULT_KINDS: Final[Mapping[str, FaultKind]] = {
    "kill": FaultKind("SIGKILL to a robot's process; its body stays in the room and must come down.", most=2),
    "freeze": FaultKind("SIGSTOP for 5 s, then SIGCONT.", 5.0),
    "partition": FaultKind(
        "Nothing passes between a robot and the router for 3 s; what was said meanwhile comes afterwards.", 3.0
    ),
    "router": FaultKind(
        "SIGKILL to the only router; the conductor starts it again.", victim=False, most=3, never="two routers"
    ),
    "failover": FaultKind("SIGKILL to the first of two routers.", victim=False, most=1, stage="two routers"),
    "frozen-router": FaultKind(
        "SIGSTOP for 5 s to a router whose lease is 60 s: robots must notice by themselves, and hold.",
        5.0,
        victim=False,
        most=2,
        stage="patient router",
    ),
    "conductor": FaultKind(
        "SIGKILL to the launcher: robots land by themselves, and everything ends.", victim=False, most=1
    ),
    "loss": FaultKind(
        "20 % of the segments of every robot are lost for 3 s and sent again after TCP's timeouts.",
        3.0,
        victim=False,
        size=(0.2, 0.2),
    ),
    "delay": FaultKind("50 to 300 ms more in both directions for 3 s, for one robot.", 3.0, size=(0.05, 0.3)),
    "bits": FaultKind("One bit is wrong in 5 % of a robot's segments for 1 s: its connection breaks.", 1.0),
    "clock": FaultKind(
        "The wall clock of all processes steps by 0.5 to 5 s, forward or back.",
        victim=False,
        size=(0.5, 5.0),
        signed=True,
    ),
    "clock-behind": FaultKind(
        "SIGKILL to a robot's process; it is started again with a clock that is 3 to 4.5 s behind, and must be heard.",
        heals_s=12.0,
        most=2,
        size=(3.0, 4.5),
    ),
    "mocap-clock": FaultKind(
        "The wall clock of motion capture steps by 0.5 to 4.5 s, and back after 3 s: no robot may lose its position.",
        3.0,
        victim=False,
        most=3,
        stage="motion capture",
        size=(0.5, 4.5),
        signed=True,
    ),
    "double": FaultKind(
        "A second process of a robot's name is started: it must be refused, and touch nothing.", heals_s=6.0
    ),
    "read-error": FaultKind(
        "Reading a robot's body raises: it must be told to land or to stop all the same.", heals_s=12.0, most=1
    ),
    "disk": FaultKind("The recording can grow no more.", victim=False, most=1),
    "corrupt": FaultKind("Payloads of nonsense on every key that a robot believes.", 1.0),
}
KINDS: Final = tuple(FAULT_KINDS)


class Fault(msgspec.Struct, frozen=True):
    """One fault."""

    kind: str
    after_s: float  # so long after all was well again (or, of the first, after the formation had come together) [s]
    lasts_s: float = 0.0  # until it is lifted [s]; 0: it cannot be
    victim: str = ""  # a robot; if it is gone by then, the next that is alive. Empty: the whole run
    size: float = 0.0  # delay or clock step [s], or share of lost segments

    @property
    def properties(self) -> FaultKind:
        """Of its kind."""
        return FAULT_KINDS[self.kind]


class Round(msgspec.Struct, frozen=True):
    """One run of the experiment, on which stage, and what befalls it."""

    faults: list[Fault]
    stage: Stage = "plain"


def script(
    robots: Sequence[str], duration_s: float, count: int, seed: int, kinds: Sequence[str] = KINDS
) -> list[Round]:
    """Rounds that hold so many faults, each kind as often as any other; the same seed gives the same script.

    Args:
        robots: Who may be a victim.
        duration_s: Of a round [s].
        count: How many faults.
        seed: Of all choices.
        kinds: Which there are.
    """
    random = np.random.default_rng(seed)
    deck = [kinds[place % len(kinds)] for place in range(count)]
    random.shuffle(deck)
    rounds = []
    while deck:
        rounds.append(_deal(deck, robots, duration_s, random))
    return rounds


def _deal(deck: list[str], robots: Sequence[str], duration_s: float, random: np.random.Generator) -> Round:
    """Take the faults of one round off the deck."""
    stage = FAULT_KINDS[deck[0]].stage
    t, faults = FORM_S, list[Fault]()
    dealt: list[str] = []
    while True:
        fitting = (k for k, kind in enumerate(deck) if _fits(kind, dealt, stage))
        place = next(fitting, None)
        if place is None:
            if faults:
                break
            place = 0  # what fits nowhere has a round of its own
        kind = deck.pop(place)
        dealt.append(kind)
        gap = round(float(random.uniform(*GAP_S)), 2)
        faults.append(_fault(kind, gap, robots, random))
        t += gap + FAULT_KINDS[kind].lasts_s + FAULT_KINDS[kind].heals_s
        if kind == "conductor" or t > duration_s - LAST_S:
            break
    return Round(faults, stage)


def _fits(kind: str, dealt: Sequence[str], stage: Stage) -> bool:
    """Whether a kind may come next in a round."""
    nature = FAULT_KINDS[kind]
    if dealt.count(kind) >= nature.most or nature.never == stage or nature.stage not in ("plain", stage):
        return False
    return kind != "conductor" or len(dealt) >= CONDUCTOR_AFTER


def _fault(kind: str, after_s: float, robots: Sequence[str], random: np.random.Generator) -> Fault:
    nature = FAULT_KINDS[kind]
    victim = str(random.choice(list(robots))) if nature.victim else ""
    size = round(float(random.uniform(*nature.size) * random.choice([-1.0, 1.0] if nature.signed else [1.0])), 3)
    return Fault(kind, after_s, nature.lasts_s, victim, size)
