"""Realisation and rigidity of a formation, without motion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, takewhile
from typing import Final, NamedTuple

import msgspec
import numpy as np

from agents.body.kinds import Kind
from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_RELATIVE
from agents.plugins.law import Law
from agents.plugins.laws import Mixed
from experiments.definition.formation import Anchored, anchor_errors, law_errors
from experiments.definition.graph import Links, adjacency, edges, part_of_rows
from experiments.definition.links import TARGET_KINDS
from experiments.definition.rigidity import CERTAIN, Bend, Redundancy, Rigidity, bend, redundancy, rigidity
from twins.arrays import Array, Index, Mask, norm

TINY: Final = 1e-18  # [m²] no length is zero
EXACT: Final = 1e-9  # [m] link errors below this are arithmetic
ENOUGH: Final = 3e-4  # [m] distances written with four decimals are met as well as can be; a better shape is not sought
SLOWLY: Final = 1e-2  # share of the rest: smaller improvements of a small error are not worth their time
OFF: Final = 1e-3  # [m] a shape that misses by more misses by more than written digits explain
ROUNDED: Final = 1e-3  # [m] distances written with three decimals contradict one another by less
DENSE: Final = 400  # unknowns up to which a matrix is solved: its time grows with the third power
CLOSE: Final = 1e-2  # rest of a step by conjugate gradients, as a share: the next step sees to it
MIRRORS: Final = 3  # robots on the wrong side that are sought
MOST_MIRRORED: Final = 40  # robots of a formation in which they are sought: the time grows with the third power
MOST_SIDES: Final = 4  # neighbours of a robot through which the lines are sought
TRIES: Final = 20  # fits of places to bearings
STRICT: Final = 10.0  # weight of what is aside of a bearing
ASKEW: Final = 0.1  # [rad] bearings written with two digits contradict one another by less
POINT: Final = 1e-6  # [m] robots that are nearer than this to each other stand in one point, which nothing turns


class Residuals(NamedTuple):
    """Equations (M) of links and anchors."""

    value: Array  # (M,) how far each is off [m]
    tail: Index  # (M,) row i
    head: Index  # (M,) row j, −1 for anchors
    slope: Array  # (M, 3) derivative of the value by the place of row i; that by row j is its negative

    def normal(self, rows: Index, count: int, axes: int) -> tuple[Array, Array]:
        """JᵀJ (axes·R, axes·R) and Jᵀ value (axes·R,) of the Jacobian J, which need not be made: it is nearly empty."""
        column = np.full(count + 1, -1)
        column[rows] = np.arange(len(rows))
        square = np.zeros((len(rows), len(rows), axes, axes))
        slope, own = np.zeros((len(rows), axes)), self.slope[:, :axes]
        outer = own[:, :, None] * own[:, None, :]
        ends = ((column[self.tail], 1.0), (column[self.head], -1.0))
        for one, sign in ends:
            moves = one >= 0
            np.add.at(slope, one[moves], sign * (self.value[:, None] * own)[moves])
            for other, against in ends:
                both = moves & (other >= 0)
                np.add.at(square, (one[both], other[both]), sign * against * outer[both])
        size = axes * len(rows)
        return square.transpose(0, 2, 1, 3).reshape(size, size), slope.ravel()

    def descent(self, free: Mask, damping: float) -> Array:
        """Step x (N, 3) [m] of the coordinates that are `free`, with (JᵀJ + damping) x = −Jᵀ value, about.

        By conjugate gradients, the diagonal as preconditioner: the Jacobian J is nearly empty, and JᵀJ is never made
        (M. R. Hestenes, E. Stiefel, Journal of Research of the National Bureau of Standards 49(6), 1952).
        """
        ends = np.stack([self.tail, np.maximum(self.head, 0)], axis=1)
        at = (3 * ends[:, :, None] + np.arange(3)).reshape(-1, 6)
        slope = np.hstack([self.slope, np.where(self.head[:, None] < 0, 0.0, -self.slope)])
        count = free.size
        fixed = ~free.ravel()

        def gathered(values: Array) -> Array:
            found = np.bincount(at.ravel(), values.ravel(), count).astype(float, copy=False)
            found[fixed] = 0.0
            return found

        rest = -gathered(slope * self.value[:, None])
        step, diagonal = np.zeros(count), gathered(slope**2) + damping
        along = rest / diagonal
        power = float(rest @ along)
        enough = CLOSE * CLOSE * power
        for _ in range(count):
            if not power > enough:
                break
            image = gathered(slope * np.vecdot(slope, along[at])[:, None]) + damping * along
            share = power / float(along @ image)
            step, rest = step + share * along, rest - share * image
            last, power = power, float(rest @ (rest / diagonal))
            along = rest / diagonal + power / last * along
        return step.reshape(-1, 3)


def targets_of_law(law: Law, links: Links) -> Links:
    """Links with the targets that the law reads: `distance` reads the distance of a relative position as well."""
    wants = TARGET_KINDS[law.NEEDS].wants
    if wants is None or links.wants is None:
        return links
    return msgspec.structs.replace(links, wants=None if wants == BY_DISTANCE else np.full(len(links), wants))


def residuals(links: Links, anchors: Anchored, position: Array) -> Residuals:
    """The equations at `position` (N, 3) [m]; of links as `targets_of_law` gives them."""
    apart = position[links.receiver] - position[links.sender]
    wants = np.full(len(links), BY_DISTANCE) if links.wants is None else links.wants
    parts = [_of_lengths(apart, links, np.flatnonzero(wants == BY_DISTANCE))]
    if links.relative is not None and links.bearing is not None:
        at = np.flatnonzero(wants == BY_RELATIVE)
        unit = np.broadcast_to(np.eye(3), (len(at), 3, 3))
        parts.append(_of_vectors(apart[at] - links.relative[at], unit, links, at))
        at = np.flatnonzero(wants == BY_BEARING)
        parts.append(_of_vectors(*_from_ray(apart[at], links.bearing[at]), links, at))
    if anchors:
        parts.append(_of_anchors(anchors, position))
    return Residuals(*map(np.concatenate, zip(*parts, strict=True)))


def _of_lengths(apart: Array, links: Links, at: Index) -> Residuals:
    length = np.sqrt(np.einsum("ek,ek->e", apart[at], apart[at]) + TINY)
    return Residuals(length - links.distance[at], links.receiver[at], links.sender[at], apart[at] / length[:, None])


def _of_vectors(value: Array, slope: Array, links: Links, at: Index) -> Residuals:
    """Three equations of each link: its vector (K, 3) and the derivative of that (K, 3, 3)."""
    tail, head = np.repeat(links.receiver[at], 3), np.repeat(links.sender[at], 3)
    return Residuals(value.reshape(-1), tail, head, slope.reshape(-1, 3))


def _from_ray(apart: Array, bearing: Array) -> tuple[Array, Array]:
    """Vector from the ray along each bearing to x, as in the law `bearing`, and its derivative."""
    flat = np.isnan(bearing[:, 2])
    bearing, apart = bearing.copy(), apart.copy()
    bearing[flat, 2] = apart[flat, 2] = 0.0
    along = np.vecdot(apart, bearing)
    ahead = (along > 0.0)[:, None, None]
    value = apart - np.maximum(along, 0.0)[:, None] * bearing
    return value, np.eye(3) - np.where(ahead, bearing[:, :, None] * bearing[:, None, :], 0.0)


def _of_anchors(anchors: Anchored, position: Array) -> Residuals:
    row = np.array([number for number, _ in anchors], dtype=np.intp)
    distance = np.array([each.distance for _, each in anchors])
    away = np.array([each.displacement(tuple(position[number].tolist())) for number, each in anchors])
    matrix = np.array([each.whole * np.eye(3) + each.along * np.outer(each.axis, each.axis) for _, each in anchors])
    ring = np.flatnonzero(distance > 0.0)
    length = np.sqrt(norm(away[ring]) ** 2 + TINY)
    direction = np.einsum("ak,akl->al", away[ring] / length[:, None], matrix[ring])
    on = np.flatnonzero(distance == 0.0)
    value = np.concatenate([length - distance[ring], away[on].reshape(-1)])
    tail = np.concatenate([row[ring], np.repeat(row[on], 3)])
    return Residuals(value, tail, np.full(len(tail), -1), np.concatenate([direction, matrix[on].reshape(-1, 3)]))


@dataclass(frozen=True)
class Solids:
    """Upright cylinders that stand for the N robots of a shape."""

    radius: Array  # (N,) [m]
    height: Array  # (N,) above the position of a robot [m]
    part: Index  # (N,) of the network; places of robots in different parts say nothing about each other
    free: Mask  # (N,) rows that a shape places; the others stay where they are
    clearance: float = 0.0  # free height that robots above one another need [m]

    @classmethod
    def of(cls, kinds: Sequence[Kind], links: Links, free: Mask, clearance: float = 0.0) -> Solids:
        """Solids of robots with these links."""
        radius, height = np.array([kind.radius for kind in kinds]), np.array([kind.height for kind in kinds])
        return cls(radius, height, part_of_rows(links, len(kinds)), free, clearance)

    def overlaps(self, position: Array) -> Index:
        """Pairs (K, 2) of rows that are in each other's way at `position` (N, 3) [m], the nearest first."""
        found: list[tuple[float, int, int]] = []
        for i in range(len(position) - 1):
            apart, top = position[i + 1 :] - position[i], self.height[i + 1 :]
            near = norm(apart[:, :2]) < self.radius[i] + self.radius[i + 1 :]
            near &= np.maximum(apart[:, 2] - self.height[i], -apart[:, 2] - top) < self.clearance
            near &= (self.part[i + 1 :] == self.part[i]) & (self.free[i + 1 :] | self.free[i])
            found += [(float(norm(apart[k])), i, i + 1 + int(k)) for k in np.flatnonzero(near)]
        return np.array([pair for _, *pair in sorted(found)], dtype=np.intp).reshape(-1, 2)


