"""Safety settings of an experiment, and the limits of some of its robots that follow from them."""

from __future__ import annotations

from math import inf
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from agents.vectors import NotNegative, Positive, Share, Vector

LOWEST_DESCENT_M_S: Final = 0.2  # [m/s] no device lands more slowly


class Safety(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Limits of setpoints, and thresholds at which a robot holds, lands or has its motors cut."""

    speed: Annotated[Positive | None, Meta(description="speed limit [m/s], if lower than that of the kind")] = None
    max_goal_distance: Annotated[Positive, Meta(description="largest distance of a goal from the robot [m]")] = 0.5
    margin: Annotated[
        NotNegative, Meta(description="gap between the surface of a robot at its goal and the walls [m]")
    ] = 0.05
    position_timeout_s: Annotated[
        Positive, Meta(description="a position older than this counts as unknown; the robot holds [s]")
    ] = 0.5
    land_without_position_s: Annotated[
        NotNegative, Meta(description="time without a known position after which a flying robot lands [s]")
    ] = 0.3
    neighbour_timeout_s: Annotated[
        Positive, Meta(description="time without a pose after which a neighbour counts as lost [s]")
    ] = 1.0
    lost_neighbour: Annotated[
        Literal["drop", "hold", "land"],
        Meta(description="reaction to a lost neighbour: continue without it, hold, or land"),
    ] = "drop"
    lost_conductor: Annotated[
        Literal["finish", "land"],
        Meta(description="reaction to a conductor that is gone in mid-run: finish the run, or land"),
    ] = "finish"
    offline_s: Annotated[
        Positive,
        Meta(
            description="time without a router after which a robot lands, as no stop reaches it; it holds at once [s]"
        ),
    ] = 10.0
    separation: Annotated[
        Positive | None,
        Meta(
            description="distance of centres below which two robots that receive each other's poses hold [m]; below "
            "half of it, or in contact, they land; left out: not watched"
        ),
    ] = None
    cut_beyond_m: Annotated[
        Positive, Meta(description="distance outside the arena at which the motors of a drone are cut [m]")
    ] = 0.75
    overspeed: Annotated[
        float, Meta(gt=1, description="multiple of the top speed of its kind above which a robot holds, then lands")
    ] = 2.5
    tilt: Annotated[float, Meta(gt=0, lt=4, description="tilt above which the motors of a drone are cut [rad]")] = 1.2
    battery_low: Annotated[Share, Meta(description="charge below which a robot lands; 0: never")] = 0.1
    battery_min: Annotated[Share, Meta(description="charge below which it does not take off; 0: it always does")] = 0.2
    start_within: Annotated[
        NotNegative,
        Meta(description="distance from its `start` beyond which a robot does not take off [m]; 0: anywhere"),
    ] = 0.3
    landing_s: Annotated[
        Positive,
        Meta(description="time without descending or hovering after which the motors of a landing drone are cut [s]"),
    ] = 20.0
    loop_timeout_s: Annotated[
        Positive, Meta(description="time without a tick of the control loop after which the watchdog lands a robot [s]")
    ] = 0.5


class Limits(Safety, frozen=True):
    """Safety settings of a robot, and the box of the arena."""

    low: Vector  # smallest x, y, z of the arena [m]
    high: Vector  # largest x, y, z of the arena [m]
    hold_s: float | None = None  # `land_without_position_s` of this robot, where it differs [s]
    # largest delay of a position from outside [s], by which it is flown on board; infinity: it is not
    late_s: float = inf

    @property
    def behind_s(self) -> float:
        """Stamps of positions that are further behind their arrival give a warning [s]."""
        return behind_limit_s(self, self.late_s)

    @property
    def top_speed(self) -> float:
        """Speed that no setpoint exceeds [m/s]; infinity: the kind's own limit is the only one."""
        return inf if self.speed is None else self.speed


def behind_limit_s(safety: Safety, late_s: float) -> float:
    """As `Limits.behind_s`, of a robot with positions that may be `late_s` [s] late."""
    return min(0.5 * safety.position_timeout_s, late_s / 1.5)
