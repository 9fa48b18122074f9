"""`./zenpark preflight`: robots checked one by one, by the processes of a run."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.system.lab import ENVIRONMENT, ROOT
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


def begin(folder: Path, *options: str, body: str) -> subprocess.Popen[str]:
    file = folder / "two.toml"
    file.write_text(TWO.replace("BODY", body))
    command = [sys.executable, "-m", "tools.guard", "preflight", str(file), "--json", "--out", str(folder / "out")]
    return subprocess.Popen(
        [*command, *options], cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.timeout(90)
def test_one_hops_and_stops_while_another_is_red(tmp_path: Path) -> None:
    process = begin(tmp_path, "--hop", "--stop", body="khepera4://127.0.0.1:9")
    out, err = process.communicate(timeout=80)
    assert process.returncode == 1, err
    said = json.loads(out)
    drone, wheels = ({check["check"]: check for check in robot["checks"]} for robot in said["robots"])
    assert {name: drone[name]["verdict"] for name in ("ready", "stop, motors off", "hop", "stop, motors on")} == (
        dict.fromkeys(("ready", "stop, motors off", "hop", "stop, motors on"), "ok")
    )
    assert "Connection refused" in wheels["address"]["found"]
    assert wheels["drive"]["verdict"] == "unknown"
    assert not said["ok"]


@pytest.mark.mechanism("preflight: a hop that is interrupted")
@pytest.mark.timeout(90)
def test_ctrl_c_lands_the_robot_that_hops(tmp_path: Path) -> None:
    process = begin(tmp_path, "--hop", body="twin")
    log = tmp_path / "out" / "logs" / "preflight-CF01.log"
    until(lambda: log.exists() and "airborne" in log.read_text(), "it is in the air", 60.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    hop = next(check for check in json.loads(out)["robots"][0]["checks"] if check["check"] == "hop")
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
def test_drones_hop_through_their_bridges_under_motion_capture(tmp_path: Path) -> None:
    (tmp_path / "drones.toml").write_text(DRONES)
    command = [sys.executable, "-m", "tools.guard", "preflight", str(tmp_path / "drones.toml"), "--json", "--hop"]
    done = subprocess.run(
        [*command, "--bodies", "protocol", "--out", str(tmp_path / "out")],
        cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=140,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    drone, tello = ({check["check"]: check for check in robot["checks"]} for robot in json.loads(done.stdout)["robots"])
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
def test_sticks_of_a_tello_are_measured(tmp_path: Path, believed: float, verdict: str) -> None:
    """Under simulated motion capture, at a fifth of its sticks, before any loop is closed."""
    file = tmp_path / "tello.toml"
    file.write_text(TELLO.replace("SPEED", str(believed)))
    command = [sys.executable, "-m", "tools.guard", "preflight", str(file), "--json", "--sticks"]
    done = subprocess.run(
        [*command, "--bodies", "protocol", "--out", str(tmp_path / "out")],
        cwd=ROOT,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    (robot,) = json.loads(done.stdout)["robots"]
    sticks = next(check for check in robot["checks"] if check["check"] == "sticks")
    assert sticks["verdict"] == verdict, done.stdout
    assert float(sticks["found"].split()[0]) == pytest.approx(0.6, rel=0.05)
    assert ("stick_speed = 0." in sticks["remedy"]) == (verdict == "bad")
