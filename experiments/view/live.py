"""Live view of a run: a page on loopback that draws what an observer of the network learns, and gives orders.

Runs in a process of its own: a slow browser, or a view that dies, touches no robot.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from math import inf
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zenoh

from agents.network.keys import Keys
from agents.network.session import connected
from experiments.scene.drawing import DARK, LIGHT, SceneDrawing, VisibleParts
from experiments.scene.stage import MANY_GOALS, LinkTracker, Moment, SceneModel
from experiments.view import heartbeat
from experiments.view.acting import Acting, WatchedRun
from experiments.view.observer import Observer
from experiments.view.panel import PLOT_S, Panel, robot_rows
from twins.arrays import Array, norm

if TYPE_CHECKING:
    import viser

    from experiments.view.serving import PageServer

FRAME_S: Final = 1.0 / 25.0
FAREWELL_S: Final = 0.5  # time until the last words have reached the pages
IDLE_S: Final = 0.2  # pause of two rounds while no page is open
TABLE_S: Final = 0.5
FOV: Final = 0.8  # [rad] upright
ASPECT: Final = 1.2  # width over height of a page that is not known
FROM: Final = np.array([-0.40, -0.77, 0.50])  # direction of the camera, as seen from the arena
FREE: Final = np.array([-0.92, 0.92])  # share of a page from its middle to its edges, where the arena is shown
PHONE: Final = 0.7  # width over height of a page with its panel below, not beside
ABOVE: Final = np.array([0.24, 0.96])  # the same as `FREE`, upwards, of such a page


def standpoint(size: Sequence[float] | Array, aspect: float) -> tuple[Array, Array]:
    """Place of a camera and the point that it looks at [m], so that a box on the floor fills the page.

    Args:
        size: Of the box, x, y, z [m], with its middle above the origin.
        aspect: Width of the page over its height.
    """
    away = FROM / norm(FROM)
    right = np.array([-away[1], away[0], 0.0]) / norm(away[:2])
    corners = np.array(list(product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)))) * size
    near, reach = corners @ away, np.tan(0.5 * FOV)
    sides = ((right, aspect * reach * FREE), (np.cross(away, right), reach * (ABOVE if aspect < PHONE else FREE)))
    distance = max(
        ((corners @ side + high * near).max() - (corners @ side + low * near).min()) / (high - low)
        for side, (low, high) in sides
    )
    at = np.zeros(3)
    for side, (low, high) in sides:
        beyond = (corners @ side - high * (distance - near)).max(), (corners @ side - low * (distance - near)).min()
        at += 0.5 * sum(beyond) * side
    return at + distance * away, at


class Camera:
    """Camera of each page: at first the whole arena is in sight, whatever the shape of the page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._size: Array = np.ones(3)  # [m]
        self._placed: dict[int, Array] = {}  # [m] place by page
        server.initial_camera.fov = FOV
        server.on_client_connect(self._add_client)

    def show(self, size: Array) -> None:
        """Another arena, with all that stands in it (3,) [m]."""
        self._size, initial = size, self._server.initial_camera
        initial.position, initial.look_at = standpoint(size, ASPECT)
        for client in self._server.get_clients().values():
            self._place(client)

    def _add_client(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._follow(client))
        self._place(client)

    def _follow(self, client: viser.ClientHandle) -> None:
        """Fits a camera that no hand has moved: a page sets its own when it opens, and its shape changes then."""
        known = (self._server.initial_camera.position, self._placed.get(client.client_id))
        if any(each is not None and np.allclose(client.camera.position, each, atol=1e-3) for each in known):
            self._place(client)

    def _place(self, client: viser.ClientHandle) -> None:
        aspect = client.camera.aspect
        place, at = standpoint(self._size, aspect if 0.0 < aspect < inf else ASPECT)  # a hidden page has no shape
        self._placed[client.client_id] = place
        client.camera.position, client.camera.look_at = place, at


class Page:
    """A page: panel, camera, check boxes for parts that are drawn on demand, and the drawing of one case."""

    drawing: SceneDrawing

    def __init__(self, server: viser.ViserServer, *, dark: bool) -> None:
        self._server, self.look = server, DARK if dark else LIGHT
        self.panel, self.shown = Panel(server), VisibleParts()
        self.camera = Camera(server)
        self._plotted = self._tabled = -inf
        self._boxes: dict[str, Any] = {}
        with server.gui.add_folder("Show", order=50.0, expand_by_default=False):
            for name, text in (
                ("names", "names"), ("trails", "trails"), ("goals", "goals"), ("places", "said places"),
                ("links", "links"), ("ranges", "range readings"), ("margins", "avoidance margins"),
            ):  # fmt: skip
                box = server.gui.add_checkbox(text, getattr(self.shown, name))
                box.on_update(partial(self._set, name))
                self._boxes[name] = box

    def fit(self, stage: SceneModel) -> None:
        """Goals of many robots are not drawn until they are asked for."""
        if len(stage.names) > MANY_GOALS:
            self._boxes["goals"].value = self.shown.goals = False

    def begin(self, stage: SceneModel) -> None:
        """Another case: its drawing in place of the one before, its panel, and the camera on its arena."""
        with self._server.atomic():
            if hasattr(self, "drawing"):
                self.drawing.remove()
            self.drawing = SceneDrawing(self._server, stage, self.look)
            self.fit(stage)
            self.drawing.shown = self.shown
            self.panel.set_stage(stage)
            self.camera.show(stage.size)
        self._plotted = self._tabled = -inf

    def refresh(self, now: float, plot: Callable[[], object], tabulate: Callable[[], object]) -> None:
        """Plots and tables at `now` [s, monotonic], if they are due."""
        if now - self._plotted >= PLOT_S:
            self._plotted = now
            plot()
        if now - self._tabled >= TABLE_S:
            self._tabled = now
            tabulate()

    def _set(self, name: str, event: viser.GuiEvent[Any]) -> None:
        setattr(self.shown, name, event.target.value)


