"""Flocking."""

from __future__ import annotations

from math import cos, hypot, isfinite, nan, pi, sqrt
from typing import Annotated, ClassVar

from msgspec import Meta

from zenpark import Control, Law, Memory, NotNegative, Positive, RobotFacts, View

EPSILON = 5.0  # parameter of the σ-norm, where lengths are in spacings
INTERACTION_RANGE = 1.2  # spacings at which robots act on each other
FLAT = 0.2  # share of the reach below which they do so in full


class Flocking(Law, frozen=True):
    """u_i = Σ_j φ_α(‖q_j − q_i‖_σ) n_ij + Σ_j a_ij (p_j − p_i) − c₁ (q_i − q_r) − c₂ (p_i − p_r): algorithm 2.

    Velocities agree with p_r, that of a moving rendezvous q_r which all know, robots keep the spacing of a lattice, and
    none collide where they begin with little energy. The mean moves by the last two terms alone (R. Olfati-Saber,
    "Flocking for multi-agent dynamic systems: algorithms and theory", IEEE Transactions on Automatic Control 51(3),
    2006). φ has a = b; lengths are in spacings within it; u is an acceleration, and the law integrates it.
    """

    ALONE: ClassVar[bool] = True
    PREDICTION: ClassVar[str] = "constant-velocity"

    spacing: Annotated[Positive, Meta(description="d, wanted between neighbours [m]")] = 0.7
    stiffness: Annotated[Positive, Meta(description="a, the most that one neighbour does [spacings/s²]")] = 10.0
    matching: Annotated[NotNegative, Meta(description="weight of the velocities of neighbours [1/s]")] = 1.0
    place: Annotated[tuple[float, float], Meta(description="q_r at the start, x, y [m]")] = (0.0, 0.0)
    velocity: Annotated[tuple[float, float], Meta(description="p_r [m/s]")] = (0.0, 0.0)
    pull: Annotated[NotNegative, Meta(description="c₁ [1/s²]")] = 0.15
    damping: Annotated[NotNegative, Meta(description="c₂ [1/s]")] = 0.8

    def begin(self, robot: RobotFacts) -> Memory:
        """v, the own velocity, begins at rest."""
        return {"v": (0.0, 0.0)}

    def step(self, view: View, memory: Memory) -> Control:
        """Step of Euler's method; a robot that is held, or led by its plan, starts again from rest."""
        if view.leads or not view.moves:
            return Control(memory={"v": (0.0, 0.0)}, velocity=(0.0, 0.0, nan))
        (vx, vy), (x, y, _) = memory["v"], view.position
        t = view.time
        ux = -self.pull * (x - self.place[0] - t * self.velocity[0]) - self.damping * (vx - self.velocity[0])
        uy = -self.pull * (y - self.place[1] - t * self.velocity[1]) - self.damping * (vy - self.velocity[1])
        for each in view.neighbours:
            dx, dy = (each.position[0] - x) / self.spacing, (each.position[1] - y) / self.spacing
            near = bump(sigma(hypot(dx, dy)) / sigma(INTERACTION_RANGE))
            apart = sigma(hypot(dx, dy)) - sigma(1.0)
            action = self.spacing * self.stiffness * near * apart / sqrt(1.0 + apart * apart)
            action /= sqrt(1.0 + EPSILON * (dx * dx + dy * dy))
            ux, uy = ux + action * dx, uy + action * dy
            if isfinite(each.velocity[0] + each.velocity[1]):
                ux += self.matching * near * (each.velocity[0] - vx)
                uy += self.matching * near * (each.velocity[1] - vy)
        vx, vy = vx + view.step_s * ux, vy + view.step_s * uy
        shrink = min(1.0, view.robot.speed / max(hypot(vx, vy), 1e-9))
        return Control(memory={"v": (vx * shrink, vy * shrink)}, velocity=(vx * shrink, vy * shrink, nan))


def sigma(length: float) -> float:
    """σ-norm, of a length in spacings."""
    return (sqrt(1.0 + EPSILON * length * length) - 1.0) / EPSILON


def bump(share: float) -> float:
    """1 where near, smoothly 0 at the end of the reach."""
    if share < FLAT:
        return 1.0
    return 0.5 * (1.0 + cos(pi * (share - FLAT) / (1.0 - FLAT))) if share < 1.0 else 0.0
