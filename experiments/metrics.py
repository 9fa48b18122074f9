"""What a run comes to in numbers: the indices of the paper (section IV-B), and what says whether to believe them.

All errors are taken on true positions. A robot that died has NaN positions from then on: its links are left out from
that moment, integrals cover what is known (`coverage` says how much), and the means leave that robot out. The figures
of a run that was interrupted cover the time until then.
"""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from experiments.signals import (
    LinkErrors,
    after_last,
    beliefs,
    closest,
    gaps,
    integral,
    leaders,
    mean_known,
    net_rotation,
    outside_arena,
    phase_starts,
    transmissions,
)
from experiments.trace import Trace

INDICES: Final = ("f_hz", "messages", "bytes", "iae", "itae", "rmse", "acquired_s", "lost", "missed_deadlines")
WINDOW_S: Final = 1.0  # [s] of the moving mean that decides on acquisition, and of the residual
BAND: Final = 0.02  # of the largest error: the 2 % band of the settling time
KNOWN: Final = 0.95  # a robot whose position is known for less of the run counts as died
SUMS: Final = ("messages", "bytes", "iae", "itae", "lost", "missed_deadlines")  # grow with the length of a run


class Phase(msgspec.Struct, frozen=True):
    """One robot in one later phase: from a leg of the timeline to the next, or to the end."""

    start_s: float  # [s] since the common start
    acquired_s: float | None  # [s] since the start of the phase
    residual: float | None  # [m] worst link, |error| averaged over the last second
    worst: str  # who is at the other end of that link


class RobotMetrics(msgspec.Struct, frozen=True):
    """One robot in one case. What cannot be known is None.

    Attributes:
        robot: Name.
        kind: Kind of robot.
        f_hz: Transmissions per second [1/s].
        messages: Transmissions, by the sequence numbers.
        bytes: Payload sent [bytes].
        iae: ∫ e dt [m·s], e = Σ|d − distance| over the links it listens on (over those that listen to it, if none).
        itae: ∫ t·e dt [m·s²].
        rmse: √(mean e²) [m].
        acquired_s: From when on the one-second mean of |error| of each of its links stays within the tolerance until
            the next phase [s]; None if never.
        lost: Samples that the sequence numbers prove were sent and that somebody never got.
        missed_deadlines: Ticks that began more than one period late.
        residual: Worst link, |error| averaged over the last second of the first phase [m].
        worst: Who is at the other end of that link.
        phases: The same for each later phase.
        settle_s: When e enters the 2 % band of its largest value for good [s]; the duration if never.
        missed_share: Missed deadlines over ticks.
        updates: Coordination decisions.
        gap_min_s: Shortest time between two transmissions [s].
        gap_median_s: Median of those times [s].
        gap_max_s: Longest of them [s].
        recorded: Poses in the recording.
        listeners: How many robots listen to it.
        heard: Poses of it that its listeners heard, all together.
        coverage: Share of its link errors that is known.
        known: Share of the run in which its own position is known.
    """

    robot: str
    kind: str
    f_hz: float
    messages: int
    bytes: int
    iae: float | None
    itae: float | None
    rmse: float | None
    acquired_s: float | None
    lost: int
    missed_deadlines: int
    residual: float | None
    worst: str
    phases: tuple[Phase, ...]
    settle_s: float
    missed_share: float | None
    updates: int
    gap_min_s: float | None
    gap_median_s: float | None
    gap_max_s: float | None
    recorded: int
    listeners: int
    heard: int
    coverage: float
    known: float

    @property
    def by_the_end(self) -> tuple[float | None, str]:
        """Residual of the last phase [m], and who is at the other end of that link."""
        return (self.phases[-1].residual, self.phases[-1].worst) if self.phases else (self.residual, self.worst)


class Belief(msgspec.Struct, frozen=True):
    """How far what a listener holds of a speaker (the last pose heard) is from where the speaker is."""

    listener: str
    speaker: str
    rms: float | None  # [m]
    max: float | None  # [m]


