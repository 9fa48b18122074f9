"""Draws docs/tracking-errors.svg: .venv/bin/python docs/tracking_errors.py"""

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


def main() -> None:
    """Estimates of one robot beside the way of the target, and the errors of all robots in three cases."""
    given = document.read(index.find_file("tracking"), [])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 2.0), layout="constrained")
        where, *errors = figure.subplots(1, 1 + len(given.cases()), width_ratios=[1.0, 1.2, 1.2, 1.2])
        for axes, (case, plan) in zip(errors, given.cases().items(), strict=True):
            trace = RunRecorder(simulate(plan, plan.experiment.seed), plan, case).trace()
            target = trace.true_position[:, :1, :2]
            if axes is errors[0]:
                where.plot(*trace.memory["x"][::5, 1, :2].T, ".", markersize=2)
                where.plot(*target[:, 0].T, color="black", linewidth=0.8)
                where.plot(*trace.true_position[0, 1:, :2].T, "s", markersize=4)
                where.set(aspect="equal", xlim=(-1.7, 1.7), ylim=(-1.7, 1.7), xlabel="x (m)", ylabel="y (m)")
            error = 100.0 * np.linalg.norm(trace.memory["x"][:, 1:, :2] - target, axis=2)
            axes.plot(trace.time[::5], error[::5], linewidth=0.5)
            axes.plot(trace.time[::5], 100.0 * trace.measures["uncertainty"][::5, 1], "k--", linewidth=1.0)
            axes.set(title=f"{case}: {len(trace.sent)} messages", xlabel="time (s)", ylim=(0.0, 15.0))
        errors[0].set_ylabel("error of the place (cm)")
        figure.savefig(Path(__file__).with_name("tracking-errors.svg"), metadata={"Date": None}, transparent=False)


if __name__ == "__main__":
    main()
