"""Sessions on a real router; and what they do about one that is silent, alarms, and connections."""

import os
import re
import socket
import struct
import threading
import time
from math import inf
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import zenoh

from agents.network import pubsub
from agents.network.endpoints import free_endpoint, obstacle
from agents.network.messages import JSON, Stop
from agents.network.session import (
    ANSWER_S,
    ASK_EVERY_S,
    SLICE_NS,
    RouterWatch,
    Unreachable,
    connected,
    count_links,
    forbid_lingering,
    open_session,
    prompt_threads,
    received,
)
from agents.network.zenoh_config import LEASE_S, config, settings
from agents.runtime.router import serve_router
from tests.cases import for_each
from tests.commands import python, started
from tests.conftest import RouterProcess
from tests.network import Net

POSE, ALIVE = "park/CF01/pose", "park/CF01/alive"


def payloads(handler):
    return [sample.payload.to_bytes() for sample in received(handler)]


@pytest.fixture
def two(router):
    with open_session([router.endpoint], name="CF01") as robot, open_session([router.endpoint], name="ui") as other:
        yield robot, other


@pytest.mark.mechanism("last pose for a late joiner")
@pytest.mark.system
def test_late_joiner_hears_the_last_pose(two, router, eventually):
    sender, early = two
    seen, poses, got = pubsub.pose_subscriber(early, POSE), pubsub.pose_publisher(sender, POSE, JSON), []
    for value in (b"1", b"2", b"3"):
        poses.put(value)
    eventually(lambda: got.extend(payloads(seen.handler)) or got[-1:] == [b"3"])  # none is on its way
    with open_session([router.endpoint], name="late") as late:
        joined, got = pubsub.pose_subscriber(late, "park/*/pose"), []
        eventually(lambda: got.extend(payloads(joined.handler)) or got)
        poses.put(b"4")
        eventually(lambda: got.extend(payloads(joined.handler)) or got[-1] == b"4")
        assert got == [b"3", b"4"]


@pytest.mark.mechanism("transmission while the router is down")
@pytest.mark.system
def test_pose_said_while_the_router_was_down_arrives(two, router, eventually):
    sender, receiver = two
    pose, poses, got = pubsub.pose_publisher(sender, POSE, JSON), pubsub.pose_subscriber(receiver, POSE), []
    pose.put(b"before")
    eventually(lambda: got.extend(payloads(poses.handler)) or got == [b"before"])
    router.kill()
    eventually(lambda: not connected(sender) and not connected(receiver))
    pose.put(b"while down")
    router.start()
    eventually(lambda: got.extend(payloads(poses.handler)) or got[-1] == b"while down")
    assert connected(sender)


@for_each(
    "endpoint, reason",
    [
        ("tcp/255.255.255.255:7447", "255.255.255.255: "),
        ("unixsock-stream//no/such/socket", "/no/such/socket: No such file or directory"),
    ],
)
def test_failed_connection_tells_the_systems_reason(endpoint, reason):
    assert obstacle(endpoint, 0.3).startswith(reason)
    with pytest.raises(Unreachable, match=rf"at {endpoint} \({reason}.*`./zenpark router` starts one"):
        open_session([endpoint], name="test", wait_s=0.0)


def test_unknown_name_is_the_reason(monkeypatch):
    def unknown(*_, **__):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    for protocol in ("tcp", "tls", "quic"):
        assert obstacle(f"{protocol}/lab:7447", 0.3) == "lab: Name or service not known"


def test_refused_connection_has_no_further_reason():
    assert obstacle(free_endpoint(preferred_port=0), 0.3) == ""


@pytest.mark.parametrize("bell", [None, pubsub.Bell()])
def test_a_constant_source_number_loses_no_sample(bell, eventually):
    with zenoh.open(config(settings("peer"))) as session:
        poses, got = pubsub.pose_subscriber(session, "park/*/pose", bell=bell), []
        plain, numbered = session.declare_publisher(POSE), pubsub.pose_publisher(session, "park/CF02/pose", JSON)
        source = zenoh.SourceInfo(plain.id, 0)  # as another program may number its samples
        for value in (b"1", b"2", b"3"):
            plain.put(value, source_info=source)
            numbered.put(b"numbered " + value)
            plain.put(b"unnumbered " + value)
        eventually(lambda: got.extend(payloads(poses.handler)) or len(got) == 9)
        assert set(got) == {
            b"1",
            b"2",
            b"3",
            *(word + b" %d" % k for word in (b"numbered", b"unnumbered") for k in (1, 2, 3)),
        }
        poses.undeclare()


