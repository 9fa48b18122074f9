"""Plan of a sweep: axes and seeds of the command line, and the cells that they span.

    ./zenpark sweep robotic-park trigger.threshold=0.002:0.05:log12 seeds=50

A cell is one case with one value of each parameter that the case has. A case without a parameter (a periodic trigger
has no threshold) is one cell, however many values the others run through.

Ratios are relative to the first case with the same gain, arena and network, but with its own trigger.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import msgspec
import numpy as np

from agents.plugins.registry import TRIGGERS
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.choices import group_of
from experiments.file.document import Document, chosen
from experiments.file.overrides import Override, parse
from experiments.file.problems import DocumentError, Problem, refusal
from experiments.sweep.runs import digest

SEEDS: Final = 20  # seeds if no number is given
FIRST_TUNING: Final = 1001  # the first seed on which parameters are sought, if none is named
DIGITS: Final = 4  # digits of a value in a range
# tables of the file that make the environment of a run: not chosen, but met
ENVIRONMENT: Final = ("arena", "channel", "disturbance", "duration_s", "hosts", "robots", "start", "timeline", "world")
MOST_CELLS: Final = 20_000
MOST_SEEDS: Final = 100_000
HOW: Final = "write PATH=LOW:HIGH:log12 (or lin12), or PATH=A,B,C; for example trigger.threshold=0.002:0.05:log12"
Scale = Literal["log", "lin"]

_RANGE: Final = re.compile(r"\s*([^:,]+):([^:,]+):(log|lin)([0-9]*)\s*")
_NUMBER: Final = re.compile(r"\s*[+-]?(\d|\.\d)")
_SEEDS: Final = re.compile(r"\s*([0-9]{1,10})\s*(?::\s*([0-9]{1,10})\s*)?")


@dataclass(frozen=True)
class Span:
    """From `low` to `high`, by equal steps or by equal ratios; `whole` if both ends were written as whole numbers."""

    low: float
    high: float
    scale: Scale
    whole: bool

    def at(self, share: float) -> str:
        """The value so far along it, as behind `--set`: 0 is `low`, 1 is `high`; to as many digits as anybody reads."""
        if self.scale == "log":
            value = math.exp(math.log(self.low) + share * (math.log(self.high) - math.log(self.low)))
        else:
            value = self.low + share * (self.high - self.low)
        short = min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high)
        return str(int(short)) if self.whole and short.is_integer() else repr(short)


@dataclass(frozen=True)
class Axis:
    """A value of the file that a sweep changes."""

    argument: str  # text that was written
    path: str  # path, written as for `--set`
    values: tuple[str, ...]  # values, written as for `--set`, each once; empty if only a span is given
    span: Span | None  # span of the values, if they are one

    def at(self, share: float) -> str:
        """The value so far along its span."""
        return self.values[0] if self.span is None else self.span.at(share)


@dataclass(frozen=True)
class Cell:
    """A case with one value of each axis that it has."""

    case: str  # name of the case
    parameters: Mapping[str, Any]  # values of the axes, by path
    plan: Plan  # what is run
    # digest of the reference of the ratios: the first case of the file with the same values, except those of its
    # trigger
    reference: str
    digest: str  # digest of what is run
    # those of `parameters` that the reference has too, or that are no choice: cells are compared where these are equal
    environment: Mapping[str, Any]


def arguments(given: Sequence[str]) -> tuple[list[Axis], dict[str, str]]:
    """Axes and words (`seeds=`, `tuning=`) apart; raises DocumentError if one is not of the form, or comes twice."""
    axes: list[Axis] = []
    words: dict[str, str] = {}
    for argument in given:
        path, equals, text = (part.strip() for part in argument.partition("="))
        if not equals or not path:
            raise refusal(argument, "this is not of the form PATH=VALUES", HOW)
        if not argument.isprintable():
            raise refusal(argument, "this holds characters that are no text", "leave them out")
        if path in words or path in (axis.path for axis in axes):
            raise refusal(argument, f"'{path}' is given twice", "give all its values at once, with commas")
        if path in ("seeds", "tuning"):
            words[path] = argument
        else:
            axes.append(_axis(argument, path, text))
    return axes, words


def seeds_of(argument: str | None, first: int, count: int = SEEDS) -> tuple[int, ...]:
    """The seeds that `seeds=50` (from `first` on) or `seeds=101:150` (both included) names.

    Raises DocumentError if it names none, or cannot be understood.
    """
    if argument is None:
        return tuple(range(first, first + count))
    word, _, text = argument.partition("=")
    found = _SEEDS.fullmatch(text)
    if found is None:
        raise refusal(argument, f"'{text}' names no seeds", f"write {word}=50, or {word}=101:150")
    begin, end = (first, first + int(found[1]) - 1) if found[2] is None else (int(found[1]), int(found[2]))
    if end < begin:
        raise refusal(argument, f"{text} goes down", f"write {word}={end}:{begin}")
    if not 0 < end - begin + 1 <= MOST_SEEDS:
        raise refusal(argument, f"these are {max(0, end - begin + 1)} seeds", f"give 1 to {MOST_SEEDS} of them")
    if end >= 2**32:
        raise refusal(argument, f"there is no seed {end}", "seeds are below 4294967296")
    return tuple(range(begin, end + 1))


def cells(read: Document, file: str, settings: Sequence[str], axes: Sequence[Axis], cases: Sequence[str]) -> list[Cell]:
    """Every cell once, in the order of the cases and of the values; the reference's cells are among them.

    Args:
        read: The file with `settings`.
        settings: As behind `--set`.
        cases: Which cases; all if none is named.

    Raises:
        DocumentError: If there is no case to compare with, a path leads nowhere, a value is refused, or there are too
            many cells.
    """
    compared(read)
    names, order = list(chosen(read, cases)), list(read.cases())
    if (count := math.prod(len(axis.values) for axis in axes)) > MOST_CELLS:
        raise refusal(axes[0].argument, f"these are {count} combinations of values", f"give at most {MOST_CELLS}")
    found: dict[tuple[str, str], Cell] = {}
    for values in itertools.product(*(axis.values for axis in axes)):
        for cell in combination(read, file, settings, dict(zip(axes, values, strict=True)), names):
            found.setdefault((cell.case, cell.digest), cell)
    return sorted(found.values(), key=lambda cell: order.index(cell.case))


def combination(
    read: Document, file: str, settings: Sequence[str], values: Mapping[Axis, str], names: Sequence[str]
) -> Iterator[Cell]:
    """The reference, then the named cases, with these values.

    Raises DocumentError if a path leads nowhere, or a value is refused.
    """
    paths = {axis: _parsed(axis, value, read) for axis, value in values.items()}
    first = compared(read)
    others = {axis: value for axis, value in values.items() if not _of_trigger(paths[axis])}
    changed = _changed(file, settings, values)
    compared_with = changed if others == values else _changed(file, settings, others)
    reference = digest(compared_with[first])
    shared = [axis for axis in others if _has(first, compared_with[first], paths[axis])]
    for name, plan, given in (
        (first, compared_with[first], others),
        *((name, changed[name], values) for name in names),
    ):
        own = [axis for axis in given if _has(name, plan, paths[axis])]
        chosen_values = {axis.path: paths[axis].value for axis in own}
        met = {axis.path: paths[axis].value for axis in own if axis in shared or paths[axis].path[0] in ENVIRONMENT}
        yield Cell(name, chosen_values, plan, reference, digest(plan), met)


def _changed(file: str, settings: Sequence[str], values: Mapping[Axis, str]) -> dict[str, Plan]:
    try:
        return document.read(file, [*settings, *(f"{axis.path}={value}" for axis, value in values.items())]).cases()
    except DocumentError as error:
        raise DocumentError([_renamed(problem, values) for problem in error.problems]) from None


def _of_trigger(parsed: Override) -> bool:
    """Whether it changes the triggers of all cases."""
    parts = range(1, len(parsed.path) + 1)
    return parsed.case is None and any(group_of(parsed.path[:end]) == TRIGGERS for end in parts)


def compared(read: Document) -> str:
    """The case that ratios are taken over."""
    if not read.experiment.cases:
        hint = 'add one above what it is to be compared with: [cases.periodic] with trigger = "periodic"'
        raise refusal(str(read.path), "there is no case in it to compare with", hint)
    return next(iter(read.cases()))


def _axis(argument: str, path: str, text: str) -> Axis:
    if not text:
        raise refusal(argument, "there is no value in it", HOW)
    found = _RANGE.fullmatch(text)
    if found is None:
        if ":" in text and _NUMBER.match(text):
            raise refusal(argument, f"'{text}' is no range", HOW)
        values = [part.strip() for part in _parts(text)]
        if "" in values:
            raise refusal(argument, "a value is missing between two commas", HOW)
        if len(set(values)) < len(values):
            raise refusal(argument, "a value is given twice", "give each once")
        return Axis(argument, path, tuple(values), None)
    whole = all(part.strip().lstrip("+-").isdigit() for part in (found[1], found[2]))
    try:
        span = Span(float(found[1]), float(found[2]), "log" if found[3] == "log" else "lin", whole)
    except ValueError:
        raise refusal(argument, f"'{found[1]}:{found[2]}' are no two numbers", HOW) from None
    if not (math.isfinite(span.low) and math.isfinite(span.high) and span.low < span.high):
        raise refusal(argument, f"from {span.low:g} to {span.high:g} is no range", "the lower end comes first")
    if span.scale == "log" and span.low <= 0.0:
        raise refusal(argument, "a logarithmic range cannot reach zero", "begin above 0, or write lin for equal steps")
    if found[4] and not 2 <= int(found[4][:9]) <= MOST_CELLS:
        raise refusal(argument, f"{found[4]} values make no range", f"give 2 to {MOST_CELLS}")
    shares = np.linspace(0.0, 1.0, int(found[4])).tolist() if found[4] else []
    return Axis(argument, path, tuple(dict.fromkeys(map(span.at, shares))), span)


def _parts(text: str) -> list[str]:
    """A list of values apart: commas inside of brackets and quotes belong to a value."""
    parts = [""]
    depth, quote = 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        if letter == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _parsed(axis: Axis, value: str, read: Document) -> Override:
    """Path, value and case of an axis at a value."""
    try:
        return parse(f"{axis.path}={value}", {"cases": read.experiment.cases})
    except DocumentError as error:
        (problem,) = error.problems
        raise refusal(axis.argument, problem.message, problem.hint.replace("--set ", "")) from None


def _has(case: str, plan: Plan, parsed: Override) -> bool:
    """Whether a case has what is changed: a parameter of a plug-in if it has chosen that plug-in, and no `--set` of the
    case has the last word."""
    path, value = parsed.path, parsed.value
    if parsed.case not in (None, case):
        return False
    found: Any = plan.experiment
    for end, step in enumerate(path):
        in_choice = end > 0 and group_of(path[:end]) is not None
        if in_choice and step == "kind":
            return True
        if isinstance(found, msgspec.Struct) and isinstance(step, str):
            found = getattr(found, step, value)
        elif isinstance(found, dict):
            if in_choice and step not in found:
                return False
            found = found.get(step, value)
        else:
            return not in_choice
    return found == value or not (_is_plain(found) and _is_plain(value))


def _is_plain(value: object) -> bool:
    """Whether a value is read from a file as it stands there: a word, a number, or a list of numbers."""
    if isinstance(value, list):
        return all(isinstance(each, int | float) for each in value)
    return isinstance(value, int | float | str)


def _renamed(problem: Problem, values: Mapping[Axis, str]) -> Problem:
    """A problem with a value, at the argument that the user wrote."""
    for axis, value in values.items():
        if problem.file == f"--set {axis.path}={value}":
            return Problem(axis.argument, 0, 0, f"at {value}: {problem.message}", problem.hint)
    return problem
