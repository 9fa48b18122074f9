"""Dynamic average consensus."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from agents.plugins.law import Control, Law, Memory, RobotFacts, Said, View
from agents.vectors import Positive


class Average(Law, frozen=True):
    """Average of the signals of all robots, at each of them, in proportional-integral form; they stay where they are.

    ẋ_i = γ (u_i − x_i) − k_P Σ_j (x_i − x_j) − k_I Σ_j (q_i − q_j), q̇_i = k_I Σ_j (x_i − x_j): without error for
    constant signals, however it begins, and with a bounded one for ramps (S. S. Kia, B. Van Scoy, J. Cortés,
    R. A. Freeman, K. M. Lynch, S. Martínez, "Tutorial on dynamic average consensus", IEEE Control Systems Magazine
    39(3), 2019). A link weighs 1/max(n_i, n_j), with n the numbers of neighbours: alike for both ends, as the theorem
    asks, and small enough for the steps of any graph. Both ends compare what was said.
    """

    SAYS: ClassVar[Mapping[str, Said]] = {"x": Said(), "q": Said(), "n": Said(metre=1e-3)}

    signal: Annotated[dict[str, float], Meta(description="by robot: u, its own number")] = msgspec.field(
        default_factory=dict
    )
    ramp: Annotated[dict[str, float], Meta(description="by robot: rate of its number [1/s]")] = msgspec.field(
        default_factory=dict
    )
    rate: Annotated[Positive, Meta(description="γ [1/s]")] = 1.0
    gain: Annotated[Positive, Meta(description="k_P [1/s]")] = 2.0
    integral: Annotated[Positive, Meta(description="k_I [1/s]")] = 1.5

    def begin(self, robot: RobotFacts) -> Memory:
        """x begins at the own signal, q and n at 0."""
        return {"x": (robot.of(self.signal, 0.0),), "q": (0.0,), "n": (0.0,)}

    def step(self, view: View, memory: Memory) -> Control:
        """Step of Euler's method."""
        (x,), (q,), robot, dt = memory["x"], memory["q"], view.robot, view.step_s
        signal = robot.of(self.signal, 0.0) + view.time * robot.of(self.ramp, 0.0)
        (said_x,), (said_q,), (said_n,) = (view.said[name] for name in self.SAYS)
        heard, apart, apart_q = view.known(*self.SAYS), 0.0, 0.0
        for each in heard:
            weight = 1.0 / max(said_n, each.said["n"][0], 1.0)
            apart += weight * (said_x - each.said["x"][0])
            apart_q += weight * (said_q - each.said["q"][0])
        x_new = x + dt * (self.rate * (signal - x) - self.gain * apart - self.integral * apart_q)
        q_new = q + dt * self.integral * apart
        return Control(
            memory={"x": (x_new,), "q": (q_new,), "n": (float(len(heard)),)}, measures={"disagreement": abs(apart)}
        )