@dataclass(frozen=True)
class Shape:
    """A place for every robot that meets the distances as well as they can be met."""

    position: Array  # (N, 3) [m]
    error: Array  # (E,) of each link as its law measures it, |‖p_i − p_j‖ − d_ij| for distances [m]
    anchored: Array = field(default_factory=lambda: np.zeros(0))  # (A,) of each anchor [m]
    overlaps: Index = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))  # (K, 2) see `Solids`

    @property
    def worst(self) -> float:
        """The largest error of a link or an anchor [m]."""
        return max(float(self.error.max(initial=0.0)), float(self.anchored.max(initial=0.0)))

    @property
    def good(self) -> bool:
        """Whether a better one need not be sought."""
        return self.worst < ENOUGH and not len(self.overlaps)


def find_shapes(
    links: Links,
    guesses: Iterable[Array],
    moves: Mask,
    anchors: Anchored = (),
    climbs: Mask | None = None,
    *,
    solids: Solids | None = None,
) -> list[Shape]:
    """Shapes that meet the targets of links and anchors, one for each guess, until one is good.

    Args:
        links: With their targets, see `targets_of_law`.
        guesses: (N, 3) each [m].
        moves: (N,) rows that may be placed elsewhere in the plane.
        climbs: (N,) rows with free heights as well; the others keep theirs.
        solids: Robots that must not overlap.

    Returns:
        The shapes that were found, in the order of the guesses; only the last one may be good.
    """
    found, free = list[Shape](), _free(moves, climbs)
    for guess in guesses:
        shape = fitted_shape(links, anchors, guess, free)
        if solids is not None and shape.worst <= OFF:  # does not matter for other shapes
            shape = replace(shape, overlaps=solids.overlaps(shape.position))
        found.append(shape)
        if shape.good:
            break
    return found


