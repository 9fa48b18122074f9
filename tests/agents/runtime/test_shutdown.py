"""Bodies land, stop and close when their loop ends, whatever fails on the way, and when it hangs."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from io import StringIO
from itertools import repeat
from typing import Any
from unittest.mock import Mock

import psutil
import pytest

from agents.decision.lifecycle import Phase
from agents.network import messages
from agents.network.keys import Keys
from agents.network.name_ownership import NameKeeper
from agents.network.shutdown import end
from agents.robot import Robot
from agents.runtime import loop, watchdog
from agents.runtime.descent import Descent, DescentTiming
from agents.runtime.watchdog import HUNG, Watchdog
from agents.ticks import Ticks
from experiments.definition.experiment import Arena
from experiments.definition.plan import Plan
from tests.agents.runtime.process import DRONE, QUICK, Airborne, clocked, process
from tests.cases import mostly_slow
from tests.commands import started
from tests.fuzz.messages import sent
from tests.network import Net
from tests.small import small
from tests.waiting import ManualClock, until

STOP = sent("park/estop", messages.Stop("a test", "to see"))[0]


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """Of the loops; that of the watchdogs is real."""
    clocked(monkeypatch, clock := ManualClock(1000.0, step=1e-4))
    return clock


def run_to_end(body: Airborne, silence_s: float = 5.0, timing: DescentTiming = QUICK) -> None:
    """Run a robot with that body to its end, on a network of its own."""
    with Net().worn() as body.net:
        process(DRONE, body, loop_timeout_s=silence_s, descent=timing).run()


def run_and_break(body: Airborne, **given: Any) -> None:
    with pytest.raises(OSError, match="the loop breaks"):
        run_to_end(body, **given)


@pytest.mark.parametrize(
    "broken", mostly_slow([[], ["read"], ["land"], ["stop"], ["close"], ["read", "land", "stop", "close"]], 5)
)
def test_shutdown_tries_everything_and_raises(broken):
    body = Airborne(*broken)
    with pytest.raises(OSError, match="fails" if broken else "the loop breaks") as error:
        run_to_end(body)
    assert body.order == ["open", "land", "stop", "close"]
    chain, one = [], error.value
    while one is not None:
        chain, one = [*chain, str(one)], one.__context__
    assert "the loop breaks" in chain


@pytest.mark.parametrize("limits", [{"landing_s": 30.0}, {"landing_s": 0.05, "slowest": 2.5 / 20.0}], ids=str)
def test_robot_is_stopped_once_it_is_down(limits):
    body = Airborne(steps=10)
    run_and_break(body, timing=replace(QUICK, **limits))  # at the slowest, it takes 20 s from the ceiling of 2.5 m
    assert body.steps <= 0
    assert body.calls == ["open", "land", "stop", "close"]


@pytest.mark.parametrize(("height", "down_s"), [(1.0, 10.0), (6.0, 30.0)])
def test_watchdog_waits_for_a_whole_descent(height, down_s):
    plan = Plan(small({"F": "crazyflie", "B": "khepera4"}, arena=Arena(size=(4.0, 4.0, height))))
    keeper, silent = NameKeeper(Keys("park"), "FB", 0.0), lambda _reason: None
    flying, driving = (
        Descent(
            [Robot(plan.assignment(name))], Airborne(), keeper, Ticks(50.0),
            silence_s=0.5, alarm=silent, recover=silent, timing=DescentTiming(),
        )
        for name in "FB"
    )  # fmt: skip
    assert flying.watchdog.down_s == pytest.approx(down_s)
    assert driving.watchdog.down_s == 10.0


@pytest.mark.parametrize(("phase", "helps"), [(Phase.RUNNING, 1), (Phase.READY, 0), (Phase.DONE, 0)])
def test_broken_loop_on_wheels_calls_for_help(phase, helps):
    """Neighbours followed the last pose of a robot that could not be read, until its process had ended."""
    robot, alarms = Robot(Plan(small({"B": "khepera4"})).assignment("B")), []
    robot.lifecycle.phase = int(phase)
    body = Airborne("stop", steps=0)  # it is beyond reach
    keeper, silent = NameKeeper(Keys("park"), "B", 0.0), lambda _reason: None
    descent = Descent(
        [robot], body, keeper, Ticks(50.0), silence_s=5.0, alarm=alarms.append, recover=silent, timing=QUICK
    )

    def breaks() -> None:
        with Net().worn() as net, ExitStack() as steps:
            descent.session = net.session
            descent.register(steps)
            raise OSError("the loop breaks")

    with pytest.raises(OSError, match="stop fails"):
        breaks()
    assert alarms == ["its control loop broke: OSError: the loop breaks"] * helps
    assert "land" not in body.calls


@pytest.mark.parametrize(("broken", "steps", "lands"), [("read", 3, 4), ("stop", 0, 0)])
def test_order_is_repeated_until_it_succeeds(broken, steps, lands):
    """A body that cannot be read gets time to land: the first order may have got lost."""
    body = Airborne(broken, steps=steps)
    with pytest.raises(OSError, match=f"{broken} fails"):
        run_to_end(body, timing=replace(QUICK, again_s=0.02))
    assert body.calls.count("land") >= lands
    assert ("land" in body.calls) == (lands > 0)
    assert body.calls.count("stop") > 1


def test_emergency_stop_during_a_descent():
    body = Airborne(steps=10**9)

    def stop() -> None:
        if body.landing and not body.stopped:
            body.net.deliver(STOP)

    body.looks = stop
    run_and_break(body, timing=replace(QUICK, landing_s=30.0))
    assert body.order == ["open", "land", "stop", "close"]


def test_hanging_read_is_landed_by_the_watchdog():
    body = Airborne()
    body.looks = lambda: until(lambda: body.landing)
    run_and_break(body, silence_s=0.3)
    assert body.order == ["open", "land", "stop", "close"]


def test_stop_between_ticks_yields_the_processor(monkeypatch):
    body = Airborne()
    done: list[float] = []  # ticks when the stop came; sleeps and ticks since
    sleep = loop.time.sleep

    def asleep(seconds: float) -> None:
        if body.reads and not body.stopped:
            body.net.deliver(STOP)
            done.append(body.reads)
        elif len(done) == 1:
            done.extend((seconds, body.reads))
        sleep(seconds)

    def command(_setpoints: Sequence[object]) -> None:
        if len(done) > 1 or body.reads > 1000:
            raise OSError("the loop breaks")

    monkeypatch.setattr(loop.time, "sleep", asleep)
    body.command = command
    run_and_break(body)
    assert done == [done[0], loop.STOP_YIELD_S, done[0]]


class Kennel(ManualClock):
    """A watchdog on a clock of its own, and its body of two rows, which writes down what row 1 is told.

    Row 0 hangs in what is `stuck`.

    `watch` lets it look at its loop as often as `life` yields; what is not stuck is done before the next look.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, down_s: float = 10.0, stuck: str = "") -> None:
        super().__init__()
        monkeypatch.setattr(watchdog, "time", self)
        self.orders, self.alarms, self.ends = [], [], []
        self.stuck, self.never = stuck, threading.Event()
        self.land, self.stop = partial(self.take, "land"), partial(self.take, "stop")
        self.dog = Watchdog(self, (0, 1), alarm=self.alarms.append, silence_s=0.5, down_s=down_s, end=self.ends.append)
        self.dog._over = self  # type: ignore[assignment]

    def take(self, what: str, rows: Sequence[int]) -> None:
        if rows == (1,):
            self.orders.append(what)
        elif self.stuck == what:
            self.never.wait(30.0)

    def watch(self, life: Iterator[None]) -> None:
        self.life = life
        self.dog._watch()
        self.never.set()
        for thread in self.dog._at_work.values():
            thread.join()

    def wait(self, seconds: float) -> bool:
        for what, thread in self.dog._at_work.items():
            if what != f"{self.stuck} 0":
                thread.join()
        self.sleep(seconds)
        return next(self.life, self) is self


