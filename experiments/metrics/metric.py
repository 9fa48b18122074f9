"""Metrics: what each is called, how runs are compared by it, and how it is measured; ours, and those from outside.

One of ours is one row of `OURS`; console, files, reports, sweeps and searches draw from `known_metrics`. A distribution
adds one under `[project.entry-points."zenpark.metrics"]`, see docs/metrics.md.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from math import isfinite, nan
from operator import attrgetter
from pathlib import Path
from traceback import extract_tb
from typing import Any, ClassVar, Final, Literal, cast

import msgspec
import numpy as np

from agents.errors import did_you_mean
from agents.plugins import files, registry
from agents.plugins.calls import supervised
from agents.plugins.law import Measure
from experiments.definition.experiment import Criterion
from experiments.definition.plan import Plan
from experiments.metrics.results import CaseMetrics, RobotMetrics
from experiments.metrics.signals import Measurement, closest_distance, mean_known
from experiments.recording.trace import Trace
from twins.arrays import Array, Index

Per = Literal["robot", "case"]
Better = Literal["less", "more", ""]
Mean = Literal["known", "all", "sum", "worst"]
Number = float | None
PLAIN: Final = str.maketrans({"²": "^2", "³": "^3", "·": " "})  # signs for MATLAB, which reads ASCII
FORMULA: Final = str.maketrans({"²": "$^2$", "³": "$^3$", "·": " "})  # signs for figures


class Metric(msgspec.Struct, frozen=True):
    """A measured quantity; its docstring is its definition in reports."""

    label: ClassVar[str] = ""  # heads of tables, axes
    unit: ClassVar[str] = ""
    per: ClassVar[Per] = "robot"
    better: ClassVar[Better] = "less"
    # from robots to the case: mean of the known values, mean if all are known, sum over all robots, worst value
    mean: ClassVar[Mean] = "known"
    sums: ClassVar[bool] = False  # adds up over what is known of a run: no ratio where less of a run is known
    relative: ClassVar[bool] = True  # sweeps, limits and searches take it over the reference
    swept: ClassVar[bool] = True  # a column of sweeps
    shown: ClassVar[bool] = True  # a column in the terminal and in the tables of reports
    console: ClassVar[bool] = False  # figure of ours in a line of the terminal; others are there if `shown`
    figure: ClassVar[bool] = False  # a bar; with `relative` and `shown` a Pareto front as well
    needs: ClassVar[tuple[str, ...]] = ("true_position",)  # fields of the trace: a sweep keeps these

    def applies(self, trace: Trace) -> bool:
        """Whether it has a meaning for a run; where it has none it is no column, unless a file asks for it."""
        return True

    def of(self, trace: Trace, shared: Measurement) -> Array | Index | float:
        """Values of all robots (N,), or of the case (); NaN where unknown. A pure function: it changes no array."""
        raise NotImplementedError

    @property
    def meaning(self) -> str:
        """The definition, on one line."""
        return " ".join((type(self).__doc__ or "").split())

    @property
    def head(self) -> str:
        """Label and unit, for the head of a table."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def average(self, values: Sequence[Number]) -> Number:
        """The value of a case, from those of the robots in the means."""
        known = [value for value in values if value is not None]
        if not known or (self.mean == "all" and len(known) < len(values)):
            return None
        if self.mean == "worst":
            return min(known) if self.better == "more" else max(known)
        return statistics.fmean(known)


def _row(
    of: str | Callable[[Measurement], Array | Index | Sequence[Number] | float],
    label: str, meaning: str, **facts: object,
) -> Metric:  # fmt: skip
    """A metric of zenpark as an object of a class of its own, with the attributes `facts`.

    Args:
        of: Quantity of the measurement by its name, or a function of it; unknown values are NaN or None.
    """
    value = attrgetter(of) if isinstance(of, str) else of

    def measured(_metric: Metric, _trace: Trace, shared: Measurement) -> object:
        found = value(shared)
        return np.array(found, dtype=float) if isinstance(found, list) and None in found else found

    body = {"of": measured, "label": label, "__doc__": meaning, **facts}
    made = msgspec.defstruct(label, [], bases=(Metric,), namespace=body, module=__name__, frozen=True)
    return cast(type[Metric], made)()


