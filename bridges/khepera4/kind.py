"""Khepera IV (figures: K-Team's user manual)."""

from __future__ import annotations

from math import inf
from typing import Final

from agents.body.kinds import Kind, ProtocolTwin, Sensor, Wheels
from bridges.khepera4.protocol import LIGHT_BEARING, RIM, SOUND_BEARING

# the maker gives no accuracy, and rates depend on the program on the robot: 10 Hz, sigmas, heights (lower than a landed
# Crazyflie is high) and dropouts are choices
INFRARED: Final = Sensor(
    name="infrared", bearing=LIGHT_BEARING, mount=RIM, height=0.025, farthest=0.25, rate_hz=10.0, sigma=0.005
)
ULTRASONIC: Final = Sensor(
    name="ultrasonic",
    bearing=SOUND_BEARING,
    mount=RIM,
    height=0.025,
    nearest=0.25,
    farthest=2.0,
    rate_hz=10.0,
    sigma=0.005,
    dropout=0.01,  # lost echoes
    resolution=0.01,  # its protocols use centimetres
)
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
    sensors=(INFRARED, ULTRASONIC),
    aliases=("khepera",),
    prefix="KH",
    colour="#44AA99",
    mesh="experiments.scene.models:khepera",
    alone_s=inf,
    bodies=("khepera4", "kteam"),
    twin=ProtocolTwin("khepera4-twin"),
    connect="switch it on, start its server, ping its address (docs/khepera4.md)",
)
