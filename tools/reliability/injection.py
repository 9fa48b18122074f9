"""How each fault of a script is done to a run that is under way, and how it is lifted again."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from agents.network import messages
from agents.network.keys import Keys
from experiments.real_time.conductor import orders
from experiments.real_time.hosts.launcher import Launcher, Process
from tools.reliability.cables import GOOD, Cables, Condition
from tools.reliability.fault_script import Fault
from tools.reliability.run_process import PROC, WatchedRun
from tools.reliability.spoilt_process import Switch

# which process gets which signal, if it is not a robot's, and on which robots' cables what happens
SIGNALS: Final[Mapping[str, tuple[str, signal.Signals]]] = {
    "kill": ("", signal.SIGKILL),
    "freeze": ("", signal.SIGSTOP),
    "clock-behind": ("", signal.SIGKILL),
    "router": ("router", signal.SIGKILL),
    "failover": ("router", signal.SIGKILL),
    "frozen-router": ("router", signal.SIGSTOP),
    "conductor": ("conductor", signal.SIGKILL),
}
CABLES: Final[Mapping[str, Callable[[float], Condition]]] = {
    "partition": lambda _: Condition(cut=True),
    "loss": lambda share: Condition(loss=share),
    "delay": lambda seconds: Condition(delay_s=seconds),
    "bits": lambda _: Condition(flips=FLIPS),
}
# which switch, with the role of the victim's process, and in which direction
CLOCKS: Final[Mapping[str, tuple[str, float]]] = {
    "clock": ("clock", 1.0),
    "mocap-clock": ("clock-positioning", 1.0),
    "clock-behind": ("clock-{}", -1.0),
}
FLIPS: Final = 0.05  # share of segments with a wrong bit
GARBAGE: Final = 20  # payloads of nonsense at a time, on each key of a victim


class Injector:
    """Does faults to one run."""

    def __init__(
        self,
        watched: WatchedRun,
        launcher: Launcher,
        cables: Cables,
        folder: Path,
        random: np.random.Generator,
        *,
        groups: Mapping[str, str],
        recording: Path,
    ) -> None:
        """No fault is done yet."""
        self._watched, self._launcher, self._cables = watched, launcher, cables
        self._folder, self._random, self._groups, self._recording = folder, random, groups, recording
        self._stopped: list[int] = []
        self._switches: dict[str, Switch] = {}
        self.second: Process | None = None  # of a name that is taken
        self.answer = messages.RunReply()  # to the last restart

    def begin(self, fault: Fault, victim: str, session: zenoh.Session, keys: Keys) -> str:
        """Inject a fault; return a note for the report.

        Args:
            fault: What.
            victim: To whom; empty for the whole run.
            session: For nonsense.
            keys: Of the realm.
        """
        kind, size = fault.kind, fault.size
        if kind in SIGNALS:
            role, number = SIGNALS[kind]
            sent = self._send(victim or role, number, most=1)
            self._stopped = sent if number == signal.SIGSTOP else []
        if kind in CABLES:
            self._cables.set(CABLES[kind](size), self._groups.get(victim))
        if kind == "read-error":
            self._switch(f"read-{victim}").write(1.0)
        if kind == "double":
            self.second = self._again(victim)
        if kind in CLOCKS:
            name, direction = CLOCKS[kind]
            switch = self._switch(name.format("+".join(self._companions(victim))))
            switch.write(direction * size + (switch.read() if kind == "clock" else 0.0))
            return f"{direction * size:+g} s"
        if kind == "disk":
            return self._fill()
        return f"{self.spoil(victim, session, keys)} payloads of nonsense" if kind == "corrupt" else ""

    def end(self, fault: Fault) -> None:
        """Lift a fault."""
        if fault.kind == "mocap-clock":
            self._switch(CLOCKS[fault.kind][0]).write(0.0)
        elif fault.lasts_s:
            self.release()

    def restart(self, victim: str, session: zenoh.Session, keys: Keys) -> None:
        """Have the conductor start a robot again; do not wait for that."""
        order = messages.RunOrder("restart", [victim], who="chaos")

        def ask() -> None:
            self.answer = orders.send_run_order(session, keys, order)

        self.answer = messages.RunReply()
        threading.Thread(target=ask, name="restart", daemon=True).start()

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
                session.put(key, self._nonsense(victim), encoding=messages.JSON)
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
        whole = messages.encode(messages.pose(victim, 1, 0.0, [9e9, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0))
        return whole[: int(self._random.integers(len(whole)))]

    def _switch(self, name: str) -> Switch:
        return self._switches.setdefault(name, Switch(self._folder / name))

    def _again(self, victim: str) -> Process:
        """A second process of a name: the same command again."""
        pid = self._running(victim)[0]
        words = (PROC / str(pid) / "cmdline").read_bytes().decode().rstrip("\0").split("\0")
        tag = self._watched.tag
        return self._launcher.spawn(f"double-{victim}-{pid}-{time.monotonic_ns()}", ["env", tag, *words])

    def _fill(self) -> str:
        """The recording may not grow any more: the recorder gets the error of a disk that is full."""
        full = self._recording.stat().st_size
        for pid in self._running("recorder"):
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
            return f"at {full} bytes"
        return "no recorder"

    def _companions(self, victim: str) -> list[str]:
        """The robots of a victim's process."""
        return [name for name, group in self._groups.items() if group == self._groups.get(victim)]

    def _running(self, role: str) -> list[int]:
        """The processes of a role, or of a robot."""
        return [pid for pid, name in sorted(self._watched.processes().items()) if role in name.split("+")]

    def _send(self, role: str, number: signal.Signals, most: int | None = None) -> list[int]:
        found = self._running(role)[:most]
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        return found