UNSEEN: Final = {"mean": "sum", "swept": False, "shown": False}  # they do not occur in virtual time
OF_CASE: Final = {"per": "case", "swept": False, "shown": False}
OURS: Final[Mapping[str, Metric]] = {  # names of the fields of `RobotMetrics`, and then those of the case
    "f_hz": _row("rate", "f",
        "Transmissions over duration. Counted by running numbers, so that what a recorder lost counts too.", unit="Hz",
        relative=False, console=True, figure=True),
    "messages": _row(lambda m: m.transmissions[0], "Messages", "Transmissions of a robot, by their running numbers."),
    "bytes": _row("payload", "Payload", "Payload of the transmissions of a robot.", unit="bytes", swept=False,
        shown=False),
    "iae": _row(lambda m: m.integrals[0], "IAE", "Integral of e(t) over the run (trapezoidal).", unit="m s", sums=True,
        console=True, figure=True),
    "itae": _row(lambda m: m.integrals[1], "ITAE", "Integral of t · e(t); t counts from the common start.",
        unit="m s²", sums=True, figure=True),
    "rmse": _row(lambda m: m.integrals[2], "RMSE", "Root of the mean of e(t)².", unit="m", shown=False,
        console=True, figure=True),
    "acquired_s": _row("acquired", "Acquired",
        "From when on the moving mean over one second of the error of each link stays within the tolerance, until the"
        " next phase or the end; 0 if it never left. \"By all\" is when the last follower was there; the mean over"
        " followers is of their own times, and is given only if every follower acquired.", unit="s", mean="all",
        relative=False, console=True),
    "updates": _row("trace.decisions", "Updates", "Goals that a robot recomputed.", relative=False, shown=False),
    "lost": _row("trace.lost", "Lost samples", "Poses that by their numbers were sent and never reached a receiver.",
        **UNSEEN),
    "dropped": _row("dropped", "Dropped", "Poses that the modelled network dropped, over all receivers.", mean="sum",
        relative=False),
    "missed_deadlines": _row("trace.missed_deadlines", "Missed deadlines",
        "Ticks that were skipped because their time had passed; shares are of the ticks that were due.", **UNSEEN),
    "j2": _row("cost", "J2",
        "Cost of the authors' benchmark: 0.02 · transmissions + 0.1 · decisions + 0.3 · settling time + 0.1 · IAE +"
        " 0.01 · ITAE, summed over the robots that receive poses, all until the settling time: the last time at which"
        " Σ(r² − d²) is farther from its end than 2 % of its way. IAE and ITAE are halved: a link has two ends.",
        **OF_CASE),
    "belief_rms": _row(lambda m: np.sqrt(mean_known(m.belief.reshape(-1) ** 2)), "Belief error, RMS",
        "Error of a receiver's estimate of a neighbour, over all links: the newest pose received, carried on by the"
        " prediction until the next.", unit="m", **OF_CASE),
    "belief_max": _row(lambda m: m.belief.max(initial=-np.inf, where=np.isfinite(m.belief)), "Belief error, largest",
        "The largest of these errors.", unit="m", **OF_CASE),
    "closest": _row(lambda m: closest_distance(m.trace.true_position), "Closest robots",
        "Smallest distance between two centres.", unit="m", better="more", **OF_CASE),
}  # fmt: skip
DETAILS: Final[dict[str, Metric]] = {  # fields of `RobotMetrics` without a mean
    "residual": _row(lambda m: [each.residual for each in m.phases[0]], "Worst link",
        "|error| of the worst link, averaged over the last second of the first phase.", unit="m"),
    "settle_s": _row("settled", "Settled",
        "When e(t) enters the 2 % band of its largest value for good; the duration of the run if never.", unit="s"),
    "missed_share": _row(lambda m: m.trace.missed_deadlines / (m.trace.ticks + m.trace.missed_deadlines), "Missed",
        "Missed deadlines over the ticks that were due, made or missed."),
    "gap_min_s": _row(lambda m: m.gap(np.min), "Shortest gap", "Shortest time between transmissions.", unit="s"),
    "gap_median_s": _row(lambda m: m.gap(np.median), "Median gap", "Median time between transmissions.", unit="s"),
    "gap_max_s": _row(lambda m: m.gap(np.max), "Longest gap", "Longest time between transmissions.", unit="s"),
    "recorded": _row(lambda m: m.transmissions[1], "Recorded", "Poses in the recording."),
    "receivers": _row("architecture.receivers", "Receivers", "Receivers, the central controller too."),
    "received": _row("architecture.received", "Received", "Poses received, by all receivers together."),
    "coverage": _row(lambda m: m.errors.coverage() if m.has_errors else [None] * len(m.trace.robots), "Known errors",
        "Known share of a robot's link errors."),
    "known": _row("known", "Known", "Share of the run in which the robot's own position is known."),
    "collisions": _row(lambda m: list(map(len, m.contacts)), "Collisions", "Contacts with robots, obstacles, walls."),
    "impulse": _row(
        lambda m: [max((c.impulse for c in own if c.impulse is not None), default=None) for own in m.contacts],
        "Impulse", "Impulse of the hardest contact.", unit="N s"),
    "overlap": _row(lambda m: [max((c.overlap for c in own), default=None) for own in m.contacts], "Overlap",
        "Depth of the deepest contact.", unit="m"),
    "short": _row("short", "Short", "Distance from the end of the robot's plan.", unit="m"),
    "interventions": _row("trace.interventions", "Interventions", "Ticks on which safety changed the decision."),
    "intervened_share": _row(lambda m: m.trace.interventions / m.trace.ticks, "Changed by safety",
        "Share of the ticks on which safety changed the decision."),
    "avoided": _row("trace.avoided", "Avoided", "Ticks on which avoidance changed the decision."),
    "avoided_share": _row(lambda m: m.trace.avoided / m.trace.ticks, "By avoidance",
        "Share of the ticks on which avoidance changed the decision."),
    "goals": _row("architecture.goals", "Goals", "Goals that the central controller sent."),
    "goal_bytes": _row("architecture.goal_bytes", "Payload of goals", "Payload of the goals of a robot.",
        unit="bytes"),
    "delay_mean_s": _row("architecture.delay_mean_s", "Delay, mean",
        "From the measurement of a pose until the robot acts on the first goal that rests on it.", unit="s"),
    "delay_p95_s": _row("architecture.delay_p95_s", "Delay, 95 %", "95 % of the same delays are shorter.", unit="s"),
    "delay_max_s": _row("architecture.delay_max_s", "Delay, longest", "The longest of the same delays.", unit="s"),
    "foreign": _row(lambda m: [0] * len(m.trace.robots) if m.trace.foreign is None else m.trace.foreign,
        "Foreign poses", "Poses in the robot's name that did not come from its process, and were refused."),
}  # fmt: skip
FIGURES: Final = {**OURS, **DETAILS}  # figures of ours: those of robots are the fields of `RobotMetrics`
ERRORS: Final = tuple(name for name, metric in OURS.items() if metric.figure and metric.relative)
TAKEN: Final = {  # columns of tables
    *RobotMetrics.__struct_fields__, *CaseMetrics.__struct_fields__,
    *("in_mean", "gap", "reference", "seeds", "acquired_share"),
}  # fmt: skip
# fields of a trace that a lean log of `experiments.virtual_time.simulation.simulate` keeps
LEAN: Final = frozenset(
    {
        *("case", "plan", "seed", "robots", "clock", "time", "true_position", "events", "dropped"),
        *("ticks", "decisions", "interventions", "avoided", "lost", "missed_deadlines", "measures"),
    }
)
_COLUMNS: Final = frozenset(each.name for each in fields(Trace))
OF_LAW: Final = "measure_"  # first letters of the names of metrics that are measures of a law
_FACTS: Final = ("label", "unit", "per", "better", "mean", "sums", "relative", "swept", "shown", "figure")


