"""Vehicle of a Crazyflie, below its protocol: motion, estimator, battery, decks and on-board logic."""

from __future__ import annotations

from bisect import bisect_left
from math import atan2, cos, exp, inf, isnan, radians, sin, tan
from typing import Final

import numpy as np

from agents.body.interface import BodyRequest
from agents.body.kinds import Flight
from agents.vectors import ZERO, Setpoint, Vector, clamp, difference, norm
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.crazyflie.protocol.addresses import CrazyflieSettings, Lighthouse, Loco, chosen
from bridges.crazyflie.protocol.crtp import Info, Power
from bridges.crazyflie.twin.commander import STEEPEST, Commander
from bridges.crazyflie.twin.memory import Memories
from bridges.crazyflie.twin.planner import OnboardPlanner, PlannerState
from bridges.crazyflie.twin.supervisor import Supervisor
from bridges.crazyflie.twin.vertical import VerticalLoops
from twins.arrays import Array
from twins.body import instants
from twins.device import Faults
from twins.models.disturbance import HoverJitter, Latency, MeasurementNoise
from twins.models.noise import refill
from twins.models.quadrotor import GRAVITY, Quadrotor

SETTLING_S: Final = 0.1  # time constant of the convergence of estimate and variance with measurements
PRECISE: Final = 1e-5  # [m²] final variance
LOST: Final = 100.0  # [m²] variance after a reset
GROWTH: Final = 1.0  # [m²/s] growth of the variance without measurements
DRIFT: Final = (0.05, -0.05)  # [m/s²] error along x, y: 0.3° of error in the attitude, twice
FRESH_S: Final = 0.5  # age of external positions from which the attitude drifts
# [m²/s³] noise of the acceleration, horizontal and vertical: the firmware's 0.5 and 1 m/s², drawn every millisecond
HORIZONTAL_NOISE, VERTICAL_NOISE = 2.5e-4, 1e-3
SLOW: Final = 1e-4  # [m²/s²] variance of the velocity after a reset
SHARPEST: Final = 1e-4  # [m] least standard deviation of external positions
THROWN: Final = 1.5  # [m] a position farther from the estimate throws it in flight,
THROWN_TURN: Final = 2.0  # yaw by which it is thrown [rad]
SEEN_TURN: Final = 0.5  # share of a wrong yaw in the estimate: roll and pitch are corrected for the rest


class KalmanGains:
    """Gains of a Kalman filter of position and velocity along one axis."""

    def __init__(self, noise: float) -> None:
        """`noise`: spectral density of the acceleration [m²/s³]."""
        self._noise = noise
        self.reset()

    def reset(self) -> None:
        """Covariance of an unknown position, at rest."""
        self._place, self._mixed = LOST, 0.0  # [m²], [m²/s]
        self._speed = SLOW  # [m²/s²]

    def predict(self, dt: float) -> None:
        """Let the covariance grow for dt [s] without a position."""
        self._place = min(self._place + dt * (2.0 * self._mixed + dt * self._speed), LOST)
        self._mixed += dt * self._speed
        self._speed += dt * self._noise

    def correct(self, sigma: float) -> tuple[float, float]:
        """Gains of position and of velocity [1/s] for a position of the standard deviation `sigma` [m]."""
        whole = self._place + sigma * sigma
        gain, speed_gain = self._place / whole, self._mixed / whole
        self._speed -= speed_gain * self._mixed
        self._place, self._mixed = (1.0 - gain) * self._place, (1.0 - gain) * self._mixed
        return gain, speed_gain


