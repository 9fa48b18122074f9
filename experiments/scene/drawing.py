"""Drawing of a scene with viser: a thin layer over `stage` and `models`. Robots of a kind are one batched mesh.

Nothing is sent that has not changed; callers wrap a round of `draw` in `server.atomic()`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from agents.network.messages import Ranges
from experiments.scene import models
from experiments.scene import stage as appearance
from experiments.scene.condition import RINGED, Colour
from experiments.scene.stage import NOWHERE, Colours, Moment, SceneModel, chassis
from twins.arrays import Array, Index, Mask

if TYPE_CHECKING:
    import viser

LABELS: Final = 24  # names of more robots are shown only where something is wrong, and of leaders and the worst
WORST: Final = 5  # number of robots with the largest errors that are named, where there are more
LABEL_ROUNDS: Final = (2, 3)  # names of few robots, and of more, move at each second and third round
GOAL_ROUNDS: Final = 3
TURNS: Final = 3  # digits of quaternions: a tenth of a degree, so that noise does not redraw bodies at rest
COARSE: Final = 5  # number of robots beyond which trails have each fifth point
PLACE_M: Final = 0.03  # half-size of the mark of a place that a robot says
SHADOWS: Final = 24  # shadows of more robots cost a browser without a graphics card too much


@dataclass(frozen=True)
class Look:
    """Colours of what is no robot, and of robots in a dark scene."""

    background: Colour
    grid: Colour
    section: Colour
    edge: Colour
    obstacle: Colour
    darkest: int = 0  # least value of a colour of a body


LIGHT: Final = Look((255, 255, 255), (226, 228, 232), (190, 193, 200), (90, 94, 102), (168, 172, 180))
DARK: Final = Look((20, 20, 20), (52, 54, 60), (95, 100, 110), (150, 155, 165), (105, 110, 120), darkest=110)


@dataclass
class VisibleParts:
    """Parts that are drawn on demand."""

    names: bool = True
    trails: bool = True
    goals: bool = True
    places: bool = True
    links: bool = True
    ranges: bool = False
    margins: bool = False


@dataclass
class _Kind:
    """Robots of one kind: their rows and their meshes."""

    rows: Index
    parts: list[Any]  # body, accent
    ghosts: Any
    shadows: Any | None
    shadow_rows: Index


def light(server: viser.ViserServer) -> None:
    """Even light without pictures of surroundings, which would cost a browser time and make colours pale."""
    server.scene.set_up_direction("+z")
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=True)
    server.scene.add_light_ambient("/light", intensity=1.1)


class SceneDrawing:
    """One case in a scene."""

    def __init__(self, server: viser.ViserServer, stage: SceneModel, look: Look, root: str = "/case") -> None:
        """Draws what does not move; `root` is the name of the node that carries everything, which `move_to` moves."""
        self._scene = server.scene
        self.stage, self._look, self._root = stage, look, root
        self.shown = VisibleParts()
        self._round = 0
        self._frame = self._scene.add_frame(root, show_axes=False)
        self._few = len(stage.names) <= LABELS
        self._add_arena()
        self._obstacles = [self._add_obstacle(number) for number in range(len(stage.scene.names))]
        self._kinds = [self._add_kind(name) for name in dict.fromkeys(kind.name for kind in stage.kinds)]
        rows, net = len(stage.names), len(stage.links)
        hidden = np.tile(np.array(NOWHERE), (max(net, 1), 2, 1))
        self._links = self._lines("links", hidden, thickness=2.0)
        self._lit = self._lines("lit", hidden, thickness=5.0)
        self._broken = self._lines("broken", hidden[:1], thickness=2.0)
        self._drops = self._lines("drops", np.tile(np.array(NOWHERE), (rows, 2, 1)), look.section, thickness=1.0)
        self._trails = self._ranges = self._margins = None
        ring = models.annulus(1.5, 2.1)
        self._rings = self._batch("rings", ring, rows, scales=stage.radius, cast=False)
        self._places: Any = None
        if count := len(stage.place_variables):
            colours = np.repeat(stage.colours, count, axis=0)
            self._places = self._batch("places", models.diamond(PLACE_M), rows * count, colours, cast=False)
        self._labels: dict[int, Any] = {}
        self._texts: dict[int, str] = {}

    def move_to(self, place: tuple[float, float, float]) -> None:
        """Puts the arena's middle there in the scene [m]."""
        self._frame.position = place

    def name(self, text: str) -> None:
        """Writes a name in front of the arena."""
        low = self.stage.scene.low
        place = (0.0, float(low[1]) - 0.12, 0.0)
        self._scene.add_label(f"{self._root}/name", text, position=place, anchor="top-center")

    def remove(self) -> None:
        self._frame.remove()

    # ------------------------------------------------------------------ what does not move

    def _add_arena(self) -> None:
        stage, look = self.stage, self._look
        x, y, _ = (stage.scene.high - stage.scene.low).tolist()
        step = 0.25 if max(x, y) <= 6.0 else 1.0
        self._scene.add_grid(
            f"{self._root}/floor", width=x, height=y, cell_size=step, section_size=4.0 * step, cell_color=look.grid,
            section_color=look.section, shadow_opacity=0.25 if self._few else 0.0, fade_distance=60.0,
        )  # fmt: skip
        corner = 0.5 * np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
        if stage.scene.walled:
            height = min(0.12, 0.05 * max(x, y))
            panels = [models.panel(a, b, 0.0, height) for a, b in zip(corner, np.roll(corner, -1, 0), strict=True)]
            self._mesh("border", models.joined(*panels), look.edge, opacity=0.35)
        else:
            ring = np.stack([corner, np.roll(corner, -1, 0)], axis=1)
            self._lines("border", np.concatenate([ring, np.zeros((4, 2, 1))], axis=2), look.edge, thickness=2.0)
        for name, start in ({} if stage.plan is None else stage.plan.experiment.arena.starts).items():
            half = 0.5 * np.array(start.size)
            ring = np.array(start.at) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            ends = np.stack([ring, np.roll(ring, -1, 0)], axis=1)
            self._lines(f"starts/{name}", np.concatenate([ends, np.full((4, 2, 1), 0.002)], axis=2), look.section)

    def _add_obstacle(self, number: int) -> Any:  # noqa: ANN401 - handles of viser
        scene = replace(self.stage.scene, top=self.stage.tops)
        opacity = 0.55 if np.isfinite(scene.mass[number]) else 0.85
        mesh = models.obstacle(scene, number)
        return self._mesh(f"obstacles/{scene.names[number]}", mesh, self._look.obstacle, opacity)

    def _add_kind(self, name: str) -> _Kind:
        stage = self.stage
        rows = np.array([row for row, kind in enumerate(stage.kinds) if kind.name == name], dtype=np.intp)
        model = models.model(stage.kinds[rows[0]])
        colours, place = stage.colours[rows], np.maximum(chassis(stage)[rows], self._look.darkest)
        parts = [
            self._batch(f"robots/{name}/body", model.body, len(rows), place),
            self._batch(f"robots/{name}/accent", model.accent, len(rows), colours),
        ]
        ghosts = self._batch(f"goals/{name}", model.whole, len(rows), colours, opacity=0.22, cast=False)
        beside = np.flatnonzero(stage.shadowed[rows])
        shadows = None
        if len(beside):
            shadows = self._batch(f"shadows/{name}", model.whole, len(beside), colours[beside], opacity=0.5, cast=False)
        return _Kind(rows, parts, ghosts, shadows, rows[beside])

    def _batch(
        self, name: str, mesh: models.Mesh, count: int, colours: Colours | None = None, *,
        opacity: float | None = None, scales: Array | None = None, cast: bool = True,
    ) -> Any:  # fmt: skip # noqa: ANN401
        """`count` copies of a mesh, out of sight."""
        return self._scene.add_batched_meshes_simple(
            f"{self._root}/{name}", mesh.vertices.astype(np.float32), mesh.faces,
            np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (count, 1)), np.tile(np.array(NOWHERE), (count, 1)),
            batched_scales=scales, batched_colors=_linear(np.full((count, 3), 128) if colours is None else colours),
            opacity=opacity, lod="auto", flat_shading=True, cast_shadow=cast and len(self.stage.names) <= SHADOWS,
            receive_shadow=False,
        )  # fmt: skip

    def _mesh(self, name: str, mesh: models.Mesh, colour: Colour, opacity: float | None = None) -> Any:  # noqa: ANN401
        return self._scene.add_mesh_simple(
            f"{self._root}/{name}", mesh.vertices.astype(np.float32), mesh.faces, color=colour, opacity=opacity,
            flat_shading=True, side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _lines(self, name: str, ends: Array, colours: Any = (140, 140, 140), thickness: float = 1.5) -> Any:  # noqa: ANN401
        colours = colours if np.ndim(colours) == 1 else _linear(colours)  # a single one is not taken for linear light
        points, place = ends.astype(np.float32), f"{self._root}/{name}"
        return self._scene.add_line_segments(place, points, colours, thickness=thickness, thickness_units="screen")

    # ------------------------------------------------------------------ what moves

    def draw(
        self, moment: Moment, *, trails: bool = True, still: bool = False, scans: Mapping[str, Ranges] | None = None
    ) -> None:
        """Draws a moment.

        Args:
            trails: Whether they have changed since the last one.
            still: Nothing follows soon: what is else drawn at some rounds only is drawn now.
            scans: Last range readings by robot.
        """
        self._round += 1
        self._draw_robots(moment, still=still)
        self._draw_links(moment)
        for handle, pose in zip(self._obstacles, moment.obstacles, strict=True):
            _update(handle, "position", np.array([pose[0], pose[1], 0.0]).round(4))
            _update(handle, "wxyz", appearance.quaternions(pose[2]).round(4))
        if trails:
            self._draw_trails(moment)
        if self._places is not None:
            _show(self._places, shown=self.shown.places and moment.places is not None)
            if moment.places is not None:
                _update(self._places, "batched_positions", appearance.shown(moment.places.reshape(-1, 3)))
        self._draw_margins(moment)
        self._draw_ranges(moment, scans or {})
        if still or self._round % LABEL_ROUNDS[not self._few] == 1:
            self._draw_labels(moment)

    def _draw_robots(self, moment: Moment, *, still: bool) -> None:
        place, turned = appearance.shown(moment.position), appearance.orientation(moment)
        goals = appearance.shown(moment.goal)
        accents = appearance.accents(self.stage, moment)
        for kind in self._kinds:
            rows = kind.rows
            for part in kind.parts:
                _update(part, "batched_positions", place[rows])
                _update(part, "batched_wxyzs", np.round(turned[rows], TURNS))
            _update(kind.parts[1], "batched_colors", accents[rows])
            _show(kind.ghosts, shown=self.shown.goals)
            if self.shown.goals and (still or self._round % GOAL_ROUNDS == 1):  # goals are decided at 10 Hz
                _update(kind.ghosts, "batched_positions", goals[rows])
                _update(kind.ghosts, "batched_wxyzs", np.round(turned[rows], TURNS))
            if kind.shadows is not None and moment.shadow is not None:
                kind.shadows.batched_positions = appearance.shown(moment.shadow[kind.shadow_rows])
                if moment.shadow_yaw is not None:
                    kind.shadows.batched_wxyzs = appearance.quaternions(moment.shadow_yaw[kind.shadow_rows])
        rings, colours = appearance.rings(moment)
        _show(self._rings, shown=bool((rings[:, 2] > NOWHERE[2]).any()))
        _update(self._rings, "batched_positions", rings)
        _update(self._rings, "batched_colors", colours)
        below = moment.position.copy()
        below[:, 2] = 0.0
        high = self.stage.flies & (moment.position[:, 2] > 0.05)
        _update(self._drops, "points", appearance.visible(np.stack([moment.position, below], axis=1), high))

    def _draw_links(self, moment: Moment) -> None:
        if not len(self.stage.links):
            return
        ends = appearance.segments(self.stage, moment.position)
        colours = appearance.link_colours(moment.error)
        both = np.repeat(colours[:, None], 2, axis=1)
        drawn = ~np.isnan(moment.error) & self.shown.links
        whole = drawn & ~moment.broken
        _update(self._links, "points", appearance.visible(ends, whole))
        _update(self._links, "colors", both)
        _update(self._lit, "points", appearance.visible(ends, whole & appearance.lit(self.stage, moment)))
        _update(self._lit, "colors", both)
        gaps = self.shown.links & moment.broken
        dashes = appearance.dashes(np.where(gaps[:, None, None], ends, np.nan))
        _update(self._broken, "points", dashes if len(dashes) else np.array([[NOWHERE, NOWHERE]]))

    def _draw_trails(self, moment: Moment) -> None:
        if self._trails is not None:
            _show(self._trails, shown=self.shown.trails)
        trail = moment.trail if self._few else moment.trail[:, ::COARSE]
        count = trail.shape[1]
        if count < 2 or not self.shown.trails:
            return
        ends = appearance.trail_segments(trail)
        if self._trails is None or self._trails.points.shape != ends.shape:
            colours = appearance.trail_colours(self.stage, count, self._look.background)
            self._trails = self._lines("trails", ends, colours, thickness=2.5)
        _update(self._trails, "points", ends)

    def _draw_margins(self, moment: Moment) -> None:
        if self.shown.margins and self._margins is None:
            outer, ring = self.stage.radius + max(self.stage.margin, 0.0), models.annulus(0.92, 1.0)
            self._margins = self._batch("margins", ring, len(outer), self.stage.colours, scales=outer, cast=False)
        if self._margins is not None:
            _show(self._margins, shown=self.shown.margins)
            _update(self._margins, "batched_positions", appearance.shown(moment.position))

    def _draw_ranges(self, moment: Moment, scans: Mapping[str, Ranges]) -> None:
        if not self.shown.ranges and self._ranges is None:
            return
        ends = appearance.rays(self.stage, moment, scans if self.shown.ranges else {})
        if self._ranges is None:
            self._ranges = self._lines("ranges", ends, (230, 80, 80), thickness=1.0)
        _update(self._ranges, "points", ends)

    def _draw_labels(self, moment: Moment) -> None:
        wanted: Mask = np.isfinite(moment.position).all(axis=1) & np.asarray(self.shown.names)
        if not self._few:
            leading = np.isin(np.array(self.stage.names), self.stage.leaders)
            worst = np.argsort(appearance.sums_of_errors(self.stage, moment.error))[-WORST:]
            notable = np.isin(moment.condition, RINGED) | leading
            notable[worst] = True
            wanted &= notable & (np.cumsum(wanted & notable) <= LABELS)
        for row in [row for row in self._labels if not wanted[row]]:
            self._labels.pop(row).remove()
        for row in np.flatnonzero(wanted).tolist():
            text = appearance.label(self.stage, row, int(moment.condition[row]))
            at = moment.position[row] + np.array([0.0, 0.0, self.stage.kinds[row].height + 0.05])
            handle = self._labels.get(row)
            if handle is None or self._texts[row] != text:
                if handle is not None:
                    handle.remove()
                self._texts[row] = text
                self._labels[row] = self._scene.add_label(
                    f"{self._root}/names/{row}", text, position=at, anchor="bottom-center", font_screen_scale=0.75
                )
            elif np.abs(handle.position - at).max() > 1e-4:
                handle.position = at


def _linear(colours: Colours | Array | Colour) -> Colours:
    """Colours as viser shows them unchanged: it takes those of lines and batches for linear light."""
    return np.asarray(np.round(255.0 * (np.asarray(colours) / 255.0) ** 2.2), dtype=np.uint8)


def _show(handle: Any, *, shown: bool) -> None:  # noqa: ANN401
    """Shows or hides a node: what is merely out of sight costs a browser nearly as much as what is seen."""
    if handle.visible != shown:
        handle.visible = shown


def _update(handle: Any, name: str, value: Array | Colours) -> None:  # noqa: ANN401
    """Sends an array if it differs from what was sent last."""
    last = getattr(handle, name)
    if name in ("colors", "batched_colors"):
        value = _linear(value.astype(np.uint8))
    value = value.astype(last.dtype)
    if last.shape != value.shape or not np.array_equal(last, value):
        setattr(handle, name, value)
