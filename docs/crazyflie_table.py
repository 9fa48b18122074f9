"""Prints the table of docs/crazyflie.md that compares the twin with published formulas:

.venv/bin/python docs/crazyflie_table.py
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial, pi

import numpy as np

from agents.vectors import ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.crazyflie.mujoco.engine import RigidBody
from bridges.crazyflie.twin.planner import ORDER, OnboardPlanner, evaluate, polynomial
from bridges.crazyflie.twin.vehicle import LOST, Estimator
from twins.arrays import Array
from twins.engines.engine import Engine, EngineInput
from twins.engines.point_mass import PointMass
from twins.scene import Scene

DT = 0.01
SETTLED = 1e-3  # [m²] variance of an estimate at which clients go on
ACCELERATION = 0.5  # [m/s²] noise of the firmware's Kalman filter, kalman.pNAcc_xy
POSITION = 0.01  # [m] its noise of external positions, locSrv.extPosStdDev
EVERY = 2  # ticks from one external position to the next: 50 Hz


def minimum_snap_difference(rng: np.random.Generator) -> float:
    """Largest difference [m] of the planner's polynomial to the solution of its eight conditions, in 1,000 plans."""
    worst = 0.0
    for _ in range(1000):
        span, ends = rng.uniform(0.5, 5.0), rng.uniform(-2.0, 2.0, (2, 3))
        rows, values = [], []
        for t, end in zip((0.0, span), ends, strict=True):
            for order, value in enumerate((*end, 0.0)):
                rows.append(
                    [
                        factorial(k) / factorial(k - order) * t ** (k - order) if k >= order else 0.0
                        for k in range(ORDER + 1)
                    ]
                )
                values.append(value)
        exact = np.linalg.solve(np.array(rows), np.array(values))
        begin, goal = (tuple(np.array([value]) for value in end) for end in ends)
        t = np.linspace(0.0, span, 50)
        found, _, _ = evaluate(polynomial(span, begin, goal)[0][None], t)  # type: ignore[arg-type]
        worst = max(worst, float(np.abs(found - np.polyval(exact[::-1], t)).max()))
    return worst


def spiral_difference(angle: float, last: float) -> float:
    """Largest distance [m] from an arc of `angle` [rad] from a radius of 1 m to `last` [m] to the spiral itself."""
    planner, span = OnboardPlanner(), 5.0
    planner.spiral(
        0.0, np.zeros(4), angle=angle, radii=(1.0, last), climb=0.0, span=span, sideways=False, clockwise=False
    )
    worst = 0.0
    for share in np.linspace(0.0, 1.0, 101):
        radius, turn = 1.0 + (last - 1.0) * share, angle * share
        spiral = np.array([radius * np.sin(turn), 1.0 - radius * np.cos(turn)])
        worst = max(worst, float(np.linalg.norm(planner.state(span * share)[0][:2] - spiral)))
    return worst


def kalman() -> Callable[[], float]:
    """Variance [m²] of a position in a Kalman filter with the firmware's noises, tick by tick."""
    step = np.array([[1.0, DT], [0.0, 1.0]])
    noise = ACCELERATION**2 * np.array([[DT**4 / 4.0, DT**3 / 2.0], [DT**3 / 2.0, DT**2]])
    state, tick = np.diag([LOST, 1.0]), 0

    def advance() -> float:
        nonlocal state, tick
        tick += 1
        state = step @ state @ step.T + noise
        if tick % EVERY == 0:
            gain = state[:, 0] / (state[0, 0] + POSITION**2)
            state = state - np.outer(gain, state[0])
        return float(state[0, 0])

    return advance


def twin() -> Callable[[], float]:
    """Variance [m²] of the twin's estimate, tick by tick."""
    estimator, tick = Estimator(ZERO, 0.0), 0

    def advance() -> float:
        nonlocal tick
        tick += 1
        estimator.add_external(DT * tick, ZERO, ZERO)
        estimator.advance(DT * tick, DT, ready=False, flow=False, flying=False)
        return estimator.variance

    return advance


def settling(variance: Callable[[], float]) -> tuple[float, float]:
    """Time [s] until a variance is below `SETTLED`, and its standard deviation [m] after 10 s."""
    values = np.array([variance() for _ in range(1000)])
    return DT * (1 + int((values < SETTLED).argmax())), float(np.sqrt(values[-1]))


def law_difference(setpoints: Array) -> tuple[float, float]:
    """Root mean square and largest distance [m] of the twin's law to the cascade on a rigid body; setpoints (T, 4)."""
    one = EngineInput((CRAZYFLIE,), [(0.0, 0.0, 0.0)], [0.0], DT, [False], Scene.empty())
    engines: tuple[Engine, ...] = PointMass().build(one), RigidBody().build(one)
    paths = []
    for engine in engines:
        engine.place([0], [(0.0, 0.0, 1.0)], [0.0], [True])
        path = []
        for x, y, z, yaw in setpoints.tolist():
            engine.motions[0].command((x, y, z, yaw))
            engine.advance(0.0, [(0.0, 0.0)])
            path.append(engine.motions[0].position)
        paths.append(np.array(path))
    far = np.linalg.norm(paths[0] - paths[1], axis=1)
    return float(np.sqrt((far**2).mean())), float(far.max())


def step(axis: int, size: float) -> Array:
    """Setpoints (T, 4) of a step of one axis [m]."""
    setpoints = np.tile([0.0, 0.0, 1.0, 0.0], (400, 1))
    setpoints[:, axis] += size
    return setpoints


def planned(span: float) -> Array:
    """Setpoints (T, 4) of a plan of 2 m along x in `span` [s]."""
    planner = OnboardPlanner()
    start = np.array([0.0, 0.0, 1.0, 0.0])
    goal = start + np.array([2.0, 0.0, 0.0, 0.0])
    planner.go_to(0.0, start, ZERO, goal=goal, span=span, relative=False, linear=False)
    return np.array([planner.state(DT * k)[0] for k in range(round((span + 2.0) / DT))])


def main() -> None:
    """Print the rows."""
    polynomials = minimum_snap_difference(np.random.default_rng(1))
    print(f"| planner, 1,000 polynomials | {1e9 * polynomials:.2f} nm |")
    for degrees, last in ((90, 1.0), (180, 1.0), (360, 1.0), (90, 1.5)):
        text = f"spiral of {degrees}°, 1 to {last:g} m"
        print(
            f"| {text}: distance to the spiral itself | {1e3 * spiral_difference(degrees * pi / 180.0, last):.0f} mm |"
        )
    (mine, spread), (exact, sigma) = settling(twin()), settling(kalman())
    print(f"| estimator, external positions at 50 Hz: settles in | {mine:.2f} s, Kalman {exact:.2f} s |")
    print(f"| its standard deviation then | {1e3 * spread:.1f} mm, Kalman {1e3 * sigma:.1f} mm |")
    for text, setpoints in (
        ("step of 0.3 m along x", step(0, 0.3)),
        ("step of 1 m along x", step(0, 1.0)),
        ("step of 0.3 m upwards", step(2, 0.3)),
        ("go_to of 2 m in 4 s", planned(4.0)),
        ("go_to of 2 m in 2 s", planned(2.0)),
    ):
        rms, worst = law_difference(setpoints)
        print(f"| motion, {text}: rms, largest distance | {1e3 * rms:.0f} mm, {1e3 * worst:.0f} mm |")


if __name__ == "__main__":
    main()