def test_hanging_loop_is_landed_and_may_recover(monkeypatch):
    kennel = Kennel(monkeypatch)

    def life() -> Iterator[None]:
        for _ in range(10):
            yield kennel.dog.beat()
        assert (kennel.orders, kennel.alarms, kennel.dog.tripped) == ([], [], "")
        while not kennel.orders:
            yield
        assert kennel.alarms == [kennel.dog.tripped]
        assert kennel.dog.tripped.startswith("its control loop hangs: no tick for ")
        assert kennel.dog.forgive() == kennel.alarms[0]
        assert not kennel.dog.tripped
        for _ in range(10):
            yield kennel.dog.beat()

    kennel.watch(life())
    assert (kennel.orders, len(kennel.alarms), kennel.ends) == (["land"], 1, [])


@pytest.mark.parametrize("stuck", ["", "land", "stop"])
def test_endless_hang_is_cut_and_ended(stuck, monkeypatch):
    kennel = Kennel(monkeypatch, down_s=0.8, stuck=stuck)
    kennel.watch(repeat(None))
    assert (kennel.ends, kennel.orders) == ([HUNG], ["land", "land", "stop"])


FROZEN = """
import select, sys, threading
from agents.runtime.watchdog import Watchdog
def say(text):
    sys.stdout.write(text + "\\n")  # at once: several threads do so
    sys.stdout.flush()
class Body:
    def land(self, rows): say("landed")
    stop = land
dog = Watchdog(Body(), (0,), alarm=say, silence_s=0.5, down_s=0.1)
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
    with started("-c", FROZEN) as process:
        assert process.stdout.readline() == "runs\n"
        os.kill(process.pid, signal.SIGSTOP)
        until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_STOPPED, "it is frozen")
        frozen = time.monotonic()
        until(lambda: time.monotonic() > frozen + 1.0, "it was frozen for twice as long as the watchdog allows")
        os.kill(process.pid, signal.SIGCONT)
        out, _ = process.communicate(timeout=100)
    assert process.returncode == HUNG
    before, *rest = out.splitlines()
    (alarm,) = [line for line in rest if line != "landed"]
    assert before == "over"
    assert alarm.startswith("its control loop hangs: no tick for ")
    assert "landed" in rest


def breaks() -> int:
    raise OSError("a defect")


@pytest.mark.parametrize(
    ("main", "daemon", "at_once"),
    [(lambda: 4, False, []), (lambda: 4, True, [4]), (lambda: sys.exit(4), True, [4]), (breaks, False, [1])],
    ids=["ends", "daemon", "exits", "breaks"],
)
def test_no_thread_outlives_the_main_function(monkeypatch, main, daemon, at_once):
    """A daemon inside Zenoh would take the process along, by SIGABRT; another one would keep a broken one alive."""
    ended = []
    monkeypatch.setattr(sys, "stdout", Mock(flush=Mock(side_effect=BrokenPipeError)))
    monkeypatch.setattr(os, "_exit", ended.append)
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread(), threading.Thread(daemon=daemon)])
    monkeypatch.setattr(sys, "stderr", StringIO())
    with pytest.raises(SystemExit):
        end(main)
    assert ended == at_once
