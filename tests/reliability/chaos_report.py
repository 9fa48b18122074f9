"""Results of a fault laboratory: a table of fault kinds, and the verdict."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from agents.errors import ExplainedError
from experiments.metrics.measure import measure
from experiments.recording import playback
from experiments.recording.reader import recover
from experiments.report.page import NONE, VerdictLine
from tests.reliability.faults import FAULTS, Fault


class FaultResult(msgspec.Struct, frozen=True):
    """Result of one fault."""

    round: int  # counted from 1
    fault: Fault  # as in the script
    victim: str  # a robot; empty: the whole run
    note: str  # for the report
    recovered: bool  # in time
    at_s: float  # from the common start [s]
    begin_s: float  # from its begin to the recovery [s]
    ended: bool  # robots came down instead of going on, dead ones not counted
    violations: list[str]  # of the invariants


class RoundResult(msgspec.Struct, frozen=True):
    """Result of one round."""

    round: int  # counted from 1
    violations: list[str]  # of the invariants, outside of a fault
    nearest_m: float  # least distance between surfaces of two robots [m]
    gone_s: float  # from its end until all of its processes were gone [s]
    missed: float  # share of missed ticks of robots without a fault: the load of the machine


def line(outcome: FaultResult) -> str:
    whom = f" {outcome.victim}" if outcome.victim else ""
    how = f"well after {outcome.begin_s:.1f} s" if outcome.recovered else "NOT WELL"
    how += ", came down" if outcome.ended else ""
    wrong = "".join(f"; {text}" for text in outcome.violations)
    note = f" ({outcome.note})" if outcome.note else ""
    return f"round {outcome.round}, {outcome.at_s:5.1f} s: {outcome.fault.kind}{whom}{note}: {how}{wrong}"


def recording_faults(recording: Path, outcomes: Sequence[FaultResult], *, disk_full: bool) -> list[str]:
    """Faults of the recording of a round, which must open and have the events."""
    try:
        if disk_full:
            mended = recording.with_name("mended.mcap")
            if not recover(recording, mended).complete:
                recording = mended
        read = playback.read(recording)
    except (ExplainedError, OSError) as error:
        return [f"the recording does not open: {error}"]
    if disk_full:
        return []
    events = {(event.kind.rstrip("0123456789"), event.source) for event in read.trace.events}
    kinds = {kind for kind, _ in events}
    wrong = [] if read.complete else ["the recording has no end"]
    for each in outcomes:
        kind = each.fault.properties.recorded
        if kind and not ((kind, each.victim) in events if each.victim else kind in kinds):
            wrong.append(f"the recording has no event {kind} {each.victim}".rstrip())
    left = [each for each in outcomes if each.ended and not each.fault.properties.ordered]
    if left and not measure(read.trace).failures:
        wrong.append(f"robots came down by {left[0].fault.kind}, and the run would end with 0")
    return wrong


BUSY: Final = 0.05  # share of the ticks that a machine may miss which is to be trusted with the rest


class ChaosResult(msgspec.Struct, frozen=True):
    """Everything of a laboratory, as `chaos.json` keeps it."""

    experiment: str
    seed: int
    script: list[Fault]
    outcomes: list[FaultResult]
    rounds: list[RoundResult]


def table(result: ChaosResult) -> list[tuple[str, ...]]:
    """A head and a row for each kind of fault; times count from the begin of the fault."""
    rows: list[tuple[str, ...]] = [("fault", "done", "well again", "came down", "median", "longest", "violations")]
    for kind in FAULTS:
        mine = [each for each in result.outcomes if each.fault.kind == kind]
        well = [each.begin_s for each in mine if each.recovered]
        counts = len(mine), len(well), sum(each.ended for each in mine)
        times = (f"{what(well):.1f} s" if well else NONE for what in (statistics.median, max))
        wrong = sum(len(each.violations) for each in mine)
        rows += [(kind, *map(str, counts), *times, str(wrong))] if mine else []
    return rows


def findings(result: ChaosResult) -> list[VerdictLine]:
    """The verdict; bad findings are violations, or faults that could not be done."""
    done, wanted, rounds = len(result.outcomes), len(result.script), result.rounds
    nearest = min((each.nearest_m for each in rounds), default=math.inf)
    late = max((each.gone_s for each in rounds), default=0.0)
    found = [
        VerdictLine("good" if done == wanted else "bad", f"{done} of {wanted} faults in {len(rounds)} rounds"),
        VerdictLine("plain", f"robots came as near as {nearest:.3f} m to each other, surface to surface"),
        VerdictLine("plain", f"after the end of a round all of its processes were gone within {late:.1f} s"),
    ]
    for each in rounds:
        if each.missed > BUSY:
            text = f"the machine was too busy, {100 * each.missed:.0f} % of ticks were missed"
            found.append(VerdictLine("fair", f"round {each.round}: {text}"))
    wrong = [line(each) for each in result.outcomes if each.violations]
    wrong += [f"round {each.round}: {text}" for each in rounds for text in each.violations]
    return found + ([VerdictLine("bad", text) for text in wrong] or [VerdictLine("good", "0 violations")])
