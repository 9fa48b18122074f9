"""Typed inboxes and orders: what is decoded, checked, counted and passed on; values that nothing can have."""

from functools import partial
from math import inf, nan

import msgspec
import pytest

from agents.network import messages, pubsub, validation
from agents.network.keys import Keys
from agents.network.messages import Command, Goal, Malformed, Order, Pose, Ranges, State
from tests.cases import for_each
from tests.network import Channel, Net, Query, Sample

KEYS = Keys("park")
ORDER = KEYS.order("A")


def add(channel, robot, seq=1, of=None):
    """An order to stop a robot, on its key or on that `of` another one."""
    channel.add(Sample(KEYS.setpoint(of or robot), messages.JSON, messages.encode(Command(robot, seq, 1.0, "stop"))))


def odd(command):
    if command.seq % 2 == 0:
        raise Malformed("an even number")


def test_inbox_passes_valid_messages_and_counts_the_rest():
    channel, refused = Channel(KEYS.setpoint("*")), []
    inbox = pubsub.Inbox(
        channel, Command, keys=KEYS, robots={"A", "B"}, on_refusal=lambda *refusal: refused.append(refusal)
    )
    assert list(inbox.read()) == []
    add(channel, "A")
    add(channel, "B", of="A")
    add(channel, "B", 2)
    channel.add(Sample(KEYS.setpoint("B"), messages.JSON, b"{}"))
    channel.add(Sample(KEYS.setpoint("C"), messages.JSON, b"not decoded"))
    add(channel, "D")
    add(channel, "B", 3)
    read = list(inbox.read_samples(odd, lambda key: key != KEYS.setpoint("C")))
    assert [(command.robot, command.seq, str(sample.key_expr)) for command, sample in read] == [
        ("A", 1, KEYS.setpoint("A")), ("B", 3, KEYS.setpoint("B")),
    ]  # fmt: skip
    assert inbox.malformed == 3
    assert refused == [
        (KEYS.setpoint("A"), "command of 'B' on the key of 'A'"), (KEYS.setpoint("B"), "an even number"),
        (KEYS.setpoint("B"), inbox.trouble),
    ]  # fmt: skip
    assert list(inbox.read()) == []


@pytest.fixture
def orders():
    """Orders to A, and what asks them."""
    net = Net()
    made = pubsub.Orders(net.session, ORDER, Order)

    def ask(payload, times=1, encoding="json", key=ORDER):
        for _ in range(times):
            query = Query(key, messages.MIME[encoding], payload)
            net.channels[0].add(query)
        return query

    return made, ask


def test_a_malformed_order_is_answered_and_counted(orders):
    orders, ask = orders
    wrong = [ask(payload) for payload in (b"{}", b"nonsense", b'{"order": "fly"}', b"")]
    reader, right = ask(b"", key="park/**"), ask(b'{"order": "land"}')
    assert list(orders.read()) == [(right, Order("land"))]
    assert [query.answers for query in wrong] == [1] * 4
    assert wrong[-1].error == pubsub.NO_ORDER.encode()
    assert (reader.answers, right.answers, orders.malformed) == (0, 0, 3)


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
@pytest.mark.parametrize("order", ["land", "stop"])
def test_flood_of_queries_displaces_no_landing(order, encoding, orders):
    orders, ask = orders
    start, ends, hold = (messages.encode(Order(name), encoding) for name in ("start", order, "hold"))
    ask(start, 5, encoding)
    ask(ends, 1, encoding)
    ask(hold, 40, encoding)
    assert len(orders.waiting) == pubsub.ORDERS
    assert [given.order for _, given in orders.read()] == [order] + ["hold"] * (pubsub.ORDERS - 1)
    ask(ends, 40, encoding)
    ask(hold, 40, encoding)
    assert [given.order for _, given in orders.read()] == [order] * pubsub.ORDERS


def test_last_value_answers_a_plain_get():
    net = Net()
    last = pubsub.LastValue(net.session, KEYS.pose("A"), messages.JSON)
    queries = [Query("park/*/pose", "", b""), Query(KEYS.pose("A"), "", b"")]
    net.channels[0].add(queries[0])
    assert (last.answer(), queries[0].answer) == (1, None)
    last.hold(b"1")
    last.hold(b"2")
    net.channels[0].add(queries[1])
    assert last.answer() == 1
    assert queries[1].answer == (KEYS.pose("A"), b"2", messages.JSON)


