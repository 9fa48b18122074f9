"""What a run came to, in plain words: the sentences at the top of a report, and what the command line prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from experiments.metrics import CaseMetrics, by_case, ratios, same_length, spread
from experiments.report_tables import interval, number

Mark = Literal["good", "fair", "bad", "plain"]
CLOSE_M = 0.15  # centres closer than this: two Crazyflies or Kheperas touch at 0.13 to 0.14 m


@dataclass(frozen=True)
class Finding:
    """One sentence and how to take it."""

    mark: Mark
    text: str


def findings(cases: Sequence[CaseMetrics]) -> list[Finding]:
    """The verdict over all cases, the first one being the reference."""
    return [
        *interruptions(cases),
        *_nothing_lost(cases),
        *_deadlines(cases),
        *_died(cases),
        *_acquired(cases),
        _worst_link(cases),
        *_against_the_first(cases),
        *_room(cases),
    ]


def interruptions(cases: Sequence[CaseMetrics]) -> list[Finding]:
    """Which runs ended before their time; the first thing that a reader must know."""
    found, several = [], len(by_case(cases)) > 1
    for run in cases:
        if run.interrupted:
            where = f"{run.case} was interrupted" if several else "Interrupted"
            text = (
                f"{where} after {run.duration_s:.1f} s of {run.planned_s:g} s: all {'its ' if several else ''}figures"
            )
            found.append(Finding("fair", f"{text} are up to there."))
    return found


def left_out(cases: Sequence[CaseMetrics]) -> str:
    """Who is not in the means, and why."""
    leading = list(dict.fromkeys(name for case in cases for name in case.leaders))
    died = list(dict.fromkeys(name for case in cases for name in case.died))
    words = []
    if leading:
        words.append(
            f"{_list(leading)} {'leads' if len(leading) == 1 else 'lead'} and {_is(leading)} left out of the means."
        )
    if died:
        words.append(
            f"{_list(died)} {_is(died)} left out too where the position is unknown for 5 % of the run or more."
        )
    return " ".join(words) or "The means are over all robots."


def _nothing_lost(cases: Sequence[CaseMetrics]) -> list[Finding]:
    sent = sum(robot.messages for case in cases for robot in case.robots)
    lost = {name: sum(run.lost for run in runs) for name, runs in by_case(cases).items()}
    if not any(lost.values()):
        return [Finding("good", f"Nothing was lost: {number(sent)} poses were sent, and no running number is missing.")]
    where = _list([f"{number(count)} in {name}" for name, count in lost.items() if count])
    return [Finding("bad", f"Samples were lost: {where}, of {number(sent)} poses sent in all.")]


def _deadlines(cases: Sequence[CaseMetrics]) -> list[Finding]:
    if all(case.clock == "virtual" for case in cases):
        return []
    if not any(case.missed_deadlines for case in cases):
        return [Finding("good", "No deadline was missed.")]
    worst = max(cases, key=lambda case: case.missed_share or 0.0)
    share = worst.missed_share or 0.0
    text = (
        f"Deadlines were missed: {number(worst.missed_deadlines)} in {worst.case}, {100.0 * share:.2g} % of all ticks."
    )
    return [Finding("fair" if share < 0.01 else "bad", text)]


def _died(cases: Sequence[CaseMetrics]) -> list[Finding]:
    found = []
    for name, runs in by_case(cases).items():
        gone = list(dict.fromkeys(robot for run in runs for robot in run.died))
        if gone:
            found.append(Finding("bad", f"In {name}, {_list(gone)} dropped out; the means leave {_them(gone)} out."))
    return found


def _acquired(cases: Sequence[CaseMetrics]) -> list[Finding]:
    found = []
    tolerance = f"{100.0 * cases[0].tolerance:g} cm"
    longest = max(cases, key=lambda case: len(case.starts_s))
    for k, start in enumerate(longest.starts_s):
        reached: list[str] = []
        missing: list[str] = []
        cut: list[str] = []
        for name, every in by_case(cases).items():
            runs = [run for run in every if k < len(run.acquired_s)]  # others ended before this phase
            when = spread([run.acquired_s[k] for run in runs])
            if when.n:
                reached.append(f"{interval(when)} s ({name})")
            if when.n < len(runs):
                short = cut if any(run.interrupted for run in runs) else missing
                short.append(name if len(runs) == 1 else f"{name} ({len(runs) - when.n} of {len(runs)} seeds)")
        which = (
            f"The formation was acquired by all to {tolerance}"
            if k == 0
            else f"After the leg at {start:g} s it was acquired by all again"
        )
        if reached:
            found.append(Finding("good" if not missing else "fair", f"{which} after {_list(reached)}."))
        if missing:
            once = "The formation" if k == 0 else f"After the leg at {start:g} s it"
            found.append(Finding("bad", f"{once} never stayed within {tolerance} in {_list(missing)}."))
        if cut:
            once = "The formation" if k == 0 else f"After the leg at {start:g} s it"
            text = f"{once} was not within {tolerance} when {_list(cut)} {_was(cut)} interrupted."
            found.append(Finding("plain", text))
    return found


def _worst_link(cases: Sequence[CaseMetrics]) -> Finding:
    words, largest = [], 0.0
    for name, runs in by_case(cases).items():
        left = [(*robot.by_the_end, robot.robot) for run in runs for robot in run.robots]
        known = [(error, robot, other) for error, other, robot in left if error is not None]
        if not known:
            continue
        error, robot, other = max(known)
        largest = max(largest, error)
        words.append(f"{number(error, 100.0)} cm ({robot}–{other}, {name})")
    if not words:
        return Finding("plain", "No link could be measured at the end.")
    mark: Mark = "good" if largest <= cases[0].tolerance else "bad"
    if mark == "bad" and any(case.interrupted for case in cases):
        mark = "plain"  # it may have been on its way
    return Finding(mark, f"By the end the worst link was off by {_list(words)}.")


def _against_the_first(cases: Sequence[CaseMetrics]) -> list[Finding]:
    grouped = by_case(cases)
    (reference, first), *others = grouped.items()
    found = []
    for name, runs in others:
        rate = spread(ratios(runs, first, "f_hz"))
        if rate.mean is not None:
            fewer = 100.0 * (1.0 - rate.mean)
            how = f"{abs(fewer):.1f} % {'fewer' if fewer >= 0.0 else 'more'} transmissions than {reference}"
            means = [interval(spread([run.mean["f_hz"] for run in group])) for group in (runs, first)]
            text = f"{name} needs {how}: {means[0]} rather than {means[1]} per second and robot."
            found.append(Finding("good" if fewer > 0.0 else "plain", text))
        errors = [
            (label, spread(ratios(runs, first, index)))
            for index, label in (("iae", "IAE"), ("itae", "ITAE"), ("rmse", "RMSE"))
        ]
        known = [(label, each) for label, each in errors if each.mean is not None]
        if not same_length([*runs, *first]):
            text = f"{name} and {reference} are of different length: their errors are not compared."
            found.append(Finding("plain", text))
        elif known:
            parts = [
                f"{label} {each.mean:.3f}" + (f" ± {each.ci95:.3f}" if each.ci95 is not None else "")
                for label, each in known
            ]
            worse = max(each.mean for _, each in known if each.mean is not None)
            text = f"Its errors relative to {reference}: {_list(parts)}."
            found.append(Finding("good" if worse <= 1.0 else "plain" if worse < 1.25 else "fair", text))
    return found


def _room(cases: Sequence[CaseMetrics]) -> list[Finding]:
    found = []
    measured = [case for case in cases if case.closest is not None]
    if measured:
        tight = min(measured, key=lambda case: case.closest or 0.0)
        text = f"No two robots came closer than {number(tight.closest)} m, centre to centre"
        text += f" ({_list(tight.closest_between)}, {number(tight.closest_at_s)} s, {tight.case})."
        found.append(Finding("plain" if (tight.closest or 0.0) > CLOSE_M else "bad", text))
    far = max(cases, key=lambda case: case.excursion)
    if far.excursion > 0.0:
        text = f"{far.excursion_robot} was {number(far.excursion, 100.0)} cm outside the arena in {far.case}."
        found.append(Finding("fair" if far.excursion < 0.02 else "bad", text))
    return found


def _list(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _was(names: Sequence[str]) -> str:
    return "was" if len(names) == 1 else "were"


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _them(names: Sequence[str]) -> str:
    return "it" if len(names) == 1 else "them"
