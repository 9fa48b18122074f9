"""A device that a process drives: a second body is refused before anything is sent."""

import socket
from dataclasses import replace

import pytest

from agents.body.device_locks import Claims
from agents.body.interface import BodyError
from agents.protocols.crazyflie import device_of
from bridges.crazyflie.body import CrazyflieBody
from bridges.khepera4.body import KheperaBody
from bridges.khepera4.link import KheperaAddress
from bridges.tello.body import TelloBody
from bridges.turtlebot3.body import TurtleBot3
from tests.bridges import turtlebots
from tests.requests import request


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path / "runs"))


def crazyflie(port):
    address = f"udp://127.0.0.1:{port}"
    return CrazyflieBody(request("crazyflie", [address])), device_of(f"udp://localhost:{port}")


def khepera(port):
    address = KheperaAddress.parse("R0", f"kteam://localhost:{port}")
    return KheperaBody(request("khepera4", [f"khepera4://127.0.0.1:{port}"])), address.device


def tello(port):
    return TelloBody(request("tello", [f"tello://127.0.0.1:{port}"], external=True)), "tello://127.0.0.1"


def turtlebot(port):
    endpoint = f"tcp/127.0.0.1:{port}"
    wanted = replace(turtlebots.request(endpoint), addresses=("ros2dds://tb3_0?distro=humble",))
    return TurtleBot3(wanted), f"ros2dds://tb3_0 by {endpoint}"


@pytest.mark.parametrize("opened", [crazyflie, khepera, tello, turtlebot])
def test_driven_device_gets_nothing_from_a_second_process(opened):
    with socket.socket(type=socket.SOCK_DGRAM) as packets, socket.socket() as connections:
        packets.bind(("127.0.0.1", 0))
        port = packets.getsockname()[1]
        connections.bind(("127.0.0.1", port))
        connections.listen()
        packets.setblocking(False)
        connections.setblocking(False)
        body, device = opened(port)
        first = Claims(["CF07"], [device])
        first.take()
        with pytest.raises(BodyError, match="is in use: this process drives it for CF07; end that first"):
            body.open()
        body.close()
        with pytest.raises(BlockingIOError):
            packets.recv(1)
        with pytest.raises(BlockingIOError):
            connections.accept()
        first.release()


@pytest.mark.slow
def test_unopened_body_leaves_its_device_to_others():
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        body, device = khepera(nobody.getsockname()[1])  # refuses connections: it does not listen
        with pytest.raises(BodyError, match="no Khepera answers"):
            body.open()
        Claims(["CF07"], [device]).take()
