"""Life of a robot under any orders in any order: phases only grow, DONE is the end, every refusal has its reason."""

from math import nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING, Lifecycle, Phase, Standing
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from tests.cases import examples, for_each

DT, HOVER = 0.1, 0.8
ORDERS = ("takeoff", "start", "start late", "land", "stop", "nothing", "nothing")


class Life:
    """A body as simple as can be: a ramp up, a ramp down, a wheel that stops at once."""

    def __init__(self, flies=True, duration=5.0):
        self.flies = flies
        self.life = Lifecycle(CRAZYFLIE if flies else KHEPERA4, HOVER if flies else nan, duration)
        self.height, self.speed, self.climb, self.flying, self.ready = 0.0, (0.0, 0.0, 0.0), 0.0, False, True
        self.tick, self.told = 0, []

    @property
    def t(self):
        return self.tick * DT

    def step(self):
        """One tick of the life, then of the body, which gets its commands in the order of the runtime."""
        life = self.life
        life.advance(self.t, (0.0, 0.0, self.height), self.speed, flying=self.flying, ready=self.ready)
        due = [name for name in ("takeoff", "land", "stop") if getattr(life, f"{name}_due")]
        life.takeoff_due = life.land_due = life.stop_due = False
        self.told += due
        if "stop" in due:
            self.flying, self.climb = False, 0.0
        if "land" in due:
            self.climb = -0.4
        if "takeoff" in due and self.flies:
            self.flying, self.climb = True, 0.4
        height = min(max(self.height + DT * self.climb * self.flying, 0.0), HOVER)
        if self.flies:
            self.speed = (0.0, 0.0, (height - self.height) / DT)
        self.height = height
        self.flying = self.flying and (height > 0.0 or self.climb > 0.0)
        self.tick += 1
        return self

    def until(self, phase):
        for _ in range(100):
            if self.life.phase == phase:
                return self
            self.step()
        raise AssertionError(f"never {phase!r}, but {self.life.phase}")

    def order(self, order):
        """Reason of a refusal; empty if there was none."""
        orders = {
            "takeoff": self.life.takeoff,
            "start": lambda: self.life.start(self.t + 0.3),
            "start late": lambda: self.life.start(self.t - 0.5),
            "land": lambda: self.life.land("land"),
            "land again": lambda: self.life.land("again"),
            "stop": lambda: self.life.stop("stop"),
            "nothing": str,
        }
        return orders[order]() or ""


@pytest.mark.slow
@examples(100)
@given(st.booleans(), st.lists(st.tuples(st.sampled_from(ORDERS), st.integers(0, 12)), max_size=25), st.booleans())
def test_any_orders_in_any_order(flies, orders, ready):
    robot = Life(flies, duration=1.0)
    robot.ready, life = ready, robot.life
    before = life.phase
    for order, wait in orders:
        phase = life.phase
        refusal = robot.order(order)
        if order == "takeoff":
            assert (refusal == "") == (phase in (READY, AIRBORNE, RUNNING))
        elif order.startswith("start"):
            assert (refusal == "") == (phase in (AIRBORNE, RUNNING))
        assert refusal == "" or Phase(phase).word in refusal
        for _ in range(wait):
            robot.step()
            assert life.phase >= before
            assert life.moved == (life.phase != before)
            assert not (robot.flying and life.phase == DONE and robot.climb > 0.0)
            before = life.phase
    life.land("the end")
    for _ in range(60):
        robot.step()
    assert (life.phase, robot.flying, bool(life.reason)) == (DONE, False, True)
    assert robot.height == 0.0 or "stop" in dict(orders)


