"""How each fault of a script is done to a run that is under way, and how it is lifted again."""

from __future__ import annotations

import contextlib
import mmap
import os
import resource
import signal
import struct
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from agents import wire
from agents.keys import Keys
from experiments.cables import GOOD, Cables, Condition
from experiments.fault_script import Fault
from experiments.watched import Watched

FLIPS: Final = 0.05  # share of segments with a wrong bit
GARBAGE: Final = 20  # payloads of nonsense at a time, on each key of a victim
STEP_FILE: Final = "clock-step"
SITE: Final = "site"
STEPPED: Final = """\
# The wall clock of every process of this run reads as much more as a file says: a step as it sees it.
import mmap
import struct
import time

with open({file!r}, "rb") as _file:
    _step = mmap.mmap(_file.fileno(), 8, access=mmap.ACCESS_READ)
_utc, _read = time.time, struct.Struct("d").unpack_from
time.time = lambda: _utc() + _read(_step)[0]
"""


class WallClock:
    """The wall clock of a run's processes, which can be stepped without that of the machine.

    Python imports `sitecustomize` from the first folder on its path, in every process of the run: `time.time` there
    reads a step from a file that they all share. What the network library stamps by itself is not reached.
    """

    def __init__(self, folder: Path) -> None:
        """Makes what `environment` refers to."""
        site = folder / SITE
        site.mkdir()
        file = folder / STEP_FILE
        file.write_bytes(struct.pack("d", 0.0))
        (site / "sitecustomize.py").write_text(textwrap.dedent(STEPPED.format(file=str(file.absolute()))))
        self._file = file.open("r+b")
        self._step = mmap.mmap(self._file.fileno(), 8)
        path = [str(site.absolute()), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.environment = [f"PYTHONPATH={os.pathsep.join(path)}"]

    def step(self, seconds: float) -> None:
        """From now on the clocks read that much more than they would."""
        (before,) = struct.unpack_from("d", self._step)
        struct.pack_into("d", self._step, 0, before + seconds)

    def close(self) -> None:
        """The run is over."""
        self._step.close()
        self._file.close()


class Injector:
    """Does faults to one run."""

    def __init__(
        self,
        watched: Watched,
        cables: Cables,
        clock: WallClock,
        random: np.random.Generator,
        *,
        groups: Mapping[str, str],
        recording: Path,
    ) -> None:
        """`groups` names the process of each robot, `recording` is where it is recorded."""
        self._recording = recording
        self._watched, self._cables, self._clock, self._random = watched, cables, clock, random
        self._groups = groups
        self._stopped: list[int] = []

    def begin(self, fault: Fault, victim: str, session: zenoh.Session, keys: Keys) -> str:
        """Does it; what there is to say of it.

        Args:
            fault: What.
            victim: To whom; empty for the whole run.
            session: For nonsense.
            keys: Of the realm.
        """
        group = self._groups.get(victim, "")
        match fault.kind:
            case "kill":
                self._send(group, signal.SIGKILL)
            case "freeze":
                self._stopped = self._send(group, signal.SIGSTOP)
            case "partition":
                self._cables.set(Condition(cut=True), group)
            case "loss":
                self._cables.set(Condition(loss=fault.size))
            case "delay":
                self._cables.set(Condition(delay_s=fault.size), group)
            case "bits":
                self._cables.set(Condition(flips=FLIPS), group)
            case "router" | "failover":
                self._send("router", signal.SIGKILL, most=1)
            case "conductor":
                os.kill(self._watched.process.handle.pid, signal.SIGKILL)
            case "clock":
                self._clock.step(fault.size)
                return f"{fault.size:+g} s"
            case "disk":
                return self._fill()
            case "corrupt":
                return f"{self.spoil(victim, session, keys)} payloads of nonsense"
        return ""

    def end(self, fault: Fault) -> None:
        """Lifts it."""
        if fault.lasts_s:
            self.release()

    def release(self) -> None:
        """Nothing is stopped or cut any more, whatever was under way."""
        for pid in self._stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._stopped = []
        self._cables.set(GOOD)

    def spoil(self, victim: str, session: zenoh.Session, keys: Keys) -> int:
        """Nonsense on every key that a robot and its body believe; how many. On the emergency stop's it would stop."""
        listening = (keys.pose, keys.position, keys.setpoint, keys.state, keys.status, keys.goal, keys.ranges)
        targets = [key(victim) for key in listening]
        for key in targets:
            for _ in range(GARBAGE):
                session.put(key, self._nonsense(victim), encoding=wire.JSON)
        return GARBAGE * len(targets)

    def _nonsense(self, victim: str) -> bytes:
        kind = int(self._random.integers(5))
        if kind == 0:
            return self._random.bytes(int(self._random.integers(1, 400)))
        if kind == 1:
            return b"[" * 10_000
        if kind == 2:
            return b'{"robot": "' + victim.encode() + b'", "seq": 1e999, "stamp": -1, "position": [1e308, 0, 0]}'
        if kind == 3:
            return b"x" * 100_000
        whole = wire.encode(wire.pose(victim, 1, 0.0, [9e9, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0))
        return whole[: int(self._random.integers(len(whole)))]

    def _fill(self) -> str:
        """The recording may not grow any more: the recorder gets the error of a disk that is full."""
        full = self._recording.stat().st_size
        for pid, name in self._watched.processes().items():
            if name == "recorder":
                with contextlib.suppress(ProcessLookupError):
                    resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
                return f"at {full} bytes"
        return "no recorder"

    def _send(self, role: str, number: signal.Signals, most: int | None = None) -> list[int]:
        found = [pid for pid, name in sorted(self._watched.processes().items()) if role in name.split("+")]
        for pid in found[:most]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        return found[:most]
