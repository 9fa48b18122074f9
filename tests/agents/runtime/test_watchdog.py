"""A loop that hangs is noticed from outside, its robots land, and one that hangs for good ends the process."""

from __future__ import annotations

import os
import signal
import threading
import time

import psutil
import pytest

from agents.runtime.watchdog import HUNG, Watchdog
from tests.commands import started
from tests.waiting import until


class Kennel:
    """A watchdog and its body, which writes down what it is told, and hangs in what it was asked to hang in."""

    def __init__(self, down_s: float = 10.0, silence_s: float = 0.1, stuck: str = "") -> None:
        self.orders, self.alarms, self.ends = [], [], []
        self.stuck, self.never = stuck, threading.Event()
        self.dog = Watchdog(
            self, (0, 1), alarm=self.alarms.append, silence_s=silence_s, down_s=down_s, end=self.ends.append
        )

    def land(self, rows) -> None:
        self.take("land", rows)

    def stop(self, rows) -> None:
        self.take("stop", rows)

    def take(self, what: str, rows) -> None:
        assert rows == (0, 1)
        self.orders.append(what)
        if self.stuck == what:
            self.never.wait(10.0)

    def __enter__(self) -> Kennel:
        self.dog.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.dog.end()
        self.never.set()

    def beat_for(self, seconds: float) -> None:
        end, pause = time.monotonic() + seconds, threading.Event()
        while time.monotonic() < end:
            self.dog.beat()
            pause.wait(0.01)


@pytest.mark.slow
def test_a_loop_that_goes_round_is_left_alone():
    with Kennel(silence_s=1.0) as kennel:  # a busy machine may hold up a loop for some tenths
        kennel.beat_for(2.0)
    assert (kennel.orders, kennel.alarms, kennel.dog.tripped) == ([], [], "")


@pytest.mark.slow
def test_hanging_loop_is_landed_and_may_recover():
    with Kennel(silence_s=0.5) as kennel:
        kennel.beat_for(0.05)
        until(lambda: kennel.orders and kennel.alarms)
        assert kennel.dog.tripped == kennel.alarms[0]
        assert kennel.dog.tripped.startswith("its control loop hangs: no tick for ")
        assert kennel.dog.forgive() == kennel.alarms[0]
        assert not kennel.dog.tripped
        kennel.beat_for(1.0)
    assert set(kennel.orders) == {"land"}
    assert len(kennel.alarms) == 1
    assert not kennel.ends


@pytest.mark.slow
@pytest.mark.parametrize("stuck", ["", "land", "stop"])
def test_endless_hang_is_cut_and_ended(stuck):
    with Kennel(down_s=0.8, stuck=stuck) as kennel:
        until(lambda: kennel.ends)
    assert kennel.ends == [HUNG]
    assert kennel.orders[-1] == "stop"
    assert kennel.orders.count("stop") == 1
    assert kennel.orders.count("land") == 1 if stuck == "land" else kennel.orders.count("land") >= 2


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
    with started("-c", FROZEN) as process:
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
