"""Several bodies in one process look like one; a twin beside a robot is never in its way."""

from functools import partial
from math import inf, isfinite, isnan, nan

import pytest

from agents.body import fleet
from agents.body.fleet import Fleet, assemble
from agents.body.interface import Body, BodyError, BodyState, Disturbance
from agents.body.shadow_twin import Shadowed, shadowed
from agents.network.messages import Inspection
from agents.plugins import registry
from agents.vectors import NO_SETPOINT, UNKNOWN, ZERO
from tests.cases import for_each
from tests.requests import request
from twins.body import TwinBody


class Recorded:
    """Robots that move along x as told, at a `share` of the speed.

    Attributes:
        told: Calls with their arguments, one after the other.
        placed: Moments and arguments of `place`.
        broken: The method that raises `failure`.
    """

    def __init__(self, rows, *, share=1.0, start=0.0):
        self.x, self.yaw = [start + row for row in range(rows)], [0.0] * rows
        self.speed, self.flying = [0.0] * rows, [False] * rows
        self.share, self.t = share, 0.0
        self.told, self.placed = [], []
        self.note = self.broken = ""
        self.failure = BodyError

    def _tell(self, what, *arguments):
        self._fail(what)
        self.told.append((what, *arguments) if arguments else what)

    def _fail(self, what):
        if self.broken == what:
            raise self.failure("no engine")

    def __getattr__(self, what):
        """A call that is written down: open, takeoff, land, stop, locate, close."""
        return partial(self._tell, what)

    def read(self, t):
        self._fail("read")
        self.x = [x + (t - self.t) * self.share * speed for x, speed in zip(self.x, self.speed, strict=True)]
        self.t = t
        return [
            BodyState(t, (x, 0.0, 0.0), (speed, 0.0, 0.0), yaw, flying=flying, note=self.note)
            for x, speed, yaw, flying in zip(self.x, self.speed, self.yaw, self.flying, strict=True)
        ]

    def command(self, setpoints):
        self._tell("command", [setpoint[0] for setpoint in setpoints])
        self.speed = [new[0] if isfinite(new[0]) else old for new, old in zip(setpoints, self.speed, strict=True)]

    def inspect(self, row):
        return Inspection(firmware=f"7.{row}")

    def place(self, rows, positions, yaws, flying, velocities=None):
        self._fail("place")
        self.placed.append((round(self.t, 6), flying))
        for row, (x, _, _), yaw in zip(rows, positions, yaws, strict=True):
            self.x[row], self.yaw[row] = x, yaw


def interleaved():
    a, b = Recorded(2, start=10.0), Recorded(3, start=20.0)
    return Fleet([((1, 3), a), ((0, 2, 4), b)]), a, b


def test_states_stand_at_their_rows():
    both, a, b = interleaved()
    a.yaw, b.flying = [0.1, 0.3], [False, True, True]
    states = both.read(0.5)
    assert [state.position[0] for state in states] == [20, 10, 21, 11, 22]
    assert [state.time for state in states] == [0.5] * 5
    assert [state.yaw for state in states] == [0.0, 0.1, 0.0, 0.3, 0.0]
    assert [state.flying for state in states] == [False, False, True, False, True]
    assert [both.inspect(row).firmware for row in range(5)] == ["7.0", "7.0", "7.1", "7.1", "7.2"]


def test_bodies_are_told_of_their_rows():
    both, a, b = interleaved()
    both.open()
    both.command([(4.0 * row, 0.0, 0.0, 0.0) for row in range(5)])
    both.takeoff([0, 3], [0.5, 0.7])
    both.land([4, 2])
    both.stop([1])
    both.locate(4, 1.5, (1.0, 2.0, 3.0), 0.5)
    both.close()
    assert a.told == ["open", ("command", [4, 12]), ("takeoff", [1], [0.7]), ("stop", [0]), "close"]
    assert b.told == [
        "open", ("command", [0, 8, 16]), ("takeoff", [0], [0.5]), ("land", [2, 1]),
        ("locate", 2, 1.5, (1.0, 2.0, 3.0), 0.5), "close",
    ]  # fmt: skip


def test_failed_opening_closes_the_others():
    a, b, c = Recorded(1), Recorded(1), Recorded(1)
    b.broken = "open"
    with pytest.raises(BodyError, match="no engine"):
        Fleet([((k,), body) for k, body in enumerate((a, b, c))]).open()
    assert (a.told, b.told, c.told) == (["open", "close"], [], [])


@for_each("what", ["land", "stop", "close"])
def test_failing_body_keeps_no_other_from_orders(what):
    both, a, b = interleaved()
    a.broken = what
    with pytest.raises(BodyError, match="no engine"):
        getattr(both, what)(*([] if what == "close" else [range(5)]))
    assert b.told == (["close"] if what == "close" else [(what, [0, 1, 2])])


def test_addresses_choose_the_bodies(monkeypatch):
    asked, loaded = [], registry.load

    def load(group, name):
        if group != registry.BODIES:
            return loaded(group, name)

        class Asked(Recorded):
            faults, device_of = staticmethod(Body.faults), staticmethod(Body.device_of)

            def __init__(self, part):
                asked.append((group, name, part.names, part.addresses, [y for _, y, _ in part.start]))
                super().__init__(len(part.names))

        return Asked

    assert isinstance(assemble(request(["tello", "khepera4"])), TwinBody), "twins share one body"
    monkeypatch.setattr(fleet.registry, "load", load)
    assemble(request(["crazyflie"] * 3, ["radio://0/80", "twin", "radio://0/81"]))
    assert asked == [
        (registry.BODIES, "radio", ("R0", "R2"), ("radio://0/80", "radio://0/81"), [0.0, 2.0]),
        (registry.BODIES, "twin", ("R1",), ("twin",), [1.0]),
    ]


