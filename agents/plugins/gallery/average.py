"""Dynamic average consensus."""

from __future__ import annotations

import cmath
from collections.abc import Iterator, Mapping, Sequence
from math import log
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from zenpark import Control, Law, Memory, NeighbourView, Positive, RobotFacts, Said, Severity, View

MOST_STEP: Final = 2.0  # limit of Euler's method on a decay: rate times step
STANDING: Final = 1e-9  # eigenvalues below are 0: of what the robots have in common


class Averaging(Law, frozen=True):
    """A law that estimates averages in proportional-integral form.

    A link weighs 1/max(n_i, n_j), with n the numbers of received neighbours, which all robots transmit. The weight is
    equal at both ends, as the theorem requires, and small enough for the steps of most graphs. Both ends compare
    transmitted values.
    """

    rate: Annotated[Positive, Meta(description="γ: rate at which the initial estimate is forgotten [1/s]")] = 1.0
    gain: Annotated[Positive, Meta(description="k_P [1/s]")] = 2.0
    integral: Annotated[Positive, Meta(description="k_I [1/s]")] = 1.5

    def heard(self, view: View) -> list[tuple[float, NeighbourView]]:
        """Neighbours with received variables, and the weights of their links."""
        (n,) = view.said["n"]
        return [(1.0 / max(n, each.said["n"][0], 1.0), each) for each in view.known(*self.SAYS)]

    def estimate(  # noqa: PLR0917 - quiet
        self, view: View, memory: Memory, names: tuple[str, str], k: int, u: float,
        heard: Sequence[tuple[float, NeighbourView]],
    ) -> tuple[float, float, float]:  # fmt: skip
        """Average of signals u: next values of number `k` of the variables `names`, and Σ w (x_i − x_j); by Euler."""
        name_x, name_q = names
        x, q = memory[name_x][k], memory[name_q][k]
        said_x, said_q = view.said[name_x][k], view.said[name_q][k]
        apart, apart_q = 0.0, 0.0
        dt = view.step_s
        for weight, each in heard:
            apart += weight * (said_x - each.said[name_x][k])
            apart_q += weight * (said_q - each.said[name_q][k])
        x += dt * (self.rate * (u - x) - self.gain * apart - self.integral * apart_q)
        return x, q + dt * self.integral * apart, apart

    def analyse(self, plan: Any) -> Iterator[tuple[Severity, str, str]]:  # noqa: ANN401 - plug-ins know no experiment
        """Whether the steps of the estimator bear its gains on these links, and how soon it settles."""
        pairs = set(zip(plan.links.receiver.tolist(), plan.links.sender.tolist(), strict=True))
        for receiver, sender in sorted((i, j) for i, j in pairs if (j, i) not in pairs)[:1]:
            sender_name, here = plan.names[sender], plan.names[receiver]
            message = f"{here} receives {sender_name}, but not the other way: the robots do not agree on the average"
            yield "error", message, f'link both ways, as "{sender_name} - {here}"'
            return
        step = 1.0 / plan.experiment.rates.coordination_hz
        count = max(round(plan.talk_period_s / step), 1)
        modes = [each.real for each in plan.laplacian_eigenvalues(lambda n, other: 1.0 / max(n, other, 1.0))]
        growth, period = self.growth(modes, step, count), count * step
        if self.rate * step >= MOST_STEP:
            message = (
                f"the estimate grows with every decision: γ T = {self.rate * step:.2g}, and {MOST_STEP:g} is the bound"
            )
            yield "error", message, f"use a rate below {MOST_STEP / step:.2g}, or a higher coordination_hz"
            return
        took = ", ".join(
            f"{name} λ T = {gain * max(modes) * period:.2g}"
            for name, gain in (("k_P", self.gain), ("k_I", self.integral))
        )
        if growth >= 1.0:
            shares = [0.02 * k for k in range(50, 0, -1)]
            bears = next((share for share in shares if self.growth(modes, step, count, share) < 1.0), 0.0)
            message = f"the average diverges: an error grows {growth:.3g}-fold from message to message ({took})"
            remedy = f"use a gain of {0.8 * bears * self.gain:.2g} and an integral of {0.8 * bears * self.integral:.2g}"
            yield "error", message, f"{remedy}, or more messages and decisions per second"
            return
        lasts = -period / log(max(growth, STANDING))
        message = f"the average settles with a time constant of {lasts:.2g} s ({took})"
        if 5.0 * lasts > plan.experiment.duration_s:
            yield "warning", message, "the run is shorter than five of them: use a larger integral, or more links"
        else:
            yield "note", message, ""

    def growth(self, modes: Sequence[float], step: float, count: int, share: float = 1.0) -> float:
        """Largest factor of an error from message to message, with `share` of both gains.

        Along an eigenvector of the Laplacian with an eigenvalue λ of `modes`, x and q become, in `count` steps T while
        the values of the neighbours are held, ((r − s k_P λ, −s k_I λ), (m T k_I λ, 1)) of themselves, with m steps,
        r = (1 − γ T)^m and s = (1 − r)/γ.
        """
        left = (1.0 - self.rate * step) ** count
        reach, worst = (1.0 - left) / self.rate, abs(left)
        for mode in modes:
            if mode > STANDING:
                corner, cross = left - reach * share * self.gain * mode, share * self.integral * mode
                middle = 0.5 * (corner + 1.0)
                root = cmath.sqrt(middle * middle - corner - reach * count * step * cross * cross)
                worst = max(worst, abs(middle + root), abs(middle - root))
        return worst


class Average(Averaging, frozen=True):
    """Average of the signals of all robots, at each of them, in proportional-integral form; they stay where they are.

    ẋ_i = γ (u_i − x_i) − k_P Σ_j (x_i − x_j) − k_I Σ_j (q_i − q_j), q̇_i = k_I Σ_j (x_i − x_j): without error for
    constant signals, however it begins, and with a bounded one for ramps (S. S. Kia, B. Van Scoy, J. Cortés,
    R. A. Freeman, K. M. Lynch, S. Martínez, "Tutorial on dynamic average consensus", IEEE Control Systems Magazine
    39(3), 2019).
    """

    SAYS: ClassVar[Mapping[str, Said]] = {"x": Said(), "q": Said(), "n": Said(metre=1e-3)}

    signal: Annotated[dict[str, float], Meta(description="by robot: u, its own number")] = msgspec.field(
        default_factory=dict
    )
    ramp: Annotated[dict[str, float], Meta(description="by robot: rate of its number [1/s]")] = msgspec.field(
        default_factory=dict
    )

    def begin(self, robot: RobotFacts) -> Memory:
        """x begins at the own signal, q and n at 0."""
        return {"x": (robot.of(self.signal, 0.0),), "q": (0.0,), "n": (0.0,)}

    def step(self, view: View, memory: Memory) -> Control:
        """Step of the estimator."""
        signal = view.robot.of(self.signal, 0.0) + view.time * view.robot.of(self.ramp, 0.0)
        heard = self.heard(view)
        x, q, apart = self.estimate(view, memory, ("x", "q"), 0, signal, heard)
        return Control(memory={"x": (x,), "q": (q,), "n": (float(len(heard)),)}, measures={"disagreement": abs(apart)})
