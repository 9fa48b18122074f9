"""A process whose loop has ended lands, stops and closes its bodies, whatever fails on the way."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from agents.body.interface import call_all
from agents.network import messages
from agents.network.keys import Keys
from agents.network.name_ownership import NameKeeper
from agents.robot import Robot
from agents.runtime import loop
from agents.runtime.descent import Descent, DescentTiming
from agents.ticks import Ticks
from experiments.definition.experiment import Arena
from experiments.definition.plan import Plan
from tests.agents.runtime.process import DRONE, QUICK, Airborne, process
from tests.cases import mostly_slow
from tests.fuzz.messages import sent
from tests.network import Net
from tests.small import small

STOP = sent("park/estop", messages.Stop("a test", "to see"))[0]


def run_to_end(body: Airborne, silence_s: float = 5.0, timing: DescentTiming = QUICK) -> None:
    """Run a robot with that body to its end, on a network of its own."""
    with Net().worn() as body.net:
        process(DRONE, body, loop_timeout_s=silence_s, descent=timing).run()


def run_and_break(body: Airborne, **given: Any) -> None:
    """Run a robot to the error of its loop."""
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


def test_robot_is_stopped_once_it_is_down():
    body = Airborne(steps=10)
    run_and_break(body, timing=replace(QUICK, landing_s=30.0))
    assert body.steps <= 0
    assert body.calls == ["open", "land", "stop", "close"]


@pytest.mark.slow
def test_slow_descent_is_not_stopped_in_flight():
    body = Airborne(steps=100)  # a second
    slow = replace(QUICK, landing_s=0.05, slowest=2.5 / 20.0)  # from the ceiling of 2.5 m it takes 20 s
    run_and_break(body, timing=slow)
    assert body.steps <= 0


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
    body, landed = Airborne(), threading.Event()
    land = body.land

    def told(rows: Sequence[int]) -> None:
        land(rows)
        landed.set()

    body.land, body.looks = told, lambda: landed.wait(10.0)
    run_and_break(body, silence_s=0.1)
    assert landed.is_set()
    assert body.order == ["open", "land", "stop", "close"]


def test_call_all_raises_the_last_error():
    made = []

    def call(what: str, *, fails: bool = False) -> None:
        made.append(what)
        if fails:
            raise OSError(what)

    with pytest.raises(OSError, match="three") as error:
        call_all([lambda: call("one", fails=True), lambda: call("two"), lambda: call("three", fails=True)])
    assert made == ["one", "two", "three"]
    assert str(error.value.__context__) == "one"


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
