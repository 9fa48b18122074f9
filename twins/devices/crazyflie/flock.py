"""The Crazyflies of one process in rows: motion, estimator, battery and on-board logic."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import Final

import numpy as np

from agents.body.external_pose import velocity_after
from agents.body.interface import BodyRequest
from agents.body.kinds import Flight
from agents.kinds.crazyflie import CRAZYFLIE
from agents.protocols.crazyflie import CrazyflieSettings, Lighthouse, Loco, Outside, chosen
from agents.protocols.crtp import Info, Power
from twins.arrays import Array, Index, Mask, any_true
from twins.body import instants
from twins.devices.crazyflie.commander import Commander
from twins.devices.crazyflie.memory import Memories
from twins.devices.crazyflie.planner import OnboardPlanners, PlannerState
from twins.devices.crazyflie.supervisor import Supervisor
from twins.devices.crazyflie.vertical import VerticalLoops
from twins.devices.device import Faults
from twins.models.disturbance import HoverJitter, Latency, MeasurementNoise
from twins.models.noise import refill
from twins.models.quadrotor import GRAVITY, Quadrotor

SETTLING_S: Final = 0.1  # time constant of the convergence of estimate and variance with measurements
PRECISE: Final = 1e-5  # [m²] final variance
LOST: Final = 100.0  # [m²] variance after a reset
GROWTH: Final = 1.0  # [m²/s] of the variance without measurements
DRIFT: Final = np.array([0.05, -0.05, 0.0])  # [m/s²] along x, y: 0.3° of error in the attitude, twice
UPWARDS: Final = np.array([False, False, True])
FRESH_S: Final = 0.5  # older external positions are ignored


class Estimator:
    """Estimators of N rows."""

    def __init__(self, rows: int) -> None:
        self.error = np.zeros((rows, 3))  # estimate minus truth [m]
        self.variance = np.full(rows, LOST)  # per axis [m²]
        self.external = np.zeros((rows, 3))  # last external position [m]
        self.received = np.zeros(rows, dtype=np.intp)  # number of external positions
        self._external_error = np.zeros((rows, 3))  # of the last external position [m]
        self._external_time = np.full(rows, -np.inf)
        self._drift = np.zeros((rows, 3))  # rate of the error without measurements [m/s]
        self.rate = np.zeros((rows, 3))  # of the error [m/s]: the estimate of the velocity is wrong by as much
        self.turn = np.zeros(rows)  # estimate minus truth of the yaw [rad]

    def reset(self, row: int, error: Array, turn: float) -> None:
        """Restart the estimator of a row with an error (3,) [m] and one of its yaw [rad]."""
        self.error[row], self.variance[row], self.turn[row] = error, LOST, turn

    def add_external(self, row: int, t: float, position: tuple[float, float, float], truth: Array) -> None:
        """Add an external position (3) [m] of a row at `truth` (3,) [m]; accelerometers measure how it moves on."""
        self.external[row], self._external_time[row] = position, t
        self._external_error[row] = self.external[row] - truth
        self.received[row] += 1

    def advance(self, t: float, dt: float, ready: Mask, flow: Mask, *, flying: Mask) -> None:
        """Advance one step of dt [s].

        Args:
            t: Current time [s].
            dt: [s].
            ready: (N,) rows with a working positioning system on board.
            flow: (N,) rows with a Flow deck: velocity and height are measured, so an error of the place stays.
            flying: (N,) rows in the air: without measurements they integrate the error of their attitude.
        """
        outside = t - self._external_time <= FRESH_S
        share = -np.expm1(-dt / SETTLING_S)
        wanted = np.where((ready | flow)[:, None], 0.0, self._external_error)
        measured = ready | outside
        axes = measured[:, None] | (flow[:, None] & UPWARDS)
        before = self.error.copy()
        self.error += np.where(axes, share * (wanted - self.error), 0.0)
        blind = flying & ~measured & ~flow
        self._drift = np.where(blind[:, None], self._drift + dt * DRIFT, 0.0)
        self.error += dt * self._drift
        self.rate = (self.error - before) / dt
        settled = self.variance + share * (PRECISE - self.variance)
        growth = np.where(flow, 0.0, GROWTH * dt)
        self.variance = np.where(measured, settled, np.minimum(self.variance + growth, LOST))


# voltage [V] of a battery at rest by charge: the curve from which the firmware gives pm.batteryLevel, and full
VOLTS: Final = np.array([3.0, 3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.0, 4.04, 4.1, 4.2])
CHARGES: Final = np.linspace(0.0, 1.0, len(VOLTS))
SAG_V: Final = 0.3  # under the load of hovering: 2 A through 0.15 ohm
LOW_V: Final = 3.2  # the firmware's own threshold
LOW_S: Final = 5.0  # from the first voltage below it to the state "low"
IMPACT: Final = 4.2  # [m/s] a robot that hits the floor faster (a fall of 0.9 m) ends on its side
SKATING: Final = 2.0  # [m/s] largest speed of that
TRIM: Final = np.radians([0.4, -0.3])  # roll, pitch of a robot at rest [rad]: none is exactly level
LEANING_S: Final = 0.05  # time constant of the attitude
ENOUGH_ANCHORS: Final = 4  # for three dimensions and a common clock


class Quadrotors:
    """Motion models of N rows; their state is that of these arrays, which others may change between two steps."""

    def __init__(self, request: BodyRequest, dt: float) -> None:
        robots = zip(request.kinds, request.start, request.yaw, strict=True)
        self._models, self._dt = [Quadrotor(*robot) for robot in robots], dt
        for model, disturbance in zip(self._models, request.disturbance, strict=True):
            model.blow(disturbance.wind or (0.0, 0.0))
        self.position, self.velocity = np.array(request.start, dtype=float), np.zeros((len(self._models), 3))
        self.yaw, self.flying = np.array(request.yaw, dtype=float), np.zeros(len(self._models), dtype=bool)

    def command(self, setpoint: Array) -> None:
        """Set positions and yaws (N, 4); no effect on rows of NaN, and on the ground."""
        for model, flying, row in zip(self._models, self.flying.tolist(), setpoint.tolist(), strict=True):
            model.flying = flying
            model.command(tuple(row))

    def stop(self, rows: Index) -> None:
        """Switch motors off."""
        self.flying[rows] = False

    def advance(self) -> None:
        """Advance one step."""
        columns = (self.position.tolist(), self.velocity.tolist(), self.yaw.tolist(), self.flying.tolist())
        for model, position, velocity, yaw, flying in zip(self._models, *columns, strict=True):
            (x, y, z), (v_x, v_y, v_z) = position, velocity
            model.held, model.velocity, model.yaw, model.flying = (x, y, z), (v_x, v_y, v_z), yaw, flying
            model.move(self._dt)
        self.position = np.array([model.position for model in self._models])
        self.velocity = np.array([model.velocity for model in self._models])
        self.yaw = np.array([model.yaw for model in self._models])


class Disturbances:
    """Disturbances of N rows."""

    def __init__(self, request: BodyRequest, dt: float) -> None:
        robots = list(zip(request.disturbance, request.names, request.seeds, strict=True))
        self._jitters = [HoverJitter(*robot, dt) for robot in robots]
        self._measurements = [MeasurementNoise(*robot, spatial=True) for robot in robots]
        self._latencies = [Latency(disturbance, dt) for disturbance in request.disturbance]

    def delay(self, setpoint: Array) -> Array:
        """Setpoints (N, 4) that take effect now, when these were given."""
        commands = zip(self._latencies, setpoint.tolist(), strict=True)
        return np.array([latency.delay(tuple(command)) for latency, command in commands])

    def jitter(self, height: Array) -> Array:
        """Hover jitter (N, 2) of rows at heights (N,) [m]."""
        moved = np.zeros((len(height), 2))
        for row, jitter in enumerate(self._jitters):
            if jitter.present:
                moved[row] = jitter.advance(float(height[row]))
                refill(jitter.noise)
        return moved

    def noise(self) -> Array:
        """Noise (N, 3) of a measured position [m]."""
        drawn = np.zeros((len(self._measurements), 3))
        for row, measurement in enumerate(self._measurements):
            if measurement.present:
                drawn[row] = measurement.draw()[:3]
                refill(measurement.noise)
        return drawn


class Batteries:
    """Batteries of N rows."""

    def __init__(self, quadrotor: Quadrotors, faults: Faults, dt: float) -> None:
        rows = len(quadrotor.flying)
        self.charge = np.full(rows, faults.battery)  # 0 to 1
        self._quadrotor, self._t = quadrotor, 0.0
        self._low_since = np.full(rows, np.inf)  # [s]
        self._drain = dt * faults.drain / CRAZYFLIE.endurance_s

    def advance(self, t: float) -> None:
        """Drain by one step until `t` [s]."""
        self._t = t
        np.maximum(self.charge - self._drain * self._quadrotor.flying, 0.0, out=self.charge)
        self._low_since = np.where(self.volts < LOW_V, np.minimum(self._low_since, t), np.inf)

    @property
    def volts(self) -> Array:
        """(N,) voltages [V]; under load they sag."""
        return np.asarray(np.interp(self.charge, CHARGES, VOLTS) - SAG_V * self._quadrotor.flying)

    def level(self, row: int) -> int:
        """Log variable pm.batteryLevel [%], in steps of 10."""
        return 10 * int(np.searchsorted(VOLTS[:-2], self.volts[row]))

    def power(self, row: int) -> Power:
        """State of a row's power management."""
        if self.charge[row] <= 0.0:
            return Power.SHUTDOWN
        return Power.LOW if self._t - self._low_since[row] > LOW_S else Power.BATTERY


