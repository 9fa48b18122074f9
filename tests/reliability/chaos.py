"""`./zenpark test --chaos`: draws a script of faults, runs it, and reports what did not hold."""

from __future__ import annotations

import dataclasses
import math
import statistics
import sys
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from agents.runtime.command_line import interrupts
from experiments.definition.plan import Plan
from experiments.file.document import chosen, load
from experiments.recording.run_folder import SOURCE, new_folder
from experiments.report.page import NONE, VerdictLine
from tests.reliability.chaos_round import ChaosRound, FaultResult, RoundResult, line
from tests.reliability.faults import FAULTS, Fault, script
from tests.reliability.spoilt_run import Setting
from tools.options import AsJson, File, Out, Settings, known_words, print_result
from tools.progress import columns

BARREN: Final = 3  # rounds without any fault, and it gives up
BUSY: Final = 0.05  # share of the ticks that a machine may miss which is to be trusted with the rest
# pymunk measures contacts; a busy machine is no fault; rounds are long, for starts take time
ALWAYS: Final = ('world.engine="pymunk"', "world.wheel_watchdog_s=0.5", "start.deadline_s=60", "duration_s=90")
# without one, robots cannot keep clear of a dead one that stands in their way, nor of one that lands below them
AVOIDANCE: Final = 'avoidance={ kind = "barrier", hears = "all", clearance = 1.0 }'
BODY_HZ: Final = 50.0  # relays, world and robots share one machine: at 100 Hz two cores are full, and ticks are missed
SCRIPT: Final = "script.json"
RESULT: Final = "chaos.json"


def chaos(
    file: File,
    *,
    faults: Annotated[int, typer.Option(min=1, help="How many.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of the script; the same seed gives the same.")] = 1,
    kinds: Annotated[
        list[str] | None, typer.Option(metavar="KIND,KIND", help="Only these: kill, freeze, partition, ... [all]")
    ] = None,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the last]")] = None,
    out: Out = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> int:
    """Run an experiment again and again while faults befall it, and say what did not hold."""
    changes = [*defaults(load(file).plan), *(settings or [])]
    read = load(file, *changes)
    name = case or list(read.cases())[-1]
    plan = chosen(read, [name])[name]
    planned = script(list(plan.names), faults, seed, known_words("--kinds", kinds or [], FAULTS) or FAULTS)
    folder = new_folder(dataclasses.replace(read, path=Path(f"{read.path.stem}-chaos")), out)
    read.keep(folder / SOURCE)
    (folder / SCRIPT).write_bytes(msgspec.json.format(msgspec.json.encode(planned), indent=1))

    print(f"{faults} faults in rounds of {plan.experiment.duration_s:g} s; script: {folder / SCRIPT}", file=sys.stderr)
    waiting, barren = list(planned), 0
    outcomes: list[FaultResult] = []
    ends: list[RoundResult] = []
    with interrupts() as interrupted:
        setting = Setting(folder / SOURCE, name, plan, folder, changes, interrupted)
        while waiting and not interrupted() and barren < BARREN:
            flown = ChaosRound(setting, len(ends) + 1, waiting)
            ends.append(flown.run())
            outcomes += flown.outcomes
            barren = 0 if flown.outcomes else barren + 1
    result = ChaosResult(read.experiment.title, seed, planned, outcomes, ends)
    (folder / RESULT).write_bytes(msgspec.json.format(msgspec.json.encode(result), indent=1))
    verdict = findings(result)
    print_result(result, *columns(table(result)), *map(str, verdict), f"results: {folder}", as_json=as_json)
    if interrupted():
        return 130
    return int(any(finding.mark == "bad" for finding in verdict))


def defaults(plan: Plan) -> list[str]:
    """Settings of the laboratory, which `--set` overrides."""
    made = list(ALWAYS)
    if plan.experiment.avoidance is None:
        made.append(AVOIDANCE)
    rates = plan.experiment.rates
    if rates.body_hz > BODY_HZ and all(
        (BODY_HZ / rate).is_integer() for rate in (rates.pose_hz, rates.coordination_hz, rates.state_hz)
    ):
        made.append(f"rates.body_hz={BODY_HZ:g}")
    return made


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
