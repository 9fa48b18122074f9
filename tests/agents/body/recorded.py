"""A body that writes down what it is told."""

from math import isfinite

from agents.body.interface import Body, BodyError, BodyState


class Recorded(Body):
    """Robots that move along x as told, at a `share` of the speed, measured off by a constant [m].

    Attributes:
        told: Calls with their arguments, one after the other.
        placed: Moments and arguments of `place`.
        broken: The method that raises `failure`.
    """

    def __init__(self, rows, *, share=1.0, off=0.0, start=0.0):
        self.x, self.yaw = [start + row for row in range(rows)], [0.0] * rows
        self.speed, self.flying = [0.0] * rows, [False] * rows
        self.share, self.off = share, off
        self.told, self.placed = [], []
        self.t = self.stale = 0.0
        self.note = self.broken = ""
        self.failure = BodyError

    def _tell(self, what, *arguments):
        if self.broken == what:
            raise self.failure("no engine")
        self.told.append((what, *arguments) if arguments else what)

    def open(self):
        self._tell("open")

    def read(self, t):
        if self.broken == "read":
            raise self.failure("no engine")
        self.x = [x + (t - self.t) * self.share * speed for x, speed in zip(self.x, self.speed, strict=True)]
        self.t = t
        return [
            BodyState(t - self.stale, (x + self.off, 0.0, 0.0), (speed, 0.0, 0.0), yaw, flying=flying, note=self.note)
            for x, speed, yaw, flying in zip(self.x, self.speed, self.yaw, self.flying, strict=True)
        ]

    def command(self, setpoints):
        self._tell("command", [setpoint[0] for setpoint in setpoints])
        for row, (speed, *_) in enumerate(setpoints):
            self.speed[row] = speed if isfinite(speed) else self.speed[row]

    def takeoff(self, rows, heights):
        self._tell("takeoff", rows, heights)
        for row in rows:
            self.flying[row] = True

    def land(self, rows):
        self._tell("land", rows)

    def stop(self, rows):
        self._tell("stop", rows)

    def locate(self, row, t, position, yaw):
        self._tell("locate", row, t, position, yaw)

    def close(self):
        self._tell("close")

    def place(self, rows, positions, yaws, flying, velocities=None):
        if self.broken == "place":
            raise self.failure("no engine")
        self.placed.append((round(self.t, 6), rows, [x for x, _, _ in positions], flying, velocities))
        for row, (x, _, _), yaw in zip(rows, positions, yaws, strict=True):
            self.x[row], self.yaw[row] = x, yaw
