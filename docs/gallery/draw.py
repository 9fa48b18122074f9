"""Pictures of the gallery: .venv/bin/python docs/gallery/draw.py [LAW ...]

Behind `--runs` stand folders of runs instead: their figures are printed, in the words of the table of the gallery.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.report.style import CASES, STYLE
from zenpark import Trace, load, reopen, simulate

Array = np.ndarray[Any, Any]  # of numbers; (T,) for a curve, in the unit of its law


def places(trace: Trace) -> Array:
    """Places from above (T, N, 2) [m]."""
    return np.asarray(trace.true_position[..., :2])


def law_of(trace: Trace) -> dict[str, Any]:
    """Parameters of the law, as the file has them."""
    law: dict[str, Any] = trace.plan.experiment.formation.law
    return law


def largest(apart: Array) -> Array:
    """Length of the longest of the differences (T, N, 2) at each time; NaN of those that are not known yet."""
    lengths = np.linalg.norm(apart, axis=2)
    return np.asarray(np.fmax.reduce(lengths, axis=1))


def by_robot(trace: Trace, table: dict[str, Sequence[float]]) -> Array:
    """Rows (N, 2) of a table by name."""
    return np.array([table[name] for name in trace.robots])


def shape(trace: Trace) -> Array:
    """Places of the file's shape (N, 2) [m]."""
    return by_robot(trace, {name: place[:2] for name, place in trace.plan.experiment.formation.shape.items()})


def consensus(trace: Trace) -> Array:
    """Norm of what is left to the meeting point."""
    place = places(trace) - by_robot(trace, law_of(trace)["offset"])
    return np.asarray(np.linalg.norm(place - place.mean(axis=1, keepdims=True), axis=(1, 2)))


def average(trace: Trace) -> Array:
    """Largest error of an estimate."""
    signal = law_of(trace)["signal"]
    return largest(trace.memory["x"] - np.mean([*signal.values()]))


def aggregative(trace: Trace) -> Array:
    """Largest distance from the centralised optimum, where w = 1 and g = 2."""
    law = law_of(trace)
    targets, wanted = by_robot(trace, law["targets"]), np.array([*law["places"].values()])
    share = 2.0 * len(wanted) / len(targets)
    centre = (targets.mean(axis=0) + share * wanted.mean(axis=0)) / (1.0 + share)
    return largest(places(trace) - (targets - share * (centre - wanted.mean(axis=0))))


def auction(trace: Trace) -> Array:
    """Sum of the ways that are left to the tasks that were won."""
    law, chosen = law_of(trace), trace.measures["task"]
    tasks = np.array([*law["tasks"], *(each[:2] for each in law["later"])])
    won = chosen >= 0.0
    there = tasks[np.where(won, chosen, 0.0).astype(int)]
    return np.asarray((np.linalg.norm(places(trace) - there, axis=2) * won).sum(axis=1))


def beyond_least(trace: Trace, _: Array) -> float:
    """Sum of the ways at a call of tasks less the least that any assignment has; the larger of both calls."""
    law, worst = law_of(trace), 0.0
    tasks = np.array([*law["tasks"], *(each[:2] for each in law["later"])])
    for begin, end, count in ((0.0, 14.5, 4), (15.2, trace.time[-1], 5)):
        first, last = np.searchsorted(trace.time, [begin, end])
        chosen = trace.measures["task"][last]
        ways = np.linalg.norm(places(trace)[first][:, None] - tasks[:count], axis=2)
        won = [int(np.flatnonzero(chosen == task)[0]) for task in range(count)]
        least = min(ways[list(some), range(count)].sum() for some in permutations(range(len(ways)), count))
        worst = max(worst, ways[won, range(count)].sum() - least)
    return worst


def radius(trace: Trace) -> Array:
    """Mean distance of the robots from their mean."""
    place = places(trace)
    return np.asarray(np.linalg.norm(place - place.mean(axis=1, keepdims=True), axis=2).mean(axis=1))


def turning(trace: Trace, _: Array) -> float:
    """Speed of the turn about the mean [rad/s], from 2 s on."""
    place = places(trace)[..., 0] + 1j * places(trace)[..., 1]
    late, count = trace.time > 2.0, place.shape[1]
    mode = (place * np.exp(-2j * np.pi / count * np.arange(count))).mean(axis=1)[late]
    return float(np.polyfit(trace.time[late], np.unwrap(np.angle(mode)), 1)[0])


def leader_observer(trace: Trace) -> Array:
    """Largest distance from a place behind the leader, the first robot."""
    place = places(trace) - shape(trace)
    return largest(place - place[:, :1])


def coverage(trace: Trace) -> Array:
    """Cost H of the places, over a grid of the area."""
    ((x, y, width, height),) = law_of(trace)["peaks"]
    edge = np.linspace(-1.78, 1.78, 90)
    spots = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    bell = height * np.exp(-((spots - [x, y]) ** 2).sum(axis=1) / (2.0 * width**2))
    weight = (1.0 + bell) * (edge[1] - edge[0]) ** 2
    return np.array([((spots[:, None] - now) ** 2).sum(axis=2).min(axis=1) @ weight for now in places(trace)])


def flocking(trace: Trace) -> Array:
    """Largest difference of a robot's velocity, over a second of its way, from that of the rendezvous."""
    place, tick = places(trace), trace.time[1] - trace.time[0]
    half = round(0.5 / tick)
    speed = np.full_like(place, np.nan)
    speed[half:-half] = (place[2 * half :] - place[: -2 * half]) / (2 * half * tick)
    return largest(speed - law_of(trace)["velocity"])


