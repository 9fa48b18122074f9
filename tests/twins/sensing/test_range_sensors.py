"""Range sensors: the makers' figures, their rates, and noise that belongs to its robot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.body.interface import BodyError
from agents.body.kinds import KINDS
from agents.vectors import ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.turtlebot3.kind import TURTLEBOT3
from tests.requests import request
from twins.body import TwinBody
from twins.engines.engine import EngineInput, World
from twins.engines.point_mass import PointMass
from twins.scene import Scene
from twins.sensing.range_sensors import RangeSensors, fan, sensors

SENSORS = sensors()


def placed(kinds, carried, *, size=(6.0, 6.0, 2.5), noise=0.0, mirrored=None):
    scene = Scene.furnished(size, {}, {}, walled=True)
    return World(scene, PointMass(), tuple(carried), noise, mirrored or (False,) * len(kinds))


def equipped(asked, world):
    """The sensors of robots, and an engine that carries them."""
    place = EngineInput(asked.kinds, asked.start, asked.yaw, 0.01, world.mirrored, world.scene)
    return RangeSensors(asked, world), PointMass().build(place)


def swept(asked, world, times=(0.0,)):
    """Readings (len(times), R) of robots that stand, and the last scans."""
    ranges, engine = equipped(asked, world)
    seen = []
    for t in times:
        ranges.sweep(t, engine)
        seen.append(np.concatenate([scan.distance for scan in ranges.scans if scan is not None]))
    return np.array(seen), ranges.scans


def facing(kind, sensor, gap, noise=0.0, times=(0.0,), *, robots=1):
    """Readings (len(times) * robots,) of the ray ahead of robots, each alone, whose sensor is `gap` from a wall."""
    rays = fan(SENSORS[sensor])
    ahead = (rays.bearing == 0.0) & (rays.elevation == 0.0)
    place, world = (3.0 - SENSORS[sensor].mount - gap, 0.0), placed([kind], [(sensor,)], noise=noise)
    seen = [swept(request([kind], start=[place], seeds=(seed,)), world, times)[0] for seed in range(robots)]
    return np.concatenate(seen)[:, ahead].ravel()


def test_sensors_make_sense():
    for name, sensor in SENSORS.items():
        assert 0.0 <= sensor.nearest < sensor.farthest, name
        assert fan(sensor).reach == sensor.mount + sensor.farthest, name
    carried = [each for kind in KINDS.values() for each in {*kind.sensors, *kind.decks}]
    assert len(carried) == len(SENSORS)  # each of its own name
    assert sorted(np.degrees(SENSORS["infrared"].bearing)) == pytest.approx([-135, -90, -45, 0, 45, 90, 135, 180])
    assert sorted(np.degrees(SENSORS["ultrasonic"].bearing)) == pytest.approx([-90, -45, 0, 45, 90])
    with pytest.raises(BodyError, match=r"R1: there is no sensor radar; there are multiranger, infrared, ultra"):
        RangeSensors(request([KHEPERA4] * 2), placed([KHEPERA4] * 2, [("infrared",), ("infrared", "radar")]))


def test_limits_count_from_sensor_readings_from_centre():
    for kind, sensor, gap, expected in (
        (KHEPERA4, "infrared", 0.2499, 0.3199),
        (KHEPERA4, "infrared", 0.2501, math.nan),
        (KHEPERA4, "infrared", -0.01, 0.07),  # run into the wall: the rim touches
        (KHEPERA4, "ultrasonic", 0.2499, math.nan),
        (KHEPERA4, "ultrasonic", 0.2501, 0.3201),
        (KHEPERA4, "ultrasonic", 2.0001, math.nan),
        (TURTLEBOT3, "lds01", 0.1199, math.nan),
        (TURTLEBOT3, "lds01", 3.4999, 3.4999),
        (TURTLEBOT3, "lds01", 3.5001, math.nan),
        (CRAZYFLIE, "multiranger", 3.9999, 3.9999),
    ):
        np.testing.assert_allclose(facing(kind, sensor, gap), [expected], atol=1e-12)


def test_rays_are_in_the_order_of_sensors():
    kinds = [KHEPERA4, CRAZYFLIE, TURTLEBOT3, KHEPERA4]
    carried = [("ultrasonic", "infrared", "ultrasonic"), (), ("lds01",), ("infrared",)]
    asked = request(kinds, start=[(0.0, 0.0), (0.2, 0.0), (1.0, 0.0), (-2.9, 0.0)])
    _, (first, none, lidar, last) = swept(asked, placed(kinds, carried))
    assert none is None
    light, sound = SENSORS["infrared"].bearing, SENSORS["ultrasonic"].bearing
    assert ([*first.bearing], [*last.bearing]) == ([*sound, *light], [*light])
    ahead = [distance for distance, bearing in zip(first.distance, first.bearing, strict=True) if bearing == 0.0]
    # the landed Crazyflie is too near for sound, and hides what is behind it; all TurtleBots' rays pass over both
    seen = [*ahead, last.distance[light.index(np.pi)], lidar.distance[180]]
    np.testing.assert_allclose(seen, [np.nan, 0.135, 0.1, np.nan], atol=1e-12)


def test_multiranger_looks_ahead_and_up():
    asked = request([CRAZYFLIE] * 2, start=[(1.0, 0.5, 1.0), (1.0, 0.52, 1.5)], yaw=[0.5 * math.pi, 0.0])
    seen, _ = swept(asked, placed([CRAZYFLIE] * 2, [("multiranger",)] * 2))
    np.testing.assert_allclose(seen[0, :5], [2.5, 3.5, 4.0, 2.0, 0.5 - 0.0145], atol=1e-12)
    np.testing.assert_allclose(seen[0, 5:], [2.0, 4.0, 2.48, 3.52, 1.0 - 0.0145], atol=1e-12)


@pytest.mark.parametrize("dt", [0.01, 0.015])
def test_sensors_measure_at_their_own_rates(dt):
    kinds = [TURTLEBOT3, KHEPERA4, CRAZYFLIE]
    asked = request(kinds, start=[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0, 1.0)])
    world = placed(kinds, [("lds01",), ("infrared",), ("multiranger",)], noise=1.0)
    ranges, engine = equipped(asked, world)
    assert ranges.scans == [None] * 3
    ranges.sweep(-2.0, engine)  # measurements missed since then are not made up for
    seen = []
    for k in range(1, round(20.0 / dt) + 1):
        ranges.sweep(k * dt, engine)
        seen.append([scan.time for scan in ranges.scans])
    for times, rate in zip(np.transpose(seen), (5.0, 10.0, 20.0), strict=True):
        steps = np.diff(np.unique(times))
        assert (times[0], len(steps)) == (dt, pytest.approx(20.0 * rate, abs=2))
        assert steps.max() < 1.0 / rate + dt + 1e-9
        assert dt != 0.01 or steps == pytest.approx(1.0 / rate)


def test_sensor_not_due_keeps_its_readings():
    kinds, carried = [TURTLEBOT3], [("lds01", "infrared")]
    world = placed(kinds, carried, size=(0.5, 0.5, 1.0), noise=1.0)
    (first, second), _ = swept(request(kinds), world, (0.0, 0.1))
    np.testing.assert_array_equal(second[:360], first[:360])  # 5 Hz
    assert (second[360:] != first[360:]).all()  # 10 Hz


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "sensor", "gap", "sigma", "scale"),
    [
        (KHEPERA4, "ultrasonic", 1.004, 0.005, 1.0),
        (TURTLEBOT3, "lds01", 0.4, 0.0075, 1.0),
        (TURTLEBOT3, "lds01", 2.0, 0.05, 0.5),
        (CRAZYFLIE, "multiranger", 3.0, 0.010, 0.5),
    ],
)
def test_noise_has_sigma_of_the_maker(kind, sensor, gap, sigma, scale):
    robots = 4 if sensor == "lds01" else 30  # each with 360 beams
    readings = facing(kind, sensor, gap, scale, np.arange(100) * 0.25, robots=robots)
    seen = readings[np.isfinite(readings)] - SENSORS[sensor].mount
    if step := SENSORS[sensor].resolution:
        np.testing.assert_allclose(seen / step, np.round(seen / step), atol=1e-9)
    assert seen.mean() == pytest.approx(gap, abs=0.5 * step + 4.0 * sigma / math.sqrt(len(seen)))
    assert seen.std() == pytest.approx(sigma * scale, rel=0.06, abs=0.5 * step)
    assert np.isnan(readings).mean() == pytest.approx(SENSORS[sensor].dropout * scale, abs=0.004)


def test_dropouts_scale_with_the_noise(monkeypatch):
    monkeypatch.setitem(SENSORS, "lds01", replace(SENSORS["lds01"], dropout=0.3))
    asked = request([TURTLEBOT3])
    for scale, expected in ((0.0, 0.0), (0.5, 0.15), (1.0, 0.3), (4.0, 1.0)):
        seen, _ = swept(asked, placed([TURTLEBOT3], [("lds01",)], size=(3.0, 3.0, 1.0), noise=scale), range(100))
        assert np.isnan(seen).mean() == pytest.approx(expected, abs=0.01)


def test_readings_do_not_depend_on_other_sensors():
    kinds = [KHEPERA4, TURTLEBOT3, KHEPERA4, CRAZYFLIE]
    carried = [("infrared", "ultrasonic"), ("lds01",), ("ultrasonic",), ("multiranger",)]
    start = [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.5), (0.0, -1.0, 0.5)]
    times = np.arange(0.0, 3.0, 0.05).tolist()
    asked, world = request(kinds, start=start), placed(kinds, carried, noise=1.0)
    together, _ = swept(asked, world, times)
    row_of_ray = np.repeat(range(4), [13, 360, 5, 5])
    for row in range(4):
        only = [own if other == row else () for other, own in enumerate(carried)]
        alone, _ = swept(asked, placed(kinds, only, noise=1.0), times)
        np.testing.assert_array_equal(together[:, row_of_ray == row], alone)
    other, _ = swept(replace(asked, seeds=(1, 9, 3, 4)), world, times)
    assert (other != together).mean(axis=0)[row_of_ray == 1].min() > 0.5


def test_mirrored_robots_are_seen_and_see():
    kinds = [KHEPERA4, KHEPERA4, KHEPERA4]
    asked = request(kinds, start=[(0.0, 0.0), (2.0, 2.0), (-2.0, 0.0)])
    world = placed(kinds, [("infrared",), ("infrared",), ()], mirrored=[False, True, False])
    ranges, engine = equipped(asked, world)
    ranges.sweep(0.0, engine)
    assert np.isnan([scan.distance for scan in ranges.scans[:2]]).all()  # it is not there yet
    engine.mirror([1], [(0.3, 0.0, 0.0)], [math.pi], [ZERO])
    engine.advance(0.01, [(0.0, 0.0)] * 3)
    ranges.sweep(0.1, engine)
    ahead = SENSORS["infrared"].bearing.index(0.0)
    for scan in ranges.scans[:2]:
        assert (np.isfinite(scan.distance).sum(), scan.distance[ahead]) == (1, pytest.approx(0.23, abs=1e-12))


def test_state_of_a_twin_has_its_scan():
    body = TwinBody(request([TURTLEBOT3]), placed([TURTLEBOT3], [("lds01",)]))
    none, scan, kept, later = (body.read(t)[0].scan for t in (0.0, 0.01, 0.2, 0.21))
    assert (none, scan.time, kept is scan, later.time) == (None, 0.01, True, 0.21)
    assert scan.distance[0] == pytest.approx(3.0, abs=1e-12)
