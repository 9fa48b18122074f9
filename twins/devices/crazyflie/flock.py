"""What moves: the rows of Crazyflies of one process, their motion, estimate, battery and on-board logic."""

from __future__ import annotations

from typing import Final

import numpy as np

from agents.arrays import Array, Mask
from agents.body.external_pose import velocity_after
from agents.body.interface import BodyRequest
from agents.protocols.crazyflie import Lighthouse, Loco, Outside, chosen
from agents.protocols.crtp import Info, Power
from twins.body import CATCH_UP_S, ENDURANCE_S, FULL_WOBBLE
from twins.devices.crazyflie.commander import Commander
from twins.devices.crazyflie.memory import Memories
from twins.devices.crazyflie.planner import Plan, Planner
from twins.devices.crazyflie.supervisor import Supervisor
from twins.devices.device import Faults
from twins.models.disturbance import HoverJitter, Latency, Measurement
from twins.models.noise import Noise
from twins.models.quadrotor import RESPONSES, Quadrotor

SETTLING_S: Final = 0.1  # time constant with which measurements pull the estimate and its variance
PRECISE: Final = 1e-5  # [m²] variance that is reached
LOST: Final = 100.0  # [m²] variance after a reset
GROWTH: Final = 1.0  # [m²/s] of the variance without measurements
FRESH_S: Final = 0.5  # an external position older than this says nothing any more


class Estimator:
    """Estimators of N rows.

    Attributes:
        error: (N, 3) estimate less truth [m].
        variance: (N,) of the estimate, per axis [m²].
        external: (N, 3) the last position that came from outside [m].
        received: (N,) how many came.
    """

    def __init__(self, rows: int) -> None:
        self.error = np.zeros((rows, 3))
        self.variance = np.full(rows, LOST)
        self.external = np.zeros((rows, 3))
        self.received = np.zeros(rows, dtype=np.intp)
        self._heard = np.full(rows, -np.inf)

    def reset(self, row: int, error: Array) -> None:
        """Begins anew with the estimate that far (3,) from the truth."""
        self.error[row], self.variance[row] = error, LOST

    def hear(self, row: int, t: float, position: tuple[float, float, float]) -> None:
        """A position from outside."""
        self.external[row], self._heard[row] = position, t
        self.received[row] += 1

    def advance(self, t: float, dt: float, truth: Array, ready: Mask) -> None:
        """One step of dt [s]; `ready` (N,) rows have a positioning system on board that works."""
        outside = t - self._heard <= FRESH_S
        share = -np.expm1(-dt / SETTLING_S)
        wanted = np.where(ready[:, None], 0.0, self.external - truth)
        measured = ready | outside
        self.error += np.where(measured[:, None], share * (wanted - self.error), 0.0)
        settled = self.variance + share * (PRECISE - self.variance)
        self.variance = np.where(measured, settled, np.minimum(self.variance + GROWTH * dt, LOST))


FULL_V: Final = 4.2
EMPTY_V: Final = 3.0
LOW_V: Final = 3.2  # the firmware's own threshold
ENOUGH_ANCHORS: Final = 4  # three dimensions and a common clock


