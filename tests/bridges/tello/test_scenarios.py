"""Scenarios with the real djitellopy and twins, one per process: its ports and threads last as long as the process.

`python -m tests.bridges.tello.test_scenarios NAME` runs one.
"""

import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from agents.body.interface import BodyError
from bridges.tello.body import TelloBody
from bridges.tello.kind import TELLO
from bridges.tello.twin import TelloDevice
from tests.bridges.driver import Driver, toward
from tests.conftest import ROOT
from tests.requests import request
from tests.twins.loopback import Served, reached
from tests.waiting import only_user_of

ONE = request("tello", ["tello-twin"], external=True, yaw=0.5)
NOBODY = "tello://127.0.0.77:18889"


@pytest.mark.system
@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param("faults", marks=pytest.mark.mechanism("Tello bridge: one of several fails")),
        "refusals",
    ],
)
def test_bridge_flies_twins_by_djitellopy(scenario):
    command = [sys.executable, "-m", "tests.bridges.tello.test_scenarios", scenario]
    with only_user_of("tello"):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def piloted(rows, *twins, addresses=(), open_s=3.0):
    """A process that flies twins, which are seen from outside, and perhaps robots at further addresses."""
    places = [*(served.addresses[0] for served in twins), *addresses] if addresses else twins[0].addresses
    body = TelloBody(reached(rows, places), open_s)
    body.open()

    def truth():
        return [np.concatenate(seen) for seen in zip(*(served.truth() for served in twins), strict=True)]

    return Driver(body, truth=truth)


def faults():
    """Six drones: a good one, one that falls silent, is killed, drains, is empty, is absent; the good one flies on."""
    changes = ({}, {"silent_from_s": 4.0}, {}, {"battery": 0.15, "drain": 12.0}, {"battery": 0.08})
    twins = [Served(TelloDevice, ONE, **change) for change in changes]
    good, _, killed, weak, _ = twins
    rows = request("tello", ["-"] * 6, external=True, yaw=0.5)
    driver = piloted(rows, *twins, addresses=["tello://127.0.0.99:18889"], open_s=1.0)
    body = driver.body
    driver.run(0.3)
    assert driver.state.note[5] == "no answer"
    assert np.isnan(driver.state.position[5, 0])
    body.takeoff(range(6), [0.6] * 6)
    driver.tick()
    assert driver.state.note[4:] == ("no take-off: battery at 8%", "no answer")
    assert driver.state.flying.tolist() == [True, True, True, True, False, False]
    driver.until(lambda: bool((driver.truth()[0][:4, 2] > 0.5).all()))
    goal = (0.5, 0.5, 0.6)
    driver.decide = toward(TELLO, [goal, *[None] * 5], 1.2)
    killed.kill()
    for row in (2, 1):
        driver.until(lambda row=row: driver.t - driver.state.time[row] > 0.5)
        assert driver.state.note[row].startswith("silent for")
        assert driver.t - driver.state.received[0] < 0.5 < driver.t - driver.state.received[row]
        body.land([row])
    driver.until(lambda: not driver.state.flying[3])
    assert driver.state.note[3] == "landing: battery at 9%"
    assert weak.truth()[0][0, 2] < 0.05
    driver.until(lambda: np.abs(good.truth()[0][0] - goal).max() < 0.03)
    driver.until(lambda: abs(good.truth()[1][0] - 1.2) < 0.05)
    assert np.abs(driver.state.position[0] - good.truth()[0][0]).max() < 0.02
    assert abs(driver.state.yaw[0] - good.truth()[1][0]) < 0.02
    assert 0.9 < driver.state.battery[0] <= 1.0
    driver.decide = None
    body.land([0])
    driver.until(lambda: not driver.state.flying[0])
    assert (driver.state.note[0], good.truth()[0][0, 2]) == ("", 0.0)
    body.close()
    for served in twins:
        served.kill()


def refused_open():
    """Why the body of an absent drone cannot be opened."""
    with pytest.raises(BodyError) as caught:
        TelloBody(reached(ONE, [NOBODY])).open()
    return str(caught.value)


def refusals():
    """Devices that cannot be opened, and a refused take-off."""
    with socket.socket(type=socket.SOCK_DGRAM) as other:  # another program that flies Tellos
        other.bind(("", 8889))
        assert refused_open().startswith("UDP port 8889 of this computer is taken")
    begin = time.monotonic()
    assert refused_open().startswith("R0 at 127.0.0.77:18889: no answer (switch it on, join its Wi-Fi")
    assert time.monotonic() - begin < 5.0
    with Served(TelloDevice, ONE) as served:
        driver = piloted(ONE, served)
        truth, driver.truth = driver.truth, None
        driver.tick()
        driver.body.takeoff([0], [0.6])
        driver.tick()
        assert driver.state.note[0].startswith("no take-off: no fresh external position")
        assert not driver.state.flying[0]
        driver.truth = truth
        driver.tick()
        driver.until(lambda: driver.state.note[0] == "")
        driver.body.takeoff([0], [0.6])
        driver.until(lambda: served.truth()[0][0, 2] > 0.5)
        threading.Event().wait(2.3)  # the process hangs: its drone lands
        driver.until(lambda: served.truth()[0][0, 2] < 0.5)
        assert driver.state.note[0] == "landing: its process did nothing for 2 s"
        driver.body.stop([0])
        driver.body.close()


if __name__ == "__main__":
    {each.__name__: each for each in (faults, refusals)}[sys.argv[1]]()
