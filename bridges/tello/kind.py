"""Tello (figures: Ryze's data sheet)."""

from __future__ import annotations

from math import inf, radians
from typing import Final

from agents.body.kinds import Airframe, Flight, Kind, ProtocolTwin, Trial
from bridges.tello.protocol import TAKEOFF_HEIGHT, TEST_ENDS_S

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
    # mass, arm and size: the maker's; the others: those of a Crazyflie, thrust scaled with the mass, inertia with mass
    # and arm squared, torque with the arm
    airframe=Airframe(
        mass=0.080,
        inertia=(8.3528670447385e-05, 8.3528670447385e-05, 0.00014749842470069315),
        arm=0.060,
        thrust=0.35555555555555557,
        torque=0.007773913043478261,
        size=(0.098, 0.0925, 0.041),
    ),
    aliases=("tello",),
    prefix="DT",
    colour="#999933",
    mesh="experiments.scene.models:tello",
    alone_s=25.0,
    bodies=("tello",),
    library="djitellopy",
    twin=ProtocolTwin("tello-twin", "tellos"),  # all of a computer are on one port
    takeoff_height=TAKEOFF_HEIGHT,
    trial=Trial("sticks", {"stick_test": True}, TEST_ENDS_S[-1], "bridges.tello.protocol:judge_stick_test"),
    connect="switch it on; this computer in its Wi-Fi; UDP 8889 and 8890 through the firewall (docs/tello.md)",
    charge="charge it, or put a full one in",
)