class CaseMetrics(msgspec.Struct, frozen=True):
    """One case of a run.

    Attributes:
        case: Name of the case.
        seed: Seed of the run.
        clock: "real" or "virtual".
        duration_s: Length of the trace [s].
        planned_s: Length that the experiment was to have [s].
        interrupted: Whether the run ended before that.
        tolerance: Of the acquisition [m].
        starts_s: Start of each phase [s].
        robots: One entry per robot.
        leaders: Robots that the means leave out because they lead.
        died: Robots that the means leave out because their position is unknown for too long.
        mean: Each of `INDICES` averaged over the others; `acquired_s` is None if any of them never acquired.
        acquired_s: When the whole formation was acquired, per phase, since the start of the phase [s].
        rotation_rad_s: Net rotation rate of the formation per phase, from acquisition on [rad/s].
        j2: The authors' benchmark cost Σ(0.02·messages + 0.1·updates + 0.3·settle_s + 0.1·IAE + 0.01·ITAE).
        belief: Error of what neighbours hold, per link.
        belief_rms: The same over all links [m].
        belief_max: The largest of all [m].
        closest: Smallest distance between two robots' centres [m].
        closest_between: Between whom.
        closest_at_s: When [s].
        excursion: Farthest that a robot was outside the arena [m].
        excursion_robot: Which; empty if none was outside.
        lost: Sum over the robots.
        missed_deadlines: Sum over the robots.
        missed_share: Missed deadlines over ticks, of all robots.
    """

    case: str
    seed: int
    clock: str
    duration_s: float
    planned_s: float
    interrupted: bool
    tolerance: float
    starts_s: tuple[float, ...]
    robots: tuple[RobotMetrics, ...]
    leaders: tuple[str, ...]
    died: tuple[str, ...]
    mean: dict[str, float | None]
    acquired_s: tuple[float | None, ...]
    rotation_rad_s: tuple[float | None, ...]
    j2: float
    belief: tuple[Belief, ...]
    belief_rms: float | None
    belief_max: float | None
    closest: float | None
    closest_between: tuple[str, ...]
    closest_at_s: float | None
    excursion: float
    excursion_robot: str
    lost: int
    missed_deadlines: int
    missed_share: float | None


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _mean(robots: Sequence[RobotMetrics]) -> dict[str, float | None]:
    """Each index averaged over the robots for which it is known; `acquired_s` only if all of them acquired."""
    mean: dict[str, float | None] = {}
    for index in INDICES:
        known = [value for value in (getattr(robot, index) for robot in robots) if value is not None]
        complete = len(known) == len(robots) or index != "acquired_s"
        mean[index] = statistics.fmean(known) if known and complete else None
    return mean


def measure(trace: Trace) -> CaseMetrics:
    """All metrics of one case.

    Raises:
        ValueError: If the trace has fewer than two samples, so that nothing can be integrated.
    """
    if len(trace.time) < 2:
        raise ValueError(f"case '{trace.case}' holds fewer than two samples: the run ended before it began")
    names, errors = trace.robots, LinkErrors.of(trace)
    bounds = _bounds(trace)
    phases = _phases(trace, errors, bounds)
    robots = _robots(trace, errors, phases)

    leading = leaders(trace.experiment)
    died = tuple(robot.robot for robot in robots if robot.known < KNOWN and robot.robot not in leading)
    kept = [i for i, name in enumerate(names) if name not in leading and name not in died]
    together = [_all([phase[i].acquired_s for i in kept if errors.own[:, i].any()]) for phase in phases]
    rotation: list[float | None] = []
    for k, (_, begin, end) in enumerate(bounds):
        after = begin + round((together[k] or 0.0) / float(trace.time[1] - trace.time[0]))
        formed = k > 0 or together[k] is not None  # before, there is no shape that one could turn
        rotation.append(net_rotation(trace.true_position[after:end, kept], trace.time[after:end]) if formed else None)

    held = beliefs(trace, errors.net)
    rms = np.sqrt(mean_known(held**2))
    largest = np.where(np.isfinite(held), held, -np.inf).max(axis=0, initial=-np.inf)
    gap, row, one, other = closest(trace.true_position)
    beyond = outside_arena(trace)
    farthest = int(beyond.argmax())
    ticks = int(trace.ticks.sum())
    planned, step = trace.experiment.duration_s, float(trace.time[1] - trace.time[0])
    return CaseMetrics(
        case=trace.case,
        seed=trace.seed,
        clock=trace.clock,
        duration_s=float(trace.time[-1] - trace.time[0]),
        planned_s=planned,
        interrupted=float(trace.time[-1]) < planned - 1.5 * step,  # a whole one may end one sample short
        tolerance=trace.experiment.tolerance,
        starts_s=tuple(start for start, _, _ in bounds),
        robots=robots,
        leaders=leading,
        died=died,
        mean=_mean([robots[i] for i in kept]),
        acquired_s=tuple(together),
        rotation_rad_s=tuple(rotation),
        j2=sum(_cost(robot) for robot in robots),
        belief=tuple(
            Belief(names[i], names[j], _number(rms[k]), _number(largest[k]))
            for k, (i, j) in enumerate(zip(errors.net.listener, errors.net.speaker, strict=True))
        ),
        belief_rms=_number(math.sqrt(mean_known(held.reshape(-1) ** 2))),
        belief_max=_number(largest.max(initial=-np.inf)),
        closest=_number(gap),
        closest_between=(names[one], names[other]) if math.isfinite(gap) else (),
        closest_at_s=float(trace.time[row]) if math.isfinite(gap) else None,
        excursion=max(0.0, float(beyond[farthest])),
        excursion_robot=names[farthest] if beyond[farthest] > 0.0 else "",
        lost=int(trace.lost.sum()),
        missed_deadlines=int(trace.missed_deadlines.sum()),
        missed_share=float(trace.missed_deadlines.sum()) / ticks if ticks else None,
    )


