"""Aggregative optimisation: each robot's cost depends on the team's centre, which none of them sees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import hypot, isfinite, nan
from typing import Annotated, Any, ClassVar

import msgspec
from msgspec import Meta

from agents.plugins.gallery.average import MOST_STEP, Averaging
from zenpark import Control, Memory, NotNegative, Positive, RobotFacts, Said, Severity, View

Place = tuple[float, float]


class Aggregative(Averaging, frozen=True):
    """Surveillance: near the own target r_i, with the team's centre σ near the places b_i, seen from above.

    The robots minimise Σ_i w/2 ‖p_i − r_i‖² + g_i/2 ‖σ − b_i‖², σ = Σ_j p_j / N, by ṗ_i = −ρ (w (p_i − r_i) + y_i)
    with y the average of g_i (s_i − b_i), and s that of p_i: both are estimated. g_i is g for robots that know a place,
    0 for others. Converges linearly to the one optimum (G. Carnevale, A. Camisa, G. Notarstefano, "Distributed online
    aggregative optimization for dynamic multirobot coordination", IEEE Transactions on Automatic Control 68(6), 2023).
    Its tracking of gradients by increments would keep an error for each message that is lost; averages in
    proportional-integral form are states, and do not. A robot that is held winds nothing up.
    """

    SAYS: ClassVar[Mapping[str, Said]] = {
        "s": Said(unit="m", place=0),
        "s_q": Said(unit="m"),
        "y": Said(unit="m"),
        "y_q": Said(unit="m"),
        "n": Said(metre=1e-3),
    }

    targets: Annotated[dict[str, Place], Meta(description="by robot: r, x, y [m]; else the origin")] = msgspec.field(
        default_factory=dict
    )
    places: Annotated[dict[str, Place], Meta(description="by robot: b, x, y [m], of those that know one")] = (
        msgspec.field(default_factory=dict)
    )
    descent: Annotated[Positive, Meta(description="ρ [1/s]")] = 0.5
    own: Annotated[Positive, Meta(description="w: what the own target matters")] = 1.0
    team: Annotated[NotNegative, Meta(description="g: what the team's centre matters")] = 2.0
    gain: Annotated[Positive, Meta(description="k_P [1/s]")] = 4.0
    integral: Annotated[Positive, Meta(description="k_I [1/s]")] = 3.0

    def begin(self, robot: RobotFacts) -> Memory:
        """Estimates s of the centre [m] and y of its gradient [m], with their integrals; received neighbours only."""
        return {**dict.fromkeys(("s", "s_q", "y", "y_q"), (0.0, 0.0)), "n": (0.0,)}

    def step(self, view: View, memory: Memory) -> Control:
        """Steps of both estimators, and the descent."""
        (x, y, _), heard = view.position, self.heard(view)
        s_x, s_qx, apart_x = self.estimate(view, memory, ("s", "s_q"), 0, x, heard)
        s_y, s_qy, apart_y = self.estimate(view, memory, ("s", "s_q"), 1, y, heard)
        place = self.places.get(view.robot.name, (nan, nan))
        slope_x, slope_y = (
            (self.team * (s_x - place[0]), self.team * (s_y - place[1])) if isfinite(place[0]) else (0.0, 0.0)
        )
        y_x, y_qx, _ = self.estimate(view, memory, ("y", "y_q"), 0, slope_x, heard)
        y_y, y_qy, _ = self.estimate(view, memory, ("y", "y_q"), 1, slope_y, heard)
        target = view.robot.of(self.targets, (0.0, 0.0))
        v_x = -self.descent * (self.own * (x - target[0]) + y_x)
        v_y = -self.descent * (self.own * (y - target[1]) + y_y)
        return Control(
            memory={
                "s": (s_x, s_y), "s_q": (s_qx, s_qy), "y": (y_x, y_y), "y_q": (y_qx, y_qy), "n": (float(len(heard)),),
            },
            velocity=(v_x, v_y, nan),
            measures={"disagreement": hypot(apart_x, apart_y)},
        )  # fmt: skip

    def analyse(self, plan: Any) -> Iterator[tuple[Severity, str, str]]:  # noqa: ANN401 - plug-ins know no experiment
        """Of the estimators, and whether they are quick enough for the descent.

        What all have in common obeys μ³ + (2γ + ρw) μ² + (γ² + 2γρw) μ + γ²ρ(w + g') = 0, with g' = g times the share
        of robots that know a place: stable if 2 (γ + ρw)² > γ ρ g' (Routh and Hurwitz).
        """
        yield from super().analyse(plan)
        own, step = self.descent * self.own, 1.0 / plan.experiment.rates.coordination_hz
        known = sum(name in self.places for name in plan.names) / len(plan.names)
        pull = self.rate * self.descent * self.team * known
        if not known:
            yield (
                "warning",
                "no robot knows a place for the team's centre: each goes to its own target",
                "name `places`",
            )
        if own * step >= MOST_STEP:
            message = f"the descent diverges: ρ w T = {own * step:.2g}, and {MOST_STEP:g} is the bound"
            yield "error", message, f"use a descent below {MOST_STEP / step / self.own:.2g}"
        elif pull >= 2.0 * (self.rate + own) ** 2:
            message = f"the team's centre swings ever wider: γ ρ g = {pull:.2g}, and 2 (γ + ρ w)² is the bound, "
            bound = 2.0 * (self.rate + own) ** 2
            remedy = f"use a team below {0.5 * bound / pull * self.team:.2g}, or a larger rate"
            yield "error", f"{message}{bound:.2g}", remedy
