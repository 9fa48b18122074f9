"""What intruders get from a secured network: nothing. Real processes, real certificates, robots in flight."""

import json
import os
import socket
import threading
from contextlib import ExitStack
from shutil import copytree
from types import SimpleNamespace

import pytest
import zenoh

from agents.network import lab, messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from agents.network.zenoh_config import config, settings
from experiments.real_time.conductor import orders
from experiments.real_time.hosts import authority
from tests.system.secured import TRIANGLE, Laboratory, forged, new_lab, refused, steady

pytestmark = pytest.mark.system

KEYS = Keys()
STOP = messages.encode(messages.Stop("mallory", "because"))


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    with Laboratory(tmp_path_factory.mktemp("secured")) as made:
        made.fly()
        yield made


@pytest.fixture(autouse=True)
def flight(laboratory):
    """Whatever a test does: the robots run on, have believed and refused nothing, and have lost nobody.

    `mad` is whose key is used to say nonsense where that robot may speak.
    """
    made = SimpleNamespace(before=laboratory.last or laboratory.statuses(), mad="")
    yield made
    after = laboratory.statuses()
    for name, before in made.before.items():
        now = after[name]
        assert (now.phase, now.pid, now.refused, now.missing) == ("running", before.pid, before.refused, [])
        lost = {other for other, count in now.lost.items() if count > before.lost[other]}
        assert lost <= {made.mad}, "nonsense crowds out whom it imitates"
        assert now.decisions > before.decisions
        assert made.mad or now.malformed == before.malformed


def say(session, key, payload):
    session.put(key, payload, encoding=messages.JSON)


def settled(laboratory, seconds=0.5):
    """Time for messages to arrive."""
    threading.Event().wait(seconds)
    laboratory.watcher.look()


@pytest.mark.parametrize(
    "protocol", ["tcp", pytest.param("tls", marks=pytest.mark.mechanism("intruder without a certificate")), "quic"]
)
def test_without_a_certificate_nobody_gets_in(laboratory, protocol):
    address = laboratory.plain.partition("/")[2]
    chosen = config(settings("client", connect=[f"{protocol}/{address}"], name="intruder"))
    chosen.insert_json5("transport/unicast/open_timeout", "1000")
    if protocol != "tcp":  # it trusts the router, and has nothing to show
        trusted = {"root_ca_certificate": str(laboratory.folder / "ca.pem")}
        chosen.insert_json5("transport/link/tls", json.dumps(trusted))
    with refused():
        zenoh.open(chosen)


WHO = ("operator", "KH01", "router")
FORGED = {
    "other authority": lambda folder, target: new_lab(target),
    "ended": lambda folder, target: authority.renew(copytree(folder, target), WHO, days=-0.01),
    "same name": lambda folder, target: authority.renew(copytree(folder, target), authority=True),
}


@pytest.mark.parametrize("forge", FORGED.values(), ids=FORGED)
def test_certificate_that_does_not_count_is_refused(laboratory, tmp_path, forge):
    folder = tmp_path / "forged"
    forge(laboratory.folder, folder)
    (folder / "ca.pem").write_bytes((laboratory.folder / "ca.pem").read_bytes())  # it does trust the router
    for identity in WHO:
        with refused():
            laboratory.session(identity, folder)


def test_a_robots_certificate_does_not_make_a_router(laboratory, tmp_path):
    """A stolen robot cannot pose as the router to the others."""
    thief = copytree(laboratory.folder, tmp_path / "thief")
    for part in ("key", "pem"):
        (thief / f"router.{part}").write_bytes((thief / f"KH03.{part}").read_bytes())
    plain = free_endpoint(preferred_port=0, protocol="tls")
    chosen = zenoh.Config()  # a thief needs nothing of ours
    own = {"mode": "peer", "listen/endpoints": [plain], "scouting/multicast/enabled": False}
    for key, value in {**own, **lab.settings(thief, "router", listens=True)}.items():
        chosen.insert_json5(key, json.dumps(value))
    with zenoh.open(chosen), refused():
        laboratory.session("KH01", plain=plain)


def test_router_outside_its_certificates_addresses_is_refused(laboratory):
    with refused():
        laboratory.session("KH01", plain=laboratory.plain.replace("127.0.0.1", "127.0.0.2"))


def first_shows(mechanism, first, *others):
    """Parameters of which the first one shows a mechanism."""
    return [pytest.param(first, marks=pytest.mark.mechanism(mechanism)), *others]