def known_metrics(cases: Iterable[CaseMetrics] = ()) -> dict[str, Metric]:
    """All metrics by name: ours, and `foreign_metrics` of the cases."""
    return {**OURS, **foreign_metrics(cases)}


def swept_metrics(plans: Iterable[Plan] = ()) -> dict[str, Metric]:
    """Metrics that are columns of sweeps, with those that these plans and their laws name."""
    found = known_metrics()
    for plan in plans:
        found |= metrics_of(plan)[0] | law_metrics(plan.law.MEASURES)
    return {name: metric for name, metric in found.items() if metric.swept}


def law_metrics(measures: Mapping[str, Measure]) -> dict[str, Metric]:
    """Two metrics of each measure of a law: over the run, with a ratio and a figure, and over the last second."""
    return {
        f"{OF_LAW}{name}_{when}": metric
        for name, measure in measures.items()
        for when, metric in zip(("mean", "end"), _of_measure(name, measure), strict=True)
    }


def _of_measure(name: str, measure: Measure) -> tuple[Metric, Metric]:
    facts: dict[str, Any] = {"unit": measure.unit, "better": measure.better, "needs": ("true_position", "measures")}
    facts |= {"applies": lambda _metric, trace: name in trace.measures}
    judged = bool(measure.better)
    return (
        _row(
            lambda m: mean_known(m.trace.measures[name]), f"{name} (mean)",
            f"Measure {name} of the law, mean over the run.", relative=judged, figure=judged, **facts,
        ),
        _row(
            lambda m: mean_known(m.trace.measures[name][-m.window :]), f"{name} (end)",
            f"Measure {name} of the law, mean over the last second.", relative=False, **facts,
        ),
    )  # fmt: skip


