"""A robot's process for `./zenpark bench safety`: `python -m tools.bench.reactions_robot STAMPS FILE NAME ...`.

The usual robot process with the usual twin; the moment of the twin's motors-off is written down by the monotonic clock
of the machine.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence

from agents.arrays import Index
from agents.network.shutdown import end
from experiments.real_time.processes import robot
from twins.body import TwinBody


def main(arguments: Sequence[str]) -> int:
    """Appends a line "NAME SECONDS" to the file `STAMPS` at each motors-off; the rest is for
    `experiments.real_time.processes.robot`.
    """
    stamps, *rest = arguments
    name = rest[1]
    file = os.open(stamps, os.O_WRONLY | os.O_APPEND)
    cut = TwinBody.stop

    def stop(body: TwinBody, rows: Index) -> None:
        cut(body, rows)
        os.write(file, f"{name} {time.monotonic()}\n".encode())

    TwinBody.stop = stop  # type: ignore[method-assign, assignment]
    return robot.main(rest)


if __name__ == "__main__":
    end(main(sys.argv[1:]))
