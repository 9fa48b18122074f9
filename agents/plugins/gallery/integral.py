"""Formation with integral action."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot, nan
from typing import Annotated, ClassVar

from msgspec import Meta

from zenpark import Control, Law, Measure, Memory, Positive, RobotFacts, View


class Integral(Law, frozen=True):
    """v_i = −k e_i − z_i, ż_i = κ e_i with e_i = Σ_j (p_i − p̂_j − d_ij), seen from above.

    A constant disturbance, such as a wind, leaves no steady error of the links, for any κ (M. Andreasson,
    D. V. Dimarogonas, H. Sandberg, K. H. Johansson, "Distributed control of networked dynamical systems: static
    feedback, integral action and consensus", IEEE Transactions on Automatic Control 59(7), 2014). That is for single
    integrators: bodies that lag by T bear less than k/T, and a third of it with decisions at 10 Hz. Without a leader
    the formation keeps its shape, and drifts with the wind. z stays as it is while safety holds the robot, and never
    asks for more than `most`.
    """

    NEEDS = "relative"
    MEASURES: ClassVar[Mapping[str, Measure]] = {"error": Measure("m")}

    gain: Annotated[Positive, Meta(description="k [1/s]")] = 0.5
    integral: Annotated[Positive, Meta(description="κ [1/s²]")] = 0.1
    most: Annotated[Positive, Meta(description="largest z: the disturbance that it can hold off [m/s]")] = 0.3

    def begin(self, robot: RobotFacts) -> Memory:
        """z, the correction [m/s], begins at 0."""
        return {"z": (0.0, 0.0)}

    def step(self, view: View, memory: Memory) -> Control:
        """Step of Euler's method."""
        z_x, z_y = memory["z"]
        x, y = 0.0, 0.0
        for each in view.neighbours:
            x += view.position[0] - each.position[0] - each.link.relative[0]
            y += view.position[1] - each.position[1] - each.link.relative[1]
        if view.moves and not view.leads:
            z_x, z_y = z_x + view.step_s * self.integral * x, z_y + view.step_s * self.integral * y
            shrink = min(1.0, self.most / max(hypot(z_x, z_y), 1e-9))
            z_x, z_y = shrink * z_x, shrink * z_y
        return Control(
            memory={"z": (z_x, z_y)},
            velocity=(-self.gain * x - z_x, -self.gain * y - z_y, nan),
            measures={"error": hypot(x, y)},
        )
