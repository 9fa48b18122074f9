"""Robots of another process, behind real bridges, in the world: twins see them, and keep clear of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE, KINDS, TURTLEBOT3
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from experiments.recording import playback
from tests.conftest import RouterProcess
from tests.system.lab import Flight, until

pytestmark = pytest.mark.system

WORLD = """
title = "{real} stands in the way of {twin}"
duration_s = 14.0
positioning = "vicon-twin"
[network]
realm = "{realm}"
[arena]
size = [4.0, 4.0, 2.0]
[world]
engine = "pymunk"
sensor_noise = 0.0
[avoidance]
kind = "barrier"
hears = "{hears}"
[[timeline]]
at_s = 3.0
robot = "{twin}"
plan = {{ kind = "waypoints", points = [[0.6, 0.0]], speed = 0.12 }}
"""
ON_THE_FLOOR = """
[robots.TB01]
kind = "turtlebot3"
body = "turtlebot3-twin"
position = "external"
start = [0.0, 0.0]
[robots.KH01]
kind = "khepera4"
body = "world"
start = [-0.35, 0.0]
"""
IN_THE_AIR = """
[robots.CF01]
kind = "crazyflie"
body = "crazyflie-twin"
start = [0.0, 0.0]
hover = 0.5
[robots.CF02]
kind = "crazyflie"
body = "world"
start = [-0.6, 0.0]
hover = 0.5
sensors = ["multiranger"]
"""
# a Khepera sees the TurtleBot; four thin rays miss much of a drone of 29 mm, which is why drones hear each other
RUNS = (
    ("floor", "neighbours", ON_THE_FLOOR, "KH01", "TB01", TURTLEBOT3),
    ("air", "all", IN_THE_AIR, "CF02", "CF01", CRAZYFLIE),
)


def ahead(scan: messages.Ranges) -> float:
    """What the rays along the nose say [m]; NaN: nothing."""
    along = np.abs(np.array(scan.bearing)) + np.abs(np.array(scan.elevation)) < 1e-6
    seen = [reading for reading, ray in zip(scan.distance, along, strict=True) if ray and reading is not None]
    return min(seen, default=math.nan)


@pytest.mark.mechanism("mixed reality")
@pytest.mark.timeout(120)
def test_real_robots_that_stand_in_the_way_of_twins_are_seen_and_avoided(tmp_path: Path, router: RouterProcess) -> None:
    flights = []
    for realm, hears, robots, twin, real, _ in RUNS:
        file = tmp_path / f"{realm}.toml"
        file.write_text(WORLD.format(realm=realm, hears=hears, twin=twin, real=real) + robots)
        connect = f'network.connect=["{router.endpoint}"]'
        flights.append(Flight(tmp_path / realm, str(file), "--json", "--no-report", "--set", connect))
    with network.open_session([router.endpoint], name="observer") as session:
        listening = [pubsub.subscriber(session, Keys(realm).ranges(twin), 4096) for realm, _, _, twin, *_ in RUNS]
        for flight in flights:
            flight.until_said(r"phase conductor: formation", 60.0)
        scans: list[list[messages.Ranges]] = [[], []]

        def ended() -> bool:
            for seen, subscriber in zip(scans, listening, strict=True):
                for sample in network.received(subscriber.handler):
                    seen.append(messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Ranges))
            return all(flight.process.poll() is not None for flight in flights)

        until(ended, "both runs are over", 60.0)
    for flight, seen, (realm, _, _, twin, real, kind) in zip(flights, scans, RUNS, strict=True):
        code, said = flight.finish()
        assert code == 0, said
        played = playback.read(tmp_path / realm / "default.mcap")
        trace = played.trace
        at = {name: row for row, name in enumerate(trace.robots)}
        truth, measured = trace.true_position[:, :, :2], trace.position[:, :, :2]
        still = (trace.time > 0.5) & (trace.time < 2.5)
        away = np.median(np.linalg.norm(measured[still, at[real]] - truth[still, at[twin]], axis=1))
        readings = [ahead(scan) for scan in seen if 0.5 < scan.stamp - played.started < 2.5]
        assert len(readings) >= 12
        assert np.nanmedian(readings) == pytest.approx(away - kind.radius, abs=0.001), twin
        apart = np.linalg.norm(truth[:, at[twin]] - truth[:, at[real]], axis=1)
        mine = KINDS[trace.experiment.robots[twin].kind].radius
        assert np.nanmin(apart) > mine + kind.radius + 0.01, twin
        assert trace.contacts == ()
        end = truth[trace.time > 13.5, at[twin]]
        assert np.linalg.norm(end - [0.6, 0.0], axis=1).max() < 0.08, twin  # it went around
        assert trace.avoided[at[twin]] > 0
