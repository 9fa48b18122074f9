"""A robot on omnidirectional wheels; its figures are a choice, of the size of common ones."""

from __future__ import annotations

from typing import Final

from agents.body.kinds import Holonomic, Kind

OMNI: Final = Kind(
    "omni",
    "velocity",
    flies=False,
    radius=0.12,
    height=0.10,
    mass=1.5,
    endurance_s=7200.0,
    speed=0.5,
    turn_rate=2.0,
    response=1.0,
    turn_response=1.5,
    lag=0.1,
    motion=Holonomic(acceleration=1.0),
    prefix="OM",
    colour="#88CCEE",
)
