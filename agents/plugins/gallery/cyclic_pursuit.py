"""Cyclic pursuit."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, nan, sin
from typing import Annotated, ClassVar

from msgspec import Meta

from zenpark import Control, Law, Positive, View


class CyclicPursuit(Law, frozen=True):
    """v_i = k R(−α) (p̂_j − p_i), seen from above: each robot pursues the next one, j, by an angle α to its right.

    Among n robots the slowest motion grows at the rate 2 k sin(π/n) sin(α − π/n). Below α = π/n they meet in their
    mean; at that angle they circle it to the left at 2 k sin(π/n) [rad/s]; above, up to 2 π/n, they leave it in spirals
    (M. Pavone, E. Frazzoli, "Decentralized policies for geometric pattern formation and path coverage", ASME Journal of
    Dynamic Systems, Measurement, and Control 129(5), 2007; with the heading of wheels: J. A. Marshall, M. E. Broucke,
    B. A. Francis, "Formations of vehicles in cyclic pursuit", IEEE Transactions on Automatic Control 49(11), 2004). The
    mean stays. Lag of bodies and messages adds its own angle: they circle at a little less than π/n.
    """

    PREDICTION: ClassVar[str] = "constant-velocity"

    gain: Annotated[Positive, Meta(description="k [1/s]")] = 0.3
    angle: Annotated[float, Meta(ge=-3.15, le=3.15, description="α [rad], to the right of the pursued")] = 0.0

    def step(self, view: View, memory: Mapping[str, tuple[float, ...]]) -> Control:
        """Sum over the pursued, of which the theorem has one."""
        x = sum(each.position[0] - view.position[0] for each in view.neighbours)
        y = sum(each.position[1] - view.position[1] for each in view.neighbours)
        along, across = self.gain * cos(self.angle), self.gain * sin(self.angle)
        return Control(velocity=(along * x + across * y, along * y - across * x, nan))
