"""Safety rules, each a sentence of the documentation that a laboratory is asked about while it runs, or at its end.

A rule gets what it looks at and returns what is wrong, an empty text if nothing is. `Look.lasting` is for conditions
that may hold for a while. `test_rules` compares the sentences with `docs`.
"""

from __future__ import annotations

import itertools
import re
from functools import partial
from math import hypot, inf, isfinite
from pathlib import Path

from agents.decision.lifecycle import AIRBORNE, DONE, LANDING, RUNNING, Phase
from agents.runtime.lifeline import GONE
from tests.simulated.end_rules import ASKED, End
from tests.simulated.kernel import Process
from tests.simulated.look import AT_THE_END, OF_COMMANDS, OF_PAIRS, OF_POSES, OF_ROBOTS, Look, Rule, Seen, rule
from tests.simulated.world import LOOK_S, World

LIES = {"body", "capture", "step"}  # faults that let a robot believe what is not true
OF_LINKS = {"loss", "duplicate", "reorder"}  # faults under which orders are repeated until they are obeyed
HEALED_S = 0.5  # time after a split in which its routers find each other, and the later of two owners learns of it
HELD = ("hold", "land", "cut")  # worst hazards with which a robot does not go on


# ---------------------------------------------------------------------- of each robot


@rule(OF_ROBOTS, "A thread of the robot's process reads it and stops the body at once.")
def emergency_stop(look: Look, seen: Seen) -> str:
    """Motors are off 0.3 s after a stop that the run has received."""
    at = min(look.world.stops, default=inf)
    if look.now <= at + 0.3 + look.slack_s or seen.process.started > at or not seen.flying or not seen.prompt:
        return ""
    apart = look.world.network.cuts_lifeline(look.world.conductor, seen.process)
    apart = apart or look.spoiled({"pause", "kill", "late", "hang"}, seen.name, "router", "conductor")
    return "" if apart else f"motors on {look.now - at:.2f} s after the emergency stop"


@rule(OF_ROBOTS, "A landing or a cut is final in a run.")
def final_landing(_: Look, seen: Seen) -> str:
    back = seen.before >= LANDING and seen.phase < seen.before
    return f"from {Phase(seen.before).word} to {Phase(seen.phase).word}" if back else ""


@rule(OF_ROBOTS, "| more than 0.25 m outside the arena | | land | |")
def inside_the_arena(look: Look, seen: Seen) -> str:
    if seen.motion is None or look.spoiled(LIES, seen.name):
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
    limit_s = 2.5 if look.spoiled({"hang"}, seen.name) else 2.2  # a slow loop notices later
    lasted = look.lasting(("hold", seen.name), offline and seen.prompt, limit_s)
    goes_on = lasted and not seen.hazard.startswith(HELD)
    return f"no router for {lasted:.1f} s, hazard '{seen.hazard}'" if goes_on else ""


@rule(OF_ROBOTS, "and lands 10.3 to 10.8 s after it")
def landing_without_router(look: Look, seen: Seen) -> str:
    offline = not look.linked(seen.process, slowly=True) and seen.phase in (AIRBORNE, RUNNING) and seen.governed
    lasted = look.lasting(("offline", seen.name), offline, 12.5)
    return f"no router for {lasted:.1f} s, still {Phase(seen.phase).word}" if lasted else ""


@rule(OF_ROBOTS, "It lands all after `offline_s`", inside=True)
def landing_without_answer(look: Look, seen: Seen) -> str:
    """A process that asks for the owner of its name commands its body again after `offline_s`."""
    assert look.world.plan is not None
    keeper, (process, at) = seen.inside.keeper, look.world.drivers.get(seen.name, (None, -inf))
    silent_s = look.now - max(at, seen.process.resumed_at)
    waits = keeper.hands_off and not keeper.ownership.contested and process is seen.process and seen.prompt
    late = seen.flying and waits and silent_s > look.world.plan.experiment.safety.offline_s + 0.5
    return f"no command for {silent_s:.1f} s, while it asks for its owner" if late else ""