class Decks:
    """Decks of N rows, with the memories that they bring; positioning on board needs their contents."""

    def __init__(self, settings: Sequence[CrazyflieSettings]) -> None:
        self.lighthouse = [isinstance(each.positioning, Lighthouse) for each in settings]
        self.loco = [isinstance(each.positioning, Loco) for each in settings]
        self.multiranger = [each.multiranger for each in settings]
        outside = np.array([isinstance(each.positioning, Outside) for each in settings])
        self.flow = ~(outside | np.array(self.lighthouse) | np.array(self.loco))  # (N,)
        present = zip(self.lighthouse, self.loco, self.multiranger, self.flow.tolist(), strict=True)
        boards = "bcLighthouse4", "bcDWM1000", "bcMultiranger", "bcFlow2"
        self.memories = [Memories(list(compress(boards, each))) for each in present]

    def station_status(self, row: int) -> int:
        """Log variable lighthouse.status: 0 nothing received, 1 geometry or calibration missing, 2 measuring."""
        if not self.lighthouse[row]:
            return 0
        memories = self.memories[row]
        return 2 if memories.geometries & memories.calibrations else 1

    def ready(self) -> Mask:
        """Rows (N,) with a working positioning system on board."""
        working = np.zeros(len(self.memories), dtype=bool)
        for row, memories in enumerate(self.memories):
            if self.lighthouse[row]:
                working[row] = self.station_status(row) == 2
            elif self.loco[row]:
                working[row] = len(memories.anchors()) >= ENOUGH_ANCHORS
        return np.asarray(working)


