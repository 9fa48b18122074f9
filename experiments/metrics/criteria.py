"""Judgement of runs by the criteria of their experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from agents.plugins.files import plain
from experiments.definition.experiment import MEAN, WORST, Criterion
from experiments.metrics.metric import known_metrics, metrics_in_files
from experiments.metrics.results import CaseMetrics, Judged, RobotMetrics
from experiments.metrics.statistics import by_case, ratio


class Judgement(msgspec.Struct, frozen=True):
    """A criterion against the runs of one case."""

    criterion: Criterion
    case: str  # case that is judged; empty if none of the runs is of the case
    values: dict[int, float | None]  # value by seed, over the reference where limits are relative; None: unknown
    measures: tuple[str, ...] = ()  # numbers that the law of the case measures

    @property
    def failed(self) -> list[int]:
        """Seeds that do not keep the limit, or have no known value."""
        return [seed for seed in self.values if not self.keeps(seed)]

    def keeps(self, seed: int) -> bool | None:
        """Whether the value of a seed is known and keeps the limit; None if it was not judged."""
        value = self.values.get(seed)
        return (value is not None and self.criterion.excess(value) <= 0.0) if self.values else None

    @property
    def passed(self) -> bool | None:
        """Whether all seeds keep the limit; None if none was judged."""
        return not self.failed if self.values else None

    @property
    def what(self) -> str:
        """The number that is judged, in words."""
        asked = self.criterion
        name = plain(asked.metric or "") or asked.measure
        metric = (known_metrics() | metrics_in_files([asked.metric or ""])[0]).get(name or "")
        name = metric.head if metric else name
        where = {MEAN: "", WORST: " of the worst robot"}.get(asked.of, f" of {asked.of}")
        return f"{name}{where} in {self.case or asked.case}"

    @property
    def limit(self) -> str:
        """The limits in words."""
        asked = self.criterion
        limits = (("at most", asked.at_most), ("at least", asked.at_least))
        words = " and ".join(f"{word} {value:g}" for word, value in limits if value is not None)
        return words if asked.relative_to is None else f"{words} times that in {asked.relative_to}"


def judge(cases: Sequence[CaseMetrics]) -> list[Judgement]:
    """Each criterion of runs, any number of seeds, against each case that it is for."""
    runs = by_case(cases)
    found = []
    for asked in [*{msgspec.json.encode(each): each for case in cases for each in case.criteria}.values()]:
        names = [name for name in runs if asked.case in (None, name) and name != asked.relative_to]
        reference = runs.get(asked.relative_to or "", ())
        by_seed = {each.seed: None if each.spoiled else _value(asked, each) for each in reference}
        found += [Judgement(asked, name, _values(asked, runs[name], by_seed), _measures(runs[name])) for name in names]
        if not names:
            found.append(Judgement(asked, "", {}))
    return found


def with_judgements(cases: Sequence[CaseMetrics]) -> list[CaseMetrics]:
    """The same runs, each with the values that its criteria judge."""
    found = judge(cases)
    return [
        msgspec.structs.replace(
            case,
            judged=tuple(
                Judged(each.what, each.limit, each.values.get(case.seed), each.keeps(case.seed))
                for each in found
                if each.case == case.case
            ),
        )
        for case in cases
    ]


def document(judged: Sequence[Judgement]) -> dict[str, Any]:
    """Judgements for scripts: `passed` is None if none failed and some were not judged; empty without criteria."""
    if not judged:
        return {}
    rows = [
        {
            **msgspec.to_builtins(each.criterion),
            **({"metric": plain(each.criterion.metric)} if each.criterion.metric else {}),
            "case": each.case or each.criterion.case,
            "passed": each.passed,
            "values": {str(seed): value for seed, value in each.values.items()},
        }
        for each in judged
    ]
    return {"passed": has_passed(judged), "criteria": rows}


def has_passed(judged: Sequence[Judgement]) -> bool | None:
    """Whether all criteria are kept; None if none failed and some were not judged."""
    answers = [each.passed for each in judged]
    return False if False in answers else None if None in answers else True


def _measures(runs: Sequence[CaseMetrics]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for run in runs for robot in run.robots for name in robot.measures))


def _values(
    asked: Criterion, runs: Sequence[CaseMetrics], reference: Mapping[int, float | None]
) -> dict[int, float | None]:
    """Judged values by seed; empty where the reference was not run, and unknown ratios of spoiled runs."""
    values = {run.seed: _value(asked, run) for run in runs}
    if asked.relative_to is None:
        return values
    spoiled = {run.seed for run in runs if run.spoiled}
    ratios = {seed: ratio(value, reference.get(seed)) for seed, value in values.items()}
    return {seed: None if seed in spoiled else value for seed, value in ratios.items()} if reference else {}


def _value(asked: Criterion, run: CaseMetrics) -> float | None:
    """The number of a run that a criterion judges; None if it is unknown, or the run was interrupted."""
    name = plain(asked.metric or asked.measure or "")
    if run.interrupted:
        return None
    by_robot = {robot.robot: robot.value(name) if asked.metric else _measure(robot, name) for robot in run.robots}
    of_case = all(value is None for value in by_robot.values())
    if asked.metric and name in run.mean and (asked.of == MEAN or of_case):
        return run.mean[name]
    if asked.of in by_robot:
        return by_robot[asked.of]
    out = {*run.leaders, *run.died}
    kept = [value for robot, value in by_robot.items() if robot not in out]
    known = [value for value in kept if value is not None]
    if not known or len(known) < len(kept):
        return None
    if asked.of == MEAN:
        return sum(known) / len(known)
    return min(known) if asked.at_most is None else max(known)


def _measure(robot: RobotMetrics, name: str) -> float | None:
    found = robot.measures.get(name)
    return None if found is None else found.end
