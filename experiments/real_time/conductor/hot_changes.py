"""Hot changes: robots are removed, restarted, added or replaced, by a spare or another body, while the run goes on.

The conductor answers orders on a key of its own. A change takes seconds: it is a generator that advances one step at a
time, so that the conductor never waits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec
import zenoh

from agents.body.kinds import KINDS
from agents.body.shadow_twin import TWIN
from agents.decision.lifecycle import PAUSED
from agents.errors import Refusal, did_you_mean
from agents.network import messages
from agents.network.keys import Keys
from agents.plugins import registry
from agents.runtime.orders import LAND, STOP
from experiments.definition.experiment import WORLD, RobotTable
from experiments.definition.plan import Plan
from experiments.real_time.conductor.case_processes import CaseProcesses
from experiments.real_time.conductor.run_view import NetworkView, RobotView
from experiments.real_time.hosts.launcher import travel_s
from experiments.scene.condition import SILENT_S

READY_S: Final = 5.0  # a robot starts later, and counts the deadline of the file from then
ROOM_S: Final = 20.0  # limit for the place of a robot to become free, where no operator waits for an answer
RESTARTS: Final = 3  # a robot that is lost more often is not helped by a restart
MAX_ORDERS: Final = 100  # orders at once
INSIST_S: Final = 5.0  # an order that a robot refuses is repeated for this long,
AGAIN_S: Final = 0.5  # period

MARGIN_M: Final = 0.1  # free space around a robot that begins to move
OF_BODY: Final = ("body", "start", "hover", "position", "device", "sensors", "ranges")  # fields of a spare

Steps = Generator[None, None, str]  # returns the result, in words


@dataclass
class _Asked:
    order: messages.RunOrder
    query: zenoh.Query | None = None
    done: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)


@dataclass
class _Change:
    """Change of robots of one process, and its order."""

    names: tuple[str, ...]
    steps: Steps
    asked: _Asked


class HotChanges:
    def __init__(self, plan: Plan, processes: CaseProcesses, view: NetworkView, keys: Keys) -> None:
        """Refuse everything until `begin`."""
        self._experiment = plan.experiment
        self._processes, self._view, self._keys = processes, view, keys
        self._robots = view.robots
        self._start: float | None = None
        self._changes: list[_Change] = []
        self._pending: list[_Asked] = []
        self._leaving: set[str] = set()
        self._ended: dict[str, str] = {}  # robots with a process that ended while they joined, and its end
        self._losses: dict[str, int] = {}
        self.stopped: dict[str, float] = {}  # robots that an operator stopped while they left, and when [s, UTC]
        self._spares = Spares(plan)

    @property
    def under_way(self) -> set[str]:
        return {name for change in self._changes for name in change.names}

    def begin(self, start: float) -> None:
        """Accept orders from now on; the common start is at `start` [s, UTC]."""
        self._start = start

    def close(self) -> None:
        """Accept no more orders and give up changes under way: all land. The end of a robot that leaves is no loss."""
        self._start, leaving = None, {*self._leaving}
        for change in self._changes:
            change.steps.close()
            self._answer(change, refused="the run is over")
        self._changes.clear()
        self._leaving = leaving
        self._reply_to_finished()

    def expects(self, name: str, how: str) -> bool:
        """Whether the end of a robot's process, or of its token, is part of a change: then it is no loss."""
        if name in self._leaving:
            return True
        if name in self.under_way:
            self._ended[name] = how
            return True
        return self._robots[name].gone

    def mark_lost(self, name: str) -> None:
        """Follow the file's policy for a robot that is lost."""
        self._robots[name].left_because = "lost"
        policy = self._experiment.on_loss
        names = self._processes.companions(name)
        view = self._robots
        if policy == "none" or self._start is None or not all(view[each].left_because == "lost" for each in names):
            return
        if calmed := self._calmed_by_operator(name):
            self._view.report("given up", name, f"{calmed}: `./zenpark robot restart {name}` when the arena is free")
            return
        self._losses[name] = self._losses.get(name, 0) + 1
        if self._losses[name] > RESTARTS:
            self._view.report("given up", name, f"lost {self._losses[name]} times")
            return
        self._begin(_Asked(messages.RunOrder(policy, names, operator="on_loss")))

    def _calmed_by_operator(self, name: str) -> str:
        """Robot that an operator holds, or has landed or stopped if it is this one, in words; empty: none.

        Such an operator may be among the robots, of which none takes off by itself then.
        """
        for other, view in self._robots.items():
            reason = "" if view.status is None else view.status.reason
            if reason.startswith(PAUSED) or (other == name and reason.startswith((LAND, STOP))):
                return f"{other} was {reason}"
        return ""

    def advance(self) -> None:
        """Take new orders, continue the changes under way, and answer those that are done."""
        for query, order in self._view.orders.read():
            self._accept(query, order)
        for change in list(self._changes):
            try:
                next(change.steps)
            except StopIteration as end:
                self._answer(change, done=str(end.value))
            except (Refusal, OSError) as refusal:  # OSError: a full disk, where a process would have begun
                self._answer(change, refused=str(refusal))
            else:
                continue
            self._changes.remove(change)
        self._reply_to_finished()

    def _accept(self, query: zenoh.Query, order: messages.RunOrder) -> None:
        if refusal := next(self._refusals(order), None):
            self._reply(query, messages.RunReply(reason=refusal))
        else:
            self._begin(_Asked(order, query))

    def _refusals(self, order: messages.RunOrder) -> Iterator[str]:
        """Reasons to refuse the whole order."""
        known = self._robots
        if (stranger := next((name for name in order.robots if name not in known), None)) is not None:
            yield f"no robot '{stranger[:50]}' in this run; {did_you_mean(stranger[:50], known)}"
        if not order.robots:
            yield f"name one or more of {', '.join(known)}"
        if self._start is None:
            yield (
                "robots can be changed between the common start and the landing, and this run is not there: "
                "ask again after it has begun"
            )
        if len(self._pending) >= MAX_ORDERS:
            yield f"{MAX_ORDERS} orders are under way; wait for them"
        others = (order.spare, order.body, order.at)
        if order.order != "replace" and any(other is not None for other in others):
            yield f"`with`, `body` and `at` belong to replace, not to {order.order}"
        if order.order == "replace" and len(order.robots) > 1 and any(other is not None for other in others):
            yield "replace one robot at a time, or leave it to the spares of the file"

    def _begin(self, asked: _Asked) -> None:
        """Begin one change for all named robots of each process."""
        left = list(dict.fromkeys(asked.order.robots))
        if asked.query is not None:
            self._pending.append(asked)
        who = asked.order.operator[:50]
        operator = who if who and who.isprintable() else "an operator"
        while left:
            names = tuple(name for name in left if name in self._processes.companions(left[0]))
            left = [name for name in left if name not in names]
            for name in names:
                self._view.report(asked.order.order, name, f"asked by {operator}")
            steps = {"remove": self._remove, "replace": self._replace}.get(asked.order.order, self._admit)
            change = _Change(names, steps(names, asked.order), asked)
            if busy := sorted(self.under_way & {*names}):
                self._answer(change, refused=f"{', '.join(busy)}: is being changed already; wait for that")
            else:
                self._changes.append(change)

    def _answer(self, change: _Change, *, done: str = "", refused: str = "") -> None:
        for name in change.names:
            if change in self._changes:  # else it was refused, and another one is changing the robot
                self._leaving.discard(name)
                self._ended.pop(name, None)
            if refused:
                change.asked.refused[name] = refused
                self._view.report("refused", name, f"{change.asked.order.order}: {refused}")
            else:
                change.asked.done[name] = done
                self._view.report("changed", name, done)

    def _reply_to_finished(self) -> None:
        for asked in list(self._pending):
            if asked.done.keys() | asked.refused.keys() >= {*asked.order.robots} and asked.query is not None:
                self._pending.remove(asked)
                self._reply(asked.query, messages.RunReply(asked.done, asked.refused))

    def _reply(self, query: zenoh.Query, reply: messages.RunReply) -> None:
        with query:
            query.reply(self._keys.run_order, messages.encode(reply), encoding=messages.JSON)

    def _remove(self, names: Sequence[str], _order: messages.RunOrder) -> Steps:
        yield from self._leave(names)
        return "removed: it is down, and the others go on"

    def _stopped(self, names: Sequence[str]) -> set[str]:
        """Robots that an operator has stopped."""
        statuses = [(name, self._robots[name].status) for name in names]
        return {name for name, status in statuses if status is not None and status.reason.startswith(STOP)}

    def _leave(self, names: Sequence[str], *, returns: bool = False) -> Generator[None]:
        """Robots land and leave the network; their process ends if no other robot needs it.

        A robot that `returns` does not do so if an operator stops it meanwhile.
        """
        processes, before = self._processes, self._stopped(names)
        present = [name for name in names if self._robots[name].alive or processes.runs(name)]
        together = processes.companions(names[0])
        staying = [other for other in together if other not in names and not self._robots[other].gone]
        kept = f"shares its process with {', '.join(staying)}: name them all" if staying else ""
        if any(name in processes.adopted for name in present):
            kept = "was not started from here: end its process where it runs"
        self._leaving |= {*present}
        for name, reply in self._view.order(present, messages.Order("leave")).items():
            if not reply.ok and kept:
                raise Refusal(f"{name} does not answer, and {kept}")
            if not reply.ok:
                self._view.report("silent", name, f"does not answer ({reply.reason}): its lifeline is cut")
                processes.release(name)
        began, killed = time.monotonic(), False
        land_s = processes.land_s
        while still := [name for name in present if self._robots[name].alive or (processes.runs(name) and not staying)]:
            past = time.monotonic() - began
            if past > land_s and kept:
                raise Refusal(f"{', '.join(still)}: ordered to land, but still there after {land_s:g} s; it {kept}")
            if not (killed or kept) and (past > land_s or (past > SILENT_S and all(map(self._frozen, still)))):
                killed = True
                for name in still:
                    self._view.report("killed", name, f"still there after {past:.0f} s")
                    processes.kill(name)
            if past > land_s + SILENT_S:
                raise Refusal(f"{', '.join(still)}: cannot be ended")
            yield
        for name in present:
            self._view.report("left", name, "it is down, and has left the run")
        stopped = sorted(self._stopped(names) - before)
        self.stopped |= dict.fromkeys(stopped, self._view.clock.utc())
        for name in names:
            self._robots[name].left_because = "removed"
            self._robots[name].forget_process()
        self._leaving -= {*names}  # the next end of a process is that of another one
        if returns and stopped:
            raise Refusal(f"{', '.join(stopped)} was ordered to stop meanwhile: restart it when the arena is free")

    def _frozen(self, name: str) -> bool:
        view = self._robots[name]
        return view.status is None or view.silent(self._view.clock.utc())

    def _admit(self, names: Sequence[str], order: messages.RunOrder) -> Steps:
        """Restart, or add: robots that were started by hand only get orders to join, all others are started."""
        robots, processes = self._robots, self._processes
        asked = time.monotonic()
        by_hand = all(robots[name].alive and not processes.runs(name) for name in names)
        if order.order == "add" and any(robots[name].reached("airborne") and not robots[name].gone for name in names):
            raise Refusal("takes part already; `./zenpark robot restart` restarts it")
        if by_hand and not any(robots[name].reached("airborne") for name in names):
            processes.adopted |= {*names}
            yield from self._join(names)
            return f"takes part after {time.monotonic() - asked:.1f} s"
        if foreign := [name for name in names if name in processes.adopted or name in processes.away]:
            raise Refusal(
                f"{', '.join(foreign)} was not started from here: end its process and start it again where it runs, "
                f"then `./zenpark robot add {' '.join(foreign)}`"
            )
        together = processes.companions(names[0])
        if others := [name for name in together if name not in names]:
            raise Refusal(
                f"{', '.join(names)} shares a process with {', '.join(others)}: name them all, "
                f"`./zenpark robot restart {' '.join(together)}`"
            )
        places = {name: processes.place(name) for name in names if processes.robot(name).body == TWIN}
        yield from self._room(places, ROOM_S if order.operator == "on_loss" else 0.0)
        yield from self._leave(names, returns=True)
        processes.start_again(names)
        yield from self._join(names)
        return f"takes part again after {time.monotonic() - asked:.1f} s"

    def _replace(self, names: Sequence[str], order: messages.RunOrder) -> Steps:
        asked = time.monotonic()
        name = names[0]
        if len(self._processes.companions(name)) > 1:
            raise Refusal(f"{name} shares its process with others: restart them together instead")
        next_one, spare = self._spares.successor(name, self._processes.robot(name), order)
        if next_one.body == TWIN:
            places = {name: self._processes.place(name, next_one)}
            yield from self._room(places, ROOM_S if order.operator == "on_loss" else 0.0, body_stays=True)
        yield from self._leave(names, returns=True)
        self._processes.start_again(names, {name: next_one})
        if spare is not None:
            self._spares.used[spare] = name
        yield from self._join(names)
        return f"{spare or next_one.body} has its name and takes part after {time.monotonic() - asked:.1f} s"

    def _join(self, names: Sequence[str]) -> Generator[None]:
        """Let robots with a new process join the run: ready, airborne, running."""
        robots = self._robots
        for name in names:
            robots[name].left_because = ""
        try:
            yield from self._reach(names, "ready", self._experiment.start.deadline_s + READY_S)
            yield from self._room({name: robots[name].place or self._processes.place(name) for name in names}, ROOM_S)
            for name in names:
                order = messages.Order("takeoff", at=self._start, origin=robots[name].origin)
                yield from self._repeat_order(name, order)
            highest = max(self._processes.robot(name).hover or 0.0 for name in names)
            yield from self._reach(names, "airborne", travel_s(highest))
            for name in names:
                order = messages.Order("start", at=self._start, origin=robots[name].origin)
                yield from self._repeat_order(name, order)
            yield from self._reach(names, "running", SILENT_S)
        except Refusal:
            self._leaving |= {*names}
            self._view.order(names, messages.Order("leave"))
            for name in names:
                self._processes.release(name)
                robots[name].left_because = "removed"
            raise

    def _repeat_order(self, name: str, order: messages.Order) -> Generator[None]:
        """Repeat an order until it is accepted: a robot may not be ready yet, and a busy machine lose an answer."""
        began = time.monotonic()
        while not (reply := self._view.order([name], order)[name]).ok:
            asked = time.monotonic()
            if asked - began > INSIST_S:
                raise Refusal(f"{name}, {order.order}: {reply.reason}")
            while time.monotonic() - asked < AGAIN_S:
                yield

    def _reach(self, names: Sequence[str], phase: str, limit_s: float) -> Generator[None]:
        began = time.monotonic()
        while late := [name for name in names if not self._robots[name].reached(phase)]:
            if ended := next((name for name in names if name in self._ended), None):
                raise Refusal(f"{ended}: {self._ended[ended]}")
            if time.monotonic() - began > limit_s:
                status = self._robots[late[0]].status
                why = "no status of its process" if status is None else status.reason or f"it is {status.phase}"
                raise Refusal(f"{', '.join(late)}: not {phase} after {limit_s:g} s: {why}")
            yield

    def _room(
        self, places: Mapping[str, Sequence[float]], patience_s: float, *, body_stays: bool = False
    ) -> Generator[None]:
        """Wait for at most `patience_s` [s] until the `places`, x, y [m], where robots begin are free.

        `body_stays` as of `in_the_way`.
        """
        began = time.monotonic()
        while True:
            robots = {name: self._processes.robot(name) for name in self._robots}
            found = [in_the_way(*each, robots, self._robots, body_stays=body_stays) for each in places.items()]
            if not any(found):
                return
            if time.monotonic() - began >= patience_s:
                raise Refusal(next(filter(None, found)))
            yield