def _bounds(trace: Trace) -> list[tuple[float, int, int]]:
    """Start [s], first row and last row + 1 of each phase; legs that begin within one sample are one phase."""
    starts = phase_starts(trace)
    begins, first = np.unique(np.searchsorted(trace.time, np.array(starts) - 1e-9), return_index=True)
    ends = [*begins[1:], len(trace.time)]
    return [(starts[k], int(begin), int(end)) for k, begin, end in zip(first, begins, ends, strict=True)]


def _phases(trace: Trace, errors: LinkErrors, bounds: Sequence[tuple[float, int, int]]) -> list[list[Phase]]:
    """Per phase and robot: when it was acquired, and what was left of the error by its end."""
    window = max(1, round(WINDOW_S / float(trace.time[1] - trace.time[0])))
    found = []
    for start, begin, end in bounds:
        acquired = errors.part(begin, end).acquired(window, trace.experiment.tolerance)
        worst = errors.part(max(begin, end - window), end).worst(trace.robots)
        found.append([Phase(start, when, *left) for when, left in zip(acquired, worst, strict=True)])
    return found


def _robots(trace: Trace, errors: LinkErrors, phases: Sequence[Sequence[Phase]]) -> tuple[RobotMetrics, ...]:
    rows, time, own = len(trace.robots), trace.time, errors.own
    duration = float(time[-1] - time[0])
    total = errors.per_robot()
    rmse = np.sqrt(mean_known(total**2))
    iae = np.where(np.isfinite(rmse), integral(total, time), np.nan)
    itae = np.where(np.isfinite(rmse), integral(time[:, None] * total, time), np.nan)
    coverage = (np.isfinite(errors.error).mean(axis=0) @ own) / np.maximum(own.sum(axis=0), 1.0)
    settled = after_last(~(total <= BAND * np.where(np.isfinite(total), total, 0.0).max(axis=0)), time)
    sent, recorded = transmissions(trace)
    size = np.bincount(trace.sent.robot, weights=trace.sent.bytes, minlength=rows)
    heard = np.bincount(trace.heard.speaker, minlength=rows)
    listeners = np.bincount(errors.net.speaker, minlength=rows)
    waits = [(wait.min(), float(np.median(wait)), wait.max()) if len(wait) else (np.nan,) * 3 for wait in gaps(trace)]
    return tuple(
        RobotMetrics(
            robot=name,
            kind=trace.experiment.robots[name].kind,
            f_hz=float(sent[i]) / duration,
            messages=int(sent[i]),
            bytes=int(size[i]),
            iae=_number(iae[i]),
            itae=_number(itae[i]),
            rmse=_number(rmse[i]),
            acquired_s=phases[0][i].acquired_s,
            lost=int(trace.lost[i]),
            missed_deadlines=int(trace.missed_deadlines[i]),
            residual=phases[0][i].residual,
            worst=phases[0][i].worst,
            phases=tuple(phase[i] for phase in phases[1:]),
            settle_s=duration if (when := settled[i]) is None else when,
            missed_share=float(trace.missed_deadlines[i] / trace.ticks[i]) if trace.ticks[i] else None,
            updates=int(trace.decisions[i]),
            gap_min_s=_number(waits[i][0]),
            gap_median_s=_number(waits[i][1]),
            gap_max_s=_number(waits[i][2]),
            recorded=int(recorded[i]),
            listeners=int(listeners[i]),
            heard=int(heard[i]),
            coverage=float(coverage[i]),
            known=float(errors.alive[:, i].mean()),
        )
        for i, name in enumerate(trace.robots)
    )


def _cost(robot: RobotMetrics) -> float:
    """One robot's share of J2; an error that is unknown costs nothing."""
    effort = 0.02 * robot.messages + 0.1 * robot.updates + 0.3 * robot.settle_s
    return effort + 0.1 * (robot.iae or 0.0) + 0.01 * (robot.itae or 0.0)


def _all(times: Sequence[float | None]) -> float | None:
    """When the last one was there; None if one never was, or nobody is asked."""
    known = [when for when in times if when is not None]
    return max(known) if known and len(known) == len(times) else None


