"""The fault laboratory: rounds of an experiment in real time, faults by a script, and what must hold after each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from experiments.chaos_flight import Flight, Say, Setting
from experiments.chaos_outcome import Ended, Outcome
from experiments.fault_script import Fault, Round

BARREN: Final = 3  # rounds without any fault, and it gives up


def run(
    setting: Setting, rounds: Sequence[Round], *, interrupted: Callable[[], bool], say: Say
) -> tuple[list[Outcome], list[Ended]]:
    """All rounds, and as many more as the faults take that had no time in theirs.

    Args:
        setting: Of all of them.
        rounds: The script.
        interrupted: Asked whether the user wants to end.
        say: Gets a line for each fault and each round.
    """
    waiting, left = list(rounds), list[Fault]()
    outcomes: list[Outcome] = []
    ends: list[Ended] = []
    barren = 0
    while (waiting or left) and not interrupted() and barren < BARREN:
        if not waiting:
            waiting, left = again(left), []
        flight = Flight(setting, waiting.pop(0), len(ends) + 1, interrupted, say)
        ends.append(flight.fly())
        outcomes += flight.outcomes
        left += ends[-1].left
        barren = 0 if flight.outcomes else barren + 1
    return outcomes, ends


def again(faults: Sequence[Fault]) -> list[Round]:
    """Faults that had no time, in rounds of their own: those that need a stage of their own on that."""
    rounds = []
    for stage in dict.fromkeys(fault.nature.stage for fault in faults):
        chosen = [fault for fault in faults if fault.nature.stage == stage]
        rounds.append(Round(sorted(chosen, key=lambda fault: fault.kind == "conductor"), stage))
    return rounds
