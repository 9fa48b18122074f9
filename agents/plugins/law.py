"""Control and communication laws: what a robot remembers, what it says beside its pose, and how it moves.

A law is a frozen struct of its parameters, found by the entry-point group `zenpark.laws`. It is written for one robot,
as textbooks write it (F. Bullo, J. Cortés, S. Martínez, *Distributed Control of Robotic Networks*, 2009, chapter 3): a
state of the processor, messages, a transition of that state, and a motion control. Formation laws without memory are
its subclass `agents.plugins.laws.Gradient`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, isnan, nan
from typing import Any, ClassVar, Final, Literal, TypeVar

import msgspec

from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_RELATIVE, Link, target_error
from agents.vectors import UNKNOWN, ZERO, Vector

Need = Literal["distance", "relative", "bearing", "any", "nothing"]
Gain = Literal["gain", "stiffness", "by link"]
Severity = Literal["error", "warning", "note"]
Values = tuple[float, ...]  # values of a variable; NaN: not known yet
Memory = Mapping[str, Values]  # variables by name

T = TypeVar("T")

# how a law takes every link, by what it needs; the others take each link by its own target
WANTS: Final[Mapping[Need, int]] = {"distance": BY_DISTANCE, "relative": BY_RELATIVE, "bearing": BY_BEARING}


class Said(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Transmission of a variable of the memory to neighbours."""

    unit: str = "1"
    metre: float = 1.0  # change of it that counts, for every trigger, as one metre of deviation of the pose
    # index, from the end if negative, at which a place x, y [m] begins; a third number that ends the variable is z
    place: int | None = None


class Measure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Unit of a measure of a law, and which way it is better; with "" it is no figure and no ratio."""

    unit: str = ""
    better: Literal["less", "more", ""] = "less"


@dataclass(eq=False)
class RobotFacts:
    """A robot as its law knows it before anything happens."""

    name: str
    number: int  # index among all robots of the experiment, from 0 on
    count: int  # number of all robots
    flies: bool
    speed: float  # largest speed of its kind [m/s]
    step_s: float  # time from one step to the next [s]

    def of(self, table: Mapping[str, T], default: T | None = None) -> T:
        """Value of this robot in a table by names; raises ValueError if it has none and there is no default."""
        value = table.get(self.name, default)
        if value is None:
            raise ValueError(f"a table of the law has no value for {self.name}: give it one there, or `of` a default")
        return value


@dataclass(eq=False)
class NeighbourView:
    """A neighbour as the robot believes it, with the link to it."""

    number: int  # index among all robots of the experiment
    name: str
    position: Vector  # predicted for now [m]
    velocity: Vector  # velocity in its last pose [m/s]
    yaw: float  # yaw in its last pose [rad], NaN where unknown
    age: float  # time since its last pose [s]
    said: Memory  # variables as it said them last; NaN before the first
    link: Link  # its target and gain


@dataclass(eq=False)
class View:
    """Knowledge of a robot at a step of its law."""

    robot: RobotFacts
    said: Memory  # own variables, as said last: what the neighbours believe of this robot
    neighbours: Sequence[NeighbourView]  # those of its links that are there, in the order of their numbers
    time: float = 0.0  # time since the common start, by ticks [s]
    step_s: float = field(default=nan, kw_only=True)  # time since the last step, by ticks [s]
    position: Vector = UNKNOWN  # own, measured [m]
    velocity: Vector = ZERO  # own, measured [m/s]
    yaw: float = 0.0  # own [rad]
    target: Vector = UNKNOWN  # place of the robot's plan now [m]; NaN without one
    target_velocity: Vector = ZERO  # velocity of that target [m/s]; 0 at first
    scan: Any = None  # range readings, see `agents.body.interface.RangeScan`; None without
    deviation: float = nan  # distance of what the neighbours believe from the truth [m]; NaN where it is unknown
    leads: bool = False  # the law does not move it: it has no links, and follows a plan or stays
    moves: bool = True  # False while safety holds it: integrals of what its motion must mend stop then

    def __post_init__(self) -> None:
        if isnan(self.step_s):
            self.step_s = self.robot.step_s

    def known(self, *names: str) -> list[NeighbourView]:
        """Neighbours that have said all variables of these names."""
        return [each for each in self.neighbours if all(is_known(each.said[name]) for name in names)]


class Control(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Result of a step of a law; with neither velocity nor goal the robot stays where it is."""

    memory: Memory = {}  # all variables, as they are from now on
    velocity: Vector | None = None  # [m/s]; the third NaN: the height is held
    goal: Vector | None = None  # [m]; likewise. Limited per axis and decision by `clamp` of the formation
    yaw: float = nan  # wanted [rad], NaN for any
    measures: Mapping[str, float] = {}  # numbers by name for figures and metrics, never said; see `Law.MEASURES`


class Law(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all laws."""

    NEEDS: ClassVar[Need] = "nothing"  # target that it needs of every link
    PULLS_BY: ClassVar[Gain] = "gain"  # gain of the file for links without their own
    SAYS: ClassVar[Mapping[str, Said]] = {}  # variables of the memory that go out with the pose
    MEASURES: ClassVar[Mapping[str, Measure]] = {}  # units of its measures; of one left out there is none
    ALONE: ClassVar[bool] = False  # moves a robot without neighbours, which else stays in place
    PREDICTION: ClassVar[str] = "hold"  # default of an experiment that names none
    LIBRARY: ClassVar[str] = ""  # distribution that it needs beside zenpark: its version decides on results, too
    FILES: ClassVar[Mapping[str, str]] = {}  # parameters that name a file, and those that get its content, in base64

    def begin(self, robot: RobotFacts) -> Memory:
        """Variables at the start, each with as many numbers as it ever has."""
        return {}

    def step(self, view: View, memory: Memory) -> Control:
        """State transition, messages and motion of one robot; pure."""
        raise TypeError(f"{type(self).__name__} must define `step`")

    def error(self, apart: Vector, link: Link) -> float:
        """Error [m] of a link with `apart` = p_i − p_j [m]; NaN where it has no target."""
        return target_error(apart, link, WANTS.get(self.NEEDS, link.wants))

    def analyse(self, plan: Any) -> Iterable[tuple[Severity, str, str]]:  # noqa: ANN401 - plug-ins know no experiment
        """Theory for `check`: findings on a compiled case, `experiments.definition.plan.Plan`, each with its remedy."""
        return ()


def is_known(values: Iterable[float]) -> bool:
    """Whether all numbers of a variable are known."""
    return all(isfinite(each) for each in values)
