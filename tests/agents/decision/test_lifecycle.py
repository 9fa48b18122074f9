"""Lives of robots under any orders in any order: phases only grow, DONE is the end, every refusal has its reason."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING, Lifecycle, Phase

DT = 0.1
HOVER = 0.8
ORDERS = ("takeoff", "start", "start late", "land", "stop", "nothing", "nothing")


class Robots:
    """Bodies as simple as can be: a ramp up, a ramp down, a wheel that stops at once."""

    def __init__(self, flies, duration=1.0):
        self.flies = np.array(flies)
        rows = len(flies)
        self.life = Lifecycle(self.flies, np.where(self.flies, HOVER, np.nan), duration)
        self.position, self.velocity = np.zeros((rows, 3)), np.zeros((rows, 3))
        self.flying = np.zeros(rows, dtype=bool)
        self.climb = np.zeros(rows)
        self.ready = np.ones(rows, dtype=bool)
        self.tick = 0
        self.told = []

    @property
    def t(self):
        return self.tick * DT

    def step(self):
        """One tick of the life, then of the bodies, which do their duties in the order in which the runtime does."""
        duties = self.life.advance(self.t, self.ready, self.position, self.velocity, self.flying)
        if duties is not None:
            self.told.append((self.tick, duties))
            self.flying[duties.stop], self.climb[duties.stop] = False, 0.0
            self.climb[duties.land] = -0.4
            up = duties.takeoff[self.flies[duties.takeoff]]
            self.flying[up], self.climb[up] = True, 0.4
        height = np.clip(self.position[:, 2] + DT * self.climb * self.flying, 0.0, HOVER)
        self.velocity[:, 2] = (height - self.position[:, 2]) / DT
        self.position[:, 2] = height
        self.flying &= (height > 0.0) | (self.climb > 0.0)
        self.tick += 1

    def until(self, phase, row=0, most=100):
        for _ in range(most):
            if self.life.phase[row] == phase:
                return
            self.step()
        raise AssertionError(f"never {phase!r}, but {self.life.phase[row]}")

    def order(self, row, order):
        """Why it was refused; empty if it was not."""
        match order:
            case "takeoff":
                return self.life.takeoff(row)
            case "start":
                return self.life.start(row, self.t + 0.3)
            case "start late":
                return self.life.start(row, self.t - 0.5)
            case "land":
                self.life.land(row, "told to")
            case "stop":
                self.life.stop(row, "told to")
        return ""


@pytest.mark.slow
@settings(max_examples=75)
@given(
    st.lists(st.booleans(), min_size=1, max_size=3),
    st.lists(st.tuples(st.sampled_from(ORDERS), st.integers(0, 2), st.integers(0, 12)), max_size=25),
    st.booleans(),
)
def test_any_orders_in_any_order(flies, orders, ready):
    robots = Robots(flies)
    robots.ready[:] = ready
    before = robots.life.phase.copy()
    for order, number, wait in orders:
        row = number % len(flies)
        phase = robots.life.phase[row]
        refusal = robots.order(row, order)
        if order == "takeoff":
            assert (refusal == "") == (phase in (READY, AIRBORNE, RUNNING))
        elif order.startswith("start"):
            assert (refusal == "") == (phase in (AIRBORNE, RUNNING))
        assert refusal == "" or Phase(phase).word in refusal
        for _ in range(wait):
            robots.step()
            assert (robots.life.phase >= before).all()
            assert robots.life.moved == (robots.life.phase != before).any()
            assert not (robots.flying & (robots.life.phase == DONE) & (robots.climb > 0.0)).any()
            before = robots.life.phase.copy()
    for row in range(len(flies)):
        robots.life.land(row, "the end")
    for _ in range(60):
        robots.step()
    assert (robots.life.phase == DONE).all()
    assert not robots.flying.any()
    assert not robots.position[:, 2].any() or any(order == "stop" for order, _, _ in orders)
    assert all(robots.life.reason)


def test_a_whole_life():
    robots = Robots([True, False], duration=2.0)
    life = robots.life
    assert life.waiting
    assert life.takeoff(0) == "cannot take off while idle"
    robots.step()
    assert life.phase.tolist() == [READY, READY]
    assert life.waiting  # what makes it ready may be lost again
    assert life.start(0, 1.0) == "cannot start while ready"
    assert [life.takeoff(row) for row in (0, 1)] == ["", ""]
    assert life.takeoff(0) == ""  # an order may be repeated when its reply was lost
    robots.step()
    (_, duties), *_ = robots.told
    assert (duties.takeoff.tolist(), duties.land.tolist(), duties.stop.tolist()) == ([0, 1], [], [])
    robots.until(AIRBORNE, row=1)
    assert life.phase.tolist() == [READY, AIRBORNE]
    robots.until(AIRBORNE, row=0)
    assert robots.position[0, 2] == pytest.approx(HOVER)
    begin = robots.t + 0.5
    assert [life.start(row, begin) for row in (0, 1)] == ["", ""]
    robots.until(RUNNING)
    assert robots.tick - 1 == round(begin / DT)
    assert life.all_running
    assert not life.waiting
    robots.until(LANDING)
    assert robots.tick - 1 == round((begin + 2.0) / DT)
    assert life.reason == ["finished", "finished"]
    robots.until(DONE)
    assert len(robots.told) == 2
    assert life.takeoff(0) == "cannot take off while done: finished"
    assert life.start(1, 9.0) == "cannot start while done"


def airborne(flies=(True,), duration=5.0):
    robots = Robots(flies, duration)
    robots.step()
    for row in range(len(flies)):
        robots.life.takeoff(row)
    robots.until(AIRBORNE)
    return robots


def test_a_start_in_the_past_joins_what_is_under_way():
    robots = airborne()
    begin = robots.t - 3.0
    robots.life.start(0, begin)
    robots.step()
    assert robots.life.phase[0] == RUNNING
    robots.until(LANDING)
    assert robots.tick - 1 == round((begin + 5.0) / DT)


def test_a_start_after_the_end_lands():
    robots = airborne()
    robots.life.start(0, robots.t - 99.0)
    robots.until(DONE)
    assert robots.life.reason == ["finished"]


def test_land_in_the_same_tick_as_take_off_stays_on_the_ground():
    robots = Robots([True])
    robots.step()
    robots.life.takeoff(0)
    robots.life.land(0, "changed our mind")
    robots.step()
    robots.step()
    (_, duties), *_ = robots.told
    assert (duties.takeoff.tolist(), duties.land.tolist()) == ([], [0])
    assert not robots.flying[0]
    assert robots.life.phase[0] == DONE


def test_stop_in_the_same_tick_as_take_off_stays_on_the_ground():
    robots = Robots([True])
    robots.step()
    robots.life.takeoff(0)
    robots.life.stop(0, "emergency")
    robots.step()
    (_, duties), *_ = robots.told
    assert (duties.takeoff.tolist(), duties.stop.tolist()) == ([], [0])
    assert robots.life.phase[0] == DONE


def test_stop_in_the_tick_of_landing_is_the_last_order():
    robots = Robots([True])
    robots.life.phase[:] = RUNNING
    robots.life.land(0, "ordered to land")
    robots.life.stop(0, "ordered to stop")
    robots.step()
    ((_, duties),) = robots.told
    assert (duties.stop.tolist(), duties.land.tolist()) == ([0], [])


def test_a_second_landing_keeps_the_first_reason():
    robots = airborne()
    robots.life.land(0, "first")
    robots.life.land(0, "second")
    robots.until(DONE)
    assert robots.life.reason == ["first"]
    assert sum(len(duties.land) for _, duties in robots.told) == 1


def test_a_ground_robot_whose_speed_nobody_knows_is_done_when_told_to_land():
    robots = airborne([False])
    robots.velocity[:] = np.nan
    robots.life.land(0, "position lost")
    for _ in range(3):
        robots.life.advance(robots.t, robots.ready, robots.position, robots.velocity, robots.flying)
    assert robots.life.phase[0] == DONE


def test_a_ground_robot_is_done_when_it_stands():
    robots = airborne([False])
    robots.life.land(0, "told to")
    for speed, phase in ((0.2, LANDING), (0.2, LANDING), (0.05, DONE)):
        robots.velocity[0] = [speed, 0.0, 0.0]
        robots.life.advance(robots.t, robots.ready, robots.position, robots.velocity, robots.flying)
        assert robots.life.phase[0] == phase


def test_whoever_climbs_waits_or_runs_is_active():
    robots = Robots([True, True, True, False])
    robots.step()
    for row in (0, 1, 3):
        robots.life.takeoff(row)
    assert robots.life.active.tolist() == [True, True, False, True]
    robots.until(AIRBORNE)
    assert robots.life.active.tolist() == [True, True, False, True]
    robots.life.start(0, robots.t)
    robots.life.land(1, "told to")
    robots.step()
    assert robots.life.phase.tolist() == [RUNNING, LANDING, READY, AIRBORNE]
    assert robots.life.active.tolist() == [True, False, False, True]


def test_an_idle_robot_says_what_it_waits_for():
    robots = Robots([True])
    robots.ready[:] = False
    robots.step()
    robots.life.set_missing(0, "never heard KH01")
    assert robots.life.takeoff(0) == "cannot take off while idle: never heard KH01"
    robots.ready[:] = True
    robots.step()
    assert (robots.life.phase[0], robots.life.reason[0]) == (READY, "")
    robots.life.set_missing(0, "too late to say")
    assert robots.life.reason[0] == ""


def test_phases_have_words():
    assert [phase.word for phase in Phase] == ["idle", "ready", "airborne", "running", "landing", "done"]
    assert (IDLE, READY, AIRBORNE, RUNNING, LANDING, DONE) == (0, 1, 2, 3, 4, 5)


def test_who_was_ready_and_is_not_is_idle_again_unless_it_climbs():
    robots = Robots([True, True, False])
    robots.step()
    assert robots.life.takeoff(1) == ""
    robots.ready[:] = False
    for row in range(3):
        robots.life.set_missing(row, "its battery is low")
    robots.step()
    assert robots.life.phase.tolist() == [IDLE, READY, IDLE]
    assert robots.life.reason == ["its battery is low", "", "its battery is low"]
    assert robots.life.moved
    assert robots.life.takeoff(0) == "cannot take off while idle: its battery is low"
    robots.until(AIRBORNE, row=1)
    robots.ready[:] = True
    robots.step()
    assert robots.life.phase.tolist() == [READY, AIRBORNE, READY]