class Estimator:
    """Estimator of position and yaw, by its errors: estimate minus truth.

    Positions from outside enter a Kalman filter with the firmware's noise, which an accelerometer drives. Late ones
    make it ring, the same one again holds it, and without any it integrates the errors of accelerometer and attitude.
    The other systems measure the truth without delay.
    """

    def __init__(self, error: Vector, turn: float, accelerometer: float) -> None:
        """See `reset`; `accelerometer`: constant error of its vertical axis [m/s²]."""
        self.external = ZERO  # last external position [m]
        self.received = 0  # number of external positions
        self._accelerometer = accelerometer
        self._external_time = -inf
        self._horizontal, self._vertical = KalmanGains(HORIZONTAL_NOISE), KalmanGains(VERTICAL_NOISE)
        self.reset(error, turn)

    def reset(self, error: Vector, turn: float, velocity: Vector = ZERO) -> None:
        """Restart at rest with an error of the position [m] and of the yaw [rad]; true `velocity` [m/s]."""
        self.error, self.variance, self.turn = error, LOST, turn  # variance per axis [m²]
        self.rate = difference(ZERO, velocity)  # error of the velocity [m/s]
        self._horizontal.reset()
        self._vertical.reset()

    def add_external(self, t: float, position: Vector, truth: Vector, sigma: float) -> float:
        """Add an external position [m] of a drone at `truth` [m]; returns its distance from the estimate [m].

        `sigma`: standard deviation that the estimator assumes [m].
        """
        self.external, self._external_time = position, t
        self.received += 1
        (x, y, z), (u, v, w) = self.error, self.rate
        off_x, off_y, off_z = off = difference(difference(position, truth), self.error)
        gain, speed_gain = self._horizontal.correct(sigma)
        gain_z, speed_gain_z = self._vertical.correct(sigma)
        self.error = x + gain * off_x, y + gain * off_y, z + gain_z * off_z
        self.rate = u + speed_gain * off_x, v + speed_gain * off_y, w + speed_gain_z * off_z
        return norm(off)

    def advance(self, t: float, dt: float, moved: Vector, *, ready: bool, flow: bool, flying: bool) -> None:
        """Advance one step of dt [s].

        Args:
            t: Current time [s].
            dt: [s].
            moved: True acceleration [m/s²].
            ready: A positioning system on board works.
            flow: A Flow deck measures velocity and height, so an error of the place stays.
            flying: In the air, without measurements, the error of the attitude is integrated.
        """
        measured = ready or t - self._external_time <= FRESH_S
        share = 1.0 - exp(-dt / SETTLING_S)
        x, y, z = self.error
        if ready or flow:
            to_x, to_y, to_z = (-share * x, -share * y, -share * z) if ready else (0.0, 0.0, -share * z)
            self.error, self.rate = (x + to_x, y + to_y, z + to_z), (to_x / dt, to_y / dt, to_z / dt)
        else:
            u, v, w = self.rate
            drift_x, drift_y = DRIFT if flying and not measured else (0.0, 0.0)
            if self.turn != 0.0:  # accelerations are turned by a wrong yaw
                c, s = cos(SEEN_TURN * self.turn), sin(SEEN_TURN * self.turn)
                a, b, _ = moved
                drift_x, drift_y = drift_x + c * a - s * b - a, drift_y + s * a + c * b - b
            self.rate = u, v, w = u + dt * drift_x, v + dt * drift_y, w + dt * self._accelerometer
            self.error = x + dt * u, y + dt * v, z + dt * w
            self._horizontal.predict(dt)
            self._vertical.predict(dt)
        if measured:
            self.variance += share * (PRECISE - self.variance)
        elif not flow:
            self.variance = min(self.variance + GROWTH * dt, LOST)


# voltage [V] of a battery at rest by charge, in steps of 10 %: the curve from which the firmware gives pm.batteryLevel
VOLTS: Final = (3.0, 3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.0, 4.04, 4.1, 4.2)
SAG_V: Final = 0.3  # drop under the load of hovering: 2 A through 0.15 ohm
LOW_V: Final = 3.2  # the firmware's own threshold
LOW_S: Final = 5.0  # time from the first voltage below it to the state "low"
IMPACT: Final = 4.2  # [m/s] a robot that hits the floor faster (a fall of 0.9 m) ends on its side
SKATING: Final = 2.0  # [m/s] largest speed of that
TRIM: Final = (radians(0.4), radians(-0.3))  # roll, pitch of a robot at rest [rad]: none is exactly level
STEEPEST_ACCELERATION: Final = GRAVITY * tan(STEEPEST)  # [m/s²] horizontal
LEANING_S: Final = 0.05  # time constant of the attitude
ENOUGH_ANCHORS: Final = 4  # anchors for three dimensions and a common clock


