"""A run in a process of its own, for those that watch runs: `python -m tools.reliability.run_process FILE FOLDER`.

Each event of the conductor is a line of JSON on standard output. Standard input is the lifeline: when it is lost,
everybody lands.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, Self

from agents.network import lab, messages
from agents.network import session as network
from agents.network.endpoints import EndpointError
from agents.runtime.command_line import told_to_end
from agents.runtime.lifeline import Lifeline
from experiments.definition.bodies import BODIES
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.real_time.conductor.conduct import RunOptions, conduct
from experiments.real_time.conductor.conductor import RunFailed
from experiments.real_time.conductor.run_view import Emergency, News, Progress
from experiments.real_time.conductor.support import StandInError
from experiments.real_time.hosts.hosts import HostError
from experiments.real_time.hosts.launcher import Launcher, Process
from tools.reliability import processes, spoilt_process
from tools.reliability.processes import ROBOT


class Cabled(Launcher):
    """Starts robots that find their routers at the ends of cables of their own, and processes that can be spoiled."""

    def __init__(self, cables: Mapping[str, Mapping[str, str]], switches: Path | None, logs: Path) -> None:
        """`cables` has, for each process of robots, the endpoint to use instead of each router's.

        `switches` is for `tools.reliability.spoilt_process`; None: processes are as they are.
        """
        super().__init__(logs)
        self._cables, self._switches = cables, switches

    def start(self, name: str, module: str, *arguments: str) -> Process:
        """See `Launcher.start`."""
        own = next((ends for process, ends in self._cables.items() if name.endswith(f"-{process}")), {})
        if module == ROBOT:
            arguments = tuple(own.get(word, word) for word in arguments)
        if self._switches is not None:
            module, arguments = spoilt_process.MODULE, (str(self._switches), module, *arguments)
        return super().start(name, module, *arguments)


class Told:
    """Prints each event once."""

    def __init__(self) -> None:
        self._news = News()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, progress: Progress) -> None:
        """Prints what is new."""
        if events := self._news.of(progress):
            sys.stdout.buffer.write(b"".join(messages.encode(event) + b"\n" for event in events))
            sys.stdout.buffer.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    parser = argparse.ArgumentParser(prog="zenpark unattended", description="Runs an experiment in real time.")
    parser.add_argument("file", help="experiment file, or a name of the catalogue")
    parser.add_argument("folder", type=Path, help="where recordings and logs go; it exists")
    parser.add_argument("--case", action="append", default=[], metavar="NAME", help="only this case")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", dest="changes")
    parser.add_argument("--bodies", choices=BODIES, help="what every robot is put into")
    parser.add_argument("--cables", type=Path, help="JSON: for each process of robots, where it finds each router")
    parser.add_argument(
        "--switches", type=Path, help="folder, with which `tools.reliability.spoilt_process` spoils processes"
    )
    chosen = parser.parse_args(arguments)
    cables: dict[str, dict[str, str]] = json.loads(chosen.cables.read_text("utf-8")) if chosen.cables else {}
    over = threading.Event()
    Lifeline(over).start()
    try:
        read = load(chosen.file, *chosen.changes)
        with told_to_end(over.set):
            conduct(
                read,
                chosen.folder,
                RunOptions(cases=chosen.case, bodies=chosen.bodies, here=True),
                show=Told(),
                interrupted=over.is_set,
                emergency=Emergency(),
                launching=partial(Cabled, cables, chosen.switches),
            )
    except (
        DocumentError,
        HostError,
        RunFailed,
        StandInError,
        lab.LabError,
        EndpointError,
        network.Unreachable,
    ) as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())


NAME: Final = "conductor"
END_S: Final = 45.0  # landing, recording and router of an interrupted run


class Watched:
    """One such run.

    Attributes:
        run: The tag of all its processes.
        process: Of the conductor.
    """

    def __init__(
        self,
        launcher: Launcher,
        file: Path,
        folder: Path,
        *,
        cases: Sequence[str] = (),
        changes: Sequence[str] = (),
        bodies: str | None = None,
        cables: Path | None = None,
        switches: Path | None = None,
    ) -> None:
        """Starts it.

        Args:
            launcher: Holds its lifeline.
            file: The experiment.
            folder: Where its recordings and logs go; it exists.
            cases: Of the file; all if none is named.
            changes: As behind `--set`.
            bodies: As behind `--bodies`.
            cables: Where robots find their routers (`tools.reliability.run_process`).
            switches: With which its processes can be spoiled (`tools.reliability.spoilt_process`).
        """
        self._launcher = launcher
        self.run = secrets.token_hex(8)
        spoilt = [] if switches is None else [spoilt_process.MODULE, str(switches)]
        words = [sys.executable, "-m", *spoilt, "tools.reliability.run_process", str(file), str(folder)]
        words += [part for case in cases for part in ("--case", case)]
        words += [part for change in changes for part in ("--set", change)]
        words += ["--bodies", bodies] if bodies is not None else []
        words += ["--cables", str(cables)] if cables is not None else []
        words += ["--switches", str(switches)] if switches is not None else []
        variables = [f"{name}={value}" for name, value in processes.tag(self.run).items()]
        self.process: Process = launcher.spawn(NAME, ["env", *variables, *words])
        self.said: list[str] = []

    def news(self) -> Iterator[messages.Event]:
        """Events since the last call; other lines are kept in `said`."""
        for line in self.process.news():
            try:
                yield messages.decode(line.encode(), messages.JSON, messages.Event)
            except messages.Malformed:
                self.said.append(line)

    def processes(self) -> dict[int, str]:
        """All of it that runs now, and what each is."""
        return processes.of_run(self.run)

    def close(self) -> None:
        """Asks it to end, as the death of whoever holds the lifeline does, and does not wait."""
        assert self.process.handle.stdin is not None
        self.process.handle.stdin.close()

    def end(self) -> None:
        """Robots land, and everything ends."""
        self._launcher.end([NAME], grace_s=END_S)
