"""Stability of the sampled loop near its target: modes, their time constants, and free motions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.formation.link import Link
from agents.plugins.laws import Gradient
from agents.vectors import Vector
from experiments.check.realisation import whole_motions
from experiments.definition.formation import Anchored, anchor_offsets, law_offsets, loop_gain, unlinked
from experiments.definition.graph import Links
from twins.arrays import Array, Index, norm

STEP: Final = 1e-4  # [m] size of the differences that stand for the law's derivative
STANDING: Final = 1e-6  # modes slower than the fastest by this factor do not move at all
UNMOVED: Final = 1e-6  # share of the fastest: the law ignores a motion of the whole with a smaller answer
EVEN: Final = 1e-9  # share of the fastest: a loop that is symmetric up to this has real modes


@dataclass(frozen=True)
class Modes:
    """The sampled loop near its target."""

    # `loop_gain` of H M, what a decision takes from a mode, with the h of robots that bear as much as `bearable` says
    gain: float
    radius: float  # largest |1 − λ| of modes that keep their sign: above 1 one of them grows
    slowest_s: float  # time constant of the slowest mode that moves [s]; infinity where none does
    # modes that decay more slowly than was asked for, or not at all: in that time nothing brings them back
    free: int = 0


def modes(
    law: Gradient,
    links: Links,
    position: Array,
    closed: Array,
    hz: float,
    *,
    bearable: Array | None = None,
    anchors: Anchored = (),
    within_s: float = math.inf,
) -> Modes:
    """Eigenvalues of p⁺ = p + H u(p) at `position`, over x and y of the robots with incoming links.

    Translations and rotations that the law ignores are taken out before: left in, their rounded zeros would pass for
    modes of hours. A law without a heading turns its answer with the formation, u(R p) = R u(p). With rounded distances
    u is not 0 at the best shape, and a rotation gets exactly that answer.

    Args:
        law: Its pull is differentiated numerically.
        position: (N, 3) where the formation is met [m].
        closed: (N,) h_i, the share of a position error that robot i closes until its next decision.
        bearable: (N,) largest factor between the error of a robot and what it is asked for with which it settles when
            it is alone; None: 2/h_i.
        within_s: Modes with a longer time constant than this are free [s].
    """
    anchored = np.array([row for row, _ in anchors], dtype=np.intp)
    receivers = np.unique(np.concatenate([links.receiver, anchored]))
    share = np.repeat(closed[receivers], 2)
    slope = -_derivative(law, links, position, anchors, receivers)
    if not np.isfinite(slope).all():
        return Modes(math.inf, math.inf, math.inf)
    # H M and H^½ M H^½ have the same eigenvalues, and the second is symmetric where M is
    root = np.sqrt(share)
    taken = root[:, None] * slope * root[None, :]
    offset = law_offsets(law, position, position[links.sender], links) + anchor_offsets(anchors, position)
    factor = 2.0 / closed if bearable is None else bearable
    hardest = np.sqrt(np.repeat(2.0 / factor[receivers], 2))
    gain = loop_gain(_eigenvalues(hardest[:, None] * slope * hardest[None, :]))
    turned = np.stack([-offset[receivers, 1], offset[receivers, 0]], axis=1).ravel()
    expected = np.stack([0.0 * turned, 0.0 * turned, -root * turned], axis=1)
    led = np.setdiff1d(np.arange(len(position)), receivers)
    centre = position[led if len(led) else receivers].mean(axis=0)
    taken = _remove_motions(taken, whole_motions((position[receivers] - centre)[:, :2]) / root[:, None], expected)
    values = _eigenvalues(taken)
    left = np.abs(1.0 - values)
    with np.errstate(divide="ignore"):
        lasts = -1.0 / (hz * np.log(left[left < 1.0]))
    moves = lasts < lasts.min(initial=math.inf) / STANDING
    free = len(left) - int((lasts <= within_s).sum()) if math.isfinite(within_s) else 0
    slowest = lasts[moves].max(initial=0.0) or math.inf
    return Modes(gain, float(left[values.real < 1.0].max(initial=0.0)), float(slowest), free)


def _eigenvalues(matrix: Array) -> NDArray[np.complex128]:
    """Eigenvalues; real ones of a matrix that is symmetric up to `EVEN`."""
    scale = float(np.abs(matrix).max(initial=0.0))
    if np.abs(matrix - matrix.T).max(initial=0.0) <= EVEN * scale:
        return np.linalg.eigvalsh(0.5 * (matrix + matrix.T)).astype(complex)
    return np.linalg.eigvals(matrix).astype(complex)


def _derivative(law: Gradient, links: Links, position: Array, anchors: Anchored, receivers: Index) -> Array:
    """∂u/∂p (2 L, 2 L) of the receivers: the sum of what each link and each anchor adds."""
    count, column = len(receivers), np.full(len(position), -1)
    column[receivers] = np.arange(count)
    blocks = np.zeros((count, 2, count, 2))
    apart = (position[links.receiver] - position[links.sender]).tolist()
    ends = zip(column[links.receiver].tolist(), column[links.sender].tolist(), strict=True)
    for (receiver, sender), (x, y, z), link in zip(ends, apart, unlinked(links), strict=True):
        slope = _slope(law.pull, (x, y, z), link)
        blocks[receiver, :, receiver] += slope
        if sender >= 0:
            blocks[receiver, :, sender] -= slope
    for row, anchor in anchors:
        x, y, z = position[row].tolist()
        blocks[column[row], :, column[row]] += _slope(anchor.pull, (x, y, z))
    return blocks.reshape(2 * count, 2 * count)


def _slope(pull: Callable[..., Vector], at: Vector, *link: Link) -> Array:
    """Derivative (2, 2) of x and y of a pull by x and y of the place [m] at which it is asked for."""
    x, y, z = at
    along = np.subtract(pull((x + STEP, y, z), *link), pull((x - STEP, y, z), *link))
    across = np.subtract(pull((x, y + STEP, z), *link), pull((x, y - STEP, z), *link))
    return np.stack([along[:2], across[:2]], axis=1) / (2.0 * STEP)


def _remove_motions(taken: Array, whole: Array, expected: Array) -> Array:
    """The loop without those motions of the whole (2 L, 3) that it answers as `expected`."""
    basis, size, mixed = np.linalg.svd(whole, full_matrices=False)
    kept = size > 1e-9 * max(1e-300, float(size.max(initial=0.0)))
    basis = basis[:, kept]
    if not basis.size:
        return taken
    answered = taken @ basis - expected @ (mixed[kept].T / size[kept])
    _, strength, turned = np.linalg.svd(answered, full_matrices=False)
    fastest = float(norm(taken).max(initial=0.0))
    still = basis @ turned[strength <= UNMOVED * fastest].T
    if not still.shape[1]:
        return taken
    rest, _ = np.linalg.qr(still, mode="complete")
    rest = rest[:, still.shape[1] :]
    return np.asarray(rest.T @ taken @ rest)
