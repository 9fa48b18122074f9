"""DJI Tello, SDK 2.0: text commands over UDP, a state line ten times a second (Tello SDK 2.0 User Guide).

The drone's own units are centimetres and degrees, its yaw grows clockwise, and its sticks go from -100 to 100.
"""

from __future__ import annotations

import math
from typing import Final
from urllib.parse import urlsplit

import msgspec

from agents.body.interface import BodyError

HOST: Final = "192.168.10.1"  # of a Tello that is its own access point
CONTROL_PORT: Final = 8889  # at the drone for commands; djitellopy binds the same number here for the answers
STATE_PORT: Final = 8890  # here, where the drone sends its state
STATE_HZ: Final = 10.0
AUTO_LAND_S: Final = 15.0  # without a command for this long the drone lands by itself
TAKEOFF_HEIGHT: Final = 0.8  # [m] to which `takeoff` climbs
STICK: Final = 100  # full deflection
STICK_SPEED: Final = 1.0  # [m/s] at full deflection; measured on the wire only, the maker gives no figure
STICK_TURN: Final = math.radians(100.0)  # [rad/s] at full deflection, likewise


class TelloSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `device` table of a Tello."""

    silence_s: float = 1.0  # [s] without a state line after which the drone counts as lost; it comes at 10 Hz
    rc_hz: float = 20.0  # [1/s] stick positions sent
    low_battery: float = 0.10  # below this charge it does not take off, and lands

    def __post_init__(self) -> None:
        if not 0.3 <= self.silence_s <= 10.0:
            raise ValueError("silence_s must be 0.3 to 10 s, for the state comes every 0.1 s")
        if not 2.0 <= self.rc_hz <= 50.0:
            raise ValueError("rc_hz must be 2 to 50")
        if not 0.0 <= self.low_battery < 1.0:
            raise ValueError("low_battery is a share: 0 <= low_battery < 1")


def endpoint(robot: str, address: str) -> tuple[str, int]:
    """Host and port of `tello://HOST[:PORT]`.

    Raises:
        BodyError: If it is not of that form, or the host is no IPv4 address.
    """
    try:
        parts = urlsplit(address)
        host, port = parts.hostname or HOST, parts.port or CONTROL_PORT
    except ValueError as error:
        raise BodyError(f"{robot}: {address}: {error}; write tello://{HOST}") from error
    numbers = host.split(".")
    if len(numbers) != 4 or not all(n.isdecimal() and int(n) < 256 for n in numbers):
        # djitellopy tells drones apart by the address that their answers come from
        raise BodyError(f"{robot}: {address}: give the drone's IPv4 address, as in tello://{HOST}")
    return host, port


def sticks(velocity: tuple[float, float, float], yaw_rate: float, yaw: float) -> tuple[int, int, int, int]:
    """Arguments of `rc` (right, forward, up, clockwise) for a velocity in the world [m/s] and a yaw rate [rad/s]."""
    x, y, z = velocity
    cos, sin = math.cos(yaw), math.sin(yaw)
    forward, left = cos * x + sin * y, cos * y - sin * x
    return (
        _stick(-left / STICK_SPEED),
        _stick(forward / STICK_SPEED),
        _stick(z / STICK_SPEED),
        _stick(-yaw_rate / STICK_TURN),
    )


def motion(rc: tuple[int, int, int, int], yaw: float) -> tuple[float, float, float, float]:
    """Velocity in the world [m/s] and yaw rate [rad/s] of sticks at `yaw`: the inverse of `sticks`."""
    right, forward, up, clockwise = (value / STICK for value in rc)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (
        STICK_SPEED * (cos * forward + sin * right),
        STICK_SPEED * (sin * forward - cos * right),
        STICK_SPEED * up,
        -STICK_TURN * clockwise,
    )


def _stick(share: float) -> int:
    return max(-STICK, min(STICK, round(STICK * share)))