SEEN = {"now": 1000.0, "valid_box": (2.0, 2.0, 3.5)}
GOOD = {
    "pose": Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5),
    "state": State("KH01", 1, 1000.0, "running", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, None, None, 0.0),
    "goal": Goal("KH01", 7, 999.9, (0.5, -0.5, 0.0), 0.25, 999.85),
    "ranges": Ranges("KH01", 1000.0, [0.0, 1.5], [0.0, 0.0], [0.25, None]),
    "drive": Command("KH01", 1, 1.0, "drive", (0.1, 0.0, 0.0, 0.0)),
    "takeoff": Command("KH01", 1, 1.0, "takeoff", None, 0.5),
}
CHECKS = {
    "pose": partial(validation.check_pose, **SEEN),
    "state": partial(validation.check_state, **SEEN),
    "goal": partial(validation.check_goal, oldest_s=1.0, **SEEN),
    "ranges": partial(validation.check_ranges, now=1000.0),
    "drive": validation.check_command,
    "takeoff": validation.check_command,
}
HONEST = [
    *((what, {}) for what in GOOD),
    ("pose", {"stamp": 1.0}),  # late joiners get old ones
    ("goal", {"yaw": None, "stamp": 1000.5, "pose": 1001.0}),  # clocks that differ a little
    ("goal", {"stamp": 999.0}),
]


def check(what, **changes):
    CHECKS[what](msgspec.structs.replace(GOOD[what], **changes))


@for_each(
    "what, field, value, why",
    [
        ("pose", "seq", 0, "sequence number 0"),
        ("pose", "seq", 2**53, "sequence number"),
        ("pose", "stamp", 1006.0, "stamp 1006.0"),
        ("pose", "stamp", 0.0, "stamp 0.0"),
        ("pose", "stamp", nan, "stamp nan"),
        ("pose", "position", (2.01, 0.0, 0.0), "outside the arena"),
        ("pose", "position", (0.0, -2.01, 0.0), "outside the arena"),
        ("pose", "position", (0.0, 0.0, 9.0), "outside the arena"),
        ("pose", "position", (0.0, nan, 0.0), "outside the arena"),
        ("pose", "velocity", (0.0, 0.0, 51.0), "velocity"),
        ("pose", "velocity", (0.0, nan, 0.0), "velocity"),
        ("pose", "yaw", nan, "yaw nan"),
        ("pose", "yaw", 1e4, "yaw"),
        ("state", "stamp", nan, "stamp"),
        ("state", "position", (2.1, 0.0, 0.0), "outside the arena"),
        ("state", "velocity", (51.0, 0.0, 0.0), "velocity"),
        ("state", "yaw", inf, "yaw"),
        ("goal", "seq", 0, "sequence number"),
        ("goal", "stamp", 998.9, "old"),
        ("goal", "stamp", 1006.0, "stamp"),
        ("goal", "pose", nan, "rest on a pose"),
        ("goal", "pose", 0.0, "rest on a pose"),
        ("goal", "pose", 1005.5, "rest on a pose"),
        ("goal", "position", (0.0, 1e9, 0.0), "outside the arena"),
        ("goal", "yaw", nan, "yaw"),
        ("ranges", "stamp", 1006.0, "stamp 1006.0"),
        ("ranges", "distance", [0.25], "differ in number"),
        ("ranges", "elevation", [0.0, 0.0, 0.0], "differ in number"),
        ("ranges", "distance", [0.25, inf], "between 0 and 100 m"),
        ("ranges", "distance", [-0.1, None], "between 0 and 100 m"),
        ("ranges", "distance", [], "0 rays"),
        ("ranges", "distance", [1.0] * 721, "721 rays"),
        ("ranges", "bearing", [0.0, nan], "no angle"),
        ("ranges", "bearing", [0.0, 90.0], "no angle"),
        ("drive", "seq", 0, "sequence number 0"),
        ("drive", "setpoint", None, "drive with the setpoint None"),
        ("drive", "setpoint", (0.0, nan, 0.0, 0.0), "drive with the setpoint"),
        ("drive", "setpoint", (0.0, 0.0, 0.0, -inf), "drive with the setpoint"),
        ("takeoff", "height", None, "takeoff with the height None"),
        ("takeoff", "height", -0.5, "takeoff with the height -0.5"),
    ],
)
def test_impossible_messages_are_refused(what, field, value, why):
    for kind, changes in HONEST:
        check(kind, **changes)
    with pytest.raises(Malformed, match=why):
        check(what, **{field: value})


@for_each(
    "last, seq, since, lost",
    [
        (1, 2, 0.02, 0),
        (1, 5, 0.08, 3),
        (1, 5, 10.0, 3),  # it speaks when it has something to say
        (7, 1, 3.0, 0),  # began anew
        (7, 3, 3.0, 2),
        (7, 99_999_999, 0.02, 1),  # forged: at 50 Hz one can have been said in that time
        (99_999_999, 9, 0.02, 1),
    ],
)
def test_gap_counts_at_most_what_time_allows(last, seq, since, lost):
    assert validation.missed(last, seq, since, 50.0) == lost