class Battery:
    """Battery, under load while the motors turn."""

    def __init__(self, model: Quadrotor, faults: Faults, dt: float) -> None:
        self.charge = faults.battery  # 0 to 1
        self._model, self._t = model, 0.0
        self._low_since = inf  # [s]
        self._drain = dt * faults.drain / CRAZYFLIE.endurance_s

    def advance(self, t: float) -> None:
        """Drain by one step until `t` [s]."""
        self._t = t
        if self._model.flying:
            self.charge = max(self.charge - self._drain, 0.0)
        self._low_since = min(self._low_since, t) if self.volts < LOW_V else inf

    @property
    def volts(self) -> float:
        """Voltage [V]; under load it sags."""
        tenths = 10.0 * self.charge
        step = min(int(tenths), len(VOLTS) - 2)
        return VOLTS[step] + (tenths - step) * (VOLTS[step + 1] - VOLTS[step]) - SAG_V * self._model.flying

    @property
    def level(self) -> int:
        """Log variable pm.batteryLevel [%], in steps of 10."""
        return 10 * bisect_left(VOLTS, self.volts, hi=len(VOLTS) - 2)

    @property
    def power(self) -> Power:
        """State of the power management."""
        if self.charge <= 0.0:
            return Power.SHUTDOWN
        return Power.LOW if self._t - self._low_since > LOW_S else Power.BATTERY


class Decks:
    """Decks, with the memories that they bring; positioning on board needs their contents."""

    def __init__(self, settings: CrazyflieSettings) -> None:
        self.lighthouse = isinstance(settings.positioning, Lighthouse)
        self.loco = isinstance(settings.positioning, Loco)
        self.multiranger, self.flow = settings.multiranger, settings.positioning is None
        self.occluded = False  # no positioning system on board receives anything
        boards = {
            "bcLighthouse4": self.lighthouse, "bcDWM1000": self.loco, "bcMultiranger": self.multiranger,
            "bcFlow2": self.flow,
        }  # fmt: skip
        self.memories = Memories([board for board, present in boards.items() if present])

    @property
    def station_status(self) -> int:
        """Log variable lighthouse.status: 0 nothing received, 1 geometry or calibration missing, 2 measuring."""
        if not self.lighthouse or self.occluded:
            return 0
        return 2 if self.memories.geometries & self.memories.calibrations else 1

    @property
    def ready(self) -> bool:
        """Whether a positioning system on board works."""
        anchored = self.loco and len(self.memories.anchors()) >= ENOUGH_ANCHORS
        return self.station_status == 2 or (anchored and not self.occluded)