def measures_of(trace: Trace) -> dict[str, Measure]:
    """Measures that the law of a run gave."""
    return {name: trace.plan.law.MEASURES.get(name, Measure()) for name in trace.measures}


def measures_in(values: Iterable[str]) -> dict[str, Measure]:
    """Measures without a unit, by the names of their metrics among those of `values`."""
    named = (name for name in values if name.startswith(OF_LAW) and name.endswith("_mean"))
    return {name.removeprefix(OF_LAW).removesuffix("_mean"): Measure() for name in named}


def facts_of(metrics: Mapping[str, Metric]) -> dict[str, dict[str, Any]]:
    """Attributes of metrics that are neither ours nor installed, for a file."""
    known = known_metrics()
    return {
        name: {fact: getattr(metric, fact) for fact in _FACTS} | {"meaning": metric.meaning}
        for name, metric in metrics.items()
        if name not in known
    }


def from_facts(facts: Mapping[str, Mapping[str, Any]]) -> dict[str, Metric]:
    """Metrics as `facts_of` describes them, without a way to measure them; raises ValueError for other facts."""
    if any({*_FACTS, "meaning"} != {*each} for each in facts.values()):
        raise ValueError("metrics of another version")
    return {name: _row(_elsewhere, **each) for name, each in facts.items()}


def _elsewhere(_shared: Measurement) -> float:
    return nan


def foreign_metrics(cases: Iterable[CaseMetrics] = ()) -> dict[str, Metric]:
    """Metrics of other distributions, those in files that the cases name, and measures of their laws.

    Of `cases` only those that one names or has: others do not apply to them.
    """
    measured, installed = list(cases), installed_metrics()[0]
    named = [*dict.fromkeys(name for case in measured for name in (*_judged(case.criteria), *case.asked))]
    if measured:
        held = {name for case in measured for name in installed if _has_value(case, name)}
        installed = {name: metric for name, metric in installed.items() if name in {*named, *held}}
    measures = {name: Measure(each.unit, each.better) for case in measured for name, each in case.measures.items()}
    return installed | metrics_in_files(named)[0] | law_metrics(measures)


def _has_value(case: CaseMetrics, name: str) -> bool:
    values = (case.mean.get(name), *(robot.extra.get(name) for robot in case.robots))
    return any(value is not None for value in values)


def console_metrics(cases: Iterable[CaseMetrics] = ()) -> dict[str, Metric]:
    """Metrics in a line of the terminal; of others, `foreign_metrics` of the cases."""
    added = {name: metric for name, metric in foreign_metrics(cases).items() if metric.shown}
    return {name: metric for name, metric in OURS.items() if metric.console} | added


def terminal_labels(metrics: Mapping[str, Metric]) -> dict[str, str]:
    """Label of each metric; one of a file that has the label of another has its file behind it."""
    labels = Counter(metric.label for metric in metrics.values())
    return {
        name: f"{metric.label} ({name.partition(':')[0]})"
        if labels[metric.label] > 1 and files.is_choice(name)
        else metric.label
        for name, metric in metrics.items()
    }


def metrics_of(plan: Plan) -> tuple[dict[str, Metric], tuple[str, ...]]:
    """Metrics in files beside an experiment that it names, by name, and why others cannot be used."""
    return metrics_in_files((*_judged(plan.experiment.criteria), *plan.experiment.metrics))


def _judged(criteria: Iterable[Criterion]) -> list[str]:
    return [each.metric for each in criteria if each.metric]


def metrics_in_files(names: Iterable[str]) -> tuple[dict[str, Metric], tuple[str, ...]]:
    """Metrics in files among these, by name, and why others cannot be used."""
    found, left_out = {}, []
    for name in dict.fromkeys(names):
        if files.is_choice(name):
            try:
                found[files.plain(name)] = usable_metric(name)
            except registry.PluginError as error:
                left_out.append(f"metric {files.plain(name)} is unknown: {' '.join(str(error).split())}")
    return found, tuple(left_out)


def unusable_metrics() -> tuple[str, ...]:
    """Reasons why registered metrics are left out, a sentence each."""
    return installed_metrics()[1]


