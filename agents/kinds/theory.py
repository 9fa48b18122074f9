"""Robots of theory: point, double integrator and unicycle, without the limits that only real robots have."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Final

from agents.body.kinds import Holonomic, Kind, Wheels

POINT: Final = Kind(  # p' = u
    "point",
    "velocity",
    flies=False,
    radius=0.05,
    height=0.05,
    mass=0.1,
    endurance_s=86400.0,
    speed=1.0,
    turn_rate=6.0,
    response=1.0,
    turn_response=1.5,
    lag=0.0,
    motion=Holonomic(),
    prefix="P",
    colour="#332288",
)
# p'' = (u − p') / lag
DOUBLE_INTEGRATOR: Final = replace(POINT, name="double-integrator", lag=0.3, prefix="D", colour="#117733")
# x' = v cos(yaw), y' = v sin(yaw), yaw' = ω
UNICYCLE: Final = replace(
    POINT, name="unicycle", takes="twist", motion=Wheels(base=0.1, speed=inf, acceleration=inf), prefix="U",
    colour="#882255",
)  # fmt: skip
