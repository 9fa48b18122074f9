"""Formation laws, the middle level (paper, figure 10): from the positions of neighbours to a goal position.

A law is a frozen struct of its parameters with `offset` and `error`, found by the entry-point group `zenpark.laws`.
`NEEDS` names the target that it needs of every link, `PULLS_BY` the gain of the file for links without their own:
`check` and the defaults go by both, and a law without them takes distances as `distance` does.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Protocol

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, NotNegative, clamp, norm
from agents.formation.graph import BY_BEARING, BY_DISTANCE, Links

Need = Literal["distance", "relative", "bearing", "any"]
Gain = Literal["gain", "stiffness", "by link"]


class Law(Protocol):
    """A formation law."""

    def offset(self, position: Array, sender_position: Array, links: Links) -> Array:
        """Offset u^s (N, 3) [m] from `position` (N, 3) and the position of each link's sender (E, 3) [m]."""
        ...

    def error(self, position: Array, sender_position: Array, links: Links) -> Array:
        """Error of each link (E,) [m], not negative."""
        ...


class Distance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Formation by distances: the negative gradient of Σ μ/8 (d² − ‖p_i − p_j‖²)² (paper, eq. (6)).

    With a `dead_zone` b a link with error s pulls as if its error were s less b, and not at all below. Two robots that
    disagree about the length of their link by less than 2b, because of different distances or outdated positions of
    each other, then both find a length at which they rest. Without it they push and pull for ever, which turns the
    whole formation (Mou, Belabbas, Morse, Sun, Anderson, IEEE TAC 2016).
    """

    NEEDS: ClassVar[Need] = "distance"
    PULLS_BY: ClassVar[Gain] = "gain"

    dead_zone: Annotated[NotNegative, Meta(description="errors up to this are ignored [m]")] = 0.0

    def offset(self, position: Array, sender_position: Array, links: Links) -> Array:
        """u_i = ½ Σ_j μ_ij (d_ij² − ‖p_i − p_j‖²)(p_i − p_j)."""
        pull = _by_distance(position[links.receiver] - sender_position, links, self.dead_zone)
        return links.sum_by_receiver(pull, len(position))

    def error(self, position: Array, sender_position: Array, links: Links) -> Array:
        """|d_ij − ‖p_i − p_j‖|."""
        return np.abs(links.distance - norm(position[links.receiver] - sender_position))


class Displacement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Formation by relative positions: the negative gradient of Σ k/2 ‖p_i − p_j − d_ij‖².

    The displacement-based law of Oh, Park and Ahn's survey (Automatica 53, 2015), which is linear: with all d_ij = 0
    it is consensus on a meeting point.
    """

    NEEDS: ClassVar[Need] = "relative"
    PULLS_BY: ClassVar[Gain] = "stiffness"

    def offset(self, position: Array, sender_position: Array, links: Links) -> Array:
        """u_i = −Σ_j k_ij (p_i − p_j − d_ij)."""
        pull = _by_relative(position[links.receiver] - sender_position, links)
        return links.sum_by_receiver(pull, len(position))

    def error(self, position: Array, sender_position: Array, links: Links) -> Array:
        """‖p_i − p_j − d_ij‖."""
        return norm(np.asarray(position[links.receiver] - sender_position - _or_nan(links.relative, links)))


