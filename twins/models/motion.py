"""Base of the motion models of one robot: in the room, under commands. All of it is quiet."""

from __future__ import annotations

from agents.body.interface import Attitude
from agents.vectors import Setpoint, Vector


class Motion:
    """Motion of one robot. A model adds `move`; what it leaves as it is here has no effect."""

    __slots__ = ("attitude", "flying", "position", "velocity", "wobble", "yaw")

    position: Vector  # the truth, hover jitter included [m]
    velocity: Vector  # velocity known by the robot's controller: without hover jitter [m/s]
    yaw: float  # [rad]
    flying: bool  # motors on, in the air or about to be
    attitude: Attitude  # unit quaternion from robot to world; NaN: upright
    wobble: tuple[float, float]  # hover jitter of the next step, of flying robots [m]

    def move(self, dt: float) -> None:
        """Advance by a step of `dt` [s], alone; of no effect where the engine moves robots together."""

    def command(self, setpoint: Setpoint) -> None:
        """Set the setpoint as in `agents.body.interface.Body.command`; NaN keeps the last one."""

    def takeoff(self, height: float) -> None:
        """Climb to `height` [m], if the robot flies."""

    def land(self) -> None:
        """Descend and switch off; on wheels, halt."""

    def stop(self) -> None:
        """Switch motors off at once; on wheels, halt."""
        self.land()

    def place(self, position: Vector, yaw: float, *, flying: bool) -> None:
        """Set position [m] and yaw [rad], at rest; a flying robot holds them."""

    def push(self, velocity: Vector) -> None:
        """Set the velocity [m/s]; of a ground robot the component along its heading, if it drives that way alone."""
        self.velocity = velocity
