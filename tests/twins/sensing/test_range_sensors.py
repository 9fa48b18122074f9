"""Range sensors: the makers' figures, their rates, and noise that belongs to its robot."""

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from agents.body.interface import BodyError, BodyRequest, Disturbance
from agents.body.kinds import CRAZYFLIE, KHEPERA4, KINDS, TURTLEBOT3
from agents.network.keys import Keys
from twins.body import TwinBody
from twins.engines.engine import Stage
from twins.engines.point_mass import PointMass
from twins.scene import Obstacle, Scene, World
from twins.sensing import range_sensors
from twins.sensing.range_sensors import OF_KIND, SENSORS, RangeSensors


def asked(kinds, start, *, yaw=None, names=None, seeds=None):
    n = len(kinds)
    return BodyRequest(
        names or tuple(f"R{k}" for k in range(n)),
        tuple(kinds),
        ("twin",) * n,
        np.array(start, dtype=float),
        np.zeros(n) if yaw is None else np.array(yaw, dtype=float),
        100.0,
        seeds or tuple(range(n)),
        (Disturbance(),) * n,
        (False,) * n,
        ({},) * n,
        (),
        Keys("park"),
    )


def placed(kinds, carried, *, obstacles=None, size=(6.0, 6.0, 2.5), noise=0.0, copy=None, mirrored=None):
    n = len(kinds)
    scene = Scene.furnished(size, obstacles or {}, {}, walled=True)
    return World(
        np.zeros(n, dtype=int) if copy is None else np.array(copy),
        scene,
        "point-mass",
        tuple(carried),
        noise,
        np.zeros(n, dtype=bool) if mirrored is None else np.array(mirrored),
    )


def engine_of(request, world):
    return PointMass().build(
        Stage(request.kinds, request.start, request.yaw, 0.01, world.copy, world.mirrored, world.scene)
    )


def swept(request, world, times=(0.0,)):
    """Readings (len(times), R) of robots that stand, and the sensors."""
    ranges, engine = RangeSensors(request, world), engine_of(request, world)
    seen = []
    for t in times:
        ranges.sweep(t, engine)
        seen.append(ranges.rays.distance)
    return np.array(seen), ranges


def facing(kind, sensor, gap, noise=0.0, times=(0.0,), *, robots=1):
    """Readings (len(times) * robots,) of the rays ahead, of robots, each in a room of its own, whose sensor is `gap`
    from a wall."""
    ahead = (SENSORS[sensor].bearing == 0.0) & (SENSORS[sensor].elevation == 0.0)
    request = asked([kind] * robots, [[3.0 - SENSORS[sensor].mount - gap, 0.0, 0.0]] * robots)
    world = placed([kind] * robots, [(sensor,)] * robots, noise=noise, copy=range(robots))
    return swept(request, world, times)[0][:, np.tile(ahead, robots)].ravel()


def test_every_sensor_makes_sense_and_kinds_carry_known_ones():
    for name, sensor in SENSORS.items():
        assert sensor.bearing.shape == sensor.elevation.shape, name
        assert 0.0 <= sensor.nearest < sensor.farthest, name
        assert sensor.fan.reach == sensor.mount + sensor.farthest, name
        assert sensor.rate_hz > 0.0, name
    assert OF_KIND.keys() <= KINDS.keys()
    assert {name for own in OF_KIND.values() for name in own} <= SENSORS.keys()


def test_the_makers_figures():
    for name, count, nearest, farthest in (
        ("infrared", 8, 0.0, 0.25),
        ("ultrasonic", 5, 0.25, 2.0),
        ("lds01", 360, 0.12, 3.5),
        ("multiranger", 5, 0.0, 4.0),
    ):
        sensor = SENSORS[name]
        assert (len(sensor.bearing), sensor.nearest, sensor.farthest) == (count, nearest, farthest)
    assert sorted(np.degrees(SENSORS["infrared"].bearing)) == pytest.approx([-135, -90, -45, 0, 45, 90, 135, 180])
    assert sorted(np.degrees(SENSORS["ultrasonic"].bearing)) == pytest.approx([-90, -45, 0, 45, 90])
    assert SENSORS["lds01"].rate_hz == 5.0