def test_numbers_of_a_plain_publisher_grow(eventually):
    with zenoh.open(config(settings("peer"))) as session:
        samples = pubsub.subscriber(session, POSE)
        named = pubsub.NumberedPublisher(session, POSE, JSON)
        for value in (b"1", b"2", b"3"):
            named.put(value)
        got = list(received(samples.handler))
        assert [sample.source_info.source_sn for sample in got] == [0, 1, 2]
        assert {pubsub.session_of(sample) for sample in got} == {str(session.zid())}


def test_rings_before_a_wait_are_one():
    bell = pubsub.Bell()
    bell.ring()
    bell.ring()
    assert [bell.wait(0.0), bell.wait(0.0)] == [True, False]


ROBOT = """
import sys
from agents.network.messages import Order
from agents.network.pubsub import Orders, alive_token, pose_publisher, pose_subscriber
from agents.network.session import open_session
session = open_session([sys.argv[1]], name="CF01")
held = [
    alive_token(session, "park/CF01/alive"),
    pose_publisher(session, "park/CF01/pose", "application/json"),
    pose_subscriber(session, "park/CF02/pose"),
    Orders(session, "park/CF01/order", Order),
]
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.mechanism("exit with an open session")
@pytest.mark.system
def test_interpreter_exits_although_a_session_was_left_open(router):
    done = python("-c", ROBOT, router.endpoint)
    assert (done.stdout, done.stderr) == ("ready\n", "")


@pytest.mark.mechanism("liveliness")
@pytest.mark.system
def test_a_killed_robot_is_noticed(router, eventually):
    with started("-c", ROBOT, router.endpoint) as robot, open_session([router.endpoint], name="CF02") as session:
        assert robot.stdout.readline() == "ready\n"
        watch, seen = pubsub.AliveWatch(session, "park/*/alive"), []
        eventually(lambda: seen.extend(watch.changes()) or seen == [(ALIVE, True)])
        for key in ("park/**", "park/*/alive"):  # on the keys of everybody: nobody's life, and nobody's death
            pubsub.alive_token(session, key).undeclare()
        robot.kill()
        eventually(lambda: seen.extend(watch.changes()) or seen[1:] == [(ALIVE, False)])
        assert connected(session)


class Question:
    answered = False

    def try_recv(self) -> None:
        if self.answered:
            raise zenoh.ZError("the answer is complete")


class Asked:
    """Session for `RouterWatch`: its links, and queries that are answered by hand."""

    def __init__(self) -> None:
        self.routers, self.peers, self.questions = ["router"], [], []
        self.info = SimpleNamespace(routers_zid=lambda: self.routers, peers_zid=lambda: self.peers)
        self.liveliness = lambda: SimpleNamespace(get=self.ask)

    def ask(self, *_: object, **__: object) -> Question:
        self.questions.append(Question())
        return self.questions[-1]


def looks(watch: RouterWatch, begin: float, end: float) -> float:
    """Last answer of a watch that is asked 50 times a second."""
    ticks = range(round(begin * 50), round(end * 50) + 1)
    return [watch.silent_since(tick / 50) for tick in ticks][-1]


@pytest.fixture
def asked():
    session = Asked()
    return session, RouterWatch(session, ALIVE)


def test_one_answer_after_silence_may_be_closing_link(asked):
    session, watch = asked
    assert looks(watch, 0.0, ANSWER_S) == inf
    silent = pytest.approx(0.0)
    assert looks(watch, 0.32, 0.46) == silent
    assert len(session.questions) == 2
    for question in session.questions:
        question.answered = True
    assert watch.silent_since(0.5) == silent
    session.routers = []
    assert watch.silent_since(0.52) == silent, "it goes on, and does not begin anew"
    session.routers = ["another"]
    for t in (0.54, 0.56):
        assert watch.silent_since(t) == silent
        session.questions[-1].answered = True
    assert watch.silent_since(0.58) == inf


def test_starved_process_does_not_blame_the_router(asked):
    _, watch = asked
    assert [watch.silent_since(t) for t in (0.0, 5.0, 5.5)] == [inf] * 3
    assert looks(watch, 5.52, 5.56) == inf
    assert looks(watch, 5.58, 5.7) == pytest.approx(5.3, abs=0.03)


def test_router_that_delivers_samples_is_not_asked(asked):
    session, watch = asked
    ticks = [tick / 20 for tick in range(40)]
    assert [watch.silent_since(t, arrived) for arrived, t in enumerate(ticks, 1)] == [inf] * len(ticks)
    assert not session.questions
    last = ticks[-1]
    looked = [(t, watch.silent_since(t, len(ticks))) for t in (last + tick / 50 for tick in range(1, 40))]
    begin = last + ASK_EVERY_S
    assert next(t for t, since in looked if since < inf) == pytest.approx(begin + ANSWER_S, abs=0.05)
    assert looked[-1][1] == pytest.approx(begin, abs=0.05)
    assert watch.silent_since(looked[-1][0] + 0.02, len(ticks) + 1) < inf, "what was on its way is no answer"


def test_members_of_a_mesh_are_not_asked(asked):
    session, watch = asked
    session.routers, session.peers = [], ["KH01"]
    assert [watch.silent_since(t) for t in (0.0, 1.0, 2.0)] == [inf] * 3
    session.peers = []
    assert [watch.silent_since(t) for t in (3.0, 4.0)] == [3.0] * 2
    assert not session.questions


def test_silent_router_is_left_only_for_another(monkeypatch):
    left = []
    monkeypatch.setattr("agents.network.session.hang_up", left.append)
    for endpoints, times in ((["one"], 0), (["one", "other"], 1)):
        session = Asked()
        watch = RouterWatch(session, ALIVE, endpoints)
        looks(watch, 0.0, LEASE_S)
        assert not left, "as long as one of ours would be waited for"
        looks(watch, LEASE_S + 0.02, LEASE_S + 0.1)
        assert len(left) == times
    session.routers = []
    looks(watch, LEASE_S + 0.12, 2.0 * LEASE_S + 0.5)
    session.routers = ["other"]
    looks(watch, 2.0 * LEASE_S + 0.52, 2.0 * LEASE_S + 0.54)
    assert len(left) == 1, "the next one has as much time"


@pytest.mark.system
def test_router_that_waits_for_another_is_not_silent(patient_router):
    near = free_endpoint(0)
    linked = zenoh.open(config(settings("router", listen=[near], connect=[patient_router.endpoint])))
    with linked, open_session([near], name="CF01") as session, patient_router.frozen():
        watch, begun = RouterWatch(session, ALIVE), time.monotonic()
        while (t := time.monotonic() - begun) < 4 * ASK_EVERY_S:
            assert watch.silent_since(t) == inf


@pytest.fixture
def second():
    """Another router, whose clients wait for 60 s."""
    made = RouterProcess(lease_s=60.0)
    yield made
    assert made.stop() == 0


@pytest.mark.mechanism("client at a second router")
@pytest.mark.system
def test_second_router_takes_over_from_frozen_long_lease(patient_router, second, eventually):
    ends = [patient_router.endpoint, second.endpoint]
    with open_session(ends, name="CF01") as robot, open_session(ends, name="CF02") as listener:
        begun, sent, got, here = time.monotonic(), [0], [], [False]
        watches = [RouterWatch(each, ALIVE, ends) for each in (robot, listener)]
        token = pubsub.alive_token(robot, ALIVE)
        poses, heard = pubsub.pose_publisher(robot, POSE, JSON), pubsub.pose_subscriber(listener, POSE)
        alive = pubsub.AliveWatch(listener, "park/*/alive")

        def exchange() -> None:
            """Both watch their router, and poses are sent, until a new one has arrived, and the token."""
            mark = sent[-1]

            def turn() -> bool:
                for watch, arrived in zip(watches, (0, len(got)), strict=True):
                    watch.silent_since(time.monotonic() - begun, arrived)
                sent.append(sent[-1] + 1)
                poses.put(str(sent[-1]).encode())
                got.extend(int(payload) for payload in payloads(heard.handler))
                here.extend(there for _, there in alive.changes())
                return bool(got) and got[-1] > mark and here[-1]

            eventually(turn)
            assert got == sorted(set(got)), "each once, in order"

        exchange()
        with patient_router.frozen():
            os.waitpid(patient_router.process.pid, os.WUNTRACED)
            exchange()
            assert count_links(robot) == count_links(listener) == 1
        exchange()
        token.undeclare()
        eventually(lambda: here.extend(there for _, there in alive.changes()) or not here[-1])


@pytest.mark.mechanism("emergency stop before everything else that came")
@pytest.mark.system
def test_alarm_is_obeyed_at_once_and_keeps_orders(two, eventually):
    robot, other = two
    obeyed, kept, reasons = [], [], ["one", "two", "three", "everybody"]
    alarm = pubsub.ImmediateSubscriber(robot, "park/estop", obeyed.append, depth=2)
    speaker = pubsub.publisher(other, "park/estop", JSON)
    eventually(lambda: speaker.matching_status.matching)
    other.delete("park/estop")  # no stop
    other.delete("park/**")
    for reason in reasons:
        other.put("park/**" if reason == "everybody" else "park/estop", reason, encoding="text/plain")
    eventually(lambda: len(obeyed) == len(reasons))
    assert [stop.reason for stop in obeyed] == reasons
    eventually(lambda: kept.extend(received(alarm)) or kept[-2:] == obeyed[-2:])
    assert len(kept) <= 3  # the newest two, and one that came while they were polled


def test_stop_waits_for_loop_after_being_obeyed():
    """A loop that polls in between would think that its motors are off, and then they are cut for ever."""
    seen = []
    net = Net()
    alarm = pubsub.ImmediateSubscriber(net.session, "park/estop", lambda _stop: seen.append(alarm.try_recv()))
    net.deliver(b"park/estop\0text/plain\0stop")
    assert seen == [None]
    assert alarm.try_recv() == Stop("an unknown sender", "stop")

    def fails(_stop):
        raise OSError("a body that cannot be told")

    alarm = pubsub.ImmediateSubscriber(net.session, "park/estop", fails)
    with pytest.raises(OSError, match="cannot be told"):
        net.deliver(b"park/estop\0text/plain\0stop")
    assert alarm.try_recv() == Stop("an unknown sender", "stop")


def lingers(descriptor: int) -> bool:
    """Whether a connection waits, when it is closed, for data that are on their way."""
    with socket.socket(fileno=os.dup(descriptor)) as one:
        return bool(struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0])


def test_a_connection_closes_without_lingering():
    """A thread of Zenoh that closes the connection to a frozen process serves all others as well."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as near:
        far, _ = server.accept()
        with far:
            for each in (near, far):
                each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
            assert forbid_lingering() >= 2
            assert not lingers(near.fileno())
            assert not lingers(far.fileno())


