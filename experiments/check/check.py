"""`./zenpark check`: findings on an experiment before anything moves, by theory and an ideal run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from agents.errors import join_names
from agents.plugins.calls import supervised
from agents.plugins.files import plain
from experiments.check import motion, noise, safety, surroundings, theory
from experiments.check.analysis import Analysis
from experiments.check.findings import FORGIVEN, MARK, NOT_RANDOM, CheckNumbers, Finding, first_of_each_code
from experiments.check.ideal_run import predict, ticking_plugins, uncompiled
from experiments.check.realisation import algebraic_connectivity
from experiments.definition import standby
from experiments.definition.graph import edges
from experiments.definition.plan import Plan
from experiments.file.cases import Source
from experiments.file.document import Document, chosen
from experiments.file.problems import Fault, Path, Problem, TextPosition, nearest
from experiments.virtual_time import machine

MOST_NAMED: Final = 5  # cases that a finding names
QUIET: Final = np.errstate(all="ignore")  # absurd numbers overflow on their way to a finding that says so


def chance(analysis: Analysis) -> Iterator[Finding]:
    """Warn if no seed changes anything."""
    if not analysis.plan.uses_chance:
        message = "nothing in this file is random: runs of other seeds are the same"
        remedy = "add what nature adds, such as [disturbance.all] with position_sigma = 0.0005"
        yield Finding("warning", NOT_RANDOM, message, remedy, ("disturbance",))


def compilation(analysis: Analysis) -> Iterator[Finding]:
    """Say what a plug-in of others that cannot be compiled costs."""
    plan = analysis.plan
    foreign = [each for each in ticking_plugins(plan) if each.__module__.partition(".")[0] != "agents"]
    if foreign and machine.works():
        text, gain = uncompiled(analysis.prediction.bare.changed(avoidance=plan.experiment.avoidance))
        cost = f"runs in virtual time and sweeps take {'2 to 8' if gain > 1.0 else '8 to 12'} times as long"
        message = f"{plain(text)}, which is not compiled: {cost} (docs/plugins.md, the subset)"
        yield from [Finding("remark", "uncompiled", message)] if text else ()


SUBJECTS: Final = (
    theory.network, theory.presence, theory.lengths, theory.realisation, theory.rigidity,
    theory.redundancy, theory.stability, theory.law,
    surroundings.contacts, surroundings.obstacles, surroundings.perception, surroundings.reality,
    motion.flight, motion.starts, motion.formation, motion.anchors, noise.softness,
    surroundings.walls, surroundings.ceiling,
    motion.encounters, motion.speeds, motion.recordings, motion.turning_circle, motion.rates, motion.ends,
    safety.architecture, safety.safety, safety.batteries, safety.libraries, safety.devices,
    safety.turned, safety.positioning,
    chance, compilation,
)  # fmt: skip


def check(given: Document, cases: Sequence[str] = ()) -> list[Finding]:
    """Findings of the named cases, of all if none is named: errors first, then warnings, then notes.

    Raises:
        DocumentError: If the experiment has no case of that name.
    """
    return _findings(given, analyses(chosen(given, cases)))


@QUIET
@supervised()
def analyses(cases: Mapping[str, Plan]) -> dict[str, Analysis]:
    """Analysis of each case, by its name."""
    bare = {name: standby.without_standby(case) for name, case in cases.items()}
    return {name: Analysis(case, predict(case)) for name, case in bare.items()}


def examine(
    given: Document, analysed: Mapping[str, Analysis] | None = None
) -> tuple[list[Finding], dict[str, CheckNumbers]]:
    """Findings of all cases, as `check`, and the figures of each case by its name."""
    analysed = analysed or analyses(given.cases())
    return _findings(given, analysed), {name: _figures(analysis) for name, analysis in analysed.items()}


def unreadable(problem: Problem) -> Finding:
    return Finding("error", "document", problem.message, problem.hint, problem.place)


def figures(plan: Plan) -> CheckNumbers:
    return _figures(analyses({"": plan})[""])


@QUIET
@supervised()
def _findings(given: Document, analyses: Mapping[str, Analysis]) -> list[Finding]:
    """Findings, each once; those of only some cases name these cases."""
    holders: dict[Finding, list[str]] = {}
    for name, analysis in analyses.items():
        for subject in SUBJECTS:
            for finding in first_of_each_code(subject(analysis)):
                holders.setdefault(finding, []).append(name)
    plans = [*given.cases().values()]
    for finding in (*theory.unused_gains(plans), *theory.unknown_robots(plans)):
        holders[finding] = [*analyses]
    found = []
    for finding, names in holders.items():
        message = finding.message
        if len(names) < len(analyses):
            quoted = join_names([f"'{name}'" for name in names], MOST_NAMED)
            message = f"in case{'s' * (len(names) > 1)} {quoted}: {message}"
        where = finding.where if isinstance(finding.where, str) else _place(given.source, finding.where, names)
        found.append(replace(finding, message=message, where=where))
    return sorted(found, key=lambda each: list(MARK).index(each.severity))


def _place(source: Source, path: Path, cases: Sequence[str]) -> str:
    """The place of `path` in the file or in a `--set`; in the first of `cases` that changes it, if any."""
    keys = source.places | {override.whole: TextPosition(0, 0) for override in source.overrides}
    own = next((p for name in cases if len(nearest(keys, p := ("cases", name, *path))[0]) > 2), path)
    return source.located(Fault(own, "")).place


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None


@QUIET
@supervised()
def _figures(analysis: Analysis) -> CheckNumbers:
    plan, links = analysis.plan, analysis.plan.links
    limits, prediction = analysis.limits, analysis.prediction
    arena, end = plan.experiment.arena, prediction.position[-1]
    fastest, follower = analysis.fastest, analysis.follower
    shape, (planar, spatial), spare, loop = analysis.shape, analysis.rigidity, analysis.spare, analysis.modes
    flown = not prediction.stuck  # else the robots stand at their starts, which says nothing of a run
    payload, words, load = theory.load(analysis)
    return CheckNumbers(
        robots=len(plan.names),
        arena=arena.size,
        obstacles={name: surroundings.describe_obstacle(obstacle) for name, obstacle in arena.obstacles.items()},
        links=len(links),
        edges=len(edges(links)),
        parts=analysis.parts,
        leaders=plan.leaders,
        algebraic_connectivity=algebraic_connectivity(links, len(plan.names)),
        rank=planar.rank if planar else None,
        rank_needed=planar.needed if planar else None,
        rank_space=spatial.rank if spatial else None,
        rank_space_needed=spatial.needed if spatial else None,
        smallest_eigenvalue=planar.smallest**2 if planar else None,
        spare_links=int(spare.pairs.sum()) if spare else None,
        vital_links=analysis.vital_links,
        spare_robots=int(spare.robots.sum()) if spare else None,
        vital_robots=analysis.vital_robots,
        residual_mm=_finite(1e3 * shape.worst) if shape else None,
        loop_gain=_finite(loop.gain) if loop else None,
        slowest_mode_s=_finite(loop.slowest_s) if loop else None,
        remembers=not analysis.is_gradient,
        free_modes=loop.free if loop else 0,
        speed_needed=_finite(fastest[2].speed()) if fastest else None,
        speed_available=None if follower is None else float(analysis.pull[follower]),
        acquired_s=analysis.acquired(analysis.departure) if shape and flown else None,
        acquired_noisy_s=analysis.noisy.acquired(analysis.departure) if shape and analysis.noisy else None,
        end_error_mm=_finite(1e3 * float(analysis.error[-1].max())) if shape and len(links) and flown else None,
        end={name: (float(x), float(y), float(z)) for name, (x, y, z) in zip(plan.names, end, strict=True)},
        end_inside=bool(((end >= np.array(limits.low) - FORGIVEN) & (end <= np.array(limits.high) + FORGIVEN)).all()),
        messages_hz=prediction.messages_hz,
        pose_bytes=payload,
        words_bytes=words,
        pose_kbit_s=load,
        predicted_s=prediction.end_s,
    )