def _free(moves: Mask, climbs: Mask | None = None) -> Mask:
    """Coordinates (N, 3) that may change."""
    return np.column_stack([moves, moves, np.zeros_like(moves) if climbs is None else climbs])


def best_shape(shapes: Sequence[Shape]) -> Shape:
    """The shape that misses least; of those that meet all targets one in which the fewest robots are in the way."""
    return min(shapes, key=lambda each: (each.worst > OFF, len(each.overlaps), each.worst))


def unfold_distances(links: Links, height: Array) -> Array:
    """A first guess (N, 3) [m] at the shape: the two main axes of the distances through the network.

    Torgerson's scaling, with shortest ways through the network for the distances that no link gives; robots in
    different parts of it are put as far apart as the longest way.
    """
    rows = len(height)
    way = np.full((rows, rows), np.inf)
    rise = height[links.receiver] - height[links.sender]
    far = np.sqrt(np.maximum(links.distance**2 - rise**2, 0.0))
    way[links.receiver, links.sender] = np.where(np.isnan(far), 1.0, far)  # any length suits a direction
    way = np.minimum(way, way.T)
    np.fill_diagonal(way, 0.0)
    for over in range(rows):
        way = np.minimum(way, way[:, over, None] + way[None, over, :])
    way[~np.isfinite(way)] = way[np.isfinite(way)].max()
    way = np.minimum(way, 1e6)  # its square must be a number
    centring = np.eye(rows) - 1.0 / rows
    values, axes = np.linalg.eigh(-0.5 * centring @ way**2 @ centring)
    plane = axes[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    return np.column_stack([np.zeros((rows, 2 - plane.shape[1])), plane, height])


@np.errstate(over="ignore", invalid="ignore")  # too far a step is no better, in spite of its result
def fitted_shape(links: Links, anchors: Anchored, guess: Array, free: Mask) -> Shape:
    """Least squares of the residuals from a guess (N, 3) [m], by Levenberg's and Marquardt's method.

    `free` (N, 3) are the coordinates that may change.
    """
    axes = 3 if free[:, 2].any() else 2
    rows = np.flatnonzero(free.any(axis=1))
    own = free[rows, :axes].ravel()
    position, damping = guess.copy(), 1e-3
    now = residuals(links, anchors, position)
    for _ in range(200):
        tried = position.copy()
        if free.sum() > DENSE:
            tried += now.descent(free, damping)
        else:
            normal, slope = now.normal(rows, len(guess), axes)
            step = np.zeros(len(slope))
            step[own] = np.linalg.solve(normal[np.ix_(own, own)] + damping * np.eye(int(own.sum())), -slope[own])
            tried[rows, :axes] += step.reshape(-1, axes)
        then = residuals(links, anchors, tried)
        before, after = float(now.value @ now.value), float(then.value @ then.value)
        if after < before:
            position, damping = tried, max(damping / 10.0, 1e-10)
            now = then
        else:
            damping *= 10.0
        small = float(np.abs(now.value).max(initial=0.0)) < ENOUGH
        least = SLOWLY * before if small else 1e-9 * before
        if damping > 1e9 or before < (EXACT / 100) ** 2 or 0.0 <= before - after < least:
            break
    error = law_errors(Mixed(), position, position[links.sender], links)
    return Shape(position, error, anchor_errors(anchors, position[None])[0])


class MirrorImage(NamedTuple):
    """Robot on the wrong side of the line through two of its neighbours."""

    row: int
    ends: tuple[int, int]  # those neighbours
    place: Array  # (3,) on the right side [m]


def mirrored_robots(links: Links, end: Array, moves: Mask, anchors: Anchored = ()) -> list[MirrorImage]:
    """Robots that have to change sides, at most `MIRRORS`, for the formation to get from `end` (N, 3) to its shape.

    One after the other that one is mirrored that leads to the shape, or nearest to it, with the least motion of all.
    Empty if that does not end in the shape, and for formations of more than `MOST_MIRRORED` robots.
    """
    if len(end) > MOST_MIRRORED:
        return []
    free, pairs = _free(moves), edges(links)
    neighbours = [np.setdiff1d(pairs[(pairs == row).any(axis=1)], [row]) for row in range(len(end))]
    choices = [
        (row, left, right)
        for row in np.flatnonzero(moves).tolist()
        for left, right in combinations(neighbours[row][:MOST_SIDES].tolist(), 2)
    ]
    place, found = end, list[MirrorImage]()
    best = fitted_shape(links, anchors, place, free)
    for _ in range(MIRRORS):
        tried = []
        for row, left, right in choices:
            guess = place.copy()
            guess[row] = _mirror(place[row], place[left], place[right])
            tried.append((fitted_shape(links, anchors, guess, free), row, (left, right)))
        moved = [(round(shape.worst, 3), float(norm(shape.position - place).sum())) for shape, _, _ in tried]
        if not moved:
            return []
        shape, row, ends = tried[moved.index(min(moved))]
        if shape.worst >= best.worst:
            return []
        best, place = shape, shape.position
        found.append(MirrorImage(row, ends, shape.position[row]))
        if best.worst <= OFF:
            return found
    return []


def _mirror(point: Array, left: Array, right: Array) -> Array:
    """Mirror image of a point (3,) across the vertical plane through two others [m]."""
    way = right[:2] - left[:2]
    across = np.array([-way[1], way[0]]) / max(float(norm(way)), POINT)
    return point - 2.0 * float((point[:2] - left[:2]) @ across) * np.array([*across, 0.0])


class Conflict(NamedTuple):
    """Distances that contradict one another whatever the rest of the formation does."""

    # two robots with a difference of heights beyond their distance, or the three of a triangle
    rows: tuple[int, ...]
    ceiling: float  # height of the higher ones at which they would just be met [m]; NaN where no height would do
    high: tuple[int, ...]  # the rows of the higher ones


def conflicts(links: Links, height: Array) -> list[Conflict]:
    """Pairs and triangles of linked robots that cannot be met with the held heights (N,) [m]."""
    rows = len(height)
    wanted = np.full((rows, rows), np.nan)
    wanted[links.receiver, links.sender] = links.distance
    wanted = np.where(np.isnan(wanted), wanted.T, wanted)
    rise = np.abs(height[:, None] - height[None, :])
    found, short = list[Conflict](), wanted < rise - ROUNDED
    for i, j in np.argwhere(np.triu(short)).tolist():
        high = i if height[i] > height[j] else j
        found.append(Conflict((i, j), float(wanted[i, j] + min(height[i], height[j])), (high,)))
    planar = np.where(short, np.nan, np.sqrt(np.maximum(wanted**2 - rise**2, 0.0)))
    triangles = dict[tuple[int, ...], None]()
    for i, j in edges(links).tolist():
        beyond = np.flatnonzero(planar[i, j] > planar[i] + planar[j] + ROUNDED)
        triangles |= {tuple(sorted((i, j, k))): None for k in beyond.tolist()}
    return found + [_of_triangle(each, wanted, height) for each in triangles]


def _of_triangle(triangle: tuple[int, ...], wanted: Array, height: Array) -> Conflict:
    """Height that would close a triangle: its own, standing on the two robots that share a height."""
    for apex in triangle:
        left, right = (row for row in triangle if row != apex)
        if height[left] == height[right] != height[apex]:
            base = wanted[left, right]
            sides = np.array([base, wanted[left, apex], wanted[right, apex]])
            half = sides.sum() / 2.0
            square = half * float(np.prod(half - sides))
            if square > 0.0:
                high = (apex,) if height[apex] > height[left] else (left, right)
                return Conflict(triangle, float(min(height[apex], height[left]) + 2.0 * math.sqrt(square) / base), high)
    return Conflict(triangle, math.nan, ())


class Contradiction(NamedTuple):
    """Relative positions that do not add up: around `rows`, each linked to the next and the last to the first."""

    rows: tuple[int, ...]  # two robots of which each asks for something else, or more around a ring
    link: int  # the one that closes the ring
    gap: float  # how far its ends miss each other [m]


def contradictions(links: Links) -> list[Contradiction]:
    """Rings of links by relative position with vectors that do not add up to zero, the shortest rings first."""
    if links.wants is None or links.relative is None:
        return []
    at = np.flatnonzero(links.wants == BY_RELATIVE)
    here = list(
        zip(at.tolist(), links.receiver[at].tolist(), links.sender[at].tolist(), links.relative[at], strict=True)
    )
    neighbours: dict[int, list[tuple[int, Array]]] = {}
    for _, i, j, offset in here:
        neighbours.setdefault(j, []).append((i, offset))
        neighbours.setdefault(i, []).append((j, -offset))
    place: dict[int, Array] = {}
    way: dict[int, list[int]] = {}  # path from the root of a tree through the network to each row
    for root in neighbours:
        if root in place:
            continue
        place[root] = np.zeros(3)
        way[root], queue = [root], [root]
        for row in queue:
            for to, step in neighbours[row]:
                if to not in place:
                    place[to], way[to] = place[row] + step, [*way[row], to]
                    queue.append(to)
    found = []
    for k, i, j, offset in here:
        gap = float(norm((place[i] - place[j] - offset)[:2]))
        if gap > ROUNDED:
            fork = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(way[i], way[j], strict=False)))
            found.append(Contradiction((*reversed(way[i][fork - 1 :]), *way[j][fork:]), k, gap))
    return sorted(found, key=lambda each: len(each.rows))


