"""Metrics of the course, all of true places; lengths are seen from above, and the end is the last second."""

import numpy as np

from zenpark import Metric


def end(trace):
    """Places in the last second (T, N, 2) [m], and their times (T,) [s]."""
    late = trace.time >= trace.time[-1] - 1.0
    return trace.true_position[late, :, :2], trace.time[late]


def velocity(trace):
    """Mean velocity of each robot over the last second (N, 2) [m/s]."""
    place, time = end(trace)
    return (place[-1] - place[0]) / (time[-1] - time[0])


class Spread(Metric, frozen=True):
    """Largest distance between two robots in the end."""

    label, unit, per = "Spread", "m", "case"

    def of(self, trace, shared):
        place = end(trace)[0].mean(axis=0)
        return np.linalg.norm(place[:, None] - place, axis=2).max()


class Length(Metric, frozen=True):
    """Largest distance between two robots along x in the end."""

    label, unit, per = "Length", "m", "case"

    def of(self, trace, shared):
        return np.ptp(end(trace)[0].mean(axis=0)[:, 0])


class Drift(Metric, frozen=True):
    """Way of the mean of all robots, from the start to the end."""

    label, unit, per = "Drift", "m", "case"

    def of(self, trace, shared):
        return np.linalg.norm(end(trace)[0].mean(axis=(0, 1)) - trace.true_position[0, :, :2].mean(axis=0))


class Speed(Metric, frozen=True):
    """Speed of a robot in the end."""

    label, unit, better = "Speed", "m/s", "more"

    def of(self, trace, shared):
        return np.linalg.norm(velocity(trace), axis=1)


class Disorder(Metric, frozen=True):
    """Largest difference between the velocities of two robots in the end."""

    label, unit, per = "Disorder", "m/s", "case"

    def of(self, trace, shared):
        each = velocity(trace)
        return np.linalg.norm(each[:, None] - each, axis=2).max()


class Lag(Metric, frozen=True):
    """Distance of a robot from its place in the shape, as the leader has it, in the end."""

    label, unit = "Lag", "m"

    def of(self, trace, shared):
        formation = trace.plan.experiment.formation
        wanted = np.array([formation.shape[name] for name in trace.robots])
        off = end(trace)[0] - wanted[:, :2]
        return np.linalg.norm(off - off[:, [trace.robots.index(formation.leader)]], axis=2).mean(axis=0)


class Way(Metric, frozen=True):
    """Length of the path of a robot, without what is shorter than a centimetre in half a second."""

    label, unit = "Way", "m"

    def of(self, trace, shared):
        every = max(1, round(0.5 / (trace.time[1] - trace.time[0])))
        steps = np.linalg.norm(np.diff(trace.true_position[::every, :, :2], axis=0), axis=2)
        return np.where(steps > 0.01, steps, 0.0).sum(axis=0)


class Cover(Metric, frozen=True):
    """Mean distance of the places of the arena, 0.2 m inside its walls, from the nearest robot in the end."""

    label, unit, per = "Cover", "m", "case"

    def of(self, trace, shared):
        x, y = (np.linspace(0.2 - size / 2, size / 2 - 0.2, 40) for size in trace.plan.experiment.arena.size[:2])
        floor = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
        return np.linalg.norm(floor - end(trace)[0].mean(axis=0), axis=2).min(axis=1).mean()


class Unserved(Metric, frozen=True):
    """Largest distance of a task of the law from the nearest robot in the end."""

    label, unit, per = "Unserved", "m", "case"

    def of(self, trace, shared):
        tasks = np.array(trace.plan.experiment.formation.law["tasks"])
        return np.linalg.norm(tasks[:, None] - end(trace)[0].mean(axis=0), axis=2).min(axis=1).max()
