"""Copies of a scene in the planar engine are what each is alone, and the same every time, to the bit."""

from dataclasses import replace

import numpy as np

from agents.body.kinds import CRAZYFLIE, KHEPERA4, TURTLEBOT3
from tests.twins.planar_drive import DT, columns, command, furnished, stage
from twins.engines.pymunk_engine import Planar


def crowd(seed, copies=1):
    rng = np.random.default_rng(seed)
    kinds = [KHEPERA4, TURTLEBOT3, CRAZYFLIE, KHEPERA4, KHEPERA4]
    grid = np.array([[-0.5, -0.5], [0.5, -0.5], [0.0, 0.0], [-0.5, 0.5], [0.5, 0.5]])
    return kinds * copies, np.tile(grid, (copies, 1)), rng


def busy(engine, rows, seeds, ticks=400):
    """Everyone to the middle by noisy commands of each copy's own."""
    streams = [np.random.default_rng(seed) for seed in seeds]
    engine.takeoff(range(2, rows, 5), [0.05] * len(seeds))
    found = []
    for k in range(ticks):
        if k % 10 == 0:
            noise = np.concatenate([stream.normal(size=5) for stream in streams])
            x, y, _ = columns(engine, "position").T
            setpoints = np.zeros((rows, 4))
            setpoints[:, 0], setpoints[:, 1] = 0.2, 2.0 * np.sin(np.arctan2(-y, -x) - columns(engine, "yaw")) + noise
            setpoints[2::5] = [0.0, 0.0, 0.05, 0.0]
            command(engine, setpoints)
        engine.advance(k * DT, [(0.0, 0.0)] * rows)
        found += engine.touches()
    return found


def test_copies_are_the_same_alone():
    scene = furnished({"box": {"box": (0.2, 0.2), "at": (0.0, 0.35), "mass": 0.2}}, size=(2.0, 2.0, 2.0), walled=True)
    alone, touched = [], []
    for seed in (1, 2, 3):
        kinds, start, _ = crowd(seed)
        engine = Planar().build(stage(kinds, start, scene=scene))
        touched.append(busy(engine, 5, [seed]))
        alone.append((columns(engine, "position"), columns(engine, "yaw"), engine.obstacles[0]))
        assert touched[-1]
    kinds, start, _ = crowd(0, 3)
    together = Planar().build(stage(kinds, start, copy=np.repeat(np.arange(3), 5).tolist(), scene=scene))
    found = busy(together, 15, [1, 2, 3])
    for k, (position, yaw, obstacles) in enumerate(alone):
        rows = slice(5 * k, 5 * k + 5)
        np.testing.assert_array_equal(columns(together, "position")[rows], position)
        np.testing.assert_array_equal(columns(together, "yaw")[rows], yaw)
        assert together.obstacles[k] == obstacles
        mine = [t for t in found if 5 * k <= t.first < 5 * k + 5]
        expected = [replace(t, first=t.first + 5 * k, second=t.second + 5 * k * (t.second >= 0)) for t in touched[k]]
        assert mine == expected
    assert np.abs(alone[0][0] - alone[1][0]).max() > 1e-3


def test_runs_are_reproducible_to_the_bit():
    ends = []
    for _ in range(2):
        kinds, start, _ = crowd(4)
        engine = Planar().build(stage(kinds, start))
        found = busy(engine, 5, [4])
        ends.append((columns(engine, "position").tobytes(), columns(engine, "yaw").tobytes(), found))
    assert ends[0] == ends[1]
