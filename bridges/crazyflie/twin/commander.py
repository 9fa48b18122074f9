"""The commander: selects the setpoint that has priority, and converts it to a setpoint of the motion model."""

from __future__ import annotations

from math import cos, inf, isnan, nan, radians, remainder, sin, tan, tau
from typing import Final

from agents.body.kinds import Flight
from agents.vectors import UNKNOWN, Pose, Setpoint, Vector, clamp
from twins.models.quadrotor import GRAVITY

STEEPEST: Final = radians(20.0)  # the firmware's default limit of roll and pitch


class Commander:
    """Setpoint of one drone: each axis follows a position, a velocity, or nothing.

    A low-level setpoint has priority over the planner for ever, unless the client announces the end of its setpoints.
    """

    def __init__(self, flight: Flight, turn_response: float) -> None:
        """Gains of the model's loops: a velocity v is the position v / gain ahead; `turn_response` of the yaw [1/s]."""
        self._gain, self._speed_gain = flight.position, flight.velocity[0]
        self._turn_gain = turn_response
        self.command(-inf, on=False)
        self._low_level = False

    def command(
        self,
        t: float,
        *,
        target: Vector = UNKNOWN,
        velocity: Vector = UNKNOWN,
        heading: float = nan,
        turn: float = 0.0,
        body: bool = False,
        lean: tuple[float, float] = (0.0, 0.0),
        thrust: float | None = None,
        on: bool = True,
    ) -> None:
        """Set a low-level setpoint.

        Args:
            t: [s].
            target: Position [m]; NaN on axes without one.
            velocity: [m/s]; NaN on axes without one.
            heading: Yaw [rad], or NaN: use `turn`.
            turn: Yaw rate [rad/s].
            body: Velocity along the axes of the robot.
            lean: Roll to the right and pitch nose up [rad]; they count on axes without setpoint.
            thrust: Raw thrust instead of a vertical setpoint, of 65,535.
            on: Motors on.
        """
        self.target, self._velocity, self.thrust = target, velocity, thrust
        self._heading, self._turn, self._body = heading, turn, body
        roll, pitch = (clamp(angle, -STEEPEST, STEEPEST) for angle in lean)
        # acceleration along the axes of the robot, on axes without setpoint [m/s²]
        self._lean = -GRAVITY * tan(pitch), -GRAVITY * tan(roll)
        self.on, self.received = on, t
        self._low_level = True

    def stop(self) -> None:
        """Forget the setpoint: motors off."""
        self.on = self._low_level = False

    def release(self) -> None:
        """End the client's setpoints: the planner's setpoints count again."""
        self._low_level = False

    def take_planned(self, t: float, goal: Pose | None) -> None:
        """Use the planner's setpoint, None without a plan, unless there is a low-level setpoint.

        One that is not a number is none: the last one becomes old.
        """
        if self._low_level or (goal is not None and isnan(sum(goal))):
            return
        if goal is None:
            self.command(t, on=False)
        else:
            x, y, z, yaw = goal
            self.command(t, target=(x, y, z), heading=yaw)
        self._low_level = False

    def model_setpoint(self, position: Vector, velocity: Vector, yaw: float, *, level: bool) -> Setpoint:
        """Setpoint as position and yaw, the input of the motion model, of a drone as it believes to be [m, m/s, rad].

        `level`: without horizontal setpoint.
        """
        c, s = cos(yaw), sin(yaw)
        (ahead, left), (v_x, v_y, v_z), (x, y, z) = self._lean, self._velocity, self.target
        if self._body:
            v_x, v_y = c * v_x - s * v_y, s * v_x + c * v_y
        if level:
            x = y = v_x = v_y = nan
            ahead = left = 0.0
        free_x, free_y, free_z = velocity  # axes without setpoint keep their velocity, or lean
        free_x += (c * ahead - s * left) / self._speed_gain
        free_y += (s * ahead + c * left) / self._speed_gain
        axes = zip((x, y, z), (v_x, v_y, v_z), (free_x, free_y, free_z), position, self._gain, strict=True)
        x, y, z = (
            place + (free if isnan(speed) else speed) / k if isnan(target) else target
            for target, speed, free, place, k in axes
        )
        turn = 0.0 if level else self._turn / self._turn_gain
        if not level and not isnan(self._heading):
            turn = remainder(self._heading - yaw, tau)
        return x, y, z, yaw + turn