class LiveView:
    """The page of one realm."""

    def __init__(
        self, server: PageServer, session: zenoh.Session, watched: WatchedRun, *, dark: bool, acting: Acting | None
    ) -> None:
        """Draws an empty page; without `acting` that of an observer, which sees no buttons."""
        self._server, self._session, self._watched, self._acting = server, session, watched, acting
        self.observer = Observer(session, Keys(watched.realm))
        self._mark = server.gui.add_html("", order=-1.0)
        self._page = Page(server, dark=dark)
        self._trailed: object = None
        self._stages, self._failure, self._over = 0, "", False
        self._elapsed: float | None = None  # [s] time since the common start; stands still with the last picture
        if acting is not None:
            acting.build(server)
        self._begin()

    def run(self, ended: Callable[[], bool]) -> None:
        """Draws while a page is open, until `ended`."""
        while not ended():
            begun = time.monotonic()
            pages = bool(self._server.get_clients())
            self._follow(begun, pages=pages)
            period = heartbeat.frame_s(self._server.gate.lag(time.time()), FRAME_S) if pages else IDLE_S
            time.sleep(max(0.001, begun + period - time.monotonic()))

    def _follow(self, now: float, *, pages: bool) -> None:
        """Draws what is new; a picture that fails leaves the page and its emergency stop."""
        try:
            if self.observer.update():
                self._begin()
            if pages:
                self.draw(now)
            self._failure = ""
        except Exception as error:  # noqa: BLE001 - of any kind: the stop stays in reach
            words = f"the picture fails: {type(error).__name__}: {error}"
            if words != self._failure:
                self._failure = words
                print(f"{words}; the emergency stop of the page works on", file=sys.stderr, flush=True)
            self._mark.content = heartbeat.mark(self._stages, time.time(), None, words)

    def close(self, words: str) -> None:
        """Tells open pages, in words, why they get no more pictures."""
        if self._server.get_clients():
            self._mark.content = heartbeat.mark(self._stages, time.time(), 0.0, words, over=True)
            self._server.flush()
            time.sleep(FAREWELL_S)

    def _begin(self) -> None:
        """Another case."""
        stage = self.observer.stage
        self._stages += 1
        self._page.begin(stage)
        self._errors = LinkTracker(stage)
        if self._acting is not None:
            self._acting.set_stage(stage, self._stages)

    def draw(self, now: float) -> None:
        """Draws what is known now [s, monotonic]."""
        observer, page = self.observer, self._page
        moment = self.observer.moment()
        observer.watch_ranges(wanted=page.shown.ranges)
        moved, self._trailed = moment.trail is not self._trailed, moment.trail
        with self._server.atomic():
            page.drawing.draw(moment, trails=moved, scans=observer.scans)
        if self._acting is not None:
            alive = [name for name, report in observer.robots.items() if report.alive]
            self._acting.follow(moment, alive, ended=observer.ended)
        page.refresh(now, partial(self._plot, now, moment), partial(self._tabulate, moment))

    def _plot(self, now: float, moment: Moment) -> None:
        rates = np.array([self.observer.robots[name].rate for name in self.observer.stage.names])
        panel = self._page.panel
        panel.history.add(now, self._errors.of_robots(moment.error), rates)
        panel.show_plots()
        utc, observer = time.time(), self.observer
        age = observer.age.seconds(utc, now)
        words = "of a recording" if observer.age.recorded else "" if age is not None else "no pose of a robot yet"
        run, here = self._watched.run, any(report.alive for report in observer.robots.values())
        linked = connected(self._session)
        ended = self._watched.over or (observer.ended if not linked else run is None and not here)
        self._over = ended and age is not None
        if self._over:
            words = f"the run is over, {age:.0f} s ago; robots may have come down or moved since"
        self._mark.content = heartbeat.mark(self._stages, utc, age, words, over=self._over)

    def _tabulate(self, moment: Moment) -> None:
        observer = self.observer
        stage, panel = self.observer.stage, self._page.panel
        reports = [observer.robots[name] for name in stage.names]
        rows = robot_rows(
            stage.names, moment, [each.status for each in reports], self._errors.of_robots(moment.error),
            [each.rate for each in reports], delay=[max(each.delay.values(), default=None) for each in reports],
        )  # fmt: skip
        if self._elapsed is None or not (self._over or observer.ended):
            self._elapsed = observer.elapsed
        phase = observer.phase
        if not connected(self._session):
            phase = "no router answers"
        elif not phase:
            phase = "waiting for robots" if not stage.names else "not started"
        where = self._watched.words.removeprefix(f"{stage.title}, ")
        duration = stage.plan.experiment.duration_s if stage.plan is not None else 0.0
        panel.show_head(observer.case, phase, self._elapsed, duration, where)
        net, names = stage.links, stage.names
        ends = zip(net.receiver.tolist(), net.sender.tolist(), strict=True)
        delays = [observer.robots[names[i]].delay.get(names[j]) for i, j in ends]
        panel.show_tables(rows, moment.error, list(observer.events), observer.started, delays)
