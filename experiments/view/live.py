"""Live view of a run: a page on loopback that draws what an observer of the network learns, and gives orders.

Runs in a process of its own: a slow browser, or a view that dies, touches no robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zenoh

from agents.network.keys import Keys
from agents.network.session import connected
from experiments.scene.drawing import DARK, LIGHT, Look, SceneDrawing, Shown, light
from experiments.scene.stage import MANY, Condition, LinkTracker, Moment, Stage
from experiments.view.acting import Acting, Watched
from experiments.view.observer import Observer, RobotReport
from experiments.view.panel import PLOT_S, Panel, Row, known

if TYPE_CHECKING:
    import viser


FRAME_S: Final = 1.0 / 30.0
IDLE_S: Final = 0.2  # between two rounds while no page is open
TABLE_S: Final = 0.5
LOOPBACK: Final = "127.0.0.1"
FARTHEST: Final = 2.2  # times as far as on a wide page


def open_server(port: int, title: str, *, dark: bool) -> viser.ViserServer:
    """A page that is reached from this machine alone, without a button that would share it.

    Args:
        port: Preferred; the next free one is taken if it is not free.
        title: Of the page.
        dark: Dark colours.
    """
    import viser  # noqa: PLC0415 - an extra

    with redirect_stdout(StringIO()):  # its own banner
        server = viser.ViserServer(host=LOOPBACK, port=port, label=title, verbose=False)
    server.gui.configure_theme(
        dark_mode=dark,
        show_logo=False,
        show_share_button=False,
        control_width="large",
        brand_color=(0, 114, 178),
    )
    server.gui.main_panel.dock_right()
    server.on_client_connect(partial(_step_back, server))
    light(server)
    return server


def look_at(server: viser.ViserServer, size: Sequence[float], *, centre: Sequence[float] = (0.0, 0.0)) -> None:
    """Camera of pages that are opened from now on, and of those that are open: the whole of `size` x, y, z [m]."""
    x, y = centre[0], centre[1]
    reach = max(size[0], size[1])
    place, at = (x - 0.45 * reach, y - 0.9 * reach, 0.68 * reach), (x, y, 0.14 * reach)
    server.initial_camera.position, server.initial_camera.look_at = place, at
    for client in server.get_clients().values():
        client.camera.position, client.camera.look_at = place, at


def _step_back(server: viser.ViserServer, client: viser.ClientHandle) -> None:
    """A page that is higher than wide, as a phone's, sees the arena from farther away, above the panel."""
    if (aspect := client.camera.aspect) < 1.0:
        at = np.array(server.initial_camera.look_at)
        away = (np.array(server.initial_camera.position) - at) * min(1.0 / aspect, FARTHEST)
        at[2] -= 0.30 * float(np.linalg.norm(away))
        client.camera.position, client.camera.look_at = at + away, at


def close_server(server: viser.ViserServer) -> None:
    """Ends the page."""
    with redirect_stdout(StringIO()):
        server.stop()


