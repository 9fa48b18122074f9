"""Figures of the twin beside a robot are the known ones: bias, lag, correlation."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from experiments.definition.experiment import Shadow
from experiments.metrics import measure
from experiments.metrics.shadow import agreement
from experiments.report import figures
from tests.experiments.traces import STEP, at_origin, trace

T = np.arange(0.0, 20.0 + STEP / 2, STEP)


def shadowed(way, twin, *, yaw=0.0, twin_yaw=None, restart=5.0):
    """A robot with a twin beside it, and one without; the paths (T, 3) of robot and twin."""
    what = at_origin({"A": "crazyflie", "B": "crazyflie"}, {"A - B": 1.0})
    robots = {**what.robots, "A": msgspec.structs.replace(what.robots["A"], shadow=Shadow(restart_s=restart))}
    place = np.stack([way, np.full_like(way, 1.0)], axis=1)
    known = trace(msgspec.structs.replace(what, robots=robots), place)
    return dataclasses.replace(
        known,
        yaw=np.full((len(T), 2), yaw),
        shadow_position=np.stack([twin, np.full_like(twin, np.nan)], axis=1),
        shadow_yaw=np.tile([yaw if twin_yaw is None else twin_yaw, np.nan], (len(T), 1)),
    )


def winding(t):
    return np.column_stack([np.sin(t), np.cos(0.7 * t), 0.5 + 0.1 * np.sin(0.3 * t)])


def test_a_constant_difference_is_bias_and_rmse():
    off = np.array([0.03, -0.04, 0.12])
    mine, none = agreement(shadowed(winding(T), winding(T) + off, yaw=math.pi / 2, twin_yaw=math.pi / 2 - 0.1))
    assert none is None
    assert mine.bias == pytest.approx((0.03, -0.04, 0.12))
    assert (mine.along, mine.across) == (pytest.approx(-0.04), pytest.approx(-0.03))
    assert (mine.rmse, mine.largest) == pytest.approx((0.13, 0.13))
    assert (mine.bias_yaw, mine.rmse_yaw) == (pytest.approx(-0.1), pytest.approx(0.1))
    assert mine.correlation == pytest.approx((1.0, 1.0, 1.0))
    assert mine.correlation_speed == pytest.approx(1.0)
    assert (mine.horizon_s, mine.known) == (5.0, 1.0)
    (mine, _) = agreement(shadowed(winding(T), winding(T), yaw=math.pi - 0.01, twin_yaw=-math.pi + 0.02))
    assert mine.bias_yaw == pytest.approx(0.03)  # the short way round


def test_a_lag_is_a_bias_along_the_way():
    heading, speed, lag = 0.6, 0.2, 0.15
    along = speed * np.array([math.cos(heading), math.sin(heading), 0.0])
    (mine, _) = agreement(shadowed(T[:, None] * along, (T - lag)[:, None] * along, yaw=heading))
    assert (mine.along, mine.across) == (pytest.approx(-speed * lag), pytest.approx(0.0, abs=1e-12))
    assert mine.rmse == pytest.approx(speed * lag)
    assert mine.correlation[:2] == pytest.approx((1.0, 1.0))
    assert mine.correlation[2] is None  # neither climbs
    assert mine.correlation_speed is None  # nor is either ever faster


def test_lag_behind_a_swing_shows_in_correlation():
    frequency, lag = math.pi, 0.1  # whole periods
    swing, late = (np.outer(0.2 * np.sin(frequency * at), [1.0, 0.0, 0.0]) for at in (T, T - lag))
    (mine, _) = agreement(shadowed(swing, late, restart=None))
    assert mine.correlation[0] == pytest.approx(math.cos(frequency * lag), abs=1e-3)
    assert mine.rmse == pytest.approx(0.2 * math.sqrt(2.0) * math.sin(0.5 * frequency * lag), rel=1e-3)
    assert mine.bias == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)
    assert mine.horizon_s is None


def test_reset_twin_has_its_horizons_error_and_speed():
    speed, forward = 0.1 + 0.05 * np.sin(T), [1.0, 0.0, 0.0]
    line = np.outer(np.concatenate([[0.0], np.cumsum(speed[:-1]) * STEP]), forward)
    ahead = np.outer(0.01 * np.mod(T + 1e-9, 5.0), forward)  # 1 cm/s too fast
    (mine, _) = agreement(shadowed(line, line + ahead))
    assert mine.along == pytest.approx(0.025, rel=6e-3)
    assert mine.rmse == pytest.approx(0.05 / math.sqrt(3.0), rel=6e-3)
    assert mine.largest == pytest.approx(0.05, rel=1e-2)
    assert mine.correlation_speed == pytest.approx(1.0)  # the jumps back are no speed of the twin's


def test_what_is_unknown_is_left_out():
    twin, way = winding(T) + np.array([0.01, 0.0, 0.0]), winding(T)
    twin[T < 5.0], way[T > 15.0] = np.nan, np.nan
    (mine, _) = agreement(shadowed(way, twin))
    assert mine.bias == pytest.approx((0.01, 0.0, 0.0))
    assert mine.known == pytest.approx(0.5, abs=2e-3)
    assert mine.correlation_speed == pytest.approx(1.0)
    assert agreement(shadowed(way, np.full_like(way, np.nan))) == [None, None]
    plain = trace(at_origin({"A": "crazyflie"}, {}), winding(T)[:, None])
    assert agreement(plain) == [None]
    assert measure.measure(plain).robots[0].shadow is None
    assert "shadows" not in figures.all_figures([], [plain])


def test_figure_has_a_row_for_each_shadowed_robot():
    known = shadowed(winding(T), winding(T) + np.array([0.02, 0.0, 0.0]))
    figure = figures.all_figures([], [known, dataclasses.replace(known, case="other")])["shadows"]
    assert len(figure.axes) == 4
    above, beside = figure.axes[:2]
    np.testing.assert_allclose(above.lines[1].get_xdata() - above.lines[0].get_xdata(), 0.02)
    assert [line.get_ydata().mean().round(9) for line in beside.lines] == [2.0, 0.0, 0.0]  # cm along, left, up
