"""Coordination, the middle level (paper, figure 10): from what was heard of the neighbours to a goal position.

A law is a frozen struct of its parameters with `offset` and `error`, found by the entry-point group `zenpark.laws`.
"""

from __future__ import annotations

from typing import Protocol

import msgspec
import numpy as np

from agents.graph import Links
from agents.rows import Array, clamp, norm


class Law(Protocol):
    """A formation law."""

    def offset(self, position: Array, heard: Array, links: Links) -> Array:
        """Offset u^s (N, 3) [m] from `position` (N, 3) and what was `heard` on each link (E, 3)."""
        ...

    def error(self, position: Array, heard: Array, links: Links) -> Array:
        """Error of each link (E,) [m], not negative."""
        ...


class Distance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Formation by distances: the negative gradient of Σ μ/8 (d² − ‖p_i − p_j‖²)² (paper, eq. (6))."""

    def offset(self, position: Array, heard: Array, links: Links) -> Array:
        """u_i = ½ Σ_j μ_ij (d_ij² − ‖p_i − p_j‖²)(p_i − p_j), see `Law.offset`."""
        offset = position[links.listener] - heard
        error = links.distance**2 - np.vecdot(offset, offset)
        return links.onto_listeners((0.5 * links.gain * error)[:, None] * offset, len(position))

    def error(self, position: Array, heard: Array, links: Links) -> Array:
        """|d_ij − ‖p_i − p_j‖|, see `Law.error`."""
        offset = position[links.listener] - heard
        return np.abs(links.distance - norm(offset))


def tracking(position: Array, target: Array, gain: float | Array) -> Array:
    """u_i^t = −½ k_i ‖p_i − q_i‖² (p_i − q_i) (N, 3) (paper, eq. (7)); zero where the target is NaN."""
    offset = position - target
    pull = (-0.5 * gain * np.vecdot(offset, offset))[:, None] * offset
    return np.where(np.isnan(pull), 0.0, pull)


def goal(position: Array, offset: Array, limit: float) -> Array:
    """Goal position p + u (N, 3), u clamped to ± `limit` per axis [m].

    The clamp is not cosmetic: unclamped, (6) grows with the third power of a large error.
    """
    return position + clamp(offset, -limit, limit)