@pytest.mark.parametrize("flies", [True, False])
def test_whole_life(flies):
    robot = Life(flies, duration=2.0)
    life = robot.life
    assert life.takeoff() == "cannot take off while idle"
    robot.step()
    assert (life.phase, life.active) == (READY, False)
    assert life.start(1.0) == "cannot start while ready"
    assert life.takeoff() == life.takeoff() == ""  # an order may be repeated when its reply was lost
    assert life.active
    assert robot.step().told == ["takeoff"]
    assert robot.until(AIRBORNE).height == pytest.approx(HOVER if flies else 0.0)
    assert life.active
    begin = robot.t + 0.5
    assert life.start(begin) == ""
    assert robot.until(RUNNING).tick - 1 == round(begin / DT)
    assert life.active
    assert robot.until(LANDING).tick - 1 == round((begin + 2.0) / DT)
    assert (life.active, life.in_motion) == (False, True)
    assert robot.until(DONE).told == ["takeoff", "land"]
    assert life.reason == "finished"
    assert life.takeoff() == "cannot take off while done: finished"
    assert life.start(9.0) == "cannot start while done"


def life_aloft(*, flies=True):
    robot = Life(flies).step()
    robot.life.takeoff()
    return robot.until(AIRBORNE)


def test_start_in_the_past_joins_or_lands():
    robot = life_aloft()
    begin = robot.t - 3.0
    robot.life.start(begin)
    assert robot.step().life.phase == RUNNING
    assert robot.until(LANDING).tick - 1 == round((begin + 5.0) / DT)
    late = life_aloft()
    late.life.start(late.t - 99.0)
    assert late.until(DONE).life.reason == "finished"


def test_orders_in_one_tick():
    for phase, orders, told, reason in (
        (READY, ["takeoff", "land"], ["land"], "land"),  # in one tick
        (READY, ["takeoff", "stop"], ["stop"], "stop"),
        (AIRBORNE, ["land", "stop"], ["takeoff", "stop"], "stop"),
        (AIRBORNE, ["land", "land again"], ["takeoff", "land"], "land"),
    ):
        robot = life_aloft() if phase == AIRBORNE else Life().step()
        for order in orders:
            robot.order(order)
        robot.step().until(DONE)
        assert (robot.told, robot.flying, robot.life.reason) == (told, False, reason)


@for_each("speeds, phases", [((nan, nan), (LANDING, DONE)), ((0.2, 0.2, 0.05), (LANDING, LANDING, DONE))])
def test_wheels_are_done_when_they_stand(speeds, phases):
    robot = life_aloft(flies=False)
    robot.life.land("told to")
    for speed, phase in zip(speeds, phases, strict=True):
        robot.speed = (speed, 0.0, 0.0)
        assert robot.step().life.phase == phase


def test_idle_and_ready_follow_what_is_missing():
    robot = Life()
    life = robot.life
    for missing in ("never received KH01", "its battery is low"):
        robot.ready = False
        life.set_missing(missing)
        robot.step()
        assert (life.phase, life.reason) == (IDLE, missing)
        assert life.takeoff() == f"cannot take off while idle: {missing}"
        robot.ready = True
        robot.step()
        assert (life.phase, life.reason, life.moved) == (READY, "", True)
    life.set_missing("too late to say")
    assert life.reason == ""
    life.failing = "it is being lifted"
    assert life.takeoff() == "cannot take off now: it is being lifted"
    life.failing = ""
    assert life.takeoff() == ""
    robot.ready = False  # what is missing while it climbs changes nothing
    life.set_missing("its battery is low")
    assert robot.until(AIRBORNE).life.reason == ""


@pytest.mark.parametrize(
    ("speed", "noise", "stands"),
    [
        (0.0, 0.0, True),
        (0.05, 0.0, False),  # a robot that drives on slowly was told to have stopped
        (0.03, 0.0, False),
        (0.0, 0.05, True),  # a velocity that positions were made into
        (0.2, 0.0, False),
        (0.0, nan, True),
    ],
)
def test_wheels_stand_when_their_place_stays(speed, noise, stands):
    standing = Standing()
    found = [
        standing.stands(t, (speed * t, 0.0, 0.0), (speed + (-1) ** tick * noise, 0.0, 0.0))
        for tick, t in enumerate(0.02 * step for step in range(100))
    ]
    assert found[-1] == stands
    assert any(found) == stands
