"""Khepera IV: the two protocols in use, their words and units, and where its range sensors look.

*Park* is the server of Robotic Park on the robot: TCP 50000, ASCII without delimiters, one read of the server is one
command, centimetres. *K-Team* is the maker's `kh4server`: lines over a serial port or TCP, motor units and encoder
pulses. Figures: Khepera IV User Manual, rev. 1.1.
"""

from __future__ import annotations

import math
import re
from typing import Final, Literal

import msgspec
import numpy as np

from agents.arrays import Array

PARK_PORT: Final = 50000
GAP_S: Final = 0.010  # between two park commands: glued in one segment, the second is lost
PULSE: Final = 6.781e-6  # [m] of way per encoder pulse
UNIT: Final = 0.6781e-3  # [m/s] per unit of speed: pulses per 10 ms
BASE: Final = 0.1054  # [m] between the wheels
FASTEST: Final = 1200  # units: 0.81 m/s
CENTIMETRE: Final = 0.01

RIM: Final = 0.070  # [m] from the robot's centre to its sensors
SOUND_BEARING: Final = np.radians([90.0, 45.0, 0.0, -45.0, -90.0])  # ultrasonic, in the order of both protocols
LIGHT_BEARING: Final = np.radians([135.0, 90.0, 45.0, 0.0, -45.0, -90.0, -135.0, 180.0])  # infrared; four look down
SOUND_NOTHING: Final = 1000  # [cm] nothing between 25 and 250 cm; 2000: switched off
SOUND_NEAREST: Final = 0.25  # [m] nearer than this it reads 0
LIGHT_NOTHING: Final = 100  # reflected light of nothing at all
LIGHT_TOUCHING: Final = 1000
LIGHT_SCALE: Final = 0.0925  # [m] so that LIGHT_NOTHING falls at 0.2 m; not calibrated, surfaces differ


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `device` table of a Khepera IV."""

    protocol: Literal["park", "kteam"] = "park"  # which of the two its protocol twin speaks; hardware: by the address
    odometry: Literal["pose", "increments", "heading"] = "pose"  # park: what `p` answers: x,y,th or d,dth or d,th
    poll_hz: float = 25.0  # [1/s] drive command and odometry
    ranges: bool = True  # read its range sensors, five times a second
    silence_s: float = 0.5  # [s] without an answer after which the link is made anew
    low_battery: float = 0.05  # below this charge it stops (K-Team's protocol only; park has no battery)

    @property
    def stops_alone(self) -> bool:
        """Whether the server stops the wheels without a client: only the newest park server does (x,y,θ)."""
        return self.protocol == "park" and self.odometry == "pose"

    def __post_init__(self) -> None:
        if not 2.0 <= self.poll_hz <= 30.0:
            raise ValueError("poll_hz must be 2 to 30: the robot wants 10 ms between two commands")
        if not 0.1 <= self.silence_s <= 10.0:
            raise ValueError("silence_s must be 0.1 to 10 s")
        if not 0.0 <= self.low_battery < 1.0:
            raise ValueError("low_battery is a share: 0 <= low_battery < 1")


def park_drive(v: float, turn: float) -> bytes:
    """Command of park's server for `v` [m/s] and `turn` [rad/s]."""
    return f"d {v / CENTIMETRE:.3f} {turn:.4f}".encode()


def units(v: float, turn: float) -> tuple[int, int]:
    """Speed units of the left and right wheel; both slowed alike where one would be too fast."""
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


def scanned(text: str, count: int = 3) -> list[float]:
    """The first numbers behind a park command's letter, as C's `scanf` finds them: what is glued behind is lost.

    No larger than a million: nothing that is meant is, and what is infinite cannot be computed with.
    """
    return [max(-1e6, min(1e6, float(word))) for word in re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)", text)[:count]]


def sound_distance(centimetres: Array) -> Array:
    """Ultrasonic readings [cm] as distances from the robot's centre [m]; NaN for nothing, or switched off."""
    near = np.where(centimetres <= 0.0, SOUND_NEAREST, centimetres * CENTIMETRE)
    return np.where(centimetres >= SOUND_NOTHING, np.nan, RIM + near)


def light_distance(reflected: Array) -> Array:
    """Infrared readings (0 to 1023) as rough distances from the robot's centre [m]; NaN for nothing.

    Reflected light falls with the square of the distance from the emitter behind the rim; a choice, not a calibration.
    """
    seen = np.maximum(reflected, LIGHT_NOTHING)
    near = LIGHT_SCALE * (np.sqrt(LIGHT_TOUCHING / seen) - 1.0)
    return np.where(reflected <= LIGHT_NOTHING, np.nan, RIM + np.maximum(near, 0.0))
