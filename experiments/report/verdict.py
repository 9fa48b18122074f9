"""Findings of a run in plain words: the sentences at the top of a report, and what the command line prints."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Sequence

from agents.errors import did_you_mean
from experiments.metrics import criteria
from experiments.metrics.comparable import LOST, MISSED, SLOW, equally_long, lost_share, spoils
from experiments.metrics.metric import ERRORS, OURS
from experiments.metrics.results import CaseMetrics, Collision
from experiments.metrics.statistics import by_case, ratios, spread
from experiments.report.page import Mark, VerdictLine, interval, number
from experiments.report.tables import dropped_share, mean_delay, ratio_words

Lines = Iterator[VerdictLine]

KEPT_UP = 0.99  # a world that is slower than this share of real time falls behind
UNFINISHED_M = 0.3  # a robot that is nearer to where its plan wants it merely lags
NAMED = 3  # collisions, or twins, that are named; the tables have them all


def findings(cases: Sequence[CaseMetrics], notes: Sequence[str] = ()) -> list[VerdictLine]:
    """The verdict over all cases, the first one being the reference; nothing is praised if one of them was spoiled.

    `notes` of the run stand behind what a reader must know first.
    """
    formation = any(case.belief for case in cases)
    judged = [case for case in cases if case.belief and case.has_errors]  # others have links without targets
    sound = [  # what is as it should be stands behind what the run has shown
        *_lost_poses(cases),
        *_foreign(cases),
        *_modelled(cases),
        *_deadlines(cases),
        *_gaps(cases),
        *_died(cases),
        *_guided(cases),
    ]
    found = [
        *failures(cases),
        *spoiled(cases),
        *interruptions(cases),
        *(VerdictLine("fair", note) for note in notes),
        *criteria_met(cases),
        *troubles(cases),
        *metric_faults(cases),
        *(line for line in sound if line.mark != "good"),
        *([*_acquired(judged), _worst_link(judged)] if judged else []),
        *(_against_the_first(cases) if formation else []),
        *contacts(cases),
        *(line for line in sound if line.mark == "good"),
        *_avoided(cases),
        *_unfinished(cases),
        *_room(cases),
        *_pace(cases),
        *_shadows(cases),
    ]
    if any(case.spoiled or case.failures for case in cases):
        return [VerdictLine("plain", each.text) if each.mark == "good" else each for each in found]
    return found


def criteria_met(cases: Sequence[CaseMetrics]) -> list[VerdictLine]:
    """Whether the runs pass the criteria of their experiment, and why not; empty without criteria."""
    found = criteria.judge(cases)
    if not found:
        return []
    bad, unjudged = ([each for each in found if each.passed is what] for what in (False, None))
    count = f"{len(found) - len(bad) - len(unjudged)} of {len(found)} criteria are met"
    seeds = max(len(each.values) for each in found)
    count += f" by all {seeds} seeds" * (seeds > 1)
    words = "Not passed" if bad else "Not judged as a whole" if unjudged else "Passed"
    mark: Mark = "bad" if bad else "fair" if unjudged else "good"
    return [
        VerdictLine(mark, f"{words}: {count}."),
        *(VerdictLine("bad", _missed(each)) for each in bad),
        *(VerdictLine("plain", _met(each)) for each in found if each.passed),
        *(VerdictLine("fair", f"Not judged: {each.what} ({each.limit}), since that was not run.") for each in unjudged),
    ]


def _met(judgement: criteria.Judgement) -> str:
    """Value that meets a criterion; of several seeds the one nearest to its limit."""
    known = [value for value in judgement.values.values() if value is not None]
    which = ", the nearest to its limit" * (len(known) > 1)
    value = max(known, key=judgement.criterion.excess)
    return f"{judgement.what} is {number(value)}{which}, as asked: {judgement.limit}."


def _missed(judgement: criteria.Judgement) -> str:
    """The criterion that is not met, by how many seeds, and why it is asked."""
    seeds, failed = len(judgement.values), judgement.failed
    values, asked = [judgement.values[seed] for seed in failed], judgement.criterion
    known = [value for value in values if value is not None]
    worst = None if len(known) < len(values) else max(known, key=asked.excess)
    which = f" for {len(failed)} of {seeds} seeds, the farthest" * (seeds > 1)
    is_what = "is unknown" if worst is None else f"is {number(worst)}"
    if asked.measure and asked.measure not in judgement.measures:
        is_what += f" (no measure of the law; {did_you_mean(asked.measure, judgement.measures) or 'it has none'})"
    return f"{judgement.what} {is_what}{which}, not {judgement.limit}. {asked.why}".rstrip()


def failures(cases: Sequence[CaseMetrics]) -> list[VerdictLine]:
    """Robots that did not do their part: the first thing that a reader must know."""
    failed = [case for case in cases if case.failures]
    return [VerdictLine("bad", f"Failed in {case.case}: {_first_few(case.failures)}.") for case in failed]


def spoiled(cases: Sequence[CaseMetrics]) -> Lines:
    """Cases that are not compared with others, and the reasons."""
    for name, runs in by_case(cases).items():
        bad = [run for run in runs if run.spoiled]
        if bad:
            which = name if len(runs) == 1 else f"{name} ({len(bad)} of {len(runs)} seeds)"
            why = "; ".join(dict.fromkeys(reason for run in bad for reason in run.spoiled))
            yield VerdictLine("bad", f"Spoiled, and compared with nothing: {which}: {why}.")


def troubles(cases: Sequence[CaseMetrics]) -> Lines:
    """Findings of conductor and recorder."""
    for case in cases:
        if case.troubles:
            mark: Mark = "bad" if any(map(spoils, case.troubles)) else "fair"
            yield VerdictLine(mark, f"In {case.case}: {_first_few(case.troubles)}.")


def metric_faults(cases: Sequence[CaseMetrics]) -> list[VerdictLine]:
    """Metrics of other distributions that failed, once each."""
    texts = dict.fromkeys(text for run in cases for text in run.metric_faults)
    return [VerdictLine("fair", f"{text}.") for text in texts]


def interruptions(cases: Sequence[CaseMetrics]) -> Lines:
    """Runs that ended early, or were without a network."""
    several = len(by_case(cases)) > 1
    for run in cases:
        if run.interrupted:
            where = f"{run.case} was interrupted" if several else "Interrupted"
            when, possessive = f"{run.duration_s:.1f} s of {run.planned_s:g} s", "its " if several else ""
            yield VerdictLine("fair", f"{where} after {when}: all {possessive}figures are up to there.")
        if run.away_s:
            where = f"In {run.case} the" if several else "The"
            text = f"{where} network was away for {run.away_s:.1f} s: errors are over the rest of the time."
            yield VerdictLine("fair", text)


def left_out(cases: Sequence[CaseMetrics]) -> str:
    """Robots that the means leave out, with the reason."""
    leading = list(dict.fromkeys(name for case in cases for name in case.leaders))
    died = list(dict.fromkeys(name for case in cases for name in case.died))
    words = []
    if leading:
        words.append(f"{_list(leading)} {_verb(leading, 'leads and is', 'lead and are')} left out of the means.")
    if died:
        are = _verb(died, "is", "are")
        words.append(f"{_list(died)} {are} left out too where the position is unknown for 5 % of the run or more.")
    return " ".join(words) or "The means are over all robots."


def _lost_poses(cases: Sequence[CaseMetrics]) -> list[VerdictLine]:
    sent = sum(robot.messages for case in cases for robot in case.robots)
    lost = {name: sum(run.lost for run in runs) for name, runs in by_case(cases).items()}
    if any(lost.values()):
        where = _list([f"{number(count)} in {name}" for name, count in lost.items() if count])
        mark: Mark = "bad" if max(map(lost_share, cases)) >= LOST else "fair"
        return [VerdictLine(mark, f"Samples were lost: {where}, of {number(sent)} poses sent in all.")]
    if not sent:
        return [VerdictLine("plain", "No pose was sent: whether any would have been lost is unknown.")]
    if silent := _without_status(cases):
        text = f"No pose is known to be lost of {number(sent)} sent; what {_list(silent)} received is unknown."
        return [VerdictLine("plain", text)]
    return [VerdictLine("good", f"No pose was lost: {number(sent)} were sent, and no running number is missing.")]


def _without_status(cases: Sequence[CaseMetrics]) -> list[str]:
    """Robots of runs in real time without a single status, so that nothing of their counters is known."""
    real = (robot for case in cases if case.clock == "real" for robot in case.robots)
    return list(dict.fromkeys(robot.robot for robot in real if robot.missed_share is None))


def _foreign(cases: Sequence[CaseMetrics]) -> Lines:
    """Poses that robots refused since another session sent them."""
    for name, runs in by_case(cases).items():
        counts = Counter[str]()
        for run in runs:
            counts.update({robot.robot: robot.foreign for robot in run.robots if robot.foreign})
        if counts:
            robots = _list([f"{number(count)} of {robot}" for robot, count in counts.items()])
            text = f"Poses from other sessions than the robots' own were refused in {name}: {robots}"
            advice = "Look for a second process of that name; in a lab, revoke the certificate."
            yield VerdictLine("bad", f"{text}. {advice}")


def _modelled(cases: Sequence[CaseMetrics]) -> Lines:
    """Loss and delay of a modelled network."""
    for name, runs in by_case(cases).items():
        if not runs[0].modelled:
            continue
        links = [link for run in runs for link in run.link_deliveries]
        dropped = sum(link.dropped for link in links)
        every = dropped + sum(link.received for link in links)
        text = f"The modelled network dropped {number(dropped)} of {number(every)} samples in {name}"
        text += f" ({number(dropped_share(links))} %)" if dropped else ""
        if (mean := mean_delay(links)) is not None:
            longest = max(link.delay_max for link in links if link.delay_max is not None)
            text += f"; those received took {number(mean, 1e3)} ms, at most {number(longest, 1e3)} ms"
        yield VerdictLine("plain", f"{text}.")


def _deadlines(cases: Sequence[CaseMetrics]) -> list[VerdictLine]:
    if all(case.clock == "virtual" for case in cases):
        return []
    if not any(case.missed_deadlines for case in cases):
        if silent := _without_status(cases):
            text = f"Whether {_list(silent)} missed deadlines is unknown: no status was recorded."
            return [VerdictLine("plain", text)]
        return [VerdictLine("good", "No deadline was missed.")]
    words = []
    for name, runs in by_case(cases).items():
        if missed := sum(run.missed_deadlines for run in runs):
            share = spread([run.missed_share for run in runs]).mean or 0.0
            words.append(f"{number(missed)} in {name} ({100.0 * share:.2g} %)")
    worst = max(case.missed_share or 0.0 for case in cases)
    return [VerdictLine("fair" if worst < MISSED else "bad", f"Deadlines were missed: {_list(words)}.")]


def _gaps(cases: Sequence[CaseMetrics]) -> Lines:
    """Times without the position of a robot that came back."""
    for case in cases:
        if case.gaps:
            text = f"Position unknown in {case.case}: {_first_few(case.gaps)}; neither in nor out of the tolerance."
            yield VerdictLine("fair", text)


def _died(cases: Sequence[CaseMetrics]) -> Lines:
    for name, runs in by_case(cases).items():
        if died := list(dict.fromkeys(robot for run in runs for robot in run.died)):
            them = _verb(died, "it", "them")
            yield VerdictLine("bad", f"In {name}, {_list(died)} dropped out; the means leave {them} out.")


def _guided(cases: Sequence[CaseMetrics]) -> Lines:
    """Cost of the central controller."""
    for name, runs in by_case(cases).items():
        centres = [run.guidance for run in runs if run.guidance is not None]
        if not centres:
            continue
        delay = spread([centre.delay_mean_s for centre in centres])
        busy = spread([centre.load for centre in centres])
        text = f"In {name} a centre decides for {_list(centres[0].guided)}"
        text += f": {interval(spread([centre.goals_hz for centre in centres]))} goals per second"
        if delay.mean is not None:
            text += f", acted on {interval(delay, 1000.0)} ms after the pose on which they rest"
        if busy.mean is not None:
            text += f"; its process took {interval(busy, 100.0)} % of a core"
        yield VerdictLine("plain", f"{text}.")


def _acquired(cases: Sequence[CaseMetrics]) -> Lines:
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
        formation = "The formation" if k == 0 else f"In the phase from {start:g} s on it"
        if reached:
            text = f"{formation} was acquired by all {'again' if k else f'to {tolerance}'} after {_list(reached)}."
            yield VerdictLine("fair" if missing else "good", text)
        if missing:
            yield VerdictLine("bad", f"{formation} never stayed within {tolerance} in {_list(missing)}.")
        if cut:
            text = f"{formation} was not within {tolerance} when {_list(cut)} {_verb(cut, 'was', 'were')} interrupted."
            yield VerdictLine("plain", text)


def _worst_link(cases: Sequence[CaseMetrics]) -> VerdictLine:
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
        return VerdictLine("plain", "No link could be measured at the end.")
    mark: Mark = "good" if largest <= cases[0].tolerance else "bad"
    if mark == "bad" and any(case.interrupted for case in cases):
        mark = "plain"  # it may have been on its way
    of = " of all seeds" if len(cases) > len(by_case(cases)) else ""
    return VerdictLine(mark, f"By the end the worst link{of} was off by {_list(words)}.")


def _against_the_first(cases: Sequence[CaseMetrics]) -> Lines:
    (reference, first), *others = by_case(cases).items()
    for name, runs in others:
        rate = spread(ratios(runs, first, "f_hz"))
        some = f" (seeds compared: {rate.n} of {len(runs)})" if rate.n < len(runs) else ""
        if rate.mean is not None:
            fewer = 100.0 * (1.0 - rate.mean)
            share = f"{abs(fewer):.1f}"
            how = f"{share} % {'fewer' if fewer > 0.0 else 'more'}" if float(share) else "as many"
            how += f" transmissions {'than' if float(share) else 'as'} {reference}"
            compared = [[run for run in group if not run.spoiled] for group in (runs, first)]
            means = [interval(spread([run.mean["f_hz"] for run in group])) for group in compared]
            text = f"{name} needs {how}: f {means[0]} rather than {means[1]} Hz"
            text += f"{_with_leaders(*compared)}{some}."
            yield VerdictLine("good" if fewer > 0.0 and float(share) and not some else "plain", text)
        errors = [(OURS[name].label, spread(ratios(runs, first, name))) for name in ERRORS]
        known = [(label, each) for label, each in errors if each.mean is not None]
        if not equally_long(run.duration_s for run in (*runs, *first)):
            yield VerdictLine("fair", f"Runs of different length of {name} and {reference} are not compared.")
        if known:
            parts = [f"{label} {ratio_words(each)}" for label, each in known]
            worse = max(each.mean for _, each in known if each.mean is not None)
            text = f"Its errors relative to {reference}: {_list(parts)}{some}."
            mark: Mark = "good" if worse <= 1.0 and not some else "plain" if worse < 1.25 else "fair"
            yield VerdictLine(mark, text)
        judged = all(run.has_errors for run in (*runs, *first))
        if judged and "IAE" not in dict(known) and rate.mean is not None:
            text = f"Less is known of one of {name} and {reference}: integrals of errors are not compared."
            yield VerdictLine("fair", text)


def _with_leaders(runs: Sequence[CaseMetrics], first: Sequence[CaseMetrics]) -> str:
    """The share of transmissions of all robots, where leaders are left out of the means."""
    leading = any(case.leaders for case in (*runs, *first))
    sent, before = ([sum(robot.f_hz for robot in run.robots) for run in each] for each in (runs, first))
    if not leading or not sum(before):
        return ""
    fewer = 100.0 * (1.0 - statistics.fmean(sent) / statistics.fmean(before))
    how = f"{abs(fewer):.1f} % {'fewer' if fewer >= 0.0 else 'more'}"
    return f"; leaders included, {how}"


def contacts(cases: Sequence[CaseMetrics]) -> list[VerdictLine]:
    """Contacts; without any, the closest approach."""
    found = []
    for name, runs in by_case(cases).items():
        touched = [each for run in runs for each in run.collisions]
        if not touched:
            continue
        shown = [_collision(each) for each in touched[:NAMED]]
        shown += [f"{len(touched) - NAMED} more"] if len(touched) > NAMED else []
        which = f"{sum(1 for run in runs if run.collisions)} of {len(runs)} seeds of {name}"
        count = "One collision" if len(touched) == 1 else f"{len(touched)} collisions"
        found.append(VerdictLine("bad", f"{count} in {name if len(runs) == 1 else which}: {_list(shown)}."))
    near = [(case.near, case.case) for case in cases if case.near is not None]
    arena = [(case.near_arena, case.case) for case in cases if case.near_arena is not None]
    if found or not (near or arena):
        return found
    gaps = []
    for what, known in (("robots", near), ("robot and arena", arena)):
        if known:
            closest, case = min(known, key=lambda each: each[0].gap)
            pair = "–".join(closest.between)
            where = f", {case}" if len(by_case(cases)) > 1 else ""
            gaps.append(f"{number(closest.gap, 100.0)} cm between {what} ({pair} at {closest.at_s:.1f} s{where})")
    unseen = list(dict.fromkeys(robot.robot for case in cases for robot in case.robots if robot.known < 1.0))
    if unseen and not all(case.watched for case in cases):
        text = f"No contact is known; the closest approach was {_list(gaps)}. Of {_list(unseen)} not all is known."
        return [VerdictLine("plain", text)]
    return [VerdictLine("good", f"No robot touched another or the arena; the closest approach was {_list(gaps)}.")]


def _collision(each: Collision) -> str:
    parts = [] if each.impulse is None else [f"{number(each.impulse, 1000.0)} mN s"]
    parts += [f"{number(each.overlap, 100.0)} cm deep"] if each.overlap > 0.0 else []
    return f"{each.first}–{each.second} at {each.time_s:.2f} s" + (f" ({', '.join(parts)})" if parts else "")


def _avoided(cases: Sequence[CaseMetrics]) -> Lines:
    for case in [case for case in cases if case.avoided_share][:NAMED]:
        most = max(case.robots, key=lambda robot: robot.avoided)
        text = f"Avoidance was at work on {number(case.avoided_share, 100.0)} % of all ticks in {case.case}"
        yield VerdictLine("plain", f"{text}, most on those of {most.robot} ({number(most.avoided)}).")


def _pace(cases: Sequence[CaseMetrics]) -> Lines:
    factors = [(case.world_factor, case.case) for case in cases if case.world_factor is not None]
    factor, case = min(factors, default=(1.0, ""))
    if factor < KEPT_UP:
        text = f"The world fell behind: at its slowest it ran at {factor:.2f} of real time, in {case}."
        yield VerdictLine("fair" if factor >= SLOW else "bad", text)


def _shadows(cases: Sequence[CaseMetrics]) -> Lines:
    found = [(case, robot, robot.shadow) for case in cases for robot in case.robots if robot.shadow is not None]
    found.sort(key=lambda each: -each[2].rmse)
    shown = []
    for case, robot, shadow in found[:NAMED]:
        ahead = "over the whole run" if shadow.horizon_s is None else f"up to {shadow.horizon_s:g} s ahead"
        shown.append(f"{robot.robot} to {number(shadow.rmse, 100.0)} cm RMSE {ahead} ({case.case})")
    if shown:
        rest = "; the others more closely" if len(found) > NAMED else ""
        yield VerdictLine("plain", f"Twins beside robots foresaw {_list(shown)}{rest}.")


def _unfinished(cases: Sequence[CaseMetrics]) -> Lines:
    """Robots that did not get where their plan wanted them."""
    for case in cases:
        short = [each for each in case.robots if each.short is not None and each.short > UNFINISHED_M]
        if short:
            names = _list([f"{each.robot} by {number(each.short, 100.0)} cm" for each in short])
            yield VerdictLine("bad", f"Not where the plan wanted them at the end of {case.case}: {names}.")


def _room(cases: Sequence[CaseMetrics]) -> Lines:
    far = max(cases, key=lambda case: case.excursion)
    if far.excursion > 0.0:
        text = f"{far.excursion_robot} was {number(far.excursion, 100.0)} cm outside the arena in {far.case}."
        yield VerdictLine("fair" if far.excursion < 0.02 else "bad", text)


def _first_few(texts: Sequence[str]) -> str:
    """The first few texts; the others are counted."""
    more = len(texts) - NAMED
    return "; ".join([*texts[:NAMED], *([f"{more} more like this"] if more > 0 else [])])


def _list(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _verb(names: Sequence[str], one: str, several: str) -> str:
    return one if len(names) == 1 else several
