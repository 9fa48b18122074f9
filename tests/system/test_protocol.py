"""Robots behind real bridges and protocol twins: runs, and the checks before one."""

import json
import signal

import numpy as np
import pytest

from agents.body.kinds import KINDS
from agents.plugins import registry
from experiments.metrics.measure import measure
from experiments.real_time.hosts.launcher import LAND_S
from tests.commands import GUARD, started
from tests.system.lab import NEAR, Flight, assert_formed, gone, until
from tests.waiting import only_user_of

pytestmark = pytest.mark.system


@pytest.mark.parametrize(("bodies", "within_m"), [("protocol", 0.05), ("world", 0.03)])
def test_the_reference_experiment_flies_in_other_bodies(tmp_path, bodies, within_m):
    words = ("--bodies", bodies, "--case", "event", "--json", "duration_s=12", "timeline=[]")
    flight = Flight(tmp_path / "run", "robotic-park", *words, *NEAR)
    flight.until_flown()
    children = flight.children()
    assert ("world" in children) == (bodies == "world")
    if bodies == "protocol":
        assert children["CF01"] == children["CF02"] == children["CF03"], "one radio, one process"
        addressed = json.loads((flight.folder / "cases" / "event" / "addressed.json").read_text())["robots"]
        assert addressed["CF01"]["body"].startswith("radio://0/80/2M/E7E7E7E701?software=127.0.0.1:")
        assert addressed["KH01"]["body"].startswith("khepera4://127.0.0.1:")
        assert addressed["TB01"]["body"].startswith(("ros2dds://", "rmw://"))
    code, out = flight.finish(90.0)
    assert code == 0, flight.said()
    until(lambda: gone(list(children.values())), "nothing is left", LAND_S)
    for name, robot in json.loads(out)["cases"]["event"]["robots"].items():
        assert robot["lost"] == 0, name
        assert name == "TB01" or robot["acquired_s"] is not None, name
    trace = flight.read().trace
    assert np.isfinite(trace.true_position).all(axis=(1, 2)).mean() > 0.98, "the truth is known"
    heights = trace.true_position[trace.time > 5.0][:, 4:, 2]
    assert np.abs(heights - 0.8).max() < 0.1
    assert_formed(trace, within_m, since_s=trace.time[-1] - 1.0)


def test_twins_shadow_a_crazyflie_and_a_khepera(tmp_path):
    folder = tmp_path / "run"
    flight = Flight(
        folder, "triangle", "--case", "periodic", "--json", "duration_s=4",
        "robots.CF01.body=crazyflie-twin", "robots.CF01.shadow={restart_s=1.5}",
        "robots.KH01.body=khepera4-twin", "robots.KH01.shadow={}",
    )  # fmt: skip
    code, out = flight.finish()
    assert code == 0, flight.said()
    assert json.loads(out)["cases"]["periodic"]["collisions"] == 0
    trace = flight.read("periodic").trace
    known = np.isfinite(trace.shadow_position).all(axis=2).mean(axis=0)
    assert known == pytest.approx([1.0, 0.0, 1.0], abs=0.05)
    khepera, _, crazyflie = (robot.shadow for robot in measure(trace).robots)
    assert (khepera.horizon_s, crazyflie.horizon_s) == (5.0, 1.5)
    moved = np.ptp(trace.position[:, [0, 2], :2], axis=0)
    assert (moved.max(axis=1) > 0.1).all()
    assert khepera.rmse < 0.03  # measured: 6 mm
    assert crazyflie.rmse < 0.05
    assert -0.05 < crazyflie.bias[2] < -0.01  # the law of the shadow does not overshoot its take-off
    for shadow, far in ((khepera, moved[0]), (crazyflie, moved[1])):
        assert shadow.correlation[int(far.argmax())] > 0.98


TWO = """
title = "one that hops, one that is not there"
duration_s = 30.0
start = { deadline_s = 8.0 }
[robots]
CF01 = { kind = "crazyflie", start = [-0.3, 0.0], hover = 0.3 }
KH01 = { kind = "khepera4", start = [0.3, 0.0], body = "BODY" }
[formation.links]
"CF01 - KH01" = 0.8
"""


