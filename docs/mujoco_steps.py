"""Draws docs/mujoco-steps.svg and prints the table of docs/mujoco.md: .venv/bin/python docs/mujoco_steps.py"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from agents.arrays import Array
from agents.body.kinds import CRAZYFLIE
from experiments.report.style import CASES, STYLE
from twins.engines.mujoco_engine import Drones
from twins.models.quadrotor import RESPONSES, Quadrotor
from twins.scene import Scene

DT, SECONDS, HEIGHT = 0.01, 4.0, 1.0
STEPS = (("x", 0, 0.3), ("x", 0, 1.0), ("z", 2, 0.3), ("z", 2, 1.0), ("yaw", 3, 1.0))


def flown(robot: Drones | Quadrotor, axis: int, step: float) -> Array:
    """(T, 2) time [s] and what a step of one axis makes of it [m], [rad]."""
    hold = np.array([0.0, 0.0, HEIGHT, 0.0])
    robot.place(np.array([0]), hold[None, :3], hold[3:], np.array([True]))
    setpoint, path = hold.copy(), [0.0]
    setpoint[axis] += step
    for _ in range(round(SECONDS / DT)):
        robot.command(setpoint[None])
        robot.advance()
        path.append([*robot.position[0], robot.yaw[0]][axis] - hold[axis])
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
    one = ((CRAZYFLIE,), np.zeros((1, 3)), np.zeros(1), DT)
    print(f"law: {RESPONSES['crazyflie']}")
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 1.9), layout="constrained")
        panels = iter(figure.subplots(1, 4))
        for name, axis, step in STEPS:
            curves = {
                "rigid body, firmware's cascade": flown(Drones(*one, scene=Scene.empty(), motor_lag=0.03), axis, step),
                "fitted law": flown(Quadrotor(*one), axis, step),
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
