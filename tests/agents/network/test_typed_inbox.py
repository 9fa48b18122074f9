"""Typed inboxes: what is decoded, checked, counted and passed on."""

import pytest

from agents.network import messages, pubsub
from agents.network.keys import Keys
from tests.network import Channel, Net, Query, Sample

KEYS = Keys("park")


def add(channel, robot, seq=1, of=None):
    """An order to stop a robot, on its key or on that `of` another one."""
    command = messages.Command(robot, seq, 1.0, "stop")
    channel.add(Sample(KEYS.setpoint(of or robot), messages.JSON, messages.encode(command)))


def odd(command):
    if command.seq % 2 == 0:
        raise messages.Malformed("an even number")


def test_inbox_passes_valid_messages_and_counts_the_rest():
    channel, refused = Channel(KEYS.setpoint("*")), []
    inbox = pubsub.Inbox(channel, messages.Command, keys=KEYS, on_refusal=lambda *refusal: refused.append(refusal))
    assert list(inbox.read()) == []
    add(channel, "A")
    add(channel, "B", of="A")
    add(channel, "B", 2)
    channel.add(Sample(KEYS.setpoint("B"), messages.JSON, b"{}"))
    channel.add(Sample(KEYS.setpoint("C"), messages.JSON, b"not decoded"))
    add(channel, "B", 3)
    read = list(inbox.read_samples(odd, lambda key: key != KEYS.setpoint("C")))
    assert [(command.robot, command.seq, str(sample.key_expr)) for command, sample in read] == [
        ("A", 1, KEYS.setpoint("A")), ("B", 3, KEYS.setpoint("B")),
    ]  # fmt: skip
    assert inbox.malformed == len(refused) == 3
    assert refused[:2] == [
        (KEYS.setpoint("A"), "command of 'B' on the key of 'A'"), (KEYS.setpoint("B"), "an even number"),
    ]  # fmt: skip
    assert refused[2] == (KEYS.setpoint("B"), inbox.trouble)
    assert list(inbox.read()) == []


def test_messages_of_other_robots_are_left_out():
    channel = Channel(KEYS.setpoint("*"))
    inbox = pubsub.Inbox(channel, messages.Command, keys=KEYS, robots={"A"})
    add(channel, "B")
    add(channel, "A")
    assert [command.robot for command in inbox.read()] == ["A"]
    assert inbox.malformed == 0


@pytest.fixture
def orders():
    """Orders to A, and what asks them."""
    net = Net()
    made = pubsub.Orders(net.session, KEYS.order("A"), messages.Order)

    def ask(payload, times=1, encoding="json"):
        for _ in range(times):
            query = Query(KEYS.order("A"), messages.MIME[encoding], payload)
            net.channels[0].add(query)
        return query

    return made, ask


@pytest.mark.parametrize("payload", [b"{}", b"nonsense", b'{"order": "fly"}'])
def test_a_malformed_order_is_answered_and_counted(payload, orders):
    orders, ask = orders
    wrong, right = ask(payload), ask(b'{"order": "land"}')
    assert list(orders.read()) == [(right, messages.Order("land"))]
    assert (wrong.answers, right.answers, orders.malformed) == (1, 0, 1)


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
@pytest.mark.parametrize("order", ["land", "stop"])
def test_flood_of_queries_displaces_no_landing(order, encoding, orders):
    orders, ask = orders
    start, ends, hold = (messages.encode(messages.Order(name), encoding) for name in ("start", order, "hold"))
    ask(start, 5, encoding)
    ask(ends, 1, encoding)
    ask(hold, 40, encoding)
    assert len(orders.waiting) == pubsub.ORDERS
    assert [given.order for _, given in orders.read()] == [order] + ["hold"] * (pubsub.ORDERS - 1)
    ask(ends, 40, encoding)
    ask(hold, 40, encoding)
    assert [given.order for _, given in orders.read()] == [order] * pubsub.ORDERS