@pytest.fixture
def preflight(tmp_path):
    """A preflight of a file: starts, `meanwhile(process)` is called, and the checks of each robot are returned."""

    def check(text, *words, code=0, meanwhile=lambda _: None):
        (tmp_path / "x.toml").write_text(text)
        given = (*GUARD, "preflight", tmp_path / "x.toml", "--json", "--out", tmp_path / "out", *words)
        with started(*given) as process:
            meanwhile(process)
            out, err = process.communicate(timeout=140)
        assert process.returncode == code or code is None, out + err
        said = json.loads(out)
        assert said["ok"] == (process.returncode == 0)
        return [{each["check"]: each for each in robot["checks"]} for robot in said["robots"]]

    return check


def test_one_hops_and_stops_while_another_is_red(preflight):
    drone, wheels = preflight(TWO.replace("BODY", "khepera4://127.0.0.1:9"), "--hop", "--stop", code=1)
    names = ("ready", "stop, motors off", "hop", "stop, motors on")
    assert {name: drone[name]["verdict"] for name in names} == dict.fromkeys(names, "ok")
    assert "Connection refused" in wheels["address"]["found"]
    assert wheels["drive"]["verdict"] == "unknown"


@pytest.mark.mechanism("preflight: a hop that is interrupted")
def test_ctrl_c_lands_the_robot_that_hops(preflight, tmp_path):
    log = tmp_path / "out" / "logs" / "preflight-CF01.log"

    def interrupt(process):
        until(lambda: log.exists() and "airborne" in log.read_text(), "it is in the air", 60.0)
        process.send_signal(signal.SIGINT)

    hop = preflight(TWO.replace("BODY", "twin"), "--hop", code=130, meanwhile=interrupt)[0]["hop"]
    assert (hop["verdict"], hop["found"]) == ("unknown", "interrupted; its motors are off")
    assert log.read_text().rstrip().splitlines()[-1].startswith("CF01: done")


BUSY = """
title = "Robots behind their protocols"
duration_s = 30.0
start = { deadline_s = 40.0 }
safety = { position_timeout_s = 4.0, land_without_position_s = 4.0 }  # a busy machine holds up radio and network
[robots]
"""
DRONES = """
CF01 = { kind = "crazyflie", start = [0.0, -0.6, 0.0], hover = 0.5 }
T01 = { kind = "tello", start = [0.0, 0.6, 0.0], hover = 0.8 }
"""
DEVICES = sorted(name.removesuffix("-twin") for name in registry.names(registry.DEVICES))


@pytest.mark.parametrize("kind", DEVICES)
def test_every_device_moves_and_stops_as_ordered(kind, preflight):
    """Of yours too: a turn to the wrong side, or a stop that its firmware doesn't know, is found here.

    What it does without commands, and the place that it tells, `tests/bridges/test_devices.py` judges.
    """
    hover = ", hover = 0.8" if KINDS[kind].flies else ""
    text = f'R = {{ kind = "{kind}", start = [0.0, 0.0]{hover} }}'
    with only_user_of(kind):
        (robot,) = preflight(BUSY + text, "--hop", "--stop", "--bodies", "protocol", code=None)
    (moved,) = (robot[name] for name in ("hop", "drive") if name in robot)
    assert moved["verdict"] == "ok", "{found}; {remedy}".format(**moved)
    assert "after " in robot["stop, motors on"]["found"], robot  # later than is safe, on a busy machine


def test_drones_hop_through_their_bridges_under_motion_capture(preflight):
    with only_user_of("tello"):
        drone, tello = preflight(BUSY + DRONES, "--hop", "--bodies", "protocol")
    assert {drone[name]["verdict"] for name in ("address", "firmware", "battery", "position", "radio", "hop")} == {"ok"}
    assert " V under load" in drone["hop"]["found"]
    assert " ms late" in drone["hop"]["found"]
    assert tello["hop"]["verdict"] == "ok"
    assert "of 0.8 m high" in tello["hop"]["found"]
