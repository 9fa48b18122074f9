"""Replay of recordings in the live view's scene: a clock with play, pause, speed and a slider; cases side by side."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from math import inf, nan
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from agents.decision.lifecycle import Phase
from agents.network.messages import Contact, Status, WorldState
from agents.ticks import ROUNDING_S
from experiments.definition.formation import errors_over_time
from experiments.metrics.clearance import Overlap
from experiments.recording.playback import WholeRecording
from experiments.scene.condition import AT_REST, Condition, RobotRow, condition
from experiments.scene.drawing import SceneDrawing
from experiments.scene.stage import TOUCH_S, TRAIL, TRAIL_S, LinkTracker, Moment, SceneModel, with_bare_links
from experiments.view.live import FRAME_S, IDLE_S, TABLE_S, Page
from experiments.view.panel import HISTORY_S, PLOT_S, History, robot_rows
from twins.arrays import Array, Index

if TYPE_CHECKING:
    import viser

M = TypeVar("M", Contact, Status, WorldState)
LOST_S: Final = 1.0  # time without a sample after which a robot is silent
SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2", "5", "10", "20")
STEP_S: Final = 0.02  # length of a single step: a sample at 50 Hz
APART: Final = 0.15  # distance of words on the slider, in its lengths
GAP: Final = 1.15  # distance from arena to arena, in its lengths


class Film:
    """A recorded case as moments."""

    def __init__(self, recording: WholeRecording) -> None:
        self.recording, self.trace = recording, recording.trace
        self.stage = SceneModel.of_plan(self.trace.plan)
        self.links = LinkTracker(self.stage)
        time, place = self.trace.time, self.trace.true_position
        self.begin, self.end = float(time[0]), float(time[-1])
        rows = np.arange(len(time))[:, None]
        known = np.where(np.isfinite(place).all(axis=2), rows, -1)
        self._newest: Index = np.maximum.accumulate(known, axis=0)  # (T, N) last sample with a position; −1: none yet
        held = np.take_along_axis(place, np.maximum(self._newest, 0)[..., None], axis=0)
        self._place: Array = np.where(self._newest[..., None] < 0, nan, held)  # silent robots stay where they were
        self._sent: list[Array] = [np.sort(own) for own in self.trace.sent_at]
        self._ages: Array = TRAIL_S * np.arange(TRAIL, dtype=np.float64)

    def positions(self, times: Array) -> Array:
        """Positions (..., N, 3) [m] at `times` (...) [s], interpolated; unknown before the first sample."""
        time = self.trace.time
        at = np.interp(times, time, np.arange(len(time)), left=nan)
        low = np.nan_to_num(at).astype(np.intp)
        share = (at - low)[..., None, None]
        before, after = self._place[low], self._place[np.minimum(low + 1, len(time) - 1)]
        return np.where(share == 0.0, before, before + share * (after - before))

    def moment(self, t: float) -> Moment:
        """The case at `t` [s] since the common start: between two samples, positions are interpolated."""
        trace, world = self.trace, _last_status(self.trace.world, t)
        sample = int(np.searchsorted(trace.time, t + ROUNDING_S, side="right")) - 1
        trail = self.positions(t - self._ages).swapaxes(0, 1)
        position = trail[:, 0]
        obstacles = self.stage.obstacles_at(t, world)
        overlaps = [
            *self.stage.overlaps(position, obstacles, world),
            *(Overlap(each.first, each.second, each.overlap) for each in _lately(trace.contacts or (), t, TOUCH_S)),
        ]
        touching = {name for each in overlaps for name in (each.first, each.second)}
        conditions = np.array(
            [self._condition(row, sample, t, touches=name in touching) for row, name in enumerate(trace.robots)],
            dtype=np.intp,
        )
        goal = self._taken(trace.goal, sample)
        goal[np.isin(conditions, AT_REST)] = nan
        shadow_yaw = None if trace.shadow_yaw is None else self._taken(trace.shadow_yaw, sample)
        return Moment(
            position=position,
            yaw=self._taken(trace.yaw, sample),
            goal=goal,
            condition=conditions,
            silent_for=np.array([_time_since(sent, t) for sent in self._sent]),
            error=self.links.errors(t, position),
            broken=self.stage.broken_links(conditions, self._statuses(t)),
            obstacles=obstacles,
            trail=trail,
            attitude=None if trace.attitude is None else self._taken(trace.attitude, sample),
            shadow=None if trace.shadow_position is None else self._taken(trace.shadow_position, sample),
            shadow_yaw=shadow_yaw,
            time=t,
            places=self.stage.said_places(self._remembered(trace.memory, sample), position),
            measures=self._remembered(trace.measures, sample),
            overlaps=overlaps,
        )

    def rows(self, t: float) -> list[RobotRow]:
        """The table at `t` [s]."""
        moment, statuses = self.moment(t), self._statuses(t)
        rate = [float(np.subtract(*np.searchsorted(each, (t, t - 1.0), side="right"))) for each in self._sent]
        ticks = self.trace.clock == "real"  # virtual time misses none
        return robot_rows(self.trace.robots, moment, statuses, self.links.of_robots(moment.error), rate, ticks=ticks)

    def history(self) -> History:
        """Errors and rates of the whole case, four times a second."""
        stage = self.stage
        history = History(len(stage.names))
        grid = np.arange(self.begin, self.end, PLOT_S)
        error = np.zeros((len(grid), len(stage.links)))
        if stage.plan is not None and len(stage.links):
            place = self.positions(grid)
            error = errors_over_time(stage.plan.law, stage.plan.formation, grid, place)
            error = np.nan_to_num(with_bare_links(stage.plan, grid, place, error), posinf=np.inf)
        sent = [np.searchsorted(each, grid) - np.searchsorted(each, grid - 1.0) for each in self._sent]
        history.time = grid.tolist()
        history.error = [self.links.of_robots(each) for each in error]
        history.rate = list(np.stack(sent, axis=1).astype(float))
        return history

    def _condition(self, row: int, sample: int, t: float, *, touches: bool) -> Condition:
        """Condition of a robot by its sample and its last status."""
        newest = -1 if sample < 0 else self._newest[sample, row]
        if newest < 0:
            return Condition.WAITING
        silent, last = t - self.trace.time[newest] > LOST_S, newest == self._newest[-1, row]
        phase = Phase(int(self.recording.phase[sample, row])).word
        alive = not (silent and last)
        return condition(self._statuses(t)[row], phase, alive=alive, silent=silent, touches=touches)

    def _statuses(self, t: float) -> list[Status | None]:
        """Last status of each robot."""
        return [_last_status(own, t) for own in self.recording.statuses]

    @staticmethod
    def _taken(values: Array, sample: int) -> Array:
        """Row of a column (T, N, ...) at a sample; unknown before the first."""
        return values[sample].copy() if sample >= 0 else np.full(values.shape[1:], nan)

    def _remembered(self, columns: Mapping[str, Array], sample: int) -> list[dict[str, Any]]:
        """Known values of each robot's law at a sample, by name."""
        found: list[dict[str, Any]] = [{} for _ in self.trace.robots]
        for name, values in columns.items() if sample >= 0 else ():
            for row in np.flatnonzero(np.isfinite(values[sample]).reshape(len(found), -1).all(axis=1)).tolist():
                found[row][name] = values[sample, row].tolist()
        return found


