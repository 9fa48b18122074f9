"""Routers: several, none (a mesh), over each transport, and a zenohd, with our configuration or with none."""

import json
import signal
import socket
import subprocess
import time
import urllib.request
from contextlib import ExitStack, contextmanager

import pytest
import zenoh

from agents.network import endpoints as topology
from agents.network import lab, messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from experiments.definition import access_rights, mesh
from experiments.file.document import load
from experiments.run import reopen
from tests.system import zenohd
from tests.system.lab import NEAR_TRIANGLE, TRIANGLE, Flight, Started, Watcher, assert_held_in_time, gone, typed, until
from tests.system.secured import Laboratory, forged, new_lab, refused
from tools.commands import orders
from tools.commands.network import members
from tools.commands.processes import of_zenohd

pytestmark = pytest.mark.system


@pytest.mark.mechanism("router of a run frozen")
def test_a_frozen_router_is_replaced_in_flight(tmp_path):
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", *NEAR_TRIANGLE, "duration_s=9")
    flight.until_flown()
    frozen = flight.children()["router"]
    frozen.suspend()
    flight.until_said(r"the router ended \(killed, since it gave no answer for \d\.\d s\); started again")
    for name in TRIANGLE:
        flight.until_said(rf"hazard [^\n]*\b{name}\b[^\n]*: over: no connection to a router")
    assert flight.finish()[0] == 0, flight.logs()
    assert gone([frozen])
    (trace,) = reopen(flight.folder).traces.values()
    assert not [event for event in trace.events if event.kind == "hazard" and "land" in event.text]
    assert {event.text for event in trace.events if event.kind == "phase"} >= {"formation", "landing"}


def intrude(session):
    """Forged stops, poses, and an order behind them on the same way, which nobody answers."""
    stop = messages.encode(messages.Stop("mallory", "because"))
    for _ in range(20):
        for key in ("park/estop", "park/**"):
            session.put(key, stop, encoding=messages.JSON)
        session.put("park/KH01/pose", forged("KH01"), encoding=messages.JSON)
    order = messages.encode(messages.Order("land"))
    for robot in ("KH01", "CF01"):
        assert not [reply for reply in session.get(f"park/{robot}/order", payload=order, timeout=0.5) if reply.ok]


def test_intruder_gets_nothing_at_the_other_router_either(tmp_path):
    with Laboratory(tmp_path, linked=True) as made:
        (other,) = lab.secured([free_endpoint(preferred_port=0, protocol="tls")], made.folder)
        made.serve(other, "--connect", made.endpoint)
        made.fly()
        with Watcher(other) as looker:  # as operator: through the link everything is seen, and orders are carried
            looker.until_all("running", *TRIANGLE)
            assert looker.order("KH01", messages.Order("get", name="speed")).robot == "KH01"
        before = made.statuses()
        for mode in ("client", "router"):  # the latter would be a link, were it a router's certificate
            chosen = config(settings("client", connect=[other], name="intruder", identity="KH03"))
            chosen.insert_json5("mode", f'"{mode}"')
            with zenoh.open(chosen) as intruder:
                states = pubsub.subscriber(intruder, made.watcher.keys.state("*"))
                intrude(intruder)
                heard = {str(sample.key_expr) for sample in network.received(states.handler)}
                assert heard <= {"park/**"}, "its own words, and nobody else's"
        with refused():
            zenoh.open(config(settings("client", connect=[other.partition("#")[0]], name="intruder")))
        for name, after in made.statuses().items():
            assert after.phase == "running"
            for what in ("malformed", "refused", "lost"):
                assert getattr(after, what) == getattr(before[name], what)


@pytest.mark.mechanism("router frozen")
def test_robots_hold_while_a_long_lease_router_freezes(patient_router, tmp_path):
    changes = (f'network.connect=["{patient_router.endpoint}"]', "safety.neighbour_timeout_s=0.6")
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", *NEAR_TRIANGLE, *changes)
    flight.until_flown()
    with patient_router.frozen() as stopped:
        flight.until_said(r"router conductor: no router answers for \d+\.\d s")
        until(lambda: time.time() > stopped + 3.0, "every robot has had the time to hold")
    flight.until_said(r"router conductor: a router answers again, after \d+\.\d s")
    for name in TRIANGLE:
        flight.until_said(rf"hazard [\w, ]*{name}[\w, ]*: over: no connection to a router")
    flight.interrupt()
    assert_held_in_time(flight, "periodic", stopped)


MESH = "network.topology=mesh"


def linked_members(children, ports):
    """Robots -> members that their processes are linked with by a connection, by the ports at which these listen."""
    linked = {name: set() for name in ports.values()}
    for name, near in linked.items():
        for each in children[name].net_connections("inet"):
            if each.status == "ESTABLISHED" and each.raddr and each.raddr.port in ports:
                near.add(ports[each.raddr.port])
                linked[ports[each.raddr.port]].add(name)
    return linked


