"""Laws that remember and say something, at work for one robot: memory, words, and what the last step decided.

Memory belongs to the decision, never to the law: a step returns it, and it is kept only where the robot was due.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import dist, inf, isfinite, nan
from numbers import Real
from typing import Any, ClassVar, Final

from agents.decision.assignment import Assignment
from agents.network.validation import ENORMOUS, MAX_NUMBERS
from agents.plugins.calls import failure, wrong
from agents.plugins.law import Control, Law, Memory, RobotFacts, Said, Values, View, is_known
from agents.plugins.registry import FAILURES, PluginError
from agents.vectors import UNKNOWN, ZERO, Vector, is_finite

Words = tuple[tuple[str, Values], ...]  # what a robot says beside its pose: variables by name

MOST_STEPS: Final = 3.0  # longest pause that counts, in periods: after a longer one integrals would leap
REST: Final = (0.0, 0.0, nan)  # [m/s]
DIGITS: Final = 7  # significant ones of what is said: units are unknown


class Speech:
    """Variables that a robot transmits with its pose; triggers ask how far neighbours are from it.

    Before its first step it says nothing: a robot that joins a run under way would draw the others to values that do
    not move yet.
    """

    def __init__(self, law: Law, memory: Memory) -> None:
        self._metres = {name: said.metre for name, said in law.SAYS.items()}
        self.now: dict[str, Values] = {}
        self.before = self.now  # variables as said last, unless the present ones are said
        self.current = True  # the present variables are said; at first as they begin
        self.update(memory)
        self.spoken = self.stepped = False  # it has said something
        self.current = True

    def update(self, memory: Memory) -> None:
        """The variables are these after a step."""
        if self.current:
            self.before = self.now
        self.stepped, self.current = True, False
        self.now = {name: tuple(map(rounded, memory[name])) for name in self._metres}
        self.change = 0.0  # largest deviation of a variable from what was said, in metres; infinite if one is new
        for name, metre in self._metres.items():
            self.change = deviation(self.change, self.now[name], self.before.get(name, ()), metre)

    @property
    def said(self) -> Memory:
        """Variables as said last; at first as they begin."""
        return self.now if self.current else self.before

    @property
    def words(self) -> Words:
        """Variables as said last, those that are known."""
        return _known(self.said) if self.spoken else ()

    @property
    def fresh(self) -> Words:
        """Variables that a transmission says now, those that are known."""
        return _known(self.now) if self.stepped else ()

    def deviation(self, of_pose: float) -> float:
        """Largest deviation of what neighbours know, of pose and variables [m]; infinite if one is new. Quiet."""
        if not self.stepped:
            return of_pose
        return max(of_pose, self.change) if self.spoken else inf

    def record(self) -> None:
        """Note that the present words are transmitted now. Quiet."""
        if self.stepped:
            self.spoken = self.current = True
            self.change = 0.0


class Stepping:
    """A law at work for one robot."""

    RARE: ClassVar = ("control", "law", "scan")

    def __init__(self, assignment: Assignment) -> None:
        """Begin; raises PluginError if `begin` of the law fails or gives what cannot be used."""
        law, kind = assignment.law, assignment.kind
        self.law, self.tick_s = law, 1.0 / assignment.body_hz
        self.alone = law.ALONE  # the law moves a robot without neighbours
        self.facts = RobotFacts(
            assignment.name, assignment.number, assignment.count, kind.flies, kind.speed,
            assignment.decide_every * self.tick_s,
        )  # fmt: skip
        self.memory = self._begin()
        self.speech = Speech(law, self.memory) if law.SAYS else None  # None: the law says nothing
        self.control = Control()  # result of the last step: a velocity [m/s], or a goal [m], and a yaw [rad]
        self.velocity, self.goal, self.yaw = REST, UNKNOWN, nan
        self.gives_goal = False
        self.measures: dict[str, float] = {}  # likewise
        self.mind: Any = None  # the same in compiled ticks, while there are any
        self.moves = True  # the robot may move; set by its caller, and likewise
        self.scan: Any = None  # range readings
        self.deviation = nan  # deviation of what the neighbours believe [m]
        self.tick, self.stepped = 0, -1  # number of the tick since the common start
        self._target = UNKNOWN

    def _begin(self) -> dict[str, Values]:
        law = self.law
        if not (isinstance(law.SAYS, Mapping) and all(isinstance(said, Said) for said in law.SAYS.values())):
            raise PluginError(f"SAYS of the law {type(law).__name__} must name a Said for each variable")
        for name, said in law.SAYS.items():
            if not (isinstance(said.metre, Real) and said.metre > 0.0):
                raise PluginError(
                    f"SAYS of the law {type(law).__name__}: the metre of {name} is {said.metre!r}, not a positive "
                    "number; infinity: changes of this variable cause no transmission"
                )
        try:
            begun = law.begin(self.facts)
        except PluginError:  # such as a library that is not installed: with its remedy
            raise
        except FAILURES as error:
            raise failure("law", law, error) from error
        if not (isinstance(begun, Mapping) and all(_size(values) >= 0 for values in begun.values())):
            raise wrong("law", law, "begin", begun, "a tuple of numbers for each variable")
        memory = {name: tuple(map(float, values)) for name, values in begun.items()}
        if missing := [name for name in law.SAYS if name not in memory]:
            raise PluginError(f"`begin` of the law {type(law).__name__} lacks {', '.join(missing)}, which it SAYS")
        count = sum(len(memory[name]) for name in law.SAYS)
        if count > MAX_NUMBERS:
            raise PluginError(f"the law {type(law).__name__} says {count} numbers; a pose carries {MAX_NUMBERS}")
        return memory

    @property
    def says(self) -> dict[str, int]:
        """Sizes of the variables that it says, by name."""
        return {name: len(self.memory[name]) for name in self.law.SAYS}

    def said_by(self, words: Mapping[str, Values]) -> dict[str, Values]:
        """Variables that a neighbour said; NaN for those that it did not say, or that have another size."""
        found = {}
        for name in self.law.SAYS:
            said, size = words.get(name, ()), len(self.memory[name])
            found[name] = said if len(said) == size else (nan,) * size
        return found

    def view(self) -> View:
        """View for the next step, without what is not known here."""
        view = View(self.facts, {} if self.speech is None else self.speech.said, ())
        view.time = self.tick * self.tick_s
        view.moves, view.scan = self.moves, self.scan
        view.deviation = self.deviation
        view.step_s = self.length()
        return view

    def length(self) -> float:
        """Length of the next step [s]; quiet."""
        length = self.facts.step_s
        if self.stepped >= 0:
            passed = (self.tick - self.stepped) * self.tick_s
            length = min(max(passed, self.tick_s), MOST_STEPS * length)
        return length

    def speed_of(self, target: Vector, s: float) -> Vector:
        """Velocity of the plan, which is at `target` [m] now, `s` [s] after the last step; quiet."""
        (x, y, z), speed = self._target, ZERO
        if is_finite(self._target) and is_finite(target):
            speed = (target[0] - x) / s, (target[1] - y) / s, (target[2] - z) / s
        self._target = target
        return speed

    def step(self, view: View) -> None:
        """Step, and keep what the law decided."""
        self.control = control = self.rehearse(view)
        self.gives_goal = control.goal is not None
        self.velocity, self.goal = _vector(control.velocity, REST), _vector(control.goal, UNKNOWN)
        self.yaw = float(control.yaw)
        self.memory = {name: tuple(map(float, values)) for name, values in control.memory.items()}
        self.measures = {name: float(value) for name, value in control.measures.items()}
        self.stepped = self.tick
        if self.speech is not None:
            self.speech.update(self.memory)

    def rehearse(self, view: View) -> Control:
        """Step of the law, of which nothing is kept. Raises PluginError where a result is not what it must be."""
        law, memory = self.law, self.memory
        control = law.step(view, dict(memory))  # one that writes into it must not count rehearsals
        if not isinstance(control, Control):
            raise wrong("law", law, "step", control, "a Control")
        sizes = {name: len(values) for name, values in memory.items()}
        if {name: _size(values) for name, values in control.memory.items()} != sizes:
            wanted = ", ".join(f"{name} ({size})" for name, size in sizes.items()) or "no variables"
            raise wrong("law", law, "step", dict(control.memory), f"a memory of the variables and sizes {wanted}")
        if control.velocity is not None and control.goal is not None:
            raise wrong("law", law, "step", control, "a velocity or a goal, not both")
        for way in (control.velocity, control.goal):
            if way is not None and _size(way) != len(self._target):
                raise wrong("law", law, "step", way, "three numbers as velocity or goal")
        if not (isinstance(control.yaw, Real) and all(isinstance(each, Real) for each in control.measures.values())):
            raise wrong("law", law, "step", control, "a number as yaw and as each of its measures")
        return control

    @property
    def sound(self) -> bool:
        """Whether all that the last step decided for the body is finite, or a height that is left out."""
        return is_sound(self.control)


def deviation(change: float, now: Values, said: Values, metre: float) -> float:
    """Largest deviation [m] of variables from what was said, `change` or that of the next; infinite if one is new."""
    if not is_known(now):
        return change
    if not said or not is_known(said):
        return inf
    return max(change, dist(now, said) / metre)


def is_sound(control: Control) -> bool:
    """Whether a velocity or goal is finite, apart from a height that is left out."""
    ways = (way for way in (control.velocity, control.goal) if way is not None)
    return all(isfinite(x) and isfinite(y) and abs(z) != inf for x, y, z in ways)


def rounded(value: float) -> float:
    """A number of `DIGITS` significant digits; NaN where it is none that can be said."""
    return float(f"{value:.{DIGITS}g}") if abs(value) <= ENORMOUS else nan


def _known(variables: Memory) -> Words:
    return tuple((name, values) for name, values in variables.items() if is_known(values))


def _vector(values: Iterable[float] | None, other: Vector) -> Vector:
    """Three numbers as floats, or another vector in place of None."""
    if values is None:
        return other
    x, y, z = map(float, values)
    return x, y, z


def _size(values: object) -> int:
    """Count of numbers; −1 if they are none."""
    if not isinstance(values, Iterable) or isinstance(values, str):
        return -1
    numbers = list(values)
    return len(numbers) if all(isinstance(each, Real) for each in numbers) else -1
