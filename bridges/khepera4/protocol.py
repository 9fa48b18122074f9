"""Khepera IV: the two protocols in use, their words and units, and where its range sensors look.

*Park* are the servers of Robotic Park on the robot: TCP 50000, ASCII without delimiters, one read of the server is one
command, centimetres; `PARK` has each that was published. *K-Team* is the maker's `kh4server`: lines over a serial port
or TCP, motor units and encoder pulses. Figures: Khepera IV User Manual, rev. 1.1.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final, Literal

import msgspec

PARK_PORT: Final = 50000
GAP_S: Final = 0.010  # [s] pause between two park commands: glued in one segment, the second is lost
PULSE: Final = 6.781e-6  # [m] way per encoder pulse
UNIT: Final = 0.6781e-3  # [m/s] speed per unit: pulses per 10 ms
BASE: Final = 0.1054  # [m] distance of the wheels
FASTEST: Final = 1200  # units: 0.81 m/s
CENTIMETRE: Final = 0.01

RIM: Final = 0.070  # [m] distance from the robot's centre to its sensors
# [rad] ultrasonic, in the order of both protocols
SOUND_BEARING: Final = tuple(map(math.radians, (90.0, 45.0, 0.0, -45.0, -90.0)))
# [rad] infrared; four look down
LIGHT_BEARING: Final = tuple(map(math.radians, (135.0, 90.0, 45.0, 0.0, -45.0, -90.0, -135.0, 180.0)))
SOUND_NOTHING: Final = 1000  # [cm] nothing between 25 and 250 cm; 2000: switched off
SOUND_NEAREST: Final = 0.25  # [m] nearer than this it reads 0
LIGHT_NOTHING: Final = 100  # reflected light of nothing at all
LIGHT_TOUCHING: Final = 1000
LIGHT_SCALE: Final = 0.0925  # [m] chosen so that LIGHT_NOTHING falls at 0.2 m; not calibrated, surfaces differ


Server = Literal["2023-01-07", "2023-01-15", "2023-04-10", "2025-05", "fork", "kteam"]


@dataclass(frozen=True)
class ParkServer:
    """Behaviour of one published server of Robotic Park (`server.c`, `prog-template.c` of its ROS package).

    All read one command per `read()`, without a time limit for the last one: none stops a robot without a link.
    """

    answer: Literal["increments", "heading", "pose"]  # answer to `p`: d,dθ or d,θ or x,y,θ
    decimals: int  # decimals of the numbers in that answer
    drives: bool  # whether `d` moves the robot; else only `g` does
    per_turn: bool  # d of `p` is the way in one turn of the server's loop, so each other command swallows a part
    clients: int | None  # connections that it accepts in its life; None: any number, one after the other
    base: float = 0.105  # [m] distance of the wheels by which it computes angles

    @property
    def posed(self) -> bool:
        """Whether `i` sets the heading, too: where `p` answers with a pose."""
        return self.answer == "pose"


PARK: Final[dict[str, ParkServer]] = {
    "2023-01-07": ParkServer("increments", 4, drives=True, per_turn=False, clients=1),
    "2023-01-15": ParkServer("heading", 4, drives=False, per_turn=True, clients=1),
    "2023-04-10": ParkServer("pose", 4, drives=False, per_turn=False, clients=1),
    "2025-05": ParkServer("pose", 2, drives=True, per_turn=False, clients=None, base=BASE),
    "fork": ParkServer("heading", 4, drives=True, per_turn=True, clients=None),
}
NEWEST: Final = "2025-05"


class Khepera4Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `device` table of a Khepera IV."""

    server: Server | None = None  # what runs on the robot; None: found out where `p` tells, else refused
    poll_hz: float = 25.0  # [1/s] drive command and odometry
    ranges: bool | None = None  # read its range sensors, five times a second; None: with K-Team's protocol only
    silence_s: float = 0.5  # [s] time without an answer after which the robot is stopped
    low_battery: float = 0.05  # charge below which it stops (K-Team's protocol only; park has no battery)

    def __post_init__(self) -> None:
        if not 2.0 <= self.poll_hz <= 30.0:
            raise ValueError("poll_hz must be 2 to 30: the robot wants 10 ms between two commands")
        if not 0.1 <= self.silence_s <= 10.0:
            raise ValueError("silence_s must be 0.1 to 10 s")
        if not 0.0 <= self.low_battery < 1.0:
            raise ValueError("low_battery is a share: 0 <= low_battery < 1")
        if self.ranges and self.server not in {None, "kteam", "2023-01-07"}:
            raise ValueError(
                f"ranges: the server of {self.server} has no range poll that is safe (it takes get_data for a goal, or "
                "does not know it); leave ranges out"
            )
        if self.server in PARK and PARK[self.server].per_turn and self.poll_hz < 22.0:
            raise ValueError(f"poll_hz must be 22 to 30 with server = '{self.server}': it forgets way after 50 ms")


