"""Rules that a laboratory is asked about at its end: exit codes, what is left behind, and what counts as a success."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from pathlib import Path

import msgspec

from agents.decision.lifecycle import LANDING, TOLD_TO_END
from agents.vectors import Vector
from experiments.recording import playback
from tests.simulated.kernel import KILLED, Process
from tests.simulated.look import AT_THE_END, Look, rule
from tests.simulated.world import LOOK_S, OUTSIDE, World

TRUE_M = 0.05  # [m] difference of figures and true motions, which are sampled at other moments
ASKED = ("finished", "ordered to", "emergency", "asked to")  # reasons to land that are no faults


@dataclass
class End:
    """A laboratory after its end."""

    look: Look
    folder: Path

    @property
    def world(self) -> World:
        return self.look.world

    @property
    def code(self) -> int | None:
        return self.world.conductor.code

    @property
    def output(self) -> str:
        return "".join(self.world.conductor.out)

    @property
    def start(self) -> float:
        return self.world.moments.get("start", inf)

    @property
    def duration_s(self) -> float:
        return self.world.plan.experiment.duration_s if self.world.plan is not None else 0.0

    @property
    def own(self) -> list[Process]:
        return [process for process in self.world.processes if not process.name.startswith(OUTSIDE)]


@rule(AT_THE_END, "So after any failure a robot ends up stopped or landed.")
def robots_are_down(end: End) -> Iterator[str]:
    for body in end.world.bodies:
        if body.process.dead and body.process.code == 0:
            for row, name in enumerate(body.names):
                if (motion := body.motion(row)) is not None and motion.flying:
                    yield f"{name}: its process ended with 0, its motors are on"


@rule(AT_THE_END, "")
def all_end(end: End) -> Iterator[str]:
    """All processes of the run end."""
    if left := [process.name for process in end.own if not process.dead]:
        yield f"still there: {', '.join(left)}"


@rule(AT_THE_END, "")
def no_exception(end: End) -> Iterator[str]:
    """No exception ends a thread or a process, and none is printed."""
    for _, name, thread, text in end.world.kernel.crashes:
        yield f"{name}/{thread}: {text.strip().splitlines()[-1]}\n{text}"
    crashed = {crash[1] for crash in end.world.kernel.crashes}
    for process in end.world.processes:
        if process.name not in crashed and "Traceback" in (text := "".join(process.out)):
            yield f"{process.name} prints a traceback: {text[-600:]}"


@rule(AT_THE_END, "")
def exit_codes(end: End) -> Iterator[str]:
    """Exit codes are those that the documentation lists."""
    for process in end.own:
        good = (0, 1, 2, 3, 130, -9, -15) if process is end.world.conductor else (0, -9, 2, 70, -15)
        if process.dead and process.code not in good:
            yield f"{process.name}: exit code {process.code}"


@rule(AT_THE_END, "")
def exit_codes_of_the_run(end: End) -> Iterator[str]:
    """The run ends with 130 if it was interrupted, with 2 if it was not flown or its own process stood still."""
    conductor, kinds = end.world.conductor, {fault.kind for fault in end.world.script}
    if end.code == 130 and not end.world.interrupted:
        yield "exit code 130 without an interrupt"
    if end.code == 2 and "start" in end.world.moments and conductor.paused_at == -inf and not kinds & {"late", "hang"}:
        yield f"exit code 2 of a run that began: {end.output[-300:]}"
    if end.code in {KILLED, -15} and not kinds & {"kill", "term"}:
        yield f"exit code {end.code}"


@rule(AT_THE_END, "")
def commands_end(end: End) -> Iterator[str]:
    """Commands of operators end, with a code that the documentation lists."""
    for t, _, words, process in end.world.answers:
        ended = end.world.ends.get(process.pid, inf)
        if process.code not in {0, 1, 2, None}:
            yield f"`{words}`: exit code {process.code}"
        if ended - t > (95.0 if "re" in words else 12.0) + end.look.slack_s and end.look.now - t > 95.0:
            yield f"`{words}` takes {ended - t:.0f} s"


@rule(AT_THE_END, "ends with exit code 1 and says so in its last line")
def words_for_a_failure(end: End) -> Iterator[str]:
    reasons = ("zenpark: ", "Spoiled", "Not passed", "failed", "landed", "emergency stop")
    if end.code in {1, 2, 3} and not any(word in end.output for word in reasons):
        yield f"exit code {end.code} without a reason: {end.output[-300:]}"


@rule(AT_THE_END, "")
def counters(end: End) -> Iterator[str]:
    """No counter of lost poses is negative."""
    for name, process in end.world.robots.items():
        runtime = end.world.runtimes.get(process.pid)
        if runtime is not None and runtime._joined:
            for sender in runtime._neighbours.senders:
                if sender.lost < 0:
                    yield f"{name}: lost {sender.lost} of {sender.name}"


@rule(AT_THE_END, "**A robot that did not do its part fails the run.**")
def no_success_without_all(end: End) -> Iterator[str]:
    """Exit code 0 only if every robot did its part."""
    if end.code != 0:
        return
    for process in end.own:
        runtime = end.world.runtimes.get(process.pid)
        for robot in [] if runtime is None else runtime.robots:
            life = robot.lifecycle
            if life.phase >= LANDING and not life.reason.startswith(ASKED) and robot.begun:
                yield f"{robot.assignment.name}: {life.reason}"
        ended = end.world.ends.get(process.pid, inf) - end.start
        restarted = process.name.endswith(("router", "router2", "router3", "world", "centre"))
        if process.code == KILLED and not restarted and 0.0 < ended < end.duration_s - 0.6:
            yield f"{process.name} was killed at {ended:.1f} s"
    assert end.world.plan is not None
    for name, asked in end.world.plan.experiment.robots.items():
        ran, held = end.look.ran_s.get(name, 0.0), end.look.held_s.get(name, 0.0)
        if asked.standby or end.world.interrupted:
            continue
        if ran < 0.8 * end.duration_s - end.look.slack_s:
            yield f"{name}: ran for {ran:.1f} of {end.duration_s:g} s"
        elif held > 0.2 * end.duration_s + 3.0 * LOOK_S + end.look.slack_s:
            yield f"{name}: held for {held:.1f} of {end.duration_s:g} s"


@rule(AT_THE_END, "")
def no_success_of_a_part(end: End) -> Iterator[str]:
    """Exit code 0 only if the figures are over the whole run."""
    metrics = end.folder / "metrics.json"
    for case in msgspec.json.decode(metrics.read_bytes()) if end.code == 0 and metrics.is_file() else ():
        if case["interrupted"]:
            yield f"{case['case']}: figures of {case['duration_s']:.1f} of {case['planned_s']:g} s"


@rule(AT_THE_END, "")
def figures_are_true(end: End) -> Iterator[str]:
    """With exit code 0 the figures agree with the true motions of the bodies."""
    metrics, plan = end.folder / "metrics.json", end.world.plan
    if end.code != 0 or plan is None or not metrics.is_file():
        return
    (case,) = msgspec.json.decode(metrics.read_bytes())
    if case.get("away_s"):  # a part of the run is told as unknown
        return
    places: dict[float, dict[str, Vector]] = {}  # true places [m] by time and robot
    for name in plan.names:
        for t, position, *_ in end.world.samples.get(name, ()):
            if 0.0 <= t - end.start <= end.duration_s:
                places.setdefault(t, {})[name] = position
    if not places:  # true motions of real processes are unknown
        return
    pairs = [pair for each in places.values() for pair in itertools.combinations(each.items(), 2)]
    closest = min((math.dist(p, q) for (_, p), (_, q) in pairs), default=inf)
    told = case["mean"]["closest"]
    if told is not None and abs(told - closest) > TRUE_M:
        yield f"closest robots {told:.3f} m, truly {closest:.3f} m"
    size = plan.experiment.arena.size
    beyond = [
        max(abs(x) - 0.5 * size[0], abs(y) - 0.5 * size[1], z - size[2])
        for each in places.values()
        for x, y, z in each.values()
    ]
    outside = max(beyond, default=0.0)
    if abs(case["excursion"] - max(outside, 0.0)) > TRUE_M:
        yield f"{case['excursion']:.3f} m outside the arena, truly {outside:.3f} m"
    kinds = dict(zip(plan.names, plan.kinds, strict=True))
    touching = {
        tuple(sorted((one, other)))
        for (one, p), (other, q) in pairs
        if math.dist(p[:2], q[:2]) < kinds[one].radius + kinds[other].radius - TRUE_M
        and abs(p[2] - q[2]) < min(kinds[one].height, kinds[other].height)
    }
    if missing := touching - {tuple(sorted((each["first"], each["second"]))) for each in case["collisions"]}:
        yield f"contacts that no figure tells: {sorted(missing)}"


@rule(AT_THE_END, "An emergency stop ends the whole run")
def no_success_after_a_stop(end: End) -> Iterator[str]:
    at = min(end.world.stops, default=inf) - end.start
    if end.code == 0 and 0.0 < at < end.duration_s - 0.3:
        yield f"emergency stop at {at:.1f} s"


@rule(AT_THE_END, "")
def no_success_after_a_change(end: End) -> Iterator[str]:
    """Exit code 0 only if no operator has landed, stopped or exchanged a robot in the run, or ended its process."""
    for t, who, words, process in end.world.answers:
        changed = words.split()[1:2] in (["remove"], ["replace"], ["land"], ["stop"])
        if (
            end.code == 0
            and changed
            and process.code == 0
            and 0.1 < t - end.start < end.duration_s - playback.EARLY_S - 0.1
        ):
            yield f"{who}: `{words}` at {t - end.start:.1f} s"
    own = {process.pid for process in end.own}
    for t, name, pid, phase, reason in end.world.phases if end.code == 0 else ():
        early = 0.1 < t - end.start < end.duration_s - playback.EARLY_S - 0.1
        if pid in own and phase == LANDING and reason.startswith(TOLD_TO_END) and early:
            yield f"{name}: {reason} at {t - end.start:.1f} s"


@rule(AT_THE_END, "")
def recording_is_kept(end: End) -> Iterator[str]:
    """The recording is found, and its figures are finite."""
    if end.code not in {0, 1, 3} or "start" not in end.world.moments or end.world.disks:
        return
    for case in end.world.cases[:1]:
        file = end.folder / f"{case}.mcap"
        if parts := sorted(end.folder.rglob("part*.mcap")):
            yield f"parts are left: {parts}"
        if not file.is_file():
            yield f"no {file.name}"
            continue
        try:
            if not (end.folder / "metrics.json").is_file():
                playback.read(file)
        except playback.NotStarted:
            pass
        except Exception as error:  # noqa: BLE001 - whatever it is, a rule is broken
            yield f"{file.name}: {type(error).__name__}: {error}"
    metrics = end.folder / "metrics.json"
    if metrics.is_file() and (bad := [*_not_finite(msgspec.json.decode(metrics.read_bytes()))]):
        yield f"figures are no numbers: {bad[:5]}"


def _not_finite(value: object, place: str = "") -> Iterator[str]:
    if isinstance(value, float) and not math.isfinite(value):
        yield place
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _not_finite(each, f"{place}.{key}")
    elif isinstance(value, list):
        for number, each in enumerate(value):
            yield from _not_finite(each, f"{place}[{number}]")
