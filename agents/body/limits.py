"""Limits of setpoints, and of what a robot may meet before it holds or lands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from agents.arrays import Array


@dataclass(frozen=True)
class Limits:
    """What no setpoint may exceed.

    Attributes:
        low: (3,) smallest x, y, z of the arena [m].
        high: (3,) largest x, y, z of the arena [m].
        margin: Goals stay this far inside the walls [m].
        speed: [m/s]; the kind's own where that is lower.
        goal_step: Farthest goal from where the robot is [m].
        own_silence_s: Own position older than this is none.
        blind_s: A flying row that has no position of its own for this long lands; one number, or one for each row.
        link_silence_s: A neighbour gone for this long is left out.
        cut_outside: A flying row this far outside the arena has its motors cut [m].
        separation: Nearer than this to another robot a row holds, nearer than half of it it lands [m]; None: never.
        overspeed: A row that moves faster than this times what its kind can is out of control.
        tilt: A flying row that leans more than this has tipped over [rad].
        battery_low: A row with less charge than this lands; a share.
        battery_min: A row with less charge than this does not take off; a share.
        offline_s: A row without a router for this long lands.
        landing_s: A flying row that takes longer to land has its motors cut.
        lost_neighbour: What is done without a neighbour: "drop" it, "hold" or "land".
        lost_conductor: What is done without the conductor: "finish" or "land".
    """

    low: Array
    high: Array
    margin: float = 0.05
    speed: float = np.inf
    goal_step: float = 0.5
    own_silence_s: float = 0.5
    blind_s: float | Array = 0.3
    link_silence_s: float = 1.0
    cut_outside: float = 0.75
    separation: float | None = None
    overspeed: float = 2.5
    tilt: float = 1.2
    battery_low: float = 0.1
    battery_min: float = 0.2
    offline_s: float = 10.0
    landing_s: float = 20.0
    lost_neighbour: Literal["drop", "hold", "land"] = "drop"
    lost_conductor: Literal["finish", "land"] = "finish"
