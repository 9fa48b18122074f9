"""Processes of one case: recorder, stand-ins for hardware, robots, routers.

Robots are started on the machines that the file names, or by others. All other processes run on the launcher's machine,
and its clock is that of the experiment.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from experiments.definition import bodies, standby
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import write_json
from experiments.real_time.conductor.case_context import CaseContext
from experiments.real_time.conductor.support import SupportProcesses
from experiments.real_time.hosts.hosts import STATION
from experiments.real_time.hosts.launcher import LAND_S, ZYGOTE, Process
from experiments.recording.reader import RecordingError, recover

ALONE_S: Final = 3.0  # limit for a robot that joins a run under way to wait for silent neighbours


@dataclass(frozen=True)
class Death:
    """Unexpected end of a process."""

    # "lost" (a robot's process), "host" (the connection to one), "device" (a protocol twin), "zygote", or the
    # role of a process that was started again
    kind: str
    source: str  # robot or host concerned, or "conductor"
    text: str


class CaseProcesses:
    """Starts, watches and ends the processes of one case."""

    def __init__(self, context: CaseContext) -> None:
        self._context = context
        self._launcher = context.launcher
        self._groups = context.plan.experiment.processes  # by process, without the case
        self._support = SupportProcesses(context)
        self.adopted: set[str] = set()  # robots that others have started, or will
        # hosts without address, by the robots that are started there
        self.away = standby.robots_without_address(context.plan)
        self._addressed, self._reached = context.file, context.plan
        self._joining = context.variant("joining")
        self._parts: list[Path] = []  # recordings of this case, one of each recorder
        self._abroad: dict[str, Process] = {}  # by host and group

    def prepare(self, *, recorder: bool = True) -> None:
        """Start all but router and robots: the recorder, if one is wanted, then what robots need."""
        context = self._context
        if recorder:
            missing = ": messages from between are missing in the recording"
            self._support.supervise(self._record, missing, ": the recording stops here")
        self._reached = self._support.start()
        if self._support.standins:
            self._addressed = context.variant("addressed")
            self._addressed.write_bytes(write_json(self._reached))

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
        """Join the files of all recorders of the case, which have ended; return why that failed, else an empty text."""
        if len(self._parts) < 2:
            return ""
        first, *later = self._parts
        joined = first.with_suffix(".joined")
        try:
            recover(first, joined, later)
            joined.replace(first)
            for part in later:
                part.unlink(missing_ok=True)
        except (RecordingError, OSError) as error:
            return f"the parts of the recording are not joined: {error}"
        return ""

    def adopt(self, there: Iterable[str]) -> list[str]:
        """Adopt robots that are `there`, and those of hosts without address, which are not started; returns all."""
        self.adopted = {*there, *self.away}
        return sorted(self.adopted)

    def start(self, only: Collection[str] | None = None, changed: Mapping[str, RobotTable] | None = None) -> None:
        """Start all robots that are neither adopted nor on standby, or `only` some of them, on their machines.

        `changed` are robots with other settings, this time only.
        """
        robots, file, plan = self._context.plan.experiment.robots, self._addressed, self._reached
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
            case = document.case_document(plan)
            self._abroad[f"{station.name}/{group}"] = station.start(self._process(names[0]), names, case)
        else:
            self._context.start(group, "experiments.real_time.processes.robot", str(file), *names)

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

    def end(self) -> None:
        """End all but the router: robots land first, and the recorder sees it."""
        self.end_robots()
        self._launcher.end([self._context.process("centre")], grace_s=2.0)  # its last report is recorded
        self._launcher.end([self._context.process("recorder")], grace_s=5.0)
        self._launcher.end(self._support.standins, grace_s=2.0)

    def end_robots(self) -> list[str]:
        """End the processes of all robots, which land first; return the robots with a process that had to be killed."""
        groups = {self._context.process(group): members for group, members in self._groups.items()}
        return [name for process in self._launcher.end(groups, grace_s=LAND_S) for name in groups[process.name]]

    def deaths(self) -> Iterator[Death]:
        """Processes that ended since the last call; recorder, router, world, centre and positioning restart,
        a few times."""
        for process in self._launcher.died():
            role, end, because = process.name.removeprefix(self._context.process("")), process.exit, process.because
            if (again := self._support.again(process)) is not None:
                yield Death(again[0], "conductor", again[1])
            elif process.name in self._support.standins:
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
