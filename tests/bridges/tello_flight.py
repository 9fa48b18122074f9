"""Scenarios with the real djitellopy, one per process: its ports and threads last as long as the process.

`python -m tests.bridges.tello_flight NAME` prints what was measured as one line of JSON.
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
from agents.decision.position_control import PositionController
from agents.vectors import NO_SETPOINT
from bridges.tello import body as bridge
from bridges.tello.body import TelloBody
from tests.bridges.columns import Columns
from tests.twins.loopback import Served, reached, request
from tests.waiting import PATIENCE_S
from twins.devices.tello import TelloDevice

TICK = 0.01


class Flight:
    """Drives a body as the runtime does: positions from outside, read, command."""

    def __init__(self, body, twins, rows):
        self.body, self.twins = body, twins  # (device, row of the device) per row of the body
        self.law = PositionController(rows.kinds[0])
        self.located = [True] * len(rows.names)
        self.goal = [None] * len(rows.names)  # x, y, z [m] of each drone; None: it is left alone
        self.toward = [0.0] * len(rows.names)
        self.tick = 0
        self.zero = time.monotonic()
        self.slowest = 0.0
        self.state = None
        self.pause = threading.Event()

    def once(self):
        self.tick = max(self.tick + 1, int((time.monotonic() - self.zero) / TICK))
        self.pause.wait(max(0.0, self.zero + self.tick * TICK - time.monotonic()))
        t = self.tick * TICK
        for row, (served, at) in enumerate(self.twins):
            if served is not None and self.located[row]:
                position, yaw = served.truth()
                self.body.locate(row, t, tuple(position[at].tolist()), float(yaw[at]))
        begin = time.monotonic()
        states = self.body.read(t)
        self.state = Columns(states)
        self.body.command(
            [
                NO_SETPOINT if goal is None else self.law.setpoint(goal, yaw, state.position, state.yaw)
                for goal, yaw, state in zip(self.goal, self.toward, states, strict=True)
            ]
        )
        self.slowest = max(self.slowest, time.monotonic() - begin)
        return t

    def until(self, true, patience):
        """Flies on until something is true; how long that took, or None."""
        begin = self.once()
        while not true():
            if self.once() - begin > patience:
                return None
        return self.tick * TICK - begin

    def truth(self):
        return np.array([served.truth()[0][at] for served, at in self.twins if served is not None])


def formation():
    """Two drones take off to different heights, fly to two places with another yaw, hold, and land."""
    rows = request("tello", ["tello-twin"] * 2, external=True, yaw=0.5)
    with Served(TelloDevice, rows) as served:
        body = TelloBody(reached(rows, served.addresses))
        body.open()
        flight = Flight(body, [(served, 0), (served, 1)], rows)
        everybody = range(2)
        before = flight.until(lambda: False, 0.3)
        body.takeoff(everybody, [0.6, 1.1])
        up = flight.until(lambda: np.allclose(flight.truth()[:, 2], [0.6, 1.1], atol=0.03), 10.0)
        flight.goal = [(0.8, -0.3, 0.7), (-0.4, 1.5, 1.0)]
        flight.toward = [1.2, -0.4]
        there = flight.until(lambda: np.abs(flight.truth() - flight.goal).max() < 0.03, 10.0)
        turned = flight.until(lambda: np.abs(served.truth()[1] - flight.toward).max() < 0.05, 6.0)
        place, yaw = served.truth()
        state = flight.state
        flight.goal = [None] * 2
        body.land(everybody)
        down = flight.until(lambda: not flight.state.flying.any(), 8.0)
        notes = flight.state.note
        height = flight.truth()[:, 2].max()
        body.stop(everybody)
        body.close()
    return {
        "before": before, "up": up, "there": there, "turned": turned, "down": down, "height": height,
        "error": np.abs(state.position - place).max(), "velocity": np.abs(state.velocity).max(),
        "yaw": (yaw - state.yaw).tolist(), "battery": state.battery.tolist(), "notes": notes,
        "slowest": flight.slowest,
    }  # fmt: skip


def faults():
    """Six drones: a good one, one that falls silent, is killed, drains, is empty, is absent; the good one flies on."""
    one = request("tello", ["tello-twin"], external=True)
    good = Served(TelloDevice, one)
    silent = Served(TelloDevice, one, silent_from_s=4.0)
    killed = Served(TelloDevice, one)
    weak = Served(TelloDevice, one, battery=0.15, drain=12.0)
    empty = Served(TelloDevice, one, battery=0.08)
    twins = [good, silent, killed, weak, empty]
    addresses = [served.addresses[0] for served in twins] + ["tello://127.0.0.99:18889"]
    rows = request("tello", addresses, external=True)
    bridge.OPEN_S = 1.0  # so long it waits for the absent one; `refusals` waits as long as the bridge wants to
    body = TelloBody(rows)
    begin = time.monotonic()
    body.open()
    opened = time.monotonic() - begin
    flight = Flight(body, [(served, 0) for served in twins] + [(None, 0)], rows)
    flight.until(lambda: False, 0.3)
    said = {"absent": flight.state.note[5], "blind": bool(np.isnan(flight.state.position[5, 0]))}
    body.takeoff(range(6), [0.6] * 6)
    flight.once()
    said["empty"], said["absent takeoff"] = flight.state.note[4], flight.state.note[5]
    flying = flight.state.flying.tolist()
    flight.until(lambda: bool((flight.truth()[:4, 2] > 0.5).all()), PATIENCE_S)
    flight.goal[0] = (0.5, 0.5, 0.6)
    killed.kill()
    aged = flight.until(lambda: flight.tick * TICK - flight.state.time[2] > 0.5, PATIENCE_S)
    said["killed"] = flight.state.note[2]
    said["silence"] = (flight.tick * TICK - flight.state.received)[[0, 2]].tolist()
    body.land([2])
    flight.until(lambda: flight.tick * TICK - flight.state.time[1] > 0.5, PATIENCE_S)
    said["silent"] = flight.state.note[1]
    body.land([1])
    flight.until(lambda: not flight.state.flying[3], PATIENCE_S)
    said["weak"] = flight.state.note[3]
    weak_height = float(weak.truth()[0][0, 2])
    there = flight.until(lambda: np.abs(flight.truth()[0] - flight.goal[0]).max() < 0.03, PATIENCE_S)
    flight.goal[0] = None
    body.stop([0])
    fell = flight.until(lambda: good.truth()[0][0, 2] <= 0.0, PATIENCE_S)
    body.close()
    for served in twins:
        served.kill()
    return {
        "opened": opened, "flying": flying, "aged": aged, "there": there,
        "weak_height": weak_height, "fell": fell, "said": said, "slowest": flight.slowest,
    }  # fmt: skip


def refusals():
    """What cannot be opened, and what refuses to take off."""
    said = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:  # another program that flies Tellos
        other.bind(("", 8889))
        try:
            TelloBody(request("tello", ["tello://127.0.0.77:18889"], external=True)).open()
        except BodyError as error:
            said["second"] = str(error)
    begin = time.monotonic()
    nobody = TelloBody(request("tello", ["tello://127.0.0.77:18889"], external=True))
    try:
        nobody.open()
    except BodyError as error:
        said["absent"] = str(error)
    seconds = time.monotonic() - begin
    rows = request("tello", ["tello-twin"], external=True)
    with Served(TelloDevice, rows) as served:
        body = TelloBody(reached(rows, served.addresses))
        body.open()
        flight = Flight(body, [(served, 0)], rows)
        flight.located[0] = False
        flight.once()
        body.takeoff([0], [0.6])
        flight.once()
        said["nowhere"], flying = flight.state.note[0], bool(flight.state.flying[0])
        flight.located[0] = True
        flight.once()
        body.takeoff([0], [0.6])
        flight.until(lambda: flight.truth()[0, 2] > 0.5, 5.0)
        flight.pause.wait(2.3)  # the process hangs: its drone lands
        sinks = flight.until(lambda: flight.truth()[0, 2] < 0.5, 6.0)
        said["hung"] = flight.state.note[0]
        body.stop([0])
        body.close()
    return {"said": said, "seconds": seconds, "flying": flying, "sinks": sinks}


def vendor():
    """The library's own calls, unmodified, with two drones."""
    sys.modules.setdefault("av", types.ModuleType("av"))
    library = importlib.import_module("djitellopy")
    Tello, TelloException = library.Tello, library.TelloException
    Tello.LOGGER.setLevel("CRITICAL")
    rows = request("tello", ["tello-twin"] * 2, external=True)
    with Served(TelloDevice, rows) as served:
        drones = []
        for address in served.addresses:
            host, port = address.removeprefix("tello://").split(":")
            drone = Tello(host=host, retry_count=1)
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
        except TelloException as error:
            told["refused"] = str(error)
        states, last, begin = 0, None, time.monotonic()
        while time.monotonic() - begin < 1.0:
            state = a.get_current_state()
            states, last = states + (state is not last), state
            threading.Event().wait(0.002)
        told["states"], told["keys"] = states, len(last)
        told["reported"] = [b.get_yaw(), b.get_height(), b.get_distance_tof()]
        a.emergency()
        b.emergency()
        threading.Event().wait(0.35)
        told["end"] = served.truth()[0][:, 2].tolist()
    return told


if __name__ == "__main__":
    print(json.dumps({each.__name__: each for each in (formation, faults, refusals, vendor)}[sys.argv[1]]()))
