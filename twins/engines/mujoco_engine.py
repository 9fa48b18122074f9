"""MuJoCo engine: drones are rigid bodies on four motors, controlled by the firmware's cascade; attitude is simulated.

Every row is a simulation of its own small model, and one call advances all: rows are independent to the last bit, and
the cost of a row does not grow with their number, as in one model of all. Drones touch the floor, the walls and the
obstacles without a plan. They fly through each other and through ground robots: contacts among robots are simulated by
the engine `pymunk`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
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
from twins.models.onboard_flight import OnboardFlight
from twins.models.quadrotor import GRAVITY
from twins.scene import Scene

SUBSTEPS: Final = 2  # of MuJoCo in a step of the firmware
QUIET_S: Final = 0.1  # a drone at rest for so long with its motors off is no longer simulated
AT_REST: Final = 0.005  # [m/s], and ten times that in rad/s
TIPPED: Final = 0.5  # cosine of the largest tilt for a take-off, as in the firmware's supervisor
# the loop follows a random error of the estimate in part: with this share at a correlation time of 0.5 s
TRACKED_SHARE: Final = 0.84
FULL_STATE: Final = 18  # time, then:
PLACE, TURN, SPEED, SPIN, LIFT = slice(1, 4), slice(4, 8), slice(8, 11), slice(11, 14), slice(14, 18)


class RigidBody(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the MuJoCo engine."""

    contacts: ClassVar[bool] = False

    motor_lag_s: Annotated[float, Meta(ge=0.01, le=0.1, description="time constant of a motor's thrust [s]")] = 0.03

    def build(self, stage: Stage) -> RigidBodyEngine:
        return RigidBodyEngine(stage, self.motor_lag_s)


class RigidBodyEngine(PointMassEngine):
    """Implements `twins.engines.engine.Engine`; ground robots are those of the point-mass engine."""

    quadrotor: Drones

    def __init__(self, stage: Stage, motor_lag: float) -> None:
        """`motor_lag`: of a thrust [s]; raises BodyError for a kind without a twin, or without MuJoCo."""
        super().__init__(stage, partial(Drones, scene=stage.scene, motor_lag=motor_lag))
        self._update_attitude()

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        super().place(rows, position, yaw, flying)
        self._update_attitude()

    def advance(self, t: float, wobble: Array) -> None:
        super().advance(t, wobble)
        self._update_attitude()

    def _fly(self, wobble: Array) -> None:
        """Advance flying rows by one step; hover jitter is an error of the drones' own estimate, which they follow."""
        self.quadrotor.set_position_error(wobble[self.air])
        self.quadrotor.advance()
        self._copy_flight_state()

    def _update_attitude(self) -> None:
        self.attitude = _upright_quaternions(self.yaw)
        self.attitude[self.air] = self.quadrotor.attitude
        self.attitude[self._mirrored] = _upright_quaternions(self.yaw[self._mirrored])


