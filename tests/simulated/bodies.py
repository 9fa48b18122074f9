"""Bodies that are watched and misread, and a motion capture with the faults of one."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from errno import EIO
from math import cos, nan, sin
from typing import Any

from agents.body.interface import Body
from agents.clock import Clock
from agents.network import messages, pubsub
from agents.network import session as network_session
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.vectors import Vector
from tests.simulated import kernel as sim
from tests.simulated.world import current
from twins.models.motion import Motion

SPOIL_S = 0.02  # period of a stranger's messages
CAPTURE_S = 0.01  # period of the motion capture
CAPTURE_SIGMA = 0.0005  # [m] its noise


def _stuck(state: Any, sigma: float, memory: dict[str, Any]) -> None:
    x, y, z = memory.setdefault("position", state.position)
    rng = sim.current().rng
    state.position = (
        (x + rng.gauss(0.0, sigma), y + rng.gauss(0.0, sigma), z + rng.gauss(0.0, sigma)) if sigma else (x, y, z)
    )
    state.velocity = (0.0, 0.0, 0.0)


def _unknown(state: Any, _: float, __: dict[str, Any]) -> None:
    state.position = (nan, nan, nan)


def _jump(state: Any, size: float, _: dict[str, Any]) -> None:
    x, y, z = state.position
    state.position = (x + size, y, z)


def _old(state: Any, age: float, memory: dict[str, Any]) -> None:
    """The state as it was `age` [s] before."""
    kept = memory.setdefault("kept", deque())
    kept.append((state.time, state.position, state.velocity, state.yaw))
    while len(kept) > 1 and kept[1][0] <= state.time - age:
        kept.popleft()
    state.time, state.position, state.velocity, state.yaw = kept[0]


def _silent(state: Any, _: float, memory: dict[str, Any]) -> None:
    state.time = memory.setdefault("time", state.time)


def _charge(state: Any, charge: float, _: dict[str, Any]) -> None:
    state.battery = charge


def _raise(_: Any, __: float, ___: dict[str, Any]) -> None:
    raise OSError(EIO, os.strerror(EIO))


def _still(state: Any, _: float, __: dict[str, Any]) -> None:
    state.flying = False


def _tilted(state: Any, angle: float, _: dict[str, Any]) -> None:
    state.attitude = (cos(0.5 * angle), sin(0.5 * angle), 0.0, 0.0)


def _fast(state: Any, speed: float, _: dict[str, Any]) -> None:
    state.velocity = (speed, 0.0, 0.0)


def _sinking(state: Any, size: float, _: dict[str, Any]) -> None:
    x, y, z = state.position
    state.position, state.velocity = (x, y, z - size), (0.0, 0.0, -size)


def _drifting(state: Any, speed: float, memory: dict[str, Any]) -> None:
    x, y, z = state.position
    state.position = (x + speed * (state.time - memory.setdefault("since", state.time)), y, z)


def _mute(state: Any, _: float, memory: dict[str, Any]) -> None:
    """A device that does not answer any more."""
    state.received = memory.setdefault("received", state.time)


def _deaf(*_: object) -> None:
    """A device that measures and does not obey stops."""


READINGS: dict[str, Callable[[Any, float, dict[str, Any]], None]] = {
    "nan": _unknown,
    "jump": _jump,
    "stuck": _stuck,
    "late": _old,
    "silent": _silent,
    "battery": _charge,
    "motors": _still,
    "tilt": _tilted,
    "speed": _fast,
    "sink": _sinking,
    "drift": _drifting,
    "mute": _mute,
    "deaf": _deaf,
    "error": _raise,
}


class WatchedBody(Body):
    """A body of the product, with faults of its readings, and a record of the process that drives it."""

    def __init__(self, body: Body, names: Sequence[str], rate_hz: float) -> None:
        self.body, self.names, self.process, self._period_s = body, names, sim.current().process, 1.0 / rate_hz
        self._world = current()
        self._world.bodies.append(self)

    def motion(self, row: int) -> Motion | None:
        twins: Sequence[Any] | None = getattr(self.body, "twins", None)
        motion: Motion | None = None if twins is None else twins[row].motion
        return motion

    def open(self) -> None:
        self.body.open()

    def read(self, t: float) -> Any:
        readings = self._world.readings
        for row, name in enumerate(self.names) if readings else ():
            self._carry(row, *readings.get(name, ("", 0.0, {})))
        states = self.body.read(t)
        self._note_motors()
        if readings and self.process is self._world.robots.get(self.names[0], self.process):
            for name, state in zip(self.names, states, strict=True):
                word, number, memory = readings.get(name, ("", 0.0, {}))
                if word in READINGS:
                    READINGS[word](state, number, memory)
        return states

    def _carry(self, row: int, word: str, speed: float, _: object) -> None:
        """Let wind, or somebody, carry a robot aside [m/s]."""
        motion = self.motion(row) if word == "adrift" else None
        if motion is not None:
            for place in {"held", "position"} & {*dir(motion)}:
                x, y, z = getattr(motion, place)
                setattr(motion, place, (x + speed * self._period_s, y, z))

    def command(self, setpoints: Any) -> None:
        self._note(self.names)
        self.body.command(setpoints)

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        self._world.rising.update(((self.process.pid, self.names[row]), True) for row in rows)
        self._note([self.names[row] for row in rows])
        self.body.takeoff(rows, heights)

    def land(self, rows: Sequence[int]) -> None:
        self._note([self.names[row] for row in rows])
        readings = self._world.readings
        self.body.land([row for row in rows if readings.get(self.names[row], ("",))[0] != "aloft"])

    def stop(self, rows: Sequence[int]) -> None:
        readings = self._world.readings
        self.body.stop([row for row in rows if readings.get(self.names[row], ("",))[0] != "deaf"])
        self._note_motors()

    def _note_motors(self) -> None:
        for row, name in enumerate(self.names):
            if (motion := self.motion(row)) is not None and self._world.carries(name, self.process):
                self._world.note_motors(name, motion)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        self.body.locate(row, t, position, yaw)

    def close(self) -> None:
        self.body.close()

    def inspect(self, row: int) -> Any:
        return self.body.inspect(row)

    def _note(self, names: Sequence[str]) -> None:
        for name in names:
            self._world.commands.append((self._world.now, name, self.process.pid))
            for watch in self._world.on_command:
                watch(name, self.process)


def spoil(name: str, keys: Keys, lasts: float) -> int:
    """Process of a stranger: it sends what nobody can read on all keys that concern a robot, for some time [s]."""
    session, rng = network_session.open_session([DEFAULT_ENDPOINT], name="stranger"), sim.current().rng
    over = time.monotonic() + lasts
    while time.monotonic() < over:
        for key in (keys.pose(name), keys.status(name), keys.state(name), keys.position(name), keys.order(name)):
            session.put(key, rng.randbytes(rng.randrange(40)), encoding=rng.choice((messages.JSON, "", "text/plain")))
        time.sleep(SPOIL_S)
    session.close()
    return 0


def capture(names: Sequence[str], realm: str) -> int:
    """Process of a motion capture: it publishes true positions with noise and its faults, until the run is over."""
    session = network_session.open_session([DEFAULT_ENDPOINT], name="capture")
    clock, keys, rng = Clock(), Keys(realm), sim.current().rng
    ends = {name: pubsub.NumberedPublisher(session, keys.position(name), messages.JSON) for name in names}
    late: dict[str, deque[tuple[float, bytes]]] = {name: deque() for name in names}
    while not current().conductor.dead:
        time.sleep(CAPTURE_S)
        for name, end in ends.items():
            motion = current().motion(name)
            if motion is None:
                continue
            word, number, memory = current().captures.get(name, ("", 0.0, {}))
            if word == "gone":
                continue
            if word == "swap":
                motion = current().motion(names[(names.index(name) + 1) % len(names)]) or motion
            x, y, z = motion.position
            if word == "stuck":
                x, y, z = memory.setdefault("position", motion.position)
            if word == "jump":
                x += number
            if word != "stuck" or number:
                x, y, z = (value + rng.gauss(0.0, number if word == "stuck" else CAPTURE_SIGMA) for value in (x, y, z))
            yaw = motion.yaw + {"flip": math.pi, "turned": number}.get(word, 0.0) + rng.gauss(0.0, 0.002)
            stamp = clock.utc() + (number if word == "stamp" else 0.0)
            message = messages.Position(name, stamp, (x, y, z), messages.heading(yaw))
            waiting = late[name]
            waiting.append((current().now + (number if word == "late" else 0.0), messages.encode(message)))
            while waiting and waiting[0][0] <= current().now:
                end.put(waiting.popleft()[1])
    return 0
