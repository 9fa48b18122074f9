"""TurtleBot3 Burger (figures: Robotis' manual)."""

from __future__ import annotations

from math import inf, radians
from typing import Final

from agents.body.kinds import Kind, ProtocolTwin, Sensor, Wheels

LDS01: Final = Sensor(
    name="lds01",
    bearing=tuple(radians(degrees) for degrees in range(360)),
    height=0.182,  # mounted on top: lower robots are below its plane
    nearest=0.12,
    farthest=3.5,
    rate_hz=5.0,
    sigma=0.0075,  # ±15 mm below 0.5 m, ±5 % beyond
    relative=0.025,
    relative_from=0.5,
    dropout=0.005,  # a choice
    resolution=0.001,
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
    motion=Wheels(base=0.160, speed=0.22 + 2.84 * 0.080, acceleration=2.0),  # acceleration: our choice
    sensors=(LDS01,),
    aliases=("turtlebot", "burger"),
    prefix="TB",
    colour="#000000",
    mesh="experiments.scene.models:turtlebot",
    alone_s=inf,
    bodies=("ros2dds", "rmw"),
    library="rosbags",
    twin=ProtocolTwin("turtlebot3-twin"),
    ros_address="bridges.turtlebot3.protocol:address_on_routers",
    watchdog="bridges.turtlebot3.watchdog",
    connect="switch it on, start its bringup and the Zenoh bridge, `ROS_DOMAIN_ID` as in the file (docs/turtlebot3.md)",
    charge="charge it; below 11 V the board beeps",
)
