"""Two routers: who loses one goes on at the other, the first comes back, and a newcomer sees everybody at either."""

import time

import msgspec
import psutil
import pytest
import zenoh

from agents.network import lab, messages, pubsub
from agents.network import session as network
from agents.network.access_control import Rights
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from experiments.run import reopen
from tests.conftest import RouterProcess
from tests.system.lab import NEAR_TRIANGLE, TRIANGLE, Flight, Watcher, assert_held_in_time, until
from tests.system.secured import FLOWN, Laboratory, refused

pytestmark = pytest.mark.system


def routers(flight):
    """Routers of a run, with their endpoints."""
    found = []
    for child in psutil.Process(flight.process.pid).children():
        line = child.cmdline()
        if "agents.runtime.router" in line:
            found.append((child, line[line.index("--listen") + 1]))
    endpoints = (flight.folder / "network.txt").read_text().split()
    return sorted(found, key=lambda pair: endpoints.index(pair[1]))


def test_a_killed_router_holds_nobody_up(tmp_path):
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", "network.routers=2", "duration_s=8")
    flight.until_flown()
    (first, one), (_, other) = routers(flight)
    with Watcher(other) as watcher:
        watcher.until(lambda: len(watcher.state) == 3 == len(watcher.alive), "robots at one are seen at the other")
        first.kill()
        told = {name: state.seq for name, state in watcher.state.items()}
        watcher.until(lambda: all(watcher.state[name].seq > told[name] + 10 for name in told), "all go on")
        flight.until_said(r"the router ended \(killed by SIGKILL\); started again: all go on at another meanwhile")
        with Watcher(one) as late:
            late.until(lambda: len(late.state) == 3 == len(late.alive), "a newcomer at the first sees all")
        watcher.until(lambda: all(not status.missing for status in watcher.status.values()), "nobody is missed")
    code, _ = flight.finish()
    assert code == 0, flight.logs()
    run = reopen(flight.folder)
    assert not run.notes, "nobody was held for lost, and the recording is whole"
    trace = run.traces["periodic"]
    holds = [event.text for event in trace.events if event.kind in ("hazard", "robot") and "hold" in event.text]
    assert not holds


@pytest.fixture
def router_lab(tmp_path):
    """Robots in flight at one router of a lab, and the endpoint of another that is linked with it."""
    with Laboratory(tmp_path, linked=True) as made:
        (other,) = lab.secured([free_endpoint(preferred_port=0, protocol="tls")], made.folder)
        made.serve(other, "--connect", made.endpoint)
        made.fly()
        yield made, other


def test_intruder_gets_nothing_at_the_other_router_either(router_lab):
    made, other = router_lab
    keys = made.watcher.keys
    assert msgspec.json.decode(made.rights.read_bytes(), type=Rights).linked
    with Watcher(other) as looker:  # as operator: through the link everything is seen, and orders are carried
        looker.until_all("running", *FLOWN)
        assert looker.order("KH01", messages.Order("get", name="speed")).robot == "KH01"
    before = made.statuses()
    forged = messages.encode(messages.pose("KH01", 10**9, time.time(), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], yaw=0.0))
    stop = messages.encode(messages.Stop("mallory", "because"))
    for mode in ("client", "router"):  # the latter would be a link, were it a router's certificate
        chosen = config(settings("client", connect=[other], name="intruder", identity="KH03"))
        chosen.insert_json5("mode", f'"{mode}"')
        with zenoh.open(chosen) as intruder:
            states = pubsub.subscriber(intruder, keys.state("*"))
            for _ in range(20):
                intruder.put(keys.pose("KH01"), forged, encoding=messages.JSON)
                intruder.put(keys.estop, stop, encoding=messages.JSON)
                intruder.put("park/**", stop, encoding=messages.JSON)
            order = messages.encode(messages.Order("land"))  # behind all others on the same way
            assert not [reply for reply in intruder.get(keys.order("KH01"), payload=order, timeout=1.0) if reply.ok]
            heard = {str(sample.key_expr) for sample in network.received(states.handler)}
            assert heard <= {"park/**"}, "its own words, and nobody else's"
    with refused():
        zenoh.open(config(settings("client", connect=[other.partition("#")[0]], name="intruder")))
    after = made.statuses()
    for name in FLOWN:
        assert after[name].phase == "running"
        assert (after[name].malformed, after[name].refused) == (before[name].malformed, before[name].refused)
        assert after[name].lost == before[name].lost


@pytest.mark.mechanism("router frozen")
def test_robots_hold_while_a_long_lease_router_freezes(patient_router, tmp_path):
    changes = (f'network.connect=["{patient_router.endpoint}"]', "safety.neighbour_timeout_s=0.6")
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", *NEAR_TRIANGLE, *changes)
    flight.until_flown()
    with patient_router.frozen() as stopped:
        flight.until_said(r"router conductor: no router answers for \d+\.\d s")
        until(lambda: time.time() > stopped + 1.6, "every robot has had the time to hold")
    flight.until_said(r"router conductor: a router answers again, after \d+\.\d s")
    for name in TRIANGLE:
        flight.until_said(rf"hazard {name}: over: no connection to a router")
    flight.interrupt()
    assert_held_in_time(flight, "periodic", stopped)


def test_run_continues_at_second_router_while_first_freezes(patient_router, tmp_path):
    second = RouterProcess(lease_s=60.0)
    try:
        both = f'network.connect=["{patient_router.endpoint}", "{second.endpoint}"]'
        flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", both, "duration_s=8")
        flight.until_flown()
        with patient_router.frozen() as stopped:
            flight.until_said(r"router conductor: a router answers again, after \d\.\d s")
            code, _ = flight.finish()
            assert code == 0, flight.logs()
        assert_held_in_time(flight, "periodic", stopped)
    finally:
        second.stop()
