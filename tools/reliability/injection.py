"""Injection of the faults of a script into a run that is under way, and their end."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from agents.network import messages
from experiments.real_time.conductor import orders
from experiments.real_time.hosts.launcher import Launcher, Process, tagged
from tools.reliability.cables import Cables
from tools.reliability.fault_script import Fault
from tools.reliability.observer import Observer
from tools.reliability.run_process import WatchedRun
from tools.reliability.spoilt_process import Switch

GARBAGE: Final = 20  # payloads of nonsense at a time, on each key of a victim


class Injector:
    """Does faults to one run."""

    def __init__(
        self,
        watched: WatchedRun,
        launcher: Launcher,
        cables: Cables,
        observer: Observer,
        *,
        folder: Path,
        random: np.random.Generator,
        groups: Mapping[str, str],
        recording: Path,
    ) -> None:
        """No fault is done yet."""
        self._watched, self._launcher, self._cables = watched, launcher, cables
        self._session, self._keys = observer.session, observer.keys
        self._folder, self._random, self._groups, self._recording = folder, random, groups, recording
        self._stopped: list[int] = []
        self._switches: dict[str, Switch] = {}
        self.second: Process | None = None  # second process of a name
        self.answer = messages.RunReply()  # to the last restart

    def begin(self, fault: Fault, victim: str) -> str:
        """Inject a fault; return a note for the report.

        Args:
            victim: A robot; empty for the whole run.
        """
        kind, size, how = fault.kind, fault.size, fault.properties
        if how.signal is not None:
            sent = self._send(victim or how.role, how.signal)
            self._stopped = sent if how.signal == signal.SIGSTOP else []
        if how.cuts:
            self._cables.cut(self._groups[victim])
        if kind == "read-error":
            self._switch(f"read-{victim}").write(1.0)
        if kind == "double":
            self.second = self._start_duplicate(victim)
        if how.clock is not None:
            name, direction = how.clock
            companions = [robot for robot, group in self._groups.items() if group == self._groups.get(victim)]
            switch = self._switch(name.format("+".join(companions)))
            switch.write(direction * size + (switch.read() if kind == "clock" else 0.0))
            return f"{direction * size:+g} s"
        if kind == "disk":
            return self._fill()
        return f"{self._spoil(victim)} payloads of nonsense" if kind == "corrupt" else ""

    def end(self, fault: Fault) -> None:
        if fault.kind == "mocap-clock":
            self._switch("clock-positioning").write(0.0)
        elif fault.lasts_s:
            self.release()

    def restart(self, victim: str) -> None:
        """Have the conductor start a robot again; do not wait for that."""
        order = messages.RunOrder("restart", [victim], who="chaos")

        def ask() -> None:
            self.answer = orders.send_run_order(self._session, self._keys, order)

        self.answer = messages.RunReply()
        threading.Thread(target=ask, name="restart", daemon=True).start()

    def release(self) -> None:
        """Continue stopped processes and mend all cables."""
        for pid in self._stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._stopped = []
        self._cables.mend()

    def _spoil(self, victim: str) -> int:
        """Send nonsense on every key that a robot and its body read, but the stop's; return the number of payloads."""
        keys = self._keys
        read = (keys.pose, keys.position, keys.setpoint, keys.state, keys.status, keys.goal, keys.ranges)
        targets = [key(victim) for key in read]
        for key in targets:
            for _ in range(GARBAGE):
                self._session.put(key, self._malformed_payload(victim), encoding=messages.JSON)
        return GARBAGE * len(targets)

    def _malformed_payload(self, victim: str) -> bytes:
        whole = messages.encode(messages.pose(victim, 1, 0.0, [9e9, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0))
        payloads = (
            self._random.bytes(int(self._random.integers(1, 400))),
            b"[" * 10_000,
            b'{"robot": "' + victim.encode() + b'", "seq": 1e999, "stamp": -1, "position": [1e308, 0, 0]}',
            b"x" * 100_000,
            whole[: int(self._random.integers(len(whole)))],
        )
        return payloads[int(self._random.integers(len(payloads)))]

    def _switch(self, name: str) -> Switch:
        return self._switches.setdefault(name, Switch(self._folder / name))

    def _start_duplicate(self, victim: str) -> Process:
        """A second process of a name: the same command again."""
        pid = self._running(victim)[0]
        tag = self._watched.tag
        words = dict(tagged(tag))[pid][:-1]  # the last one is empty
        return self._launcher.spawn(f"double-{victim}-{pid}-{time.monotonic_ns()}", ["env", tag, *words])

    def _fill(self) -> str:
        """Limit the recording to its present size: the recorder gets the error of a disk that is full."""
        full = self._recording.stat().st_size
        for pid in self._running("recorder"):
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
            return f"at {full} bytes"
        return "no recorder"

    def _running(self, role: str) -> list[int]:
        """The processes of a role, or of a robot."""
        return [pid for pid, name in sorted(self._watched.processes().items()) if role in name.split("+")]

    def _send(self, role: str, number: signal.Signals) -> list[int]:
        """Send a signal to the first process of a role."""
        found = self._running(role)[:1]
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        return found
