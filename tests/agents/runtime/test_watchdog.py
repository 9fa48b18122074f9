"""A loop that hangs is noticed from outside, its robots land, and one that hangs for good ends the process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager

import numpy as np
import psutil
import pytest

from agents.runtime.watchdog import HUNG, Watchdog
from tests.conftest import ROOT
from tests.waiting import until
from twins.arrays import Index

SILENCE_S = 0.1


class Told:
    """A body that writes down what it is told, and hangs in what it was asked to hang in."""

    def __init__(self) -> None:
        self.orders: list[tuple[str, list[int]]] = []
        self.never = threading.Event()
        self.stuck = ""

    def land(self, rows: Index) -> None:
        self.take("land", rows)

    def stop(self, rows: Index) -> None:
        self.take("stop", rows)

    def take(self, what: str, rows: Index) -> None:
        self.orders.append((what, rows.tolist()))
        if self.stuck == what:
            self.never.wait(10.0)

    def count(self, what: str) -> int:
        return sum(order == (what, [0, 1]) for order in self.orders)


class Kennel:
    def __init__(self, down_s: float = 10.0, silence_s: float = SILENCE_S) -> None:
        self.body, self.alarms, self.ends = Told(), list[str](), list[int]()
        self.dog = Watchdog(
            self.body,  # type: ignore[arg-type]
            np.arange(2),
            alarm=self.alarms.append,
            silence_s=silence_s,
            down_s=down_s,
            end=self.ends.append,
        )

    @contextmanager
    def watched(self):
        self.dog.start()
        try:
            yield
        finally:
            self.dog.end()

    def beat_for(self, seconds: float) -> None:
        end, pause = time.monotonic() + seconds, threading.Event()
        while time.monotonic() < end:
            self.dog.beat()
            pause.wait(0.01)


@pytest.mark.slow
def test_a_loop_that_goes_round_is_left_alone():
    kennel = Kennel(silence_s=1.0)  # a busy machine may hold up a loop for some tenths
    with kennel.watched():
        kennel.beat_for(2.0)
    assert not kennel.body.orders
    assert not kennel.alarms
    assert not kennel.dog.tripped


@pytest.mark.slow
def test_hanging_loop_is_landed_and_may_recover(eventually: Callable[[Callable[[], object]], None]):
    kennel = Kennel(silence_s=0.5)
    with kennel.watched():
        kennel.beat_for(0.05)
        eventually(lambda: kennel.body.count("land"))
        eventually(lambda: kennel.alarms)
        assert kennel.dog.tripped == kennel.alarms[0]
        assert kennel.dog.tripped.startswith("its control loop hangs: no tick for ")
        assert kennel.dog.forgive() == kennel.alarms[0]
        assert not kennel.dog.tripped
        kennel.beat_for(1.0)
    assert not kennel.body.count("stop")
    assert len(kennel.alarms) == 1
    assert not kennel.ends


@pytest.mark.slow
@pytest.mark.parametrize("stuck", ["", "land", "stop"])
def test_endless_hang_is_cut_and_ended(stuck: str, eventually):
    kennel = Kennel(down_s=0.8)
    kennel.body.stuck = stuck
    with kennel.watched():
        eventually(lambda: kennel.ends)
    kennel.body.never.set()
    assert kennel.ends == [HUNG]
    assert kennel.body.orders[-1] == ("stop", [0, 1])
    assert kennel.body.count("stop") == 1
    assert kennel.body.count("land") == 1 if stuck == "land" else kennel.body.count("land") >= 2


FROZEN = """
import select, sys, threading
from agents.runtime.watchdog import Watchdog
def say(text):
    sys.stdout.write(text + "\\n")  # at once: several threads do so
    sys.stdout.flush()
class Body:
    def land(self, rows): say("landed")
    stop = land
dog = Watchdog(Body(), None, alarm=say, silence_s=0.5, down_s=0.1)
dog.start()
print("runs", flush=True)
pause, left = threading.Event(), 80
while left:
    dog.beat()
    pause.wait(0.01)
    left -= len(select.select([sys.stdin], [], [], 0.0)[0])  # from the end of its input on
print("over", flush=True)
threading.Event().wait()
"""


@pytest.mark.mechanism("watchdog: suspended process")
@pytest.mark.system
def test_frozen_process_is_no_hanging_loop():
    """And one that hangs for good ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", FROZEN], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "runs\n"
    os.kill(process.pid, signal.SIGSTOP)
    until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_STOPPED, "it is frozen")
    frozen = time.monotonic()
    until(lambda: time.monotonic() > frozen + 1.0, "it was frozen for twice as long as the watchdog allows")
    os.kill(process.pid, signal.SIGCONT)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == HUNG
    before, *rest = out.splitlines()
    (alarm,) = [line for line in rest if line != "landed"]
    assert before == "over"
    assert alarm.startswith("its control loop hangs: no tick for ")
    assert "landed" in rest