@rule(OF_ROBOTS, "land after `land_without_position_s` 0.3 s")
def landing_without_position(look: Look, seen: Seen) -> str:
    word = look.world.readings.get(seen.name, ("",))[0]
    aloft = seen.phase in (AIRBORNE, RUNNING) and seen.kind.flies and seen.governed
    blind = word in {"nan", "silent"} and aloft and not _carried(look, seen)  # `world.patience_s` is longer
    lasted = look.lasting(("blind", seen.name), blind, 1.6)
    return f"no position for {lasted:.1f} s, still {Phase(seen.phase).word}" if lasted and seen.prompt else ""


@rule(
    OF_ROBOTS,
    "If a hazard causes it, the robot transmits no pose from its beginning, and its neighbours lose it.",
    inside=True,
)
def silent_landing(look: Look, seen: Seen) -> str:
    sent, key = seen.inside.counts.sent[seen.row], (seen.process.pid, seen.name)
    before, look.sent[key] = look.sent.get(key, sent), sent
    life = seen.robot.lifecycle
    own = seen.inside._stopping is None and not seen.robot.landing.aside and seen.robot.begun
    if seen.before < LANDING or not own or life.reason.startswith(ASKED) or sent <= before:
        return ""
    assert look.world.plan is not None
    over = seen.inside.ticks.t >= life.start_at + look.world.plan.experiment.duration_s - 0.1
    return "" if over else f"sends poses while it lands: {life.reason}"


def _carried(look: Look, seen: Seen) -> bool:
    assert look.world.plan is not None
    return look.world.plan.experiment.robots[seen.name].body == "world"


def _misled(look: Look, seen: Seen) -> bool:
    """Whether its body, world or process cannot do what it should; a twin stands still while its process hangs."""
    of_world = (each for each in look.world.script if "world" in {each.who, *str(each.size).split()})
    if _carried(look, seen) and any(each.kind not in OF_LINKS for each in of_world):
        return True
    faults = [fault for fault in look.world.script if fault.who == seen.name]
    sizes = [str(fault.size) for fault in faults if fault.kind in {"body", "capture"}]
    wrong = any(word in size for size in sizes for word in ("motors", "stuck", "adrift", "aloft"))
    still = not _carried(look, seen) and look.spoiled({"hang"}, seen.name)
    return wrong or still or not seen.prompt


@rule(OF_ROBOTS, "its landing makes no progress for this time")
def descent(look: Look, seen: Seen) -> str:
    lands = seen.phase == LANDING and seen.flying and seen.governed and not _misled(look, seen)
    lasted = look.lasting(("descent", seen.name), lands, 12.0)
    return f"lands for {lasted:.1f} s, at {seen.motion.position}" if lasted and seen.motion else ""


@rule(OF_ROBOTS, "A robot that was stopped counts as stopped when its body confirms it: motors off")
def motors_off_when_done(look: Look, seen: Seen) -> str:
    on = seen.phase == DONE and seen.flying and not _misled(look, seen)
    limit_s = 1.5 if look.spoiled({"loss"}, seen.name) else 0.5  # 75 orders, of which nine of ten may be lost
    return f"done, motors on: {seen.reason}" if look.lasting(("done", seen.name), on, limit_s) else ""


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
    if not look.world.answers:
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
            look.now >= t > look.now - age - 1.0 and other in {who, ""}  # "" is an order to all
            for t, other, _, each in look.world.answers
            if each is not process
        )
        due = who == seen.name and process.code == 0 and 0.0 <= age - 0.5 - look.slack_s < LOOK_S and newest
        if (
            due
            and seen.governed
            and seen.prompt
            and seen.process.started < look.now - age
            and not obeys.get(word, True)
            and all(each.name != f"second {seen.name}" for each in look.world.processes)
        ):
            return f"accepted `{words}`, and is {Phase(seen.phase).word}, hazard '{seen.hazard}'"
    return ""


@rule(OF_ROBOTS, "For each run it prints which of *its* robots have", inside=True)
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


