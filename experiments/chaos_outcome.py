"""What the faults of a round did, and whether its recording says so."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from experiments import playback
from experiments.fault_script import Fault
from experiments.playback import NotStarted
from experiments.problem import DocumentError
from experiments.records import RecordingError
from experiments.recover import recover


class Outcome(msgspec.Struct, frozen=True):
    """What a fault did.

    Attributes:
        round: In which it was done, counted from 1.
        fault: As in the script.
        victim: To whom it was done.
        at_s: When, from the common start [s].
        note: What there is to say of it.
        recovered: Whether all healed in time.
        begin_s: From its begin until then [s].
        end_s: From its end [s]; 0 if the formation had healed while it lasted.
        ended: Whether robots came down instead of going on, the dead not counted.
        violations: What must not have happened.
    """

    round: int
    fault: Fault
    victim: str
    at_s: float
    note: str
    recovered: bool
    begin_s: float
    end_s: float
    ended: bool
    violations: list[str]


class Ended(msgspec.Struct, frozen=True):
    """How a round ended.

    Attributes:
        round: Counted from 1.
        left: Faults that it had no time for.
        violations: What was wrong that no fault explains.
        nearest_m: How near robots came to each other, between surfaces [m].
        gone_s: After its end, how long until all of its processes were gone [s].
        missed: Share of the ticks that robots missed which were never stopped: how busy the machine was.
        recording: Its folder, if there is a recording.
    """

    round: int
    left: list[Fault]
    violations: list[str]
    nearest_m: float
    gone_s: float
    missed: float
    recording: str


def line(outcome: Outcome) -> str:
    """An outcome for people."""
    whom = f" {outcome.victim}" if outcome.victim else ""
    how = f"well after {outcome.begin_s:.1f} s" if outcome.recovered else "NOT WELL"
    how += ", came down" if outcome.ended else ""
    wrong = "".join(f"; {text}" for text in outcome.violations)
    note = f" ({outcome.note})" if outcome.note else ""
    return f"round {outcome.round}, {outcome.at_s:5.1f} s: {outcome.fault.kind}{whom}{note}: {how}{wrong}"


def misrecorded(recording: Path, outcomes: Sequence[Outcome], *, disk_full: bool) -> list[str]:
    """What is wrong with the recording of a round: it must open, and say what happened."""
    opened = recording
    try:
        if disk_full:
            opened = recording.with_name("mended.mcap")
            recover(recording, opened)
        read = playback.read(opened)
    except (RecordingError, NotStarted, DocumentError, OSError) as error:
        return [f"the recording does not open: {error}"]
    wrong = []
    if not (read.complete or disk_full):
        wrong.append("the recording has no end")
    said = {(event.kind, event.source) for event in read.trace.events}
    kinds = {kind.rstrip("0123456789") for kind, _ in said}
    if not disk_full:
        for outcome in outcomes:
            kind = outcome.fault.kind
            if kind in ("kill", "read-error", "clock-behind") and ("lost", outcome.victim) not in said:
                wrong.append(f"the recording does not say that {outcome.victim} was lost")
            elif kind in ("router", "failover") and "router" not in kinds:
                wrong.append("the recording does not say that the router ended")
    return wrong
