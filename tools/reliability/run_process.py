"""A run whose processes can be spoiled, in a process of its own: `python -m tools.reliability.run_process REQUEST`.

The request is a struct as JSON. Standard input is the lifeline: when it is lost, all robots land.
"""

from __future__ import annotations

import sys
import threading
from functools import partial
from pathlib import Path

import msgspec

from agents.errors import ExplainedError
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import Lifeline
from experiments.file.document import load
from experiments.real_time.conductor.conduct import RunOptions, Supervision, conduct
from experiments.real_time.hosts.launcher import Launcher, Process
from tools.progress import Lines
from tools.reliability import spoilt_process


class Request(msgspec.Struct):
    """A run in real time on this machine, its bodies in one world."""

    file: str  # experiment file
    folder: str  # for recordings and logs; it exists
    case: str
    changes: list[str]  # as behind `--set`
    cables: dict[str, dict[str, str]]  # for each process of robots, by its role, an endpoint in place of each router's
    switches: str  # folder, with which `tools.reliability.spoilt_process` spoils processes


class SpoiltLauncher(Launcher):
    """Starts processes that can be spoiled, and whose robots find their routers at the ends of cables of their own."""

    def __init__(self, request: Request, logs: Path) -> None:
        super().__init__(logs)
        self._request = request

    def start(self, name: str, module: str, *arguments: str) -> Process:
        own = self._request.cables.get(spoilt_process.role_of([module, *arguments]), {})
        words = (own.get(word, word) for word in arguments)
        return super().start(name, spoilt_process.MODULE, self._request.switches, module, *words)


def main() -> int:
    """Run the request of the command line."""
    request = msgspec.json.decode(sys.argv[1], type=Request)
    over = threading.Event()
    Lifeline(over).start()
    user = Supervision(Lines(), over.is_set, launching=partial(SpoiltLauncher, request))
    try:
        with on_termination(over.set):
            options = RunOptions([request.case], "world", here=True)
            conduct(load(request.file, *request.changes), Path(request.folder), options, user)
    except ExplainedError as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
