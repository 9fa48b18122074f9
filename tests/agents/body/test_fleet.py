"""Several bodies in one process look like one."""

import pytest

from agents.body import fleet
from agents.body.fleet import Fleet, assemble
from agents.body.interface import BodyError
from agents.network.messages import Inspection
from agents.plugins import registry
from experiments.definition import bodies
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from tests.agents.body.recorded import Recorded
from tests.small import small
from twins.body import TwinBody


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


@pytest.mark.parametrize("what", ["land", "stop", "close"])
def test_failing_body_keeps_no_other_from_orders(what):
    both, a, b = interleaved()
    a.broken = what
    with pytest.raises(BodyError, match="no engine"):
        getattr(both, what)(*([] if what == "close" else [range(5)]))
    assert b.told == (["close"] if what == "close" else [(what, [0, 1, 2])])


def request(*addresses):
    robots = {
        f"R{k}": RobotTable(kind="crazyflie" if k == 1 else "khepera4", start=[0.5 * k, 0.0], body=address, hover=0.5)
        for k, address in enumerate(addresses)
    }
    return bodies.body_request(Plan(small(robots)), tuple(robots), 7)


def test_addresses_choose_the_bodies(monkeypatch):
    asked = []

    def load(group, name):
        def opened(part):
            asked.append((group, name, part.names, part.addresses, [x for x, _, _ in part.start]))
            return Recorded(len(part.names))

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


class Inspected(Recorded):
    """A body that knows the firmware of its rows."""

    def inspect(self, row):
        return Inspection(firmware=f"7.{row}")


def test_rows_are_inspected_by_their_bodies():
    both = Fleet([((0, 2), Inspected(2)), ((1,), Recorded(1))])
    assert [both.inspect(row) for row in range(3)] == [Inspection("7.0"), Inspection(), Inspection("7.1")]
