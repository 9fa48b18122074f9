"""Two Tellos that are access points of their own: one address, two network interfaces, as a user without rights."""

import ctypes
import os
import socket
import subprocess
import threading
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from bridges.tello import twin as tello
from bridges.tello.library import TelloLibrary, filters_answers
from bridges.tello.protocol import TelloPlace
from tests.requests import request
from tests.system.machines import why_not
from tests.waiting import until
from twins.device import DeviceRequest, Faults

LACKING = why_not() or ("" if find_spec("djitellopy") else "needs djitellopy")
pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(LACKING), reason=LACKING)]
HOST, PORT = "192.168.10.1", 8889
NOBODY = 65534


@contextmanager
def inside(namespace):
    """This thread is in the network namespace of a process."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open() as own, Path(f"/proc/{namespace.pid}/ns/net").open() as other:
        assert libc.setns(other.fileno(), 0) == 0, os.strerror(ctypes.get_errno())
        try:
            yield
        finally:
            assert libc.setns(own.fileno(), 0) == 0, os.strerror(ctypes.get_errno())


def ip(words):
    subprocess.run(["ip", *words.split()], check=True)


@pytest.fixture
def computer():
    """Namespaces of a computer with two adapters, in which this thread is, and of the drones at their far ends."""
    with ExitStack() as stack:
        made = []
        for _ in range(3):
            process = stack.enter_context(subprocess.Popen(["unshare", "-n", "sleep", "600"]))
            stack.callback(process.kill)
            made.append(process)
        outside = Path("/proc/self/ns/net").readlink()
        until(lambda: all(Path(f"/proc/{each.pid}/ns/net").readlink() != outside for each in made))
        stack.enter_context(inside(made[0]))
        ip("link set lo up")
        for number in (1, 2):
            plug(number, made[number])
        yield made


def plug(number, drone):
    """Wi-Fi adapter `wl<number>` of the computer, in the network of a drone."""
    ip(f"link add wl{number} type veth peer name drone netns {drone.pid}")
    ip(f"addr add 192.168.10.2/24 dev wl{number}")
    Path(f"/proc/sys/net/ipv4/conf/wl{number}/rp_filter").write_text("0")
    ip(f"link set wl{number} up")
    with inside(drone):
        ip(f"addr add {HOST}/24 dev drone")
        ip("link set drone up")


def device(drone, battery, monkeypatch):
    """Protocol twin in the network of a drone, at the address of every Tello."""
    with inside(drone):
        wire = socket.socket(type=socket.SOCK_DGRAM)
        wire.bind((HOST, PORT))
        wire.setblocking(False)
    monkeypatch.setattr(tello, "_listen", lambda *_: wire)
    return tello.TelloDevice(DeviceRequest(request("tello"), Faults(battery=battery)))


@pytest.fixture
def drones(computer, monkeypatch):
    """The twins in flight, in a thread; the charges of their batteries differ."""
    devices = [device(each, battery, monkeypatch) for each, battery in zip(computer[1:], (0.5, 0.9), strict=True)]
    ending, ticks = threading.Event(), 0

    def serve():
        nonlocal ticks
        while not ending.wait(0.01):
            ticks += 1
            for each in devices:
                for wire in each.sockets():
                    each.serve(wire, 0.01 * ticks)
                each.advance(0.01 * ticks)

    thread = threading.Thread(target=serve)
    thread.start()
    yield devices
    ending.set()
    thread.join()
    for each in devices:
        each.close()


def test_each_drone_hears_its_own_commands(computer, drones):
    os.seteuid(NOBODY)
    try:
        library = TelloLibrary(interfaces=("wl1", "wl2"))
    finally:
        os.seteuid(0)
    first, second = (library.drone(TelloPlace(HOST, PORT, f"wl{number}")) for number in (1, 2))

    def state(drone, key):
        library.receive()
        return drone.get_current_state().get(key)

    for drone in (first, second):
        drone.send_command_without_return("command")
    until(lambda: (state(first, "bat"), state(second, "bat")) == (50, 90))
    first.send_command_without_return("takeoff")
    until(lambda: state(first, "h") > 50)
    assert state(second, "h") == 0
    ip("link del wl2")
    with pytest.raises(OSError, match="wl2 is not there"):
        second.send_command_without_return("command")
    plug(2, computer[2])
    second.send_command_without_return("takeoff")
    until(lambda: state(second, "h") > 50)
    library.close()
    assert not filters_answers("wl2")
    Path("/proc/sys/net/ipv4/conf/wl2/rp_filter").write_text("1")
    assert filters_answers("wl2")
