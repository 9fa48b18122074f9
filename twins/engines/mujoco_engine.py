"""The MuJoCo engine: drones are rigid bodies on four motors, flown by the firmware's cascade, for whom attitude counts.

Every row is a simulation of its own of one small model, and one call advances them all: rows cannot disturb each
other, to the last bit, and the cost of a row does not grow with their number, as it does in one model of them all.
Drones touch the floor, the walls and the obstacles that no plan moves. They fly through each other and through ground
robots: for contacts among robots there is the engine `pymunk`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Final

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Index, Mask, clamp, norm, some
from agents.body.interface import BodyError
from agents.body.kinds import Kind
from twins.engines.crazyflie_cascade import RATE_HZ, Firmware
from twins.engines.engine import Stage
from twins.engines.mujoco_model import AIRFRAMES, mjcf
from twins.engines.point_mass import PointMassEngine
from twins.models.onboard_flight import Piloted
from twins.models.quadrotor import GRAVITY
from twins.scene import Scene

SUBSTEPS: Final = 2  # of MuJoCo in a step of the firmware
QUIET_S: Final = 0.1  # what lies still for so long with its motors off is not moved any more
STILL: Final = 0.005  # [m/s], and ten times that in rad/s
TIPPED: Final = 0.5  # cosine of the tilt from which a drone does not take off, as the firmware's supervisor has it
# the loop follows a wandering estimate with less than its full size: at a correlation time of 0.5 s with this share
FOLLOWED: Final = 0.84
FULL_STATE: Final = 18  # time, then:
PLACE, TURN, SPEED, SPIN, LIFT = slice(1, 4), slice(4, 8), slice(8, 11), slice(11, 14), slice(14, 18)


class RigidBody(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Its parameters."""

    contacts: ClassVar[bool] = False

    motor_lag_s: Annotated[float, Meta(ge=0.01, le=0.1, description="time constant of a motor's thrust [s]")] = 0.03

    def build(self, stage: Stage) -> RigidBodyEngine:
        """See `EngineFactory.build`."""
        return RigidBodyEngine(stage, self.motor_lag_s)


