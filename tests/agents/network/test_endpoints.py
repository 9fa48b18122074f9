"""Endpoints: how they are written, which a session uses, and which are refused; and whose a key is."""

import socket
import threading

import pytest

from agents.network import endpoints, zenoh_config
from agents.network.endpoints import Endpoint, EndpointError, free_endpoint, free_endpoints
from agents.network.keys import Keys
from agents.network.session import Unreachable, open_session
from agents.network.zenoh_config import config
from tests.cases import for_each

MESH = ["tcp/127.0.0.1:1#of=A", "tcp/127.0.0.1:2#of=B+C", "tcp/127.0.0.1:3#of=D", "tcp/127.0.0.1:4#of=recorder"]


@for_each(
    "text, parts",
    [
        ("tls/[::1]:7447#x=1", ("tls", "::1", 7447, "#x=1")),
        ("quic/lab-1.example.org:65535?a=1", ("quic", "lab-1.example.org", 65535, "?a=1")),
        ("unixsock-stream//tmp/x.sock", ("unixsock-stream", "/tmp/x.sock", 0)),
    ],
)
def test_parts_are_read_and_written(text, parts):
    assert Endpoint.parse(text) == Endpoint(*parts)
    assert str(Endpoint(*parts)) == text


@for_each(
    "text", ["", "tcp", "tcp/", "tcp/host", "tcp/host:", "tcp/:1", "tcp/host:0", "tcp/h:99999", "tcp/h:x", "udp/h:1"]
)
def test_what_is_no_endpoint_is_refused(text):
    with pytest.raises(ValueError, match="write it like tcp/127"):
        Endpoint.parse(text)


@for_each(
    "text, loopback, wildcard",
    [
        ("tcp/127.0.0.1:1", True, False),
        ("tcp/localhost:1", True, False),
        ("tcp/[::1]:1", True, False),
        ("unixsock-stream//x", True, False),
        ("tcp/0.0.0.0:1", False, True),
        ("tcp/[::]:1", False, True),
        ("tls/192.0.2.7:1", False, False),
        ("tls/lab:1", False, False),
    ],
)
def test_who_reaches_it(text, loopback, wildcard):
    endpoint = Endpoint.parse(text)
    assert (endpoint.is_loopback, endpoint.is_wildcard) == (loopback, wildcard)


@for_each(
    "use, endpoint, why",
    [
        ("listen", "tcp/0.0.0.0:7447", "SSH tunnel"),
        ("listen", "tcp/host.example:7447", "SSH tunnel"),
        ("listen", "tcp/:1", "SSH tunnel"),
        ("connect", "127.0.0.1:7447", "not an endpoint"),
        ("connect", "tcp/", "not an endpoint"),
        ("connect", "", "not an endpoint"),
        ("connect", "tcp/127.0.0.1:7447\n", "not an endpoint"),
        ("connect", "t#tcp/localhost:1", "no such protocol"),
        ("connect", "http/127.0.0.1:1", "no such protocol"),
        ("connect", "udp/127.0.0.1:1", "lost messages"),
        ("connect", "ws/127.0.0.1:1", "certificates"),
        ("connect", "wss/127.0.0.1:1", "certificates"),
        ("connect", "serial//dev/ttyUSB0", "no network"),
        ("connect", "tcp?/x/y", "no such protocol"),
    ],
)
def test_unusable_endpoints_are_refused_with_an_example(use, endpoint, why):
    with pytest.raises(EndpointError, match=why) as refusal:
        config(zenoh_config.settings("router", **{use: [endpoint]}))
    assert endpoints.DEFAULT_ENDPOINT in str(refusal.value)


@for_each("endpoint", ["tcp/127.0.0.1:0", "tcp/127.3.2.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447"])
def test_listens_on_loopback(endpoint):
    made = config(zenoh_config.settings("router", listen=[endpoint], name="router", lease_s=1.5))
    assert made.get_json("listen/endpoints") == f'["{endpoint}"]'
    assert made.get_json("transport/link/tx/lease") == "1500"
    for off in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        assert made.get_json(f"{off}/enabled") == "false"


def test_free_endpoints_avoid_taken_ports():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert free_endpoint(port) != f"tcp/127.0.0.1:{port}"
    assert free_endpoint(port) == f"tcp/127.0.0.1:{port}"
    assert len(set(free_endpoints(3))) == 3


@for_each(
    "name, listens, connects",
    [
        ("A", [1], []),
        ("B+C", [2], [1]),
        ("B", [2], [1]),
        ("recorder", [4], [1, 2, 3]),
        ("zenpark echo", [], [1, 2, 3, 4]),  # a visitor
    ],
)
def test_the_later_of_two_members_connects(name, listens, connects):
    ends = endpoints.ends(MESH, name)
    assert (ends.mode, ends.visits) == ("peer", not listens)
    assert ends.listen == [f"tcp/127.0.0.1:{port}" for port in listens]
    assert ends.connect == [f"tcp/127.0.0.1:{port}" for port in connects]


def test_marks_stand_in_either_order_of_making():
    endpoint = endpoints.owned("tls/127.0.0.1:1#lab=/l", "A")
    assert endpoint == "tls/127.0.0.1:1#of=A#lab=/l"
    assert endpoints.owner(endpoint) == "A"
    assert endpoints.unowned(endpoint) == "tls/127.0.0.1:1#lab=/l"
    assert endpoints.bare([endpoint]) == ["tls/127.0.0.1:1"]
    assert endpoints.from_here("tls/0.0.0.0:7#lab=/l") == "tls/127.0.0.1:7#lab=/l"


def test_robot_knows_its_neighbours_and_services():
    senders = {"A": {"B"}, "B": set(), "C": set(), "D": {"A"}}
    assert endpoints.near(MESH, senders, ["A"]) == MESH  # it receives B, D receives it
    assert endpoints.near(MESH, senders, ["B", "C"]) == [MESH[0], MESH[1], MESH[3]]
    assert endpoints.near(MESH, senders, ["D"]) == [MESH[0], MESH[2], MESH[3]]
    routers = ["tcp/127.0.0.1:1", "tls/lab:2#lab=/x"]
    assert endpoints.near(routers, senders, ["D"]) == routers
    ends = endpoints.ends(routers, "A")
    assert (ends.mode, ends.connect, ends.listen, ends.visits) == ("client", routers, [], False)


def test_unreachable_names_endpoints_and_remedy():
    endpoint, stop = free_endpoint(preferred_port=0), threading.Event()
    with pytest.raises(Unreachable, match=rf"{endpoint}.*`./zenpark router`"):
        open_session([endpoint], name="test", wait_s=0.0)
    with pytest.raises(Unreachable, match="no member answers at"):
        open_session([endpoints.owned(endpoint, "A")], name="visitor", wait_s=0.05)
    stop.set()
    with pytest.raises(Unreachable):
        open_session([endpoint], name="test", wait_s=1e6, stop=stop)


def test_robots_and_sessions_own_keys():
    keys = Keys("park")
    alive = keys.alive("KH01")
    assert keys.whose(keys.pose("KH01")) == keys.whose(alive) == "KH01"
    for key in ("**", "park/**", "lab/KH01/pose", "park", "park/", "park//pose", ""):
        assert keys.whose(key) is None
    assert Keys.session_of(Keys.life(alive, "f00d")) == "f00d"
    assert Keys.session_of(Keys.claim(alive, Keys.rank(1e9, "f00d"))) == "f00d"
    assert Keys.session_of(alive) is None
    assert Keys.session_of("park/run/conductor") is None
