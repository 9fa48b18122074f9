"""Tracking of a moving target by a distributed Kalman filter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache, reduce
from math import atan2, hypot, isnan, nan, pi, remainder, sqrt
from operator import add, mul
from random import Random
from typing import Annotated, Any, ClassVar, Final, Literal

from msgspec import Meta

from zenpark import (
    Control,
    Law,
    Measure,
    Memory,
    Positive,
    RobotFacts,
    Said,
    Severity,
    Values,
    Vector,
    View,
    difference,
    is_known,
)

Matrix = Sequence[Sequence[float]]  # 4 × 4, for a state of x, y [m] and v_x, v_y [m/s]
Information = tuple[Sequence[float], Matrix]  # y = Y x and Y = P⁻¹

NEAREST: Final = 0.1  # [m] nearer, the slope of a direction means nothing
IDENTITY: Final = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class Tracking(Law, frozen=True):
    """x̂_i = (Σ_j Y_j)⁻¹ Σ_j y_j, with Y ← W F⁻ᵀ Y F⁻¹ + g gᵀ and y ← W F⁻ᵀ y + g (z − h(x̂) + gᵀ x̂); robots stand.

    Kalman filter of a target of nearly constant velocity, in information form, in units of one reading, 1/σ². Each
    robot transmits the information of its own readings z, and adds that of its neighbours, brought up to date. All is
    discounted by the filter gain of the sum, W = (I + F⁻ᵀ ΣY F⁻¹ Q)⁻¹. If all robots receive each other, the sums are
    those of the central filter, apart from the delay of messages. A message holds all information of its sender, so
    losses delay and never bias (R. Olfati-Saber, "Kalman-consensus filter: optimality, stability, and performance", CDC
    2009; F. Govaers, "Distributed Kalman filter", in *Kalman Filters: Theory for Advanced Applications*, 2018).

    Readings are emulated: the distance or direction, seen from above, of the place that the target sends, with a normal
    error. A hash of robot, time and that place draws it: another in each run, as motion capture never gives a place
    twice, and the same in a repetition. The filter gets no other data of the target.
    """

    PREDICTION: ClassVar[str] = "constant-velocity"
    MEASURES: ClassVar[Mapping[str, Measure]] = {"uncertainty": Measure("m"), "reading": Measure(better="")}
    SAYS: ClassVar[Mapping[str, Said]] = {  # 1 cm of threshold: one reading
        "y": Said(unit="m", metre=100.0),
        "Y": Said(metre=100.0),
        "x": Said(unit="m", metre=100.0, place=0),  # unit and scale for views
    }

    target: Annotated[
        str, Meta(description="robot that is tracked; robots that receive its poses get readings of it")
    ] = ""
    sees: Annotated[Literal["distance", "direction"], Meta(description="quantity of a reading")] = "distance"
    sigma: Annotated[Positive, Meta(description="σ, standard deviation of a reading [m] or [rad]")] = 0.1
    agility: Annotated[Positive, Meta(description="density of the target's white acceleration [m²/s³]")] = 1e-4
    guess: Annotated[tuple[float, float], Meta(description="place of the target at first [m]")] = (0.0, 0.0)
    doubt: Annotated[
        tuple[Positive, Positive], Meta(description="standard deviations of that place [m] and of its velocity [m/s]")
    ] = (1.0, 0.2)

    def begin(self, robot: RobotFacts) -> Memory:
        """Own y and Y, the estimate x, and the sum of all Y. The guess is shared out; the target says nothing."""
        place, speed = (self.sigma / self.doubt[0]) ** 2, (self.sigma / self.doubt[1]) ** 2
        guess, weights = (*self.guess, 0.0, 0.0), (place, place, speed, speed)
        share = 1.0 / max(robot.count - 1, 1)
        every = tuple(weights[k] if k == m else 0.0 for k in range(4) for m in range(4))
        y = tuple(share * weight * each for weight, each in zip(weights, guess, strict=True))
        memory = {"y": y, "Y": tuple(share * each for each in every), "x": guess, "all": every}
        if robot.name == self.target:
            return {name: (nan,) * len(values) for name, values in memory.items()}
        return memory

    def step(self, view: View, memory: Memory) -> Control:
        """Prediction, sum, correction by an own reading."""
        if view.robot.name == self.target:
            return Control(memory=memory)
        every, density = memory["all"], self.agility / self.sigma**2
        own = predicted(memory["y"], memory["Y"], view.step_s, density, every)
        others = [
            predicted(each.said["y"], each.said["Y"], max(each.age, 0.0), density, every)
            for each in view.known("y", "Y")
        ]
        y, known = total([own, *others])
        if not all(row[k] > 0.0 for k, row in enumerate(inverse(known))):  # received values are no information
            others, (y, known) = [], own
        reading = self.measure(view)
        own = total([own, told_by(reading, self.sees, view.position, times(inverse(known), y))])
        y, known = total([own, *others])
        covariance = inverse(known)
        x = times(covariance, y)
        if not is_known(x):
            return Control(memory=memory)
        variance = self.sigma**2 * (covariance[0][0] + covariance[1][1])
        return Control(
            memory={"y": tuple(own[0]), "Y": flat(own[1]), "x": x, "all": flat(known)},
            measures={"reading": reading, "uncertainty": sqrt(max(variance, 0.0))},
        )

    def measure(self, view: View) -> float:
        """A reading of the target [m] or [rad], NaN without one; a sensor of the robot would give it here."""
        for target in view.neighbours:
            if target.name == self.target:
                error = Random(repr((view.robot.number, view.time, target.position))).gauss(0.0, self.sigma)
                x, y, _ = difference(target.position, view.position)
                return (hypot(x, y) if self.sees == "distance" else atan2(y, x)) + error
        return nan

    def analyse(self, plan: Any) -> Iterable[tuple[Severity, str, str]]:  # noqa: ANN401 - as its base
        """A target that is no robot, or that none sees."""
        incoming = [link.name for name in plan.names for link in plan.assignment(name).neighbours if link.in_law]
        if self.target not in plan.names:
            yield "error", f"the target {self.target!r} is no robot of the experiment", "mend `target` of the law"
        elif self.target not in incoming:
            yield "error", f"no robot sees {self.target}", f'give it links, such as "{self.target} > KH01" = "link"'


def told_by(reading: float, sees: str, position: Vector, x: Sequence[float]) -> Information:
    """Information of a reading at a position of a target that is believed at x; none where it is NaN."""
    east, north = x[0] - position[0], x[1] - position[1]
    far = max(hypot(east, north), NEAREST)
    if sees == "distance":
        change, g = reading - hypot(east, north), (east / far, north / far, 0.0, 0.0)
    else:
        change = remainder(reading - atan2(north, east), 2.0 * pi)
        g = -north / far**2, east / far**2, 0.0, 0.0
    if isnan(change):
        return (0.0,) * 4, rows((0.0,) * 16)
    pull = change + g[0] * x[0] + g[1] * x[1]
    return tuple(each * pull for each in g), [[k * m for m in g] for k in g]


def predicted(y: Values, matrix: Values, seconds: float, density: float, every: Values) -> Information:
    """Information after some time, where `every` is the sum of what all robots know."""
    onward, back = transition(round(seconds, 6), density, every)
    return times(onward, y), product(product(onward, rows(matrix)), back)


@lru_cache(maxsize=8)  # most ages are equal
def transition(t: float, density: float, every: Values) -> tuple[Matrix, Matrix]:
    """W F⁻ᵀ and F⁻¹ for `t` [s], where `every` is the sum of information."""
    a, b = density * t**3 / 3.0, density * t * t / 2.0
    c = density * t
    noise = ((a, 0.0, b, 0.0), (0.0, a, 0.0, b), (b, 0.0, c, 0.0), (0.0, b, 0.0, c))
    back = ((1.0, 0.0, -t, 0.0), (0.0, 1.0, 0.0, -t), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    forward = transposed(back)
    discount = inverse(plus(IDENTITY, product(product(product(forward, rows(every)), back), noise)))
    return product(discount, forward), back


def rows(numbers: Sequence[float]) -> Matrix:
    """Matrix of its numbers, row by row."""
    return [numbers[k : k + 4] for k in range(0, 16, 4)]


def flat(matrix: Matrix) -> Values:
    """Numbers of a matrix, row by row."""
    return tuple(each for row in matrix for each in row)


def transposed(matrix: Matrix) -> Matrix:
    """Columns as rows."""
    return [*zip(*matrix, strict=True)]


def times(matrix: Matrix, vector: Sequence[float]) -> Values:
    """Product with a vector."""
    return tuple(sum(map(mul, row, vector)) for row in matrix)


def product(a: Matrix, b: Matrix) -> Matrix:
    """Product of two matrices."""
    columns = transposed(b)
    return [[sum(map(mul, row, column)) for column in columns] for row in a]


def plus(a: Matrix, b: Matrix) -> Matrix:
    """Sum of two matrices."""
    return [[*map(add, left, right)] for left, right in zip(a, b, strict=True)]


def total(parts: Iterable[Information]) -> Information:
    """Sum of information."""
    vectors, matrices = zip(*parts, strict=True)
    return tuple(map(sum, zip(*vectors, strict=True))), reduce(plus, matrices)


def inverse(matrix: Matrix) -> Matrix:
    """Inverse by Gauss and Jordan; NaN where there is none."""
    left = [[*row, *unit] for row, unit in zip(matrix, IDENTITY, strict=True)]
    for k in range(4):
        best = max(range(k, 4), key=lambda row: abs(left[row][k]))
        left[k], left[best] = left[best], left[k]
        pivot = left[k][k] or nan
        left[k] = [each / pivot for each in left[k]]
        for m in range(4):
            if m != k:
                factor = left[m][k]
                left[m] = [each - factor * other for each, other in zip(left[m], left[k], strict=True)]
    return [row[4:] for row in left]