class Flock:
    """Rows of Crazyflies; the protocol of each is a `twins.devices.crazyflie.drone.Drone`.

    Attributes:
        planner, commander, supervisor, estimator: On-board logic of the rows.
        quadrotor: Their motion.
        memories: Of each row.
        charge: (N,) of the batteries, 0 to 1.
        place: (N, 3) where they are [m].
        estimate: (N, 3) where they say to be [m].
        velocity: (N, 3) that they say, from what they measure [m/s].
        dt: Of a tick [s].
        t: Now [s].
    """

    def __init__(self, request: BodyRequest, faults: Faults) -> None:
        rows = len(request.names)
        self.dt = 1.0 / request.rate_hz
        self.t = 0.0
        settings = [
            chosen(name, device, external=external)
            for name, device, external in zip(request.names, request.device, request.external, strict=True)
        ]
        self.lighthouse = [isinstance(each.positioning, Lighthouse) for each in settings]
        self.loco = [isinstance(each.positioning, Loco) for each in settings]
        self.multiranger = [each.multiranger for each in settings]
        outside = np.array([isinstance(each.positioning, Outside) for each in settings])
        self._on_board = ~(outside | np.array(self.lighthouse) | np.array(self.loco))
        by_hand = [faults.refuse_arming or each.platform == "brushless" for each in settings]
        self.refuse_arming = faults.refuse_arming
        self.planner = Planner(rows)
        self.commander = Commander(rows)
        self.supervisor = Supervisor(~np.array(by_hand))
        self.estimator = Estimator(rows)
        self.quadrotor = Quadrotor(request.kinds, request.start, request.yaw, self.dt)
        self.memories = [Memories() for _ in range(rows)]
        self.charge = np.full(rows, faults.battery)
        self._drain = self.dt * faults.drain / ENDURANCE_S["crazyflie"]
        spatial = np.ones((rows, 3))
        noise = Noise(request.names, request.seeds, "measurement", 4)
        self._measurement = Measurement(request.disturbance, spatial, noise)
        wobble = Noise(request.names, request.seeds, "hover jitter", 2)
        self._jitter = HoverJitter(request.disturbance, wobble, self.dt)
        self._latency = Latency(request.disturbance, self.dt)
        response, kind = RESPONSES["crazyflie"], request.kinds[0]
        self._gain, self._turn_gain = np.array(response.position), kind.turn_response
        self.estimator.error[~self._on_board] = -self.quadrotor.position[~self._on_board]
        self.place = self.quadrotor.position.copy()
        self.estimate = self.place + self.estimator.error
        self.velocity = np.zeros((rows, 3))
        self._seen = self.place

    def pose(self, row: int) -> Array:
        """(4,) where a row believes to be: x, y, z [m], yaw [rad]."""
        return np.append(self.quadrotor.position[row] + self.estimator.error[row], self.quadrotor.yaw[row])

    def voltage(self, row: int) -> float:
        """Of a row's battery [V]."""
        return EMPTY_V + (FULL_V - EMPTY_V) * float(self.charge[row])

    def power(self, row: int) -> Power:
        """What a row's power management says."""
        if self.charge[row] <= 0.0:
            return Power.SHUTDOWN
        return Power.LOW if self.voltage(row) < LOW_V else Power.BATTERY

    def info(self, row: int) -> Info:
        """What a row's supervisor says."""
        info = self.supervisor.info(row)
        if self.planner.plan[row] != Plan.IDLE:
            info |= Info.PLANNER_ACTIVE
        if self.planner.finished(self.t)[row]:
            info |= Info.PLANNER_FINISHED
        return info

    def station_status(self, row: int) -> int:
        """Log variable lighthouse.status: 0 nothing received, 1 geometry or calibration missing, 2 measuring."""
        if not self.lighthouse[row]:
            return 0
        memories = self.memories[row]
        return 2 if memories.geometries & memories.calibrations else 1

    def ready(self) -> Mask:
        """(N,) rows whose positioning system on board works."""
        working = self._on_board.copy()
        for row, memories in enumerate(self.memories):
            if self.lighthouse[row]:
                working[row] = self.station_status(row) == 2
            elif self.loco[row]:
                working[row] = len(memories.anchors()) >= ENOUGH_ANCHORS
        return np.asarray(working)

    def arm(self, row: int, *, on: bool) -> bool:
        """An arming request."""
        if on and self.refuse_arming:
            return False
        return self.supervisor.arm(row, self.t, on=on)

    def advance(self, t: float) -> Mask:
        """On to time `t` [s], by steps of dt; returns (N,) which rows have been locked on the way."""
        steps = max(1, round((t - self.t) / self.dt))
        if steps * self.dt > CATCH_UP_S:
            steps = 1
        locked = np.zeros(len(self.charge), dtype=bool)
        for left in range(steps - 1, -1, -1):
            locked |= self._step(t - left * self.dt)
        return locked

    def _step(self, t: float) -> Mask:
        self.t = t
        quadrotor, commander, supervisor = self.quadrotor, self.commander, self.supervisor
        commander.follow(t, self.planner.goal(t))
        locked = supervisor.advance(t, quadrotor.flying, commander.age(t))
        for row in np.flatnonzero(locked):
            self.planner.stop(int(row))
        quadrotor.stop(np.flatnonzero(quadrotor.flying & ~self._spinning()))
        quadrotor.flying[self._spinning()] = True
        setpoint = commander.wanted(
            quadrotor.position + self.estimator.error,
            quadrotor.velocity,
            quadrotor.yaw,
            level=supervisor.level,
            gain=self._gain,
            turn_gain=self._turn_gain,
        )
        setpoint[:, :3] -= self.estimator.error  # the controller flies the estimate, not the truth
        quadrotor.command(self._latency.pass_on(setpoint) if self._latency.present else setpoint)
        quadrotor.advance()
        self.place = quadrotor.position.copy()
        if self._jitter.present:
            self._jitter.advance()
            share = np.minimum(quadrotor.position[:, 2] / FULL_WOBBLE, 1.0)
            self.place[:, :2] += share[:, None] * self._jitter.displacement
        np.maximum(self.charge - self._drain * quadrotor.flying, 0.0, out=self.charge)
        self.estimator.advance(t, self.dt, self.place, self.ready())
        seen = self.place + self._measurement.draw()[:, :3] if self._measurement.present else self.place
        self.estimate = seen + self.estimator.error
        self.velocity, self._seen = velocity_after(self.velocity, seen - self._seen, self.dt), seen
        return locked

    def _spinning(self) -> Mask:
        """(N,) motors turn."""
        return np.asarray(self.commander.on & self.supervisor.may_fly & (self.charge > 0.0))
