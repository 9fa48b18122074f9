"""Several bodies in one process look like one."""

from dataclasses import replace

import numpy as np
import pytest

from agents.body import fleet
from agents.body.fleet import Fleet, assemble
from agents.body.interface import BodyError, BodyState, inspect
from agents.network.messages import Inspection
from agents.plugins import registry
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, Robot
from twins.body import TwinBody


class Recorded:
    """A body that writes down what it is told; its state tells its rows apart."""

    def __init__(self, label, rows, *, broken=False):
        self.label, self.rows, self.broken, self.told = label, rows, broken, []

    def open(self):
        if self.broken:
            raise BodyError("plug it in")
        self.told.append("open")

    def read(self, t):
        own = self.label + np.arange(self.rows, dtype=float)
        vector = np.repeat(own[:, None], 3, axis=1)
        return BodyState(own + t, vector, -vector, own, vector, own, own, own > self.label)

    def command(self, setpoint):
        self.told.append(("command", setpoint[:, 0].tolist()))

    def takeoff(self, rows, height):
        self.told.append(("takeoff", rows.tolist(), height.tolist()))

    def land(self, rows):
        self.told.append(("land", rows.tolist()))

    def stop(self, rows):
        self.told.append(("stop", rows.tolist()))

    def locate(self, row, t, position, yaw):
        self.told.append(("locate", row, t, position.tolist(), yaw))

    def close(self):
        self.told.append("close")


def interleaved():
    a, b = Recorded(10.0, 2), Recorded(20.0, 3)
    return Fleet(5, [(np.array([1, 3]), a), (np.array([0, 2, 4]), b)]), a, b


def test_states_are_put_where_their_rows_are():
    both, _, _ = interleaved()
    state = both.read(0.5)
    assert state.yaw.tolist() == [20, 10, 21, 11, 22]
    assert state.time.tolist() == [20.5, 10.5, 21.5, 11.5, 22.5]
    assert state.position[:, 2].tolist() == [20, 10, 21, 11, 22]
    assert state.flying.tolist() == [False, False, True, True, True]
    assert state.flying.dtype == bool


def test_a_pose_from_outside_reaches_the_body_of_its_row():
    both, a, b = interleaved()
    both.locate(4, 1.5, np.array([1.0, 2.0, 3.0]), 0.5)
    both.locate(1, 1.6, np.array([4.0, 5.0, 6.0]), np.nan)
    assert b.told == [("locate", 2, 1.5, [1.0, 2.0, 3.0], 0.5)]
    assert a.told[0][:4] == ("locate", 0, 1.6, [4.0, 5.0, 6.0])


def test_what_some_bodies_say_of_their_rows_stands_at_their_rows():
    both, _, b = interleaved()
    assert both.read(0.0).notes == ()
    plain = b.read
    b.read = lambda t: replace(plain(t), notes=("locked", "", "tumbled"), refusals=("", "", "upside down"))
    assert both.read(0.0).notes == ("locked", "", "", "", "tumbled")
    assert both.read(0.0).refusals == ("", "", "", "", "upside down")


def test_each_body_is_told_what_concerns_its_rows():
    both, a, b = interleaved()
    both.open()
    both.command(np.arange(20.0).reshape(5, 4))
    both.takeoff(np.array([0, 3]), np.array([0.5, 0.7]))
    both.land(np.array([4, 2]))
    both.stop(np.array([1]))
    both.close()
    assert a.told == ["open", ("command", [4, 12]), ("takeoff", [1], [0.7]), ("stop", [0]), "close"]
    assert b.told == ["open", ("command", [0, 8, 16]), ("takeoff", [0], [0.5]), ("land", [2, 1]), "close"]


def test_when_one_cannot_be_opened_the_others_are_closed_again():
    a, b, c = Recorded(0.0, 1), Recorded(1.0, 1, broken=True), Recorded(2.0, 1)
    with pytest.raises(BodyError, match="plug it in"):
        Fleet(3, [(np.array([k]), body) for k, body in enumerate((a, b, c))]).open()
    assert (a.told, b.told, c.told) == (["open", "close"], [], [])


@pytest.mark.parametrize("what", ["land", "stop", "close"])
def test_one_that_fails_keeps_nobody_from_being_told(what):
    both, a, b = interleaved()

    def fails(*_):
        raise OSError("its link is gone")

    setattr(a, what, fails)
    with pytest.raises(OSError, match="its link is gone"):
        getattr(both, what)(*([] if what == "close" else [np.arange(5)]))
    assert b.told == (["close"] if what == "close" else [(what, [0, 1, 2])])


def request(*addresses):
    robots = {
        f"R{k}": Robot(kind="crazyflie" if k == 1 else "khepera4", start=[0.5 * k, 0.0], body=address, hover=0.5)
        for k, address in enumerate(addresses)
    }
    return bodies.body_request(Experiment(title="Bodies", robots=robots, duration_s=1.0), tuple(robots), [7])


def test_addresses_choose_the_bodies(monkeypatch):
    asked = []

    def load(group, name):
        def opened(part):
            asked.append((group, name, part.names, part.addresses, part.start[:, 0].tolist()))
            return Recorded(0.0, len(part.names))

        return opened

    monkeypatch.setattr(fleet.registry, "load", load)
    assemble(request("radio://0/80", "twin", "radio://0/81"))
    assert asked == [
        (registry.BODIES, "radio", ("R0", "R2"), ("radio://0/80", "radio://0/81"), [0.0, 1.0]),
        (registry.BODIES, "twin", ("R1",), ("twin",), [0.5]),
    ]


def test_twins_share_one_body():
    both = assemble(request("twin", "twin", "twin"))
    assert both.read(0.0).position.shape == (3, 3)
    assert isinstance(both, TwinBody)


def test_an_unknown_body_is_named():
    with pytest.raises(registry.UnknownPlugin, match="hovercraft"):
        assemble(request("hovercraft://1"))


class Told(Recorded):
    """A body that knows the firmware of its rows."""

    def inspect(self, row):
        return Inspection(firmware=f"{self.label:g}.{row}")


def test_each_row_is_inspected_by_its_own_body_and_a_body_that_cannot_says_nothing():
    both = Fleet(3, [(np.array([0, 2]), Told(7.0, 2)), (np.array([1]), Recorded(1.0, 1))])
    assert [inspect(both, row) for row in range(3)] == [Inspection("7.0"), Inspection(), Inspection("7.1")]
