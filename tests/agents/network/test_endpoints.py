"""Endpoints, and whose a key is."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.network.endpoints import Endpoint
from agents.network.keys import Keys

HOSTS = st.one_of(st.ip_addresses().map(str), st.from_regex(r"[a-z][a-z0-9-]{0,20}(\.[a-z]{2,5})?", fullmatch=True))


@settings(max_examples=40)
@given(
    st.sampled_from(["tcp", "tls", "quic"]), HOSTS, st.integers(1, 65535), st.sampled_from(["", "#iface=eth0", "?a=1"])
)
def test_what_is_written_is_read_back(protocol, host, port, rest):
    endpoint = Endpoint(protocol, host, port, rest)
    assert Endpoint.parse(str(endpoint)) == endpoint


def test_parts():
    assert Endpoint.parse("tls/[::1]:7447#x=1") == Endpoint("tls", "::1", 7447, "#x=1")
    assert Endpoint.parse("unixsock-stream//tmp/x.sock") == Endpoint("unixsock-stream", "/tmp/x.sock", 0)
    assert str(Endpoint.parse("unixsock-stream//tmp/x.sock")) == "unixsock-stream//tmp/x.sock"


@pytest.mark.parametrize(
    "text", ["", "tcp", "tcp/", "tcp/host", "tcp/host:", "tcp/:1", "tcp/host:0", "tcp/h:99999", "tcp/h:x"]
)
def test_what_is_none_is_refused(text):
    with pytest.raises(ValueError, match="write it like tcp/127"):
        Endpoint.parse(text)


@pytest.mark.parametrize("text", ["udp/127.0.0.1:1", "ws/lab:1", "serial//dev/ttyUSB0", "wss/lab:1"])
def test_unusable_endpoints_are_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r"cannot be used: .*; write it like tcp/"):
        Endpoint.parse(text)


@pytest.mark.parametrize(
    ("text", "loopback", "wildcard"),
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


@pytest.mark.parametrize("key", ["**", "park/**", "lab/KH01/pose", "park", "park/", "park//pose", ""])
def test_a_key_on_which_many_hear_is_nobodys(key):
    assert Keys("park").whose(key) is None


def test_a_robots_key_is_its_own():
    keys = Keys("park")
    assert keys.whose(keys.pose("KH01")) == keys.whose(keys.alive("KH01")) == "KH01"


def test_tokens_of_owners_name_their_session():
    alive = Keys("park").alive("KH01")
    assert Keys.session_of(Keys.life(alive, "f00d")) == "f00d"
    assert Keys.session_of(Keys.claim(alive, Keys.rank(1e9, "f00d"))) == "f00d"
    assert Keys.session_of(alive) is None
    assert Keys.session_of("park/run/conductor") is None