def fitting(answer: str) -> list[str]:
    """Park servers that may give such an answer to `p`."""
    words = answer.split(",")
    if not all(re.fullmatch(r"[-+]?\d+\.\d+", word) for word in words):
        return []
    decimals = {len(word.partition(".")[2]) for word in words}
    return [
        name
        for name, server in PARK.items()
        if len(words) == (3 if server.answer == "pose" else 2) and decimals == {server.decimals}
    ]


def park_drive(v: float, turn: float) -> bytes:
    """Command of park's server for `v` [m/s] and `turn` [rad/s]."""
    return f"d {v / CENTIMETRE:.3f} {turn:.4f}".encode()


def park_goal(x: float, y: float) -> bytes:
    """Command of park's server for a goal [m] in its own frame."""
    return f"g {x:.5f} {y:.5f}".encode()


def park_goal_2023_04(v: float, turn: float) -> tuple[float, float]:
    """Goal (x, y) [m] at which the controller of 2023-04-10 drives `v` [m/s] and `turn` [rad/s] from (0, 0, π/2).

    Its law, from the bearing error e of the goal: ω = 1.5 sin e, and v = (|Δx| + 100 Δy²) (3.14 − ⌊|e|⌋)/3.14 in cm/s,
    10 at most and never negative; the robot stands still when |Δx| + 100 Δy² is at most 0.01. Along y such a goal is
    near: 10 cm/s need 0.32 m, so a robot without further commands stops there. The least goal that turns on the spot
    lies 1 cm away.
    """
    if not v and not turn:
        return 0.0, 0.0
    error = math.asin(max(-1.0, min(1.0, turn / 1.5)))
    share = (3.14 - int(abs(error))) / 3.14
    way = max(0.011, min(max(v, 0.0) / CENTIMETRE / share, 20.0))
    sin, cos = abs(math.sin(error)), math.cos(error)
    distance = 2.0 * way / (sin + math.sqrt(sin * sin + 400.0 * cos * cos * way))
    return -distance * math.sin(error), distance * cos


def park_goal_2023_01(v: float, turn: float, theta: float) -> tuple[float, float]:
    """Goal (x, y) [m] at which the controller of 2023-01-15 drives `v` [m/s] and `turn` [rad/s] from (0, 0, `theta`).

    Its law, from the bearing error e and the distance r of the goal: v = 10 r cos e in cm/s, 0 below 0.02, and
    ω = sin e. A goal 1 mm ahead stops it; one at its own place makes it turn.
    """
    error = math.asin(max(-0.95, min(0.95, turn)))
    distance = max(abs(v) / (10.0 * CENTIMETRE) / math.cos(error), 0.001)
    error = math.pi - error if v < 0.0 else error
    return distance * math.cos(theta + error), distance * math.sin(theta + error)


def units(v: float, turn: float) -> tuple[int, int]:
    """Speed units of the left and right wheel; both slowed by the same factor if one would be too fast."""
    half = 0.5 * BASE * turn
    left, right = (v - half) / UNIT, (v + half) / UNIT
    share = max(1.0, abs(left) / FASTEST, abs(right) / FASTEST)
    return round(left / share), round(right / share)


def twist(left: float, right: float) -> tuple[float, float]:
    """v [m/s] and ω [rad/s] of speed units: the inverse of `units`."""
    return 0.5 * UNIT * (left + right), UNIT * (right - left) / BASE


def rolled(left: float, right: float) -> tuple[float, float]:
    """Way [m] and turn [rad] of encoder pulses."""
    return 0.5 * PULSE * (left + right), PULSE * (right - left) / BASE


def numbers(text: str) -> list[float]:
    """The comma separated numbers of an answer, up to the first that is none."""
    found = []
    for word in text.split(","):
        try:
            value = float(word)
        except ValueError:
            break
        if not math.isfinite(value):
            break
        found.append(value)
    return found


def scanned(text: str) -> list[float]:
    """The first three numbers behind a park command's letter, as C's `scanf` finds them: what is glued behind is lost.

    No larger than a million: nothing that is meant is, and what is infinite cannot be computed with.
    """
    return [max(-1e6, min(1e6, float(word))) for word in re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)", text)[:3]]


def sound_distance(centimetres: float) -> float:
    """An ultrasonic reading [cm] as distance from the robot's centre [m]; NaN for nothing, or switched off."""
    if centimetres >= SOUND_NOTHING:
        return math.nan
    return RIM + (SOUND_NEAREST if centimetres <= 0.0 else centimetres * CENTIMETRE)


def light_distance(reflected: float) -> float:
    """An infrared reading (0 to 1023) as rough distance from the robot's centre [m]; NaN for nothing.

    Reflected light falls with the square of the distance from the emitter behind the rim; a choice, not a calibration.
    """
    if reflected <= LIGHT_NOTHING:
        return math.nan
    return RIM + max(LIGHT_SCALE * (math.sqrt(LIGHT_TOUCHING / reflected) - 1.0), 0.0)