@pytest.mark.parametrize(
    ("kind", "sensor", "gap", "expected"),
    [
        (KHEPERA4, "infrared", 0.1, 0.17),
        (KHEPERA4, "infrared", 0.2499, 0.3199),
        (KHEPERA4, "infrared", 0.2501, math.nan),
        (KHEPERA4, "infrared", -0.01, 0.07),  # run into the wall: the rim touches
        (KHEPERA4, "ultrasonic", 0.2499, math.nan),
        (KHEPERA4, "ultrasonic", 0.2501, 0.3201),
        (KHEPERA4, "ultrasonic", 1.9999, 2.0699),
        (KHEPERA4, "ultrasonic", 2.0001, math.nan),
        (TURTLEBOT3, "lds01", 0.1199, math.nan),
        (TURTLEBOT3, "lds01", 0.1201, 0.1201),
        (TURTLEBOT3, "lds01", 3.4999, 3.4999),
        (TURTLEBOT3, "lds01", 3.5001, math.nan),
        (CRAZYFLIE, "multiranger", 3.9999, 3.9999),
        (CRAZYFLIE, "multiranger", 4.0001, math.nan),
    ],
)
def test_limits_count_from_the_sensor_and_readings_from_the_centre(kind, sensor, gap, expected):
    np.testing.assert_allclose(facing(kind, sensor, gap), [expected], atol=1e-12)


def test_without_noise_readings_are_geometry():
    """A TurtleBot3 turned by 0.3 rad in a room of 6 m × 5 m with a pillar."""
    request = asked([TURTLEBOT3], [[0.4, -0.2, 0.0]], yaw=[0.3])
    pillar = {"pillar": Obstacle(radius=0.25, at=(1.4, -0.2))}
    seen, _ = swept(request, placed([TURTLEBOT3], [("lds01",)], obstacles=pillar, size=(6.0, 5.0, 2.5)))
    angle = np.radians(np.arange(360.0)) + 0.3
    c, s = np.cos(angle), np.sin(angle)
    walls = np.minimum((3.0 * np.sign(c) - 0.4) / c, (2.5 * np.sign(s) + 0.2) / s)
    with np.errstate(invalid="ignore"):
        pillars = np.where(c > 0.0, c - np.sqrt(0.25**2 - s**2), np.inf)  # it is 1 m ahead in x
    expected = np.fmin(walls, pillars)
    assert np.isfinite(pillars).sum() == 29
    np.testing.assert_allclose(seen[0], np.where(expected > 3.5, np.nan, expected), atol=1e-12)


def test_rays_of_a_row_stand_together_in_the_order_of_its_sensors():
    kinds = [KHEPERA4, CRAZYFLIE, TURTLEBOT3, KHEPERA4]
    carried = [("ultrasonic", "infrared", "ultrasonic"), (), ("lds01",), ("infrared",)]
    request = asked(kinds, [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [1.0, 0.0, 0.0], [-2.9, 0.0, 0.0]])
    seen, ranges = swept(request, placed(kinds, carried))
    rays = ranges.rays
    np.testing.assert_array_equal(rays.row, np.repeat([0, 2, 3], [13, 360, 8]))
    light, sound = SENSORS["infrared"].bearing, SENSORS["ultrasonic"].bearing
    np.testing.assert_array_equal(rays.bearing[:13], np.concatenate([sound, light]))
    np.testing.assert_array_equal(rays.bearing[-8:], light)
    assert not rays.elevation.any()
    scan = rays.scan_of(0)
    ahead = scan.bearing == 0.0
    # the landed Crazyflie is too near for sound, and hides what is behind it; all TurtleBots' rays pass over both
    np.testing.assert_allclose(scan.distance[ahead], [np.nan, 0.135], atol=1e-12)
    assert rays.scan_of(3).distance[light == np.pi] == pytest.approx(0.1, abs=1e-12)
    np.testing.assert_allclose(seen[0, 13 + 180], np.nan)
    assert rays.scan_of(1) is None


def test_a_multiranger_looks_ahead_and_up():
    request = asked([CRAZYFLIE, CRAZYFLIE], [[1.0, 0.5, 1.0], [1.0, 0.52, 1.5]], yaw=[0.5 * math.pi, 0.0])
    seen, _ = swept(request, placed([CRAZYFLIE] * 2, [("multiranger",)] * 2))
    np.testing.assert_allclose(seen[0, :5], [2.5, 3.5, 4.0, 2.0, 0.5 - 0.0145], atol=1e-12)
    np.testing.assert_allclose(seen[0, 5:], [2.0, 4.0, 2.48, 3.52, 1.0 - 0.0145], atol=1e-12)


def test_a_sensor_that_nobody_knows():
    request = asked([KHEPERA4, KHEPERA4], np.zeros((2, 3)), names=("KH01", "KH02"))
    with pytest.raises(BodyError, match=r"KH02: there is no sensor radar; there are infrared, ultrasonic, lds01"):
        RangeSensors(request, placed([KHEPERA4] * 2, [("infrared",), ("infrared", "radar")]))


