"""DJI Tello, SDK 2.0: text commands over UDP, a state line ten times a second (Tello SDK 2.0 User Guide).

The drone's own units are centimetres and degrees, its yaw grows clockwise, and its sticks go from -100 to 100.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple
from urllib.parse import urlsplit

import msgspec

from agents.body.interface import BodyError, settings
from agents.network.messages import State

HOST: Final = "192.168.10.1"  # address of a Tello that is its own access point
INTERFACE: Final = re.compile(r"[^\s/:%]{1,15}")  # name of a network interface of Linux
CONTROL_PORT: Final = 8889  # port of the drone for commands; djitellopy binds the same number here for the answers
STATE_PORT: Final = 8890  # here, where the drone sends its state
STATE_HZ: Final = 10.0
AUTO_LAND_S: Final = 15.0  # [s] time without a command after which the drone lands by itself
TAKEOFF_HEIGHT: Final = 0.8  # [m] height to which `takeoff` climbs
STICK: Final = 100  # full deflection
STICK_SPEED: Final = 1.0  # [m/s] speed at full deflection, unless measured: a guess, the maker gives no figure
TEST_SPEED: Final = 0.2  # [m/s] speed of the stick test, as far as known: 2 s forward, 1 s of rest, 2 s back
TEST_ENDS_S: Final = (1.0, 3.0, 4.0, 6.0, 7.0)  # [s] ends of its parts, from the end of the take-off
TEST_WINDOW_S: Final = 1.0  # the speed of sticks is that over this time, when it has settled
SLOWEST_STICK: Final = 0.1  # [m/s] least speed at full deflection
STICK_UNEVEN: Final = 0.3  # largest difference of forward and back, as a share of their mean
STICK_OFF: Final = 0.1  # largest error of the setting `stick_speed`, as a share of it
STICK_TURN: Final = math.radians(100.0)  # [rad/s] rate at full deflection, likewise


class TelloSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `device` table of a Tello."""

    silence_s: float = 1.0  # [s] time without a state line after which the drone counts as lost; it comes at 10 Hz
    rc_hz: float = 20.0  # [1/s] stick positions sent
    low_battery: float = 0.10  # charge below which it does not take off, and lands
    stick_speed: float = (
        STICK_SPEED  # [m/s] speed at full deflection of the sticks; `./zenpark preflight --sticks` measures it
    )
    stick_test: bool = False  # flies the stick test after the take-off instead of setpoints
    twin_stick_speed: float = STICK_SPEED  # used by the twin alone: [m/s] that its sticks really give

    def __post_init__(self) -> None:
        if not (0.1 <= self.stick_speed <= 10.0 and 0.1 <= self.twin_stick_speed <= 10.0):
            raise ValueError("stick_speed must be 0.1 to 10 m/s")
        if not 0.3 <= self.silence_s <= 10.0:
            raise ValueError("silence_s must be 0.3 to 10 s, for the state comes every 0.1 s")
        if not 2.0 <= self.rc_hz <= 50.0:
            raise ValueError("rc_hz must be 2 to 50")
        if not 0.0 <= self.low_battery < 1.0:
            raise ValueError("low_battery is a share: 0 <= low_battery < 1")


class TelloPlace(NamedTuple):
    """Place of a Tello: host, port, and the network interface of this computer that leads there."""

    host: str
    port: int
    interface: str = ""  # empty: as the computer routes

    @property
    def device(self) -> str:
        """Host and interface: what distinguishes Tellos of one address."""
        return f"{self.host}%{self.interface}" if self.interface else self.host


def endpoint(robot: str, address: str) -> TelloPlace:
    """Place of `tello://HOST[%INTERFACE][:PORT]`, with an IPv4 address as its host; raises BodyError for others."""
    try:
        parts = urlsplit(address)
        host, zone, interface = (parts.hostname or HOST).partition("%")
        port = parts.port or CONTROL_PORT
    except ValueError as error:
        raise BodyError(f"{robot}: '{address}': {error}; write tello://{HOST}") from error
    if zone and not INTERFACE.fullmatch(interface):
        form = f"write its name as `ip link` shows it, as in tello://{HOST}%wlan1"
        raise BodyError(f"{robot}: '{address}' names no network interface; {form}")
    numbers = host.split(".")
    if len(numbers) != 4 or not all(n.isdecimal() and int(n) < 256 for n in numbers):
        # djitellopy tells drones apart by the address that their answers come from
        raise BodyError(f"{robot}: '{address}' is no Tello's address; give its IPv4 address, as in tello://{HOST}")
    return TelloPlace(host, port, interface)


