"""Formation laws, the middle level (paper, figure 10): from the positions of neighbours to a goal position.

They have no memory, and are written for one robot i, as textbooks write it: u_i = Σ_j of what each link pulls. All of
`pull` and `error` runs on quiet ticks. Laws that remember and say something are `agents.plugins.law.Law`.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta

from agents.formation.link import BY_BEARING, BY_DISTANCE, Link, from_ray, target_error
from agents.plugins.law import Gain, Law, Need
from agents.vectors import NotNegative, Vector, clamp, difference, norm


class Gradient(Law, frozen=True):
    """A law without memory: the sum of what the links pull, each by its own relative position.

    `apart` is p_i − p̂_j [m], from the sender j to the robot i.
    """

    NEEDS: ClassVar[Need] = "distance"

    def pull(self, apart: Vector, link: Link) -> Vector:
        """Contribution of a link to the offset u_i [m]."""
        raise TypeError(f"{type(self).__name__} must define `pull`")

    def error(self, apart: Vector, link: Link) -> float:
        """Error of a link [m]; its sign does not count."""
        raise TypeError(f"{type(self).__name__} must define `error`")


class Distance(Gradient, frozen=True):
    """Formation by distances: the negative gradient of Σ μ/8 (d² − ‖p_i − p_j‖²)² (paper, eq. (6)).

    With a `dead_zone` b a link with error s pulls as if its error were s less b, and not at all below. Two robots may
    disagree about the length of their link, because of different distances or outdated positions of each other. Below
    2b of disagreement both find a length at which they rest. Without it they push and pull for ever, which turns the
    whole formation (Mou, Belabbas, Morse, Sun, Anderson, IEEE TAC 2016).
    """

    dead_zone: Annotated[NotNegative, Meta(description="errors up to this are ignored [m]")] = 0.0

    def pull(self, apart: Vector, link: Link) -> Vector:
        """½ μ_ij (d_ij² − ‖p_i − p_j‖²)(p_i − p_j)."""
        return pull_to_distance(apart, link, self.dead_zone)

    def error(self, apart: Vector, link: Link) -> float:
        """|d_ij − ‖p_i − p_j‖|."""
        return abs(link.distance - norm(apart))


class Displacement(Gradient, frozen=True):
    """Formation by relative positions: the negative gradient of Σ k/2 ‖p_i − p_j − d_ij‖².

    The displacement-based law of Oh, Park and Ahn's survey (Automatica 53, 2015), which is linear: with all d_ij = 0
    it is consensus on a meeting point.
    """

    NEEDS: ClassVar[Need] = "relative"
    PULLS_BY: ClassVar[Gain] = "stiffness"

    def pull(self, apart: Vector, link: Link) -> Vector:
        """−k_ij (p_i − p_j − d_ij)."""
        return pull_to_place(apart, link)

    def error(self, apart: Vector, link: Link) -> float:
        """‖p_i − p_j − d_ij‖."""
        return norm(difference(apart, link.relative))


class Bearing(Gradient, frozen=True):
    """Formation by directions: the negative gradient of Σ k/2 (distance of p_i − p_j from the ray along g_ij)².

    On the side that g_ij points to, this is −k P_g (p_i − p_j) with the projector P_g = I − g gᵀ of Zhao and Zelazo
    (IEEE Transactions on Control of Network Systems 4(3), 2017). On the other side that law accepts the opposite
    direction; here the robots first close up. The size of the formation is left to two leaders, or to heights.
    """

    NEEDS: ClassVar[Need] = "bearing"
    PULLS_BY: ClassVar[Gain] = "stiffness"

    def pull(self, apart: Vector, link: Link) -> Vector:
        """−k_ij (x − max(gᵀx, 0) g) with x = p_i − p_j."""
        return pull_to_ray(apart, link)

    def error(self, apart: Vector, link: Link) -> float:
        """‖x − max(gᵀx, 0) g‖."""
        return norm(from_ray(apart, link.bearing))


class Mixed(Gradient, frozen=True):
    """Each link by its own target: a distance, a relative position or a direction.

    One link with a relative position among distances fixes the orientation of the formation, which distances leave
    free.
    """

    NEEDS: ClassVar[Need] = "any"
    PULLS_BY: ClassVar[Gain] = "by link"

    dead_zone: Annotated[NotNegative, Meta(description="errors of distances up to this are ignored [m]")] = 0.0

    def pull(self, apart: Vector, link: Link) -> Vector:
        """By the law of the link's target."""
        if link.wants == BY_DISTANCE:
            return pull_to_distance(apart, link, self.dead_zone)
        return pull_to_ray(apart, link) if link.wants == BY_BEARING else pull_to_place(apart, link)

    def error(self, apart: Vector, link: Link) -> float:
        """By the target of the link."""
        return target_error(apart, link, link.wants)


def pull_to_distance(apart: Vector, link: Link, dead_zone: float) -> Vector:
    """½ μ (d² − ‖x‖²) x; within the dead zone 0, beyond it as if ‖x‖ were nearer to d by it."""
    x, y, z = apart
    square, wanted = x * x + y * y + z * z, link.distance
    if dead_zone > 0.0:
        error = wanted - norm(apart)
        felt = wanted - (error - clamp(error, -dead_zone, dead_zone))
        square = felt * felt
    pull = 0.5 * link.gain * (wanted * wanted - square)
    return pull * x, pull * y, pull * z


def pull_to_place(apart: Vector, link: Link) -> Vector:
    (x, y, z), k = difference(link.relative, apart), link.gain
    return k * x, k * y, k * z


def pull_to_ray(apart: Vector, link: Link) -> Vector:
    (x, y, z), k = from_ray(apart, link.bearing), -link.gain
    return k * x, k * y, k * z


def tracking_offset(position: Vector, target: Vector, gain: float) -> Vector:
    """u_i^t = −½ k_i ‖p_i − q_i‖² (p_i − q_i) (paper, eq. (7)); zero where the target is NaN."""
    x, y, z = difference(position, target)
    pull = -0.5 * gain * (x * x + y * y + z * z)
    if pull != pull:  # noqa: PLR0124 - NaN
        return 0.0, 0.0, 0.0
    return pull * x, pull * y, pull * z


def goal_position(position: Vector, offset: Vector, limit: float) -> Vector:
    """Goal position p + u, u clamped to ± `limit` per axis [m].

    The clamp is not cosmetic: unclamped, (6) grows with the third power of a large error.
    """
    return (
        position[0] + clamp(offset[0], -limit, limit),
        position[1] + clamp(offset[1], -limit, limit),
        position[2] + clamp(offset[2], -limit, limit),
    )