def drawn_bearings(links: Links, robots: int) -> tuple[Array, bool]:
    """Places (N, 2) [m] with at least a metre along each bearing, from above; whether all are met, to some degrees."""
    assert links.bearing is not None
    gx, gy = np.nan_to_num(links.bearing[:, :2]).T[:, :, None]
    rows = np.eye(robots)
    apart = rows[links.receiver] - rows[links.sender]
    along, aside = np.hstack([gx * apart, gy * apart]), np.hstack([-gy * apart, gx * apart])

    def rest(place: Array) -> float:
        return float(((STRICT * aside @ place) ** 2).sum() + (np.maximum(1.0 - along @ place, 0.0) ** 2).sum())

    place, least = np.zeros(along.shape[1]), math.inf
    for _ in range(TRIES):  # Newton's method: only what is too short along its bearing counts
        short = along @ place < 1.0
        wanted = np.concatenate([np.zeros(len(links)), np.ones(int(short.sum()))])
        step = np.linalg.lstsq(np.vstack([STRICT * aside, along[short]]), wanted)[0] - place
        while rest(place + step) > least and rest(place + step) > rest(place + step / 2.0):
            step = step / 2.0
        place = place + step
        if rest(place) > 0.999 * least:
            break
        least = rest(place)
    return place.reshape(2, -1).T, bool((np.abs(aside @ place) <= ASKEW * (along @ place)).all())


