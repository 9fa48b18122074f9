"""Refusals of all bodies: wrong rows before they open, and a device that another process drives."""

from dataclasses import replace

import pytest

from agents.body.device_locks import Claims
from agents.body.interface import BodyError, refuse
from agents.body.kinds import KINDS
from agents.plugins import registry
from bridges.khepera4.protocol import PARK_PORT
from tests.requests import request

pytestmark = pytest.mark.usefixtures("runtime_folder")

BODIES = {kind.name: registry.load(registry.BODIES, kind.bodies[0]) for kind in KINDS.usable() if kind.bodies}
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
        ("tello", [f"{TELLO}%wlan1", TELLO], {}, True, "R0 has the same body, tello://10.*name the network"),
        ("tello", f"{TELLO}%", {}, True, "names no network interface"),
    ],
)
def test_wrong_addresses_and_settings_are_named(kind, addresses, device, external, said):
    asked = request(kind, addresses, device=device, external=external)
    with pytest.raises(BodyError, match=said):
        made(BODIES[kind], asked)


# two names of one device of each body
NAMES = {
    "radio": (RADIO, f"{RADIO[:-10]}e7e7e7e701?rate_limit=100"),
    "usb": ("usb://0", "usb://00"),
    "udp": ("udp://localhost:19850", "udp://127.0.0.1:19850"),
    "khepera4": ("khepera4://localhost", f"kteam://127.1:{PARK_PORT}"),
    "kteam": ("kteam:///dev/stdin", "kteam:///proc/self/fd/0"),
    "tello": ("tello://192.0.2.7", "tello://192.0.2.7%wlan1:1"),
    "ros2dds": ("ros2dds://tb3_0?distro=humble", "rmw://tb3_0"),
    "rmw": ("rmw://tb3_0?domain=3", "rmw://tb3_0/?distro=jazzy&domain=3"),
}


@pytest.mark.parametrize("word", NAMES)
def test_body_knows_its_device_by_any_name(word):
    body = registry.load(registry.BODIES, word)
    kind = next(kind for kind, each in BODIES.items() if each is body)
    routers = ("tcp/127.0.0.1:7447", "tls/localhost:7447")
    asked = [
        replace(request(kind, [address]), endpoints=(router,))
        for address, router in zip(NAMES[word], routers, strict=True)
    ]
    first, second = map(Claims.of, asked)
    first.take()
    with pytest.raises(BodyError, match="is in use: this process drives it for R0; end that first"):
        second.take()
    first.release()


def test_every_device_has_two_names():
    registered = registry.registered(registry.BODIES)
    bodies = {
        name
        for name, (entry, *_) in registered.items()
        if entry.value.startswith("bridges.") and entry.module != "bridges.external"
    }
    assert bodies == NAMES.keys(), f"add a row to NAMES in tests/bridges/test_bodies.py: {bodies - NAMES.keys()}"
