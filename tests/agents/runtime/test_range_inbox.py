"""Range readings on the network: what is sent is what is heard, and what is old is forgotten."""

import time
from math import nan

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.network import messages, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.runtime import range_inbox
from agents.runtime.range_inbox import RangeInbox

KEYS = Keys()


def test_sweep_as_a_message():
    scan = RangeScan(2.5, (0.0, 0.5, 1.0), (0.0,) * 3, (0.12345678, nan, 1.0))
    ranges = range_inbox.message("KH01", 1000.0, scan)
    assert ranges == messages.Ranges("KH01", 1002.5, [0.0, 0.5, 1.0], [0.0, 0.0, 0.0], [0.123457, None, 1.0])
    validation.check_ranges(ranges, now=1002.5)


@pytest.mark.system
def test_newest_sweep_is_known_until_old(router, eventually):
    with network.open_session([router.endpoint], name="test") as session:
        inbox = RangeInbox(session, KEYS, ("CF01", "KH01"), [1])
        utc = time.time() - 10.0

        def known(at):
            return inbox.read(utc, at)[1]

        def send(*distance, at, robot="KH01"):
            angles = [0.0] * len(distance)
            message = messages.Ranges(robot, utc + at, angles, angles, list(distance))
            session.put(KEYS.ranges("KH01"), messages.encode(message), encoding=messages.JSON)

        assert known(10.0) is None
        send(0.5, None, at=10.0)
        eventually(lambda: known(10.0) is not None)
        first = known(10.0)
        assert first.distance == pytest.approx((0.5, nan), nan_ok=True)
        assert first.time == pytest.approx(10.0, abs=1e-6)
        assert known(10.5) is first, "nothing new costs nothing"
        states = [BodyState(), BodyState()]
        inbox.replace_scans(states, utc, 10.5)
        assert [state.scan for state in states] == [None, first]
        send(0.7, 0.8, at=9.5)  # overtaken
        send(0.7, 0.8, at=10.2, robot="CF01")
        send(0.9, at=10.2)
        eventually(lambda: len((known(10.2) or first).distance) == 1)
        assert (inbox.malformed, inbox.trouble) == (1, "ranges of 'CF01' on the key of 'KH01'")
        assert known(11.3) is None, "a second later it says nothing of where things are"