def formation_rigidity(
    position: Array, links: Links, led: Index, anchors: Anchored = ()
) -> tuple[Rigidity, Rigidity | None]:
    """Infinitesimal rigidity when heights are held, and in full space if all links ask for distances.

    Leaders (rows `led`) keep their places among themselves by their plans, so a bar stands between any two of them.
    If links have targets other than distances, or robots are anchored, some translations, a rotation and a growth may
    be left free. The formation is rigid if no other motion leaves the links satisfied.
    """
    bars = _bars(led)
    if links.wants is not None or anchors:
        return _similar_rigidity(position, links, bars, anchors), None
    pairs = np.unique(np.concatenate([edges(links), bars]), axis=0)
    return rigidity(position, pairs, _free(np.ones(len(position), dtype=bool))), rigidity(position, pairs)


def formation_bend(position: Array, links: Links, led: Index, sigma: float) -> Bend:
    """Bend of a formation by distances under errors of positions of `sigma` [m], see `bend`; leaders as bars."""
    pairs = np.unique(np.concatenate([edges(links), _bars(led)]), axis=0)
    return bend(position, pairs, sigma, _free(np.ones(len(position), dtype=bool)))


def formation_redundancy(position: Array, links: Links, led: Index) -> Redundancy:
    """Links and robots without which a formation by distances stays rigid while heights are held.

    Bars between leaders, rows `led`, cannot be lost as links are; they go with their robots.
    """
    own, bars = edges(links), _bars(led)
    pairs = np.concatenate([own, bars[~(bars[:, None] == own).all(axis=2).any(axis=1)]])
    found = redundancy(position, pairs, _free(np.ones(len(position), dtype=bool)))
    return Redundancy(found.pairs[: len(own)], found.robots)


