"""`./zenpark test --chaos`: scripts of the simulated laboratory, done to real processes in real time.

A round is one run with a random script. It is flown by real processes, whose keys an observer reads, and the rules of
the simulated laboratory are asked about what it saw. Then it is flown in the simulator with the same script: another
exit code than the simulated one is told.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from typing import Annotated, Final

import msgspec
import typer

from experiments.definition.plan import Plan
from experiments.file.document import chosen, load
from experiments.recording.run_folder import new_folder
from experiments.report.page import VerdictLine
from tests.reliability.real_world import RealWorld
from tests.simulated import faults as scripted
from tests.simulated import laboratory
from tests.simulated.faults import Fault
from tools.options import AsJson, File, Out, Settings, known_words, print_result

UNREAL: Final = (
    "loss",
    "duplicate",
    "reorder",
    "slow",
    "step",
    "drift",
    "capture",
    "corrupt",
    "split",
)  # docs/chaos.md says why
KINDS: Final = tuple(kind for kind in scripted.KINDS if kind not in UNREAL)
LENGTH: Final = "duration_s=15"  # length of a round, unless the user chooses another
RESULT: Final = "chaos.json"


class Round(msgspec.Struct, frozen=True):
    """Result of one round."""

    seed: int
    script: list[str]
    code: int | None  # exit code of the real run
    simulated: int | None  # exit code of the simulated one
    violations: list[str]
    slack_s: float = 0.0  # tolerance of the rules [s]


def scripts(plan: Plan, faults: int, seed: int, kinds: Sequence[str]) -> Iterator[tuple[int, list[Fault]]]:
    """Seeds from this one on and their scripts, until they have so many faults."""
    for number in itertools.count(seed):
        if faults <= 0:
            return
        drawn = [fault for fault in scripted.draw_for(plan, number, kinds) if fault.since != "launch"][:faults]
        faults -= len(drawn)  # a real launch takes its time
        if drawn:
            yield number, drawn


def chaos(
    file: File,
    *,
    faults: Annotated[int, typer.Option(min=1, help="How many.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of the scripts; the same seed gives the same.")] = 1,
    kinds: Annotated[
        list[str] | None, typer.Option(metavar="KIND,KIND", help=f"Only these: {', '.join(KINDS)}. [all]")
    ] = None,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the last]")] = None,
    out: Out = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> int:
    """Run an experiment again and again while faults befall its processes, and say what did not hold."""
    changes = [LENGTH, *(settings or [])]
    read = load(file, *changes)
    name = case or list(read.cases())[-1]
    plan = chosen(read, [name])[name]
    folder, rounds = new_folder(read, out), list[Round]()
    words = [str(file), "--case", name, "--no-report", *(word for each in changes for word in ("--set", each))]
    for number, script in scripts(plan, faults, seed, known_words("--kinds", kinds or [], KINDS) or KINDS):
        real = RealWorld(folder / f"seed-{number}", plan, name, script, words)
        real.fly(plan.experiment.duration_s)
        asked = laboratory.Request(str(file), tuple(script), number, name, tuple(changes))
        simulated, told = laboratory.run(asked).code, [*map(str, script)]
        rounds.append(Round(number, told, real.conductor.code, simulated, real.judge(), real.slack_s))
        print(_line(rounds[-1]), file=sys.stderr, flush=True)
    laboratory.close()
    (folder / RESULT).write_bytes(msgspec.json.format(msgspec.json.encode(rounds), indent=1))
    verdict = findings(rounds)
    print_result(rounds, *map(str, verdict), f"results: {folder}", as_json=as_json)
    return int(any(finding.mark == "bad" for finding in verdict))


def _line(done: Round) -> str:
    ends = "; ".join(done.violations) or "no violation"
    return f"seed {done.seed}: {len(done.script)} faults, exit code {done.code}, simulated {done.simulated}: {ends}"


def findings(rounds: Sequence[Round]) -> list[VerdictLine]:
    """The verdict; bad findings are violations."""
    count = sum(len(each.script) for each in rounds)
    wrong = [VerdictLine("bad", f"seed {each.seed}: {text}") for each in rounds for text in each.violations]
    other = [
        VerdictLine("fair", f"seed {each.seed}: exit code {each.code}, simulated {each.simulated}")
        for each in rounds
        if each.code != each.simulated
    ]
    return [VerdictLine("bad" if wrong else "good", f"{count} faults, {len(wrong)} violations"), *other, *wrong]
