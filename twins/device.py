"""Interface of protocol twins: simulated devices with a real wire protocol, for the unmodified vendor library.

A device moves its robots with the models of `twins.models` (there is no second model) and serves its protocol on
loopback sockets. `experiments.real_time.processes.protocol_twins` runs devices in a process.
"""

from __future__ import annotations

import select
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Final, Generic, Literal, TypeVar

import msgspec
import numpy as np

from agents.body.interface import BodyRequest
from agents.ticks import Ticks
from twins.arrays import Array
from twins.models.motion import Motion

# what motion capture tells wrongly: the same poses in new frames, the same frame again, two subjects exchanged, one
# under another name; all poses as they were before, the frame of an object turned, an object that stands still; one
# left out of the frames, frames with wrong bytes, every second frame before the one that it follows
CaptureFault = Literal[
    "", "frozen", "repeated", "swapped", "renamed", "late", "turned", "stuck", "missing", "damaged", "overtaking"
]
LATEST_S: Final = 2.0  # largest delay of motion capture


class Faults(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Injected faults; by default none. Devices ignore faults that they cannot have."""

    loss: float = 0.0  # share of packets lost, in each direction
    delay_s: float = 0.0  # [s] delay of each packet that the device sends
    silent_from_s: float | None = None  # [s] begin of silence on the device's clock: nothing sent, nothing received
    silent_for_s: float = 1e9  # [s] duration of the silence
    battery: float = 1.0  # charge at the start, 0 to 1
    drain: float = 1.0  # battery drain as a multiple of the maker's figure
    refuse_arming: bool = False
    accelerometer_mg: float = 0.0  # constant vertical error of a Crazyflie's accelerometer [mg]
    refuse_landing_s: float = 0.0  # [s] time for which a Tello answers `land` with "error", from the first one
    exchanges_hz: float = 500.0  # [1/s] exchanges of a software radio, 300 to 1000 by dongle and computer
    tumbled_from_s: float | None = None  # [s] begin of lying on its side, as after a collision
    tumbled_for_s: float = 1e9  # [s] time until it is put upright
    # [s] begin of an occlusion of all robots from motion capture, base stations and anchors
    occluded_from_s: float | None = None
    occluded_for_s: float = 1e9  # [s] duration of the occlusion
    capture: CaptureFault = ""  # fault of motion capture
    capture_subject: int = 0  # number of its subject, which is exchanged with the next
    capture_by: float = 0.0  # how late [s], by which yaw turned [rad], with which noise stuck, per axis [m]
    capture_from_s: float = 0.0  # [s] begin of that
    capture_for_s: float = 1e9  # [s] duration of that

    def silent(self, t: float) -> bool:
        """Whether the device is silent at time `t` [s]."""
        return _during(t, self.silent_from_s, self.silent_for_s)

    def tumbled(self, t: float) -> bool:
        """Whether the robots lie on their sides at time `t` [s]."""
        return _during(t, self.tumbled_from_s, self.tumbled_for_s)

    def occluded(self, t: float) -> bool:
        """Whether nothing measures the positions at time `t` [s]."""
        return _during(t, self.occluded_from_s, self.occluded_for_s)

    def captured(self, t: float) -> tuple[CaptureFault, int, float]:
        """Fault of motion capture at time `t` [s], empty if none, the number of its subject, and its size."""
        fault = self.capture if _during(t, self.capture_from_s, self.capture_for_s) else ""
        return fault, self.capture_subject, self.capture_by


def _during(t: float, begin: float | None, duration: float) -> bool:
    return begin is not None and begin <= t < begin + duration


class Capture:
    """Poses as motion capture tells them: late, turned, or stuck, see `CaptureFault`."""

    def __init__(self, random: np.random.Generator | None = None) -> None:
        """`random`: noise of objects that are stuck."""
        self._random = random or np.random.default_rng(0)
        self._past: deque[tuple[float, Array, Array]] = deque()  # time [s], positions, attitudes
        self._stuck: Array | None = None  # position (3,) [m]

    def measured(self, faults: Faults, t: float, position: Array, attitude: Array) -> tuple[Array, Array, Array]:
        """Positions (n, 3) [m], attitudes (n, ...), and yaws (n,) [rad] by which these are turned, at time `t` [s].

        Called for each frame, also without a fault, with arrays that are not changed afterwards.
        """
        fault, subject, size = faults.captured(t)
        yaw = np.zeros(len(position))
        subject %= len(position)
        self._past.append((t, position, attitude))
        while len(self._past) > 1 and self._past[1][0] <= t - LATEST_S:
            self._past.popleft()
        if fault == "late":
            ages = (pose for pose in reversed(self._past) if pose[0] <= t - size + 1e-6)
            _, position, attitude = next(ages, self._past[0])
        elif fault == "turned":
            yaw[subject] = size
        if fault != "stuck":
            self._stuck = None
        else:
            self._stuck = position[subject].copy() if self._stuck is None else self._stuck
            position = position.copy()
            position[subject] = self._stuck + size * self._random.standard_normal(3)
        return position, attitude, yaw


Item = TypeVar("Item")


class FaultyLink(Generic[Item]):
    """Link of a device with its injected faults: outages, losses, and the delay of what the device sends."""

    def __init__(self, faults: Faults, random: np.random.Generator | None = None) -> None:
        """`random`: of the losses; not needed for a link that loses nothing, such as TCP."""
        self.t = 0.0  # current time [s]; set by the device
        self.faults, self._random = faults, random
        self._outage = (inf, -inf)  # begin and end [s]
        self._queue: deque[tuple[float, Item]] = deque()

    def silence(self, seconds: float) -> None:
        """Begin an outage: nothing is received in either direction."""
        self._outage = self.t, self.t + seconds

    def silent(self, t: float) -> bool:
        """Whether nothing is received at time `t` [s]."""
        return self.faults.silent(t) or self._outage[0] <= t < self._outage[1]

    def lost(self) -> bool:
        """Whether the current packet is lost."""
        loss = self.faults.loss
        return self.silent(self.t) or (loss > 0.0 and self._random is not None and self._random.random() < loss)

    def put(self, item: Item) -> None:
        """Queue what the device sends now."""
        self._queue.append((self.t + self.faults.delay_s, item))

    def due(self) -> Iterator[Item]:
        """Take what is to be sent by now out of the queue."""
        while self._queue and self._queue[0][0] <= self.t:
            yield self._queue.popleft()[1]


class Server(ABC):
    """Simulated far end of a protocol."""

    def sockets(self) -> Sequence[socket.socket | int]:
        """Sockets, or descriptors of terminals, to wait on; read again after every `serve`: clients come and go."""
        return ()

    def serve(self, ready: Any, t: float) -> None:  # noqa: ANN401, B027 - not called without sockets
        """Read from one of `sockets()` that is ready, at time `t` [s]. Never blocks."""

    @abstractmethod
    def advance(self, t: float) -> None:
        """Advance the models to `t` [s] and send due packets; called once per tick of `request.rate_hz`."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network."""


class Device(Server):
    """Simulated device for some robots of one kind, made with a `DeviceRequest`."""

    addresses: tuple[str, ...]  # one per row: the body's address for the bridge, such as "udp://127.0.0.1:19850"
    models: Sequence[Motion]  # motions of the rows, for `truth`

    def truth(self) -> tuple[Array, Array]:
        """True positions (n, 3) [m] and yaws (n,) [rad] of the robots."""
        return np.array([model.position for model in self.models]), np.array([model.yaw for model in self.models])


def serve_until_next(server: Server, ticks: Ticks) -> float:
    """Serve sockets until the next tick, and begin it; returns the time since the start of the ticks [s]."""
    while True:
        for ready in select.select(server.sockets(), [], [], ticks.until_next())[0]:
            server.serve(ready, ticks.elapsed())
        if (now := ticks.elapsed()) >= ticks.next:
            ticks.begin()
            return now


@dataclass(frozen=True)
class DeviceRequest:
    """Input of a device: its robots, as for a body, and the injected faults."""

    body: BodyRequest
    faults: Faults
    by_hand: bool = False  # True without an experiment: addresses at which vendor libraries scan, where they are free
