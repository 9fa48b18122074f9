"""Robots that are paused, removed, restarted, replaced and added while the others fly on."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agents import wire
from experiments import document, orders, playback
from experiments.run import reopen
from tests.system.lab import ENVIRONMENT, ROOT, Flight, Watcher

pytestmark = pytest.mark.system

SPARES = """
[robots.KH03]
kind = "khepera4"
start = [-0.7, 0.7]
standby = true

[spares.S1]
kind = "crazyflie"
start = [0.6, 0.3]
hover = 0.6

[spares.S2]
kind = "khepera4"
start = [-0.6, -0.2]
"""


class Lab:
    """The triangle with a robot on standby and two spares, and an operator."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / "x.toml"
        text = document.catalogue_path("triangle").read_text("utf-8")
        text = text.replace("[formation]", f"{SPARES}\n[formation]", 1)
        text = text.replace('"KH01 - KH02"', '"KH01 > KH03" = 0.60\n"KH03 > KH01" = 0.60\n"KH01 - KH02"', 1)
        self.file.write_text(text)

    def fly(self, *more: str, duration: int = 60) -> None:
        settings = [part for each in (f"duration_s={duration}", *more) for part in ("--set", each)]
        self.flight = Flight(self.folder / "run", str(self.file), "--case", "event", "--no-report", "--json", *settings)
        self.flight.until_said("phase conductor: formation")
        self.endpoint = self.flight.endpoint()
        self.watcher = Watcher(self.endpoint)
        self.watcher.until(lambda: self.running("KH01", "KH02", "CF01"), "all run")

    def running(self, *names: str) -> bool:
        return all(self.watcher.phase(name) == "running" for name in names)

    def change(self, what: wire.ChangeKind, *names: str, **more: object) -> wire.RunReply:
        order = wire.RunOrder(what, list(names), **more)  # type: ignore[arg-type]
        return orders.give_run(self.watcher.session, self.watcher.keys, order)

    def zenpark(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "tools.guard", "robot", *arguments, "--connect", self.endpoint],
            cwd=ROOT, env=ENVIRONMENT, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
            timeout=60,
        )  # fmt: skip

    def end(self) -> tuple[int, str]:
        """Ctrl-C: all land."""
        if self.flight.process.poll() is None:
            self.flight.signal(2)
        return self.flight.finish()

    def close(self) -> None:
        if hasattr(self, "watcher"):
            self.watcher.close()
        if hasattr(self, "flight") and self.flight.process.poll() is None:
            self.flight.signal(2)
            self.flight.process.wait(40.0)


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    yield made
    made.close()


def test_a_killed_robot_is_started_again_and_takes_part(lab: Lab) -> None:
    lab.fly()
    first = lab.watcher.status["CF01"].pid
    os.kill(first, 9)
    lab.flight.until_said("lost CF01: its process ended")
    reply = lab.change("restart", "CF01")
    assert set(reply.done) == {"CF01"}, reply
    lab.watcher.until(lambda: lab.watcher.status["CF01"].pid != first and lab.running("CF01"), "it runs")
    lab.watcher.until(lambda: not lab.watcher.status["KH01"].missing or lab.watcher.status["KH01"].missing == ["KH03"],
                      "it is heard again")  # fmt: skip
    started = lab.watcher.status["CF01"].started
    assert abs(started - lab.watcher.status["KH01"].started) < 0.1, "its time is that of the others"
    time.sleep(1.0)
    code, _ = lab.end()
    assert code in (0, 130), lab.flight.said()
    read = playback.read(lab.folder / "run" / "event.mcap")
    assert read.complete
    told = [(event.kind, event.source) for event in read.trace.events]
    for each in (("lost", "CF01"), ("restart", "CF01"), ("changed", "CF01")):
        assert each in told
    run = reopen(lab.folder / "run")
    assert run.metrics["event"].robots


if __name__ == "__main__":
    pytest.main([__file__])