def sticks(
    velocity: tuple[float, float, float], yaw_rate: float, yaw: float, stick_speed: float = STICK_SPEED
) -> tuple[int, int, int, int]:
    """Arguments of `rc` (right, forward, up, clockwise) for a velocity in the world [m/s] and a yaw rate [rad/s].

    `stick_speed` is the speed at full deflection [m/s].
    """
    x, y, z = velocity
    cos, sin = math.cos(yaw), math.sin(yaw)
    forward, left = cos * x + sin * y, cos * y - sin * x
    return (
        _stick(-left / stick_speed),
        _stick(forward / stick_speed),
        _stick(z / stick_speed),
        _stick(-yaw_rate / STICK_TURN),
    )


def test_deflection(stick_speed: float) -> int:
    """Deflection of the sticks in the stick test: 20 unless another `stick_speed` is known."""
    return _stick(TEST_SPEED / stick_speed)


def stick_test(elapsed: float, stick_speed: float) -> tuple[int, int, int, int] | None:
    """Sticks of the stick test `elapsed` [s] after the take-off; None when it is over."""
    deflection = test_deflection(stick_speed)
    forward = (0, deflection, 0, -deflection, 0)
    return next(((0, stick, 0, 0) for stick, end in zip(forward, TEST_ENDS_S, strict=True) if elapsed < end), None)


def judge_stick_test(states: Sequence[State], failure: str, device: Mapping[str, object]) -> tuple[str, str]:
    """Result of a stick test and remedy: speed at full deflection [m/s], from that over a second forward and back."""
    speeds = _test_speeds([state for state in states if state.position is not None and state.yaw is not None])
    if failure:
        fast = speeds is not None and max(speeds) > 2.0 * TEST_SPEED
        remedy = "it is fast: double stick_speed in its table, then again" if fast else "look at its log"
        return failure, f"{remedy}; do not fly it before the cause is clear"
    if speeds is None:
        return "its position was not known long enough", "see the line on its position"
    believed = settings(TelloSettings, "", device).stick_speed
    forward, back = (speed * STICK / test_deflection(believed) for speed in speeds)
    measured = 0.5 * (forward + back)
    found = (
        f"{measured:.2f} m/s at full deflection ({forward:.2f} forward, {back:.2f} back), `stick_speed` is {believed:g}"
    )
    if min(forward, back) < SLOWEST_STICK or abs(forward - back) > STICK_UNEVEN * measured:
        return found, "uneven: no draught, the floor well lit and patterned, propellers, then again"
    off = abs(measured - believed) > STICK_OFF * believed
    return found, f"write device = {{ stick_speed = {measured:.2f} }} in its table, then again" if off else ""


def _test_speeds(known: Sequence[State]) -> tuple[float, float] | None:
    """Largest mean speeds [m/s] over `TEST_WINDOW_S` along the nose, forward and back; None for shorter times."""
    times = [state.stamp for state in known]
    yaw = (known[0].yaw or 0.0) if known else 0.0
    along = [state.position[0] * math.cos(yaw) + state.position[1] * math.sin(yaw) for state in known if state.position]
    ends = ((begin, bisect_left(times, time + TEST_WINDOW_S)) for begin, time in enumerate(times))
    speeds = [(along[end] - along[k]) / (times[end] - times[k]) for k, end in ends if end < len(times)]
    return (max(speeds), -min(speeds)) if speeds else None


def motion(
    rc: tuple[int, int, int, int], yaw: float, stick_speed: float = STICK_SPEED
) -> tuple[float, float, float, float]:
    """Velocity in the world [m/s] and yaw rate [rad/s] of sticks at `yaw`: the inverse of `sticks`."""
    right, forward, up, clockwise = (value / STICK for value in rc)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (
        stick_speed * (cos * forward + sin * right),
        stick_speed * (sin * forward - cos * right),
        stick_speed * up,
        -STICK_TURN * clockwise,
    )


def _stick(share: float) -> int:
    return max(-STICK, min(STICK, round(STICK * share)))