class Drones(OnboardFlight):
    """N rigid quadrotors.

    Heights are those of the centre of mass relative to standing on the floor [m]; yaw has no jumps.
    """

    def __init__(
        self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float, *, scene: Scene, motor_lag: float
    ) -> None:
        """Steps of `dt` [s] are divided for the firmware's rate; raises BodyError without MuJoCo or an airframe."""
        try:
            import mujoco  # noqa: PLC0415 - an extra
            from mujoco import rollout  # noqa: PLC0415
        except ImportError:
            raise BodyError(
                "the engine mujoco needs an extra library: ./zenpark install mujoco-core, or pip install -e '.[mujoco]'"
            ) from None
        super().__init__(kinds, start, yaw, dt)
        rows = len(kinds)
        self._ticks = max(1, math.ceil(dt * RATE_HZ - 1e-6))
        self._period = dt / self._ticks
        if unknown := sorted({kind.name for kind in kinds} - AIRFRAMES.keys()):
            remedy = "add it to AIRFRAMES in twins/engines/mujoco_model.py (docs/plugins.md), or choose another engine"
            raise BodyError(f"the engine mujoco has no airframe of {', '.join(map(repr, unknown))}; {remedy}")
        frames = [AIRFRAMES[kind.name] for kind in kinds]
        step = self._period / SUBSTEPS
        models = {frame: mujoco.MjModel.from_xml_string(mjcf(frame, scene, step, motor_lag)) for frame in frames}
        self._models = [models[frame] for frame in frames]
        self._data = [mujoco.MjData(model) for model in list(models.values())[:1]]
        self._rollout = rollout.Rollout(nthread=0)
        self._full = np.array([frame.thrust for frame in frames])[:, None]
        self._hover = np.array([0.25 * GRAVITY * frame.mass for frame in frames])
        self._speed = np.array([kind.speed for kind in kinds])[:, None]
        self._control = int(mujoco.mjtState.mjSTATE_CTRL.value)
        self._firmware = Firmware(rows, self._period)
        self._state = np.zeros((rows, FULL_STATE))
        self._quiet = np.zeros(rows)  # for how long each has been still [s]
        self._wobble, self._drift = np.zeros((rows, 2)), np.zeros((rows, 2))
        self._angles = np.zeros((rows, 3))
        self._heading = np.array(yaw, dtype=float)
        self._set_state(np.arange(rows), start, yaw, self.flying)

    @property
    def attitude(self) -> Array:
        """(n, 4) unit quaternion w, x, y, z from robot to world."""
        return self._state[:, TURN]

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Engine.takeoff`; no effect on a drone that lies on its side or back."""
        upright = self._tilt_cosine(rows) > TIPPED
        rows, height = rows[upright], height[upright]
        fresh = rows[~self.flying[rows]]
        self._firmware.reset(fresh)
        self._heading[fresh] = self.yaw[fresh]
        self._yaw_setpoint[fresh] = self.yaw[fresh]
        self._quiet[rows] = 0.0
        super().takeoff(rows, height)

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        super().place(rows, position, yaw, flying)
        self._firmware.reset(rows)
        aloft = rows[flying]
        self._firmware.preset_hover(aloft, self._hover[aloft] / self._full[aloft, 0])
        self._set_state(rows, position, yaw, flying)

    def set_position_error(self, wobble: Array) -> None:
        """Set the error of the drones' position estimates until the next step: (n, 2) [m]."""
        self._drift = (wobble - self._wobble) / (self._period * self._ticks)
        self._wobble = wobble

    def advance(self) -> None:
        state, climbing = self._state, self._climbing()
        if some(climbing):
            self._advance_climb(climbing)
        awake = np.flatnonzero(self.flying | (self._quiet < QUIET_S))
        if not len(awake):
            return
        alone = len(awake) < len(state)
        models = [self._models[row] for row in awake] if alone else self._models
        any_flies = some(self.flying)
        by_velocity = self._by_velocity & ~climbing
        target = self._target.copy()
        target[:, :2] += self._wobble / TRACKED_SHARE
        wanted = clamp(self._velocity_setpoint, -self._speed, self._speed)
        if self._any_by_velocity:
            wanted[:, :2] += self._drift
        force = np.zeros((len(state), 4))
        for _ in range(self._ticks):
            if any_flies:
                force = self._motor_forces(target, wanted, by_velocity)
            before = state[awake] if alone else state
            control = np.repeat((force[awake] if alone else force)[:, None], SUBSTEPS, axis=1)
            path = np.empty((len(awake), SUBSTEPS, FULL_STATE))
            self._rollout.rollout(
                models, self._data, before, control, control_spec=self._control, skip_checks=True, nstep=SUBSTEPS,
                state=path, sensordata=np.empty((len(awake), SUBSTEPS, 0)),
            )  # fmt: skip
            state[awake] = path[:, -1]
            self._update_angles()
        self._update_grounded()

    def _motor_forces(self, target: Array, wanted: Array, by_velocity: Mask) -> Array:
        """Thrust setpoints of the motors, by the firmware's cascade: (n, 4) [N]."""
        state, firmware = self._state, self._firmware
        self._heading = np.where(by_velocity, self._heading + self._period * self._yaw_rate, self._yaw_setpoint)
        firmware.advance_outer_loops(target - state[:, PLACE], state[:, SPEED], wanted, by_velocity, self.yaw)
        share = firmware.advance_inner_loops(self._angles, state[:, SPIN], self._heading)
        return np.where(self.flying[:, None], self._full * share, 0.0)

    def _update_angles(self) -> None:
        """Update roll, pitch (nose down) and yaw of each row; yaw without jumps."""
        w, x, y, z = self._state[:, TURN].T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        self.yaw = yaw + 2.0 * np.pi * np.round((self.yaw - yaw) / (2.0 * np.pi))
        roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        self._angles = np.stack([roll, np.arcsin(clamp(2.0 * (w * y - z * x), -1.0, 1.0)), self.yaw], axis=1)

    def _update_grounded(self) -> None:
        """End completed landings and bring drones on the ground to rest."""
        state = self._state
        self.position, self.velocity = state[:, PLACE].copy(), state[:, SPEED].copy()
        self._touch_down()
        if some(self.flying):
            # the firmware's supervisor switches the motors off when the drone is upside down
            over = np.flatnonzero(self.flying & (self._tilt_cosine(slice(None)) < 0.0))
            if len(over):
                self.stop(over)
        moving = self.flying | (norm(state[:, SPEED]) > AT_REST) | (norm(state[:, SPIN]) > 10.0 * AT_REST)
        self._quiet = np.where(moving, 0.0, self._quiet + self._period * self._ticks)
        if some(rests := self._quiet >= QUIET_S):
            state[rests, SPEED] = state[rests, SPIN] = 0.0
            self.velocity[rests] = 0.0

    def _tilt_cosine(self, rows: Index | slice) -> Array:
        turn = self._state[rows, TURN]
        return np.asarray(1.0 - 2.0 * (turn[:, 1] ** 2 + turn[:, 2] ** 2))

    def _set_state(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        state = self._state
        state[rows] = 0.0
        state[rows, PLACE], state[rows, TURN] = position, _upright_quaternions(yaw)
        state[rows, LIFT] = np.where(flying, self._hover[rows], 0.0)[:, None]
        self._quiet[rows] = 0.0
        self.yaw[rows] = self._heading[rows] = yaw
        self.position, self.velocity = state[:, PLACE].copy(), state[:, SPEED].copy()
        self._update_angles()


def _upright_quaternions(yaw: Array) -> Array:
    """Quaternions (n, 4) of upright rows."""
    zero = np.zeros(len(yaw))
    return np.stack([np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw)], axis=1)
