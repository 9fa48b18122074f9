"""Range sensors of twins: direction, range, rate and noise of each.

A sensor is a `agents.body.kinds.Sensor` of a kind. A robot has it when its `sensors` in the experiment file names it,
or, for all robots of a kind, when its kind does.

Accuracies that makers give as limits (±) are read as two standard deviations of white noise: 95 % within them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import inf, nan
from statistics import NormalDist
from typing import Final

import numpy as np

from agents.body.interface import BodyError, BodyRequest, RangeScan
from agents.body.kinds import KINDS, Sensor
from twins.arrays import Array, Index
from twins.engines.engine import Engine, World
from twins.models.noise import stream
from twins.sensing.ray_casting import Beams, Caster, Fan

DRAWN_AHEAD: Final = 512  # numbers per robot and sensor
ON_TIME: Final = 1e-6  # [s] ticks are multiples of a period, up to rounding


@cache
def sensors() -> dict[str, Sensor]:
    """Range sensors of all kinds by name."""
    return {each.name: each for kind in KINDS.usable() for each in (*kind.sensors, *kind.decks)}


def fan(sensor: Sensor) -> Fan:
    """The rays of a sensor, from the robot's centre."""
    elevation = np.array(sensor.elevation or (0.0,) * len(sensor.bearing))
    return Fan(np.array(sensor.bearing), elevation, sensor.height, sensor.mount + sensor.farthest)


class RangeSensors:
    """Range sensors of all robots of a world. Rays of a robot are in the order of its sensors."""

    scans: list[RangeScan | None]  # newest readings of each robot; None before the first, and without sensors
    next: float  # time of the next measurement [s]

    def __init__(self, request: BodyRequest, world: World) -> None:
        """Raises BodyError for an unknown sensor."""
        carried = [tuple(dict.fromkeys(own)) for own in world.sensors]
        for robot, own in zip(request.names, carried, strict=True):
            for name in own:
                if name not in sensors():
                    raise BodyError(f"{robot}: there is no sensor {name}; there are {', '.join(sensors())}")
        self._caster = Caster(world.scene, request.kinds)
        fans = [(row, name) for row, own in enumerate(carried) for name in own]
        self._mounted = []
        for name in dict.fromkeys(name for _, name in fans):
            rows = np.array([row for row, other in fans if other == name])
            self._mounted.append(_Mounted(name, rows, request, world.sensor_noise))
        self._carried = carried
        self._rays = [_directions(own) for own in carried]
        # distance to what each sensor of a robot has seen last
        self._seen: list[dict[str, list[float]]] = [
            {name: [nan] * len(sensors()[name].bearing) for name in own} for own in carried
        ]
        self.scans = [None] * len(carried)
        self._due = [-inf] * len(self._mounted)
        self.next = -inf if self._mounted else inf
        self._beams: dict[tuple[int, ...], Beams] = {}

    def sweep(self, t: float, engine: Engine) -> bool:
        """Measure with the sensors that are due at `t` [s], at first with all; returns whether there are any.

        Missed measurements are not repeated.
        """
        if t < self.next:
            return False
        due = tuple(k for k, when in enumerate(self._due) if when <= t)
        beams = self._beams.get(due)
        if beams is None:
            beams = self._beams[due] = _arrange_beams([self._mounted[k] for k in due])
        position = np.array([motion.position for motion in engine.motions])
        yaw = np.array([motion.yaw for motion in engine.motions])
        obstacles = np.array(engine.obstacles).reshape(-1, 3)
        truth = self._caster.cast(beams, position, yaw, obstacles)
        begin = 0
        changed: set[int] = set()
        for k in due:
            one = self._mounted[k]
            rows, width = one.rows.tolist(), len(one.sensor.bearing)
            end = begin + len(rows) * width
            for row, distance in zip(rows, one.read(truth[begin:end].reshape(-1, width)).tolist(), strict=True):
                self._seen[row][one.name] = distance
            changed.update(rows)
            begin = end
            period = 1.0 / one.sensor.rate_hz
            following = self._due[k] + period
            self._due[k] = following if following > t - period else t - ON_TIME + period
        for row in changed:
            bearing, elevation = self._rays[row]
            distances = [each for name in self._carried[row] for each in self._seen[row][name]]
            self.scans[row] = RangeScan(t, bearing, elevation, distances)
        self.next = min(self._due)
        return True


def _directions(names: Sequence[str]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bearings and elevations of the rays of some sensors [rad]."""
    fans = [fan(sensors()[name]) for name in names]
    bearing = tuple(ray for each in fans for ray in each.bearing.tolist())
    return bearing, tuple(ray for each in fans for ray in each.elevation.tolist())


def _arrange_beams(mounted: Sequence[_Mounted]) -> Beams:
    """Arrange the rays of these sensors, sensor after sensor."""
    rows = [one.rows for one in mounted]
    which = np.repeat(np.arange(len(mounted)), [len(each) for each in rows])
    return Beams([fan(one.sensor) for one in mounted], np.concatenate(rows), which)


class _Mounted:
    """One kind of sensor on the robots that have it."""

    def __init__(self, name: str, rows: Index, request: BodyRequest, scale: float) -> None:
        sensor = self.sensor = sensors()[name]
        self.name = name
        self.rows = rows  # (k,)
        self._scale = scale
        share = min(sensor.dropout * scale, 1.0)
        self._lost = NormalDist().inv_cdf(share) if 0.0 < share < 1.0 else inf
        robots = [(request.names[row], request.seeds[row]) for row in rows.tolist()]
        width = len(sensor.bearing)
        self._noise = _Streams(robots, f"{name} noise", width) if scale > 0.0 else None
        self._dropouts = _Streams(robots, f"{name} dropouts", width) if share > 0.0 else None

    def read(self, truth: Array) -> Array:
        """Readings for true distances from the robots' centres (k, m) [m]; NaN where nothing is reported."""
        sensor = self.sensor
        reading = np.maximum(truth - sensor.mount, 0.0)  # an object in contact touches the rim
        if self._noise is not None:
            sigma = np.where(reading < sensor.relative_from, sensor.sigma, sensor.relative * reading)
            reading = np.maximum(reading + self._scale * sigma * self._noise.draw(), 0.0)
            if sensor.resolution > 0.0:
                reading = sensor.resolution * np.round(reading / sensor.resolution)
            if self._dropouts is not None:
                reading[self._dropouts.draw() < self._lost] = np.nan
        outside = (reading < sensor.nearest) | (reading > sensor.farthest)
        return np.where(outside, np.nan, sensor.mount + reading)


class _Streams:
    """White Gaussian noise of unit variance for the rays of a sensor on k robots; each has its own stream."""

    def __init__(self, robots: Sequence[tuple[str, int]], purpose: str, width: int) -> None:
        """`robots`: names and seeds."""
        self._generators = [stream(name, seed, purpose) for name, seed in robots]
        self._shape = max(DRAWN_AHEAD // width, 1), width
        self._ahead: Array = np.zeros((0, len(robots), width))
        self._next = 0

    def draw(self) -> Array:
        """The next (k, width)."""
        if self._next == len(self._ahead):
            drawn = [generator.standard_normal(self._shape) for generator in self._generators]
            self._ahead, self._next = np.stack(drawn, axis=1), 0
        self._next += 1
        return np.asarray(self._ahead[self._next - 1])
