"""The script of a fault laboratory: which fault befalls whom and when, drawn from a seed. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, get_args

import msgspec
import numpy as np

Kind = Literal[
    "kill",
    "freeze",
    "partition",
    "router",
    "failover",
    "conductor",
    "loss",
    "delay",
    "clock",
    "disk",
    "corrupt",
    "bits",
]

KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
FORM_S: Final = (
    15.0  # what a formation takes to come together, so that a round gets about as many faults as it has time for
)
GAP_S: Final = (0.5, 2.0)  # from when a fault has healed to the next
HEAL_S: Final = 1.5  # what that takes
LAST_S: Final = 6.0  # before the end of the run nothing new begins
MOST: Final = {"kill": 2, "router": 3, "failover": 1, "disk": 1, "conductor": 1}  # of one round
LASTING: Final = {"freeze": 5.0, "partition": 3.0, "loss": 3.0, "delay": 3.0, "corrupt": 1.0, "bits": 1.0}  # [s]
WITHOUT_VICTIM: Final = ("router", "failover", "conductor", "loss", "clock", "disk")
DELAY_S: Final = (0.05, 0.3)
STEP_S: Final = (0.5, 5.0)
LOSS: Final = 0.2


class Fault(msgspec.Struct, frozen=True):
    """One fault.

    Attributes:
        kind: What happens.
        after_s: So long after all was well again (or, of the first, after the formation had come together) [s].
        lasts_s: Until it is lifted [s]; 0 if it cannot be.
        victim: A robot; if it is gone by then, the next one that is there. Empty: the whole run.
        size: Of a delay or a step of the clock [s], of a loss as a share.
    """

    kind: Kind
    after_s: float
    lasts_s: float = 0.0
    victim: str = ""
    size: float = 0.0


class Round(msgspec.Struct, frozen=True):
    """One run of the experiment and what befalls it, with so many routers."""

    faults: list[Fault]
    routers: int = 1


def script(
    robots: Sequence[str], duration_s: float, count: int, seed: int, kinds: Sequence[Kind] = KINDS
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


def _deal(deck: list[Kind], robots: Sequence[str], duration_s: float, random: np.random.Generator) -> Round:
    """Takes the faults of one round off the deck."""
    several = deck[0] == "failover"
    t, faults = FORM_S, list[Fault]()
    dealt: list[Kind] = []
    while True:
        fitting = (k for k, kind in enumerate(deck) if _fits(kind, dealt, several=several))
        place = next(fitting, None)
        if place is None:
            if faults:
                break
            place = 0  # what fits nowhere has a round of its own
        kind = deck.pop(place)
        dealt.append(kind)
        gap = round(float(random.uniform(*GAP_S)), 2)
        faults.append(_fault(kind, gap, robots, random))
        t += gap + LASTING.get(kind, 0.0) + HEAL_S
        if kind == "conductor" or t > duration_s - LAST_S:
            break
    return Round(faults, 2 if several else 1)


def _fits(kind: Kind, dealt: Sequence[Kind], *, several: bool) -> bool:
    """Whether a kind may come next in a round."""
    if dealt.count(kind) >= MOST.get(kind, len(KINDS)):
        return False
    if kind == "conductor":
        return len(dealt) >= 3  # nothing can befall the run after it: it had better be late
    return kind != ("router" if several else "failover")


def _fault(kind: Kind, after_s: float, robots: Sequence[str], random: np.random.Generator) -> Fault:
    victim = "" if kind in WITHOUT_VICTIM else str(random.choice(list(robots)))
    size = 0.0
    if kind == "loss":
        size = LOSS
    elif kind == "delay":
        size = round(float(random.uniform(*DELAY_S)), 3)
    elif kind == "clock":
        size = round(float(random.uniform(*STEP_S) * random.choice([-1.0, 1.0])), 3)
    return Fault(kind, after_s, LASTING.get(kind, 0.0), victim, size)
