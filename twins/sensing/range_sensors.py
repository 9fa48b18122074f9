"""Range sensors of twins: direction, range, rate and noise of each.

A new sensor is a new entry of `SENSORS`: a `Sensor` with its rays and parameters. A robot has a sensor when its
`sensors` in the experiment file names it, or, for all robots of a kind, when its kind does. No other module knows
sensor names.

Accuracies that makers give as limits (±) are read as two standard deviations of white noise: 95 % within them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, nan
from statistics import NormalDist
from typing import Final

import numpy as np

from agents.body.interface import BodyError, BodyRequest, RangeScan
from agents.protocols.khepera4 import LIGHT_BEARING, RIM, SOUND_BEARING
from twins.arrays import Array, Index
from twins.engines.engine import Engine, World
from twins.models.noise import stream
from twins.sensing.ray_casting import Beams, Caster, Fan

DRAWN_AHEAD: Final = 512  # numbers per robot and sensor
ON_TIME: Final = 1e-6  # [s] ticks are multiples of a period, up to rounding


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """One kind of range sensor; ranges are measured from the sensor itself."""

    bearing: Array  # (m,) of the rays from the robot's nose, to the left [rad]
    elevation: Array  # (m,) 0 or ±π/2 [rad]
    mount: float = 0.0  # from the robot's centre to the sensor, along each ray [m]
    height: float  # above the robot's position, which is the lowest point of its body [m]
    nearest: float = 0.0  # closer objects are not reported [m]; with 0, an object that touches the sensor is at 0
    farthest: float  # farther objects are not reported [m]
    rate_hz: float
    sigma: float  # standard deviation of a reading [m]
    relative: float = 0.0  # standard deviation as a share of the range, from `relative_from` on
    relative_from: float = inf  # [m]
    dropout: float = 0.0  # probability that a ray reports nothing
    resolution: float = 0.0  # step of the readings [m]; 0: none

    @property
    def fan(self) -> Fan:
        """The sensor's rays, from the robot's centre."""
        return Fan(self.bearing, self.elevation, self.height, self.mount + self.farthest)


SENSORS: Final[dict[str, Sensor]] = {
    # Khepera IV; the maker gives no accuracy, and rates depend on the program on the robot: 10 Hz, sigmas, heights
    # (lower than a landed Crazyflie is high) and dropouts are choices
    "infrared": Sensor(
        bearing=np.array(LIGHT_BEARING),
        elevation=np.zeros(len(LIGHT_BEARING)),
        mount=RIM,
        height=0.025,
        farthest=0.25,
        rate_hz=10.0,
        sigma=0.005,
    ),
    "ultrasonic": Sensor(
        bearing=np.array(SOUND_BEARING),
        elevation=np.zeros(len(SOUND_BEARING)),
        mount=RIM,
        height=0.025,
        nearest=0.25,
        farthest=2.0,
        rate_hz=10.0,
        sigma=0.005,
        dropout=0.01,  # lost echoes
        resolution=0.01,  # its protocols use centimetres
    ),
    # TurtleBot3: ±15 mm below 0.5 m, ±5 % beyond; the dropout is a choice
    "lds01": Sensor(
        bearing=np.radians(np.arange(360.0)),
        elevation=np.zeros(360),
        height=0.182,  # mounted on top: lower robots are below its plane
        nearest=0.12,
        farthest=3.5,
        rate_hz=5.0,
        sigma=0.0075,
        relative=0.025,
        relative_from=0.5,
        dropout=0.005,
        resolution=0.001,
    ),
    # Crazyflie's Multi-ranger, in the order of its bridge: front, back, left, right, up. Rate, sigma and height (half
    # that of the robot) are choices; its beams are lines here, and cones in reality
    "multiranger": Sensor(
        bearing=np.radians([0.0, 180.0, 90.0, -90.0, 0.0]),
        elevation=np.radians([0.0, 0.0, 0.0, 0.0, 90.0]),
        height=0.0145,
        farthest=4.0,
        rate_hz=20.0,
        sigma=0.010,
        resolution=0.001,
    ),
}


class RangeSensors:
    """Range sensors of all robots of a world. Rays of a robot are in the order of its sensors."""

    scans: list[RangeScan | None]  # newest readings of each robot; None before the first, and without sensors

    def __init__(self, request: BodyRequest, world: World) -> None:
        """Raises BodyError for an unknown sensor."""
        carried = [tuple(dict.fromkeys(own)) for own in world.sensors]
        for robot, own in zip(request.names, carried, strict=True):
            for name in own:
                if name not in SENSORS:
                    raise BodyError(f"{robot}: there is no sensor {name}; there are {', '.join(SENSORS)}")
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
            {name: [nan] * len(SENSORS[name].bearing) for name in own} for own in carried
        ]
        self.scans = [None] * len(carried)
        self._due = [-inf] * len(self._mounted)
        self._next = -inf if self._mounted else inf
        self._beams: dict[tuple[int, ...], Beams] = {}

    def sweep(self, t: float, engine: Engine) -> bool:
        """Measure with the sensors that are due at `t` [s], at first with all; returns whether there are any.

        Missed measurements are not repeated.
        """
        if t < self._next:
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
        self._next = min(self._due)
        return True


def _directions(sensors: Sequence[str]) -> tuple[list[float], list[float]]:
    """Bearings and elevations of the rays of some sensors [rad]."""
    bearing = [each for name in sensors for each in SENSORS[name].bearing.tolist()]
    return bearing, [each for name in sensors for each in SENSORS[name].elevation.tolist()]


def _arrange_beams(mounted: Sequence[_Mounted]) -> Beams:
    """Arrange the rays of these sensors, sensor after sensor."""
    rows = [one.rows for one in mounted]
    which = np.repeat(np.arange(len(mounted)), [len(each) for each in rows])
    return Beams([one.sensor.fan for one in mounted], np.concatenate(rows), which)


class _Mounted:
    """One kind of sensor on the robots that have it."""

    def __init__(self, name: str, rows: Index, request: BodyRequest, scale: float) -> None:
        sensor = self.sensor = SENSORS[name]
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
