"""Point-mass engine: every row moves by its own model, without contacts; for thousands of robots."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Final

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, span
from agents.body.interface import BodyError
from agents.body.kinds import Kind
from twins.engines.engine import Stage, Touch
from twins.models.differential import DRIVES, Differential
from twins.models.onboard_flight import OnboardFlight
from twins.models.quadrotor import RESPONSES, Quadrotor


class PointMass(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The point-mass engine has no parameters."""

    contacts: ClassVar[bool] = False

    def build(self, stage: Stage) -> PointMassEngine:
        return PointMassEngine(stage)


TWINLESS: Final = (  # remedy for a kind of which `has_model` is false
    "add it to RESPONSES if it flies, to DRIVES if it takes a twist; another motion needs a model of its own in "
    "twins/models (docs/plugins.md); or name another body"
)


def has_model(kind: Kind) -> bool:
    """Whether a model moves as the kind: a quadrotor flies, a differential drive takes a twist on the floor."""
    return kind.name in (RESPONSES if kind.flies else DRIVES) and kind.flies == (kind.takes != "twist")


class Models:
    """Motion models of rows of any kinds: quadrotors for flying rows (`air`), differential drives for the `floor`."""

    def __init__(self, stage: Stage, flights: Callable[..., OnboardFlight] = Quadrotor) -> None:
        """`flights` makes the model of flying rows, with the arguments of `Quadrotor`."""
        kinds = stage.kinds
        if unknown := sorted({kind.name for kind in kinds if not has_model(kind)}):
            raise BodyError(f"no twin of {', '.join(map(repr, unknown))}; {TWINLESS}")
        flies = np.array([kind.flies for kind in kinds])
        air, floor = np.flatnonzero(flies), np.flatnonzero(~flies)
        self.in_air, self.on_floor = air, floor
        self.air, self.floor = span(air), span(floor)
        self.quadrotor = flights([kinds[i] for i in air], stage.start[air], stage.yaw[air], stage.dt)
        self.differential = Differential([kinds[i] for i in floor], stage.start[floor], stage.yaw[floor], stage.dt)
        self.position, self.yaw = np.array(stage.start, dtype=float), np.array(stage.yaw, dtype=float)
        self.velocity, self.flying = np.zeros_like(self.position), np.zeros(len(kinds), dtype=bool)
        self._mirrored = np.flatnonzero(stage.mirrored)
        count = len(self._mirrored)
        self._mirrored_state = np.full((count, 3), np.nan), np.zeros((count, 3)), np.zeros(count)

    def command(self, setpoint: Array) -> None:
        if len(self.in_air):
            self.quadrotor.command(setpoint[self.air])
        if len(self.on_floor):
            self.differential.command(setpoint[self.floor, :2])

    def takeoff(self, rows: Index, height: Array) -> None:
        flies = np.isin(rows, self.in_air)
        self.quadrotor.takeoff(np.searchsorted(self.in_air, rows[flies]), height[flies])

    def land(self, rows: Index) -> None:
        self.quadrotor.land(self._indices_in(self.in_air, rows))
        self.differential.halt(self._indices_in(self.on_floor, rows))

    def stop(self, rows: Index) -> None:
        self.quadrotor.stop(self._indices_in(self.in_air, rows))
        self.differential.halt(self._indices_in(self.on_floor, rows))

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        for part, model in ((self.in_air, self.quadrotor), (self.on_floor, self.differential)):
            which = np.isin(rows, part)
            at = np.searchsorted(part, rows[which])
            model.place(at, position[which], yaw[which], flying[which])
        self.position[rows], self.yaw[rows], self.velocity[rows], self.flying[rows] = position, yaw, 0.0, flying

    def mirror(self, rows: Index, position: Array, yaw: Array, velocity: Array) -> None:
        at = np.searchsorted(self._mirrored, rows)
        for state, values in zip(self._mirrored_state, (position, velocity, yaw), strict=True):
            state[at] = values

    def push(self, rows: Index, velocity: Array) -> None:
        """Set velocities (len(rows), 3) [m/s]; of ground robots the component along their heading."""
        flies = np.isin(rows, self.in_air)
        self.quadrotor.velocity[np.searchsorted(self.in_air, rows[flies])] = velocity[flies]
        self.differential.roll(np.searchsorted(self.on_floor, rows[~flies]), velocity[~flies])

    @staticmethod
    def _indices_in(part: Index, rows: Index) -> Index:
        """Indices in `part` of the `rows` that belong to it."""
        return np.searchsorted(part, rows[np.isin(rows, part)])


class PointMassEngine(Models):
    """Implements `twins.engines.engine.Engine`."""

    attitude: Array | None = None

    def __init__(self, stage: Stage, flights: Callable[..., OnboardFlight] = Quadrotor) -> None:
        super().__init__(stage, flights)
        self.position[self._mirrored] = np.nan
        self._scene, self._moves = stage.scene, len(stage.scene.moving) > 0
        self.obstacles = np.tile(stage.scene.pose, (int(stage.copy.max(initial=0)) + 1, 1, 1))

    def advance(self, t: float, wobble: Array) -> None:
        if len(self.on_floor):
            drive = self.differential
            drive.advance()
            floor = self.floor
            self.position[floor], self.velocity[floor], self.yaw[floor] = drive.position, drive.velocity, drive.yaw
        if len(self.in_air):
            self._fly(wobble)
        if len(self._mirrored):
            rows = self._mirrored
            self.position[rows], self.velocity[rows], self.yaw[rows] = self._mirrored_state
        if self._moves:
            self.obstacles = np.tile(self._scene.at(t), (len(self.obstacles), 1, 1))

    def _fly(self, wobble: Array) -> None:
        """Advance flying rows by one step; hover jitter is added to the position, not to the motion."""
        self.quadrotor.advance()
        self._copy_flight_state()
        self.position[self.air, :2] += wobble[self.air]

    def _copy_flight_state(self) -> None:
        """Copy the state of flying rows from their model."""
        flight, air = self.quadrotor, self.air
        self.position[air], self.velocity[air], self.yaw[air] = flight.position, flight.velocity, flight.yaw
        self.flying[air] = flight.flying

    def touches(self) -> list[Touch]:
        """See `Engine.touches`: always empty."""
        return []
