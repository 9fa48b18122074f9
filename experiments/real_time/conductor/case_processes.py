"""Processes of one case: recorder, stand-ins for hardware, support processes, robots; restarts of routers.

Robots are started on the machines that the file names, or by others. All other processes run on the launcher's machine,
and its clock is that of the experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from agents.plugins import registry
from experiments.definition import bodies, standby
from experiments.definition.access_rights import has_world
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from experiments.file.document import case_document, write_json
from experiments.real_time.conductor.orders import Emergency
from experiments.real_time.hosts.hosts import STATION, Hosts
from experiments.real_time.hosts.launcher import ZYGOTE, Launcher, Process, is_router, make_routers
from experiments.recording.reader import PARTS, RecordingError, recover

ALONE_S: Final = 3.0  # limit for a robot that joins a run under way to wait for silent neighbours
LEAST_SIGMA: Final = 1e-5  # [m] noise of simulated motion capture: what repeats itself to the last bit is not believed
STARTS: Final = 4  # a process that dies more often is not helped by another start
HOLD: Final = ": robots hold meanwhile"


@dataclass(frozen=True)
class CaseContext:
    """Case of a run, the place of its files, and the means to run it."""

    plan: Plan  # overrides applied
    case: str  # its name, with which the names of its processes and files begin
    folder: Path  # place of the recording, and of the processes' output in logs/
    source: Path  # the experiment file as it was written, for the recording
    endpoints: Sequence[str]  # routers as this machine reaches them
    launcher: Launcher
    hosts: Hosts  # other machines, on which robots may be started; it has the endpoints at which our routers listen
    interrupted: Callable[[], bool] = lambda: False  # whether the user wants to end the run
    rights: Path | None = None  # access rights for a router that is started again, in a lab
    identity: str = "operator"  # identity of the conductor, in a lab
    emergency: Emergency = field(default_factory=Emergency)  # emergency stops, which end the run as well

    @property
    def file(self) -> Path:
        """The case as its processes read it."""
        return self.variant("experiment")

    def variant(self, word: str) -> Path:
        """File of a variant of the case, in a folder that no other file of the run can share, however it is called."""
        return self.folder / PARTS / self.case / f"{word}.json"

    @property
    def recording(self) -> Path:
        """The file of the recorder; a recorder that is started again writes another, see `CaseProcesses.join_parts`."""
        return self.folder / f"{self.case}.mcap"

    def ended(self) -> bool:
        """Whether the user or an emergency stop ends the run."""
        return bool(self.emergency) or self.interrupted()

    def process(self, role: str) -> str:
        return f"{self.case}-{role}"

    def start(self, role: str, module: str, *arguments: str) -> Process:
        """Start a process of this case on this machine, with a lifeline and the routers."""
        connect = [part for endpoint in self.endpoints for part in ("--connect", endpoint)]
        return self.launcher.start(self.process(role), module, *arguments, *connect, "--lifeline", forked=True)


@dataclass
class _Supervised:
    """Supervised process; texts for the robots' state meanwhile, and when it is given up."""

    start: Callable[[], object]
    meanwhile: str
    given_up: str
    starts: int = 1


@dataclass(frozen=True)
class Death:
    """Unexpected end of a process."""

    # "lost" (a robot's process), "host" (the connection to one), "device" (a protocol twin), "zygote", or the
    # role of a process that was started again
    kind: str
    source: str  # robot or host concerned, or "conductor"
    text: str