@rule(OF_ROBOTS, "A neighbour counts as alive only while there is a token with its exact key", inside=True)
def knowledge_of_tokens(look: Look, seen: Seen) -> str:
    """Three seconds after the last disturbance each robot knows who is alive."""
    flies = seen.phase in (AIRBORNE, RUNNING)
    knows = flies and look.calm and look.linked(seen.process) and seen.governed and seen.prompt
    for sender in seen.inside._neighbours.senders:
        if not knows:
            look.since.pop(("token", seen.name, sender.name), None)
            continue
        own, owners = look.world.robots.get(sender.name), look.owners(sender._token)
        heard = own is not None and (own.dead or look.linked(own)) and all(map(look.linked, owners))
        differs = heard and bool(sender.alive) != bool(owners)
        if lasted := look.lasting(("token", seen.name, sender.name), differs, 3.0):
            return f"believes that {sender.name} is {'alive' if sender.alive else 'gone'} for {lasted:.1f} s"
    return ""


@rule(
    OF_ROBOTS,
    "arrives earlier: with the neighbour's next heartbeat (0.5 s) or, after a reconnection, with its history",
    inside=True,
)
def knowledge_of_poses(look: Look, seen: Seen) -> str:
    """Three seconds after the last disturbance each robot has the newest poses."""
    lossy = look.kinds & {"loss", "reorder"}
    knows = look.calm and not lossy and look.linked(seen.process) and seen.governed and seen.prompt
    for sender in seen.inside._neighbours.senders:
        if not knows:
            look.since.pop(("pose", seen.name, sender.name), None)
            continue
        owners = look.owners(sender._token)
        theirs = look.world.runtimes.get(owners[0].pid) if len(owners) == 1 and look.linked(owners[0]) else None
        deaf = False
        if theirs is not None and theirs._joined and not sender.doubt:
            row = theirs._names.index(sender.name)
            both = seen.phase in (AIRBORNE, RUNNING) and theirs.robots[row].lifecycle.phase in (AIRBORNE, RUNNING)
            deaf = both and sender._order.seq < theirs.counts.sent[row] - 2
        if lasted := look.lasting(("pose", seen.name, sender.name), deaf, 3.0):
            return f"has no new pose of {sender.name} for {lasted:.1f} s"
    return ""


@rule(OF_ROBOTS, "", inside=True)
def picture_of_the_conductor(look: Look, seen: Seen) -> str:
    """Three seconds after the last disturbance the conductor knows the phase of each robot."""
    progress, conductor = look.world.progress, look.world.conductor
    view = None if progress is None else progress.robots.get(seen.name)
    if view is None or view.status is None or conductor.dead:
        return ""
    well = look.calm and look.linked(conductor) and look.linked(seen.process) and seen.governed
    well = well and seen.reason != GONE and view.left_because != "lost"  # a conductor that ends robots looks no more
    stands = "command" in look.kinds and seen.inside._telemetry._resting[seen.row]  # a paused world confirms no stop
    well = well and not stands
    wrong = well and not seen.inside._descent.begun and view.status.phase != Phase(seen.phase).word
    lasted = look.lasting(("view", seen.name), wrong, 3.0)
    return f"is {Phase(seen.phase).word}, the conductor says {view.status.phase} for {lasted:.1f} s" if lasted else ""


@rule(OF_ROBOTS, "")
def common_start(look: Look, seen: Seen) -> str:
    """Robots whose clocks are right begin together."""
    start = look.world.moments.get("start")
    if start is None or not isfinite(seen.start) or look.bent or seen.name in look.world.clocks:
        return ""
    off = seen.start - start
    return f"begins {off:+.3f} s from the common start" if abs(off) > 0.02 else ""


# ---------------------------------------------------------------------- of pairs, commands and poses


@rule(OF_PAIRS, "An `avoidance` keeps clear of its last known position, from the floor up")
def contact(look: Look, one: Seen, other: Seen) -> str:
    assert look.world.plan is not None
    if look.world.plan.experiment.avoidance is None or one.motion is None or other.motion is None:
        return ""
    if look.spoiled(LIES, one.name, other.name):
        return ""
    p, q = one.motion.position, other.motion.position
    beside = hypot(p[0] - q[0], p[1] - q[1]) < one.kind.radius + other.kind.radius
    level = abs(p[2] - q[2]) < max(one.kind.height, other.kind.height)
    excused = ("excused", one.name, other.name)  # they met while the body of one followed its last command
    if not (beside and level):
        look.since.pop(excused, None)
    elif not (one.governed and other.governed):
        look.since[excused] = look.now
    return f"touches {other.name}, {p} {q}" if beside and level and excused not in look.since else ""


