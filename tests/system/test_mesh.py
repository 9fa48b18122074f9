"""A mesh: the reference experiment without any router; each robot is linked with exactly its neighbours."""

import math
import time
from contextlib import ExitStack

import pytest
import zenoh

from agents.network import endpoints as topology
from agents.network import messages
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from experiments.definition import access_rights, mesh
from experiments.file.document import load
from experiments.real_time.hosts import authority
from experiments.run import reopen
from tests.system.lab import TRIANGLE, Flight, Started, Watcher
from tools.commands import orders
from tools.commands.network import members

pytestmark = pytest.mark.system

MESH = "network.topology=mesh"


def peers(process, ports):
    """Members that a process is linked with by a connection of its own, by the ports at which they listen."""
    return {
        ports[each.raddr.port]
        for each in process.net_connections("inet")
        if each.status == "ESTABLISHED" and each.raddr and each.raddr.port in ports
    }


def test_the_reference_experiment_without_a_router(tmp_path, capsys):
    flight = Flight(tmp_path / "run", "robotic-park", "--case", "event", MESH)
    flight.until_flown()
    endpoints = (flight.folder / "network.txt").read_text().split()
    ports = {int(topology.bare([each])[0].rpartition(":")[2]): topology.owner(each) for each in endpoints}
    children = flight.children()
    assert "router" not in children

    hears = access_rights.senders_by_receiver(load("robotic-park").plan)
    robots = list(hears)
    linked = {name: set() for name in robots}
    for name in robots:
        for other in peers(children[name], ports):
            linked[name].add(other)
            linked[other].add(name)
    for name, heard in hears.items():
        assert linked[name] == heard | {other for other in robots if name in hears[other]}, name

    with Watcher(*endpoints) as watcher:
        status = watcher.status
        watcher.until(lambda: len(watcher.alive) == len(robots) == len(watcher.state), "everybody is seen")
        assert {"conductor", "recorder", *robots} <= {member.name for member in members(watcher.session)}
        children["CF02"].kill()
        near = linked["CF02"]
        watcher.until(
            lambda: all((status[name].missing == ["CF02"]) == ("CF02" in hears[name]) for name in near),
            "its neighbours miss it",
        )
        begun = {name: status[name].decisions for name in robots if name != "CF02"}
        watcher.until(lambda: all(status[name].decisions > count for name, count in begun.items()), "the others go on")
        assert all(not status[name].missing for name in begun if "CF02" not in hears[name])
    assert orders.estop(connect=endpoints, realm="park", identity="operator") == 0
    assert capsys.readouterr().out == f"stopped: {', '.join(sorted(begun))} (at a mesh)\n"
    flight.finish()
    run = reopen(flight.folder)
    assert run.notes == ("event: lost CF02",) or "event" in run.traces


def test_robot_cut_off_from_everybody_holds(tmp_path):
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", MESH, "duration_s=60")
    flight.until_flown()
    endpoints = (flight.folder / "network.txt").read_text().split()
    children = flight.children()
    with Watcher(*endpoints) as watcher:
        watcher.until(lambda: "CF01" in watcher.state, "it is seen")
        for name in ("KH01", "KH02"):
            children[name].kill()
        watcher.until(lambda: sorted(watcher.status["CF01"].missing) == ["KH01", "KH02"], "it misses them")
        watcher.until(lambda: math.hypot(*watcher.state["CF01"].velocity) < 0.05, "it holds")
    flight.interrupt()


def test_an_endpoint_that_somebody_else_has_is_named(tmp_path):
    taken = free_endpoint(0)
    with zenoh.open(config(settings("router", listen=[taken], name="stranger"))):
        where = f'network.addresses={{KH01 = "{taken}"}}'
        flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", MESH, where)
        code, _ = flight.finish()
    assert code == 2
    assert "KH01 cannot listen on" in flight.said()
    assert "network.addresses" in flight.said()


@pytest.mark.mechanism("mesh")
def test_a_silent_missing_link_is_named():
    right = [topology.owned(endpoint, name) for endpoint, name in zip(free(3), TRIANGLE, strict=True)]
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


def free(count):
    """So many endpoints at which nobody listens."""
    found = set()
    while len(found) < count:
        found.add(free_endpoint(0))
    return sorted(found)


def test_lab_members_let_nobody_exceed_its_rights(tmp_path):
    """No router could refuse anything in a mesh: the receiver of an order does."""
    file = tmp_path / "mesh.toml"
    file.write_text(load("triangle").path.read_text() + '\n[network]\ntopology = "mesh"\nlab = "lab"\n')
    case = load(file).plan
    listening = mesh.listening_hosts(case)
    identities = {role: role for role in authority.SERVICES}
    authority.create(
        tmp_path / "lab", {**identities, **dict.fromkeys((*case.names, "KH09"), "robot")}, listening=listening
    )
    flight = Flight(tmp_path / "run", file, "--case", "periodic", "duration_s=6")
    flight.until_flown()
    endpoints = (flight.folder / "network.txt").read_text().split()
    stop = messages.encode(messages.Stop("mallory", "because"))
    pose = messages.encode(messages.pose("KH01", 10**9, time.time(), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], yaw=0.0))
    for who in ("KH09", "KH02", "observer", "recorder"):
        with network.open_session(endpoints, name="intruder", identity=who) as intruder:
            for _ in range(10):
                for key in ("park/estop", "park/**"):
                    intruder.put(key, stop, encoding=messages.JSON)
                intruder.put("park/KH01/pose", pose, encoding=messages.JSON)
            order = messages.encode(messages.Order("land"))  # behind all others on the same way
            assert not [reply for reply in intruder.get("park/CF01/order", payload=order, timeout=0.5) if reply.ok]
    code, _ = flight.finish()
    assert code == 0, flight.logs()
    run = reopen(flight.folder)
    assert not run.notes
    for name in TRIANGLE:
        assert "emergency stop" not in (flight.folder / "logs" / f"periodic-{name}.log").read_text()
    assert run.metrics["periodic"].lost == 0, "a pose with a higher number would have made all after it old"