@pytest.mark.parametrize("dt", [0.01, 0.015, 0.03])
def test_sensors_measure_at_their_own_rates(dt):
    kinds = [TURTLEBOT3, KHEPERA4, CRAZYFLIE]
    request = asked(kinds, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    world = placed(kinds, [("lds01",), ("infrared",), ("multiranger",)], noise=1.0)
    ranges, engine = RangeSensors(request, world), engine_of(request, world)
    assert ranges.rays is None
    times, last = {0: [], 1: [], 2: []}, {}
    for k in range(1, round(20.0 / dt) + 1):
        ranges.sweep(k * dt, engine)
        for row, seen in times.items():
            scan = ranges.rays.scan_of(row)
            if not seen or scan.time > seen[-1]:
                assert scan.time == k * dt
                seen.append(scan.time)
            else:
                np.testing.assert_array_equal(scan.distance, last[row])
            last[row] = scan.distance
    for row, rate in ((0, 5.0), (1, 10.0), (2, 20.0)):
        assert times[row][0] == dt
        assert len(times[row]) == pytest.approx(20.0 * rate, abs=1)
        assert np.diff(times[row]).max() < 1.0 / rate + dt + 1e-9
        if dt == 0.01:
            np.testing.assert_allclose(np.diff(times[row]), 1.0 / rate, atol=1e-9)


def test_a_sensor_faster_than_the_clock_measures_at_every_tick_and_makes_up_for_nothing():
    request = asked([CRAZYFLIE], [[0.0, 0.0, 1.0]])
    world = placed([CRAZYFLIE], [("multiranger",)])
    ranges, engine = RangeSensors(request, world), engine_of(request, world)
    for t in (0.1, 0.2, 0.3):
        ranges.sweep(t, engine)
        np.testing.assert_array_equal(ranges.rays.time, t)
    measured = []
    for t in np.arange(5.0, 5.195, 0.01):
        ranges.sweep(t, engine)
        measured.append(ranges.rays.time[0])
    assert len(np.unique(measured)) == 4  # 20 Hz


def test_readings_that_were_handed_out_do_not_change():
    request = asked([KHEPERA4], np.zeros((1, 3)))
    world = placed([KHEPERA4], [("infrared", "ultrasonic")], size=(1.5, 1.5, 1.0), noise=1.0)
    ranges, engine = RangeSensors(request, world), engine_of(request, world)
    ranges.sweep(0.0, engine)
    first = ranges.rays
    time, distance = first.time.copy(), first.distance.copy()
    ranges.sweep(0.1, engine)
    np.testing.assert_array_equal(first.time, time)
    np.testing.assert_array_equal(first.distance, distance)
    assert (ranges.rays.time == 0.1).all()


@pytest.mark.parametrize(
    ("kind", "sensor", "gap", "sigma"),
    [
        (KHEPERA4, "infrared", 0.15, 0.005),
        (KHEPERA4, "ultrasonic", 1.004, 0.005),
        (TURTLEBOT3, "lds01", 0.4, 0.0075),
        (TURTLEBOT3, "lds01", 2.0, 0.05),
        (CRAZYFLIE, "multiranger", 3.0, 0.010),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_noise_has_the_makers_sigma(kind, sensor, gap, sigma, scale):
    readings = facing(kind, sensor, gap, scale, np.arange(100) * 0.25, robots=30)
    seen = readings[np.isfinite(readings)] - SENSORS[sensor].mount
    step = SENSORS[sensor].resolution
    expected = np.array([NormalDist(gap, sigma * scale).inv_cdf((k + 0.5) / 4000) for k in range(4000)])
    if step:
        expected = step * np.round(expected / step)
        np.testing.assert_allclose(seen / step, np.round(seen / step), atol=1e-9)
    assert seen.mean() == pytest.approx(expected.mean(), abs=4.0 * sigma / math.sqrt(len(seen)))
    assert seen.std() == pytest.approx(expected.std(), rel=0.06)
    lost = np.isnan(readings).mean()
    assert lost == pytest.approx(SENSORS[sensor].dropout * scale, abs=0.004)


def test_95_percent_of_a_lidar_s_readings_are_within_the_maker_s_limits():
    for gap, limit in ((0.3, 0.015), (3.0, 0.15)):
        readings = facing(TURTLEBOT3, "lds01", gap, 1.0, np.arange(100) * 0.2, robots=20)
        within = np.abs(readings[np.isfinite(readings)] - gap) <= limit
        assert within.mean() == pytest.approx(0.9545, abs=0.015)


def test_dropouts_scale_with_the_noise_and_end_with_it(monkeypatch):
    monkeypatch.setitem(SENSORS, "lds01", replace(SENSORS["lds01"], dropout=0.3))
    request = asked([TURTLEBOT3], np.zeros((1, 3)))
    for scale, expected in ((0.0, 0.0), (0.5, 0.15), (1.0, 0.3), (4.0, 1.0)):
        seen, _ = swept(request, placed([TURTLEBOT3], [("lds01",)], size=(3.0, 3.0, 1.0), noise=scale), range(100))
        assert np.isnan(seen).mean() == pytest.approx(expected, abs=0.01)


def test_a_robot_s_readings_do_not_depend_on_who_shares_its_process():
    kinds = [KHEPERA4, TURTLEBOT3, KHEPERA4, CRAZYFLIE]
    carried = [("infrared", "ultrasonic"), ("lds01",), ("ultrasonic",), ("multiranger",)]
    start = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.5, 0.0], [0.0, -1.0, 0.5]]
    times = np.arange(0.0, 3.0, 0.05)
    request = asked(kinds, start)
    together, ranges = swept(request, placed(kinds, carried, copy=[0, 1, 2, 3], noise=1.0), times)
    for row in range(4):
        one = request.select(np.array([row]))
        alone, _ = swept(one, placed([kinds[row]], [carried[row]], noise=1.0), times)
        np.testing.assert_array_equal(together[:, ranges.rays.row == row], alone)
    reseeded = replace(request, seeds=(0, 9, 2, 3))
    other, _ = swept(reseeded, placed(kinds, carried, copy=[0, 1, 2, 3], noise=1.0), times)
    lidar = ranges.rays.row == 1
    np.testing.assert_array_equal(other[:, ~lidar], together[:, ~lidar])
    assert (other[:, lidar] != together[:, lidar]).mean() > 0.9


def test_mirrored_rows_are_seen_where_they_are_and_see_from_there():
    kinds = [KHEPERA4, KHEPERA4, KHEPERA4]
    request = asked(kinds, [[0.0, 0.0, 0.0], [2.0, 2.0, 0.0], [-2.0, 0.0, 0.0]])
    world = placed(kinds, [("infrared",), ("infrared",), ()], mirrored=[False, True, False])
    ranges, engine = RangeSensors(request, world), engine_of(request, world)
    ranges.sweep(0.0, engine)
    assert np.isnan(ranges.rays.distance).all()  # it is not there yet
    engine.mirror(np.array([1]), np.array([[0.3, 0.0, 0.0]]), np.array([math.pi]), np.zeros((1, 3)))
    engine.advance(0.01, np.zeros((3, 2)))
    ranges.sweep(0.1, engine)
    for row in (0, 1):
        scan = ranges.rays.scan_of(row)
        np.testing.assert_allclose(scan.distance[scan.bearing == 0.0], 0.23, atol=1e-12)
        assert np.isfinite(scan.distance).sum() == 1


def test_a_twin_s_state_carries_its_rays():
    request = asked([TURTLEBOT3], np.zeros((1, 3)))
    body = TwinBody(request, placed([TURTLEBOT3], [("lds01",)]))
    assert body.read(0.0).rays is None
    state = body.read(0.01)
    assert state.rays.distance[0] == pytest.approx(3.0, abs=1e-12)
    assert (state.rays.time == 0.01).all()
    assert body.read(0.2).rays is state.rays
    assert (body.read(0.21).rays.time == 0.21).all()


def test_a_sensor_of_one_s_own(monkeypatch):
    """As a user adds one: an entry of the table, here a height sensor that looks down."""
    floor = range_sensors.Sensor(
        bearing=np.zeros(1), elevation=np.array([-0.5 * np.pi]), height=0.0, farthest=2.0, rate_hz=25.0, sigma=0.0
    )
    monkeypatch.setitem(SENSORS, "floor", floor)
    request = asked([CRAZYFLIE, CRAZYFLIE], [[0.0, 0.0, 0.8], [1.0, 0.0, 0.8]])
    table = {"table": Obstacle(box=(0.5, 0.5), at=(1.0, 0.0), height=0.3)}
    seen, _ = swept(request, placed([CRAZYFLIE] * 2, [("floor",)] * 2, obstacles=table, noise=1.0))
    np.testing.assert_allclose(seen, [[0.8, 0.5]], atol=1e-12)
