"""Which process of a case has which robots, on which machine, and who needs not be started from here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from experiments import hosts as machines
from experiments.document import read
from experiments.experiment import Experiment
from experiments.hosts import Hosts
from experiments.launcher import Launcher, Process


class Crew:
    """The robots of one case.

    Attributes:
        groups: Robots by the process that they share, or that is theirs alone.
        adopted: Robots that somebody else has started, or will.
        away: Robots that are started on a host without address, and that host.
    """

    def __init__(self, experiment: Experiment, case: str, launcher: Launcher, hosts: Hosts) -> None:
        """Nobody is started yet."""
        self._experiment, self._case, self._launcher, self._hosts = experiment, case, launcher, hosts
        self.groups: dict[str, list[str]] = {}
        for name, robot in experiment.robots.items():
            self.groups.setdefault(robot.process or name, []).append(name)
        self.adopted: set[str] = set()
        self.away = machines.absent(experiment)
        self._abroad: dict[str, Process] = {}  # by host and group

    @property
    def processes(self) -> list[str]:
        """The names of all processes."""
        return [self.process(group) for group in self.groups]

    def process(self, group: str) -> str:
        """What the process of a group is called."""
        return f"{self._case}-{group}"

    def of(self, process: str) -> list[str]:
        """The robots of a process."""
        return self.groups.get(process.removeprefix(f"{self._case}-"), [])

    def process_of(self, robot: str) -> str:
        """What the process of a robot is called."""
        return next(self.process(group) for group, members in self.groups.items() if robot in members)

    def adopt(self, there: Iterable[str]) -> list[str]:
        """Robots that are `there` are nobody's to start, nor are those of hosts without address; returns them all."""
        self.adopted = {*there, *self.away}
        return sorted(self.adopted)

    def start(self, file: Path, connect: Sequence[str]) -> None:
        """Starts everybody else.

        Args:
            file: The case, with the addresses of what stands in for hardware.
            connect: `--connect` and the endpoints of this machine.
        """
        document = machines.document(read(file).experiment) if self._experiment.hosts else b""
        for group, names in self.groups.items():
            missing = [name for name in names if name not in self.adopted]
            station = self._hosts.of(names[0])
            process = self.process(group)
            if station is not None and missing:
                self._abroad[f"{station.name}/{group}"] = station.start(process, missing, document, self._launcher)
            elif missing:
                self._launcher.start(process, "experiments.robot", str(file), *missing, *connect, "--lifeline")

    def output(self) -> Iterator[tuple[str, str]]:
        """What processes on other machines have printed since the last call: where, and the line."""
        for place, process in self._abroad.items():
            for line in process.news():
                yield place, line