class Flock:
    """N Crazyflies; the protocol of each is a `twins.devices.crazyflie.drone.Drone`."""

    def __init__(self, request: BodyRequest, faults: Faults) -> None:
        rows = len(request.names)
        self.dt = 1.0 / request.rate_hz  # tick [s]
        self.t = 0.0  # current time [s]
        settings = [
            chosen(name, device, external=external)
            for name, device, external in zip(request.names, request.device, request.external, strict=True)
        ]
        self.decks = Decks(settings)
        self.tables = [tuple(each.tables) for each in settings]
        self.gaps = [each.gaps for each in settings]
        self._faults, self._fault_tumbled = faults, False
        by_hand = [faults.refuse_arming or each.platform == "brushless" for each in settings]
        self.refuse_arming = faults.refuse_arming
        self.planner = OnboardPlanners(rows)
        self.commander = Commander(rows)
        self.supervisor = Supervisor(~np.array(by_hand))
        self.estimator = Estimator(rows)
        self.quadrotor = Quadrotors(request, self.dt)
        self.batteries = Batteries(self.quadrotor, faults, self.dt)
        self._disturbances = Disturbances(request, self.dt)
        flight = CRAZYFLIE.motion
        assert isinstance(flight, Flight)
        self._gain, self._turn_gain = np.array(flight.position), request.kinds[0].turn_response
        self._speed_gain = np.array(flight.velocity)
        self.estimator.error[:] = -self.quadrotor.position  # it believes to be where it was switched on,
        self.estimator.turn[:] = -self.quadrotor.yaw  # and to look along x
        self.vertical = VerticalLoops([each.platform for each in settings], self.dt)
        self.place = self.quadrotor.position.copy()  # (N, 3) true positions [m]
        self.estimate = self.place + self.estimator.error  # (N, 3) reported positions [m]
        self.velocity = np.zeros((rows, 3))  # reported, from measured positions [m/s]
        self._last_measured = self.place
        self.acceleration = np.zeros((rows, 3))  # [m/s²]
        self.attitude = np.tile(TRIM, (rows, 1))  # roll to the right, pitch nose up [rad]

    def pose(self, row: int) -> Array:
        """Estimated pose (4,) of a row: x, y, z [m], yaw [rad]."""
        return np.append(self.quadrotor.position[row] + self.estimator.error[row], self.estimated_yaw(row))

    def estimated_yaw(self, row: int) -> float:
        """Estimated yaw of a row [rad]."""
        return float(self.quadrotor.yaw[row] + self.estimator.turn[row])

    def info(self, row: int) -> Info:
        """Flags of a row's supervisor and planner."""
        info = self.supervisor.info(row)
        if self.planner.plan[row] != PlannerState.IDLE:
            info |= Info.PLANNER_ACTIVE
        if self.planner.finished(self.t)[row]:
            info |= Info.PLANNER_FINISHED
        return info

    def arm(self, row: int, *, on: bool) -> bool:
        """Arm or disarm a row; False if refused."""
        if on and self.refuse_arming:
            return False
        done = self.supervisor.arm(row, self.t, on=on)
        if not on:
            self.planner.stop(row)
            self.commander.stop(row)
        return done

    def restart(self, row: int) -> None:
        """Switch a row off and on: motors off, estimator at its start."""
        self.planner.stop(row)
        self.commander.stop(row)
        self.supervisor.restart(row)
        self.quadrotor.stop(np.array([row]))
        self.estimator.reset(row, -self.quadrotor.position[row], -float(self.quadrotor.yaw[row]))

    def advance(self, t: float) -> Mask:
        """Advance to time `t` [s] by steps of dt; returns the rows (N,) locked or crashed on the way."""
        locked = np.zeros(len(self.place), dtype=bool)
        for now in instants(self.t, t, self.dt) or [t]:
            locked |= self._step(now)
        return locked

    def _step(self, t: float) -> Mask:
        self.t = t
        if self._faults.tumbled(t) != self._fault_tumbled:
            self._fault_tumbled = not self._fault_tumbled
            self.supervisor.tumbled[:] = self._fault_tumbled
        quadrotor, commander, supervisor = self.quadrotor, self.commander, self.supervisor
        commander.take_planned(t, self.planner.goal(t))
        locked = supervisor.advance(t, quadrotor.flying, commander.setpoint_age(t))
        for row in np.flatnonzero(locked):
            self.planner.stop(int(row))
        quadrotor.stop(np.flatnonzero(quadrotor.flying & ~self._motors_on()))
        quadrotor.flying[self._motors_on()] = True
        setpoint = commander.model_setpoint(
            quadrotor.position + self.estimator.error,
            quadrotor.velocity,
            quadrotor.yaw + self.estimator.turn,
            level=supervisor.level,
            gain=self._gain,
            speed_gain=self._speed_gain[0],
            turn_gain=self._turn_gain,
        )
        setpoint = self._true_setpoint(setpoint)
        delayed = self._disturbances.delay(setpoint)
        quadrotor.command(delayed)
        before, place = quadrotor.velocity, quadrotor.position.copy()
        quadrotor.advance()
        self._climb(before, place, np.nan_to_num(delayed[:, 2] - place[:, 2]))
        if any_true(quadrotor.flying):
            # the controller takes what the estimate does not see of the velocity for none
            quadrotor.velocity[:, :2] -= np.where(
                quadrotor.flying[:, None], self.dt * self._speed_gain[:2] * self.estimator.rate[:, :2], 0.0
            )
        self._touch_floor(before, place, setpoint)
        self._update_attitude(before)
        self.place = quadrotor.position.copy()
        self.place[:, :2] += self._disturbances.jitter(quadrotor.position[:, 2])
        self.batteries.advance(t)
        self.estimator.advance(t, self.dt, self.decks.ready(), self.decks.flow, flying=quadrotor.flying)
        measured = self.place + self._disturbances.noise()
        self.estimate = measured + self.estimator.error
        moved = zip(self.velocity.tolist(), (measured - self._last_measured).tolist(), strict=True)
        self.velocity = np.array([velocity_after((u, v, w), (x, y, z), self.dt) for (u, v, w), (x, y, z) in moved])
        self._last_measured = measured
        return locked

    def _climb(self, before: Array, place: Array, offset: Array) -> None:
        """Move rows with motors on vertically, from `before` (N, 3) [m/s] and `place` (N, 3) [m] by `offset` (N,)."""
        quadrotor = self.quadrotor
        wanted = np.where(np.isnan(self.commander.target[:, 2]), self._gain[2] * offset, np.nan)
        climb = before[:, 2] + self.estimator.rate[:, 2]
        acceleration = self.vertical.advance(quadrotor.flying, offset, climb, wanted, self.commander.thrust)
        speed = before[:, 2] + self.dt * acceleration
        quadrotor.velocity[:, 2] = np.where(quadrotor.flying, speed, quadrotor.velocity[:, 2])
        quadrotor.position[:, 2] = np.where(quadrotor.flying, place[:, 2] + self.dt * speed, quadrotor.position[:, 2])

    def _true_setpoint(self, setpoint: Array) -> Array:
        """Setpoints (N, 4) of positions and yaws as they are flown: the controller uses the estimate, not the truth."""
        estimator = self.estimator
        setpoint[:, :3] -= estimator.error
        setpoint[:, 3] -= estimator.turn
        if any_true(estimator.turn != 0.0):  # it turns its accelerations by a wrong yaw
            place = self.quadrotor.position[:, :2]
            ahead, cos, sin = setpoint[:, :2] - place, np.cos(estimator.turn), np.sin(estimator.turn)
            turned = np.stack([cos * ahead[:, 0] + sin * ahead[:, 1], cos * ahead[:, 1] - sin * ahead[:, 0]], axis=1)
            setpoint[:, :2] = place + turned
        return setpoint

    def _touch_floor(self, before: Array, place: Array, setpoint: Array) -> None:
        """Stop rows at the floor; those that hit it hard, with `before` (N, 3) [m/s], end on their sides.

        If the motors of a row still carry much of its weight, it slides from its `place` (N, 3) [m] toward `setpoint`
        (N, 4), as its estimate leads.
        """
        quadrotor = self.quadrotor
        floor = quadrotor.position[:, 2] <= 0.0
        self.supervisor.tumbled |= floor & (before[:, 2] < -IMPACT)
        below = quadrotor.position[:, 2] < 0.0
        sliding = below & quadrotor.flying & self.vertical.sliding
        wanted = np.clip(self._gain[:2] * (setpoint[:, :2] - place[:, :2]), -SKATING, SKATING)
        speed = before[:, :2] + self.dt * self._speed_gain[:2] * (wanted - before[:, :2])
        quadrotor.position[below, 2] = 0.0
        quadrotor.velocity[below] = 0.0
        quadrotor.velocity[sliding, :2] = speed[sliding]
        quadrotor.position[below, :2] = place[below, :2] + self.dt * quadrotor.velocity[below, :2]

    def _update_attitude(self, before: Array) -> None:
        """Attitude that gives the acceleration from `before` (N, 3) [m/s] on, with a lag."""
        quadrotor = self.quadrotor
        self.acceleration = np.where(quadrotor.flying[:, None], (quadrotor.velocity - before) / self.dt, 0.0)
        cos, sin = np.cos(quadrotor.yaw), np.sin(quadrotor.yaw)
        x, y, z = self.acceleration.T
        lift = GRAVITY + z
        wanted = TRIM + np.stack([np.arctan2(sin * x - cos * y, lift), -np.arctan2(cos * x + sin * y, lift)], axis=1)
        self.attitude += -np.expm1(-self.dt / LEANING_S) * (wanted - self.attitude)

    def _motors_on(self) -> Mask:
        """Rows (N,) with turning motors."""
        return np.asarray(self.commander.on & self.supervisor.may_fly & (self.batteries.charge > 0.0))
