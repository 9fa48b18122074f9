"""Distributed model predictive control; its solver, daqp, is the extra `mpc`, and loads with numpy at first use."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from math import cos, hypot, isfinite, nan, sin
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from zenpark import (
    Control,
    Law,
    Measure,
    Memory,
    NeighbourView,
    NotNegative,
    PluginError,
    Positive,
    RobotFacts,
    Said,
    Severity,
    View,
    clamp,
    is_known,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

AROUND: Final = 1.5  # spacings within which neighbours count, where one of them comes too near
STRAY: Final = 0.15  # [m] distance from the plan at which a robot plans from its measured place
CATCH_UP: Final = 1.0  # rate at which it returns to its plan [1/s]
TOGETHER: Final = 1e-6  # [m] places nearer than this have no direction

Planar = tuple[float, float]  # x, y


class Mpc(Law, frozen=True):
    """Goals reached by plans over a horizon, which robots exchange and keep apart, seen from above.

    Each minimises Σ_k ‖p_k − g‖² + r Σ_k ‖a_k‖² + w Σ_j (ε_j + ε_j²) over accelerations a_k and ε_j ≥ 0, with p'' = a
    and limits of speed and acceleration per axis. The constraint n_j·(p_κ − p̂_jκ) ≥ d − ε_j holds at the first step κ
    at which its last plan comes nearer than d to another received plan (C. E. Luis, M. Vukosavljevic, A. P. Schoellig,
    "Online trajectory generation with distributed model predictive control for multi-robot motion planning", IEEE
    Robotics and Automation Letters 5(2), 2020). A plan continues the one before, unless the robot has left that one.
    Neither distance nor
    arrival is guaranteed: constraints are soft, and robots that block each other stay.
    """

    SAYS: ClassVar[Mapping[str, Said]] = {"path": Said(unit="m", place=-2)}  # its end is drawn
    ALONE: ClassVar[bool] = True
    MEASURES: ClassVar[Mapping[str, Measure]] = {"conflicts": Measure(), "slack": Measure("m")}
    PREDICTION: ClassVar[str] = "constant-velocity"
    LIBRARY: ClassVar[str] = "daqp"

    goal: Annotated[dict[str, Planar], Meta(description="by robot: g, x, y [m]; one without makes way")] = (
        msgspec.field(default_factory=dict)
    )
    spacing: Annotated[Positive, Meta(description="d, between the axes of two robots [m]")] = 0.35
    speed: Annotated[Positive, Meta(description="limit per axis [m/s]")] = 0.5
    acceleration: Annotated[Positive, Meta(description="limit per axis [m/s²]")] = 1.0
    steps: Annotated[int, Meta(description="of the horizon", ge=2, le=31)] = 15
    period: Annotated[Positive, Meta(description="of such a step [s]")] = 0.2
    effort: Annotated[Positive, Meta(description="r [s⁴]")] = 0.1
    penalty: Annotated[Positive, Meta(description="w, of a violation ε [m]")] = 300.0
    right: Annotated[NotNegative, Meta(description="turn of n, by which robots pass on the right [rad]")] = 0.3

    def begin(self, robot: RobotFacts) -> Memory:
        """Neither path (x, y from now on) nor state (x, y, their rates, accelerations) is known; needs the solver."""
        horizon(self.steps, self.period, self.effort)
        return {"path": (nan,) * (2 * self.steps + 2), "state": (nan,) * 6}

    def step(self, view: View, memory: Memory) -> Control:
        """Plan again from the state of the last plan, and move along."""
        ahead, speed = horizon(self.steps, self.period, self.effort), min(self.speed, view.robot.speed)
        p, v = advance(memory["state"], view, speed)
        conflicts, slack = [], 0.0
        a = ahead.rest
        if view.moves and not view.leads:
            own_path = (
                ahead.later(memory["path"], view.step_s) if is_known(memory["path"]) else ahead.positions(p, v, a)
            )
            conflicts = ahead.conflicts(own_path, view.neighbours, self.spacing, self.right)
            goal = self.goal.get(view.robot.name, p)
            a, slack = ahead.plan(p, v, goal, conflicts, (speed, self.acceleration, self.penalty))
        path, (ax, ay) = ahead.positions(p, v, a), a[0].tolist()
        dt = view.robot.step_s
        x = v[0] + ax * dt + CATCH_UP * (p[0] - view.position[0])
        y = v[1] + ay * dt + CATCH_UP * (p[1] - view.position[1])
        return Control(
            memory={"path": (*p, *path.ravel().tolist()), "state": (*p, *v, ax, ay)},
            velocity=(x, y, nan),
            measures={"conflicts": float(len(conflicts)), "slack": slack},
        )

    def analyse(self, plan: Any) -> Iterable[tuple[Severity, str, str]]:  # noqa: ANN401 - as its base
        """Goals that robots cannot have together, or that no robot has."""
        if strangers := self.goal.keys() - plan.experiment.robots.keys():
            yield "error", f"goals of {', '.join(sorted(strangers))}, which no robot is called", "mend the names"
        for first, (x, y) in self.goal.items():
            for second, (a, b) in self.goal.items():
                if first < second and hypot(x - a, y - b) < self.spacing:
                    yield "warning", f"goals of {first} and {second} are nearer than the spacing", "put them apart"


def advance(state: tuple[float, ...], view: View, speed: float) -> tuple[Planar, Planar]:
    """Place and velocity of the last plan now; where it strayed, is held or led, those of the robot."""
    x, y, vx, vy, ax, ay = state
    dt, (here_x, here_y, _) = view.step_s, view.position
    x, y = x + dt * (vx + 0.5 * dt * ax), y + dt * (vy + 0.5 * dt * ay)
    vx, vy = vx + dt * ax, vy + dt * ay
    if not (view.moves and not view.leads and hypot(x - here_x, y - here_y) < STRAY):
        x, y = here_x, here_y
        vx, vy, _ = view.target_velocity if view.leads else view.velocity
        if not (view.moves and isfinite(vx + vy)):
            vx = vy = 0.0
    return (x, y), (clamp(vx, -speed, speed), clamp(vy, -speed, speed))


class Horizon:
    """Plans of a number of steps: accelerations in rows of x and y, places after each of the steps likewise."""

    def __init__(self, steps: int, period: float, effort: float) -> None:
        """Raises PluginError without the solver."""
        try:
            import daqp  # noqa: PLC0415 - an extra
            import numpy as np  # noqa: PLC0415 - which comes with it
        except ImportError:
            raise PluginError(
                "the law mpc needs an extra library: ./zenpark install daqp, or pip install -e '.[mpc]'"
            ) from None
        self._np, self._solve = np, daqp.solve
        self._period = period
        self._times = period * np.arange(1.0, steps + 1.0)
        since = (self._times[:, None] - self._times) / period  # steps from the end of one to the end of another
        self._shift = np.where(since >= 0.0, period * period * (since + 0.5), 0.0)  # change of places by accelerations
        self._gain = np.where(since >= 0.0, period, 0.0)  # change of velocities by accelerations
        half = np.einsum("ki,kj->ij", self._shift, self._shift) + effort * np.eye(steps)  # a BLAS has bits of its own
        self._hessian = 2.0 * np.kron(np.eye(2), half)
        self._velocities = np.kron(np.eye(2), self._gain)
        self.rest = np.zeros((steps, 2))

    def positions(self, p: Planar, v: Planar, a: Array) -> Array:
        """Places from p [m], with v [m/s] and accelerations [m/s²]."""
        np = self._np
        found: Array = np.asarray(p) + self._times[:, None] * np.asarray(v) + np.einsum("ki,ix->kx", self._shift, a)
        return found

    def later(self, path: tuple[float, ...], seconds: float) -> Array:
        """Places of a path `seconds` [s] after its transmission; it stays at its end."""
        np = self._np
        points, when = np.array(path).reshape(-1, 2), (self._times + seconds) / self._period
        before = np.minimum(when.astype(int), len(points) - 2)
        share = np.minimum(when - before, 1.0)[:, None]
        found: Array = (1.0 - share) * points[before] + share * points[before + 1]
        return found

    def conflicts(
        self, own_path: Array, neighbours: Iterable[NeighbourView], spacing: float, right: float
    ) -> list[tuple[int, Planar, float]]:
        """Constraints n·p ≥ b at the first step at which a plan comes too near to another: step, n and b."""
        np = self._np
        paths = [
            self.later(each.said["path"], each.age)
            if is_known(each.said["path"])
            else np.broadcast_to(np.array(each.position[:2]), own_path.shape)
            for each in neighbours
        ]
        if not paths:
            return []
        other_paths = np.array(paths)
        apart = np.hypot(*np.moveaxis(own_path - other_paths, 2, 0))
        too_near = (apart < spacing).any(axis=0)
        if not too_near.any():
            return []
        step, found = int(too_near.argmax()), []
        for (x, y), distance in zip(other_paths[:, step].tolist(), apart[:, step].tolist(), strict=True):
            if distance < AROUND * spacing:
                dx, dy = (own_path[step] - (x, y)).tolist() if distance > TOGETHER else (1.0, 0.0)
                size = hypot(dx, dy)
                nx, ny = (dx * cos(right) - dy * sin(right)) / size, (dx * sin(right) + dy * cos(right)) / size
                found.append((step, (nx, ny), nx * x + ny * y + spacing))
        return found

    def plan(
        self, p: Planar, v: Planar, goal: Planar, conflicts: list[tuple[int, Planar, float]],
        limits: tuple[float, float, float],
    ) -> tuple[Array, float]:  # fmt: skip
        """Accelerations toward a goal, and the largest violation of a constraint; they brake if there is no solution.

        `limits`: of speed [m/s] and acceleration [m/s²], and the penalty of a violation.
        """
        np, steps = self._np, len(self.rest)
        count = len(conflicts)
        speed, most, penalty = limits
        free = self.positions(p, v, self.rest)
        hessian, rows = np.zeros((2 * steps + count,) * 2), np.zeros((2 * steps + count,) * 2)
        hessian[: 2 * steps, : 2 * steps], rows[: 2 * steps, : 2 * steps] = self._hessian, self._velocities
        linear = np.full(2 * steps + count, penalty)
        linear[: 2 * steps] = 2.0 * np.einsum("kx,ki->xi", free - np.asarray(goal), self._shift).ravel()
        low = np.concatenate((np.full(2 * steps, -most), np.zeros(count), np.repeat(-speed - np.asarray(v), steps)))
        high = np.concatenate(
            (np.full(2 * steps, most), np.full(count, np.inf), np.repeat(speed - np.asarray(v), steps))
        )
        for number, (step, (nx, ny), bound) in enumerate(conflicts, 2 * steps):
            hessian[number, number] = 2.0 * penalty
            rows[number, :steps], rows[number, steps : 2 * steps] = nx * self._shift[step], ny * self._shift[step]
            rows[number, number] = 1.0
            low = np.append(low, bound - nx * free[step, 0] - ny * free[step, 1])
            high = np.append(high, np.inf)
        found, _, flag, _ = self._solve(hessian, linear, rows, high, low)
        if flag < 1:
            speeds = np.asarray(v) - np.sign(v) * np.minimum(np.abs(v), most * self._times[:, None])
            return np.diff(speeds, axis=0, prepend=[v]) / self._period, nan
        return found[: 2 * steps].reshape(2, steps).T, float(max(found[2 * steps :], default=0.0))


@lru_cache(maxsize=8)
def horizon(steps: int, period: float, effort: float) -> Horizon:
    """Kept: it is the same for all robots of a law."""
    return Horizon(steps, period, effort)
