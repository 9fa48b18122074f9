"""Steps of laws that remember, in compiled ticks: as in `agents.decision.goals`, with variables as records.

A law outside of the subset is called back in Python, see `experiments.virtual_time.steps`.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from functools import cache
from itertools import accumulate
from math import isfinite, nan
from typing import Any, ClassVar, Final

from agents.decision.goals import GoalComputer
from agents.decision.stepping import Speech, Stepping, deviation, rounded
from agents.plugins.law import Control, Law, Memory, NeighbourView, RobotFacts, Values, View, is_known
from agents.vectors import UNKNOWN, ZERO, Vector

MEASURES: Final = 12  # most measures of a law
VELOCITY, GOAL = 1, 2  # what a law gives


class Variables:
    """Variables by name; each is a tuple of floats in a slot of its own."""

    __slots__ = ()

    NAMES: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def slot(cls, name: str) -> str:
        """Attribute of a variable."""
        return f"n{cls.NAMES.index(name)}"

    def take(self, values: Memory) -> None:
        for k, name in enumerate(self.NAMES):
            setattr(self, f"n{k}", values[name])

    def hear(self, values: Memory) -> None:
        """Take what was said of variables of these sizes."""
        for name, former in self.all().items():
            said = values.get(name, ())
            setattr(self, self.slot(name), said if len(said) == len(former) else (nan,) * len(former))

    def known(self) -> dict[str, Values]:
        """Variables of which all numbers are known."""
        return {name: values for name, values in self.all().items() if is_known(values)}

    def all(self) -> dict[str, Values]:
        return {name: getattr(self, f"n{k}") for k, name in enumerate(self.NAMES)}


@cache
def _class_of(names: tuple[str, ...]) -> type[Variables]:
    return type("Variables", (Variables,), {"__slots__": tuple(f"n{k}" for k in range(len(names))), "NAMES": names})


def variables(sizes: Mapping[str, int]) -> Variables:
    """Variables of these sizes, which are not known."""
    found = _class_of((*sizes,))()
    found.take({name: (nan,) * size for name, size in sizes.items()})
    return found


class Mind:
    """Law of a robot in compiled ticks, with what it remembers and says."""

    __slots__ = (
        "before", "called_back", "ends", "facts", "gives", "law", "measured", "measures", "memory", "metres", "now",
        "places", "steps", "ways",
    )  # fmt: skip

    law: Law
    facts: RobotFacts
    memory: Variables
    now: Variables  # see `Speech`
    before: Variables
    ends: list[int]  # ends of the variables that are said, among all their numbers
    places: list[int]  # index in the memory by number that is said
    metres: list[float]  # see `Said`, by variable
    gives: int  # 0, `VELOCITY` or `GOAL`, by the last step
    measured: int  # a bit for each measure that the last step gave
    measures: array[float]
    steps: int  # steps so far
    called_back: bool  # the law steps in Python
    ways: list[Any]  # links on which the robot receives, see `experiments.virtual_time.company`

    def __init__(self, stepping: Stepping) -> None:
        self.law, self.facts = stepping.law, stepping.facts
        self.called_back = False
        sizes, said = {name: len(values) for name, values in stepping.memory.items()}, stepping.says
        first = dict(zip(sizes, accumulate(sizes.values(), initial=0), strict=False))
        self.ends = [*accumulate(said.values())]
        self.places = [first[name] + k for name, size in said.items() for k in range(size)]
        self.metres = [float(self.law.SAYS[name].metre) for name in said]
        self.measures = array("d", (0.0,)) * MEASURES
        self.memory = variables(sizes)
        self.now, self.before = variables(said), variables(said)
        self.steps = self.gives = self.measured = 0
        self.ways = []

    def parts(self) -> list[object]:
        """The law with its variables, and records that a step in Python reads or changes."""
        return [self, self.memory, self.now, self.before, *(way.said for way in self.ways)]

    def take(self, stepping: Stepping, names: list[str]) -> None:
        """Take over what a law remembers; `names` are those of all measures."""
        control, speech = stepping.control, stepping.speech
        self.steps, self.measured = 0, 0
        self.memory.take(stepping.memory)
        self.gives = GOAL if stepping.gives_goal else VELOCITY if control.velocity is not None else 0
        for name, value in stepping.measures.items():
            if name not in names:
                names.append(name)
            self.measures[names.index(name)] = value
            self.measured |= 1 << names.index(name)
        if speech is not None:
            self.now.take(speech.now)
            self.before.hear(speech.before)

    def give(self, stepping: Stepping, names: list[str]) -> None:
        """Give back what the law remembers now."""
        if self.called_back or not self.steps:
            return
        stepping.memory = self.memory.all()
        known = [(k, name) for k, name in enumerate(names) if self.measured >> k & 1]
        stepping.measures = {name: self.measures[k] for k, name in known}
        stepping.control = Control(
            stepping.memory,
            stepping.velocity if self.gives == VELOCITY else None,
            stepping.goal if self.gives == GOAL else None,
            stepping.yaw,
            stepping.measures,
        )
        if stepping.speech is not None:
            stepping.speech.now, stepping.speech.before = self.now.all(), self.before.all()


def as_dictionary(of: Variables) -> dict[str, Values]:
    """Variables as a law gets them."""
    return of.all()


def keep(of: Variables, values: Memory) -> None:
    """Variables are these from now on."""
    of.take(values)


def numbers(of: Variables) -> list[float]:
    """All numbers of variables, where they stand; of compiled functions alone."""
    raise TypeError(type(of).__name__)


def robot_name(number: int) -> str:
    """Name of a robot by its number, with which compiled functions do nothing; of those alone."""
    raise TypeError(number)


def step(  # noqa: PLR0917 - quiet
    goals: GoalComputer, t: float, position: Vector, velocity: Vector, yaw: float, start: float
) -> None:
    """As `GoalComputer.step`."""
    stepping = goals.stepping
    assert stepping is not None
    mind: Any = stepping.mind
    if goals.changes_shape:
        goals.reshape(t - start, position, t)
    target, speed = UNKNOWN, ZERO
    length = stepping.length()
    if goals.itinerary is not None:
        x, y, z, _ = goals.itinerary.target(t - start, (position[0], position[1], goals.ground), yaw)
        target = x, y, z
        speed = stepping.speed_of(target, length)
    neighbours = [
        NeighbourView(
            way.neighbour.sender, robot_name(way.neighbour.sender), way.neighbour.place(goals.predictor, t),
            way.neighbour.velocity, way.neighbour.yaw, t - way.neighbour.stamp, as_dictionary(way.said),
            way.neighbour.link,
        )
        for way in mind.ways
        if way.neighbour.active
    ]  # fmt: skip
    view = View(
        mind.facts, said_by(mind, stepping.speech), neighbours, stepping.tick * stepping.tick_s, position, velocity,
        yaw, target, speed, None, stepping.deviation, not goals.follows, stepping.moves, step_s=length,
    )  # fmt: skip
    control = mind.law.step(view, as_dictionary(mind.memory))
    keep(mind.memory, control.memory)
    mind.gives, mind.measured = control.gives, control.measured
    for k, value in enumerate(control.measures):
        mind.measures[k] = value
    stepping.gives_goal = control.gives == GOAL
    stepping.velocity, stepping.goal, stepping.yaw = control.velocity, control.goal, control.yaw
    stepping.stepped = stepping.tick
    mind.steps += 1
    if stepping.speech is not None:
        update(mind, stepping.speech)


def said_by(mind: Mind, speech: Speech | None) -> Memory:
    """Own variables as said last."""
    if speech is None:
        return {}
    return as_dictionary(mind.now) if speech.current else as_dictionary(mind.before)


def update(mind: Mind, speech: Speech) -> None:
    """As `Speech.update`."""
    now, before, memory = numbers(mind.now), numbers(mind.before), numbers(mind.memory)
    for k in range(len(now)):
        if speech.current:
            before[k] = now[k]
        now[k] = rounded(memory[mind.places[k]])
    speech.stepped, speech.current = True, False
    change, k = 0.0, -1
    for name in mind.law.SAYS:
        k += 1
        change = deviation(change, as_dictionary(mind.now)[name], as_dictionary(mind.before)[name], mind.metres[k])
    speech.change = change


def speak(mind: Mind, speech: Speech, words: array[float]) -> None:
    """Words of a transmission, NaN for a variable that is not known."""
    said = numbers(mind.now) if speech.current else numbers(mind.before)
    begin = 0
    for end in mind.ends:
        known = speech.spoken
        for k in range(begin, end):
            known = known and isfinite(said[k])
        for k in range(begin, end):
            words[k] = said[k] if known else nan
        begin = end