class Bearing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Formation by directions: the negative gradient of Σ k/2 (distance of p_i − p_j from the ray along g_ij)².

    On the side that g_ij points to, this is −k P_g (p_i − p_j) with the projector P_g = I − g gᵀ of Zhao and Zelazo
    (IEEE Transactions on Control of Network Systems 4(3), 2017); on the other side, where that law is content with the
    opposite direction, the robots first close up. The size of the formation is left to two leaders, or to heights.
    """

    NEEDS: ClassVar[Need] = "bearing"
    PULLS_BY: ClassVar[Gain] = "stiffness"

    def offset(self, position: Array, sender_position: Array, links: Links) -> Array:
        """u_i = −Σ_j k_ij (x − max(gᵀx, 0) g) with x = p_i − p_j."""
        pull = _by_bearing(position[links.receiver] - sender_position, links)
        return links.sum_by_receiver(pull, len(position))

    def error(self, position: Array, sender_position: Array, links: Links) -> Array:
        """‖x − max(gᵀx, 0) g‖."""
        return norm(_from_ray(position[links.receiver] - sender_position, links))


class Mixed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Each link by its own target: a distance, a relative position or a direction.

    One link with a relative position among distances fixes the orientation of the formation, which distances leave
    free.
    """

    NEEDS: ClassVar[Need] = "any"
    PULLS_BY: ClassVar[Gain] = "by link"

    dead_zone: Annotated[NotNegative, Meta(description="errors of distances up to this are ignored [m]")] = 0.0

    def offset(self, position: Array, sender_position: Array, links: Links) -> Array:
        """Sum of the laws of each link."""
        offset = position[links.receiver] - sender_position
        pull = _by_distance(offset, links, self.dead_zone)
        if links.wants is not None:
            other = np.where(
                (links.wants == BY_BEARING)[:, None], _by_bearing(offset, links), _by_relative(offset, links)
            )
            pull = np.where((links.wants == BY_DISTANCE)[:, None], pull, other)
        return links.sum_by_receiver(pull, len(position))

    def error(self, position: Array, sender_position: Array, links: Links) -> Array:
        offset = position[links.receiver] - sender_position
        error = np.abs(links.distance - norm(offset))
        if links.wants is None:
            return error
        other = np.where(
            links.wants == BY_BEARING, norm(_from_ray(offset, links)), norm(offset - _or_nan(links.relative, links))
        )
        return np.where(links.wants == BY_DISTANCE, error, other)


def _by_distance(offset: Array, links: Links, dead_zone: float) -> Array:
    """½ μ (d² − ‖x‖²) x of each link (E, 3); within the dead zone 0, beyond it as if ‖x‖ were nearer to d by it."""
    square = np.asarray(np.vecdot(offset, offset))
    if dead_zone > 0.0:
        error = links.distance - np.sqrt(square)
        square = (links.distance - (error - clamp(error, -dead_zone, dead_zone))) ** 2
    return np.asarray((0.5 * links.gain * (links.distance**2 - square))[:, None] * offset)


def _by_relative(offset: Array, links: Links) -> Array:
    return np.asarray(links.gain[:, None] * (_or_nan(links.relative, links) - offset))


def _by_bearing(offset: Array, links: Links) -> Array:
    return np.asarray(-links.gain[:, None] * _from_ray(offset, links))


def _from_ray(offset: Array, links: Links) -> Array:
    """Vectors (E, 3) from the nearest point of the ray along the bearing to x; seen from above where the bearing is."""
    bearing = _or_nan(links.bearing, links)
    flat = np.isnan(bearing[:, 2]) & np.isfinite(bearing[:, 0])
    if flat.any():
        bearing, offset = bearing.copy(), offset.copy()
        bearing[flat, 2] = offset[flat, 2] = 0.0
    along = np.maximum(np.vecdot(offset, bearing), 0.0)
    return np.asarray(offset - along[:, None] * bearing)


def _or_nan(vectors: Array | None, links: Links) -> Array:
    return np.full((len(links), 3), np.nan) if vectors is None else vectors


def tracking_offset(position: Array, target: Array, gain: float | Array) -> Array:
    """u_i^t = −½ k_i ‖p_i − q_i‖² (p_i − q_i) (N, 3) (paper, eq. (7)); zero where the target is NaN."""
    offset = position - target
    pull = (-0.5 * gain * np.vecdot(offset, offset))[:, None] * offset
    return np.where(np.isnan(pull), 0.0, pull)


def goal_position(position: Array, offset: Array, limit: float) -> Array:
    """Goal position p + u (N, 3), u clamped to ± `limit` per axis [m].

    The clamp is not cosmetic: unclamped, (6) grows with the third power of a large error.
    """
    return position + clamp(offset, -limit, limit)