def _apart(look: Look, process: Process, other: Process) -> bool:
    """Whether a split is between two processes that have routers, or has just healed."""
    one, two = (session and session.link for session in map(look.world.session, (process, other)))
    if one is None or two is None or one.far is two.far:
        return False
    link = one.far.path_to(two.far)
    return link is None or link.out or look.now - max(link.since, look.world.network.healed) < HEALED_S


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
    both = not fresh and ((look.linked(other) and not _apart(look, process, other)) or woken)
    return f"by process {process.pid}, {look.now - at:.3f} s after {other.pid}" if both else ""


@rule(OF_COMMANDS, "A process commands a body only while it owns the robot's name on the network", inside=True)
def one_driver(look: Look, name: str, process: Process) -> str:
    found = _second_voice(look, name, process)
    newest = look.world.drivers.get(name)
    if newest is None or newest[0].started <= process.started or newest[0].dead:
        look.world.drivers[name] = process, look.now
    return f"command {found}" if found else ""


@rule(OF_POSES, "it commands no body, sends nothing, and answers no order", inside=True)
def one_speaker(look: Look, name: str, process: Process) -> str:
    return f"pose {found}" if (found := _second_voice(look, name, process)) else ""


@rule(OF_COMMANDS, "A robot is *ready*, and obeys `takeoff`, only when all of the conditions below hold.", inside=True)
def take_off_on_order(look: Look, name: str, process: Process) -> str:
    runtime = look.world.runtimes.get(process.pid) if look.world.rising else None
    if runtime is None or name not in runtime._names or not look.world.rising.pop((process.pid, name), False):
        return ""
    asked = any(robot == name and look.now - at < 2.5 for at, robot in look.world.takeoffs_ordered)
    return "" if asked else "takes off without an order"


# ---------------------------------------------------------------------- all together


class Rules:
    """All rules, asked of one laboratory; each is reported once for each robot."""

    def __init__(self, world: World, look: Look | None = None) -> None:
        """`look`: of a laboratory of real processes, which tell what they will."""
        self.violations: list[tuple[str, float, str]] = []  # rule, time, text
        self.robot_s = 0.0
        self._look, self._known = look or Look(world), set[tuple[str, str]]()
        self._of_robots = [each for each in OF_ROBOTS if look is None or not each.inside]
        world.watchers.append(self._check)
        world.on_command.append(partial(self._use, OF_COMMANDS))
        world.on_pose.append(partial(self._use, OF_POSES))

    def judge(self, folder: Path) -> None:
        """Ask at the end."""
        self._begin()
        for each in AT_THE_END:
            for text in each.check(End(self._look, folder)):
                self._violate(each, text.partition(":")[0], text)

    def _begin(self) -> Look:
        """Look anew: what was asked before does not count."""
        look = self._look
        look.now = look.world.now
        look.links.clear()
        look.tokens.clear()
        return look

    def _check(self) -> None:
        look = self._begin()
        seen = [*look.seen()]
        self.robot_s += LOOK_S * len(seen)
        for one in seen:
            self._count(one)
            for each in self._of_robots:
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
            if seen.held or not seen.governed:
                look.held_s[seen.name] = look.held_s.get(seen.name, 0.0) + LOOK_S

    def _use(self, rules: list[Rule], name: str, process: Process) -> None:
        look = self._begin()
        for each in rules:
            if text := each.check(look, name, process):
                self._violate(each, name, f"{name}: {text}")

    def _violate(self, broken: Rule, who: str, text: str) -> None:
        if (broken.name, who) not in self._known:
            self._known.add((broken.name, who))
            self.violations.append((broken.name, self._look.now, text))
