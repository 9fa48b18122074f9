"""MuJoCo engine: drones are rigid bodies on four motors, controlled by the firmware's cascade; attitude is simulated.

Every row is a simulation of its own small model, and one call advances all. Rows are independent to the last bit, and
the cost of a row does not grow with their number, unlike in one model of all. Drones touch the floor, the walls and the
obstacles without a plan. They fly through each other and through ground robots: contacts among robots are simulated by
the engine `pymunk`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Annotated, Final

import numpy as np
from msgspec import Meta

from agents.body.interface import Attitude, BodyError
from agents.body.kinds import Kind
from agents.vectors import ZERO, Vector
from bridges.crazyflie.mujoco.cascade import RATE_HZ, Firmware
from bridges.crazyflie.mujoco.model import mjcf
from twins.arrays import Array, Index, Mask, any_true, clamp, norm
from twins.engines.engine import Engine, EngineFactory, EngineInput, Mirrored, Planar
from twins.engines.point_mass import model, require_models
from twins.models.motion import Motion
from twins.models.onboard_flight import OnboardFlight
from twins.models.quadrotor import GRAVITY
from twins.scene import Scene

SUBSTEPS: Final = 2  # steps of MuJoCo in a step of the firmware
QUIET_S: Final = 0.1  # time at rest with its motors off after which a drone is no longer simulated
AT_REST: Final = 0.005  # [m/s], and ten times that in rad/s
TIPPED: Final = 0.5  # cosine of the largest tilt for a take-off, as in the firmware's supervisor
# the loop follows a random error of the estimate in part: with this share at a correlation time of 0.5 s
TRACKED_SHARE: Final = 0.84
FULL_STATE: Final = 18  # time, then:
PLACE, TURN, SPEED, SPIN, LIFT = slice(1, 4), slice(4, 8), slice(8, 11), slice(11, 14), slice(14, 18)


class RigidBody(EngineFactory, frozen=True):
    """Parameters of the MuJoCo engine."""

    motor_lag_s: Annotated[float, Meta(ge=0.01, le=0.1, description="time constant of a motor's thrust [s]")] = 0.03

    def build(self, stage: EngineInput) -> RigidBodyEngine:
        return RigidBodyEngine(stage, self.motor_lag_s)


class RigidBodyEngine(Engine):
    """Engine of rigid drones; ground robots are those of the point-mass engine."""

    def __init__(self, stage: EngineInput, motor_lag: float) -> None:
        """`motor_lag`: of a thrust [s]; raises BodyError for a kind without a twin, or without MuJoCo."""
        require_models(stage.kinds)
        self._dt, self._scene = stage.dt, stage.scene
        self._air = [row for row, kind in enumerate(stage.kinds) if kind.flies and not stage.mirrored[row]]
        self.drones = Drones([stage.kinds[row] for row in self._air], stage.dt, scene=stage.scene, motor_lag=motor_lag)
        self.motions: list[Motion] = []
        for row, kind in enumerate(stage.kinds):
            start, yaw = stage.start[row], stage.yaw[row]
            if stage.mirrored[row]:
                self.motions.append(Mirrored(yaw))
            elif kind.flies:
                self.motions.append(self.drones.add(kind, start, yaw))
            else:
                self.motions.append(model(kind, start, yaw))
        self.obstacles = stage.scene.start
        self._update_attitudes()

    def place(
        self, rows: Sequence[int], positions: Sequence[Vector], yaws: Sequence[float], flying: Sequence[bool]
    ) -> None:
        super().place(rows, positions, yaws, flying)
        self._update_attitudes()

    def advance(self, t: float, wobble: Sequence[Planar]) -> None:
        for motion in self.motions:
            motion.move(self._dt)
        for row in self._air:
            # an error of the drones' own estimate, which they follow
            self.motions[row].wobble = wobble[row]
        self.drones.advance()
        self._update_attitudes()
        if any(self._scene.plans):
            self.obstacles = self._scene.poses(t)

    def _update_attitudes(self) -> None:
        """Update the attitude of what stays upright."""
        for motion in self.motions:
            if not isinstance(motion, MujocoDrone):
                motion.attitude = _upright_quaternion(motion.yaw)


class MujocoDrone(OnboardFlight):
    """Setpoints and state of one of the drones that `Drones` moves.

    Heights are those of the centre of mass relative to standing on the floor [m]; yaw has no jumps.
    """

    __slots__ = ("_drones", "row")

    def __init__(self, drones: Drones, row: int, kind: Kind, start: Vector, yaw: float) -> None:
        self._drones, self.row = drones, row
        super().__init__(kind, start, yaw)

    def move(self, dt: float) -> None:
        """Of no effect: `Drones.advance` moves all."""

    def takeoff(self, height: float) -> None:
        """See `Motion.takeoff`; no effect on a drone that lies on its side or back."""
        if self._drones.start_motors(self):
            super().takeoff(height)

    def blow(self, wind: Planar) -> None:
        super().blow(wind)
        self._drones.blow(self)

    def place(self, position: Vector, yaw: float, *, flying: bool) -> None:
        super().place(position, yaw, flying=flying)
        self._drones.place(self)

    def hold_yaw(self) -> None:
        """Keep the present yaw."""
        self._yaw_setpoint = self.yaw

    def setpoint(self, dt: float) -> tuple[Vector, Vector, float, float, bool]:
        """Advance a climb by `dt` [s]; returns position, velocity, yaw and yaw rate, and whether velocity counts."""
        if self._climbing:
            self._advance_climb(dt)
        by_velocity = self._by_velocity and not self._climbing
        return self._target, self._velocity_setpoint, self._yaw_setpoint, self._yaw_rate, by_velocity

    def take(self, position: Vector, velocity: Vector, yaw: float, attitude: Attitude) -> None:
        """Set the state, and end a completed landing."""
        self.position = self.held = position
        self.velocity, self.yaw, self.attitude = velocity, yaw, attitude
        self._touches_down(position[2])


class Drones:
    """N rigid quadrotors: motion of all, in arrays."""

    def __init__(self, kinds: Sequence[Kind], dt: float, *, scene: Scene, motor_lag: float) -> None:
        """Steps of `dt` [s] are divided for the firmware's rate; raises BodyError without MuJoCo or an airframe."""
        try:
            import mujoco  # noqa: PLC0415 - an extra
            from mujoco import rollout  # noqa: PLC0415
        except ImportError:
            raise BodyError(
                "the engine mujoco needs an extra library: ./zenpark install mujoco-core, or pip install -e '.[mujoco]'"
            ) from None
        rows = len(kinds)
        self._dt, self._ticks = dt, max(1, math.ceil(dt * RATE_HZ - 1e-6))
        self._period = dt / self._ticks
        frames = [kind.airframe for kind in kinds if kind.airframe is not None]
        if frameless := sorted({kind.name for kind in kinds if kind.airframe is None}):
            remedy = "give the kind an `airframe` (docs/plugins.md), or choose another engine"
            raise BodyError(f"the engine mujoco has no airframe of {', '.join(map(repr, frameless))}; {remedy}")
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
        self.state = np.zeros((rows, FULL_STATE))
        self._quiet = np.zeros(rows)  # time for which each has been still [s]
        self._wobble = np.zeros((rows, 2))
        self._angles = np.zeros((rows, 3))
        self._yaw, self._heading = np.zeros(rows), np.zeros(rows)  # yaw, and its setpoint [rad]
        self._drones: list[MujocoDrone] = []

    def add(self, kind: Kind, start: Vector, yaw: float) -> MujocoDrone:
        """The next drone, at rest at `start` [m], `yaw` [rad]."""
        drone = MujocoDrone(self, len(self._drones), kind, start, yaw)
        self._drones.append(drone)
        return drone

    def blow(self, drone: MujocoDrone) -> None:
        """Push a drone by its wind, as a slant of gravity in a model of its own."""
        model = copy.copy(self._models[drone.row])
        model.opt.gravity[:2] = drone.wind
        self._models[drone.row] = model

    def start_motors(self, drone: MujocoDrone) -> bool:
        """Prepare a take-off; returns whether the drone stands upright."""
        row = drone.row
        if not self._tilt_cosine(slice(row, row + 1))[0] > TIPPED:
            return False
        if not drone.flying:
            self._firmware.reset(np.array([row]))
            self._heading[row] = drone.yaw
            drone.hold_yaw()
        self._quiet[row] = 0.0
        return True

    def place(self, drone: MujocoDrone) -> None:
        """Set the state of a drone to its position and yaw, at rest."""
        row = drone.row
        rows = np.array([row])
        self._firmware.reset(rows)
        if drone.flying:
            self._firmware.preset_hover(rows, self._hover[rows] / self._full[rows, 0])
        drone.attitude = _upright_quaternion(drone.yaw)
        state = self.state[row]
        state[:] = 0.0
        state[PLACE], state[TURN] = drone.position, drone.attitude
        state[LIFT] = self._hover[row] if drone.flying else 0.0
        self._quiet[row] = 0.0
        self._yaw[row] = self._heading[row] = drone.yaw
        self._update_angles()

    def advance(self) -> None:
        """One step of dt; `wobble` of each drone is the error of its position estimate."""
        if not self._drones:
            return
        state, drones = self.state, self._drones
        target, velocity, yaw, yaw_rate, by_velocity = map(
            np.array, zip(*(drone.setpoint(self._dt) for drone in drones), strict=True)
        )
        flying = np.array([drone.flying for drone in drones])
        wobble = np.array([drone.wobble for drone in drones])
        drift, self._wobble = (wobble - self._wobble) / (self._period * self._ticks), wobble
        awake = np.flatnonzero(flying | (self._quiet < QUIET_S))
        if not len(awake):
            return
        alone = len(awake) < len(state)
        models = [self._models[row] for row in awake] if alone else self._models
        any_flies = any_true(flying)
        target[:, :2] += wobble / TRACKED_SHARE
        wanted = clamp(velocity, -self._speed, self._speed)
        wanted[:, :2] += np.where(by_velocity[:, None], drift, 0.0)
        force = np.zeros((len(state), 4))
        for _ in range(self._ticks):
            if any_flies:
                self._heading = np.where(by_velocity, self._heading + self._period * yaw_rate, yaw)
                force = self._motor_forces(target, wanted, by_velocity, flying)
            before = state[awake] if alone else state
            control = np.repeat((force[awake] if alone else force)[:, None], SUBSTEPS, axis=1)
            path = np.empty((len(awake), SUBSTEPS, FULL_STATE))
            self._rollout.rollout(
                models, self._data, before, control, control_spec=self._control, skip_checks=True, nstep=SUBSTEPS,
                state=path, sensordata=np.empty((len(awake), SUBSTEPS, 0)),
            )  # fmt: skip
            state[awake] = path[:, -1]
            self._update_angles()
        self._update_drones()

    def _motor_forces(self, target: Array, wanted: Array, by_velocity: Mask, flying: Mask) -> Array:
        """Thrust setpoints of the motors, by the firmware's cascade: (n, 4) [N]."""
        state, firmware = self.state, self._firmware
        firmware.advance_outer_loops(target - state[:, PLACE], state[:, SPEED], wanted, by_velocity, self._yaw)
        share = firmware.advance_inner_loops(self._angles, state[:, SPIN], self._heading)
        return np.where(flying[:, None], self._full * share, 0.0)

    def _update_angles(self) -> None:
        """Update roll, pitch (nose down) and yaw of each row; yaw without jumps."""
        w, x, y, z = self.state[:, TURN].T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        self._yaw = yaw + 2.0 * np.pi * np.round((self._yaw - yaw) / (2.0 * np.pi))
        roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        self._angles = np.stack([roll, np.arcsin(clamp(2.0 * (w * y - z * x), -1.0, 1.0)), self._yaw], axis=1)

    def _update_drones(self) -> None:
        """Give the drones their state; end completed landings, and bring drones on the ground to rest."""
        state, drones = self.state, self._drones
        columns = (state[:, PLACE], state[:, SPEED], self._yaw, state[:, TURN])
        for drone, place, speed, yaw, turn in zip(drones, *(each.tolist() for each in columns), strict=True):
            drone.take(tuple(place), tuple(speed), yaw, tuple(turn))
        upside_down = self._tilt_cosine(slice(None)) < 0.0
        for row in np.flatnonzero(upside_down).tolist():
            if drones[row].flying:  # the firmware's supervisor switches the motors off
                drones[row].stop()
        flying = np.array([drone.flying for drone in drones])
        moving = flying | (norm(state[:, SPEED]) > AT_REST) | (norm(state[:, SPIN]) > 10.0 * AT_REST)
        self._quiet = np.where(moving, 0.0, self._quiet + self._period * self._ticks)
        rests = self._quiet >= QUIET_S
        if any_true(rests):
            state[rests, SPEED] = state[rests, SPIN] = 0.0
            for row in np.flatnonzero(rests).tolist():
                drones[row].velocity = ZERO

    def _tilt_cosine(self, rows: Index | slice) -> Array:
        turn = self.state[rows, TURN]
        return np.asarray(1.0 - 2.0 * (turn[:, 1] ** 2 + turn[:, 2] ** 2))


def _upright_quaternion(yaw: float) -> Attitude:
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)