SPEAKERS = ("KH03", "observer", "recorder", "world", "positioning", "twin", "router")


@pytest.mark.parametrize("who", first_shows("intruder with the certificate of another robot", *SPEAKERS))
def test_nobody_speaks_for_a_robot_or_stops_everybody(laboratory, who):
    heard = pubsub.subscriber(laboratory.watcher.session, "park/**", 20_000)
    with laboratory.session(who) as session:
        threading.Event().wait(0.1)
        for key in ("park/KH01/pose", "park/*/pose", "park/**", "park/*/*", "**", "park/$*1/pose", "park/KH01/**"):
            say(session, key, forged("KH01"))
            session.delete(key)
        for key in (KEYS.estop, KEYS.goal("KH01"), "park/*", "park/est$*", "*/estop"):
            say(session, key, STOP)
            session.delete(key)
        settled(laboratory)
    keys = {str(sample.key_expr) for sample in network.received(heard.handler) if "mallory" in str(sample.payload)}
    heard.undeclare()
    assert not keys


OTHERS = ("observer", "KH03", "recorder", "world", "centre", "ros2")


@pytest.mark.parametrize("who", first_shows("orders from others than the operator", *OTHERS))
def test_orders_are_the_operators(laboratory, who):
    land = {"payload": messages.encode(messages.Order("land")), "encoding": messages.JSON}
    with laboratory.session(who) as session:
        reply = orders.send_order(session, KEYS, ["CF01"], messages.Order("land"))["CF01"]
        assert (reply.ok, reply.reason) == (False, "no answer")
        for key in ("park/*/order", "park/**", "park/CF01/*", "**"):
            assert not list(session.get(key, timeout=1.0, **land))
        session.put(KEYS.order("CF01"), **land)
    assert laboratory.watcher.order("CF01", messages.Order("get", name="clamp")).ok, "the operator is heard"


@pytest.mark.parametrize(("who", "part"), [("observer", "pose"), ("operator", "pose"), ("operator", "order")])
def test_queryable_wildcard_is_answered_by_all(laboratory, who, part):
    asked = {"payload": messages.encode(messages.Order("get", name="clamp")), "encoding": messages.JSON}
    with laboratory.session(who) as session:
        replies = list(session.get(f"park/*/{part}", timeout=5.0, **(asked if part == "order" else {})))
        assert {str(reply.ok.key_expr) for reply in replies if reply.ok} == {f"park/{name}/{part}" for name in TRIANGLE}
        assert not list(session.get("park/**", timeout=1.0))


@pytest.mark.parametrize("who", ["KH03", "observer", "recorder", "world"])
def test_robots_are_changed_by_operators_only(laboratory, who):
    """Somebody else neither asks the conductor for a change, nor answers in its place."""
    order = messages.RunOrder("remove", ["CF01"], operator="operator")
    with laboratory.session(who) as session:
        false = pubsub.Orders(session, KEYS.run_order, messages.RunOrder)
        reply = orders.send_run_order(laboratory.watcher.session, KEYS, order, 0.5)
        assert "no conductor answers" in reply.reason
        assert not list(false.read()), "and it does not even hear of it"
        false.close()
        asked = pubsub.Orders(laboratory.watcher.session, KEYS.run_order, messages.RunOrder)
        settled(laboratory)
        for key in (KEYS.run_order, "park/run/*", "park/**"):
            assert not list(session.get(key, payload=messages.encode(order), encoding=messages.JSON, timeout=0.5))
        assert not list(asked.read())
        asked.close()


def test_a_robot_hears_its_neighbours_and_nobody_else(laboratory):
    with laboratory.session("KH03") as session:
        neighbour = pubsub.pose_subscriber(session, KEYS.pose("KH01"))
        keys = (KEYS.pose("KH02"), KEYS.state("KH01"), "park/*/pose", "park/**", "**", KEYS.event)
        others = [pubsub.pose_subscriber(session, key) for key in keys]
        watches = [pubsub.AliveWatch(session, key) for key in ("park/KH02/alive", "park/*/alive", "park/**")]
        settled(laboratory)
        assert len(list(network.received(neighbour.handler))) > 10
        heard = {str(sample.key_expr) for other in others for sample in network.received(other.handler)}
        assert heard <= {KEYS.pose("KH01")}, "what comes for the neighbour's sake reaches all ears of the session"
        assert not [sample for watch in watches for sample in network.received(watch.handler)]
        assert not list(session.get("park/KH02/pose", timeout=1.0))
        assert not list(session.get("@/*/router/**", timeout=1.0))


