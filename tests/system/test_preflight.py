"""`./zenpark preflight`: robots checked one by one, by the processes of a run."""

import json
import signal
import subprocess
import sys

import pytest

from tests.commands import GUARD, ROOT, environment
from tests.waiting import until

pytestmark = pytest.mark.system

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


def preflight(file, text, *words):
    file.write_text(text)
    command = [sys.executable, *GUARD, "preflight", str(file), "--json", "--out", str(file.parent / "out"), *words]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def checked(process, *codes):
    """Checks of each robot, by name."""
    out, err = process.communicate(timeout=140)
    assert process.returncode in codes, out + err
    said = json.loads(out)
    assert said["ok"] == (process.returncode == 0)
    return [{check["check"]: check for check in robot["checks"]} for robot in said["robots"]]


@pytest.mark.timeout(90)
def test_one_hops_and_stops_while_another_is_red(tmp_path):
    text = TWO.replace("BODY", "khepera4://127.0.0.1:9")
    drone, wheels = checked(preflight(tmp_path / "two.toml", text, "--hop", "--stop"), 1)
    names = ("ready", "stop, motors off", "hop", "stop, motors on")
    assert {name: drone[name]["verdict"] for name in names} == dict.fromkeys(names, "ok")
    assert "Connection refused" in wheels["address"]["found"]
    assert wheels["drive"]["verdict"] == "unknown"


@pytest.mark.mechanism("preflight: a hop that is interrupted")
@pytest.mark.timeout(90)
def test_ctrl_c_lands_the_robot_that_hops(tmp_path):
    process = preflight(tmp_path / "two.toml", TWO.replace("BODY", "twin"), "--hop")
    log = tmp_path / "out" / "logs" / "preflight-CF01.log"
    until(lambda: log.exists() and "airborne" in log.read_text(), "it is in the air", 60.0)
    process.send_signal(signal.SIGINT)
    hop = checked(process, 130)[0]["hop"]
    assert (hop["verdict"], hop["found"]) == ("unknown", "interrupted; it is down")
    assert log.read_text().rstrip().splitlines()[-1].startswith("CF01: done")


DRONES = """
title = "A Crazyflie by radio and a Tello, under motion capture"
duration_s = 30.0
start = { deadline_s = 40.0 }
safety = { position_timeout_s = 4.0, land_without_position_s = 4.0 }  # a busy machine holds up the radio
[robots]
CF01 = { kind = "crazyflie", start = [0.0, -0.6, 0.0], hover = 0.5 }
T01 = { kind = "tello", start = [0.0, 0.6, 0.0], hover = 0.8 }
"""


@pytest.mark.timeout(150)
def test_drones_hop_through_their_bridges_under_motion_capture(tmp_path):
    process = preflight(tmp_path / "drones.toml", DRONES, "--hop", "--bodies", "protocol")
    drone, tello = checked(process, 0)
    assert {drone[name]["verdict"] for name in ("address", "firmware", "battery", "position", "radio", "hop")} == {"ok"}
    assert " V under load" in drone["hop"]["found"]
    assert tello["hop"]["verdict"] == "ok"
    assert "of 0.8 m high" in tello["hop"]["found"]


TELLO = """
title = "a Tello whose sticks give less than it is told"
duration_s = 20.0
[robots.T1]
kind = "tello"
start = [0.0, 0.0, 0.0]
hover = 0.8
body = "tello-twin"
position = "external"
device = { twin_stick_speed = 0.6, stick_speed = SPEED }
"""


@pytest.mark.timeout(120)
@pytest.mark.parametrize(("believed", "verdict"), [(1.0, "bad"), (0.6, "ok")])
def test_sticks_of_a_tello_are_measured(tmp_path, believed, verdict):
    """Under simulated motion capture, at a fifth of its sticks, before any loop is closed."""
    text = TELLO.replace("SPEED", str(believed))
    (robot,) = checked(preflight(tmp_path / "tello.toml", text, "--sticks", "--bodies", "protocol"), 0, 1)
    sticks = robot["sticks"]
    assert sticks["verdict"] == verdict
    assert float(sticks["found"].split()[0]) == pytest.approx(0.6, rel=0.05)
    assert ("stick_speed = 0." in sticks["remedy"]) == (verdict == "bad")
