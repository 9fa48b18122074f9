"""Processes of a run on this machine, by a tag in their environment: who they are, and what they take."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from experiments.real_time.hosts.launcher import RUN

PAGE: Final = resource.getpagesize()
TICKS: Final = os.sysconf("SC_CLK_TCK")
PROC: Final = Path("/proc")
ROLES: Final = {  # by the module that a process runs
    "agents.runtime.router": "router",
    "experiments.real_time.processes.recorder": "recorder",
    "experiments.real_time.processes.world": "world",
    "experiments.real_time.processes.centre": "centre",
    "tools.reliability.run_process": "conductor",
    "bridges.vicon.publisher": "positioning",
}
ROBOT: Final = "experiments.real_time.processes.robot"
OTHER: Final = "other"


@dataclass(frozen=True)
class Usage:
    """What a process takes now.

    Attributes:
        rss_mb: Resident memory [MB].
        threads: How many.
        files: Open file descriptors.
        cpu_s: CPU time since it began [s].
    """

    rss_mb: float
    threads: int
    files: int
    cpu_s: float


def tag(run: str) -> dict[str, str]:
    """What to add to the environment of a run, so that its processes are found."""
    return {RUN: run}


def of_run(run: str) -> dict[int, str]:
    """Processes of a run that still run, and what each of them is; zombies are gone."""
    mark, found = f"{RUN}={run}".encode(), {}
    for folder in PROC.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # another user's, or gone meanwhile
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
                found[int(folder.name)] = role(words)
    return found


def role(words: Sequence[str]) -> str:
    """What a process of a run is, by its command line: a robot's name, "router", "recorder", "conductor", ..."""
    for module, name in ROLES.items():
        if module in words:
            return name
    if ROBOT in words:
        names = words[words.index(ROBOT) + 2 :]
        end = next((place for place, word in enumerate(names) if word.startswith("--") or not word), len(names))
        return "+".join(names[:end])
    return OTHER


def usage(pid: int) -> Usage | None:
    """What a process takes; None if it is gone."""
    folder = PROC / str(pid)
    try:
        fields = (folder / "stat").read_bytes().rpartition(b")")[2].split()
        files = sum(1 for _ in (folder / "fd").iterdir())
    except OSError:
        return None
    # counted from the state, which is field 3 of proc_pid_stat(5): utime 14, stime 15, num_threads 20, rss 24
    return Usage(int(fields[21]) * PAGE / 1e6, int(fields[17]), files, (int(fields[11]) + int(fields[12])) / TICKS)
