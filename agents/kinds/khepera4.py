"""Khepera IV (figures: K-Team's user manual)."""

from __future__ import annotations

from typing import Final

from agents.body.kinds import Kind, ProtocolTwin, Wheels

KHEPERA4: Final = Kind(
    "khepera4",
    "twist",
    flies=False,
    radius=0.070,
    height=0.058,
    mass=0.540,
    endurance_s=18000.0,
    speed=0.2712,  # 400 units of 0.6781 mm/s, the cap of the paper's authors; the wheels could do three times that
    turn_rate=2.0 * 0.2712 / 0.1054,
    response=1.0,
    turn_response=1.5,
    motion=Wheels(base=0.1054, speed=0.8137, acceleration=130.0 * 0.021),  # 130 rad/s² on a wheel of 42 mm
    sensors=("infrared", "ultrasonic"),
    aliases=("khepera",),
    prefix="KH",
    colour="#44AA99",
    mesh="experiments.scene.models:khepera",
    bodies=("khepera4", "kteam"),
    twin=ProtocolTwin("khepera4-twin"),
    connect="switch it on, start its server, ping its address (docs/khepera4.md)",
)
