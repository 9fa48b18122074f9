"""Measures what docs/cameras.md says of a formation by cameras, on simulated time, whatever the load of the machine:

.venv/bin/python -m docs.cameras_flight

The whole laboratory flies `robotic-park` in one process (tests/simulated). All positions come from outside: from a
Vicon system, or from images that are rendered at the true poses of each exposure, and searched by the bridge's code.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from agents.body.capture_reader import CaptureFrame, MeasuredPose
from agents.clock import Clock, uptime
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from bridges.motion_capture.cameras import file
from bridges.motion_capture.cameras.tracker import Tracker
from bridges.motion_capture.publisher import PoseFilter
from bridges.motion_capture.twin.capture import upright
from tests.bridges.motion_capture.cameras_lab import Room, text
from tests.simulated import bodies, flight, laboratory
from tests.simulated.world import current
from twins.arrays import Array

PERIOD_S = 1.0 / 30.0  # time between two images of a camera [s]
CAMERAS = "ABCD"
DELAY_S = 0.05  # time from an exposure to its frame: transfer, JPEG, search [s]
VICON = 0.01, 0.004, 0.0003  # period [s], latency [s], standard deviation of a position [m]
WHEELS = {"TB01": (1, 0.10, 0.20, True), **{f"KH0{k}": (k + 1, 0.10, 0.14, True) for k in (1, 2, 3)}}
SEEDS = (1, 2, 3)
# size of the images [px], and side of a drone's tag [m]
SYSTEMS = {"Vicon": None, "1280 x 720": ((1280, 720), 0.08), "larger tags": ((1280, 720), 0.10),
           "1920 x 1080": ((1920, 1080), 0.08)}  # fmt: skip

Found = tuple[float, CaptureFrame]


def true_poses(names: Sequence[str]) -> dict[str, tuple[Array, Array]]:
    """Position [m] and rotation of each robot now."""
    motions = {name: current().motion(name) for name in names}
    return {name: (np.array(each.position), upright(each.yaw)) for name, each in motions.items() if each is not None}


def publish(names: Sequence[str], realm: str, see: Callable[[Sequence[str]], Found | None], delay_s: float) -> int:
    """Process of a bridge: it passes on what `see` finds, `delay_s` later, by the filter of the bridge."""
    session, clock, keys = network.open_session([DEFAULT_ENDPOINT], name="capture"), Clock(), Keys(realm)
    ends = {name: pubsub.NumberedPublisher(session, keys.position(name), messages.JSON) for name in names}
    kept = PoseFilter({name: name for name in names}, print)
    waiting = deque[Found]()
    while not current().conductor.dead:
        if (found := see(names)) is not None:
            waiting.append((found[0] + delay_s, found[1]))
        while waiting and waiting[0][0] <= uptime():
            _, frame = waiting.popleft()
            for name, measured, position, yaw in kept.filter_poses(frame, uptime()):
                stamp = clock.utc() + measured - uptime()
                ends[name].put(messages.encode(messages.Position(name, stamp, position, messages.heading(yaw))))
    return 0


def vicon(names: Sequence[str], realm: str) -> int:
    """Process of a Vicon system."""
    period, latency, sigma = VICON
    rng, count = np.random.default_rng(5), iter(range(1 << 30))

    def see(names: Sequence[str]) -> Found:
        time.sleep(period)
        poses = {
            name: MeasuredPose(tuple((at + rng.normal(0.0, sigma, 3)).tolist()), tuple(turn.ravel().tolist()))
            for name, (at, turn) in true_poses(names).items()
        }
        return uptime(), CaptureFrame(next(count), poses, latency, "z")

    return publish(names, realm, see, latency)


def cameras(names: Sequence[str], realm: str, system: str, seen: dict[str, list[float]]) -> int:
    """Process of the cameras' bridge; they expose one after the other."""
    chosen = SYSTEMS[system]
    assert chosen is not None
    size, side = chosen
    tags = {name: WHEELS.get(name, (10 + row, side, 0.04, False)) for row, name in enumerate(names)}
    lab = file.parse(text(tags, CAMERAS, 1.0 / PERIOD_S, size=size))
    room, tracker, count = Room(lab), Tracker(lab, print), iter(range(1 << 30))
    past: dict[str, deque[tuple[float, Array]]] = {name: deque(maxlen=40) for name in names}

    def see(names: Sequence[str]) -> Found | None:
        time.sleep(PERIOD_S / len(CAMERAS))
        number, true = next(count), true_poses(names)
        for name, (at, _) in true.items():
            past[name].append((uptime(), at))
        camera = CAMERAS[number % len(CAMERAS)]
        found = tracker.see(camera, uptime(), room.image(camera, true))
        if found is None:
            return None
        for name, pose in found[1].items():
            if past[name]:
                at = min(past[name], key=lambda each: abs(each[0] - found[0]))[1]
                seen[name].append(np.nan if pose is None else float(np.linalg.norm(np.subtract(pose.position, at))))
        return uptime(), CaptureFrame(number, found[1], uptime() - found[0] + DELAY_S, "z")

    return publish(names, realm, see, DELAY_S)


def fly(system: str, seed: int) -> None:
    """Fly the formation once, and print its figures by case."""
    cv2.setNumThreads(1)
    seen: dict[str, list[float]] = {f"{kind}{k}": [] for kind in ("TB0", "KH0", "CF0") for k in (1, 2, 3)}
    flight.warm_up()
    bodies.capture = lambda names, realm: (
        cameras(names, realm, system, seen) if SYSTEMS[system] else vicon(names, realm)
    )
    settings = [f'robots.{name}.position="external"' for name in (*WHEELS, "CF01", "CF02", "CF03")]
    settings += [f"seed={seed}", "disturbance.all.position_sigma=0"]
    flown = flight.fly(laboratory.Request("robotic-park", seed=seed, case="event", settings=tuple(settings)))
    rows = [row for case in flown.metrics or () for row in case["robots"] if row["robot"] != "TB01"]
    if not rows:
        print(f"{system}, seed {seed}: exit code {flown.code}; {flown.output.splitlines()[-1]}", flush=True)
        return
    iae, rmse, left, rate = (np.mean([row[key] for row in rows]) for key in ("iae", "rmse", "residual", "f_hz"))
    figures = f"IAE {iae:.2f} m s, RMSE {rmse:.3f} m, last error {1e3 * left:.1f} mm, {rate:.2f} poses per second"
    print(f"{system}, seed {seed}: exit code {flown.code}, {figures}", flush=True)
    for what, names in (("on wheels", [*WHEELS]), ("flying", ["CF01", "CF02", "CF03"])):
        each = np.array([one for name in names for one in seen[name]])
        if len(each):
            share, away = np.isfinite(each).mean(), 1e3 * np.nanpercentile(each, 95)
            print(f"  {what}: seen {share:.1%} of {len(each)}, p95 {away:.1f} mm", flush=True)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or SYSTEMS:
        for number in SEEDS:
            if not (child := os.fork()):
                fly(chosen, number)
                flight.leave()
            os.waitpid(child, 0)
