"""Statistics over runs: one case with several seeds, and one case against another."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import msgspec

from experiments.metrics.comparable import SAME_COVERAGE, coverage, equally_long
from experiments.metrics.metric import known_metrics
from experiments.metrics.results import CaseMetrics
from experiments.recording.trace import Trace


def ratio(value: float | None, reference: float | None) -> float | None:
    """The value over its reference; None where the reference is 0 or either is unknown."""
    return None if value is None or not reference else value / reference


def ratios(runs: Sequence[CaseMetrics], reference: Sequence[CaseMetrics], index: str) -> list[float | None]:
    """Ratio of a metric of each run to the reference: to the same seed if all seeds are the same, else to its mean.

    None for disturbed runs, and for runs that are shorter than others. None as well for sums of a run with fewer known
    data than others. Such a run of the reference is left out.
    """
    every = [*runs, *reference]
    metric = known_metrics(every).get(index)
    sums = metric is not None and metric.sums
    longest, most = max(run.duration_s for run in every), max(coverage(run) for run in every)

    def value(run: CaseMetrics) -> float | None:
        less = sums and most - coverage(run) > SAME_COVERAGE
        return None if run.spoiled or less or not equally_long((run.duration_s, longest)) else run.mean.get(index)

    values, others = ({run.seed: value(run) for run in each} for each in (runs, reference))
    mean, paired = spread([*others.values()]).mean, values.keys() == others.keys()
    return [ratio(known, others[seed] if paired else mean) for seed, known in values.items()]


def by_case(cases: Sequence[CaseMetrics]) -> dict[str, list[CaseMetrics]]:
    """Runs of the same case together, cases in the order of their first run."""
    grouped: dict[str, list[CaseMetrics]] = {}
    for case in cases:
        grouped.setdefault(case.case, []).append(case)
    return grouped


def first_seed(traces: Sequence[Trace]) -> list[Trace]:
    """First trace of each case."""
    return list({trace.case: trace for trace in reversed(traces)}.values())[::-1]


def across_seeds(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean, standard deviation and 95 % confidence half-width of each metric and ratio over runs of several seeds.

    Returns:
        `{"seeds": [...], "cases": {case: {"mean" | "ratio": {metric: {"mean", "std", "ci95", "n"}}}}}`. `n` counts the
        seeds for which the value is known; the half-width is Student's, None for fewer than two. Of runs that were
        spoiled or interrupted, which the means include, also `{"flawed": {case: {seed: [reason, ...]}}}`.
    """
    cases = list(dict.fromkeys(case for each in documents for case in each["cases"]))
    names = dict.fromkeys(name for each in documents for found in each["cases"].values() for name in found["mean"])
    flawed: dict[str, dict[int, list[str]]] = {}
    for each in documents:
        for case, found in each["cases"].items():
            cut = [f"interrupted after {found['duration_s']:.1f} s"] if found.get("interrupted") else []
            if reasons := [*found.get("spoiled", ()), *cut]:
                flawed.setdefault(case, {})[each["seed"]] = reasons
    return ({"flawed": flawed} if flawed else {}) | {
        "seeds": [each["seed"] for each in documents],
        "cases": {
            case: {
                group: {
                    name: msgspec.structs.asdict(
                        spread([each["cases"][case][group].get(name) for each in documents if case in each["cases"]])
                    )
                    for name in names
                }
                for group in ("mean", "ratio")
            }
            for case in cases
        },
    }


class Spread(msgspec.Struct, frozen=True):
    """Mean, standard deviation and 95 % confidence half-width (Student's, None for fewer than two) of `n` values."""

    mean: float | None
    std: float | None
    ci95: float | None
    n: int


def spread(values: Sequence[float | None]) -> Spread:
    """Statistics of the known values."""
    known = [value for value in values if value is not None]
    n = len(known)
    deviation = statistics.stdev(known) if n > 1 else None
    return Spread(
        mean=statistics.fmean(known) if known else None,
        std=deviation,
        ci95=None if deviation is None else student_95(n - 1) * deviation / math.sqrt(n),
        n=n,
    )


@cache
def student_95(freedom: int) -> float:
    """Two-sided 95 % quantile of Student's t, exact to rounding; from 100 on by Fisher's expansion (1e-9).

    The share inside of ±√n tan θ is a finite sum (Abramowitz, Stegun, "Handbook of Mathematical Functions", 26.7.3, 4).
    """
    if freedom < 100:
        low, high = 0.0, 0.5 * math.pi
        for _ in range(60):  # halved until only rounding is left
            angle = 0.5 * (low + high)
            low, high = (low, angle) if _share_inside(angle, freedom) > 0.95 else (angle, high)
        return math.sqrt(freedom) * math.tan(low)
    z = statistics.NormalDist().inv_cdf(0.975)
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return math.fsum(term / float(freedom) ** k for k, term in enumerate(terms))


def _share_inside(angle: float, freedom: int) -> float:
    """Share of Student's t inside of ±√n tan θ."""
    odd, cosine = freedom % 2, math.cos(angle)
    total = 0.0
    term = cosine if odd else 1.0
    for power in range(odd, freedom - 1, 2):
        total += term
        term *= cosine * cosine * (power + 1) / (power + 2)
    share = math.sin(angle) * total
    return 2.0 / math.pi * (angle + share) if odd else share
