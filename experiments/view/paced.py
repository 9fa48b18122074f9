"""View of a run in virtual time: simulated as fast as it is watched, with pause, steps and speed; for teaching."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from math import inf, isnan, nan
from typing import TYPE_CHECKING, Final

import numpy as np

from agents.body.interface import BodyState
from agents.clock import wait_until
from agents.decision.lifecycle import RUNNING, Phase
from agents.network.messages import Event, Status
from experiments.definition.plan import Plan
from experiments.scene.condition import condition
from experiments.scene.stage import LinkTracker, Moment, SceneModel, Trail
from experiments.view.live import FRAME_S, Page
from experiments.view.panel import PLOT_S, known, robot_rows
from experiments.view.replay import ReplayClock, add_transport
from experiments.virtual_time.simulation import Snapshot
from twins.arrays import Array

if TYPE_CHECKING:
    import viser

POLL_S: Final = 0.005
PAGE_S: Final = 30.0  # time for which the first case waits for a page


class PacedView:
    """The page of a run in virtual time; `watch` is called by the simulation, which waits in it."""

    def __init__(self, server: viser.ViserServer, *, pace: float, dark: bool, page_s: float = PAGE_S) -> None:
        """`pace`: simulated seconds in one second, at first; `page_s`: limit of the wait for a page [s]."""
        self._server, self._page_s = server, page_s
        self.clock = ReplayClock(-inf, inf, -inf)
        self.clock.speed, self.clock.playing = pace, True
        with server.gui.add_folder("Virtual time", order=5.0):
            add_transport(server, self.clock, ("+1", "+1 s"))
        self._page = Page(server, dark=dark)
        self._opened = time.monotonic()

    def begin(self, case: str, plan: Plan) -> Callable[[Snapshot], object]:
        """Another case begins; returns what its simulation calls."""
        stage = self._stage = SceneModel.of_plan(plan)
        self._case, self._plan = case, plan
        rows = len(stage.names)
        self._tracker, self._trail = LinkTracker(stage), Trail(rows)
        self._sent, self._sent_at = [deque[float]() for _ in stage.names], [-inf] * rows
        self._events: list[Event] = []
        self._incidents = [0] * rows
        self._drawn = self._waited = -inf
        self._page.begin(stage)
        self.clock.t = -inf
        return self.watch

    def watch(self, instant: Snapshot) -> None:
        """Draws a moment of the simulation, and holds it until the clock of the page is there."""
        clock = self.clock
        wait_until(self._server.get_clients, self._opened + self._page_s - time.monotonic(), POLL_S)
        if clock.t == -inf:
            clock.t, self._waited = instant.now, time.monotonic()
        self._count(instant)
        while True:
            now = time.monotonic()
            clock.advance(now - self._waited)
            self._waited = now
            if now - self._drawn >= FRAME_S:
                self._drawn = now
                self._draw(instant, now)
            if instant.now <= clock.t:
                return
            time.sleep(POLL_S)

    def _count(self, instant: Snapshot) -> None:
        """Transmissions and incidents since the last call."""
        for row, robot in enumerate(instant.robots):
            at = robot.transmitter.asking.last.time
            if at > self._sent_at[row]:
                self._sent[row].append(at)
                self._sent_at[row] = at
        for sent in self._sent:
            while sent and sent[0] <= instant.now - 1.0:
                sent.popleft()
        begin = instant.now - instant.time
        for row, robot in enumerate(instant.robots):
            for each in robot.hazards.incidents[self._incidents[row] :]:
                self._incidents[row] += 1
                self._events.append(Event(each.time - begin, "hazard", self._stage.names[row], each.text))

    def _moment(self, instant: Snapshot) -> Moment:
        robots, states = instant.robots, instant.states
        truth, measured = _column(states, "true_position"), _column(states, "position")
        position = np.where(np.isfinite(truth).all(axis=1, keepdims=True), truth, measured)
        true_yaw, yaw = _column(states, "true_yaw"), _column(states, "yaw")
        attitude, shadow = _column(states, "attitude"), _column(states, "shadow_position")
        running = np.array([robot.lifecycle.phase == RUNNING for robot in robots])
        elapsed, obstacles = None if isnan(instant.time) else instant.time, np.array(instant.engine.obstacles)
        overlaps = self._stage.overlaps(position, obstacles, None)
        touching = {name for each in overlaps for name in (each.first, each.second)}
        conditions = [condition(status, touches=status.robot in touching) for status in self._statuses(instant)]
        self._trail.add(instant.now, position)
        laws = [robot.stepping for robot in robots]  # nothing is known here of guided robots
        return Moment(
            position=position,
            yaw=np.where(np.isfinite(true_yaw), true_yaw, yaw),
            goal=np.where(running[:, None], np.array([robot.goal for robot in robots]), nan),
            condition=np.array(conditions, dtype=np.intp),
            silent_for=instant.now - np.array(self._sent_at),
            error=self._tracker.errors(elapsed, position),
            broken=np.zeros(len(self._stage.links), dtype=bool),
            obstacles=obstacles,
            trail=self._trail.points,
            attitude=None if np.isnan(attitude).all() else attitude,
            shadow=None if np.isnan(shadow).all() else shadow,
            shadow_yaw=None if np.isnan(shadow).all() else _column(states, "shadow_yaw"),
            time=elapsed,
            places=self._stage.said_places([{} if law is None else law.memory for law in laws], position),
            measures=[{} if law is None else law.measures for law in laws],
            overlaps=overlaps,
        )

    def _statuses(self, instant: Snapshot) -> list[Status]:
        """Statuses as robots of a run in real time send them, as far as they are shown."""
        return [
            Status(
                name, instant.now, Phase(robot.lifecycle.phase).word, robot.lifecycle.reason,
                battery=known(state.battery), hazard=robot.hazards.worst(),
            )
            for name, robot, state in zip(self._stage.names, instant.robots, instant.states, strict=True)
        ]  # fmt: skip

    def _draw(self, instant: Snapshot, now: float) -> None:
        moment = self._moment(instant)
        with self._server.atomic():
            self._page.drawing.draw(moment, still=not self.clock.playing)
        errors = self._tracker.of_robots(moment.error)
        panel = self._page.panel
        history = panel.history
        if not history.time or instant.now - history.time[-1] >= PLOT_S:
            history.add(instant.now, errors, np.array([float(len(each)) for each in self._sent]))
        self._page.refresh(now, panel.show_plots, partial(self._tabulate, instant, moment))

    def _tabulate(self, instant: Snapshot, moment: Moment) -> None:
        errors = self._tracker.of_robots(moment.error)
        panel = self._page.panel
        rate = [float(len(each)) for each in self._sent]
        rows = robot_rows(self._stage.names, moment, self._statuses(instant), errors, rate, ticks=False)
        phase = "running" if moment.time is not None and moment.time >= 0.0 else "taking off"
        where = f"virtual time, {self.clock.speed:g} times as fast" + ("" if self.clock.playing else ", paused")
        panel.show_head(self._case, phase, moment.time, self._plan.experiment.duration_s, where)
        panel.show_tables(rows, moment.error, self._events, 0.0)


def _column(states: Sequence[BodyState], name: str) -> Array:
    return np.array([getattr(state, name) for state in states], dtype=float)