def test_no_one_takes_anothers_place(laboratory):
    """Neither its orders, nor its token, nor the memory of its last value."""
    with laboratory.session("KH03") as session:
        order = pubsub.Orders(session, KEYS.order("KH02"), messages.Order)
        last = pubsub.LastValue(session, KEYS.pose("KH02"), messages.JSON)
        last.hold(forged("KH02"))
        token = pubsub.alive_token(session, KEYS.alive("KH09"))
        memory = pubsub.pose_publisher(session, KEYS.pose("KH02"), messages.JSON)
        memory.put(forged("KH02"))
        settled(laboratory)
        assert laboratory.watcher.order("KH02", messages.Order("get", name="clamp")).robot == "KH02"
        with pubsub.pose_subscriber(laboratory.watcher.session, KEYS.pose("KH02")) as late:
            settled(laboratory, 0.2)
            poses = list(pubsub.Inbox(late, messages.Pose).read())
        assert poses
        assert all(pose.seq < 10**8 for pose in poses)
        assert "KH09" not in laboratory.watcher.alive
        assert not list(order.read())
        assert not last.answer()
        token.undeclare()


def test_replayed_samples_are_not_believed_again(laboratory, flight):
    """With the very key of KH01, its own poses of a moment ago, twenty times each."""
    with pubsub.pose_subscriber(laboratory.watcher.session, KEYS.pose("KH01"), 500) as ear:
        settled(laboratory)
        taken = [sample.payload.to_bytes() for sample in network.received(ear.handler)]
    assert len(taken) > 10
    with laboratory.session("KH01") as thief:
        for count in steady(500, 0.04 * len(taken)):  # any faster, and KH01 itself is crowded out
            say(thief, KEYS.pose("KH01"), taken[count % len(taken)])
        settled(laboratory)
    after = laboratory.statuses()
    for name in ("KH02", "CF01"):
        said = sum(after[other].sent - flight.before[other].sent for other in TRIANGLE if other != name)
        twice = after[name].received - flight.before[name].received - said
        assert twice < 120 < 20 * len(taken), "each once, give or take the age of a status"


def test_nonsense_at_ten_thousand_hertz_is_counted(laboratory, flight):
    """From a robot that has gone mad, on its own key: KH01's, in a thief's hands."""
    flight.mad = "KH01"
    nonsense = [b"", b"{", b"[" * 1000, os.urandom(200), b'{"robot":"KH01","seq":NaN}', forged("KH02"), b"null"]
    sent = 0
    with laboratory.session("KH01") as thief:
        mad = pubsub.publisher(thief, KEYS.pose("KH01"), messages.JSON)
        for count in steady(10_000, 1.5):
            mad.put(nonsense[count % len(nonsense)])
            sent = count
    assert sent > 5_000
    after = laboratory.statuses()
    for name in ("KH02", "CF01"):
        assert after[name].malformed > flight.before[name].malformed, "it is counted"


def test_what_is_too_large_does_not_arrive(laboratory):
    with laboratory.session("KH01") as thief:
        for size in (65_537, 300_000, 3_000_000) * 20:
            say(thief, KEYS.pose("KH01"), b" " * size)
        settled(laboratory)


def test_denied_samples_at_ten_thousand_hertz_arrive_nowhere(laboratory):
    with laboratory.session("observer") as session:
        for count in steady(10_000, 1.5):
            say(session, (KEYS.estop, KEYS.pose("KH01"), "park/**")[count % 3], STOP)
        assert count > 5_000


def test_half_open_connections_are_dropped_and_disturb_nobody(laboratory):
    """Slowloris: handshakes that begin and never end. Those who are in stay in; the router drops the others."""
    host, _, port = laboratory.plain.partition("/")[2].rpartition(":")
    with ExitStack() as stack:
        half = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(60)]
        for one in half:
            one.sendall(b"\x16\x03\x01")  # the beginning of a ClientHello
            one.setblocking(False)
        assert laboratory.watcher.order("CF01", messages.Order("get", name="clamp")).ok
        laboratory.watcher.until(lambda: all(map(_closed, half)), "the router drops them all", 40.0)
    with laboratory.session("observer") as session:
        assert list(session.liveliness().get("park/*/alive", timeout=1.0))


def _closed(one):
    try:
        return one.recv(64) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
