"""Scenarios with the real djitellopy, one per process: its ports and threads last as long as the process.

`python -m tests.bridges.tello.scenarios NAME` prints what was measured as one line of JSON.
"""

import importlib
import json
import socket
import sys
import threading
import time
import types

import numpy as np

from agents.body.interface import BodyError
from agents.kinds.tello import TELLO
from bridges.tello.body import TelloBody
from tests.bridges.driver import Driver, toward
from tests.requests import request
from tests.twins.loopback import Served, reached
from twins.devices.tello import TelloDevice

ONE = request("tello", ["tello-twin"], external=True)
NOBODY = "tello://127.0.0.77:18889"


def piloted(rows, *twins, addresses=(), open_s=3.0):
    """A process that flies twins, which are seen from outside, and perhaps robots at further addresses."""
    places = [*(served.addresses[0] for served in twins), *addresses] if addresses else twins[0].addresses
    body = TelloBody(reached(rows, places), open_s)
    body.open()

    def truth():
        return [np.concatenate(seen) for seen in zip(*(served.truth() for served in twins), strict=True)]

    return Driver(body, truth=truth)


def formation():
    """Two drones take off to different heights, fly to two places with another yaw, hold, and land."""
    rows = request("tello", ["tello-twin"] * 2, external=True, yaw=0.5)
    with Served(TelloDevice, rows) as served:
        driver = piloted(rows, served)
        driver.run(0.3)
        driver.body.takeoff(range(2), [0.6, 1.1])
        driver.until(lambda: np.allclose(served.truth()[0][:, 2], [0.6, 1.1], atol=0.03))
        goals, yaws = [(0.8, -0.3, 0.7), (-0.4, 1.5, 1.0)], [1.2, -0.4]
        driver.decide = toward(TELLO, goals, yaws)
        driver.until(lambda: np.abs(served.truth()[0] - goals).max() < 0.03)
        driver.until(lambda: np.abs(served.truth()[1] - yaws).max() < 0.05)
        place, yaw = served.truth()
        state, driver.decide = driver.state, None
        driver.body.land(range(2))
        driver.until(lambda: not driver.state.flying.any())
        notes = driver.state.note
        height = served.truth()[0][:, 2].max()
        driver.body.stop(range(2))
        driver.body.close()
    return {
        "height": height, "error": np.abs(state.position - place).max(), "velocity": np.abs(state.velocity).max(),
        "yaw": (yaw - state.yaw).tolist(), "battery": state.battery.tolist(), "notes": notes,
    }  # fmt: skip


def faults():
    """Six drones: a good one, one that falls silent, is killed, drains, is empty, is absent; the good one flies on."""
    changes = ({}, {"silent_from_s": 4.0}, {}, {"battery": 0.15, "drain": 12.0}, {"battery": 0.08})
    twins = [Served(TelloDevice, ONE, **change) for change in changes]
    good, _, killed, weak, _ = twins
    begin = time.monotonic()
    rows = request("tello", ["-"] * 6, external=True)
    driver = piloted(rows, *twins, addresses=["tello://127.0.0.99:18889"], open_s=1.0)
    body, told = driver.body, {"opened": time.monotonic() - begin}
    driver.run(0.3)
    told |= {"absent": driver.state.note[5], "blind": bool(np.isnan(driver.state.position[5, 0]))}
    body.takeoff(range(6), [0.6] * 6)
    driver.tick()
    told |= {"empty": driver.state.note[4], "absent takeoff": driver.state.note[5]}
    told["flying"] = driver.state.flying.tolist()
    driver.until(lambda: bool((driver.truth()[0][:4, 2] > 0.5).all()))
    goal = (0.5, 0.5, 0.6)
    driver.decide = toward(TELLO, [goal, *[None] * 5], 0.0)
    killed.kill()
    driver.until(lambda: driver.t - driver.state.time[2] > 0.5)
    told |= {"killed": driver.state.note[2], "silence": (driver.t - driver.state.received)[[0, 2]].tolist()}
    body.land([2])
    driver.until(lambda: driver.t - driver.state.time[1] > 0.5)
    told["silent"] = driver.state.note[1]
    body.land([1])
    driver.until(lambda: not driver.state.flying[3])
    told |= {"weak": driver.state.note[3], "weak_height": float(weak.truth()[0][0, 2])}
    driver.until(lambda: np.abs(good.truth()[0][0] - goal).max() < 0.03)
    driver.decide = None
    body.stop([0])
    driver.until(lambda: good.truth()[0][0, 2] <= 0.0)
    body.close()
    for served in twins:
        served.kill()
    return told