def short_name(name: str) -> str:
    """Name of a metric on the command line: `f` for `f_hz`."""
    return name.removesuffix("_hz").removesuffix("_s")


@cache
def installed_metrics() -> tuple[dict[str, Metric], tuple[str, ...]]:
    """Metrics of installed packages by name, and a sentence for each one that is left out."""
    found, left_out = {}, []
    for name in registry.names(registry.METRICS):
        try:
            found[name] = usable_metric(name)
        except registry.PluginError as error:
            left_out.append(f"metric {name} is left out: {' '.join(str(error).split())} (docs/metrics.md)")
    return found, tuple(left_out)


def usable_metric(name: str) -> Metric:
    """The metric registered under a name; raises PluginError if it cannot be used."""
    plugin = cast(type[Metric], registry.struct(registry.METRICS, name))
    wrong = ""
    if not files.is_choice(name) and (not name.isidentifier() or name != name.lower()):
        wrong = "its name must be of small letters, digits and _"
    elif name in TAKEN or short_name(name) in {short_name(each) for each in OURS}:
        wrong = "zenpark has something of this name: register it under another one"
    elif plugin.__struct_fields__:
        wrong = f"it has parameters ({', '.join(plugin.__struct_fields__)}), and no file gives them"
    elif not isinstance(plugin.label, str) or not plugin.label or not isinstance(plugin.unit, str):
        wrong = "label and unit must be texts, and the label not empty"
    elif bad := [each for each in plugin.needs if each not in _COLUMNS]:
        wrong = f"needs names {bad[0]!r}, and a trace has no such field: {did_you_mean(bad[0], sorted(_COLUMNS))}"
    if wrong:
        raise registry.PluginError(wrong)
    return plugin()


class _LeanTrace(Trace):
    """Trace of a sweep; a field that no metric needs is not kept, and reading it raises PluginError."""

    def __getattribute__(self, name: str) -> Any:  # noqa: ANN401 - as the fields are
        if name in _COLUMNS - LEAN - {"sent"}:  # numbers and times of `sent` are kept
            raise registry.PluginError(f"it reads {name!r}, which its `needs` does not name: a sweep keeps no more")
        return super().__getattribute__(name)


@supervised()
def values_of(
    metrics: Mapping[str, Metric], shared: Measurement, *, lean: bool = False
) -> tuple[dict[str, list[Number]], tuple[str, ...]]:
    """Values of metrics by robot, or the single one of a case; and which metrics failed, a sentence each.

    A metric of another distribution that fails has unknown values. Integers stay integers. A `lean` trace has the
    fields `LEAN` alone.
    """
    trace = shared.trace
    shown = _LeanTrace(**{name: getattr(trace, name) for name in _COLUMNS}) if lean else trace
    found: dict[str, list[Number]] = {}
    failed = []
    for name, metric in metrics.items():
        count, wanted = 1, "one number"
        if metric.per == "robot":
            count = len(trace.robots)
            wanted = f"{count} numbers, one for each robot"
        try:
            if name not in OURS and not metric.applies(shown):
                found[name] = [None] * count
                continue
            with np.errstate(all="ignore"):
                values = np.asarray(metric.of(trace if name in OURS else shown, shared))
            if values.shape != ((count,) if metric.per == "robot" else ()) or values.dtype.kind not in "iuf":
                raise ValueError(f"it gives {values.dtype} {values.shape}, not {wanted}")
            found[name] = [each if isfinite(each) else None for each in values.reshape(count).tolist()]
        except registry.FAILURES as error:
            if name in OURS:
                raise
            found[name] = [None] * count
            code, frames = metric.of.__code__, extract_tb(error.__traceback__)
            lines = [each.lineno for each in frames if each.filename == code.co_filename]  # none for a wrong result
            where = f"{Path(code.co_filename).name}:{lines[-1] if lines else code.co_firstlineno}"
            failed.append(f"metric {name} failed: {type(error).__name__}: {error} ({where})")
    return found, tuple(failed)


def case_values(
    metrics: Mapping[str, Metric], values: Mapping[str, Sequence[Number]], kept: Sequence[int], *, sums: bool = False
) -> dict[str, Number]:
    """Each metric of a case: over the robots in the means; with `sums`, what adds up over robots is over all."""
    found: dict[str, Number] = {}
    for name, metric in metrics.items():
        if metric.per == "case":
            (found[name],) = values[name]
        elif sums and metric.mean == "sum":
            known = [value for value in values[name] if value is not None]
            found[name] = sum(known) if known else None
        else:
            found[name] = metric.average([values[name][i] for i in kept])
    return found