class CaseProcesses:
    """Starts, watches and ends the processes of one case, except its routers, which it only starts again."""

    def __init__(self, context: CaseContext) -> None:
        self._context = context
        self._launcher = context.launcher
        self._groups = context.plan.experiment.processes  # groups by process, without the case
        self._standins: list[str] = []  # processes of protocol twins, world and motion capture
        count = context.plan.experiment.network.routers
        self._supervised = {
            each.name: _Supervised(
                partial(each.start, context.launcher, context.rights, forked=True),
                ": all go on at another meanwhile" if count > 1 else "",
                ": no other takes its place" if count > 1 else ": the robots hold, and land at the end",
            )
            for each in make_routers(context.hosts.routers, count)
        }
        self.adopted: set[str] = set()  # robots that others have started, or will
        # hosts without address, by the robots that are started there
        self.away = standby.robots_without_address(context.plan)
        self._addressed, self._reached = context.file, context.plan
        self._joining = context.variant("joining")
        self._parts: list[Path] = []  # recordings of this case, one of each recorder
        self._abroad: dict[str, Process] = {}  # processes by host and group

    def prepare(self, *, recorder: bool = True) -> None:
        """Start all but router and robots: the recorder, if one is wanted, then what robots need.

        Raises StandInError if a protocol twin or a positioning system does not start in time.
        """
        context = self._context
        if recorder:
            missing = ": messages from between are missing in the recording"
            self._supervise(self._record, missing, ": the recording stops here")
        self._reached = self._start_support()
        if self._standins:
            self._addressed = context.variant("addressed")
            self._addressed.write_bytes(write_json(self._reached))

    def _supervise(self, start: Callable[[], Process], meanwhile: str = HOLD, given_up: str = "") -> Process:
        """Start a process of the case, and again when it dies; texts as of `_Supervised`."""
        process = start()
        self._supervised[process.name] = _Supervised(start, meanwhile, given_up)
        return process

    def _start_support(self) -> Plan:
        """Start what the robots of the case need; return the case with the addresses of its robots."""
        context, experiment = self._context, self._context.plan.experiment
        world: Process | None = None
        if has_world(context.plan):
            start = partial(context.start, "world", "experiments.real_time.processes.world", str(context.file))
            world = self._supervise(start)
        words = registry.names(registry.DEVICES)
        groups: dict[str, list[str]] = {}
        for name, robot in experiment.robots.items():
            if robot.body in words:
                groups.setdefault(robot.body, []).append(name)
        module = "experiments.real_time.processes.protocol_twins"
        processes = {word: context.start(word, module, str(context.file), *names) for word, names in groups.items()}
        addresses: dict[str, str] = {}
        for word, names in groups.items():
            addresses |= processes[word].await_lines(r"^address (\w+) (\S+)$", len(names), context.ended)
            self._standins.append(processes[word].name)
        if world is not None:
            world.await_lines(r"^(world) (ready)\b", 1, context.ended)
            self._standins.append(world.name)
        robots = experiment.robots
        twins = {name: msgspec.structs.replace(robots[name], body=address) for name, address in addresses.items()}
        addressed = context.plan.changed(robots={**robots, **twins})
        self._start_positioning(addressed)
        if context.plan.guided:
            centre = partial(context.start, "centre", "experiments.real_time.processes.centre", str(context.file))
            self._supervise(centre, given_up=": the robots that it guides hold, and land at the end")
        return addressed

    def _start_positioning(self, plan: Plan) -> None:
        """Start the motion capture of the case; its robots have addresses."""
        context, experiment, measured = self._context, plan.experiment, plan.externally_measured
        if experiment.positioning is None or not measured:
            return
        realm = ["--realm", experiment.network.realm]
        capture = experiment.capture
        assert capture is not None
        host = capture.address
        if registry.load(registry.POSITIONING, capture.system).FILE:  # it lies beside the experiment
            host = str(context.source.parent / host)
        bodies = [f"{name}={capture.names.get(name, name)}" for name in measured]
        coordinates = capture.options()
        if capture.simulated:
            asked = (plan.disturbance(name).position_sigma or 0.0 for name in measured)
            sigma = max(LEAST_SIGMA, *asked)
            noise = ["--sigma", str(sigma), "--seed", str(experiment.seed)]
            file = ["--file", host] if host else []
            arguments = [capture.system, *bodies, "--listen", "127.0.0.1:0", *noise, *coordinates, *file, *realm]
            twin = context.start(capture.scheme, "bridges.motion_capture.twin.capture", *arguments)
            self._standins.append(twin.name)
            host = twin.await_lines(rf"^{capture.system} (ready on) (.+)$", 1, context.ended)["ready on"]
        maps = [part for body in bodies for part in ("--map", body)]
        late = f"--latency-s={capture.latency_s}"
        words = [capture.system, host, *maps, *coordinates, late, *realm]
        bridge = partial(context.start, capture.system, "bridges.motion_capture.publisher", *words)
        hold = ": robots without a position hold, drones land"
        self._standins.append(self._supervise(bridge, hold, hold).name)

    def again(self, process: Process) -> tuple[str, str] | None:
        """Restart a process that has died; its role and the text of the event. None if it is not supervised."""
        supervised = self._supervised.get(process.name)
        if supervised is None:
            return None
        kind = process.name.removeprefix(self._context.process(""))
        more = supervised.starts < STARTS
        if more:
            supervised.starts += 1
            try:
                supervised.start()
            except OSError:  # a disk that takes no more: nothing of that ends the run
                more = False
        what = f"started again{supervised.meanwhile}" if more else f"given up{supervised.given_up}"
        return kind, f"the {kind} ended ({process.exit}); {what}{'' if is_router(process.name) else process.because}"

    def _record(self) -> Process:
        context = self._context
        first = not self._parts
        self._parts.append(context.recording if first else context.file.with_name(f"part{len(self._parts) + 1}.mcap"))
        module = "experiments.real_time.processes.recorder"
        files = str(context.file), str(self._parts[-1])
        return context.start("recorder", module, *files, "--name", context.case, "--source", str(context.source))

    @property
    def recording(self) -> bool:
        return self._launcher.running(self._context.process("recorder"))

    def kill_recorder(self) -> None:
        """Kill a recorder that stands still; it is started again."""
        self._launcher.kill(self._context.process("recorder"))

    def join_parts(self) -> str:
        """Join the files of all recorders of the case, which have ended; return why that failed, else an empty text.

        A recorder that was killed early may have left no file, or one without a record.
        """
        if len(self._parts) < 2:
            return ""
        first, *later = self._parts
        joined = first.with_suffix(".joined")
        try:
            if not recover(first, joined, later).complete:  # else nothing is written: the later parts are empty
                joined.replace(first)
            for part in later:
                part.unlink(missing_ok=True)
        except (RecordingError, OSError) as error:
            return f"the parts of the recording are not joined: {error}"
        return ""

    def adopt(self, robots: Iterable[str]) -> list[str]:
        """Adopt `robots` that are there, and those of hosts without address, which are not started; returns all."""
        self.adopted = {*robots, *self.away}
        return sorted(self.adopted)

    def start(self, only: Collection[str] | None = None, changed: Mapping[str, RobotTable] | None = None) -> None:
        """Start all robots that are neither adopted nor on standby, or `only` some of them, on their machines.

        `changed` are robots with other settings, this time only.
        """
        robots = self._context.plan.experiment.robots
        file, plan = self._addressed, self._reached
        if changed:
            plan = plan.changed(robots={**plan.experiment.robots, **changed})
            file = self._context.variant("changed")
            file.write_bytes(write_json(plan))
        for names in self._groups.values():
            wanted = names if only is None else [name for name in names if name in only]
            if missing := [name for name in wanted if not (name in self.adopted or robots[name].standby)]:
                self._start(missing, file, plan)

    def start_again(self, names: Sequence[str], bodies: Mapping[str, RobotTable] | None = None) -> None:
        """Start the process of the robots `names` while the run is under way.

        They are ready without silent neighbours, which may be out of the run as well. `bodies` are other robots, which
        have these names from now on.
        """
        reached = self._reached.experiment
        robots = {**reached.robots, **(bodies or {})}
        for name in bodies or {}:
            self._groups[self._group(name)].remove(name)
            self._groups[name] = [name]
        self._groups = {group: members for group, members in self._groups.items() if members}
        self._reached = self._reached.changed(robots=robots)
        begin = msgspec.structs.replace(reached.start, missing="go-on", deadline_s=ALONE_S)
        safety = msgspec.structs.replace(reached.safety, start_within=0.0)  # it begins where it came down
        joining = self._reached.changed(start=begin, safety=safety)
        fresh = self._joining.with_suffix(".new")  # a process that is just starting reads the one or the other
        fresh.write_bytes(write_json(joining))
        fresh.replace(self._joining)
        self.adopted -= {*names}
        self._start(names, self._joining, joining)

    def _start(self, names: Sequence[str], file: Path, plan: Plan) -> None:
        group = self._group(names[0])
        station = self._context.hosts.by_robot.get(names[0])
        if station is not None:
            case = case_document(plan)
            self._abroad[f"{station.name}/{group}"] = station.start(self._process(names[0]), names, case)
        else:
            process = self._context.start(group, "experiments.real_time.processes.robot", str(file), *names)
            process.robots = tuple(names)

    def robot(self, name: str) -> RobotTable:
        """The robot of a name now: it may be another one, at an address that the file does not know."""
        return self._reached.experiment.robots[name]

    def place(self, name: str, robot: RobotTable | None = None) -> tuple[float, float]:
        """Start of a robot: x, y [m], or of `robot` under its name."""
        reached = self._reached
        if robot is not None:
            reached = reached.changed(robots={**reached.experiment.robots, name: robot})
        positions, _ = bodies.scattered_poses(reached, [name], reached.experiment.seed)
        return positions[0][:2]

    @property
    def land_s(self) -> float:
        """Longest landing of a robot [s]."""
        return self._launcher.land_s

    def companions(self, name: str) -> list[str]:
        """Robots of the same process, itself included."""
        return list(self._groups[self._group(name)])

    def runs(self, name: str) -> bool:
        """Whether the process of a robot was started from here, and has not ended."""
        return self._launcher.running(self._process(name))

    def release(self, name: str) -> None:
        """Cut the lifeline of a robot's process: it lands by itself, and ends."""
        self._launcher.release(self._process(name))

    def kill(self, name: str) -> None:
        """Kill the process of a robot that ignores its lifeline."""
        self._launcher.kill(self._process(name))

    def end(self) -> str:
        """End all but the router: robots land first, and the recorder sees it; return why its file has no end."""
        self.end_robots()
        self._launcher.end([self._context.process("centre")], grace_s=2.0)  # its last report is recorded
        ended = self._launcher.end([self._context.process("recorder")], grace_s=5.0)
        self._launcher.end(self._standins, grace_s=2.0)
        # a batch is written topic by topic: poses of the end may be there without events and statuses
        missing = "messages of the end are missing in the recording"
        return "".join(
            f"the recorder ended ({each.exit}): {missing}{each.because}" for each in ended if each.exit != "exit code 0"
        )

    def end_robots(self) -> list[str]:
        """End the processes of all robots, which land first; return the robots with a process that had to be killed."""
        groups = {self._context.process(group): members for group, members in self._groups.items()}
        return [
            name
            for process in self._launcher.end(groups, grace_s=self._launcher.land_s)
            if process.killed
            for name in groups[process.name]
        ]

    def deaths(self) -> Iterator[Death]:
        """Processes that ended since the last call; recorder, router, world, centre and positioning restart,
        a few times."""
        for process in self._launcher.died():
            role = process.name.removeprefix(self._context.process(""))
            end, because = process.exit, process.because
            if (again := self.again(process)) is not None:
                yield Death(again[0], "conductor", again[1])
            elif process.name in self._standins:
                text = f"the {role} ended ({end}); robots that need it hold, or land{because}"
                yield Death("device", "conductor", text)
            elif process.name == ZYGOTE:
                text = f"the zygote ended ({end}); processes are started without it{because}"
                yield Death("zygote", "conductor", text)
            elif process.name.startswith(STATION):
                text = f"the connection to it ended ({end}); without a router robots hold{because}"
                yield Death("host", process.name.removeprefix(STATION), text)
            else:
                for name in self._groups.get(role, []):
                    yield Death("lost", name, f"its process ended ({end}){because}")

    def output(self) -> Iterator[tuple[str, str]]:
        """Lines that processes on other machines have printed since the last call, each with its place."""
        for place, process in self._abroad.items():
            for line in process.news():
                yield place, line

    def last_line(self, robot: str) -> str:
        """The last line that the process of a robot wrote; empty if it wrote none."""
        log = self._context.folder / "logs" / f"{self._process(robot)}.log"
        return "".join(log.read_text(errors="replace").strip().splitlines()[-1:]) if log.exists() else ""

    def _group(self, robot: str) -> str:
        return next(group for group, members in self._groups.items() if robot in members)

    def _process(self, robot: str) -> str:
        return self._context.process(self._group(robot))