def _bars(led: Index) -> Index:
    """Pairs (M, 2) of leaders."""
    return np.array([*combinations(np.sort(led), 2)], dtype=np.intp).reshape(-1, 2)


def _similar_rigidity(position: Array, links: Links, bars: Index, anchors: Anchored) -> Rigidity:
    """Rigidity up to translations, a rotation and a growth, from the squared singular values: eigenvalues of JᵀJ."""
    rows = len(position)
    asked = residuals(links, anchors, position)
    square = asked.normal(np.arange(rows), rows, 2)[0]
    i, j = np.repeat(bars, 2, axis=0).T  # leaders keep their places along both axes
    stiff = Residuals(np.zeros(len(i)), i, j, np.tile(np.eye(3)[:2], (len(bars), 1)))
    square += stiff.normal(np.arange(rows), rows, 2)[0]
    away = (position - position.mean(axis=0))[:, :2]
    alike = np.stack([*whole_motions(away).T, away.ravel()])
    alike = alike[norm(alike) > POINT]
    answered = int((np.linalg.eigvalsh(alike @ square @ alike.T) > CERTAIN).sum())
    squares = np.linalg.eigvalsh(square)[::-1]
    rank = int((squares > CERTAIN * float(squares.max(initial=0.0))).sum())
    needed = 2 * rows - len(alike) + answered
    return Rigidity(rank, needed, math.sqrt(squares[needed - 1]) if 0 < needed <= rank else 0.0)


def whole_motions(away: Array) -> Array:
    """Motions in the plane (2 N, 3) of all robots `away` (N, 2) from a centre: along x, along y, and turning."""
    zero, one = np.zeros(len(away)), np.ones(len(away))
    motions = ((one, zero), (zero, one), (-away[:, 1], away[:, 0]))
    return np.stack([np.stack(each, axis=1).ravel() for each in motions], axis=1)


def algebraic_connectivity(links: Links, rows: int) -> float:
    """Second smallest eigenvalue of the Laplacian of the network without directions (Fiedler); 0 for one robot."""
    between = np.maximum(adjacency(links, rows), adjacency(links, rows).T)
    values = np.linalg.eigvalsh(np.diag(between.sum(axis=1)) - between)
    return max(0.0, float(values[1])) if rows > 1 else 0.0
