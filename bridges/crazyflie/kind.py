"""Crazyflie 2.1 (figures: Bitcraze's data sheet and firmware)."""

from __future__ import annotations

from math import inf, radians
from typing import Final

from agents.body.kinds import Airframe, Flight, Kind, ProtocolTwin, Sensor

# in the order of its bridge: front, back, left, right, up. Rate, sigma and height (half that of the robot) are choices;
# its beams are lines here, and cones in reality
MULTIRANGER: Final = Sensor(
    name="multiranger",
    bearing=(0.0, radians(180.0), radians(90.0), radians(-90.0), 0.0),
    elevation=(0.0, 0.0, 0.0, 0.0, radians(90.0)),
    height=0.0145,
    farthest=4.0,
    rate_hz=20.0,
    sigma=0.010,
    resolution=0.001,
)
CRAZYFLIE: Final = Kind(
    "crazyflie",
    "position",
    flies=True,
    radius=0.065,
    height=0.029,
    mass=0.029,  # mass with a deck for its position: the maker's 27 g of a 2.1 are those of a bare one
    endurance_s=420.0,
    speed=1.0,
    turn_rate=10.0,  # rate of a step of 3 rad under the firmware's yaw controller
    response=2.0,  # position P of the firmware
    turn_response=7.6,  # step response of the firmware's yaw controller
    lag=0.4,  # velocity loop and tilt, 0.2 s each
    overshoot=0.11,  # the firmware's height loop, of 27 to 36 g: 7 to 11 %, for 10 to 15 s
    # the firmware's loops ring by positions that are 0.2 s late (0.15 s: a sway of 0.2 m that dies out)
    late_s=0.15,
    # 0.2 to 0.35 s more than a drone of 29 g under the firmware's height loop, which lifts off late
    lift_s=(0.55, 0.55, 0.16),
    # fitted to step responses of a rigid body under the firmware's cascade (docs/mujoco.md)
    motion=Flight((2.0, 2.0, 2.8), (5.0, 5.0, 3.5), (1.1, 1.1, 1.4), (5.0, 5.0, inf)),
    airframe=Airframe(
        mass=0.027,
        inertia=(1.657e-5, 1.657e-5, 2.926e-5),
        arm=0.046,
        thrust=0.12,
        torque=0.00596,  # Förster, "System Identification of the Crazyflie 2.0 Nano Quadrocopter", 2015
        size=(0.092, 0.092, 0.029),
    ),
    decks=(MULTIRANGER,),
    aliases=("dron", "crazyflie"),
    prefix="CF",
    colour="#AA4499",
    mesh="experiments.scene.models:crazyflie",
    alone_s=8.0,
    bodies=("radio", "usb", "udp"),
    library="cflib",
    twin=ProtocolTwin("crazyflie-twin", "radio0", device={"link": "radio"}),  # several hang on one radio
    connect="switch it on; channel, rate and address as in the Crazyflie client; radio plugged in and permitted "
    "(docs/crazyflie.md)",
    charge="charge it; one that sags under load although it was full is worn: replace it",
    locks=True,
)
