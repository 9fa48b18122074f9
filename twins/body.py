"""The twin: a simulated body in the robot's own process, behind the same seam as the hardware."""

from __future__ import annotations

import numpy as np

from agents.body import BodyError, BodyRequest, BodyState
from agents.kinds import Kind
from agents.positioning import External
from agents.rows import Array, Index, span
from twins.differential import DRIVES, Differential
from twins.disturbance import Drift, HoverJitter, Latency, Measurement
from twins.noise import Noise
from twins.quadrotor import RESPONSES, Quadrotor

CATCH_UP_S = 1.0  # a process that was frozen for longer resumes where it was: time it could not see did not pass
FULL_WOBBLE = 0.2  # [m] from the ground up to here hover jitter grows: a robot that stands does not wobble
ENDURANCE_S = {"crazyflie": 420.0, "tello": 780.0, "khepera4": 18000.0, "turtlebot3": 9000.0}  # makers' figures


class TwinBody:
    """Rows of any simulated kinds; implements `agents.body.Body`. Advances itself to the time at which it is read."""

    def __init__(self, request: BodyRequest) -> None:
        kinds = request.kinds
        unknown = sorted({k.name for k in kinds} - DRIVES.keys() - RESPONSES.keys())
        if unknown:
            raise BodyError(f"there is no twin of a {', '.join(unknown)}; name another body")
        self._dt = 1.0 / request.rate_hz
        self._t = 0.0
        flies = np.array([k.flies for k in kinds])
        air, floor = np.flatnonzero(flies), np.flatnonzero(~flies)
        self._in_air, self._on_floor = air, floor
        self._air, self._floor = span(air), span(floor)
        self._quadrotor = Quadrotor(*self._part(request, air), self._dt)
        self._differential = Differential(*self._part(request, floor), self._dt)
        names, seeds, nature = request.names, request.seeds, request.disturbance
        aloft = [nature[i] for i in air]
        air_names, air_seeds = [names[i] for i in air], [seeds[i] for i in air]
        self._jitter = HoverJitter(aloft, Noise(air_names, air_seeds, "hover jitter", 2), self._dt)
        axes = np.where(flies[:, None], 1.0, [1.0, 1.0, 0.0])
        self._measurement = Measurement(nature, axes, Noise(names, seeds, "measurement", 4))
        self._drift = Drift(nature, Noise(names, seeds, "odometry", 2))
        self._latency = Latency(nature, self._dt)
        self._command = np.full((len(kinds), 4), np.nan)
        self._truth = np.array(request.start, dtype=float)
        self._endurance = np.array([ENDURANCE_S[k.name] for k in kinds])
        self._used = np.zeros(len(kinds))
        self._outside = np.flatnonzero(request.external)
        self._external = External(len(kinds))
        self._state = self._measure()

    @staticmethod
    def _part(request: BodyRequest, rows: Index) -> tuple[list[Kind], Array, Array]:
        return [request.kinds[i] for i in rows], request.start[rows], request.yaw[rows]

    def open(self) -> None:
        """See `Body.open`."""

    def read(self, t: float) -> BodyState:
        """See `Body.read`."""
        steps = round((t - self._t) / self._dt)
        if steps * self._dt > CATCH_UP_S:
            steps = 1
        for _ in range(steps):
            self._advance()
        self._t = t
        if steps > 0:
            self._state = self._measure()
        return self._state

    def command(self, setpoint: Array) -> None:
        """See `Body.command`."""
        if self._latency.present:
            self._command = np.where(np.isnan(setpoint), self._command, setpoint)
        else:
            self._apply(setpoint)

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`."""
        flies = np.isin(rows, self._in_air)
        self._quadrotor.takeoff(np.searchsorted(self._in_air, rows[flies]), height[flies])

    def land(self, rows: Index) -> None:
        """See `Body.land`."""
        self._quadrotor.land(self._among(self._in_air, rows))
        self._differential.halt(self._among(self._on_floor, rows))

    def stop(self, rows: Index) -> None:
        """See `Body.stop`."""
        self._quadrotor.stop(self._among(self._in_air, rows))
        self._differential.halt(self._among(self._on_floor, rows))

    @staticmethod
    def _among(part: Index, rows: Index) -> Index:
        """Where in `part` those of `rows` stand that belong to it."""
        return np.searchsorted(part, rows[np.isin(rows, part)])

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """See `Body.locate`."""
        self._external.update(row, t, position, yaw)

    def close(self) -> None:
        """See `Body.close`."""

    def _apply(self, setpoint: Array) -> None:
        if len(self._in_air):
            self._quadrotor.command(setpoint[self._air])
        if len(self._on_floor):
            self._differential.command(setpoint[self._floor, :2])

    def _advance(self) -> None:
        if self._latency.present:
            self._apply(self._latency.pass_on(self._command))
            self._command = np.full_like(self._command, np.nan)  # one command moves a body once: silence must show
        before = self._truth[:, :2].copy() if self._drift.present else None
        if len(self._on_floor):
            self._differential.advance()
            self._truth[self._floor] = self._differential.position
            self._used[self._floor] += self._dt
        if len(self._in_air):
            self._quadrotor.advance()
            self._truth[self._air] = self._quadrotor.position
            self._used[self._air] += self._dt * self._quadrotor.flying
            if self._jitter.present:
                self._jitter.advance()
                share = np.minimum(self._quadrotor.position[:, 2] / FULL_WOBBLE, 1.0)
                self._truth[self._air, :2] += share[:, None] * self._jitter.displacement
        if before is not None:
            self._drift.advance(self._truth[:, :2] - before)

    def _measure(self) -> BodyState:
        rows = len(self._truth)
        truth = self._truth.copy()
        velocity, yaw, flying = np.zeros((rows, 3)), np.zeros(rows), np.zeros(rows, dtype=bool)
        velocity[self._floor], yaw[self._floor] = self._differential.velocity, self._differential.yaw
        velocity[self._air], yaw[self._air] = self._quadrotor.velocity, self._quadrotor.yaw
        flying[self._air] = self._quadrotor.flying
        measured, heading = truth, yaw
        if self._measurement.present:
            noise = self._measurement.draw()
            measured, heading = truth + noise[:, :3], yaw + noise[:, 3]
        if self._drift.present:
            measured = measured.copy()
            measured[:, :2] += self._drift.error
        battery = 1.0 - self._used / self._endurance
        state = BodyState(np.full(rows, self._t), measured, velocity, heading, truth, yaw, battery, flying)
        if len(self._outside):
            state.position, state.yaw = measured.copy(), heading.copy()
            self._external.fill(state, self._outside)
        return state


def open_twin(request: BodyRequest) -> TwinBody:
    """The entry point `twin` of the group `zenpark.bodies`."""
    return TwinBody(request)