def refused_open(address):
    """Why a body cannot be opened."""
    try:
        TelloBody(reached(ONE, [address])).open()
    except BodyError as error:
        return str(error)
    return ""


def refusals():
    """Devices that cannot be opened, and refused take-offs."""
    told = {}
    with socket.socket(type=socket.SOCK_DGRAM) as other:  # another program that flies Tellos
        other.bind(("", 8889))
        told["second"] = refused_open(NOBODY)
    begin = time.monotonic()
    told |= {"absent": refused_open(NOBODY), "seconds": time.monotonic() - begin}
    with Served(TelloDevice, ONE) as served:
        driver = piloted(ONE, served)
        truth, driver.truth = driver.truth, None
        driver.tick()
        driver.body.takeoff([0], [0.6])
        driver.tick()
        told |= {"nowhere": driver.state.note[0], "flying": bool(driver.state.flying[0])}
        driver.truth = truth
        driver.tick()
        driver.body.takeoff([0], [0.6])
        driver.until(lambda: served.truth()[0][0, 2] > 0.5)
        threading.Event().wait(2.3)  # the process hangs: its drone lands
        driver.until(lambda: served.truth()[0][0, 2] < 0.5)
        told["hung"] = driver.state.note[0]
        driver.body.stop([0])
        driver.body.close()
    return told


def vendor():
    """The library's own calls, unmodified, with two drones."""
    sys.modules.setdefault("av", types.ModuleType("av"))
    library = importlib.import_module("djitellopy")
    library.Tello.LOGGER.setLevel("CRITICAL")
    with Served(TelloDevice, request("tello", ["tello-twin"] * 2, external=True)) as served:
        drones = []
        for address in served.addresses:
            host, port = address.removeprefix("tello://").split(":")
            drone = library.Tello(host=host, retry_count=1)
            drone.address = (host, int(port))
            drone.connect()
            drones.append(drone)
        a, b = drones
        told = {"sdk": a.query_sdk_version(), "battery": a.query_battery(), "serial": b.query_serial_number()}
        told["grounded"] = a.send_command_with_return("forward 50")
        told["unknown"] = a.send_command_with_return("dance")
        workers = [threading.Thread(target=drone.takeoff) for drone in drones]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        told["height"] = served.truth()[0][:, 2].tolist()
        a.go_xyz_speed(50, 40, 0, 100)
        told["go"] = served.truth()[0][0].tolist()
        b.rotate_clockwise(90)
        told["yaw"] = float(served.truth()[1][1])
        try:
            a.move_up(10)
        except library.TelloException as error:
            told["refused"] = str(error)
        states, last, begin = 0, None, time.monotonic()
        while time.monotonic() - begin < 1.0:
            state = a.get_current_state()
            states, last = states + (state is not last), state
            threading.Event().wait(0.002)
        told |= {"states": states, "keys": len(last)}
        told["reported"] = [b.get_yaw(), b.get_height(), b.get_distance_tof()]
        a.emergency()
        b.emergency()
        threading.Event().wait(0.35)
        told["end"] = served.truth()[0][:, 2].tolist()
    return told


if __name__ == "__main__":
    print(json.dumps({each.__name__: each for each in (formation, faults, refusals, vendor)}[sys.argv[1]]()))
