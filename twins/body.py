"""Simulated bodies behind the same interface as the hardware, in the robot's process or together in a world."""

from __future__ import annotations

from math import inf, isfinite

import numpy as np

from agents.arrays import Array, Index, Mask, span
from agents.body.external_pose import PATIENCE_S, External, velocity_after
from agents.body.interface import BodyRequest, BodyState
from agents.plugins import registry
from twins.engines.engine import Engine, EngineFactory, Stage, Touch
from twins.engines.point_mass import PointMass, PointMassEngine
from twins.models.disturbance import Drift, HoverJitter, Latency, Measurement
from twins.models.noise import Noise
from twins.scene import World
from twins.sensing.range_sensors import RangeSensors

CATCH_UP_S = 1.0  # a process that was frozen for longer resumes where it was: the lost time is not simulated


def instants(since: float, until: float, step: float) -> list[float]:
    """Times [s] of the steps that lead from `since` to `until`."""
    steps = round((until - since) / step)
    if steps * step > CATCH_UP_S:
        steps = 1
    return [until - left * step for left in range(steps - 1, -1, -1)]


class TwinBody:
    """Simulated robots of any kinds; implements `agents.body.interface.Body`. Advances to the time of each `read`."""

    def __init__(self, request: BodyRequest, world: World | None = None) -> None:
        """Without a world every row is alone; raises BodyError or PluginError for an unknown kind or engine."""
        kinds = request.kinds
        rows = len(kinds)
        self._dt = 1.0 / request.rate_hz
        self._t = 0.0
        self.begun_at = (
            np.nan
        )  # common start on the clock of `read` [s], NaN while unknown; obstacles' plans start then
        self._world = world if world is not None else World.alone(rows)
        stage = Stage(
            kinds, request.start, request.yaw, self._dt, self._world.copy, self._world.mirrored, self._world.scene
        )
        factory: EngineFactory = PointMass() if world is None else registry.build(registry.ENGINES, self._world.engine)
        self.engine: Engine = factory.build(stage)
        flies = np.array([k.flies for k in kinds])
        names, seeds, nature = request.names, request.seeds, request.disturbance
        air = np.flatnonzero(flies)
        self._in_air, self._all_fly, self._drives = span(air), len(air) == rows, ~flies
        aloft = [nature[i] for i in air]
        air_names, air_seeds = [names[i] for i in air], [seeds[i] for i in air]
        self._jitter = HoverJitter(aloft, Noise(air_names, air_seeds, "hover jitter", 2), self._dt)
        self._wobble = np.zeros((rows, 2))
        axes = np.where(flies[:, None], 1.0, [1.0, 1.0, 0.0])
        self._measurement = Measurement(nature, axes, Noise(names, seeds, "measurement", 4))
        self._drift = Drift(nature, Noise(names, seeds, "odometry", 2))
        self._latency = Latency(nature, self._dt)
        self._command = np.full((rows, 4), np.nan)
        self._sensors = RangeSensors(request, self._world) if any(self._world.sensors) else None
        self._endurance = np.array([k.endurance_s for k in kinds])
        self._used, self._uses, self._flew = np.zeros(rows), np.zeros(rows), b""
        self._absent = bool(self._world.mirrored.any())  # mirrored robots may be absent: their positions are NaN
        self._no_time = np.zeros(rows)
        self._external_rows = np.flatnonzero(request.external)
        self._external = External(rows)
        self._measured_at, self._measured, self._velocity = -inf, np.zeros((rows, 3)), np.zeros((rows, 3))
        self._state = self._measure()

    def open(self) -> None:
        """See `Body.open`."""

    def read(self, t: float) -> BodyState:
        steps = instants(self._t, t, self._dt)
        for now in steps:
            self._advance(now)
        self._t = t
        if steps:
            self._state = self._measure()
        return self._state

    def command(self, setpoint: Array) -> None:
        if self._latency.present:
            self._command = np.where(np.isnan(setpoint), self._command, setpoint)
        else:
            self.engine.command(setpoint)

    def takeoff(self, rows: Index, height: Array) -> None:
        self.engine.takeoff(rows, height)

    def land(self, rows: Index) -> None:
        self.engine.land(rows)

    def stop(self, rows: Index) -> None:
        self.engine.stop(rows)

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        self._external.update(row, t, position, yaw)

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask, velocity: Array | None = None) -> None:
        """Set positions (len(rows), 3) [m] and yaws (len(rows),) [rad]; flying rows hold them.

        The rows are at rest, or move with `velocity` (len(rows), 3) [m/s] in the point-mass engine.
        """
        self.engine.place(rows, position, yaw, flying)
        if velocity is not None and isinstance(self.engine, PointMassEngine):
            self.engine.push(rows, velocity)
        self._state = self._measure()
        self._velocity = self._velocity.copy()
        self._velocity[rows] = 0.0 if velocity is None else velocity  # the jump to the place is no motion
        self._state.velocity = self._velocity

    def mirror(self, rows: Index, position: Array, yaw: Array, velocity: Array) -> None:
        """Set the state of mirrored rows: (len(rows), 3) [m], (len(rows),) [rad], (len(rows), 3) [m/s]; NaN: absent."""
        self.engine.mirror(rows, position, yaw, velocity)

    def touches(self) -> list[Touch]:
        """Contacts that began since the last call."""
        return self.engine.touches()

    def close(self) -> None:
        """See `Body.close`."""

    def _advance(self, t: float) -> None:
        engine = self.engine
        if self._latency.present:
            engine.command(self._latency.delay(self._command))
            self._command = np.full_like(self._command, np.nan)  # a command acts once, so that silence has its effect
        before = engine.position[:, :2].copy() if self._drift.present else None
        if self._jitter.present:
            displacement = self._wobble = self._jitter.advance(engine.position[self._in_air, 2])
            if not self._all_fly:
                self._wobble = np.zeros((len(self._used), 2))  # a new array: engines may keep the last one
                self._wobble[self._in_air] = displacement
        engine.advance(t - self.begun_at if isfinite(self.begun_at) else -inf, self._wobble)
        if (flying := engine.flying.tobytes()) != self._flew:
            self._flew, self._uses = flying, self._dt * (engine.flying | self._drives)
        self._used = self._used + self._uses
        if before is not None:
            self._drift.advance(engine.position[:, :2] - before)
        if self._sensors is not None:
            self._sensors.sweep(t, engine)

    def _measure(self) -> BodyState:
        engine = self.engine
        truth, yaw = engine.position.copy(), engine.yaw.copy()
        measured, heading = truth, yaw
        if self._measurement.present:
            noise = self._measurement.draw()
            measured, heading = truth + noise[:, :3], yaw + noise[:, 3]
        if self._drift.present:
            measured = measured.copy()
            measured[:, :2] += self._drift.error
        self._estimate(measured)
        state = BodyState(
            time=self._no_time + self._t,
            position=measured,
            velocity=self._velocity,
            yaw=heading,
            true_position=truth,
            true_yaw=yaw,
            battery=np.maximum(1.0 - self._used / self._endurance, 0.0),
            flying=engine.flying.copy(),
            rays=None if self._sensors is None else self._sensors.rays,
            attitude=engine.attitude,
        )
        if len(self._external_rows):
            state.position, state.velocity, state.yaw = measured.copy(), self._velocity.copy(), heading.copy()
            self._external.fill(state, self._external_rows)
        return state

    def _estimate(self, measured: Array) -> None:
        """Estimate velocities from measured positions, hover jitter and noise included.

        Motion capture measures positions (`External`), and so does a Khepera's odometry. A Crazyflie with a positioning
        system on board also uses its accelerometer (Mueller, Hamer and D'Andrea, ICRA 2015), hence has less noise; it
        also measures its own hover jitter.
        """
        since = self._t - self._measured_at
        if since >= PATIENCE_S:
            self._velocity = np.zeros_like(self._velocity)
        elif since > 0.0:
            velocity = velocity_after(self._velocity, measured - self._measured, since)
            self._velocity = np.where(np.isfinite(velocity), velocity, 0.0) if self._absent else velocity
        self._measured_at, self._measured = self._t, measured
