"""The context of one case in real time: what its conductor, its processes and their restarts share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from experiments.definition.plan import Plan
from experiments.real_time.conductor.orders import Emergency
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import Launcher, Process
from experiments.recording.reader import PARTS


@dataclass(frozen=True)
class CaseContext:
    """Case of a run, the place of its files, and the means to run it."""

    plan: Plan  # overrides applied
    case: str  # its name, with which the names of its processes and files begin
    folder: Path  # for the recording, and for the processes' output in logs/
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
