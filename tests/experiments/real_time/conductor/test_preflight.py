"""A robot that is tried gets no order to move after an interrupt."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from agents.clock import Clock
from agents.network import messages
from experiments.file import document
from experiments.real_time.conductor.preflight import Inspector, Trials
from experiments.real_time.conductor.run_view import RobotView
from tests.experiments.recordings import status
from tests.small import changed

NAME = "KH01"


class Trying(Inspector):
    """Checks of one robot on wheels, which obeys at once; the user interrupts when it is in the phase `at`."""

    def __init__(self, at: str) -> None:
        self._experiment, self._trials, self._clock = document.read("triangle").experiment, Trials(hop=True), Clock()
        self._robots, self._ended, self._states = {NAME: RobotView()}, {}, {}
        self._context: Any = SimpleNamespace(ended=lambda: self._robots[NAME].phase == at)
        nothing = SimpleNamespace(adopted=(), start=lambda *_: None, end_robots=lambda: None)
        self._processes: Any = nothing
        self._view: Any = SimpleNamespace(order=self._obey)
        self.given: list[str] = []
        self.trial = self._move

    def _update(self) -> None:
        if self._robots[NAME].status is None:
            self._enter("ready")

    def _obey(self, _names: list[str], order: messages.Order) -> dict[str, messages.Reply]:
        self.given.append(order.order)
        self._enter({"takeoff": "airborne", "start": "done"}.get(order.order, self._robots[NAME].phase))
        return {NAME: messages.Reply(NAME, ok=True, phase="")}

    def _enter(self, phase: str) -> None:
        self._robots[NAME].status = changed(status(NAME), phase=phase)


@pytest.mark.parametrize(("at", "given"), [("ready", []), ("airborne", ["takeoff"]), ("never", ["takeoff", "start"])])
def test_interrupt_before_a_trial_moves_nothing(at: str, given: list[str]) -> None:
    trying = Trying(at)
    tried = trying.trial(NAME, document.read("triangle").experiment.robots[NAME])
    assert [order for order in trying.given if order != "inspect"] == given
    assert bool(tried.failure) == (at != "never")
