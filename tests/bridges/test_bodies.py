"""Refusals of all bodies: wrong rows before they open, and a device that another process drives."""

import select
import socket
from contextlib import ExitStack, suppress

import pytest

from agents.body.device_locks import Claims
from agents.body.interface import BodyError, refuse
from bridges.crazyflie.body import CrazyflieBody
from bridges.crazyflie.protocol.addresses import device_of
from bridges.khepera4.body import KheperaBody
from bridges.khepera4.link import KheperaAddress
from bridges.tello.body import TelloBody
from bridges.turtlebot3.body import TurtleBot3
from tests.bridges.turtlebot3 import turtlebots
from tests.requests import request

pytestmark = pytest.mark.usefixtures("runtime_folder")

BODIES = {"crazyflie": CrazyflieBody, "khepera4": KheperaBody, "tello": TelloBody, "turtlebot3": TurtleBot3}
RADIO, KHEPERA, TELLO, ROS = "radio://0/80/2M/E7E7E7E701", "khepera4://h", "tello://10.0.0.2", "ros2dds://"
NO_CRAZYFLIE = r"R0: .* is no Crazyflie's address; write radio://0/80/2M/E7E7E7E701"
NO_TELLO = r"^R0: .*tello://192\.168\.10\.1"


GPS, OUTSIDE = ({"positioning": {"system": system}} for system in ("gps", "external"))
NO_RANGE = {"server": "2023-04-10", "ranges": True}


def made(body, asked):
    refuse(body, asked)
    return body(asked)


@pytest.mark.parametrize(
    ("kind", "addresses", "device", "external", "said"),
    [
        ("crazyflie", "radio://0/80/3M/E7", {}, False, NO_CRAZYFLIE),
        ("crazyflie", "udp://127.0.0.1", {}, False, NO_CRAZYFLIE),
        ("crazyflie", "usb://", {}, False, NO_CRAZYFLIE),
        ("crazyflie", "", {}, False, NO_CRAZYFLIE),
        ("khepera4", "khepera4", {}, False, "^R0: 'khepera4'"),
        ("khepera4", "khepera4://", {}, False, "^R0: 'khepera4://'"),
        (
            "khepera4",
            "kteam://10.0.0.3",
            {},
            False,
            r"^R0: 'kteam://10\.0\.0\.3' is no Khepera's address; write khepera4://HOST ",
        ),
        ("khepera4", "khepera4://h:port", {}, False, "^R0: 'khepera4://h:port'"),
        ("khepera4", "khepera4://h?server=2024", {}, False, r"^R0: 'khepera4://h\?server=2024' .*2025-05"),
        ("khepera4", "khepera4://h?year=2023", {}, False, r"^R0: 'khepera4://h\?year=2023' "),
        ("tello", "tello://kitchen", {}, True, NO_TELLO),
        ("tello", "tello://1.2.3.256", {}, True, NO_TELLO),
        ("tello", "tello://1.2.3.4:x", {}, True, NO_TELLO),
        ("turtlebot3", "ros2dds://tb3-0", {}, False, "R0: 'tb3-0' is no ROS namespace"),
        ("turtlebot3", "rmw://tb3_0?domain=500", {}, False, "domain '500' is no number from 0 to 232"),
        ("turtlebot3", "rmw://tb3_0?distro=foxy", {}, False, "distro 'foxy' is not known"),
        ("turtlebot3", "rmw://tb3_0?colour=red", {}, False, "'colour' is no part"),
        ("turtlebot3", "radio://0", {}, False, "is no TurtleBot3; write it like ros2dds://tb3_0"),
        ("crazyflie", RADIO, {"contrl": "position"}, False, "^R0: device: .*contrl"),
        ("crazyflie", RADIO, {"log_hz": 500.0}, False, "^R0: device: .*log_hz"),
        ("crazyflie", RADIO, GPS, False, "^R0: device: .*positioning"),
        ("khepera4", KHEPERA, {"poll_hz": 100.0}, False, "^R0: device: .*poll_hz must be 2 to 30"),
        ("khepera4", KHEPERA, {"servre": "fork"}, False, "^R0: device: .*`servre`; its fields are server, poll_hz"),
        ("khepera4", KHEPERA, NO_RANGE, False, "device: .*2023-04-10 has no range"),
        ("khepera4", KHEPERA, {"server": "fork", "poll_hz": 10}, False, "poll_hz must be 22 to 30 with server"),
        ("tello", TELLO, {"rc_hz": True}, True, "^R0: device: .*rc_hz"),
        ("tello", TELLO, {"low_battery": 20}, True, "^R0: device: .*low_battery"),
        ("tello", TELLO, {"silence_s": 0.01}, True, "^R0: device: .*silence_s must be 0.3 to 10 s"),
        ("turtlebot3", ROS, {"speed": 1.0}, False, "^R0: device: .*Object contains unknown field `speed`"),
        ("turtlebot3", ROS, {"distro": "foxy"}, False, r"^R0: device: .*at `\$.distro`"),
        ("crazyflie", [RADIO] * 2, {}, False, "R1: R0 has the same body, radio://.*; give each its own address"),
        ("crazyflie", RADIO, OUTSIDE, False, "needs position = "),
        ("tello", "tello", {}, False, 'a Tello does not measure its position; write position = "external"'),
        ("tello", [TELLO, f"{TELLO}:1"], {}, True, "R1: R0 has the same body, tello://10.*192.168.10.1%wlan1"),
        ("tello", [f"{TELLO}%wlan1", TELLO], {}, True, "10.0.0.2, one of them without its interface; name that"),
        ("tello", f"{TELLO}%", {}, True, "names no network interface"),
    ],
)
def test_wrong_addresses_and_settings_are_named(kind, addresses, device, external, said):
    asked = request(kind, addresses, device=device, external=external)
    with pytest.raises(BodyError, match=said):
        made(BODIES[kind], asked)


