"""Safety rules, each a sentence of the documentation that a laboratory is asked about while it runs, or at its end.

A rule gets what it looks at and returns what is wrong, an empty text if nothing is. `Look.lasting` is for conditions
that may hold for a while. `test_rules` compares the sentences with `docs`.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import hypot, inf, isfinite
from pathlib import Path
from typing import Any

import msgspec

from agents.body.kinds import Kind
from agents.decision.lifecycle import AIRBORNE, DONE, LANDING, RUNNING, Phase
from agents.robot import Robot
from agents.runtime.loop import Runtime
from agents.safety.hazards import Outcome
from experiments.metrics.measure import HOLDING
from experiments.recording import playback
from tests.simulated.kernel import BUSY_S, EPOCH, KILLED, Process
from tests.simulated.world import LOOK_S, OUTSIDE, World
from twins.models.motion import Motion

HELD = ("hold", "land", "cut")  # worst hazards with which a robot does not go on
QUIET_S = 4.0  # time after a disturbance, until all know all again
ASKED = ("finished", "ordered to", "emergency", "asked to", "lands as")  # reasons to land that are no faults


@dataclass
class Seen:
    """Robot at a look: its newest process, which is neither dead nor suspended and has joined."""

    name: str
    process: Process
    runtime: Runtime
    row: int
    kind: Kind
    motion: Motion | None  # None: simulated by no process
    before: int  # phase at the last look

    @property
    def robot(self) -> Robot:
        return self.runtime.robots[self.row]

    @property
    def phase(self) -> int:
        return self.robot.lifecycle.phase

    @property
    def hazard(self) -> str:
        return str(self.robot.hazards.worst())

    @property
    def held(self) -> bool:
        """Whether it stands for a reason that is not part of its experiment; a hold is told for a second longer."""
        hazards = self.robot.hazards
        return any(hazards.present >> each & 1 and hazards.level[each] == Outcome.HOLD for each in HOLDING)

    @property
    def governed(self) -> bool:
        """Whether its loop decides for the body: it owns the name, and no watchdog has taken over."""
        return not (self.runtime.keeper.hands_off or self.runtime.watchdog.tripped)

    @property
    def prompt(self) -> bool:
        return self.process.late <= BUSY_S

    @property
    def flying(self) -> bool:
        return self.kind.flies and self.motion is not None and self.motion.flying


@dataclass
class Look:
    """The laboratory now, with what former looks have found."""

    world: World
    since: dict[Hashable, float] = field(default_factory=dict)  # begin of lasting conditions
    sent: dict[tuple[int, str], int] = field(default_factory=dict)  # poses, by process and robot
    phases: dict[tuple[int, str], int] = field(default_factory=dict)
    links: dict[tuple[Process | None, bool], bool] = field(default_factory=dict)  # answers of `linked` at this look
    ran_s: dict[str, float] = field(default_factory=dict)  # time in the experiment, by robot
    held_s: dict[str, float] = field(default_factory=dict)  # time for which it stood then

    @property
    def now(self) -> float:
        return self.world.now

    @property
    def calm(self) -> bool:
        """Whether the last disturbance is over for long."""
        return self.now - self.world.disturbed_until > QUIET_S

    def lasting(self, key: Hashable, there: bool, limit_s: float) -> float:
        """Time for which a condition lasts, if that is more than the limit [s]; else 0."""
        if not there:
            self.since.pop(key, None)
            return 0.0
        lasted = self.now - self.since.setdefault(key, self.now)
        return lasted if lasted > limit_s else 0.0

    def seen(self) -> Iterator[Seen]:
        plan = self.world.plan
        if plan is None:
            return
        kinds = dict(zip(plan.names, plan.kinds, strict=True))
        for name, process in self.world.robots.items():
            runtime = self.world.runtimes.get(process.pid)
            if runtime is None or process.dead or process.paused or not runtime._joined:
                for key in [key for key in self.since if isinstance(key, tuple) and key[1] == name]:
                    del self.since[key]
                continue
            row = runtime._names.index(name)
            phase = runtime.robots[row].lifecycle.phase
            yield Seen(
                name, process, runtime, row, kinds[name], self.world.true.get(name),
                self.phases.get((process.pid, name), phase),
            )  # fmt: skip
            self.phases[process.pid, name] = phase

    def linked(self, process: Process | None, *, slowly: bool = False) -> bool:
        """Whether a process has a router that answers, over a cable that is not cut, nor slow unless that is enough."""
        if (found := self.links.get((process, slowly))) is None:
            found = self.links[process, slowly] = self._link(process, slowly=slowly)
        return found

    def _link(self, process: Process | None, *, slowly: bool) -> bool:
        if process is None or process.dead or process.paused:
            return False
        session = self.world.session(process)
        link = None if session is None else session.link
        if session is None or link is None or not link.open() or session.cut or (session.slow >= 100 and not slowly):
            return False
        return not (link.far.cut or link.far.process.paused)

    @cached_property
    def kinds(self) -> set[str]:
        """Kinds of the faults of the script."""
        return {fault.kind for fault in self.world.script}

    @cached_property
    def lies(self) -> bool:
        """Whether the script lets robots believe what is not true."""
        return bool(self.kinds & {"body", "capture", "step"})

    @cached_property
    def bent(self) -> bool:
        """Whether the script changes clocks, or orders a start."""
        return bool(self.kinds & {"step", "drift"}) or any("start" in str(each.size) for each in self.world.script)


@dataclass(frozen=True)
class Rule:
    name: str
    sentence: str  # text of `docs`; empty: no page has to promise that
    check: Callable[..., Any]


OF_ROBOTS: list[Rule] = []
OF_PAIRS: list[Rule] = []
OF_COMMANDS: list[Rule] = []
OF_POSES: list[Rule] = []
AT_THE_END: list[Rule] = []


def rule(table: list[Rule], sentence: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    def add(check: Callable[..., Any]) -> Callable[..., Any]:
        table.append(Rule(check.__name__.replace("_", "-"), sentence, check))
        return check

    return add


# ---------------------------------------------------------------------- of each robot


@rule(OF_ROBOTS, "A thread of the robot's process reads it and stops the body at once.")
def emergency_stop(look: Look, seen: Seen) -> str:
    """Motors are off 0.3 s after a stop that the run has received."""
    at = min(look.world.stops, default=inf)
    if look.now <= at + 0.3 or seen.process.started > at or not seen.flying or not seen.prompt:
        return ""
    apart = look.kinds & {"pause", "kill", "late", "hang"}
    return "" if apart else f"motors on {look.now - at:.2f} s after the emergency stop"


@rule(OF_ROBOTS, "A landing or a cut is final in a run.")
def final_landing(_: Look, seen: Seen) -> str:
    back = seen.before >= LANDING and seen.phase < seen.before
    return f"from {Phase(seen.before).word} to {Phase(seen.phase).word}" if back else ""


@rule(OF_ROBOTS, "| more than 0.25 m outside the arena | | land | |")
def inside_the_arena(look: Look, seen: Seen) -> str:
    if seen.motion is None or look.lies:
        return ""
    assert look.world.plan is not None
    (x, y, z), size = seen.motion.position, look.world.plan.experiment.arena.size
    beyond = max(abs(x) - 0.5 * size[0], abs(y) - 0.5 * size[1], z - size[2])
    return f"{beyond:.2f} m outside, at {seen.motion.position}" if beyond > 0.05 else ""


@rule(OF_ROBOTS, "| its goal or setpoint is not finite | | hold: the setpoint is its own position |")
def finite_motion(_: Look, seen: Seen) -> str:
    known = seen.motion is None or all(map(isfinite, seen.motion.position))
    return "" if known else f"its true position is {seen.motion.position}"


@rule(OF_ROBOTS, "It holds 1.3 to 1.8 s after the loss")
def hold_without_router(look: Look, seen: Seen) -> str:
    offline = not look.linked(seen.process, slowly=True) and seen.phase in (AIRBORNE, RUNNING) and seen.governed
    lasted = look.lasting(("hold", seen.name), offline, 2.2)
    goes_on = lasted and seen.prompt and not seen.hazard.startswith(HELD)
    return f"no router for {lasted:.1f} s, hazard '{seen.hazard}'" if goes_on else ""


@rule(OF_ROBOTS, "and lands 10.3 to 10.8 s after it")
def landing_without_router(look: Look, seen: Seen) -> str:
    offline = not look.linked(seen.process, slowly=True) and seen.phase in (AIRBORNE, RUNNING) and seen.governed
    lasted = look.lasting(("offline", seen.name), offline, 12.5)
    return f"no router for {lasted:.1f} s, still {Phase(seen.phase).word}" if lasted else ""


@rule(OF_ROBOTS, "land after `land_without_position_s` 0.3 s")
def landing_without_position(look: Look, seen: Seen) -> str:
    word = look.world.readings.get(seen.name, ("",))[0]
    blind = word in {"nan", "silent"} and seen.phase in (AIRBORNE, RUNNING) and seen.kind.flies and seen.governed
    lasted = look.lasting(("blind", seen.name), blind, 1.6)
    return f"no position for {lasted:.1f} s, still {Phase(seen.phase).word}" if lasted and seen.prompt else ""


@rule(OF_ROBOTS, "If a hazard causes it, the robot transmits no pose from its beginning, and its neighbours lose it.")
def silent_landing(look: Look, seen: Seen) -> str:
    sent, key = seen.runtime.counts.sent[seen.row], (seen.process.pid, seen.name)
    before, look.sent[key] = look.sent.get(key, sent), sent
    life = seen.robot.lifecycle
    own = seen.runtime._stopping is None and not seen.robot.landing.aside and seen.robot.begun
    if seen.before < LANDING or not own or life.reason.startswith(ASKED) or sent <= before:
        return ""
    assert look.world.plan is not None
    over = seen.runtime.ticks.t >= life.start_at + look.world.plan.experiment.duration_s - 0.1
    return "" if over else f"sends poses while it lands: {life.reason}"


def _misled(look: Look, seen: Seen) -> bool:
    """Whether its body, world or process cannot do what it should; a twin stands still while its loop hangs."""
    assert look.world.plan is not None
    carried = look.world.plan.experiment.robots[seen.name].body == "world"
    if carried and any("world" in {fault.who, *str(fault.size).split()} for fault in look.world.script):
        return True
    faults = [fault for fault in look.world.script if fault.who == seen.name]
    sizes = [str(fault.size) for fault in faults if fault.kind in {"body", "capture"}]
    wrong = any(word in size for size in sizes for word in ("motors", "stuck", "adrift", "aloft"))
    return wrong or any(fault.kind == "hang" for fault in faults) or not seen.prompt


@rule(OF_ROBOTS, "its landing makes no progress for this time")
def descent(look: Look, seen: Seen) -> str:
    lands = seen.phase == LANDING and seen.flying and not _misled(look, seen)
    lasted = look.lasting(("descent", seen.name), lands, 12.0)
    return f"lands for {lasted:.1f} s, at {seen.motion.position}" if lasted and seen.motion else ""


@rule(OF_ROBOTS, "A robot that was stopped counts as stopped when its body confirms it: motors off")
def motors_off_when_done(look: Look, seen: Seen) -> str:
    on = seen.phase == DONE and seen.flying and not _misled(look, seen)
    return f"done, motors on: {seen.robot.lifecycle.reason}" if look.lasting(("done", seen.name), on, 0.5) else ""


@rule(OF_ROBOTS, "its robots land after 3 s without its heartbeat")
def landing_without_launcher(look: Look, seen: Seen) -> str:
    conductor = look.world.conductor
    silent = conductor.paused and look.now - conductor.paused_at > 0.6
    orphan = (conductor.dead and conductor.code != 0) or silent
    there = orphan and seen.phase in (AIRBORNE, RUNNING) and seen.prompt and seen.governed
    lasted = look.lasting(("lifeline", seen.name), there, 4.0)
    return f"its launcher is silent for {lasted:.1f} s, still {Phase(seen.phase).word}" if lasted else ""


@rule(OF_ROBOTS, "")
def obedience(look: Look, seen: Seen) -> str:
    """Half a second after it was accepted an order is obeyed."""
    if not look.world.answers or any(each.name == f"second {seen.name}" for each in look.world.processes):
        return ""
    obeys = {
        "land": seen.phase >= LANDING,
        "stop": seen.phase >= LANDING,
        "hold": seen.phase != RUNNING or seen.hazard.startswith(HELD),
    }
    for _, who, words, process in look.world.answers:
        age = look.now - look.world.ends.get(process.pid, inf)
        word = words.split()[1] if words.startswith("robot ") else ""
        newest = not any(
            t > look.now - age - 1.0 and other == who for t, other, _, each in look.world.answers if each is not process
        )
        due = who == seen.name and process.code == 0 and 0.5 <= age < 0.5 + LOOK_S and newest
        if (
            due
            and seen.governed
            and seen.prompt
            and seen.process.started < look.now - age
            and not obeys.get(word, True)
        ):
            return f"accepted `{words}`, and is {Phase(seen.phase).word}, hazard '{seen.hazard}'"
    return ""


@rule(OF_ROBOTS, "For each run it prints which of *its* robots have")
def truth_about_stops(look: Look, seen: Seen) -> str:
    """Motors are off when a command says that a robot has stopped."""
    for _, _, words, process in look.world.answers:
        age = look.now - look.world.ends.get(process.pid, inf)
        fresh = 0.0 <= age < LOOK_S and seen.process.started < look.now - age - 2.5
        text = "".join(process.out) if fresh and words.startswith(("estop", "robot stop")) else ""
        named = re.search(rf"^(stopped: .*\b{seen.name}\b.*|{seen.name}: has stopped)$", text, re.MULTILINE)
        if named and seen.flying and "dry-run" not in words:
            return f"motors on, `{words}` said: {named[0]}"
    return ""


@rule(OF_ROBOTS, "A neighbour counts as alive only while there is a token with its exact key")
def knowledge_of_tokens(look: Look, seen: Seen) -> str:
    """Three seconds after the last disturbance each robot knows who is alive."""
    flies = seen.phase in (AIRBORNE, RUNNING)
    knows = flies and look.calm and look.linked(seen.process) and seen.governed and seen.prompt
    for sender in seen.runtime._neighbours.senders:
        if not knows:
            look.since.pop(("token", seen.name, sender.name), None)
            continue
        other = look.world.robots.get(sender.name)
        tokens = (token.key for session in look.world.sessions(sender.name) for token in session.tokens)
        there = sender._token in tokens
        differs = other is not None and (other.dead or look.linked(other)) and bool(sender.alive) != there
        if lasted := look.lasting(("token", seen.name, sender.name), differs, 3.0):
            return f"believes that {sender.name} is {'alive' if sender.alive else 'gone'} for {lasted:.1f} s"
    return ""


@rule(
    OF_ROBOTS, "arrives earlier: with the neighbour's next heartbeat (0.5 s) or, after a reconnection, with its history"
)
def knowledge_of_poses(look: Look, seen: Seen) -> str:
    """Three seconds after the last disturbance each robot has the newest poses."""
    lossy = look.kinds & {"loss", "reorder"}
    knows = look.calm and not lossy and look.linked(seen.process) and seen.governed and seen.prompt
    for sender in seen.runtime._neighbours.senders:
        if not knows:
            look.since.pop(("pose", seen.name, sender.name), None)
            continue
        other = look.world.robots.get(sender.name)
        theirs = None if other is None else look.world.runtimes.get(other.pid)
        deaf = False
        if theirs is not None and theirs._joined and look.linked(other) and not sender.doubt:
            row = theirs._names.index(sender.name)
            both = seen.phase in (AIRBORNE, RUNNING) and theirs.robots[row].lifecycle.phase in (AIRBORNE, RUNNING)
            deaf = both and sender._order.seq < theirs.counts.sent[row] - 2
        if lasted := look.lasting(("pose", seen.name, sender.name), deaf, 3.0):
            return f"has no new pose of {sender.name} for {lasted:.1f} s"
    return ""


@rule(OF_ROBOTS, "")
def picture_of_the_conductor(look: Look, seen: Seen) -> str:
    """Three seconds after the last disturbance the conductor knows the phase of each robot."""
    progress, conductor = look.world.progress, look.world.conductor
    view = None if progress is None else progress.robots.get(seen.name)
    if view is None or view.status is None or conductor.dead:
        return ""
    well = look.calm and look.linked(conductor) and look.linked(seen.process) and seen.governed
    wrong = well and not seen.runtime._descent.begun and view.status.phase != Phase(seen.phase).word
    lasted = look.lasting(("view", seen.name), wrong, 3.0)
    return f"is {Phase(seen.phase).word}, the conductor says {view.status.phase} for {lasted:.1f} s" if lasted else ""


@rule(OF_ROBOTS, "")
def common_start(look: Look, seen: Seen) -> str:
    """Robots whose clocks are right begin together."""
    at, start = seen.robot.lifecycle.start_at, look.world.moments.get("start")
    if start is None or not isfinite(at) or look.bent or seen.name in look.world.clocks:
        return ""
    off = seen.runtime._utc + at - EPOCH - start
    return f"begins {off:+.3f} s from the common start" if abs(off) > 0.02 else ""


# ---------------------------------------------------------------------- of pairs, commands and poses


@rule(OF_PAIRS, "An `avoidance` keeps clear of its last known position, from the floor up")
def contact(look: Look, one: Seen, other: Seen) -> str:
    assert look.world.plan is not None
    if look.world.plan.experiment.avoidance is None or look.lies or one.motion is None or other.motion is None:
        return ""
    p, q = one.motion.position, other.motion.position
    beside = hypot(p[0] - q[0], p[1] - q[1]) < one.kind.radius + other.kind.radius
    level = abs(p[2] - q[2]) < max(one.kind.height, other.kind.height)
    return f"touches {other.name}, {p} {q}" if beside and level else ""


def _second_voice(look: Look, name: str, process: Process) -> str:
    """Newer processes that drive the robot of an older one, though both are on the network."""
    newer = look.world.drivers.get(name)
    if newer is None:
        return ""
    other, at = newer
    older = process.started < other.started and other is not process
    if not older or other.dead or other.paused or look.now - at >= 0.2 or not look.linked(process):
        return ""
    session = look.world.session(process)
    fresh = session is not None and session.link is not None and look.now <= session.link.since
    woken = process.resumed_at > look.now - 1.0 and process.resumed_at - process.paused_at > 0.7
    both = not fresh and (look.linked(other) or woken)
    return f"by process {process.pid}, {look.now - at:.3f} s after {other.pid}" if both else ""


@rule(OF_COMMANDS, "A process commands a body only while it owns the robot's name on the network")
def one_driver(look: Look, name: str, process: Process) -> str:
    found = _second_voice(look, name, process)
    newest = look.world.drivers.get(name)
    if newest is None or newest[0].started <= process.started or newest[0].dead:
        look.world.drivers[name] = process, look.now
    return f"command {found}" if found else ""


@rule(OF_POSES, "it commands no body, sends nothing, and answers no order")
def one_speaker(look: Look, name: str, process: Process) -> str:
    return f"pose {found}" if (found := _second_voice(look, name, process)) else ""


@rule(OF_COMMANDS, "A robot is *ready*, and obeys `takeoff`, only when all of the conditions below hold.")
def take_off_on_order(look: Look, name: str, process: Process) -> str:
    runtime = look.world.runtimes.get(process.pid)
    if runtime is None or name not in runtime._names or not look.world.rising.pop((process.pid, name), False):
        return ""
    asked = any(robot == name and look.now - at < 2.5 for at, robot in look.world.takeoffs_ordered)
    return "" if asked else "takes off without an order"


# ---------------------------------------------------------------------- at the end


@dataclass
class End:
    """A laboratory after its end."""

    look: Look
    folder: Path

    @property
    def world(self) -> World:
        return self.look.world

    @property
    def code(self) -> int | None:
        return self.world.conductor.code

    @property
    def output(self) -> str:
        return "".join(self.world.conductor.out)

    @property
    def start(self) -> float:
        return self.world.moments.get("start", inf)

    @property
    def duration_s(self) -> float:
        return self.world.plan.experiment.duration_s if self.world.plan is not None else 0.0

    @property
    def own(self) -> list[Process]:
        return [process for process in self.world.processes if not process.name.startswith(OUTSIDE)]


@rule(AT_THE_END, "So after any failure a robot ends up stopped or landed.")
def robots_are_down(end: End) -> Iterator[str]:
    for body in end.world.bodies:
        if body.process.dead and body.process.code == 0:
            for row, name in enumerate(body.names):
                if (motion := body.motion(row)) is not None and motion.flying:
                    yield f"{name}: its process ended with 0, its motors are on"


@rule(AT_THE_END, "")
def all_end(end: End) -> Iterator[str]:
    """All processes of the run end."""
    if left := [process.name for process in end.own if not process.dead]:
        yield f"still there: {', '.join(left)}"


@rule(AT_THE_END, "")
def no_exception(end: End) -> Iterator[str]:
    """No exception ends a thread or a process, and none is printed."""
    for _, name, thread, text in end.world.kernel.crashes:
        yield f"{name}/{thread}: {text.strip().splitlines()[-1]}\n{text}"
    crashed = {crash[1] for crash in end.world.kernel.crashes}
    for process in end.world.processes:
        if process.name not in crashed and "Traceback" in (text := "".join(process.out)):
            yield f"{process.name} prints a traceback: {text[-600:]}"


@rule(AT_THE_END, "")
def exit_codes(end: End) -> Iterator[str]:
    """Exit codes are those that the documentation lists."""
    for process in end.own:
        good = (0, 1, 2, 3, 130, -9, -15) if process is end.world.conductor else (0, -9, 2, 70, -15)
        if process.dead and process.code not in good:
            yield f"{process.name}: exit code {process.code}"


@rule(AT_THE_END, "")
def exit_codes_of_the_run(end: End) -> Iterator[str]:
    """The run ends with 130 if it was interrupted, with 2 if it was not flown or its own process stood still."""
    conductor, kinds = end.world.conductor, {fault.kind for fault in end.world.script}
    if end.code == 130 and not end.world.interrupted:
        yield "exit code 130 without an interrupt"
    if end.code == 2 and "start" in end.world.moments and conductor.paused_at == -inf and not kinds & {"late", "hang"}:
        yield f"exit code 2 of a run that began: {end.output[-300:]}"
    if end.code in {KILLED, -15} and not kinds & {"kill", "term"}:
        yield f"exit code {end.code}"


@rule(AT_THE_END, "")
def commands_end(end: End) -> Iterator[str]:
    """Commands of operators end, with a code that the documentation lists."""
    for t, _, words, process in end.world.answers:
        ended = end.world.ends.get(process.pid, inf)
        if process.code not in {0, 1, 2, None}:
            yield f"`{words}`: exit code {process.code}"
        if ended - t > (95.0 if "re" in words else 12.0) and end.look.now - t > 95.0:
            yield f"`{words}` takes {ended - t:.0f} s"


@rule(AT_THE_END, "ends with exit code 1 and says so in its last line")
def words_for_a_failure(end: End) -> Iterator[str]:
    reasons = ("zenpark: ", "Spoiled", "Not passed", "failed", "landed", "emergency stop")
    if end.code in {1, 2, 3} and not any(word in end.output for word in reasons):
        yield f"exit code {end.code} without a reason: {end.output[-300:]}"


@rule(AT_THE_END, "")
def counters(end: End) -> Iterator[str]:
    """No counter of lost poses is negative."""
    for name, process in end.world.robots.items():
        runtime = end.world.runtimes.get(process.pid)
        if runtime is not None and runtime._joined:
            for sender in runtime._neighbours.senders:
                if sender.lost < 0:
                    yield f"{name}: lost {sender.lost} of {sender.name}"


@rule(AT_THE_END, "**A robot that did not do its part fails the run.**")
def no_success_without_all(end: End) -> Iterator[str]:
    """Exit code 0 only if every robot did its part."""
    if end.code != 0:
        return
    for process in end.own:
        runtime = end.world.runtimes.get(process.pid)
        for robot in [] if runtime is None else runtime.robots:
            life = robot.lifecycle
            if life.phase >= LANDING and not life.reason.startswith(ASKED) and robot.begun:
                yield f"{robot.assignment.name}: {life.reason}"
        ended = end.world.ends.get(process.pid, inf) - end.start
        restarted = process.name.endswith(("router", "router2", "router3", "world", "centre"))
        if process.code == KILLED and not restarted and 0.0 < ended < end.duration_s - 0.6:
            yield f"{process.name} was killed at {ended:.1f} s"
    assert end.world.plan is not None
    for name, asked in end.world.plan.experiment.robots.items():
        ran, held = end.look.ran_s.get(name, 0.0), end.look.held_s.get(name, 0.0)
        if asked.standby or end.world.interrupted:
            continue
        if ran < 0.8 * end.duration_s:
            yield f"{name}: ran for {ran:.1f} of {end.duration_s:g} s"
        elif held > 0.2 * end.duration_s + 3.0 * LOOK_S:
            yield f"{name}: held for {held:.1f} of {end.duration_s:g} s"


@rule(AT_THE_END, "")
def no_success_of_a_part(end: End) -> Iterator[str]:
    """Exit code 0 only if the figures are over the whole run."""
    metrics = end.folder / "metrics.json"
    for case in msgspec.json.decode(metrics.read_bytes()) if end.code == 0 and metrics.is_file() else ():
        if case["interrupted"]:
            yield f"{case['case']}: figures of {case['duration_s']:.1f} of {case['planned_s']:g} s"


@rule(AT_THE_END, "An emergency stop ends the whole run")
def no_success_after_a_stop(end: End) -> Iterator[str]:
    at = min(end.world.stops, default=inf) - end.start
    if end.code == 0 and 0.0 < at < end.duration_s - 0.3:
        yield f"emergency stop at {at:.1f} s"


@rule(AT_THE_END, "")
def no_success_after_a_change(end: End) -> Iterator[str]:
    """Exit code 0 only if no operator has landed, stopped or exchanged a robot in the run."""
    for t, who, words, process in end.world.answers:
        changed = words.split()[1:2] in (["remove"], ["replace"], ["land"], ["stop"])
        if (
            end.code == 0
            and changed
            and process.code == 0
            and 0.1 < t - end.start < end.duration_s - playback.EARLY_S - 0.1
        ):
            yield f"{who}: `{words}` at {t - end.start:.1f} s"


@rule(AT_THE_END, "")
def recording_is_kept(end: End) -> Iterator[str]:
    """The recording is found, and its figures are finite."""
    if end.code not in {0, 1, 3} or "start" not in end.world.moments or end.world.disks:
        return
    for case in end.world.cases[:1]:
        file = end.folder / f"{case}.mcap"
        if parts := sorted(end.folder.rglob("part*.mcap")):
            yield f"parts are left: {parts}"
        if not file.is_file():
            yield f"no {file.name}"
            continue
        try:
            if not (end.folder / "metrics.json").is_file():
                playback.read(file)
        except playback.NotStarted:
            pass
        except Exception as error:  # noqa: BLE001 - whatever it is, a rule is broken
            yield f"{file.name}: {type(error).__name__}: {error}"
    metrics = end.folder / "metrics.json"
    if metrics.is_file() and (bad := [*_not_finite(msgspec.json.decode(metrics.read_bytes()))]):
        yield f"figures are no numbers: {bad[:5]}"


def _not_finite(value: object, place: str = "") -> Iterator[str]:
    if isinstance(value, float) and not math.isfinite(value):
        yield place
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _not_finite(each, f"{place}.{key}")
    elif isinstance(value, list):
        for number, each in enumerate(value):
            yield from _not_finite(each, f"{place}[{number}]")


# ---------------------------------------------------------------------- all together


class Rules:
    """All rules, asked of one laboratory; each is reported once for each robot."""

    def __init__(self, world: World) -> None:
        self.violations: list[tuple[str, float, str]] = []  # rule, time, text
        self.robot_s = 0.0
        self._look, self._known = Look(world), set[tuple[str, str]]()
        world.watchers.append(self._check)
        world.on_command.append(lambda name, process: self._use(OF_COMMANDS, name, process))
        world.on_pose.append(lambda name, process: self._use(OF_POSES, name, process))

    def judge(self, folder: Path) -> None:
        """Ask at the end."""
        for each in AT_THE_END:
            for text in each.check(End(self._look, folder)):
                self._violate(each, text.partition(":")[0], text)

    def _check(self) -> None:
        look = self._look
        look.links.clear()
        seen = [*look.seen()]
        self.robot_s += LOOK_S * len(seen)
        for one in seen:
            self._count(one)
            for each in OF_ROBOTS:
                if text := each.check(look, one):
                    self._violate(each, one.name, f"{one.name}: {text}")
        for one, other in itertools.combinations(seen, 2):
            for each in OF_PAIRS:
                if text := each.check(look, one, other):
                    self._violate(each, one.name, f"{one.name}: {text}")

    def _count(self, seen: Seen) -> None:
        look, start = self._look, self._look.world.moments.get("start", inf)
        assert look.world.plan is not None
        if 0.0 <= look.now - start <= look.world.plan.experiment.duration_s and seen.phase == RUNNING:
            look.ran_s[seen.name] = look.ran_s.get(seen.name, 0.0) + LOOK_S
            if seen.held:
                look.held_s[seen.name] = look.held_s.get(seen.name, 0.0) + LOOK_S

    def _use(self, rules: list[Rule], name: str, process: Process) -> None:
        self._look.links.clear()
        for each in rules:
            if text := each.check(self._look, name, process):
                self._violate(each, name, f"{name}: {text}")

    def _violate(self, broken: Rule, who: str, text: str) -> None:
        if (broken.name, who) not in self._known:
            self._known.add((broken.name, who))
            self.violations.append((broken.name, self._look.now, text))
