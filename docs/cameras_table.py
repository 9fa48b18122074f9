"""Measures what docs/cameras.md says of errors and rates, by rendered images:

.venv/bin/python -m docs.cameras_table

Cameras of 1280 x 720 in the corners of a room of 3.4 m, six robots on circles, of which three fly and tilt.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import cos, sin

import cv2
import numpy as np

from bridges.motion_capture.cameras import file
from bridges.motion_capture.cameras.tracker import Tracker
from bridges.motion_capture.twin.cameras import jpeg
from bridges.motion_capture.twin.capture import upright
from tests.bridges.motion_capture.cameras_lab import Room, text
from twins.arrays import Array

SETS = 120  # sets of images
COLD = 20  # sets without anything known from earlier images
STEP_S = 0.033  # period of the sets of images [s]
TIMES = 3  # repetitions, of which the quickest counts: other programs share the machine
WHEELS = {f"KH0{k}": (k, 0.10, 0.06, True) for k in (1, 2, 3)}
DRONES = {f"CF0{k}": (k + 3, 0.08, 0.03, False) for k in (1, 2, 3)}
BODIES = {**WHEELS, **DRONES}


def true_pose(row: int, k: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Position (3,) [m] and rotation (3, 3) of a body in a set."""
    angle, radius, flies = 0.015 * k + 1.05 * row, 0.9 if row % 2 else 0.5, row > 2
    tilt = rng.normal(0.0, 0.05, 2) if flies else np.zeros(2)
    turn = cv2.Rodrigues(np.array([*tilt, 0.0]))[0] @ upright(angle)
    return np.array([radius * cos(angle), radius * sin(angle), 0.5 + 0.1 * (row - 3) if flies else 0.0]), turn


def measure(cameras: str) -> Iterator[str]:
    """Lines of the table for these cameras."""
    lab, rng = file.parse(text(BODIES, cameras, 1.0 / STEP_S)), np.random.default_rng(4)
    room = Room(lab)
    truth = [{name: true_pose(row, k, rng) for row, name in enumerate(BODIES)} for k in range(SETS)]
    sets = [[(name, jpeg(room.image(name, true))) for name in cameras] for true in truth]
    spent = np.full((3, SETS), np.inf)  # decoding, following, finding without memory [s]
    for _ in range(TIMES):
        followed = Tracker(lab, lambda _: None)
        errors: dict[str, list[tuple[float, float]]] = {name: [] for name in BODIES}
        for k, images in enumerate(sets):
            begun = time.process_time()
            grey = [
                (name, cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)) for name, image in images
            ]
            decoded = time.process_time()
            frames = [followed.see(name, STEP_S * k, image) for name, image in grey]
            seen = time.process_time()
            fresh = Tracker(lab, lambda _: None)
            cold = time.process_time()
            for name, image in grey if k < COLD else ():
                fresh.see(name, 0.0, image)
            ended = time.process_time() if k < COLD else np.inf
            spent[:, k] = np.minimum(spent[:, k], [decoded - begun, seen - decoded, ended - cold])
            if frames[-1] is None:
                continue
            for name, found in frames[-1][1].items():
                if found is not None:
                    (position, turn), at = truth[k][name], found.rotation
                    away = float(np.linalg.norm(np.subtract(found.position, position)))
                    sine = turn[0, 0] * at[3] - turn[1, 0] * at[0]
                    errors[name].append((1e3 * away, abs(float(np.degrees(np.arcsin(sine))))))
    decoding, following = spent[:2].mean(axis=1).tolist()
    finding = float(spent[2, :COLD].mean())
    rates = f"{1 / following:.0f} Hz followed, {1 / finding:.0f} Hz cold"
    yield f"{len(cameras)} cameras: {rates}; decoding takes {1e3 * decoding:.0f} ms of a set"
    for what, names in (("on wheels", WHEELS), ("flying", DRONES)):
        each = np.array([one for name in names for one in errors[name]]).reshape(-1, 2)
        share = len(each) / (len(names) * (SETS - 1))
        if not len(each):
            yield f"  {what}: never seen"
            continue
        (mean, p95), yaw = (each[:, 0].mean(), np.percentile(each[:, 0], 95)), np.percentile(each[:, 1], 95)
        yield f"  {what}: seen {share:.0%}; mean {mean:.1f} mm, p95 {p95:.1f} mm; yaw p95 {yaw:.1f} degrees"


if __name__ == "__main__":
    cv2.setNumThreads(1)
    for chosen in ("A", "AC", "AB", "ACBD"):
        print("\n".join(measure(chosen)), flush=True)
