"""A run in a process of its own (`experiments.unattended`) and how somebody beside it follows and ends it."""

from __future__ import annotations

import secrets
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from agents import wire
from experiments import faulty, processes
from experiments.launcher import Launcher, Process

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
            cables: Where robots find their routers (`experiments.unattended`).
            switches: With which its processes can be spoiled (`experiments.faulty`).
        """
        self._launcher = launcher
        self.run = secrets.token_hex(8)
        spoilt = [] if switches is None else [faulty.MODULE, str(switches)]
        words = [sys.executable, "-m", *spoilt, "experiments.unattended", str(file), str(folder)]
        words += [part for case in cases for part in ("--case", case)]
        words += [part for change in changes for part in ("--set", change)]
        words += ["--bodies", bodies] if bodies is not None else []
        words += ["--cables", str(cables)] if cables is not None else []
        words += ["--switches", str(switches)] if switches is not None else []
        variables = [f"{name}={value}" for name, value in processes.tag(self.run).items()]
        self.process: Process = launcher.spawn(NAME, ["env", *variables, *words])
        self.said: list[str] = []

    def news(self) -> Iterator[wire.Event]:
        """Events since the last call; other lines are kept in `said`."""
        for line in self.process.news():
            try:
                yield wire.decode(line.encode(), wire.JSON, wire.Event)
            except wire.Malformed:
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