@pytest.mark.mechanism("router that closes without lingering")
@pytest.mark.system
def test_a_router_closes_no_connection_slowly(eventually):
    """The router serves in this process, whose ends of the connections can be read."""
    endpoint, stop = free_endpoint(preferred_port=0), threading.Event()
    thread = threading.Thread(target=serve_router, args=([endpoint], stop))
    thread.start()
    try:
        with open_session([endpoint], name="viewer"):
            port = int(endpoint.rpartition(":")[2])

            def ends() -> list[bool]:
                found = psutil.Process().net_connections("tcp")
                return [lingers(each.fd) for each in found if each.laddr.port == port and each.raddr]

            eventually(lambda: ends() == [False])
    finally:
        stop.set()
        thread.join()


def granted() -> int:
    scheduler = Path("/proc/thread-self/sched")
    found = re.search(r"se\.slice\s*:\s*(\d+)", scheduler.read_text()) if scheduler.exists() else None
    if found is None:
        pytest.skip("this kernel does not say how long slices are")
    return int(found[1])


def test_threads_that_are_started_inside_have_short_slices():
    before, inside = granted(), []
    with prompt_threads():
        if granted() != SLICE_NS:
            pytest.skip("this kernel grants no slices")
        thread = threading.Thread(target=lambda: inside.append(granted()))
        thread.start()
        thread.join()
    assert inside == [SLICE_NS]
    assert granted() == before > SLICE_NS
