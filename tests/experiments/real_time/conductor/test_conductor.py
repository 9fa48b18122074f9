"""The course of a case without network and processes: when it is over, and what spoils it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from experiments.file import document
from experiments.real_time.conductor import conductor as module
from experiments.real_time.conductor.case_processes import Death
from experiments.real_time.conductor.conductor import Conductor
from experiments.real_time.conductor.run_view import Progress, RobotView, RunFailed
from tests.experiments.recordings import START, status

EXPERIMENT = msgspec.structs.replace(document.read("triangle").experiment, duration_s=10.0)
STEP_S = 0.5  # of the clock, at each look at it
DEAD = Death("recorder", "conductor", "the recorder ended (killed by SIGKILL); started again")


class Clock:
    now = START

    def utc(self) -> float:
        self.now += STEP_S
        return self.now


class Course(Conductor):
    """A conductor whose robots are in `phases`, by the time since the common start."""

    def __init__(self, phases: dict[float, str], deaths: dict[float, Death] | None = None) -> None:
        self.clock = Clock()
        self._clock: Any = self.clock
        self._experiment = EXPERIMENT
        self.robots = self._robots = {name: RobotView() for name in EXPERIMENT.robots}
        self._progress = Progress("only", "", None, 10.0, self._robots)
        self._phases, self._deaths = phases, deaths or {}
        self.failures: list[str] = []
        self._starting: set[str] = set()
        self._landed: set[str] = set()
        self.reasons: dict[str, str] = {}  # of robots that have landed at 3 s, before all others
        self.killed = 0
        nothing: Any = SimpleNamespace(
            under_way=set(), begin=lambda _: None, advance=lambda: None, news=lambda: ((), ()), close=lambda: None
        )
        self._changes = self._drift = nothing
        self._context: Any = SimpleNamespace(ended=lambda: False, emergency=None)
        self.processes: Any = SimpleNamespace(
            deaths=self._died, recording=True, kill_recorder=lambda: setattr(self, "killed", self.killed + 1)
        )
        self.view: Any = SimpleNamespace(
            update=self._phase, report=lambda *_, **__: None, report_drift=lambda *_: None, order=lambda *_: {},
            recorder_stands_still=False, recording_begun=True, await_recorder=lambda: None,
            refuse_joining=lambda: None,
        )  # fmt: skip
        self._processes, self._view = self.processes, self.view
        self.update, self.land = self._update, self._land
        self._show: Any = lambda _: None

    def _show_progress(self) -> None: ...

    def _phase(self) -> list[str]:
        now = self._clock.now - START
        phase = next(said for at, said in sorted(self._phases.items(), reverse=True) if now >= at)
        for name, view in self._robots.items():
            reason = self.reasons.get(name, "") if now >= 3.0 else ""
            view.status = msgspec.structs.replace(
                status(name, at=now), phase="landing" if reason else phase, reason=reason
            )
        return []

    def _died(self) -> list[Death]:
        return [self._deaths.pop(at) for at in list(self._deaths) if self._clock.now - START >= at]


@pytest.fixture(autouse=True)
def _without_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "time", SimpleNamespace(sleep=lambda _: None, monotonic=lambda: 0.0))


@pytest.mark.parametrize(
    ("landing", "failures"), [(3.0, ["all robots had landed after 3.0 of 10 s"]), (9.6, []), (10.2, [])]
)
def test_a_run_that_ended_early_has_failed(landing: float, failures: list[str]) -> None:
    course = Course({0.0: "running", landing: "landing"})
    course.walk(START)
    assert [text.replace("3.5", "3.0") for text in course.failures] == failures


@pytest.mark.parametrize(
    ("reason", "spoilt"), [("ordered to land", True), ("ordered to stop", True), ("its battery is low", False)]
)
def test_robot_that_was_ordered_down_spoils_the_run(reason: str, spoilt: bool) -> None:
    """Any other landing is a hazard of the recording."""
    course = Course({0.0: "running", 10.0: "landing"})
    name = next(iter(course.robots))
    course.reasons = {name: reason}
    course.walk(START)
    assert [text.split(" of ")[0].rpartition(" ")[0] for text in course.failures] == [f"{name} landed after"] * spoilt


def test_a_run_without_any_robot_left_has_failed() -> None:
    course = Course({0.0: "running"})
    for view in course.robots.values():
        view.left_because = "lost"
    course.walk(START)
    assert [text.partition(" after")[0] for text in course.failures] == ["no robot was left"]


def test_a_recorder_that_dies_spoils_the_run() -> None:
    course = Course({0.0: "running", 10.0: "landing"}, {4.0: DEAD})
    course.walk(START)
    assert course.failures == [DEAD.text]


def test_a_recorder_is_awaited_again_before_the_start() -> None:
    course = Course({0.0: "ready"}, {0.0: DEAD})
    assert course.await_phase("ready", 10.0, recorder=True)
    assert course.failures == []


def test_nothing_flies_without_a_recorder() -> None:
    course = Course({0.0: "ready"})
    course.processes.recording = False
    with pytest.raises(RunFailed, match="nothing would be recorded"):
        course.await_phase("ready", 10.0, recorder=True)


def test_a_recorder_that_stands_still_is_killed() -> None:
    course = Course({0.0: "running"})
    course.view.recorder_stands_still = True
    course.update()
    assert course.killed == 1


def test_order_to_land_is_repeated_until_all_obey(monkeypatch):
    course = Course({0.0: "running", 4.0: "done"})
    monkeypatch.setattr(module, "time", SimpleNamespace(sleep=lambda _: None, monotonic=lambda: course.clock.now))
    asked: list[tuple[str, list[str]]] = []
    course.view.order = lambda names, order: asked.append((order.order, names)) or {}
    course.update()
    course.land()
    assert asked[:3] == [("land", list(course.robots))] * 3
    assert not any(view.left_because for view in course.robots.values())


def test_output_of_a_lost_robot_is_told_once():
    course = Course({})
    lost, late = list(course.robots)[:2]
    course.processes.last_line = lambda name: f"last words of {name}"
    course.robots[lost].left_because = "lost"
    told = course.start_failure([lost, late], "could not start")
    assert told.count("could not start") == 1
    assert f"last words of {late}" in told
    assert f"last words of {lost}" not in told  # the event of its end has them
