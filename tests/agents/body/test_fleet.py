"""Several bodies in one process look like one."""

from math import isnan, nan

import pytest

from agents.body import fleet
from agents.body.fleet import Fleet, assemble
from agents.body.interface import Body, BodyError, BodyState
from agents.network.messages import Inspection
from agents.plugins import registry
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, RobotTable
from experiments.definition.plan import Plan
from twins.body import TwinBody


class Recorded(Body):
    """A body that writes down what it is told; its state tells its rows apart."""

    def __init__(self, label, rows, *, broken=False):
        self.label, self.rows, self.broken, self.told = label, rows, broken, []

    def open(self):
        if self.broken:
            raise BodyError("plug it in")
        self.told.append("open")

    def read(self, t):
        own = [self.label + row for row in range(self.rows)]
        return [BodyState(x + t, (x, x, x), (-x, -x, -x), x, flying=x > self.label) for x in own]

    def command(self, setpoints):
        self.told.append(("command", [setpoint[0] for setpoint in setpoints]))

    def takeoff(self, rows, heights):
        self.told.append(("takeoff", rows, heights))

    def land(self, rows):
        self.told.append(("land", rows))

    def stop(self, rows):
        self.told.append(("stop", rows))

    def locate(self, row, t, position, yaw):
        self.told.append(("locate", row, t, position, yaw))

    def close(self):
        self.told.append("close")


def interleaved():
    a, b = Recorded(10.0, 2), Recorded(20.0, 3)
    return Fleet([((1, 3), a), ((0, 2, 4), b)]), a, b


def test_states_stand_at_their_rows():
    both, _, _ = interleaved()
    states = both.read(0.5)
    assert [state.yaw for state in states] == [20, 10, 21, 11, 22]
    assert [state.time for state in states] == [20.5, 10.5, 21.5, 11.5, 22.5]
    assert [state.position[2] for state in states] == [20, 10, 21, 11, 22]
    assert [state.flying for state in states] == [False, False, True, True, True]


def test_external_pose_reaches_body_of_its_row():
    both, a, b = interleaved()
    both.locate(4, 1.5, (1.0, 2.0, 3.0), 0.5)
    both.locate(1, 1.6, (4.0, 5.0, 6.0), nan)
    assert b.told == [("locate", 2, 1.5, (1.0, 2.0, 3.0), 0.5)]
    (*told, yaw) = a.told[0]
    assert told == ["locate", 0, 1.6, (4.0, 5.0, 6.0)]
    assert isnan(yaw)


def test_bodies_are_told_of_their_rows():
    both, a, b = interleaved()
    both.open()
    both.command([(4.0 * row, 0.0, 0.0, 0.0) for row in range(5)])
    both.takeoff([0, 3], [0.5, 0.7])
    both.land([4, 2])
    both.stop([1])
    both.close()
    assert a.told == ["open", ("command", [4, 12]), ("takeoff", [1], [0.7]), ("stop", [0]), "close"]
    assert b.told == ["open", ("command", [0, 8, 16]), ("takeoff", [0], [0.5]), ("land", [2, 1]), "close"]


def test_failed_opening_closes_the_others():
    a, b, c = Recorded(0.0, 1), Recorded(1.0, 1, broken=True), Recorded(2.0, 1)
    with pytest.raises(BodyError, match="plug it in"):
        Fleet([((k,), body) for k, body in enumerate((a, b, c))]).open()
    assert (a.told, b.told, c.told) == (["open", "close"], [], [])


@pytest.mark.parametrize("what", ["land", "stop", "close"])
def test_failing_body_keeps_no_other_from_orders(what):
    both, a, b = interleaved()

    def fails(*_):
        raise OSError("its link is gone")

    setattr(a, what, fails)
    with pytest.raises(OSError, match="its link is gone"):
        getattr(both, what)(*([] if what == "close" else [range(5)]))
    assert b.told == (["close"] if what == "close" else [(what, [0, 1, 2])])


def request(*addresses):
    robots = {
        f"R{k}": RobotTable(kind="crazyflie" if k == 1 else "khepera4", start=[0.5 * k, 0.0], body=address, hover=0.5)
        for k, address in enumerate(addresses)
    }
    return bodies.body_request(Plan(Experiment(title="Bodies", robots=robots, duration_s=1.0)), tuple(robots), 7)


def test_addresses_choose_the_bodies(monkeypatch):
    asked = []

    def load(group, name):
        def opened(part):
            asked.append((group, name, part.names, part.addresses, [x for x, _, _ in part.start]))
            return Recorded(0.0, len(part.names))

        return opened

    wanted = request("radio://0/80", "twin", "radio://0/81")
    monkeypatch.setattr(fleet.registry, "load", load)
    assemble(wanted)
    assert asked == [
        (registry.BODIES, "radio", ("R0", "R2"), ("radio://0/80", "radio://0/81"), [0.0, 1.0]),
        (registry.BODIES, "twin", ("R1",), ("twin",), [0.5]),
    ]


def test_twins_share_one_body():
    both = assemble(request("twin", "twin", "twin"))
    assert len(both.read(0.0)) == 3
    assert isinstance(both, TwinBody)


def test_an_unknown_body_is_named():
    with pytest.raises(registry.UnknownPlugin, match="hovercraft"):
        assemble(request("hovercraft://1"))


class Told(Recorded):
    """A body that knows the firmware of its rows."""

    def inspect(self, row):
        return Inspection(firmware=f"{self.label:g}.{row}")


def test_rows_are_inspected_by_their_bodies():
    both = Fleet([((0, 2), Told(7.0, 2)), ((1,), Recorded(1.0, 1))])
    assert [both.inspect(row) for row in range(3)] == [Inspection("7.0"), Inspection(), Inspection("7.1")]
