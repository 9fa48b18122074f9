"""Stability of the sampled loop near its target: modes, their time constants, and free motions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.arrays import Array, Index, norm
from agents.formation.anchors import Anchors
from agents.formation.graph import Links
from agents.plugins.laws import Law

STEP: Final = 1e-4  # [m] of the differences that stand for the law's derivative
STANDING: Final = 1e-6  # modes slower than the fastest by this factor do not move at all
UNMOVED: Final = 1e-6  # of the fastest: a motion of the whole that the law answers by less is none of its business
EVEN: Final = 1e-9  # of the fastest: a loop that is symmetric but for this has real modes, which are quicker to find


@dataclass(frozen=True)
class Modes:
    """The sampled loop near its target."""

    # largest real part of the eigenvalues of H M, what a decision takes from a mode, with the h of robots that bear as
    # much as those of `bearable`: 2 is where it hunts
    gain: float
    radius: float  # largest |1 − λ| of modes whose sign stays: above 1 something grows
    slowest_s: float  # time constant of the slowest mode that moves [s]; infinity where none does
    # modes that decay more slowly than was asked for, or not at all: in that time nothing brings them back
    free: int = 0


def modes(
    law: Law,
    links: Links,
    position: Array,
    closed: Array,
    hz: float,
    *,
    bearable: Array | None = None,
    anchors: Anchors | None = None,
    within_s: float = math.inf,
) -> Modes:
    """Eigenvalues of p⁺ = p + H u(p) at `position`, over x and y of the robots that listen.

    Translations and rotations of which the law knows nothing are taken out before: left in, their rounded zeros would
    pass for modes of hours. A law that knows no heading turns its answer with the whole, u(R p) = R u(p); where
    distances were rounded, u is not 0 at the best shape, and a rotation is not left alone but answered by just that.

    Args:
        law: Its offset is differentiated numerically.
        position: (N, 3) where the formation is met [m].
        closed: (N,) h_i, the share of a position error that robot i closes until its next decision.
        bearable: (N,) largest factor between the error of a robot and what it is asked for with which it settles when
            it is alone; None: 2/h_i.
        within_s: Modes with a longer time constant than this are free [s].
    """
    anchored = np.zeros(0, dtype=np.intp) if anchors is None else anchors.row
    receivers = np.unique(np.concatenate([links.receiver, anchored]))
    share = np.repeat(closed[receivers], 2)
    slope = -_derivative(law, links, position, anchors, receivers)
    if not np.isfinite(slope).all():
        return Modes(math.inf, math.inf, math.inf)
    # H M and H^½ M H^½ have the same eigenvalues, and the second is symmetric where M is
    root = np.sqrt(share)
    taken = root[:, None] * slope * root[None, :]
    offset = law.offset(position, position[links.sender], links)
    offset = offset if anchors is None else offset + anchors.offset(position)
    factor = 2.0 / closed if bearable is None else bearable
    hardest = np.sqrt(np.repeat(2.0 / factor[receivers], 2))
    gain = _eigenvalues(hardest[:, None] * slope * hardest[None, :]).real.max(initial=0.0)
    turned = np.stack([-offset[receivers, 1], offset[receivers, 0]], axis=1).ravel()
    expected = np.stack([0.0 * turned, 0.0 * turned, -root * turned], axis=1)
    taken = _remove_motions(taken, _rigid_motions(position, receivers, len(position)) / root[:, None], expected)
    values = _eigenvalues(taken)
    left = np.abs(1.0 - values)
    with np.errstate(divide="ignore"):
        lasts = -1.0 / (hz * np.log(left[left < 1.0]))
    moves = lasts < lasts.min(initial=math.inf) / STANDING
    free = len(left) - int((lasts <= within_s).sum()) if math.isfinite(within_s) else 0
    slowest = lasts[moves].max(initial=0.0) or math.inf
    return Modes(float(gain), float(left[values.real < 1.0].max(initial=0.0)), float(slowest), free)


def _eigenvalues(matrix: Array) -> NDArray[np.complex128]:
    """Eigenvalues; real ones of a matrix that is symmetric but for `EVEN`."""
    scale = float(np.abs(matrix).max(initial=0.0))
    if np.abs(matrix - matrix.T).max(initial=0.0) <= EVEN * scale:
        return np.linalg.eigvalsh(0.5 * (matrix + matrix.T)).astype(complex)
    return np.linalg.eigvals(matrix).astype(complex)


def _derivative(law: Law, links: Links, position: Array, anchors: Anchors | None, receivers: Index) -> Array:
    """∂u/∂p (2 L, 2 L) of the receivers.

    The decision of a robot depends on its own position and on the poses received on its own links alone. So all robots
    are moved at once with the received poses kept, and then one link of every robot at once: two evaluations for each
    coordinate and link of a robot, however many robots there are.
    """
    rows, count = len(position), len(receivers)
    column = np.full(rows, -1)
    column[receivers] = np.arange(count)
    received = position[links.sender]
    blocks = np.zeros((count, 2, count, 2))
    rank = np.arange(len(links)) - np.searchsorted(links.receiver, links.receiver)
    for axis in (0, 1):
        step = np.zeros(3)
        step[axis] = STEP
        own = law.offset(position + step, received, links) - law.offset(position - step, received, links)
        if anchors is not None:
            own = own + anchors.offset(position + step) - anchors.offset(position - step)
        blocks[np.arange(count), :, np.arange(count), axis] += own[receivers, :2] / (2.0 * STEP)
        for turn in range(int(rank.max(initial=-1)) + 1):
            mine = rank == turn
            shift = mine[:, None] * step
            answer = law.offset(position, received + shift, links) - law.offset(position, received - shift, links)
            receiver, sender = links.receiver[mine], column[links.sender[mine]]
            known = sender >= 0
            at = column[receiver[known]], sender[known]
            blocks[at[0], :, at[1], axis] += answer[receiver[known], :2] / (2.0 * STEP)
    return blocks.reshape(2 * count, 2 * count)


def _rigid_motions(position: Array, receivers: Index, rows: int) -> Array:
    """Motions of the whole (2 L, 3): along x, along y, and turning, about the leaders if there are any."""
    led = np.setdiff1d(np.arange(rows), receivers)
    centre = position[led if len(led) else receivers].mean(axis=0)[:2]
    way = position[receivers, :2] - centre
    zero, one = np.zeros(len(receivers)), np.ones(len(receivers))
    motions = ((one, zero), (zero, one), (-way[:, 1], way[:, 0]))
    return np.stack([np.stack(each, axis=1).ravel() for each in motions], axis=1)


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
