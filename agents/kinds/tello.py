"""Tello (figures: Ryze's data sheet)."""

from __future__ import annotations

from math import inf, radians
from typing import Final

from agents.body.kinds import Flight, Kind, ProtocolTwin, Trial
from agents.kinds.crazyflie import CRAZYFLIE
from agents.protocols.tello import TAKEOFF_HEIGHT, TEST_ENDS_S

assert CRAZYFLIE.airframe is not None
TELLO: Final = Kind(
    "tello",
    "velocity",
    flies=True,
    radius=0.10,
    height=0.041,
    mass=0.080,
    endurance_s=780.0,
    speed=1.0,  # rc 100
    turn_rate=radians(100.0),
    response=1.0,
    turn_response=1.0,
    lag=1.0 / 3.0,
    # a choice: the maker publishes no figures
    motion=Flight((1.0, 1.0, 1.0), (3.0, 3.0, 3.0), (1.0, 1.0, 1.0), (inf, inf, inf)),
    airframe=CRAZYFLIE.airframe.scaled(0.080, 0.060, (0.098, 0.0925, 0.041)),  # the maker publishes mass and size only
    aliases=("tello",),
    prefix="DT",
    colour="#999933",
    mesh="experiments.scene.models:tello",
    bodies=("tello",),
    library="djitellopy",
    twin=ProtocolTwin("tello-twin", "tellos"),  # all of a computer are on one port
    takeoff_height=TAKEOFF_HEIGHT,
    trial=Trial("sticks", {"stick_test": True}, TEST_ENDS_S[-1], "agents.protocols.tello:judge_stick_test"),
    connect="switch it on; this computer in its Wi-Fi; UDP 8889 and 8890 through the firewall (docs/tello.md)",
    charge="charge it, or put a full one in",
)
