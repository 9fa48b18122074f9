"""A run in a process of its own, for those that watch runs: `python -m experiments.unattended FILE FOLDER`.

Each event of the conductor is a line of JSON on standard output. Standard input is the lifeline: when it is lost,
everybody lands.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Self

from agents import lab, wire
from agents import session as network
from agents.endpoint import EndpointError
from agents.lifeline import Lifeline
from agents.process import told_to_end
from experiments import faulty
from experiments.conductor import RunFailed
from experiments.emergency import Emergency
from experiments.hosts import HostError
from experiments.launcher import Launcher, Process
from experiments.problem import DocumentError
from experiments.processes import ROBOT
from experiments.realtime import Staging, conduct
from experiments.run import load
from experiments.seen import News, Progress
from experiments.standins import BODIES, StandInError


class Cabled(Launcher):
    """Starts robots that find their routers at the ends of cables of their own, and processes that can be spoiled."""

    def __init__(self, cables: Mapping[str, Mapping[str, str]], switches: Path | None, logs: Path) -> None:
        """`cables` has, for each process of robots, the endpoint to use instead of each router's.

        `switches` is for `experiments.faulty`; None: processes are as they are.
        """
        super().__init__(logs)
        self._cables, self._switches = cables, switches

    def start(self, name: str, module: str, *arguments: str) -> Process:
        """See `Launcher.start`."""
        own = next((ends for process, ends in self._cables.items() if name.endswith(f"-{process}")), {})
        if module == ROBOT:
            arguments = tuple(own.get(word, word) for word in arguments)
        if self._switches is not None:
            module, arguments = faulty.MODULE, (str(self._switches), module, *arguments)
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
            sys.stdout.buffer.write(b"".join(wire.encode(event) + b"\n" for event in events))
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
    parser.add_argument("--switches", type=Path, help="folder, with which `experiments.faulty` spoils processes")
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
                Staging(cases=chosen.case, bodies=chosen.bodies, here=True),
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