class Vehicle:
    """Vehicle of a Crazyflie; its protocol is a `bridges.crazyflie.twin.drone.Drone`."""

    def __init__(self, request: BodyRequest, faults: Faults, row: int) -> None:
        """Raises BodyError for invalid settings."""
        name, seed, kind = request.names[row], request.seeds[row], request.kinds[row]
        disturbance, yaw = request.disturbance[row], request.yaw[row]
        self.settings = settings = chosen(name, request.device[row], external=request.external[row])
        self.row, self.dt = row, 1.0 / request.rate_hz  # tick [s]
        self.t = 0.0  # current time [s]
        self.model = Quadrotor(kind, request.start[row], yaw)  # `held` is its true position without hover jitter
        self.model.blow(disturbance.wind or (0.0, 0.0))
        self._jitter = HoverJitter(disturbance, name, seed, self.dt)
        self._measurement = MeasurementNoise(disturbance, name, seed, spatial=True)
        self._latency = Latency(disturbance, self.dt)
        self.decks = Decks(settings)
        self._faults, self._fault_tumbled = faults, False
        self.supervisor = Supervisor(auto_arm=not (faults.refuse_arming or settings.platform == "brushless"))
        self.battery = Battery(self.model, faults, self.dt)
        self.vertical = VerticalLoops(settings.platform, self.dt)
        flight = CRAZYFLIE.motion
        assert isinstance(flight, Flight)
        self._gain = flight.position
        self._speed_gain, self._limit = flight.velocity[0], flight.speed[0]
        self.planner, self.commander = OnboardPlanner(), Commander(flight, kind.turn_response)
        # it believes to be where it was switched on, and to look along x
        accelerometer = 1e-3 * GRAVITY * faults.accelerometer_mg
        self.estimator = Estimator(difference(ZERO, self.model.held), -yaw, accelerometer)
        self.place = self.model.held  # true position [m]
        self.estimate = ZERO  # reported position [m]
        self.velocity = ZERO  # reported [m/s]
        self.acceleration = ZERO  # [m/s²]
        self.attitude = TRIM  # roll to the right, pitch nose up [rad]

    @property
    def pose(self) -> Array:
        """Estimated pose (4,): x, y, z [m], yaw [rad]."""
        return np.array([*self._believed, self.yaw])

    @property
    def yaw(self) -> float:
        """Estimated yaw [rad]."""
        return self.model.yaw + self.estimator.turn

    @property
    def _believed(self) -> Vector:
        """Estimated position, without noise [m]."""
        (x, y, z), (dx, dy, dz) = self.model.held, self.estimator.error
        return x + dx, y + dy, z + dz

    @property
    def info(self) -> Info:
        """Flags of supervisor and planner."""
        info = self.supervisor.info
        if self.planner.plan != PlannerState.IDLE:
            info |= Info.PLANNER_ACTIVE
        if self.planner.finished(self.t):
            info |= Info.PLANNER_FINISHED
        return info

    def arm(self, *, on: bool) -> bool:
        """Arm or disarm; False if refused."""
        if on and self._faults.refuse_arming:
            return False
        done = self.supervisor.arm(self.t, on=on)
        if not on:
            self.planner.stop()
            self.commander.stop()
        return done

    def locate(self, position: Vector, sigma: float) -> None:
        """Take an external position [m] of the standard deviation `sigma` [m].

        In flight one that is far from the estimate throws its attitude: it turns the drone over.
        """
        far = self.estimator.add_external(self.t, position, self.place, max(sigma, SHARPEST)) > THROWN
        if far and self.model.flying and self.place[2] > 0.0:
            self.estimator.turn += THROWN_TURN
            self.supervisor.tumbled = True

    def restart(self) -> None:
        """Switch off and on: motors off, estimator at its start."""
        self.planner.stop()
        self.commander.stop()
        self.supervisor.restart()
        self.model.stop()
        self.estimator.reset(difference(ZERO, self.model.held), -self.model.yaw)

    def advance(self, t: float) -> bool:
        """Advance to time `t` [s] by steps of dt; returns whether it was locked or crashed on the way."""
        locked = False
        for now in instants(self.t, t, self.dt) or [t]:
            locked |= self._step(now)
        return locked

    def _step(self, t: float) -> bool:
        self.t = t
        model, commander, supervisor, dt = self.model, self.commander, self.supervisor, self.dt
        if self._faults.tumbled(t) != self._fault_tumbled:
            supervisor.tumbled = self._fault_tumbled = not self._fault_tumbled
        self.decks.occluded = self._faults.occluded(t)
        commander.take_planned(t, self.planner.goal(t))
        locked = supervisor.advance(t, t - commander.received, spinning=model.flying)
        if locked:
            self.planner.stop()
        model.flying = commander.on and supervisor.may_fly and self.battery.charge > 0.0
        believed = commander.model_setpoint(self._believed, model.velocity, self.yaw, level=supervisor.level)
        setpoint = self._true_setpoint(believed)
        delayed = self._latency.delay(setpoint)
        model.command(delayed)
        before, place = model.velocity, model.held
        model.move(dt)
        if model.flying:
            self._steer(before, place, delayed)
        else:
            self.vertical.reset()
        self._touch_floor(before, place, setpoint)
        self._update_attitude(before)
        x, y, z = model.held
        if self._jitter.present:
            dx, dy = self._jitter.advance(z)
            x, y = x + dx, y + dy
        moved, self.place = difference((x, y, z), self.place), (x, y, z)
        self.battery.advance(t)
        self.estimator.advance(
            t, dt, self.acceleration, ready=self.decks.ready, flow=self.decks.flow, flying=model.flying
        )
        if self._measurement.present:
            dx, dy, dz, _ = self._measurement.draw()
            x, y, z = x + dx, y + dy, z + dz
        refill(self._jitter.noise, self._measurement.noise)
        wrong_x, wrong_y, wrong_z = self.estimator.error
        self.estimate = x + wrong_x, y + wrong_y, z + wrong_z
        u, v, w = self.estimator.rate
        self.velocity = moved[0] / dt + u, moved[1] / dt + v, moved[2] / dt + w
        return locked

    def _steer(self, before: Vector, place: Vector, target: Setpoint) -> None:
        """Move vertically, from a velocity [m/s] and place [m] before the step toward a target [m]; NaN: stay.

        The controller takes what the estimate does not see of the horizontal velocity for none, and turns its
        accelerations by a wrong yaw.
        """
        model, estimator = self.model, self.estimator
        u, v, w = estimator.rate
        offset = 0.0 if isnan(target[2]) else target[2] - place[2]
        wanted = self._gain[2] * offset if isnan(self.commander.target[2]) else None
        acceleration = self.vertical.advance(offset, before[2] + w, wanted, self.commander.thrust)
        (x, y, _), (v_x, v_y, _) = model.held, model.velocity
        speed = before[2] + self.dt * acceleration
        model.held = x, y, place[2] + self.dt * speed
        share = self.dt * self._speed_gain
        more_x, more_y = -u, -v
        if estimator.turn != 0.0 and not isnan(target[0]):
            c, s = cos(estimator.turn), sin(estimator.turn)
            a = clamp(self._gain[0] * (target[0] - place[0]), -self._limit, self._limit) - before[0]
            b = clamp(self._gain[1] * (target[1] - place[1]), -self._limit, self._limit) - before[1]
            more_x, more_y = c * (a - u) + s * (b - v) - a, c * (b - v) - s * (a - u) - b
        most = self.dt * STEEPEST_ACCELERATION
        more_x = clamp(v_x + share * more_x - before[0], -most, most)
        more_y = clamp(v_y + share * more_y - before[1], -most, most)
        model.velocity = before[0] + more_x, before[1] + more_y, speed

    def _true_setpoint(self, setpoint: Setpoint) -> Setpoint:
        """Setpoint of position and yaw as it is flown: the controller uses the estimate, not the truth."""
        (wrong_x, wrong_y, wrong_z), (x, y, z, yaw) = self.estimator.error, setpoint
        return x - wrong_x, y - wrong_y, z - wrong_z, yaw - self.estimator.turn

    def _touch_floor(self, before: Vector, place: Vector, setpoint: Setpoint) -> None:
        """Stop at the floor; a drone that hits it hard, with `before` [m/s], ends on its side.

        If the motors still carry much of the weight, it slides from its `place` [m] toward `setpoint`, as its estimate
        leads.
        """
        model, dt = self.model, self.dt
        height = model.held[2]
        self.supervisor.tumbled |= height <= 0.0 and before[2] < -IMPACT
        if height >= 0.0:
            return
        x, y = place[0], place[1]
        v_x, v_y = 0.0, 0.0
        if model.flying and self.vertical.sliding:
            wanted_x = clamp(self._gain[0] * (setpoint[0] - x), -SKATING, SKATING)
            wanted_y = clamp(self._gain[1] * (setpoint[1] - y), -SKATING, SKATING)
            share = dt * self._speed_gain
            v_x, v_y = before[0] + share * (wanted_x - before[0]), before[1] + share * (wanted_y - before[1])
        model.velocity, model.held = (v_x, v_y, 0.0), (x + dt * v_x, y + dt * v_y, 0.0)

    def _update_attitude(self, before: Vector) -> None:
        """Attitude that gives the acceleration from `before` [m/s] on, with a lag."""
        (v_x, v_y, v_z), dt = self.model.velocity, self.dt
        moved = (v_x - before[0]) / dt, (v_y - before[1]) / dt, (v_z - before[2]) / dt
        self.acceleration = x, y, z = moved if self.model.flying else ZERO
        c, s = cos(self.model.yaw), sin(self.model.yaw)
        lift = GRAVITY + z
        share, (roll, pitch) = 1.0 - exp(-dt / LEANING_S), self.attitude
        wanted_roll, wanted_pitch = TRIM[0] + atan2(s * x - c * y, lift), TRIM[1] - atan2(c * x + s * y, lift)
        self.attitude = roll + share * (wanted_roll - roll), pitch + share * (wanted_pitch - pitch)