def _last_status(messages: Sequence[M], t: float) -> M | None:
    """The last message at or before `t` [s]."""
    count = bisect_right(messages, t, key=attrgetter("stamp"))
    return messages[count - 1] if count else None


def _lately(messages: Sequence[M], t: float, span: float) -> Sequence[M]:
    """Messages of the last `span` before `t` [s]."""
    first, last = (bisect_right(messages, at, key=attrgetter("stamp")) for at in (t - span, t))
    return messages[first:last]


def _time_since(sent: Array, t: float) -> float:
    """Time since the last of some events at or before `t` [s]."""
    k = int(np.searchsorted(sent, t + ROUNDING_S, side="right"))
    return t - float(sent[k - 1]) if k else inf


class ReplayClock:
    """Time of a replay: plays, pauses, goes by steps, at any speed."""

    def __init__(self, begin: float, end: float, t: float = 0.0) -> None:
        self.begin, self.end, self.t = begin, end, t  # [s]
        self.playing, self.speed, self.loop = False, 1.0, False

    def advance(self, elapsed: float) -> None:
        """`elapsed` [s] have passed outside; at the end it stops, or begins again."""
        if not self.playing:
            return
        self.t += self.speed * elapsed
        if self.t >= self.end:
            self.t = self.begin if self.loop else self.end
            self.playing = self.loop

    def toggle(self) -> None:
        """Play, from the beginning if it is at the end, or pause."""
        if not self.playing and self.t >= self.end:
            self.t = self.begin
        self.playing = not self.playing

    def seek(self, t: float) -> None:
        self.t = min(max(t, self.begin), self.end)


