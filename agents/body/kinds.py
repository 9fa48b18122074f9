"""The kinds of robots: size, limits, and which setpoint they take (figures: reference sheets of the makers)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

Takes = Literal["position", "velocity", "twist"]


@dataclass(frozen=True)
class Kind:
    """Kind of robot."""

    name: str  # as in the experiment file
    takes: Takes  # the setpoint that its body takes
    flies: bool  # takes off and lands
    radius: float  # horizontal half-size [m]
    height: float  # vertical size [m]; a position is that of the lowest point, so a body reaches from z to z + height
    mass: float  # ready to fly, with battery and decks [kg]
    endurance_s: float  # with a full battery, maker's figure
    speed: float  # largest speed [m/s]; per axis for flying robots
    turn_rate: float  # largest yaw rate [rad/s]
    response: float  # rate at which its position controller closes a position error [1/s]
    turn_response: float  # rate at which it closes a yaw error [1/s]
    # time constant with which its velocity follows what is commanded [s]
    lag: float = 0.1  # of a robot on wheels at 2 m/s², from 0.3 m/s, and a tick or two
    overshoot: float = 0.0  # of a take-off of the real robot, share of its height, at most


CRAZYFLIE: Final = Kind(
    "crazyflie",
    "position",
    flies=True,
    radius=0.065,
    height=0.029,
    mass=0.029,  # with a deck for its position: the maker's 27 g of a 2.1 are those of a bare one
    endurance_s=420.0,
    speed=1.0,
    turn_rate=10.0,  # that of a step of 3 rad under the firmware's yaw controller
    response=2.0,  # position P of the firmware
    turn_response=7.6,  # step response of the firmware's yaw controller
    lag=0.4,  # velocity loop and tilt, 0.2 s each
    overshoot=0.11,  # the firmware's height loop, of 27 to 36 g: 7 to 11 %, for 10 to 15 s
)
TELLO: Final = Kind(
    "tello",
    "velocity",
    flies=True,
    radius=0.10,
    height=0.041,
    mass=0.080,
    endurance_s=780.0,
    speed=1.0,  # rc 100
    turn_rate=math.radians(100.0),
    response=1.0,
    turn_response=1.0,
    lag=1.0 / 3.0,
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
)
TURTLEBOT3: Final = Kind(
    "turtlebot3",
    "twist",
    flies=False,
    radius=0.105,
    height=0.192,
    mass=1.0,
    endurance_s=9000.0,
    speed=0.22,
    turn_rate=2.84,
    response=1.0,
    turn_response=1.5,
)

KINDS: Final[dict[str, Kind]] = {kind.name: kind for kind in (CRAZYFLIE, TELLO, KHEPERA4, TURTLEBOT3)}
