"""Draws docs/mpc-paths.svg: .venv/bin/python docs/mpc_paths.py"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.catalogue import index
from experiments.file import document
from experiments.report.style import STYLE
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate

SECONDS = (0.0, 2.0, 3.5, 8.0)  # of the panels


def main() -> None:
    """Ways so far, and what the robots say of the next 3 s."""
    plan = document.read(index.find_file("mpc"), []).cases()["periodic"]
    trace = RunRecorder(simulate(plan, plan.experiment.seed), plan, "periodic").trace()
    plans = trace.memory["path"].reshape(len(trace.time), len(plan.names), -1, 2)
    colours = mpl.colormaps["turbo"](np.linspace(0.05, 0.95, len(plan.names)))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 2.1), layout="constrained")
        for axes, seconds in zip(figure.subplots(1, len(SECONDS), sharey=True), SECONDS, strict=True):
            last = int(np.searchsorted(trace.time, seconds + 0.1))
            for robot, colour in enumerate(colours):
                x, y = trace.true_position[: last + 1, robot, :2].T
                axes.plot(x, y, color=colour, linewidth=0.8)
                axes.plot(*plans[last, robot].T, ":", color=colour, linewidth=0.8)
                axes.plot(x[-1], y[-1], "o", color=colour, markersize=5)
            axes.set(title=f"{seconds:g} s", xlabel="x (m)", xlim=(-1.7, 1.7), ylim=(-1.7, 1.7), aspect="equal")
        figure.axes[0].set_ylabel("y (m)")
        figure.savefig(Path(__file__).with_name("mpc-paths.svg"), metadata={"Date": None}, transparent=False)


if __name__ == "__main__":
    main()
