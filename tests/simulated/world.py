"""A whole laboratory in one thread: its moments, its processes, and what is seen of it.

The product's code is unmodified; `tests.simulated.seam` replaces what it stands on.
"""

from __future__ import annotations

import ast
import functools
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.network import messages
from agents.network.keys import Keys
from agents.runtime import loop
from agents.vectors import Vector
from experiments.definition.plan import Plan
from experiments.real_time.conductor import run_view
from experiments.real_time.hosts import run_registry
from experiments.real_time.processes import robot as robot_process
from experiments.real_time.processes import world_population
from tests.simulated import kernel as sim
from tests.simulated import network as net
from tests.simulated.faults import Fault, inject
from twins.models.motion import Motion

if TYPE_CHECKING:
    from tests.simulated.bodies import WatchedBody

LOOK_S = 0.05  # period of samples and rules
END_S = 0.05  # time after the end of the last process
OUTSIDE = ("operator", "capture", "second ", "site-")  # processes that no run has started

_world: World | None = None


def current() -> World:
    """The laboratory of this process: there is one."""
    assert _world is not None, "no laboratory is up"
    return _world


class World:
    """Laboratory of one flight: its script, and its history."""

    def __init__(
        self, kernel: sim.Kernel, script: Sequence[Fault], *, varied: bool, clocks: Mapping[str, float]
    ) -> None:
        """`varied`: processes start after random times; `clocks`: errors of the clocks of robots' machines [s]."""
        global _world  # noqa: PLW0603 - the seam replaces functions that have no other way to their laboratory
        _world = self
        self.kernel = kernel
        self.network = net.Network()
        self.script, self.varied, self.clocks = list(script), varied, dict(clocks)
        self.moments: dict[str, float] = {"launch": self.now}  # moments that a script counts from
        self.bodies: list[WatchedBody] = []
        self.populations: list[tuple[sim.Process, world_population.WorldBodies]] = []
        self.readings: dict[str, Any] = {}  # faults of measurements by robot: word, number, memory
        self.captures: dict[str, Any] = {}
        self.altered: dict[tuple[object, str], tuple[float, list[Fault]]] = {}  # usual values, and faults that last
        self.disks: dict[str, Any] = {}  # disks by the name of a process in a script
        self.robots: dict[str, sim.Process] = {}  # newest process that the run has started
        self.launched: dict[str, list[str]] = {}  # command lines of robots
        self.runtimes: dict[int, loop.Runtime] = {}  # runtimes by process id
        self.runs: list[tuple[run_registry.RegisteredRun, run_registry.Obey, sim.Process]] = []
        self.progress: run_view.Progress | None = None
        self.seen: dict[int, int] = {}  # number of events that were noted, by progress
        self.plan: Plan | None = None
        self.answers: list[tuple[float, str, str, sim.Process]] = []  # time, robot, words of operators
        self.notes: list[tuple[float, str]] = []
        self.events: list[messages.Event] = []
        self.phases: list[tuple[float, str, int, int, str]] = []  # time, robot, process, phase, reason
        self.hazards: list[tuple[float, str, str]] = []  # time, robot, text
        self.missing: list[tuple[float, str, tuple[str, ...]]] = []  # neighbours, by statuses
        self.commands: list[tuple[float, str, int]] = []
        self.poses: list[tuple[float, str, int]] = []
        self.motors: list[tuple[float, str, bool]] = []  # changes
        self.true: dict[str, Motion] = {}  # motions at the last look
        self.samples: dict[str, list[tuple[float, Vector, Vector, bool]]] = {}  # every `LOOK_S`, true
        self.takeoffs_ordered: list[tuple[float, str]] = []
        self.stops: list[float] = []
        self.drivers: dict[str, tuple[sim.Process, float]] = {}  # newest process that has driven a robot, and when
        self.rising: dict[tuple[int, str], bool] = {}  # True by process and robot if it was just told to take off
        self.cases: list[str] = []
        self.ends: dict[int, float] = {}  # times by process id
        self._flying: dict[str, bool] = {}
        self.disturbed_until = 0.0
        self.watchers: list[Callable[[], None]] = []  # called every `LOOK_S`
        self.on_command: list[Callable[[str, sim.Process], None]] = []
        self.on_pose: list[Callable[[str, sim.Process], None]] = []

    @property
    def processes(self) -> list[sim.Process]:
        return self.kernel.processes

    @property
    def interrupted(self) -> bool:
        """Whether the script has a Ctrl-C."""
        return any(fault.kind in {"interrupt", "term"} for fault in self.script)

    @property
    def now(self) -> float:
        return self.kernel.now

    def after(self, seconds: float, call: Callable[[], object]) -> None:
        self.kernel.after(seconds, call)

    def note(self, text: str) -> None:
        self.notes.append((self.now, text))

    # ------------------------------------------------------------------ the run

    def run(self, words: Sequence[str], limit_s: float, sites: Sequence[str] = ()) -> None:
        """Run `./zenpark run` with these words, until all processes of the run have ended, or for `limit_s` [s].

        A router runs already at each endpoint of `sites`, linked with those before it.
        """
        for row, site in enumerate(sites):
            links = [word for each in sites[:row] for word in ("--connect", each)]
            command = partial(main, "agents.runtime.router", ["--listen", site, *links])
            sim.Process(f"site-router{row + 1 if row else ''}", command)
        self.conductor = sim.Process("conductor", lambda: main("tools.guard", words))
        self._close_pipes_at_exit(self.conductor)
        self._schedule("launch")
        self.after(LOOK_S, self._look)
        self.kernel.run(self.now + limit_s)

    def note_end(self, process: sim.Process) -> None:
        """Note that a process has ended, maybe the last one of the run, or of the commands beside it."""
        self.ends.setdefault(process.pid, self.now)
        awaited = [each for each in self.processes if not each.name.startswith(OUTSIDE)]
        if all(each.dead for each in [*awaited, *(process for *_, process in self.answers)]):
            self.after(END_S, self.kernel.stop)

    def _close_pipes_at_exit(self, process: sim.Process) -> None:
        leave = process.exit

        def exit_process(code: int) -> None:
            if not process.dead:
                leave(code)
                for each in self.kernel.processes:
                    each.give(b"", eof=True)

        process.exit = exit_process

    def reach(self, moment: str, at: float | None = None) -> None:
        """Note the first time of a moment, at `at` [s], of which the script may depend."""
        if moment not in self.moments:
            self.moments[moment] = self.now if at is None else at
            self._schedule(moment)

    def _schedule(self, moment: str) -> None:
        for fault in self.script:
            if fault.since == moment:
                self.kernel.at(self.moments[moment] + fault.at, lambda fault=fault: inject(self, fault))

    def _look(self) -> None:
        self.after(LOOK_S, self._look)
        self.true = {}
        for name, _, motion in self.motions():
            self.true[name] = motion
            self.note_motors(name, motion)
            sample = self.now, motion.position, motion.velocity, motion.flying
            self.samples.setdefault(name, []).append(sample)
        for watch in self.watchers:
            watch()

    def note_motors(self, name: str, motion: Motion) -> None:
        if motion.flying != self._flying.get(name, False):
            self._flying[name] = motion.flying
            self.motors.append((self.now, name, motion.flying))

    # ------------------------------------------------------------------ processes

    def process(self, who: str) -> sim.Process | None:
        """The living process that a script names; None if there is none."""
        found = self.robots.get(who)
        if found is None:
            same = (
                each for each in reversed(self.kernel.processes) if each.name == who or each.name.endswith(f"-{who}")
            )
            found = next((each for each in same if not each.dead), None)
        return None if found is None or found.dead else found

    def sessions(self, who: str) -> list[net.Session]:
        return self._sessions(self.process(who))

    def tokens(self, process: sim.Process) -> list[str]:
        """Keys of the tokens that a process has declared; none if it is dead."""
        return [token.key for session in self._sessions(process) for token in session.tokens]

    def _sessions(self, process: sim.Process | None) -> list[net.Session]:
        there = [] if process is None or process.dead else process.sessions
        return [each for each in there if isinstance(each, net.Session)]

    def session(self, process: sim.Process) -> net.Session | None:
        """The newest open session of a living process."""
        return next((each for each in reversed(self._sessions(process)) if not each.closed), None)

    def signal(self, process: sim.Process, number: int) -> None:
        """Send a signal; what its handler raises is raised in the main thread."""
        if process.dead:
            return
        if process.paused:
            process.deferred.append((self.signal, (process, number)))
            return
        try:
            process.term(int(number))
        except BaseException as error:  # noqa: BLE001 - as the interpreter does
            sim.current().at(self.now, _raise_in, process.main, error)

    def hang(self, process: sim.Process, seconds: float) -> None:
        """Let the next sleep of a process, which is that of its loop, take so much longer."""
        process.stall = seconds

    def started(self, process: sim.Process, module: str, words: Sequence[str]) -> None:
        """Note a process that the launcher has started."""
        if module != robot_process.__name__:
            return
        for name in [word for word in words[1:] if self.plan is not None and word in self.plan.names]:
            self.robots[name] = process
            self.launched[name] = list(words)
            if name in self.clocks:
                process.env, process.wall = {}, self.clocks[name]

    def start_second(self, name: str, wall: float) -> None:
        """Start another process of a robot by hand: without a lifeline."""
        words = [word for word in self.launched.get(name, ()) if word != "--lifeline"]
        if not words:
            return
        process = sim.Process(f"second {name}", lambda: main(robot_process.__name__, [*words, "--once"]), {})
        process.wall = wall

    def spoil(self, name: str, lasts: float) -> None:
        """Let a stranger send what nobody can read on the keys of a robot, for some time [s]."""
        from tests.simulated import bodies  # noqa: PLC0415 - which needs this module

        realm = "park" if self.plan is None else self.plan.experiment.network.realm
        sim.Process("operator: a stranger", lambda: bodies.spoil(name, Keys(realm), lasts))

    def operate(self, words: Sequence[str], who: str) -> None:
        """Let an operator type a command."""
        process = sim.Process(f"operator {len(self.answers) + 1}", lambda: main("tools.guard", words))
        self.answers.append((self.now, who, " ".join(words), process))

    # ------------------------------------------------------------------ truth

    def motions(self) -> Iterator[tuple[str, sim.Process, Motion]]:
        """True motions of all robots with a living process that simulates them."""
        for body in self.bodies:
            for row, name in enumerate(body.names):
                if self.carries(name, body.process) and (motion := body.motion(row)) is not None:
                    yield name, body.process, motion
        for process, population in self.populations:
            if not process.dead:
                for name, carried, motion in zip(
                    population.names, population.carried, population.body.engine.motions, strict=True
                ):
                    if carried:
                        yield name, process, motion

    def carries(self, name: str, process: sim.Process) -> bool:
        """Whether the twin of a process is the robot: that of one started by hand is not, while the run's own lives."""
        own = self.robots.get(name, process)
        return not process.dead and (process is own or own.dead)

    def motion(self, name: str) -> Motion | None:
        """True motion of a robot, of its newest process."""
        return next((motion for other, _, motion in reversed([*self.motions()]) if other == name), None)


def running() -> sim.Process | None:
    """The simulated process that runs; None outside of all."""
    return None if sim._kernel is None else sim._kernel.process


def _raise_in(task: sim.Task, error: BaseException) -> None:
    """Raise an exception in a thread that waits."""
    kernel = sim.current()
    task._ticket += 1
    kernel.task, kernel.process = task, task.process
    try:
        task.greenlet.throw(error)
    finally:
        kernel.task = kernel.process = None


def main(module: str, words: Sequence[str]) -> int:
    """`python -m MODULE WORDS`: what the module does when it is the main one."""
    sys.argv = [module, *words]
    exec(_block(module), vars(importlib.import_module(module)))
    return 0


@functools.cache
def _block(module: str) -> Any:
    file = importlib.import_module(module).__file__
    assert file is not None
    tree = ast.parse(Path(file).read_text("utf-8"))
    last = tree.body[-1]
    assert isinstance(last, ast.If), f"{module} does nothing when it is the main module"
    return compile(ast.Module(last.body, []), file, "exec")