class ShowFolder:
    """Check boxes for parts that are drawn on demand."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self.shown = server, Shown()
        self._boxes: dict[str, Any] = {}
        with server.gui.add_folder("Show", order=50.0, expand_by_default=False):
            for name, text in (
                ("names", "names"), ("trails", "trails"), ("goals", "goals"), ("links", "links"),
                ("ranges", "range readings"), ("margins", "avoidance margins"),
            ):  # fmt: skip
                box = server.gui.add_checkbox(text, getattr(self.shown, name))
                box.on_update(partial(self._set, name))
                self._boxes[name] = box

    def fit(self, stage: Stage) -> None:
        """Goals of many robots are not drawn until they are asked for."""
        if len(stage.names) > MANY:
            self._boxes["goals"].value = self.shown.goals = False

    def draw_anew(self, former: SceneDrawing | None, stage: Stage, look: Look, panel: Panel) -> SceneDrawing:
        """Drawing of a case in place of the one before, with its panel, and the camera on its arena."""
        with self._server.atomic():
            if former is not None:
                former.remove()
            drawing = SceneDrawing(self._server, stage, look)
            self.fit(stage)
            drawing.shown = self.shown
            panel.set_stage(stage)
            look_at(self._server, (stage.scene.high - stage.scene.low).tolist())
        return drawing

    def _set(self, name: str, event: viser.GuiEvent[Any]) -> None:
        setattr(self.shown, name, event.target.value)


class LiveView:
    """The page of one realm."""

    def __init__(
        self, server: viser.ViserServer, session: zenoh.Session, watched: Watched, *, dark: bool, acting: Acting | None
    ) -> None:
        """Draws an empty page.

        Args:
            server: From `open_server`.
            session: On the network of the run.
            watched: The run.
            dark: Dark colours.
            acting: Orders of the page; None for an observer, which sees no buttons.
        """
        self._server, self._session, self._watched, self._acting = server, session, watched, acting
        self._look = DARK if dark else LIGHT
        self.observer = Observer(session, Keys(watched.realm))
        self._panel = Panel(server)
        self._show = ShowFolder(server)
        self._drawing: SceneDrawing | None = None
        self._tabled = self._plotted = 0.0
        self._trailed: object = None
        self._errors = LinkTracker(self.observer.stage)
        if acting is not None:
            acting.build(server)

    def run(self, ended: Callable[[], bool]) -> None:
        """Draws at 30 Hz while a page is open, until `ended`."""
        due = time.monotonic()
        while not ended():
            begun = time.monotonic()
            pages = bool(self._server.get_clients())
            changed = self.observer.update()
            if changed or self._drawing is None:
                self._begin()
            if pages:
                self.draw(begun)
            due = max(due + (FRAME_S if pages else IDLE_S), begun)
            time.sleep(max(0.001, due - time.monotonic()))

    def _begin(self) -> None:
        """Another case."""
        stage = self.observer.stage
        self._drawing = self._show.draw_anew(self._drawing, stage, self._look, self._panel)
        self._errors = LinkTracker(stage)
        if self._acting is not None:
            self._acting.set_stage(stage)

    def draw(self, now: float) -> None:
        """Draws what is known now [s, monotonic]."""
        assert self._drawing is not None
        observer, moment = self.observer, self.observer.moment()
        observer.watch_ranges(wanted=self._show.shown.ranges)
        moved, self._trailed = moment.trail is not self._trailed, moment.trail
        with self._server.atomic():
            self._drawing.draw(moment, trails=moved, scans=observer.scans)
        if self._acting is not None:
            self._acting.follow(moment, [name for name, report in observer.robots.items() if report.alive])
        if now - self._plotted >= PLOT_S:
            self._plotted = now
            self._plot(now, moment)
        if now - self._tabled >= TABLE_S:
            self._tabled = now
            self._tabulate(moment)

    def _plot(self, now: float, moment: Moment) -> None:
        rates = np.array([self.observer.robots[name].rate for name in self.observer.stage.names])
        self._panel.history.add(now, self._errors.of_robots(moment.error), rates)
        self._panel.show_plots()

    def _tabulate(self, moment: Moment) -> None:
        observer, stage = self.observer, self.observer.stage
        errors = self._errors.of_robots(moment.error)
        rows = [
            _row(name, observer.robots[name], Condition(int(moment.condition[k])), known(errors[k]))
            for k, name in enumerate(stage.names)
        ]
        elapsed = observer.elapsed
        start = None if elapsed is None else time.time() - elapsed
        phase = observer.phase
        if not connected(self._session):
            phase = "no router answers"
        elif not phase:
            phase = "waiting for robots" if not stage.names else "not started"
        duration = stage.experiment.duration_s if stage.experiment is not None else 0.0
        self._panel.show_head(observer.case, phase, elapsed, duration, self._watched.words)
        self._panel.show_robots(rows)
        net, names = stage.links, stage.names
        ends = zip(net.receiver.tolist(), net.sender.tolist(), strict=True)
        self._panel.show_links(moment.error, [observer.robots[names[i]].delay.get(names[j]) for i, j in ends])
        self._panel.show_events(list(observer.events), start)


def _row(name: str, report: RobotReport, condition: Condition, error: float | None) -> Row:
    status = report.status
    if status is None:
        return Row(name, condition)
    note = status.hazard or (status.reason if condition > Condition.DONE else "")
    if not note and status.missing:
        note = "misses " + ", ".join(status.missing)
    delay = max(report.delay.values(), default=None)
    return Row(name, condition, error, report.rate, status.battery, status.missed, delay, note)