class RigidBodyEngine(PointMassEngine):
    """Implements `twins.engines.engine.Engine`; ground robots are those of the point-mass engine."""

    def __init__(self, stage: Stage, motor_lag: float) -> None:
        """`motor_lag` is the time constant of a motor's thrust [s].

        Raises:
            BodyError: For a kind without a twin, or if MuJoCo is not installed.
        """

        def drones(kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> Drones:
            self._drones = Drones(kinds, start, yaw, dt, scene=stage.scene, motor_lag=motor_lag)
            return self._drones

        super().__init__(stage, drones)
        self._lean()

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """See `Engine.place`."""
        super().place(rows, position, yaw, flying)
        self._lean()

    def advance(self, t: float, wobble: Array) -> None:
        """See `Engine.advance`."""
        super().advance(t, wobble)
        self._lean()

    def _fly(self, wobble: Array) -> None:
        """The wobble is an error of the drones' own estimate of where they are: they really fly it."""
        self._drones.wander(wobble[self.air])
        self._drones.advance()
        self._adopt()

    def _lean(self) -> None:
        self.attitude = _upright(self.yaw)
        self.attitude[self.air] = self._drones.attitude
        self.attitude[self._mirrored] = _upright(self.yaw[self._mirrored])


class Drones(Piloted):
    """Rows of rigid quadrotors; implements `twins.engines.point_mass.Flight`.

    Attributes:
        position: (n, 3) of the centre of mass, over where it is when standing on the floor [m].
        velocity: (n, 3) [m/s].
        yaw: (n,) [rad], without jumps.
        attitude: (n, 4) unit quaternion w, x, y, z from robot to room.
        thrust: (n, 4) of each motor [N].
        flying: (n,) motors on.
    """

    def __init__(
        self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float, *, scene: Scene, motor_lag: float
    ) -> None:
        """Steps of `dt` [s] are divided for the firmware so that it runs at its own rate or faster.

        Raises:
            BodyError: If MuJoCo is not installed.
        """
        try:
            import mujoco  # noqa: PLC0415 - an extra
            from mujoco import rollout  # noqa: PLC0415
        except ImportError:
            raise BodyError(
                "the engine mujoco needs a library that is an extra: ./zenpark install mujoco-core, or "
                "pip install -e '.[mujoco]'"
            ) from None
        super().__init__(kinds, start, yaw, dt)
        rows = len(kinds)
        self._ticks = max(1, math.ceil(dt * RATE_HZ - 1e-6))
        self._dt = dt / self._ticks
        frames = [AIRFRAMES[kind.name] for kind in kinds]
        step = self._dt / SUBSTEPS
        models = {frame: mujoco.MjModel.from_xml_string(mjcf(frame, scene, step, motor_lag)) for frame in frames}
        self._models = [models[frame] for frame in frames]
        self._data = [mujoco.MjData(model) for model in list(models.values())[:1]]
        self._rollout = rollout.Rollout(nthread=0)
        self._full = np.array([frame.thrust for frame in frames])[:, None]
        self._hover = np.array([0.25 * GRAVITY * frame.mass for frame in frames])
        self._speed = np.array([kind.speed for kind in kinds])[:, None]
        self._control = int(mujoco.mjtState.mjSTATE_CTRL.value)
        self._firmware = Firmware(rows, self._dt)
        self._state = np.zeros((rows, FULL_STATE))
        self._quiet = np.zeros(rows)  # for how long each has been still [s]
        self._wobble, self._drift = np.zeros((rows, 2)), np.zeros((rows, 2))
        self._angles = np.zeros((rows, 3))
        self._heading = np.array(yaw, dtype=float)
        self._put(np.arange(rows), start, yaw, self.flying)

    @property
    def attitude(self) -> Array:
        """See the class."""
        return self._state[:, TURN]

    @property
    def thrust(self) -> Array:
        """See the class."""
        return self._state[:, LIFT]

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Engine.takeoff`; what lies on its side or back stays there."""
        upright = self._up(rows) > TIPPED
        rows, height = rows[upright], height[upright]
        fresh = rows[~self.flying[rows]]
        self._firmware.reset(fresh)
        self._heading[fresh] = self.yaw[fresh]
        self._pilot.heading[fresh] = self.yaw[fresh]
        self._quiet[rows] = 0.0
        super().takeoff(rows, height)

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """See `Engine.place`."""
        self._pilot.place(rows, position, yaw, flying)
        self._firmware.reset(rows)
        aloft = rows[flying]
        self._firmware.trim(aloft, self._hover[aloft] / self._full[aloft, 0])
        self._put(rows, position, yaw, flying)

    def wander(self, wobble: Array) -> None:
        """By how much the drones are wrong about where they are, until the next step: (n, 2) [m]."""
        self._drift = (wobble - self._wobble) / (self._dt * self._ticks)
        self._wobble = wobble

    def advance(self) -> None:
        """One step of dt."""
        pilot, state = self._pilot, self._state
        climbing = pilot.climbing
        if some(climbing):
            pilot.advance(climbing)
        awake = np.flatnonzero(self.flying | (self._quiet < QUIET_S))
        if not len(awake):
            return
        alone = len(awake) < len(state)
        models = [self._models[row] for row in awake] if alone else self._models
        any_flies = some(self.flying)
        by_velocity = pilot.by_velocity & ~climbing
        target = pilot.target.copy()
        target[:, :2] += self._wobble / FOLLOWED
        wanted = clamp(pilot.wanted, -self._speed, self._speed)
        if pilot.any_by_velocity:
            wanted[:, :2] += self._drift
        force = np.zeros((len(state), 4))
        for _ in range(self._ticks):
            if any_flies:
                force = self._flown(target, wanted, by_velocity)
            before = state[awake] if alone else state
            control = np.repeat((force[awake] if alone else force)[:, None], SUBSTEPS, axis=1)
            path = np.empty((len(awake), SUBSTEPS, FULL_STATE))
            self._rollout.rollout(
                models, self._data, before, control, control_spec=self._control, skip_checks=True, nstep=SUBSTEPS,
                state=path, sensordata=np.empty((len(awake), SUBSTEPS, 0)),
            )  # fmt: skip
            state[awake] = path[:, -1]
            self._see()
        self._settle()

    def _flown(self, target: Array, wanted: Array, by_velocity: Mask) -> Array:
        """(n, 4) thrust that the firmware asks of each motor [N]."""
        state, pilot, firmware = self._state, self._pilot, self._firmware
        self._heading = np.where(by_velocity, self._heading + self._dt * pilot.yaw_rate, pilot.heading)
        firmware.guide(target - state[:, PLACE], state[:, SPEED], wanted, by_velocity, self.yaw)
        share = firmware.motors(self._angles, state[:, SPIN], self._heading)
        return np.where(self.flying[:, None], self._full * share, 0.0)

    def _see(self) -> None:
        """Roll, pitch (nose down) and yaw of each row; yaw goes on where it would jump."""
        w, x, y, z = self._state[:, TURN].T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        self.yaw = yaw + 2.0 * np.pi * np.round((self.yaw - yaw) / (2.0 * np.pi))
        roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        self._angles = np.stack([roll, np.arcsin(clamp(2.0 * (w * y - z * x), -1.0, 1.0)), self.yaw], axis=1)

    def _settle(self) -> None:
        """Touchdown, and rest."""
        state = self._state
        self.position, self.velocity = state[:, PLACE].copy(), state[:, SPEED].copy()
        self._pilot.touch_down(self.position[:, 2])
        if some(self.flying):
            # what is on its back flies no more: the firmware's supervisor switches off
            over = np.flatnonzero(self.flying & (self._up(slice(None)) < 0.0))
            if len(over):
                self._pilot.stop(over)
        moving = self.flying | (norm(state[:, SPEED]) > STILL) | (norm(state[:, SPIN]) > 10.0 * STILL)
        self._quiet = np.where(moving, 0.0, self._quiet + self._dt * self._ticks)
        if some(rests := self._quiet >= QUIET_S):
            state[rests, SPEED] = state[rests, SPIN] = 0.0
            self.velocity[rests] = 0.0

    def _up(self, rows: Index | slice) -> Array:
        """Cosine of the tilt."""
        turn = self._state[rows, TURN]
        return np.asarray(1.0 - 2.0 * (turn[:, 1] ** 2 + turn[:, 2] ** 2))

    def _put(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        state = self._state
        state[rows] = 0.0
        state[rows, PLACE], state[rows, TURN] = position, _upright(yaw)
        state[rows, LIFT] = np.where(flying, self._hover[rows], 0.0)[:, None]
        self._quiet[rows] = 0.0
        self.yaw[rows] = self._heading[rows] = yaw
        self.position, self.velocity = state[:, PLACE].copy(), state[:, SPEED].copy()
        self._see()


def _upright(yaw: Array) -> Array:
    """(n, 4) quaternions of rows that stand upright."""
    zero = np.zeros(len(yaw))
    return np.stack([np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw)], axis=1)