def test_the_reference_experiment_without_a_router(tmp_path, capsys):
    flight = Flight(tmp_path / "run", "robotic-park", "--case", "event", MESH)
    flight.until_flown()
    endpoints = (flight.folder / "network.txt").read_text().split()
    ports = {int(topology.bare([each])[0].rpartition(":")[2]): topology.owner(each) for each in endpoints}
    children = flight.children()
    assert "router" not in children
    hears = access_rights.senders_by_receiver(load("robotic-park").plan)
    linked = linked_members(children, {port: name for port, name in ports.items() if name in hears})
    for name, heard in hears.items():
        assert linked[name] == heard | {other for other in hears if name in hears[other]}, name

    with Watcher(*endpoints) as watcher:
        status, near = watcher.status, linked["CF02"]
        watcher.until(lambda: len(watcher.alive) == len(hears) == len(watcher.state), "everybody is seen")
        seen = {member.name: member for member in members(watcher.session)}
        assert {"run", *hears} <= seen.keys()
        assert {watcher.keys.conductor, watcher.keys.recorder} <= {*seen["run"].alive}
        children["CF02"].kill()
        missing = {name: ["CF02"] * ("CF02" in hears[name]) for name in near}
        watcher.until(lambda: all(status[name].missing == missing[name] for name in near), "its neighbours miss it")
        begun = {name: status[name].decisions for name in hears if name != "CF02"}
        watcher.until(lambda: all(status[name].decisions > count for name, count in begun.items()), "the others go on")
        assert all(not status[name].missing for name in begun if "CF02" not in hears[name])
    assert orders.estop(connect=endpoints, realm="park", identity="operator") == 0
    assert capsys.readouterr().out == f"stopped: {', '.join(sorted(begun))} (at a mesh)\n"
    flight.finish()
    run = reopen(flight.folder)
    assert run.notes == ("event: lost CF02",) or "event" in run.traces


def test_an_endpoint_that_somebody_else_has_is_named(tmp_path):
    taken = free_endpoint(0)
    with zenoh.open(config(settings("router", listen=[taken], name="stranger"))):
        where = f'network.addresses={{KH01 = "{taken}"}}'
        flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", MESH, where)
        assert flight.finish()[0] == 2
    assert "KH01 cannot listen on" in flight.said()


@pytest.mark.mechanism("mesh")
def test_a_silent_missing_link_is_named():
    free = {free_endpoint(0) for _ in range(20)}
    right = [topology.owned(endpoint, name) for endpoint, name in zip(free, TRIANGLE, strict=False)]
    wrong = [topology.owned(free_endpoint(0), "KH01"), *right[1:]]  # where KH02 seeks it
    with ExitStack() as stack:
        for name in TRIANGLE:
            connect = [part for each in (wrong if name == "KH02" else right) for part in ("--connect", each)]
            stack.enter_context(Started("experiments.real_time.processes.robot", "triangle", name, *connect))
        watcher = stack.enter_context(Watcher(*right))
        watcher.until(lambda: watcher.phase("CF01") == "ready", "it hears both")
        watcher.until(lambda: watcher.status["KH02"].reason == "never received KH01", "and KH02 says whom it does not")
        assert watcher.phase("KH02") == watcher.phase("KH01") == "idle"
        assert not watcher.order("KH02", messages.Order("takeoff")).ok


def test_lab_members_let_nobody_exceed_its_rights(tmp_path):
    """No router could refuse anything in a mesh: the receiver of an order does."""
    file = tmp_path / "mesh.toml"
    file.write_text(load("triangle").path.read_text() + '\n[network]\ntopology = "mesh"\nlab = "lab"\n')
    listening = mesh.listening_hosts(load(file).plan)
    new_lab(tmp_path / "lab", *TRIANGLE, "KH09", listening=listening)
    flight = Flight(tmp_path / "run", file, "--case", "periodic", "duration_s=6")
    flight.until_flown()
    endpoints = (flight.folder / "network.txt").read_text().split()
    for who in ("KH09", "KH02", "observer", "recorder"):
        with network.open_session(endpoints, name="intruder", identity=who) as intruder:
            intrude(intruder)
    assert flight.finish()[0] == 0, flight.logs()
    run = reopen(flight.folder)
    assert not run.notes
    for name in TRIANGLE:
        assert "emergency stop" not in (flight.folder / "logs" / f"periodic-{name}.log").read_text()
    assert run.metrics["periodic"].lost == 0, "a pose with a higher number would have made all after it old"


SHORT = ("--case", "periodic", "--no-report", "--set", "duration_s=3", "--set", "rates.body_hz=50")