def crazyflie(port):
    return CrazyflieBody(request("crazyflie", [f"udp://127.0.0.1:{port}"])), device_of(f"udp://localhost:{port}")


def khepera(port):
    device = KheperaAddress.parse("R0", f"kteam://localhost:{port}").device
    return KheperaBody(request("khepera4", [f"khepera4://127.0.0.1:{port}"])), device


def tello(port):
    return TelloBody(request("tello", [f"tello://127.0.0.1:{port}"], external=True)), "tello://127.0.0.1"


def turtlebot(port):
    endpoint = f"tcp/127.0.0.1:{port}"
    return TurtleBot3(turtlebots.request(endpoint, "ros2dds://tb3_0?distro=humble")), f"ros2dds://tb3_0 by {endpoint}"


def free_for_both(stack):
    """Sockets of UDP and TCP at one port, which other processes may have for one of the two."""
    while True:
        packets = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        connections = stack.enter_context(socket.socket())
        packets.bind(("127.0.0.1", 0))
        with suppress(OSError):
            connections.bind(("127.0.0.1", port := packets.getsockname()[1]))
            return packets, connections, port


@pytest.mark.parametrize("opened", [crazyflie, khepera, tello, turtlebot])
def test_driven_device_gets_nothing_from_a_second_process(opened):
    with ExitStack() as both:
        packets, connections, port = free_for_both(both)
        connections.listen()
        body, device = opened(port)
        first = Claims(["CF07"], [device])
        first.take()
        with pytest.raises(BodyError, match="is in use: this process drives it for CF07; end that first"):
            body.open()
        body.close()
        assert select.select([packets, connections], [], [], 0.0)[0] == []
        first.release()


@pytest.mark.slow
def test_unopened_body_leaves_its_device_to_others():
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        body, device = khepera(nobody.getsockname()[1])  # refuses connections: it does not listen
        with pytest.raises(BodyError, match="no Khepera answers"):
            body.open()
        Claims(["CF07"], [device]).take()