def _add_transport(server: viser.ViserServer, clock: ReplayClock) -> None:
    """Adds play and pause, also by the space bar, steps of a sample or some seconds, and the speed."""
    import viser  # noqa: PLC0415 - an extra

    def step(event: viser.GuiEvent[Any]) -> None:
        what = str(event.target.value)
        clock.playing = False
        clock.seek(clock.t + float(what.split(maxsplit=1)[0]) * (1.0 if what.endswith("s") else STEP_S))

    play = server.gui.add_button("Play / pause (Space)", icon=viser.Icon.PLAYER_PLAY)
    play.on_click(lambda _: clock.toggle())
    server.gui.add_button_group("step", ("-1 s", "-1", "+1", "+1 s")).on_click(step)
    given = f"{clock.speed:g}"
    speed = server.gui.add_dropdown("speed", tuple(dict.fromkeys((*SPEEDS, given))), initial_value=given)
    speed.on_update(lambda event: setattr(clock, "speed", float(event.target.value)))
    key = server.gui.add_command("Play or pause", hotkey="space", icon=viser.Icon.PLAYER_PLAY)
    key.on_trigger(lambda _: clock.toggle())


class ReplayView:
    """The page of the recordings of a run."""

    def __init__(
        self, server: viser.ViserServer, films: Sequence[Film], where: str, *, dark: bool, pace: float | None = None
    ) -> None:
        """Draws all cases beside one another; `where` says which run it is.

        With a `pace`, a multiple of real time, it plays from the beginning as soon as a page is open.
        """
        self._server, self._films = server, list(films)
        self._where = where
        self.clock = ReplayClock(min(film.begin for film in films), max(film.end for film in films))
        if pace is not None:
            self.clock.t = self.clock.begin
            self.clock.speed, self.clock.playing = pace, True
        self._drawn: object = None
        self._tabled = -inf
        self._build_controls()
        self._page = page = Page(server, dark=dark)
        self._shown = -1
        self._drawings = []
        sizes = [film.stage.size for film in films]
        pitch = GAP * max(float(size[0]) for size in sizes)
        with server.atomic():
            for k, film in enumerate(films):
                drawing = SceneDrawing(server, film.stage, page.look, root=f"/case{k}")
                drawing.move_to(((k - 0.5 * (len(films) - 1)) * pitch, 0.0, 0.0))
                page.fit(film.stage)
                drawing.shown = page.shown
                if len(films) > 1:
                    drawing.name(film.trace.case)
                self._drawings.append(drawing)
        largest = np.max(sizes, axis=0)
        page.camera.show(largest + np.array([pitch * (len(films) - 1), 0.0, 0.0]))
        self._histories = [film.history() for film in films]
        self._choose(0)

    def run(self, ended: Callable[[], bool]) -> None:
        """Draws while a page is open and something moves, until `ended`."""
        before = time.monotonic()
        while not ended():
            now = time.monotonic()
            pages = bool(self._server.get_clients())
            if pages:
                self.clock.advance(now - before)
                self.draw()
            before = now
            time.sleep(max(0.001, now + (FRAME_S if pages else IDLE_S) - time.monotonic()))

    def draw(self) -> None:
        """Draws the present time, if it is not drawn already."""
        t = self.clock.t
        shown = tuple(vars(self._page.shown).values())
        if (t, shown, self.clock.playing) == self._drawn:
            return
        self._drawn = (t, shown, self.clock.playing)
        with self._server.atomic():
            for film, drawing in zip(self._films, self._drawings, strict=True):
                drawing.draw(film.moment(min(t, film.end)), still=not self.clock.playing)
        now = time.monotonic()
        if not self.clock.playing or now - self._tabled >= TABLE_S:
            self._tabled = now
            self._tabulate(t)

    # ------------------------------------------------------------------ controls

    def _build_controls(self) -> None:
        gui, clock = self._server.gui, self.clock
        with gui.add_folder("Replay", order=5.0):
            self._slider: Any = gui.add_slider(
                "time [s]", min=round(clock.begin, 2), max=max(round(clock.end, 2), round(clock.begin, 2) + STEP_S),
                step=STEP_S, initial_value=round(clock.t, 2), marks=marks(self._films),
            )  # fmt: skip
            _add_transport(self._server, clock)
            if len(self._films) > 1:
                case = gui.add_dropdown("table of", tuple(film.trace.case for film in self._films))
                case.on_update(self._choose_case)
        self._slider.on_update(self._seek)

    def _seek(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:  # moved by a hand, not by the clock
            self.clock.playing = False
            self.clock.seek(float(event.target.value))

    def _choose_case(self, event: viser.GuiEvent[Any]) -> None:
        self._choose([film.trace.case for film in self._films].index(event.target.value))

    def _choose(self, number: int) -> None:
        """Shows table and plots of one case."""
        self._shown = number
        self._page.panel.set_stage(self._films[number].stage)
        self._drawn = None

    def _tabulate(self, t: float) -> None:
        film, history = self._films[self._shown], self._histories[self._shown]
        panel = self._page.panel
        trace = film.trace
        if abs(self._slider.value - t) > 0.5 * STEP_S:
            self._slider.value = round(t, 2)
        said = [event for event in trace.events if event.stamp <= t]
        phase = next((event.text for event in reversed(said) if event.kind == "phase"), "")
        panel.show_head(trace.case, phase, t, trace.plan.experiment.duration_s, self._where)
        at = min(t, film.end)
        panel.show_tables(film.rows(at), film.moment(at).error, said, 0.0)
        first, last = np.searchsorted(history.time, (t - HISTORY_S, t))
        first = min(int(first), int(last) - 2)
        if first >= 0:
            window = slice(first, int(last))
            for name in ("time", "error", "rate"):
                setattr(panel.history, name, getattr(history, name)[window])
            panel.show_plots()


def marks(films: Sequence[Film]) -> tuple[Any, ...]:
    """Events on the slider: phases of the first case with their words, incidents of all as points."""
    worded = [(event.stamp, event.text) for event in films[0].trace.events if event.kind == "phase"]
    begin, end = min(film.begin for film in films), max(film.end for film in films)
    found: dict[float, Any] = {}
    for film in films:
        for event in film.trace.events:
            if event.kind in ("hazard", "lost", "failed", "stop", "order", "contact") and begin <= event.stamp <= end:
                found[round(event.stamp, 1)] = round(event.stamp, 2)
    last = -inf
    for stamp, text in worded:
        if begin <= stamp <= end and stamp - last >= APART * (end - begin):  # words must not overlap
            last = stamp
            found[round(stamp, 1)] = (round(stamp, 2), text.removesuffix(" under way").removesuffix(" (interrupted)"))
    return tuple(found.values())
