"""`./zenpark chaos`: draws a script of faults, runs it, and reports what did not hold."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import AsJson, File, Out, Settings, example, known_words, print_result

if TYPE_CHECKING:
    from experiments.definition.plan import Plan
    from tools.reliability.chaos_report import FaultResult, RoundResult

app: Final = typer.Typer()

BARREN: Final = 3  # rounds without any fault, and it gives up


# pymunk measures contacts; a busy machine is no fault; rounds are long, for starts take time
ALWAYS: Final = ('world.engine="pymunk"', "world.wheels_stop_s=0.5", "start.deadline_s=60", "duration_s=90")
# without one, robots cannot keep clear of a dead one that stands in their way, nor of one that lands below them
AVOIDANCE: Final = 'avoidance={ kind = "barrier", hears = "all", clearance = 1.0 }'
BODY_HZ: Final = 50.0  # relays, world and robots share one machine: at 100 Hz two cores are full, and ticks are missed
SCRIPT: Final = "script.json"


@app.command(epilog=example("chaos triangle --faults 20 --seed 1", "chaos triangle --kinds kill,freeze"))
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
    import msgspec

    from agents.runtime.command_line import interrupts
    from experiments.file.document import chosen, load
    from experiments.recording.run_folder import SOURCE, new_folder
    from tools.progress import columns, finding_lines
    from tools.reliability import chaos_report
    from tools.reliability.chaos_report import ChaosResult
    from tools.reliability.chaos_round import ChaosRound
    from tools.reliability.faults import FAULTS, script
    from tools.reliability.spoilt_run import Setting

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
    words = ["./zenpark", "chaos", file, "--faults", str(faults), "--seed", str(seed)]
    words += [part for kind in kinds or () for part in ("--kinds", kind)]
    page = chaos_report.write(folder, result, " ".join(words))
    table, findings = chaos_report.table(result), chaos_report.findings(result)
    lines = [*columns([table.head, *(tuple(map(str, row.cells)) for row in table.rows)]), *finding_lines(findings)]
    print_result(result, *lines, f"report: {page}", as_json=as_json)
    if interrupted():
        return 130
    return int(any(finding.mark == "bad" for finding in findings))


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