DT = 0.1


def beside(rows=1, shadows=(0,), restart=inf, *, share=1.0):
    robot, twin = Recorded(rows), Recorded(len(shadows), share=share)
    return Shadowed(robot, twin, shadows, [restart] * len(shadows)), robot, twin


def speeds(*values):
    """Setpoints that say how fast to go along x."""
    return [(value, 0.0, 0.0, 0.0) for value in values]


@pytest.mark.parametrize(("restart", "placed"), [(1.0, [0.0, 0.1, 1.1, 2.1]), (inf, [0.0, 0.1])])
def test_faster_twin_runs_ahead_until_put_back(restart, placed):
    body, _, twin = beside(restart=restart, share=1.1)
    ahead = []
    for k in range(31):
        (state,) = body.read(k * DT)
        ahead.append(state.shadow_position[0] - state.position[0])
        body.command(speeds(0.5))
    assert [at for at, _ in twin.placed] == placed  # driven at 0, seen to be driven at 0.1
    since = [k * DT - max((at for at in placed if at < k * DT + 1e-9), default=0.0) for k in range(31)]
    assert ahead == pytest.approx([0.05 * max(seconds, 0.0) for seconds in since], abs=1e-12)


def test_orders_reach_twins_by_their_own_rows():
    body, robot, twin = beside(rows=3, shadows=(0, 2))
    body.open()
    states = body.read(0.0)
    assert states[1].shadow_position is UNKNOWN
    assert [isnan(state.shadow_yaw) for state in states] == [False, True, False]
    body.takeoff([1, 2], [0.5, 0.7])
    body.command(speeds(0.1, 0.2, 0.3))
    body.land([1])
    body.land([2, 0])
    body.stop([0, 1, 2])
    body.locate(2, 0.0, ZERO, 0.0)
    body.close()
    assert robot.told == [
        "open", ("takeoff", [1, 2], [0.5, 0.7]), ("command", [0.1, 0.2, 0.3]), ("land", [1]), ("land", [2, 0]),
        ("stop", [0, 1, 2]), ("locate", 2, 0.0, ZERO, 0.0), "close",
    ]  # fmt: skip
    assert twin.told == [
        "open", ("takeoff", [1], [0.7]), ("command", [0.1, 0.3]), ("land", []), ("land", [1, 0]), ("stop", [0, 1]),
        "close",
    ]  # fmt: skip


def test_restarts_wait_while_standing_or_landing():
    body, robot, twin = beside(restart=0.5)
    robot.flying[0] = True
    for k in range(10):
        body.read(k * DT)
        body.command([NO_SETPOINT] if k % 2 else speeds(0.0))
    assert [at for at, _ in twin.placed] == [0.0]
    body.command(speeds(0.2))
    body.read(1.0)
    body.land([0])
    for k in range(11, 30):
        body.read(k * DT)
    assert twin.placed == [(0.0, [True]), (1.0, [True])]


METHODS = ("open", "read", "place", "command", "takeoff", "land", "stop", "close")
FAILURES = (AssertionError, MemoryError, StopIteration, Exception)


@for_each("what, failure", [(what, BodyError) for what in METHODS] + [("command", failure) for failure in FAILURES])
def test_failing_twin_is_left_alone(what, failure):
    body, robot, twin = beside()
    twin.broken, twin.failure = what, failure
    body.open()
    for k in range(3):
        (state,) = body.read(k * DT)
        assert state.position == ZERO
        if k == 0:
            body.takeoff([0], [1.0])
            body.land([0])
            body.stop([0])
            body.command(speeds(0.0))
    body.close()
    assert robot.told == ["open", ("takeoff", [0], [1.0]), ("land", [0]), ("stop", [0]), ("command", [0.0]), "close"]
    if what != "close":
        assert state.note == f"its shadow failed: {failure.__name__}: no engine"
        assert state.shadow_position is UNKNOWN


def test_troubles_of_the_robot_are_not_hidden():
    body, robot, twin = beside(rows=2, shadows=(1,))
    robot.note = "locked"
    assert [state.note for state in body.read(0.0)] == ["locked"] * 2
    twin.broken = "read"
    assert [state.note for state in body.read(DT)] == ["locked", "locked; its shadow failed: BodyError: no engine"]
    robot.broken = "read"
    with pytest.raises(BodyError, match="no engine"):
        body.read(0.0)


@pytest.mark.parametrize("kind", ["khepera4", "tello"])
def test_twin_is_undisturbed(kind):
    robot = Recorded(2)
    robot.flying = [kind == "tello"] * 2
    asked = request(
        ["crazyflie", kind], "radio://0/80/2M/E7E7E7E701", start=[(0.0, 0.0)] * 2, external=True,
        disturbance=Disturbance(position_sigma=0.1, latency_s=0.1, odometry_drift=0.1), device={"tx_power": 3},
    )  # fmt: skip
    assert shadowed(robot, asked, [nan, nan]) is robot
    body = shadowed(robot, asked, [nan, 1.0])
    for k in range(101):
        first, second = body.read(k / 100)
        body.command([NO_SETPOINT, (0.2, 0.0, 0.0, 0.0)])
    assert first.shadow_position is UNKNOWN
    assert second.position[0] == pytest.approx(1.2)
    # it took over the robot's speed with its place
    assert second.shadow_position == (pytest.approx(1.2), 0.0, 0.0)