def enclosing(trace: Trace) -> Array:
    """Largest difference of a distance from the target, the first robot, from the wanted radius."""
    place = places(trace)
    away = np.linalg.norm(place[:, 1:] - place[:, :1], axis=2)
    return np.asarray(np.abs(away - law_of(trace)["radius"]).max(axis=1))


def tracking(trace: Trace) -> Array:
    """Root of the mean squared error of the estimates of the first robot's place."""
    apart = trace.memory["x"][:, 1:, :2] - places(trace)[:, :1]
    return np.asarray(np.sqrt((apart**2).sum(axis=2).mean(axis=1)))


def root_mean_square(trace: Trace, curve: Array) -> float:
    """Of a curve, from 5 s on."""
    return float(np.sqrt(np.mean(curve[trace.time > 5.0] ** 2)))


def nearest(trace: Trace) -> Array:
    """Least distance of any two robots."""
    place = places(trace)
    pairs = combinations(range(place.shape[1]), 2)
    return np.asarray(np.min([np.linalg.norm(place[:, a] - place[:, b], axis=1) for a, b in pairs], axis=0))


def policy(trace: Trace) -> Array:
    """Largest distance from a place in the square of 1 m, about the mean."""
    place = places(trace) - [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    return largest(place - place.mean(axis=1, keepdims=True))


def end(trace: Trace, curve: Array) -> float:
    """Largest value of the last second that is known."""
    late = curve[np.isfinite(curve)][-round(1.0 / (trace.time[1] - trace.time[0])) :]
    return float(late.max())


def within(begin: float, until: float) -> Callable[[Trace, Array], float]:
    """Largest value between two times [s]."""
    return lambda trace, curve: float(curve[(trace.time > begin) & (trace.time < until)].max())


class Subject(NamedTuple):
    """Picture of a law, and its figure in the table of the gallery."""

    curve: Callable[[Trace], Array]
    label: str
    figure: Callable[[Trace, Array], float] = end
    logarithmic: bool = True


SUBJECTS = {
    "consensus": Subject(consensus, "distance left, norm (m)"),
    "average": Subject(average, "largest error"),
    "aggregative": Subject(aggregative, "from the optimum (m)"),
    "auction": Subject(auction, "ways left, sum (m)", beyond_least, logarithmic=False),
    "cyclic-pursuit": Subject(radius, "mean radius (m)", turning, logarithmic=False),
    "leader-observer": Subject(leader_observer, "largest lag (m)", within(20.0, 38.0)),
    "coverage": Subject(coverage, "cost H", logarithmic=False),
    "flocking": Subject(flocking, "velocity, off by (m/s)"),
    "integral": Subject(leader_observer, "largest error (m)", within(37.0, 40.0)),
    "enclosing": Subject(enclosing, "off the radius (m)", within(30.0, 38.0)),
    "tracking": Subject(tracking, "error, rms (m)", root_mean_square),
    "mpc": Subject(nearest, "nearest two (m)", lambda _, curve: float(curve.min()), logarithmic=False),
    "policy": Subject(policy, "off the square (m)"),
}


def ways(axes: Axes, trace: Trace) -> None:
    """Ways from above, with starts (circles) and ends (discs)."""
    colours = mpl.colormaps["turbo"](np.linspace(0.05, 0.95, len(trace.robots)))
    for robot, colour in enumerate(colours):
        x, y = places(trace)[:: 10 * (1 + len(trace.robots) // 8), robot].T  # a page loads quickly
        axes.plot(x, y, color=colour, linewidth=0.9)
        axes.plot(x[0], y[0], "o", color=colour, markerfacecolor="white", markersize=4)
        axes.plot(x[-1], y[-1], "o", color=colour, markersize=4)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.set_adjustable("datalim")


def draw(name: str) -> dict[str, float]:
    """Picture of a law: ways of the first case, and the curves of all. The figures of the cases."""
    subject, traces = SUBJECTS[name], simulate(load(name)).traces
    found = {}
    with mpl.rc_context({**STYLE, "svg.fonttype": "none", "svg.hashsalt": name}):
        figure = Figure(figsize=(7.0, 2.4), layout="constrained")
        above, over = figure.subplots(1, 2, width_ratios=[1.0, 1.4])
        ways(above, next(iter(traces.values())))
        for (case, trace), colour in zip(traces.items(), CASES, strict=False):
            curve = subject.curve(trace)
            found[case] = subject.figure(trace, curve)
            label = f"{case}: {len(trace.sent)}"
            over.plot(trace.time[::10], curve[::10], color=colour, linewidth=0.9, label=label)
        over.set(xlabel="time (s)", ylabel=subject.label, yscale="log" if subject.logarithmic else "linear")
        over.legend(title="messages", borderaxespad=2.0)  # with room for the wider letters of other machines
        picture = Path(__file__).with_name(f"{name}.svg")
        figure.savefig(picture, metadata={"Date": None}, transparent=False)
    return found


def main(words: Sequence[str]) -> None:
    """Draws laws, or prints the figures of runs."""
    if words[:1] == ["--runs"]:
        for folder in words[1:]:
            for case, trace in reopen(folder).traces.items():
                subject = SUBJECTS[law_of(trace)["kind"]]
                found = subject.figure(trace, subject.curve(trace))
                print(f"{law_of(trace)['kind']} {case}: {found:.3g}, {len(trace.sent)} messages")
        return
    for name in words or SUBJECTS:
        print(name, *(f"{case} {found:.3g}" for case, found in draw(name).items()))


if __name__ == "__main__":
    main(sys.argv[1:])
