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
IMPOSSIBLE = {
    "seq": [0, 2**53],
    "stamp": [0.0, nan, 1006.0],
    "position": [(2.01, 0.0, 0.0), (0.0, -2.01, 0.0), (0.0, 0.0, 9.0), (0.0, nan, 0.0)],
    "velocity": [(0.0, 0.0, 51.0), (0.0, nan, 0.0), (-51.0, 0.0, 0.0)],
    "yaw": [nan, 1e4, -inf],
}
IN_KIND = {"pose": IMPOSSIBLE, "goal": IMPOSSIBLE, "state": IMPOSSIBLE.keys() - {"seq"}, "ranges": ["stamp"]}
REFUSED = [
    *((what, field, IMPOSSIBLE[field]) for what, fields in IN_KIND.items() for field in fields),
    ("goal", "stamp", [998.9]),
    ("goal", "pose", [nan, 0.0, 1005.5]),
    ("ranges", "distance", [[0.25], [0.25, inf], [-0.1, None], []]),
    ("ranges", "elevation", [[0.0, 0.0, 0.0], [-90.0, 0.0]]),
    ("ranges", "bearing", [[0.0, nan], [0.0, 90.0]]),
    ("drive", "seq", [0]),
    ("drive", "setpoint", [None, (0.0, nan, 0.0, 0.0), (0.0, 0.0, 0.0, -inf)]),
    ("takeoff", "height", [None, -0.5, 0.0]),
]


def check(what, **changes):
    CHECKS[what](msgspec.structs.replace(GOOD[what], **changes))


@for_each("what, changes", HONEST)
def test_honest_messages_pass(what, changes):
    check(what, **changes)


@for_each("what, field, values", REFUSED)
def test_impossible_messages_are_refused(what, field, values):
    for value in values:
        with pytest.raises(Malformed):
            check(what, **{field: value})


def test_sweep_has_at_most_720_rays():
    rays = [0.0] * 721
    check("ranges", distance=rays[1:], bearing=rays[1:], elevation=rays[1:])
    with pytest.raises(Malformed, match="721 rays"):
        check("ranges", distance=rays, bearing=rays, elevation=rays)


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
