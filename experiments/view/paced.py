"""View of a run in virtual time: simulated as fast as it is watched, with pause, steps and speed; for teaching."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from math import inf, isnan, nan
from typing import TYPE_CHECKING, Final

import numpy as np

from agents.decision.lifecycle import RUNNING
from agents.network.messages import Event
from experiments.definition.experiment import Experiment
from experiments.scene.stage import Condition, LinkTracker, Moment, Stage, Trail
from experiments.view.live import FRAME_S, Page
from experiments.view.panel import PLOT_S, Row, known
from experiments.view.replay import CONDITION_OF, Clock, add_transport
from experiments.virtual_time.simulation import Instant

if TYPE_CHECKING:
    import viser

POLL_S: Final = 0.005
PAGE_S: Final = 30.0  # the first case waits so long for a page


class PacedView:
    """The page of a run in virtual time; `watch` is called by the simulation, which waits in it."""

    def __init__(self, server: viser.ViserServer, *, pace: float, dark: bool) -> None:
        """`pace`: simulated seconds in one second, at first."""
        self._server = server
        self.clock = Clock(-inf, inf, -inf)
        self.clock.speed, self.clock.playing = pace, True
        with server.gui.add_folder("Virtual time", order=5.0):
            add_transport(server, self.clock, ("+1", "+1 s"))
        self._page = Page(server, dark=dark)
        self._opened = time.monotonic()

    def begin(self, case: str, experiment: Experiment) -> Callable[[Instant], object]:
        """Another case begins; returns what its simulation calls."""
        stage = self._stage = Stage.of_experiment(experiment)
        self._case, self._experiment = case, experiment
        rows = len(stage.names)
        self._tracker, self._trail = LinkTracker(stage), Trail(rows)
        self._sent, self._sent_at = [deque[float]() for _ in stage.names], np.full(rows, -inf)
        self._events: list[Event] = []
        self._incidents = 0
        self._drawn = self._waited = -inf
        self._page.begin(stage)
        self.clock.t = -inf
        return self.watch

    def watch(self, instant: Instant) -> None:
        """Draws a moment of the simulation, and holds it until the clock of the page is there."""
        clock = self.clock
        while not self._server.get_clients() and time.monotonic() - self._opened < PAGE_S:
            time.sleep(POLL_S)
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

    def _count(self, instant: Instant) -> None:
        """Transmissions and incidents since the last call."""
        at = instant.agent.transmitter.last_event.time
        for row in np.flatnonzero(at > self._sent_at).tolist():
            self._sent[row].append(float(at[row]))
        self._sent_at = at.copy()
        for sent in self._sent:
            while sent and sent[0] <= instant.now - 1.0:
                sent.popleft()
        news = instant.agent.hazards.incidents[self._incidents :]
        self._incidents += len(news)
        begin = instant.now - instant.time
        for each in news:
            self._events.append(Event(each.time - begin, "hazard", self._stage.names[each.row], each.text))

    def _moment(self, instant: Instant) -> Moment:
        agent, state = instant.agent, instant.state
        known = np.isfinite(state.true_position).all(axis=1, keepdims=True)
        position = np.where(known, state.true_position, state.position)
        phase, elapsed = agent.lifecycle.phase, None if isnan(instant.time) else instant.time
        held = agent.hazards.held
        conditions = [
            CONDITION_OF.get(int(each), Condition.HELD if held[row] else Condition.ACTIVE)
            for row, each in enumerate(phase)
        ]
        self._trail.add(instant.now, position)
        return Moment(
            position=position,
            yaw=np.where(np.isfinite(state.true_yaw), state.true_yaw, state.yaw),
            goal=np.where((phase == RUNNING)[:, None], agent.goal, nan),
            condition=np.array(conditions, dtype=np.intp),
            silent_for=instant.now - self._sent_at,
            error=self._tracker.errors(elapsed, position),
            broken=np.zeros(len(self._stage.links), dtype=bool),
            obstacles=np.array(instant.engine.obstacles)[0],
            trail=self._trail.points,
            attitude=state.attitude,
            shadow=state.shadow_position,
            shadow_yaw=state.shadow_yaw,
            time=elapsed,
        )

    def _draw(self, instant: Instant, now: float) -> None:
        moment = self._moment(instant)
        with self._server.atomic():
            self._page.drawing.draw(moment, still=not self.clock.playing)
        errors = self._tracker.of_robots(moment.error)
        panel = self._page.panel
        history = panel.history
        if not history.time or instant.now - history.time[-1] >= PLOT_S:
            history.add(instant.now, errors, np.array([float(len(each)) for each in self._sent]))
        self._page.refresh(now, panel.show_plots, partial(self._tabulate, instant, moment))

    def _tabulate(self, instant: Instant, moment: Moment) -> None:
        errors = self._tracker.of_robots(moment.error)
        battery, panel = instant.state.battery, self._page.panel
        rows = [
            Row(
                name, Condition(int(moment.condition[k])), known(errors[k]), float(len(self._sent[k])),
                known(battery[k]), note=instant.agent.hazards.worst(k),
            )
            for k, name in enumerate(self._stage.names)
        ]  # fmt: skip
        phase = "running" if moment.time is not None and moment.time >= 0.0 else "taking off"
        where = f"virtual time, {self.clock.speed:g} times as fast" + ("" if self.clock.playing else ", paused")
        panel.show_head(self._case, phase, moment.time, self._experiment.duration_s, where)
        panel.show_robots(rows)
        panel.show_links(moment.error, [None] * len(moment.error))
        panel.show_events(self._events, 0.0)
