"""Draws docs/mujoco-steps.svg and prints the table of docs/mujoco.md: .venv/bin/python docs/mujoco_steps.py"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from bridges.crazyflie.kind import CRAZYFLIE
from bridges.crazyflie.mujoco.engine import RigidBody
from experiments.report.style import CASES, STYLE
from twins.arrays import Array
from twins.engines.engine import Engine, EngineInput
from twins.engines.point_mass import PointMass
from twins.scene import Scene

DT, SECONDS, HEIGHT = 0.01, 4.0, 1.0
STEPS = (("x", 0, 0.3), ("x", 0, 1.0), ("z", 2, 0.3), ("z", 2, 1.0), ("yaw", 3, 1.0))


def flown(engine: Engine, axis: int, step: float) -> Array:
    """(T, 2) time [s] and what a step of one axis makes of it [m], [rad]."""
    hold = [0.0, 0.0, HEIGHT, 0.0]
    engine.place([0], [(0.0, 0.0, HEIGHT)], [0.0], [True])
    x, y, z, yaw = (value + step * (number == axis) for number, value in enumerate(hold))
    motion, path = engine.motions[0], [0.0]
    for _ in range(round(SECONDS / DT)):
        engine.motions[0].command((x, y, z, yaw))
        engine.advance(0.0, [(0.0, 0.0)])
        path.append([*motion.position, motion.yaw][axis] - hold[axis])
    return np.column_stack([DT * np.arange(len(path)), path])


def figures(path: Array, step: float) -> tuple[float, float]:
    """Rise from a tenth to nine tenths [s], overshoot as a share of the step."""
    time, value = path.T
    rise = []
    for level in (0.1 * step, 0.9 * step):
        after = int((value >= level).argmax())
        rise.append(np.interp(level, value[after - 1 : after + 1], time[after - 1 : after + 1]))
    return float(rise[1] - rise[0]), float(value.max() / step - 1.0)


def main() -> None:
    """Both."""
    one = EngineInput((CRAZYFLIE,), [(0.0, 0.0, 0.0)], [0.0], DT, [False], Scene.empty())
    print(f"law: {CRAZYFLIE.motion}")
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 1.9), layout="constrained")
        panels = iter(figure.subplots(1, 4))
        for name, axis, step in STEPS:
            curves = {
                "rigid body, firmware's cascade": flown(RigidBody().build(one), axis, step),
                "fitted law": flown(PointMass().build(one), axis, step),
            }
            for label, path in curves.items():
                rise, overshoot = figures(path, step)
                print(f"{name} {step:g}: {label}: rise {1e3 * rise:.0f} ms, overshoot {100 * overshoot:.1f} %")
            if (name, step) == ("z", 0.3):
                continue
            axes = next(panels)
            for (label, path), style, colour in zip(curves.items(), ("-", "--"), CASES, strict=False):
                axes.plot(*path.T, style, color=colour, label=label)
            axes.axhline(step, color="#9a9a9a", linewidth=0.5, zorder=0.5)
            axes.set(
                xlabel="Time (s)", ylabel=f"{name} ({'rad' if axis == 3 else 'm'})", xlim=(0.0, SECONDS), ylim=(0, None)
            )
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=2, loc="outside upper center")
        figure.savefig(Path(__file__).with_name("mujoco-steps.svg"), metadata={"Date": None}, transparent=False)


if __name__ == "__main__":
    main()
