"""Effect of intruders on robots in flight: lateness of their control loops, against quiet times of the same run.

Intruder and robots share this machine here, which they do not in a laboratory. So each flood is measured twice: first
against a decoy, a second router of the same lab without other members, which shows what the flood costs the
machine; then against the robots' router.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec

from agents.network import lab
from agents.network.endpoints import free_endpoint
from agents.network.lab import Role
from agents.network.session import Unreachable, open_session
from experiments.definition import access_rights
from experiments.file.document import load
from experiments.real_time.conductor.run_view import Progress
from experiments.real_time.conductor.support import start_router
from experiments.real_time.hosts.launcher import Launcher
from tools.bench.measuring import Figure, fly
from tools.commands.authority import SERVICES, create

SPAN_S: Final = 6.0
SETTLE_S: Final = 1.5  # a status speaks of the second before it
JOIN_S: Final = 15.0
EFFECT_S: Final = 12.0  # half-open handshakes are dropped after 10 s
ATTACKS: Final = (
    # kind, identity whose certificate is shown, key
    ("denied", "observer", "park/CF01/pose"),
    ("large", "KH01", "park/KH01/pose"),
    ("replay", "KH01", "park/KH01/pose"),
    ("nonsense", "KH01", "park/KH01/pose"),
    # last: after these a TLS listener accepts no connection for a while
    ("half-open", "observer", "park/estop"),
    ("garbage", "observer", "park/estop"),
)


@dataclass
class Phase:
    """A part of the run: the attack, and the lateness of the robots' loops meanwhile."""

    name: str
    attack: tuple[str, ...] = ()
    late: list[float] = field(default_factory=list)
    rate: float = 0.0

    @property
    def jitter(self) -> float:
        """Median over robots and seconds of the largest lateness of a tick in that second [s]."""
        return statistics.median(self.late) if self.late else float("nan")


class Siege:
    """Walks through the phases while the conductor shows its progress."""

    def __init__(self, phases: list[Phase]) -> None:
        self.phases = phases
        self._now = -1
        self._process: subprocess.Popen[str] | None = None
        self._stamps: dict[str, float] = {}

    def look(self, progress: Progress) -> None:
        """Begin and end attacks, and collect lateness; called some ten times a second."""
        elapsed = progress.elapsed if progress.elapsed is not None else -1.0
        number = int((elapsed - 1.0) // SPAN_S) if elapsed > 1.0 else -1
        if number != self._now:
            self.end()
            self._now = number
            if 0 <= number < len(self.phases) and self.phases[number].attack:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "tools.bench.intruder_process", *self.phases[number].attack],
                    stdout=subprocess.PIPE,
                    text=True,
                )
        if not 0 <= number < len(self.phases):
            return
        fresh = elapsed - 1.0 - number * SPAN_S > SETTLE_S
        for name, view in progress.robots.items():
            status = view.status
            if status is None or status.phase != "running" or self._stamps.get(name) == status.stamp:
                continue
            self._stamps[name] = status.stamp
            if fresh:
                self.phases[number].late.append(status.late_s)

    def end(self) -> None:
        """End the intruder of this phase."""
        if self._process is None:
            return
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired, ValueError):  # it has the lowest priority: it may not get to answer
            out, _ = self._process.communicate(timeout=1.0)
            self.phases[self._now].rate = json.loads(out)["rate"]
        self._process.kill()
        self._process.communicate()
        self._process = None


def intruders() -> Iterator[Figure]:
    """Loop lateness of seven robots under attack, and how long joining takes meanwhile."""
    for protocol in ("tls", "quic"):
        yield from _siege(protocol)
    for protocol in ("tls", "quic"):
        yield from _joining(protocol)


def _siege(protocol: str) -> Iterator[Figure]:

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rights, founded = _lab(folder)
        (real,), (decoy,) = (
            lab.secured([free_endpoint(preferred_port=0, protocol=protocol)], founded) for _ in range(2)
        )
        phases: list[Phase] = []
        for kind, identity, key in ATTACKS:
            if kind == "half-open" and protocol == "quic":
                continue
            phases.append(Phase("quiet"))
            for target, where in ((decoy, "elsewhere"), (real, "here")):
                phases.append(Phase(f"{kind}, {where}", (kind, target, identity, key)))
        phases.append(Phase("quiet"))
        siege = Siege(phases)
        with Launcher(folder / "logs") as launcher:
            start_router(launcher, [real], rights)
            listen = ("--listen", decoy, "--rights", str(rights), "--lifeline")
            launcher.start("decoy", "agents.runtime.router", *listen)
            try:
                fly(launcher, folder, [real], siege.look, duration_s=1.0 + SPAN_S * len(phases) + 1.0, rights=rights)
            finally:
                siege.end()
    for number, phase in enumerate(phases):
        if not phase.attack:
            continue
        # other work of the machine comes and goes: quiet is what it was just before and just after
        around = [p for p in (*phases[number - 2 : number], *phases[number + 1 : number + 3]) if not p.attack]
        quiet = Phase("quiet", late=[late for near in around for late in near.late]).jitter
        what = f"{protocol}: {phase.name}, {phase.rate:.0f}/s"
        yield Figure("intruders", what, 1e3 * phase.jitter, "ms late", phase.jitter / quiet, "× quiet")


def _joining(protocol: str) -> Iterator[Figure]:
    """Time to join with a good certificate."""
    kinds = ("garbage", "half-open") if protocol == "tls" else ("garbage",)
    for kind in kinds:
        quiet, taken = _joined(protocol, kind)
        what = f"{protocol}: joining, {kind}" + (f" (not in {JOIN_S:g} s)" if taken >= JOIN_S else "")
        yield Figure("intruders", what, 1e3 * taken, "ms", taken / quiet, "× quiet")


def _joined(protocol: str, kind: str) -> tuple[float, float]:
    """Time to join [s], in quiet and under an attack."""
    with tempfile.TemporaryDirectory() as name, Launcher(Path(name) / "logs") as launcher:
        rights, founded = _lab(Path(name))
        (endpoint,) = lab.secured([free_endpoint(preferred_port=0, protocol=protocol)], founded)
        start_router(launcher, [endpoint], rights)

        def join() -> float:
            begin = time.monotonic()
            try:
                open_session([endpoint], name="observer", wait_s=JOIN_S).close()  # type: ignore[no-untyped-call]
            except Unreachable:
                return JOIN_S
            return time.monotonic() - begin

        join()
        quiet = statistics.median(join() for _ in range(5))
        attack = [sys.executable, "-m", "tools.bench.intruder_process", kind, endpoint, "observer", "park/estop"]
        with subprocess.Popen(attack, stdout=subprocess.DEVNULL) as process:
            time.sleep(EFFECT_S)
            taken = join()
            process.kill()
        return quiet, taken


def _lab(folder: Path) -> tuple[Path, Path]:
    """The rights of the reference experiment as a file, and a lab for it."""

    cases = load("robotic-park").cases().values()
    rights = folder / "rights.json"
    rights.write_bytes(msgspec.json.encode(access_rights.rights(cases)))
    identities: dict[str, Role] = {role: role for role in SERVICES}
    identities |= {name: "robot" for case in cases for name in case.robots}
    create(folder / "lab", identities)
    return rights, folder / "lab"
