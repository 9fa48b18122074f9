"""Messages on the network are recorded, malformed ones are not."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import pytest

from agents.network import messages, shutdown
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import FAREWELL_S, STOPPED_S
from experiments.real_time.processes.recorder import AFTER_S, Recorder, with_truth
from tests.conftest import RouterProcess
from tests.experiments.recordings import START, state, touched, world_state

KEYS = Keys()


class Taken(list[messages.Message]):
    """In the place of a recording: what would be in it."""

    def write(self, message: messages.Message) -> None:
        self.append(message)


def test_servers_and_recorders_wait_for_the_longest_descent() -> None:
    assert shutdown.AFTER_S == AFTER_S
    assert AFTER_S > 2.0 * FAREWELL_S + STOPPED_S


@pytest.mark.system
def test_recorder_keeps_plausible_messages_of_the_world(
    router: RouterProcess, eventually: Callable[[Callable[[], object]], None]
) -> None:
    lost = messages.ObstaclePose("box", (0.0, math.nan, 0.0))
    said: list[tuple[str, messages.Message]] = [
        (KEYS.contact, msgspec.structs.replace(touched(0.1), impulse=math.nan)),
        (KEYS.contact, msgspec.structs.replace(touched(0.1), stamp=math.inf)),
        (KEYS.contact, world_state(0.1)),
        (KEYS.world, msgspec.structs.replace(world_state(0.1), obstacles=[lost])),
        (KEYS.world, touched(0.1)),
        (KEYS.world, world_state(0.2)),
        (KEYS.contact, touched(0.3)),
    ]
    taken = Taken()
    with (
        network.open_session([router.endpoint], name="recorder") as session,
        network.open_session([router.endpoint], name="world") as other,
    ):
        recorder = Recorder(session, KEYS, taken)  # type: ignore[arg-type]

        def heard() -> bool:
            for key, message in said:
                # MessagePack keeps what is not finite; JSON would say null
                other.put(key, messages.encode(message, "msgpack"), encoding=messages.MSGPACK)
            recorder.receive()
            return {type(message) for message in taken} >= {messages.Contact, messages.WorldState}

        eventually(heard)
    assert set(map(str, taken)) == {str(touched(0.3)), str(world_state(0.2))}
    assert sum(count for count, _ in recorder.unread.values()) >= 5
    taken.clear()
    for last in (False, False, True):  # each once
        recorder.report_malformed(last=last)
    told = [(event.kind, event.source, event.text.split(" on ")[1].split(": ")[0]) for event in taken]
    assert sorted(told) == [("unread", "recorder", key) for key in sorted((KEYS.contact, KEYS.world))]


def test_truth_at_a_state_is_interpolated_between_neighbours() -> None:
    """At 0.5 m/s the newest of 50 truths a second is up to 1 cm away."""
    truths = [
        messages.Position("TB01", START + 0.02 * k, (0.01 * k, 0.0, 0.0), messages.heading(math.pi - 0.05 + 0.02 * k))
        for k in range(10)
    ]
    for at in (0.0, 0.013, 0.0975, 0.18):
        found = with_truth(state(at=at), truths)
        assert found.true_position == pytest.approx((0.5 * at, 0.0, 0.0), abs=1e-6)
        assert math.remainder(found.true_yaw - (math.pi - 0.05 + at), math.tau) == pytest.approx(0.0, abs=1e-6)
    assert with_truth(state(at=0.2), truths).true_position == truths[-1].position
    for at in (-0.06, 0.24):
        assert with_truth(state(at=at), truths).true_position is None
    assert with_truth(state(at=0.0), []).true_position is None