class Spares:
    used: dict[str, str]  # names that they have taken over, by spare

    def __init__(self, plan: Plan) -> None:
        self._spares, self._arena = plan.experiment.spares, plan.experiment.arena
        self.used = {}

    def successor(self, name: str, robot: RobotTable, order: messages.RunOrder) -> tuple[RobotTable, str | None]:
        """The robot with the name `name` from now on, and the name of the spare, if it is one."""
        spare = order.spare
        if spare is None and order.body is None:
            fits = (each for each, other in self._spares.items() if other.kind == robot.kind and each not in self.used)
            if (spare := next(fits, None)) is None:
                why = f"the file has no spare {robot.kind} left for {name}"
                raise Refusal(f"{why}: say which body takes over, --body URI, or add [spares.NAME]")
        if spare is not None and order.body is not None:
            raise Refusal("a spare has a body of its own: leave --body or --with out")
        made = self._of_spare(spare, name, robot) if spare is not None else self._of_body(order.body or "", robot)
        if WORLD in (robot.body, made.body) and robot.body != made.body:
            raise Refusal("a robot cannot go into the world, or out of it, in mid-run")
        if order.at is not None:
            made = self._put(made, order.at, order.yaw)
        return made, spare

    def _of_spare(self, spare: str, name: str, robot: RobotTable) -> RobotTable:
        spares = self._spares
        if spare not in spares:
            hint = did_you_mean(spare[:50], spares) if spares else "the file has none"
            raise Refusal(f"no spare '{spare[:50]}'; {hint}")
        if spare in self.used:
            raise Refusal(f"{spare} has taken over {self.used[spare]} already")
        if spares[spare].kind != robot.kind:
            raise Refusal(f"{spare} is a {spares[spare].kind} and cannot be {name}, a {robot.kind}")
        brought = {field: getattr(spares[spare], field) for field in OF_BODY}
        return msgspec.structs.replace(robot, **brought, process=None, shadow=None)

    @staticmethod
    def _of_body(body: str, robot: RobotTable) -> RobotTable:
        word, known = registry.body_name(body), registry.names(registry.BODIES)
        if word in registry.names(registry.DEVICES):
            raise Refusal(f"{word} needs a simulated device, which is started before the run only")
        if word not in known:
            raise Refusal(f"no {word[:50]!r} among the bodies; {did_you_mean(word[:50], known)}")
        device = robot.device if word == registry.body_name(robot.body) else {}
        return msgspec.structs.replace(robot, body=body, device=device, process=None, shadow=None)

    def _put(self, robot: RobotTable, at: tuple[float, float], yaw: float) -> RobotTable:
        if robot.body != TWIN:
            raise Refusal("only a twin can be put somewhere: put the robot there yourself, and leave --at out")
        half = [size / 2 for size in self._arena.size[:2]]
        if not math.isfinite(yaw) or not all(abs(x) <= limit for x, limit in zip(at, half, strict=True)):
            raise Refusal(f"--at lies outside of the arena, ±{half[0]:g} by ±{half[1]:g} m")
        return msgspec.structs.replace(robot, start=[*at, yaw])


def in_the_way(
    name: str,
    place: Sequence[float],
    robots: Mapping[str, RobotTable],
    views: Mapping[str, RobotView],
    *,
    body_stays: bool,
) -> str:
    """Refusal of `place`, x, y [m], for the robot `name` to begin there, whatever its height; empty if it is free.

    `body_stays`: the body that had this name lies in the way as any other.
    """
    radius = KINDS[robots[name].kind].radius
    for other, known in views.items():
        vanished = robots[other].body == TWIN and not known.alive  # it was a part of its process
        if known.place is None or vanished or (other == name and (known.alive or not body_stays)):
            continue
        gap = math.dist(known.place[:2], place[:2]) - radius - KINDS[robots[other].kind].radius
        if gap < MARGIN_M:
            x, y = place[:2]
            return (
                f"{name} would begin at ({x:.2f}, {y:.2f}) m, {max(gap, 0.0):.2f} m from {other}: it needs "
                f"{MARGIN_M:g} m around it; move one of them, or wait"
            )
    return ""