@pytest.mark.parametrize("protocol", ["unixsock-stream", "tls", "quic"])
def test_an_experiment_over_each_transport(tmp_path, protocol):
    secure = protocol in ("tls", "quic")
    listen = free_endpoint(0, protocol) if secure else f"{protocol}/{tmp_path}/router.sock"
    lab = ("--lab", str(new_lab(tmp_path / "lab"))) if secure else ()
    flight = Flight(tmp_path / "run", "triangle", *SHORT, *lab, f'network.listen=["{listen}"]')
    assert flight.finish()[0] == 0, flight.logs()
    assert f"router ready on {listen}" in (flight.folder / "logs" / "router.log").read_text()
    case = reopen(flight.folder).metrics["periodic"]
    assert case.lost == 0
    assert all(robot.messages > 10 for robot in case.robots)


@contextmanager
def ours(file):
    """The library that the wheel brings, from the very file."""
    with zenoh.open(zenoh.Config.from_file(str(file))):
        yield


def theirs(file):
    """A zenohd, from the same file."""
    return started(json.loads(file.read_text())["listen"]["endpoints"][0], "--config", str(file))


@contextmanager
def started(endpoint, *arguments):
    """A zenohd that listens."""
    process = subprocess.Popen([zenohd.folder() / "zenohd", *arguments], stdin=subprocess.DEVNULL)
    try:
        until(lambda: answers(endpoint, process), "zenohd answers")
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.wait(100.0)


def answers(endpoint, process):
    assert process.poll() is None
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def missing():
    """Why there is no zenohd; empty if there is one."""
    try:
        zenohd.folder()
    except zenohd.NotBuilt as error:
        return str(error)
    return ""


NEEDED = pytest.mark.skipif(bool(missing()), reason=missing())
WITH = [ours, pytest.param(theirs, marks=NEEDED)]


@pytest.mark.parametrize("start", WITH)
@pytest.mark.parametrize("secure", [False, True])
def test_an_experiment_at_a_router_of_somebody_else(tmp_path, start, secure):
    plain = free_endpoint(0, "tls" if secure else "tcp")
    rights, endpoint = None, plain
    options = ()
    if secure:
        folder = new_lab(tmp_path / "lab")
        rights = access_rights.rights(load("triangle").cases().values())
        (endpoint,) = lab.secured([plain], folder)
        options = ("--lab", str(folder))
    file = tmp_path / "zenohd.json5"
    file.write_text(json.dumps(of_zenohd([endpoint], rights=rights)))
    with start(file):
        flight = Flight(tmp_path / "run", "triangle", *SHORT, *options, f'network.connect=["{plain}"]')
        assert flight.finish()[0] == 0, flight.logs()
        if secure:
            with zenoh.open(config(settings("client", connect=[endpoint], name="x", identity="observer"))) as session:
                assert not [r for r in session.get("park/KH01/order", payload=b"{}", timeout=0.5) if r.ok]
    assert reopen(flight.folder).metrics["periodic"].lost == 0


@NEEDED
@pytest.mark.mechanism("zenohd")
def test_plain_zenohd_is_read_by_rest_and_freezes(tmp_path):
    """No file: a lease of 10 s. What the README says of REST."""
    endpoint, rest = free_endpoint(0), free_endpoint(0).partition("/")[2]

    def read(path, post=None):
        body = None if post is None else json.dumps(post).encode()
        asked = urllib.request.Request(f"http://{rest}/{path}", body, {"content-type": "application/json"})
        with urllib.request.urlopen(asked, timeout=10.0) as answer:
            return json.load(answer)

    with started(endpoint, "-l", endpoint, "--no-multicast-scouting", "--rest-http-port", rest) as process:
        changes = (*NEAR_TRIANGLE, f'network.connect=["{endpoint}"]')
        flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", *changes)
        flight.until_flown()
        (last,) = read("park/CF01/pose")
        assert (last["key"], last["encoding"]) == ("park/CF01/pose", "application/json")
        assert len(last["value"]["position"]) == 3
        for every in ("park/*/pose", "park/**"):  # and no errors
            assert {each["key"] for each in read(every)} == {f"park/{name}/pose" for name in TRIANGLE}
        replies = read("park/*/order", {"order": "get", "name": "clamp"})
        # the conductor has an order key too, and says that this is none of its orders
        told = [each["value"] for each in replies if each["key"] != "ERROR"]
        assert {each["robot"] for each in told if each["ok"]} == set(TRIANGLE)
        process.send_signal(signal.SIGSTOP)
        stopped = time.time()
        flight.until_said(r"router conductor: no router answers for \d+\.\d s")
        until(lambda: time.time() > stopped + 3.0, "every robot has had the time to hold")
        process.send_signal(signal.SIGCONT)
        flight.until_said(r"router conductor: a router answers again, after \d+\.\d s")
        flight.interrupt()
    assert_held_in_time(flight, "periodic", stopped)
    for name in TRIANGLE:
        assert typed(flight.folder / "periodic.mcap", f"/{name}/status")[-1].malformed == 0
