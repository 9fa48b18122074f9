"""Laws that remember and say something, at work for one robot: memory, words, and what the last step decided.

Memory belongs to the decision, never to the law: a step returns it, and it is kept only where the robot was due.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import dist, inf, isfinite, isnan, nan
from numbers import Real
from typing import Any, ClassVar, Final

from agents.decision.assignment import Assignment
from agents.network.validation import ENORMOUS, MAX_NUMBERS
from agents.plugins.calls import failure, wrong
from agents.plugins.law import Control, Law, Memory, NeighbourView, RobotFacts, Said, Values, View, is_known
from agents.plugins.registry import FAILURES, PluginError
from agents.vectors import UNKNOWN, ZERO, Vector, difference, is_finite

Words = tuple[tuple[str, Values], ...]  # what a robot says beside its pose: variables by name

MOST_STEPS: Final = 3.0  # longest pause that counts, in periods: after a longer one integrals would leap
REST: Final = (0.0, 0.0, nan)  # [m/s]
DIGITS: Final = 7  # significant ones of what is said: units are unknown


class Speech:
    """Variables that a robot transmits with its pose; triggers ask how far neighbours are from it.

    Before its first step it says nothing: a robot that joins a run under way would draw the others to values that do
    not move yet.
    """

    FIXED: ClassVar = ("metres",)
    NAMED: ClassVar = ("now", "before")

    def __init__(self, law: Law, memory: Memory) -> None:
        self.metres = {name: float(law.SAYS[name].metre) for name in sorted(law.SAYS)}  # see `Said`
        self.now = {name: (nan,) * len(memory[name]) for name in self.metres}
        self.before = self.now  # variables as said last, unless the present ones are said
        self.current = True  # the present variables are said; at first as they begin
        self.update(memory)
        self.spoken = self.stepped = False  # it has said something
        self.current = True

    def update(self, memory: Memory) -> None:
        """The variables are these after a step. Quiet."""
        if self.current:
            self.before = self.now
        self.stepped, self.current = True, False
        self.now = {name: tuple(map(rounded, memory[name])) for name in self.metres}
        self.change = 0.0  # largest deviation of a variable from what was said, in metres; infinite if one is new
        for name in self.metres:
            self.change = deviation(self.change, self.now[name], self.before[name], self.metres[name])

    @property
    def said(self) -> Memory:
        """Variables as said last; at first as they begin. Quiet."""
        return self.now if self.current else self.before

    def says(self, name: str) -> bool:
        """Whether a variable is said: a number of it may be unknown. Quiet."""
        return self.spoken and is_known(self.said[name])

    @property
    def words(self) -> Words:
        """Variables as said last, those that are known."""
        return tuple((name, values) for name, values in self.said.items() if self.says(name))

    @property
    def fresh(self) -> Words:
        """Variables that a transmission says now, those that are known."""
        return tuple((name, values) for name, values in self.now.items() if self.stepped and is_known(values))

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

    NAMED: ClassVar = ("memory",)
    MEASURED: ClassVar = ("measures",)
    CHECKS: ClassVar = ("checked",)

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
        # result of the last step: a velocity [m/s], or a goal [m], and a yaw [rad]
        self.velocity, self.goal, self.yaw = REST, UNKNOWN, nan
        self.gives_velocity = self.gives_goal = False
        self.measures: Mapping[str, float] = {}  # likewise
        self.error = nan  # Σ|e| of the links with known errors at the last step [m]; NaN without any
        self.moves = True  # the robot may move; set by its caller, and likewise
        self.scan: Any = None  # range readings
        self.deviation = nan  # deviation of what the neighbours believe [m]
        self.tick, self.stepped = 0, -1  # number of the tick since the common start
        self._target = UNKNOWN

    def _begin(self) -> Memory:
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
        return {name: len(self.memory[name]) for name in sorted(self.law.SAYS)}

    def view(  # noqa: PLR0917 - quiet
        self, neighbours: Sequence[NeighbourView] = (), position: Vector = UNKNOWN, velocity: Vector = ZERO,
        yaw: float = 0.0, target: Vector = UNKNOWN, speed: Vector = ZERO, leads: bool = False,
    ) -> View:  # fmt: skip
        """View for the next step; for the arguments see `View`. Quiet."""
        said = {} if self.speech is None else self.speech.said
        return View(
            self.facts, said, neighbours, self.tick * self.tick_s, position, velocity, yaw, target, speed, self.scan,
            self.deviation, leads, self.moves, step_s=self.length(),
        )  # fmt: skip

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
        """Step, and keep what the law decided. Quiet, if the law is."""
        control = self.rehearse(view)
        self.gives_velocity, self.gives_goal = control.velocity is not None, control.goal is not None
        self.velocity = REST if control.velocity is None else control.velocity
        self.goal = UNKNOWN if control.goal is None else control.goal
        self.yaw, self.memory = control.yaw, control.memory
        self.measures, self.stepped = control.measures, self.tick
        total, known = 0.0, False
        for each in view.neighbours:
            error = abs(self.law.error(difference(view.position, each.position), each.link))
            if not isnan(error):
                total, known = total + error, True
        self.error = total if known else nan
        if self.speech is not None:
            self.speech.update(self.memory)

    def rehearse(self, view: View) -> Control:
        """Step of the law, of which nothing is kept. Raises PluginError where a result is not what it must be."""
        # a law that writes into its memory must not count rehearsals
        return self.checked(self.law.step(view, dict(self.memory)))

    def checked(self, control: Control) -> Control:
        """Result of a law, in floats; raises PluginError where it is not what it must be.

        A compiled step is sure of it, by the types of its values.
        """
        law, memory = self.law, self.memory
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
        return Control(
            {name: tuple(map(float, values)) for name, values in control.memory.items()},
            _vector(control.velocity), _vector(control.goal), float(control.yaw),
            {name: float(value) for name, value in control.measures.items()},
        )  # fmt: skip

    @property
    def sound(self) -> bool:
        """Whether all that the last step decided for the body is finite, or a height that is left out."""
        return is_sound(self.velocity) and (is_sound(self.goal) or not self.gives_goal)


def deviation(change: float, now: Values, said: Values, metre: float) -> float:
    """Largest deviation [m] of variables from what was said, `change` or that of the next; infinite if one is new."""
    if not is_known(now):
        return change
    if not said or not is_known(said):
        return inf
    return max(change, dist(now, said) / metre)


def is_sound(way: Vector | None) -> bool:
    """Whether a velocity or goal is finite, apart from a height that is left out; it may be left out itself."""
    return way is None or (isfinite(way[0]) and isfinite(way[1]) and abs(way[2]) != inf)


def rounded(value: float) -> float:
    """A number of `DIGITS` significant digits; NaN where it is none that can be said."""
    return float(f"{value:.{DIGITS}g}") if abs(value) <= ENORMOUS else nan


def _vector(values: Iterable[float] | None) -> Vector | None:
    """Three numbers as floats, if there are any."""
    if values is None:
        return None
    x, y, z = map(float, values)
    return x, y, z


def _size(values: object) -> int:
    """Count of numbers; −1 if they are none."""
    if not isinstance(values, Iterable) or isinstance(values, str):
        return -1
    numbers = list(values)
    return len(numbers) if all(isinstance(each, Real) for each in numbers) else -1
