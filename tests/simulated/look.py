"""Looks at a laboratory, simulated or real, and the tables of rules that are asked about it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Set
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from agents.body.kinds import Kind
from agents.robot import Robot
from agents.runtime.loop import Runtime
from agents.safety.hazards import Outcome
from experiments.metrics.measure import HOLDING
from tests.simulated.kernel import BUSY_S, EPOCH, Process
from tests.simulated.world import World

QUIET_S = 4.0  # time after a disturbance, until all know all again


@dataclass
class Seen:
    """Robot at a look: its newest process, which is neither dead nor suspended and has joined."""

    name: str
    process: Process
    kind: Kind
    before: int  # phase at the last look
    phase: int
    hazard: str  # the worst one
    held: bool  # True if it stands for a reason that is not part of its experiment
    governed: bool  # True if its loop decides for the body: it owns the name, and no watchdog has taken over
    reason: str  # of its phase
    start: float  # common start, as it knows it [s]; infinity before
    motion: Any  # true motion, with `position` and `flying`; None: simulated by no process
    inside: Runtime = field(default=None)  # None: only what it tells is known
    row: int = 0

    @property
    def robot(self) -> Robot:
        return self.inside.robots[self.row]

    @property
    def prompt(self) -> bool:
        return self.process.late <= BUSY_S

    @property
    def flying(self) -> bool:
        return self.kind.flies and self.motion is not None and self.motion.flying


@dataclass
class Look:
    """The laboratory now, with what former looks have found.

    Attributes:
        slack_s: Added to the limits of rules, on a machine that is busy with other work [s].
        now: Time of the look, the simulator's [s].
    """

    world: World
    slack_s: float = 0.0
    now: float = 0.0
    since: dict[Hashable, float] = field(default_factory=dict)  # begin of lasting conditions
    sent: dict[tuple[int, str], int] = field(default_factory=dict)  # poses, by process and robot
    phases: dict[tuple[int, str], int] = field(default_factory=dict)
    links: dict[tuple[Process | None, bool], bool] = field(default_factory=dict)  # answers of `linked` at this look
    tokens: dict[str, list[Process]] = field(default_factory=dict)  # who has declared them, at this look
    ran_s: dict[str, float] = field(default_factory=dict)  # time in the experiment, by robot
    held_s: dict[str, float] = field(default_factory=dict)  # time for which it stood then

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
        return lasted if lasted > limit_s + self.slack_s else 0.0

    def seen(self) -> Iterator[Seen]:
        plan = self.world.plan
        if plan is None:
            return
        kinds = dict(zip(plan.names, plan.kinds, strict=True))
        for name, process in self.world.robots.items():
            runtime = self.world.runtimes.get(process.pid)
            if runtime is None or process.dead or process.paused or not runtime._joined:
                self.forget(name)
                continue
            row = runtime._names.index(name)
            life, hazards = runtime.robots[row].lifecycle, runtime.robots[row].hazards
            present, level = hazards.present, hazards.level
            held = present != 0 and any(present >> each & 1 and level[each] == Outcome.HOLD for each in HOLDING)
            keeper = runtime.keeper
            governed = not (keeper.hands_off or keeper.ownership.contested or runtime.watchdog.tripped)
            yield Seen(
                name, process, kinds[name], self.before(name, process, life.phase), life.phase, hazards.worst(), held,
                governed, life.reason, runtime._utc + life.start_at - EPOCH, self.world.true.get(name), runtime, row,
            )  # fmt: skip

    def forget(self, name: str) -> None:
        """Forget what lasts of a robot that is not seen."""
        for key in [key for key in self.since if isinstance(key, tuple) and key[1] == name]:
            del self.since[key]

    def before(self, name: str, process: Process, phase: int) -> int:
        """Phase of a robot at the last look at this process, and note that of now."""
        before, self.phases[process.pid, name] = self.phases.get((process.pid, name), phase), phase
        return before

    def linked(self, process: Process | None, *, slowly: bool = False) -> bool:
        """Whether a process has a router that answers, over a cable that is not cut, nor slow unless that is enough."""
        if (found := self.links.get((process, slowly))) is None:
            found = self.links[process, slowly] = self._link(process, slowly=slowly)
        return found

    def owners(self, token: str) -> list[Process]:
        """Living processes that have declared a token, whether the run has started them or somebody by hand."""
        if not self.tokens:
            for process in self.world.processes:
                for each in self.world.tokens(process):
                    self.tokens.setdefault(each, []).append(process)
        return self.tokens.get(token, [])

    def _link(self, process: Process | None, *, slowly: bool) -> bool:
        if process is None or process.dead or process.paused:
            return False
        session = self.world.session(process)
        link = None if session is None else session.link
        if session is None or link is None or not link.open() or (session.slow >= 100 and not slowly):
            return False
        if link.out:
            return False
        return not link.far.process.paused or (slowly and link.arrives(session))  # what it sent before

    @cached_property
    def kinds(self) -> set[str]:
        """Kinds of the faults of the script."""
        return {fault.kind for fault in self.world.script}

    def spoiled(self, kinds: Set[str], *names: str) -> bool:
        """Whether the script has faults of these kinds, of these processes or of robots that share one with them."""
        if not self.kinds & kinds:
            return False
        assert self.world.plan is not None
        robots = self.world.plan.experiment.robots
        meant = [robots[name] for name in names if name in robots]
        shared = {robot.process for robot in meant} - {None}
        others = {name for name, robot in robots.items() if robot.process in shared}
        others |= {"world"} if any(robot.body == "world" for robot in meant) else set()
        hit = {
            fault.who.rstrip("23") if "router" in fault.who else fault.who
            for fault in self.world.script
            if fault.kind in kinds
        }
        return bool(hit & {*names, *others})

    @cached_property
    def bent(self) -> bool:
        """Whether the script changes clocks, or orders a start."""
        return bool(self.kinds & {"step", "drift"}) or any("start" in str(each.size) for each in self.world.script)


Check = Callable[..., Any]


@dataclass(frozen=True)
class Rule:
    name: str
    sentence: str  # text of `docs`; empty: no page has to promise that
    check: Check
    inside: bool  # True if it asks for what a process knows, and not only for what it tells


OF_ROBOTS: list[Rule] = []
OF_PAIRS: list[Rule] = []
OF_COMMANDS: list[Rule] = []
OF_POSES: list[Rule] = []
AT_THE_END: list[Rule] = []


def rule(table: list[Rule], sentence: str, *, inside: bool = False) -> Callable[[Check], Check]:
    def add(check: Check) -> Check:
        table.append(Rule(check.__name__.replace("_", "-"), sentence, check, inside))
        return check

    return add
