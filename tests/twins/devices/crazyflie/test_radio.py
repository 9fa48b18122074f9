"""Radio chip of a Crazyflie: safelink, retransmissions, the queue of one exchange per packet, outages."""

import numpy as np
import pytest

from agents.protocols.crazyradio import ACK, QUEUE
from agents.protocols.crtp import Port
from twins.devices.crazyflie.radio import NOTHING, RadioLink
from twins.devices.device import Faults

REQUEST = b"\xff\x05\x01"


class Host:
    """The counters of a client, as cflib keeps them, over exchanges of which the given ones lose their answer."""

    def __init__(self, link):
        self.link, self.up, self.down = link, 0, 0

    def poll(self, packet=b"\xff", *, answered=True):
        """Answer of the drone, or None if it was lost; and the packet that the drone was given."""
        first = packet[0] & 0xF3 | self.up << 3 | self.down << 2
        status, answer, forwarded = self.link.exchange(bytes((first,)) + packet[1:], 3)
        assert status & ACK
        if not answered:
            return None, forwarded
        if (answer[0] & 4) == self.down << 2:
            self.down = 1 - self.down
        self.up = 1 - self.up
        return answer, forwarded


@pytest.fixture
def link():
    return RadioLink(np.random.default_rng(1), Faults(), 0)


def secured(link):
    assert link.exchange(REQUEST, 3)[1] == REQUEST
    return Host(link)


def test_one_packet_down_for_each_exchange(link):
    host = secured(link)
    for number in range(3):
        link.send(Port.LOG, 2, bytes((number,)))
    assert [host.poll()[0][1:] for _ in range(4)] == [b"\0", b"\1", b"\2", NOTHING[1:]]


def test_safelink_loses_and_repeats_nothing(link):
    host = secured(link)
    for number in range(20):
        link.send(Port.LOG, 2, bytes((number,)))
    up, down, sent = [], [], 0
    for attempt in range(60):
        answer, forwarded = host.poll(bytes((0x7C, sent)), answered=attempt % 3 != 0)
        up += [] if forwarded is None else [forwarded[1]]
        sent += answer is not None
        if answer is not None and answer[1:] != NOTHING[1:] and answer[1] not in down:
            down.append(answer[1])
    assert up == list(range(max(up) + 1))
    assert down == list(range(20))


def test_a_client_without_safelink_is_heard_once(link):
    """A drone that still has safelink on drops every packet of a client that has it off as a repetition."""
    secured(link)
    given = [link.exchange(bytes((0x7C, number)), 3)[2] for number in range(5)]
    assert sum(packet is not None for packet in given) <= 1
    assert link.safelink, "it outlives the session"


def test_answers_wait_behind_logs(link):
    host = secured(link)
    for number in range(QUEUE + 30):
        link.send(Port.LOG, 2, bytes((number % 256,)))
    link.send(Port.HIGH_LEVEL, 0, b"answer")
    assert link.dropped == 30
    answers = [host.poll()[0][1:] for _ in range(QUEUE + 1)]
    assert answers.index(b"answer") == QUEUE


def test_an_outage_empties_the_queue_and_ends(link):
    secured(link)
    link.silence(1.5)
    link.send(Port.LOG, 2, b"\0")
    for t, waiting, answered in ((0.9, 1, False), (1.1, 0, False), (1.6, 0, True)):
        link.t = t
        link.send_due()
        assert len(link.queue) == waiting
        assert bool(link.exchange(REQUEST, 3)[0] & ACK) == answered


def test_losses_cost_retransmissions():
    link = RadioLink(np.random.default_rng(1), Faults(loss=0.5), 0)
    results = [link.exchange(bytes((0x7C, number % 256)), 3) for number in range(2000)]
    share = np.mean([bool(status & ACK) for status, _, _ in results])
    assert share == pytest.approx(1.0 - 0.75**4, abs=0.05)
    assert sum(packet is not None for _, _, packet in results) == pytest.approx(2000 * (1.0 - 0.5**4), rel=0.05)
