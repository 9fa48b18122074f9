"""`./zenpark test --chaos`: scripts of the simulated laboratory, done to real processes in real time.

A round is one run with a random script. It is flown by real processes, then in the simulator with the same script: what
breaks a rule is a violation, and another exit code than the simulated one is told.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import psutil  # type: ignore[import-untyped]
import typer

from agents.errors import ExplainedError
from experiments.definition.plan import Plan
from experiments.file.document import chosen, load
from experiments.metrics.measure import measure
from experiments.recording import playback
from experiments.recording.run_folder import new_folder
from experiments.report.page import VerdictLine
from tests.commands import GUARD, ROOT
from tests.simulated import laboratory
from tests.simulated.faults import Fault, draw
from tests.system import lab
from tools.options import AsJson, File, Out, Settings, known_words, print_result

KINDS: Final = ("pause", "kill", "term", "order", "estop", "interrupt", "twice")  # what signals and commands can do
LENGTH: Final = "duration_s=15"  # length of a round, unless the user chooses another
GONE_S: Final = 60.0  # time after the end of a run in which its processes must have ended
OUTSIDE_M: Final = 0.75  # farther outside a drone is cut
CODES: Final = (0, 1, 2, 3, 130)  # exit codes of `./zenpark run`
REFUSED: Final = 2  # exit code of a process whose name is taken
RESULT: Final = "chaos.json"
FLIGHT: Any = lab.Flight  # class without types


class Round(msgspec.Struct, frozen=True):
    """Result of one round."""

    seed: int
    script: list[str]
    code: int  # exit code of the real run
    simulated: int | None  # exit code of the simulated one
    violations: list[str]


class RealRun:
    """A run with real processes, and the levers of a script."""

    def __init__(self, folder: Path, file: str, case: str, settings: Sequence[str], names: Sequence[str]) -> None:
        self.flight = FLIGHT(folder, file, "--case", case, *settings)
        self._names, self._stopped, self._others = names, list[psutil.Process](), list[subprocess.Popen[str]]()
        self.seen: dict[int, psutil.Process] = {}  # all of its processes
        self.ended: set[str] = set()  # robots whose process a script has ended
        self.violations: list[str] = []

    def fly(self, script: Sequence[Fault], duration_s: float) -> int:
        """Do a script to it, and wait for its end; return its exit code."""
        try:
            with contextlib.suppress(AssertionError):  # it may end before
                self.flight.until_flown()
            begun = time.monotonic()
            self._look()
            for fault in script:
                time.sleep(max(0.0, begun + fault.at - time.monotonic()))
                self._look()
                self._do(fault)
            self._end(begun + duration_s + GONE_S)
        finally:
            for process in self._stopped:
                _signal(process, signal.SIGCONT)
            for other in self._others:
                other.terminate()
                other.communicate(timeout=GONE_S)
            for process in self.seen.values():
                _signal(process, signal.SIGKILL)
        return int(self.flight.process.returncode)

    def _look(self) -> None:
        if self.flight.process.poll() is None:
            self.seen |= {each.pid: each for each in self.flight.children().values()}

    def _end(self, deadline: float) -> None:
        try:
            self.flight.finish(max(1.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.violations.append(f"it does not end {GONE_S:g} s after its time")
            self.flight.process.kill()
            self.flight.finish()
        while left := [each for each in self.seen.values() if not lab.gone([each])]:  # type: ignore[no-untyped-call]
            if time.monotonic() > deadline:
                self.violations.append(f"left behind: {', '.join(' '.join(each.cmdline()[:5]) for each in left)}")
                return
            time.sleep(0.1)

    def _do(self, fault: Fault) -> None:
        if self.flight.process.poll() is not None:
            return
        words = str(fault.size).split()
        if fault.kind == "order":
            self._command("robot", words[0], fault.who, *words[1:])
        elif fault.kind == "estop":
            self._command("estop")
        elif fault.kind == "interrupt":
            self.flight.process.send_signal(signal.SIGINT)
        elif (process := self._process(fault.who)) is None:
            return
        elif fault.kind == "twice":
            command = [word for word in process.cmdline() if word != "--lifeline"]
            self._others.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        elif fault.kind == "pause":
            self._stopped.append(process)
            _signal(process, signal.SIGSTOP)
            threading.Timer(fault.lasts, _signal, (process, signal.SIGCONT)).start()
        else:
            _signal(process, signal.SIGKILL if fault.kind == "kill" else signal.SIGTERM)
        if fault.kind != "order" and fault.who in self._names:
            self.ended.add(fault.who)

    def _process(self, who: str) -> psutil.Process | None:
        if who == "conductor":
            return psutil.Process(self.flight.process.pid)
        return self.flight.children().get(who)

    def _command(self, *words: str) -> None:
        connect = f"@{self.flight.folder / 'network.txt'}"
        command = [sys.executable, *GUARD, *words, "--connect", connect]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self._others.append(subprocess.Popen(command, cwd=ROOT, env=lab.ENVIRONMENT, text=True, **streams))  # type: ignore[call-overload]

    def judge(self, plan: Plan, case: str, code: int, script: Sequence[Fault]) -> None:
        """Add what breaks a rule."""
        killed = any(fault.kind == "kill" and fault.who == "conductor" for fault in script)
        if code not in CODES and not killed:
            self.violations.append(f"exit code {code}")
        texts = {"the run": self.flight.said()}
        for file in (self.flight.folder / "logs").glob("*.log"):
            texts[file.stem] = file.read_text("utf-8")
        self.violations += [f"{who}: a traceback" for who, text in texts.items() if "Traceback (most" in text]
        for name in set(self._names) - self.ended:
            last = texts.get(f"{case}-{name}", "").strip().splitlines()[-1:]
            if last and not re.match(rf"{name}: (done|idle|ready)", last[0]):
                self.violations.append(f"{name} is not down: {last[0][:120]}")
        if (recording := self.flight.folder / f"{case}.mcap").is_file() and code != REFUSED:
            self.violations += _faults_of(recording, plan)


def _faults_of(recording: Path, plan: Plan) -> list[str]:
    """Faults of a recording, which must be read and have all robots inside of the arena."""
    try:
        trace = playback.read(recording).trace
        measure(trace)
    except playback.NotStarted:
        return []
    except (ExplainedError, OSError) as error:
        return [f"the recording does not open: {error}"]
    x, y, _ = (0.5 * side + OUTSIDE_M for side in plan.experiment.arena.size)
    places = zip(trace.robots, trace.true_position.transpose(1, 2, 0), strict=True)
    return [
        f"{name} left the arena" for name, place in places if (abs(place[0]) > x).any() or (abs(place[1]) > y).any()
    ]


def _signal(process: psutil.Process, number: int) -> None:
    with contextlib.suppress(psutil.NoSuchProcess):
        process.send_signal(number)


def scripts(plan: Plan, faults: int, seed: int, kinds: Sequence[str]) -> Iterator[tuple[int, list[Fault]]]:
    """Seeds from this one on and their scripts, until they have so many faults."""
    for number in itertools.count(seed):
        if faults <= 0:
            return
        drawn = draw(number, plan.names, (), plan.experiment.duration_s, kinds)
        drawn = [fault for fault in drawn if fault.kind in kinds and fault.since == "start" and fault.at >= 0.0][
            :faults
        ]
        faults -= len(drawn)
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
    for number, script in scripts(plan, faults, seed, known_words("--kinds", kinds or [], KINDS) or KINDS):
        real = RealRun(folder / f"seed-{number}", str(file), name, changes, plan.names)
        code = real.fly(script, plan.experiment.duration_s)
        real.judge(plan, name, code, script)
        asked = laboratory.Request(str(file), tuple(script), number, name, tuple(changes))
        rounds.append(Round(number, [*map(str, script)], code, laboratory.run(asked).code, real.violations))
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