def document(run_folder: str, seed: int, cases: Sequence[CaseMetrics]) -> dict[str, Any]:
    """The figures of one run for scripts: per case and robot the indices, their means, and ratios to the first case."""
    return {
        "run": run_folder,
        "seed": seed,
        "cases": {
            case.case: {
                "robots": {robot.robot: {index: getattr(robot, index) for index in INDICES} for robot in case.robots},
                "mean": dict(case.mean),
                "ratio": {index: next(iter(ratios([case], cases[:1], index))) for index in INDICES},
                **({"duration_s": case.duration_s, "interrupted": True} if case.interrupted else {}),
            }
            for case in cases
        },
    }


def ratio(value: float | None, reference: float | None) -> float | None:
    """The value over its reference; None where the reference is 0 or either is unknown."""
    return None if value is None or not reference else value / reference


def ratios(runs: Sequence[CaseMetrics], reference: Sequence[CaseMetrics], index: str) -> list[float | None]:
    """An index of each run over the reference: of the same seed if all seeds are the same, else over its mean.

    None for what grows with the length of a run if the runs are of different length: one was interrupted.
    """
    if index in SUMS and not same_length([*runs, *reference]):
        return [None] * len(runs)
    if sorted(run.seed for run in runs) == sorted(run.seed for run in reference):
        of_seed = {run.seed: run.mean[index] for run in reference}
        return [ratio(run.mean[index], of_seed[run.seed]) for run in runs]
    mean = spread([run.mean[index] for run in reference]).mean
    return [ratio(run.mean[index], mean) for run in runs]


def same_length(runs: Sequence[CaseMetrics]) -> bool:
    """Whether runs can be compared: equally long within 2 %, or as long as each was to be."""
    lengths = [run.duration_s for run in runs]
    return not any(run.interrupted for run in runs) or max(lengths) - min(lengths) <= 0.02 * max(lengths)


def by_case(cases: Sequence[CaseMetrics]) -> dict[str, list[CaseMetrics]]:
    """Runs of the same case together, cases in the order of their first run."""
    grouped: dict[str, list[CaseMetrics]] = {}
    for case in cases:
        grouped.setdefault(case.case, []).append(case)
    return grouped


def across_seeds(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean, standard deviation and 95 % confidence half-width of each index and ratio over runs of several seeds.

    Returns:
        `{"seeds": [...], "cases": {case: {"mean" | "ratio": {index: {"mean", "std", "ci95", "n"}}}}}`. `n` counts the
        seeds for which the value is known; the half-width is Student's, None for fewer than two.
    """
    cases = list(dict.fromkeys(case for each in documents for case in each["cases"]))
    return {
        "seeds": [each["seed"] for each in documents],
        "cases": {
            case: {
                group: {
                    index: msgspec.structs.asdict(
                        spread([each["cases"][case][group][index] for each in documents if case in each["cases"]])
                    )
                    for index in INDICES
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
    """Of what is known among the values."""
    known = [value for value in values if value is not None]
    n = len(known)
    deviation = statistics.stdev(known) if n > 1 else None
    return Spread(
        mean=statistics.fmean(known) if known else None,
        std=deviation,
        ci95=None if deviation is None else student_95(n - 1) * deviation / math.sqrt(n),
        n=n,
    )


def student_95(freedom: int) -> float:
    """Two-sided 95 % quantile of Student's t: exact for 1 and 2, else Fisher's expansion (0.1 % at 3, then better)."""
    if freedom == 1:
        return math.tan(0.475 * math.pi)
    if freedom == 2:
        return 0.95 * math.sqrt(2.0 / (1.0 - 0.95**2))
    z = statistics.NormalDist().inv_cdf(0.975)
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return math.fsum(term / float(freedom) ** k for k, term in enumerate(terms))


def write_csv(path: Path, cases: Sequence[CaseMetrics]) -> None:
    """One row per case and robot, and a row `mean` per case; empty where a value is unknown."""
    later = max((len(case.starts_s) for case in cases), default=1)
    plain = [field for field in RobotMetrics.__struct_fields__ if field != "phases"]
    phases = [f"phase{k}_{what}" for k in range(2, later + 1) for what in ("acquired_s", "residual", "worst")]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, ["seed", "case", "in_mean", *plain, *phases], restval="")
        table.writeheader()
        for case in cases:
            out = {*case.leaders, *case.died}
            for robot in case.robots:
                row = {field: getattr(robot, field) for field in plain}
                for k, phase in enumerate(robot.phases, start=2):
                    row |= {f"phase{k}_{what}": getattr(phase, what) for what in ("acquired_s", "residual", "worst")}
                table.writerow({"seed": case.seed, "case": case.case, "in_mean": int(robot.robot not in out), **row})
            table.writerow({"seed": case.seed, "case": case.case, "robot": "mean", **case.mean})


def write_json(path: Path, cases: Sequence[CaseMetrics]) -> None:
    """Everything that was measured, one object per case."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(cases), indent=2) + b"\n")
