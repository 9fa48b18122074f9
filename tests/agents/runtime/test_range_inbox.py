"""Range readings on the network: what is sent is what is heard, nonsense is refused, what is old is forgotten."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import msgspec
import pytest

from agents.body.interface import BodyState, RangeScan
from agents.network import messages, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.runtime import range_inbox
from agents.runtime.range_inbox import RangeInbox
from tests.conftest import RouterProcess

KEYS = Keys()
GOOD = messages.Ranges("KH01", 1000.0, [0.0, 1.5], [0.0, 0.0], [0.25, None])


def scan(t: float, *distance: float) -> RangeScan:
    count = len(distance)
    return RangeScan(t, tuple(k / max(count - 1, 1) for k in range(count)), (0.0,) * count, distance)


def test_sweep_as_a_message() -> None:
    said = range_inbox.message("KH01", 1000.0, scan(2.5, 0.12345678, math.nan, 1.0))
    assert said == messages.Ranges("KH01", 1002.5, [0.0, 0.5, 1.0], [0.0, 0.0, 0.0], [0.123457, None, 1.0])
    validation.check_ranges(said, now=1002.5)


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        ("stamp", math.nan, "stamp nan is impossible"),
        ("stamp", 1006.0, "stamp 1006.0 is impossible"),
        ("distance", [0.25], "differ in number"),
        ("distance", [0.25, math.inf], "a distance is not between 0 and 100 m"),
        ("distance", [-0.1, None], "a distance is not between 0 and 100 m"),
        ("distance", [], "0 rays; a sweep has 1 to 720"),
        ("distance", [1.0] * 721, "721 rays; a sweep has 1 to 720"),
        ("bearing", [0.0, math.nan], "no angle in radians"),
        ("bearing", [0.0, 90.0], "no angle in radians"),
        ("elevation", [0.0, 0.0, 0.0], "differ in number"),
    ],
)
def test_impossible_readings_are_refused(field: str, value: object, why: str) -> None:
    validation.check_ranges(GOOD, now=1000.0)
    with pytest.raises(messages.Malformed, match=why):
        validation.check_ranges(msgspec.structs.replace(GOOD, **{field: value}), now=1000.0)


@pytest.mark.system
def test_newest_sweep_is_known_until_old(
    router: RouterProcess, eventually: Callable[[Callable[[], object]], None]
) -> None:
    with network.open_session([router.endpoint], name="test") as session:
        listener = RangeInbox(session, KEYS, ("CF01", "KH01"), [1])
        utc = time.time() - 10.0

        def known(at: float) -> RangeScan | None:
            return listener.read(utc, at)[1]

        assert known(10.0) is None

        def say(*distance: float | None, at: float, robot: str = "KH01") -> None:
            angles = [0.0] * len(distance)
            message = messages.Ranges(robot, utc + at, angles, angles, list(distance))
            session.put(KEYS.ranges("KH01"), messages.encode(message), encoding=messages.JSON)

        say(0.5, None, at=10.0)
        eventually(lambda: known(10.0) is not None)
        first = known(10.0)
        assert first is not None
        assert first.distance == pytest.approx((0.5, math.nan), nan_ok=True)
        assert first.time == pytest.approx(10.0, abs=1e-6)
        assert known(10.5) is first, "nothing new costs nothing"
        states = [BodyState(), BodyState()]
        listener.replace_scans(states, utc, 10.5)
        assert [state.scan for state in states] == [None, first]
        say(0.7, 0.8, at=9.5)  # overtaken
        say(0.7, 0.8, at=10.2, robot="CF01")
        say(0.9, at=10.2)
        eventually(lambda: len((known(10.2) or first).distance) == 1)
        assert listener.malformed == 1
        assert listener.trouble == "ranges of 'CF01' on the key of 'KH01'"
        assert known(11.3) is None, "a second later it says nothing of where things are"
