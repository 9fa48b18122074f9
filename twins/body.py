"""Simulated bodies behind the same interface as the hardware, in the robot's process or together in a world.

The methods of `Twin` but `place` and `refill` are quiet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf, isfinite, nan
from typing import TYPE_CHECKING

from agents.body.external_pose import PATIENCE_S, External, velocity_after
from agents.body.interface import BodyRequest, BodyState, Disturbance
from agents.body.kinds import Kind
from agents.body.shadow_twin import Placeable
from agents.vectors import NO_SETPOINT, ZERO, Setpoint, Vector
from twins.engines.engine import Engine, EngineInput, Touch, World
from twins.engines.point_mass import PointMassEngine, model, require_models
from twins.models import noise
from twins.models.disturbance import HoverJitter, Latency, MeasurementNoise, OdometryDrift
from twins.models.motion import Motion
from twins.models.onboard_flight import OnboardFlight

if TYPE_CHECKING:  # a process of one robot needs no scene, which needs numpy
    from twins.sensing.range_sensors import RangeSensors

CATCH_UP_S = 1.0  # a process that was frozen for longer resumes where it was: the lost time is not simulated


def instants(since: float, until: float, step: float) -> list[float]:
    """Times [s] of the steps that lead from `since` to `until`."""
    steps = round((until - since) / step)
    if steps * step > CATCH_UP_S:
        steps = 1
    return [until - left * step for left in range(steps - 1, -1, -1)]


class Twin:
    """One simulated robot: its motion, what disturbs it, and what it measures of itself."""

    __slots__ = (
        "_before", "_command", "_delays", "_drift", "_drifts", "_drives", "_endurance", "_jitter", "_jitters",
        "_latency", "_measured", "_measured_at", "_measurement", "_measures", "_t", "_used", "_velocity", "motion",
    )  # fmt: skip

    motion: Motion  # motion by an engine
    _jitter: HoverJitter
    _measurement: MeasurementNoise
    _drift: OdometryDrift
    _latency: Latency
    _jitters: bool  # whether these four are present
    _measures: bool
    _drifts: bool
    _delays: bool
    _drives: bool  # uses its battery all the time; what flies, with its motors on
    _endurance: float  # time that a full battery lasts [s],
    _used: float  # used part of it [s]
    _command: Setpoint  # given since the last step; NaN: none
    _before: Vector  # true position before the step [m]
    _t: float  # time of the last step [s]
    _measured_at: float  # time of the last measurement [s], −inf before the first,
    _measured: Vector  # its position [m],
    _velocity: Vector  # its velocity [m/s]

    def __init__(
        self, motion: Motion, kind: Kind, disturbance: Disturbance, *, name: str, seed: int, dt: float
    ) -> None:
        """`dt`: step of `advance` [s]."""
        self.motion = motion
        self._jitter = HoverJitter(disturbance if kind.flies else Disturbance(), name, seed, dt)
        self._measurement = MeasurementNoise(disturbance, name, seed, spatial=kind.flies)
        self._drift, self._latency = OdometryDrift(disturbance, name, seed), Latency(disturbance, dt)
        self._jitters, self._measures = self._jitter.present, self._measurement.present
        self._drifts, self._delays = self._drift.present, self._latency.present
        self._drives, self._endurance = not kind.flies, kind.endurance_s
        if disturbance.wind is not None and isinstance(motion, OnboardFlight):
            motion.blow(disturbance.wind)
        self._command, self._before = NO_SETPOINT, motion.position
        self._t = self._used = 0.0
        self._measured_at = -inf
        self._measured, self._velocity = ZERO, ZERO

    def command(self, setpoint: Setpoint) -> None:
        """Set the setpoint, see `Body.command`; it takes effect after the latency."""
        if not self._delays:
            self.motion.command(setpoint)
        elif setpoint[0] == setpoint[0]:
            self._command = setpoint

    def advance(self, t: float, dt: float) -> bool:
        """One step of `dt` to `t` [s], of a motion that moves by itself; returns whether `refill` is due."""
        self.begin_step()
        self.motion.move(dt)
        return self.end_step(t, dt)

    def begin_step(self) -> None:
        """Give the motion its delayed command and the hover jitter of this step."""
        motion = self.motion
        if self._delays:
            motion.command(self._latency.delay(self._command))
            self._command = NO_SETPOINT  # a command acts once, so that silence has its effect
        if self._jitters:
            motion.wobble = self._jitter.advance(motion.position[2])
        if self._drifts:
            self._before = motion.position

    def end_step(self, t: float, dt: float) -> bool:
        """Account for the step of `dt` to `t` [s] that the motion made; returns whether `refill` is due."""
        self._t = t
        motion = self.motion
        if self._drives or motion.flying:
            self._used += dt
        due = False
        if self._jitters:
            jitter = self._jitter.noise
            due = jitter.next == jitter.end
        if self._drifts:
            drift, before, now = self._drift, self._before, motion.position
            drift.advance(now[0] - before[0], now[1] - before[1])
            due = due or drift.noise.next == drift.noise.end
        return due

    def measure(self, state: BodyState) -> bool:
        """Measure into a state: its newest pose, velocity and battery; returns whether `refill` is due.

        Velocities are estimated from measured positions, hover jitter and noise included. Motion capture measures
        positions (`External`), and so does a Khepera's odometry. A Crazyflie with a positioning system on board also
        uses its accelerometer (Mueller, Hamer and D'Andrea, ICRA 2015), hence has less noise; it also measures its own
        hover jitter.
        """
        motion, t = self.motion, self._t
        position, yaw = motion.position, motion.yaw
        state.true_position, state.true_yaw = position, yaw
        due = False
        if self._measures:
            measurement = self._measurement
            dx, dy, dz, turn = measurement.draw()
            position, yaw = (position[0] + dx, position[1] + dy, position[2] + dz), yaw + turn
            due = measurement.noise.next == measurement.noise.end
        if self._drifts:
            drift = self._drift
            position = (position[0] + drift.x, position[1] + drift.y, position[2])
        since = t - self._measured_at
        if since >= PATIENCE_S:
            self._velocity = ZERO
        elif since > 0.0:
            x, y, z = self._measured
            velocity = velocity_after(self._velocity, (position[0] - x, position[1] - y, position[2] - z), since)
            self._velocity = velocity if velocity[0] == velocity[0] else ZERO
        self._measured_at, self._measured = t, position
        state.time, state.position = t, position
        state.velocity, state.yaw = self._velocity, yaw
        charge = 1.0 - self._used / self._endurance
        state.battery = charge if charge > 0.0 else 0.0
        state.flying, state.attitude = motion.flying, motion.attitude
        return due

    def settle(self, velocity: Vector) -> None:
        """Take a jump to another place for no motion: the robot moves with `velocity` [m/s]."""
        self._velocity = velocity

    def reserve(self, steps: int) -> None:
        """Draw noise for `steps` steps and measurements ahead."""
        for each in (self._jitter.noise, self._measurement.noise, self._drift.noise):
            each.reserve(steps + 1)

    def refill(self) -> None:
        """Draw noise for more steps; due when `advance` or `measure` say so."""
        noise.refill(self._jitter.noise, self._measurement.noise, self._drift.noise)


class TwinBody(Placeable):
    """Simulated robots of any kinds. Advances to the time of each `read`."""

    begun_at: float  # common start on the clock of `read` [s], NaN while unknown; obstacles' plans start then
    engine: Engine
    twins: list[Twin]

    def __init__(self, request: BodyRequest, world: World | None = None, substeps: int = 1) -> None:
        """Without a world every robot is alone; raises BodyError for a kind without a twin, or a missing library.

        `substeps`: steps of the models in a tick.
        """
        self._dt = dt = 1.0 / (request.rate_hz * substeps)
        self._t = 0.0
        self.begun_at = nan
        rows = len(request.names)
        mirrored: Sequence[bool] = (False,) * rows
        self._alone: PointMassEngine | None = None
        if world is None:
            require_models(request.kinds)
            models = map(model, request.kinds, request.start, request.yaw)
            self.engine = self._alone = PointMassEngine(list(models), dt)
        else:
            mirrored = world.mirrored
            stage = EngineInput(request.kinds, request.start, request.yaw, dt, mirrored, world.scene)
            self.engine = world.engine.build(stage)
            if type(self.engine) is PointMassEngine:
                self._alone = self.engine
        self.twins = [
            Twin(motion, kind, Disturbance() if away else disturbance, name=name, seed=seed, dt=dt)
            for motion, kind, disturbance, name, seed, away in zip(
                self.engine.motions, request.kinds, request.disturbance, request.names, request.seeds, mirrored,
                strict=True,
            )
        ]  # fmt: skip
        self._states = [BodyState() for _ in self.twins]
        self._measured = list(zip(self.twins, self._states, strict=True))
        self._external = {row: External() for row, outside in enumerate(request.external) if outside}
        self._sensors: RangeSensors | None = None
        if world is not None and any(world.sensors):
            from twins.sensing.range_sensors import RangeSensors  # noqa: PLC0415 - needs numpy

            self._sensors = RangeSensors(request, world)
        self._measure()

    def open(self) -> None:
        """See `Body.open`."""

    def read(self, t: float) -> Sequence[BodyState]:
        """See `Body.read`; the states are the same objects at every call."""
        steps = round((t - self._t) / self._dt)
        if steps == 1:  # the rule
            self._advance(t)
        elif steps > 1:
            for now in instants(self._t, t, self._dt):
                self._advance(now)
        self._t = t
        if steps > 0:
            self._measure()
        return self._states

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        for twin, setpoint in zip(self.twins, setpoints, strict=True):
            twin.command(setpoint)

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        self.engine.takeoff(rows, heights)

    def land(self, rows: Sequence[int]) -> None:
        self.engine.land(rows)

    def stop(self, rows: Sequence[int]) -> None:
        self.engine.stop(rows)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        self._external[row].update(t, position, yaw)

    def place(
        self,
        rows: Sequence[int],
        positions: Sequence[Vector],
        yaws: Sequence[float],
        flying: Sequence[bool],
        velocities: Sequence[Vector] | None = None,
    ) -> None:
        """Set positions [m] and yaws [rad]; flying robots hold them.

        The robots are at rest, or move with `velocities` [m/s] in the point-mass engine.
        """
        self.engine.place(rows, positions, yaws, flying)
        moving = (ZERO,) * len(rows) if velocities is None else velocities
        self._measure()
        for row, velocity in zip(rows, moving, strict=True):
            if velocities is not None and self._alone is not None:
                self._alone.motions[row].push(velocity)
            self.twins[row].settle(velocity)
            self._states[row].velocity = velocity

    def mirror(
        self, rows: Sequence[int], positions: Sequence[Vector], yaws: Sequence[float], velocities: Sequence[Vector]
    ) -> None:
        """Set the state of mirrored robots: [m], [rad], [m/s]; NaN: absent."""
        self.engine.mirror(rows, positions, yaws, velocities)

    def touches(self) -> list[Touch]:
        """Contacts that began since the last call."""
        return self.engine.touches()

    def close(self) -> None:
        """See `Body.close`."""

    @property
    def lonely(self) -> bool:
        """Whether every robot moves by itself, in a room where nothing moves, and sees nothing: see `Twin`."""
        alone = self._alone
        return alone is not None and not (alone.moves_obstacles or self._sensors is not None or self._external)

    @property
    def together(self) -> bool:
        """Whether robots move in an engine that they share, and nothing is measured from outside."""
        return self._alone is None and not self._external

    def move(self, t: float, update: Callable[[], object] | None = None) -> bool:
        """The part of a step to `t` [s] that all robots make at once, after `begin_step` and before `end_step` of each.

        It sets their range readings; returns whether there are new ones.

        Args:
            update: Brings motions and carriers up to date, for readings; of a caller that pushes and takes the robots.
        """
        since = self._since_start(t)
        if update is None:
            self.engine.advance(since, [motion.wobble for motion in self.engine.motions])
        else:
            self.engine.solve(since)
            if self._sensors is not None and t >= self._sensors.next:
                update()
                for carrier, motion in zip(self.engine.carriers, self.engine.motions, strict=True):
                    carrier.take(motion)
        return self._sensors is not None and self._sweep(t, self._sensors)

    def moved_to(self, t: float) -> None:
        """The twins were advanced to `t` [s], and measured, one by one."""
        self._t = t

    def _advance(self, t: float) -> None:
        if self._alone is None:
            for twin in self.twins:
                twin.begin_step()
            self.move(t)
            for twin in self.twins:
                if twin.end_step(t, self._dt):
                    twin.refill()
            return
        for twin in self.twins:
            if twin.advance(t, self._dt):
                twin.refill()
        if self._alone.moves_obstacles:
            self._alone.move_obstacles(self._since_start(t))
        if self._sensors is not None:
            self._sweep(t, self._sensors)

    def _sweep(self, t: float, sensors: RangeSensors) -> bool:
        """Let range sensors measure; returns whether one was due."""
        if not sensors.sweep(t, self.engine):
            return False
        for state, scan in zip(self._states, sensors.scans, strict=True):
            state.scan = scan
        return True

    def _since_start(self, t: float) -> float:
        """Time since the common start [s], −inf while that is unknown."""
        return t - self.begun_at if isfinite(self.begun_at) else -inf

    def _measure(self) -> None:
        for twin, state in self._measured:
            if twin.measure(state):
                twin.refill()
            state.note = ""
        for row, external in self._external.items():
            external.fill(self._states[row])
