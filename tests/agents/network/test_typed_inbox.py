"""Typed inboxes: what is decoded, checked, counted and passed on."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from agents.network import messages, pubsub
from agents.network.keys import Keys
from tests.network import Channel, Query, Sample, typed_orders

KEYS = Keys("park")


def stop(robot: str, seq: int = 1) -> bytes:
    return messages.encode(messages.Command(robot, seq, 1.0, "stop"))


def odd(command: messages.Command):
    if command.seq % 2 == 0:
        raise messages.Malformed("an even number")


def test_inbox_passes_valid_messages_and_counts_the_rest():
    channel = Channel(KEYS.setpoint("*"))
    refused = []
    inbox = pubsub.Inbox(
        channel, messages.Command, keys=KEYS, on_refusal=lambda key, reason: refused.append((key, reason))
    )
    assert list(inbox.read()) == []
    for key, payload in (
        ("park/A/setpoint", stop("A")),
        ("park/A/setpoint", stop("B")),
        ("park/B/setpoint", stop("B", 2)),
        ("park/B/setpoint", b"{}"),
        ("park/C/setpoint", b"not decoded"),
        ("park/B/setpoint", stop("B", 3)),
    ):
        channel.add(Sample(key, messages.JSON, payload))
    got = [
        (command.robot, command.seq, str(sample.key_expr))
        for command, sample in inbox.read_samples(odd, lambda key: key != "park/C/setpoint")
    ]
    assert got == [("A", 1, "park/A/setpoint"), ("B", 3, "park/B/setpoint")]
    assert inbox.malformed == len(refused) == 3
    assert [key for key, _ in refused] == ["park/A/setpoint", "park/B/setpoint", "park/B/setpoint"]
    assert refused[0][1] == "command of 'B' on the key of 'A'"
    assert refused[1][1] == "an even number"
    assert inbox.trouble == refused[2][1]
    assert list(inbox.read()) == []


def test_messages_of_other_robots_are_left_out():
    channel = Channel(KEYS.setpoint("*"))
    inbox = pubsub.Inbox(channel, messages.Command, keys=KEYS, robots={"A"})
    for robot in "BA":
        channel.add(Sample(KEYS.setpoint(robot), messages.JSON, stop(robot)))
    assert [command.robot for command in inbox.read()] == ["A"]
    assert inbox.malformed == 0


@pytest.mark.parametrize("payload", [b"{}", b"nonsense", b'{"order": "fly"}'])
def test_a_malformed_order_is_answered_and_counted(payload):
    channel = Channel(KEYS.order("A"), asked=True)
    orders = typed_orders(channel, messages.Order)
    channel.add(wrong := Query(KEYS.order("A"), messages.JSON, payload))
    channel.add(right := Query(KEYS.order("A"), messages.JSON, b'{"order": "land"}'))
    assert list(orders.read()) == [(right, messages.Order("land"))]
    assert (wrong.answers, right.answers, orders.malformed) == (1, 0, 1)


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
@pytest.mark.parametrize("order", ["land", "stop"])
def test_flood_of_queries_displaces_no_landing(order, encoding):
    callbacks = []
    session = SimpleNamespace(declare_queryable=lambda _key, callback, **_: callbacks.append(callback))
    orders = pubsub.Orders(session, KEYS.order("A"), messages.Order)

    def ask(name, times=1):
        payload = messages.encode(messages.Order(name), encoding)
        for _ in range(times):
            callbacks[0](Query(KEYS.order("A"), messages.MIME[encoding], payload))

    ask("start", 5)
    ask(order)
    ask("hold", 40)
    assert len(orders.waiting) == pubsub.ORDERS
    assert [given.order for _, given in orders.read()] == [order] + ["hold"] * (pubsub.ORDERS - 1)
    ask(order, 40)
    ask("hold", 40)
    assert [given.order for _, given in orders.read()] == [order] * pubsub.ORDERS
