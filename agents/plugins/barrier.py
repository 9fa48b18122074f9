"""A control barrier function: the least change of the commanded velocity that keeps a robot from touching things.

All of it is quiet.
"""

from __future__ import annotations

from math import atan2, copysign, cos, floor, inf, pi, sin, sqrt
from typing import Annotated, Final

from msgspec import Meta

from agents.plugins.avoidance import Avoidance, Nearby, OwnState, Thing, measure
from agents.vectors import NotNegative, Positive, Setpoint, Vector, clamp

SECTORS: Final = 8  # of what surrounds a robot; the tightest half-plane of each takes part in the exact solution
SLACK: Final = 1e-9  # [m/s] violations smaller than this are arithmetic
PARALLEL: Final = 1e-9  # sine of the angle below which two half-planes have no corner
SKEW: Final = 0.2  # a robot on wheels hardly flees along a heading this far (its cosine) from broadside
LEAST: Final = 1e-100  # to divide by: beyond any speed, and still a number

Planar = tuple[float, float]  # x, y
Candidate = tuple[float, float, float]  # x, y, and the square of the distance from what is wanted; infinite: none


class Barrier(Avoidance, frozen=True):
    """A control barrier function, kept by a quadratic program in closed form.

    For each thing near a robot let n be the horizontal unit vector from it to the robot, h the gap between their
    surfaces less `margin`, and s = h − τ_i [−n·v_i]₊ − τ_j [n·v_j]₊ the part of h that would remain if both stopped
    now: a body whose velocity follows its commands with time constant τ goes on for τ v. The commanded velocity u must
    obey

        −n·u ≤ α s / 2                  its half; the other robot keeps the other half
        −n·u ≤ α s − [n·v_j]₊           for the received velocity of the other robot
        −n·u ≤ α s                      in place of the first, where s < 0: back off

    and is the one nearest to the wanted velocity w (‖u − w‖² least, a quadratic program in two variables). At the last,
    the speed of robots on wheels along their heading is limited by the same inequalities, of which none forbids turning
    on the spot; before that their goal is shifted to where u points, so that they drive around things rather than stop,
    and by a smaller α (`steering`), so that they have turned in time. Where not all inequalities can be kept, the
    largest violation is made as small as it can be.

    For u that obeys, s' ≥ −α s: s stays positive once it is, and h ≥ s, so that no two robots touch under the
    conditions that docs/plugins.md names. Arrival is not guaranteed. Against deadlocks of robots that meet head-on, the
    share `right` of the barred velocity is given back to the right: all pass each other on the same side. A robot that
    comes faster than this one can flee is dodged to the side of its way on which this one is.

    Barrier functions: Ames et al., European Control Conference 2019; shared between robots: Wang, Ames and Egerstedt,
    IEEE Transactions on Robotics 33(3), 2017.
    """

    margin: Annotated[NotNegative, Meta(description="gap between surfaces that is kept [m]")] = 0.05
    alpha: Annotated[Positive, Meta(description="α: how fast a gap may be used up, per metre of it [1/s]")] = 3.0
    steering: Annotated[
        Positive,
        Meta(
            description="robots on wheels are steered by this share of α around robots whose poses they receive", le=1
        ),
    ] = 0.2
    right: Annotated[
        NotNegative, Meta(description="share of the barred velocity that is driven to the right instead")
    ] = 1.0

    def bound(self, thing: Thing, share: float) -> float:
        """b [m/s] of the half-plane −n·u ≤ b that a measured thing asks for, if this `share` of α is used."""
        left = thing.gap - self.margin
        coming = max(thing.away_x * thing.velocity_x + thing.away_y * thing.velocity_y, 0.0)
        used = self.alpha * share * left
        return min(0.5 * used if left > 0.0 else used, used - coming)

    def deviate(self, goal: Vector, own: OwnState, near: Nearby, period: float) -> Vector:
        """Steer a robot that cannot move sideways."""
        if near.count == 0 or not own.by_twist:
            return goal
        here_x, here_y, _ = own.position
        wanted_x, wanted_y = own.response * (goal[0] - here_x), own.response * (goal[1] - here_y)
        share = min(1.0, own.speed / max(sqrt(wanted_x * wanted_x + wanted_y * wanted_y), SLACK))
        wanted_x, wanted_y = wanted_x * share, wanted_y * share
        for k in range(near.count):
            thing = near.things[k]
            measure(own, thing)
            thing.bound = self.bound(thing, self.steering if thing.is_robot else 1.0)
        if not barred(wanted_x, wanted_y, near):
            return goal
        x, y = self.nearest(wanted_x, wanted_y, own, near)
        return here_x + x / own.response, here_y + y / own.response, goal[2]

    def restrain(self, setpoint: Setpoint, own: OwnState, near: Nearby) -> Setpoint:
        if near.count == 0:
            return setpoint
        for k in range(near.count):
            measure(own, near.things[k])
            near.things[k].bound = self.bound(near.things[k], 1.0)
        a, b, c, d = setpoint
        if own.by_twist:
            return along_heading(a, own, near), b, c, d
        here_x, here_y, _ = own.position
        wanted_x, wanted_y = a, b
        if own.by_position:
            wanted_x, wanted_y = own.response * (a - here_x), own.response * (b - here_y)
        if not barred(wanted_x, wanted_y, near):
            return setpoint
        x, y = self.nearest(wanted_x, wanted_y, own, near)
        if own.by_position:
            x, y = here_x + x / own.response, here_y + y / own.response
        return x, y, c, d

    def nearest(self, x: float, y: float, own: OwnState, near: Nearby) -> Planar:
        """The velocity nearest to a wanted one x, y [m/s] that the half-planes of the things allow, which bar it."""
        worst = -1
        for k in range(near.count):
            thing = near.things[k]
            thing.counts = thing.bound < own.speed or thing.excess > SLACK
            if thing.counts and (worst < 0 or thing.excess > near.things[worst].excess):
                worst = k
        thing = near.things[worst]  # what bars most
        side_x, side_y = self.evasion(thing, own)
        give = clamp(thing.excess, 0.0, own.speed)
        x, y = x + give * side_x, y + give * side_y
        x, y = closest(x, y, near, tightest(near))
        return scaled(x, y, own.speed, near)

    def evasion(self, thing: Thing, own: OwnState) -> Planar:
        """Evasion per m/s that a thing bars: to the right, seen toward the thing.

        One that comes faster than the robot can flee will not mind it: there it is the side of its way where the robot
        is.
        """
        x, y, share = -thing.away_x, -thing.away_y, self.right
        if x * thing.velocity_x + y * thing.velocity_y < -own.speed:
            off = x * thing.velocity_y - y * thing.velocity_x  # > 0: the robot is left of its way
            if off < 0.0:
                share = -1.0
            elif off > 0.0:
                share = 1.0
        return share * y, -share * x


def barred(x: float, y: float, near: Nearby) -> bool:
    """Whether a half-plane bars the velocity x, y [m/s]; sets `excess` of the things."""
    any_bars = False
    for k in range(near.count):
        thing = near.things[k]
        thing.excess = -(thing.away_x * x + thing.away_y * y) - thing.bound
        any_bars = any_bars or thing.excess > SLACK
    return any_bars


def along_heading(v: float, own: OwnState, near: Nearby) -> float:
    """The speed nearest to v [m/s] in the interval that all half-planes leave along the heading."""
    head_x, head_y = cos(own.yaw), sin(own.yaw)
    high, low, any_bars = inf, -inf, False
    for k in range(near.count):
        thing = near.things[k]
        bound, gain = thing.bound, -(thing.away_x * head_x + thing.away_y * head_y)
        any_bars = any_bars or gain * v > bound + SLACK
        # where standing still is allowed the limit is exact; where it is not, a robot that stands broadside to what it
        # should flee from must not be driven at full speed for next to nothing
        limit = bound * gain / (gain * gain + SKEW * SKEW)
        if bound >= 0.0:
            limit = bound / copysign(max(abs(gain), LEAST), gain)
        if gain > 0.0:
            high = min(high, limit)
        elif gain < 0.0:
            low = max(low, limit)
    if not any_bars:
        return v
    if low > high:  # it should go both ways: only as far as what is not touched yet allows
        return clamp(high if high >= 0.0 else low if low <= 0.0 else 0.0, -own.speed, own.speed)
    return clamp(clamp(v, low, high), -own.speed, own.speed)


def tightest(near: Nearby) -> int:
    """Set `planes` to the half-plane of the smallest bound in each sector; returns how many there are."""
    count = 0
    for sector in range(SECTORS + 1):  # exactly π falls into a sector of its own
        best = -1
        for k in range(near.count):
            thing = near.things[k]
            if thing.counts and sector_of(thing) == sector and (best < 0 or thing.bound < near.things[best].bound):
                best = k
        if best >= 0:
            plane, thing = near.planes[count], near.things[best]
            plane.x, plane.y, plane.b = -thing.away_x, -thing.away_y, thing.bound
            count += 1
    return count


def sector_of(thing: Thing) -> int:
    return floor((atan2(-thing.away_y, -thing.away_x) / pi + 1.0) * (0.5 * SECTORS))


def closest(x: float, y: float, near: Nearby, count: int) -> Planar:
    """The point nearest to x, y with a·u ≤ b for the first `count` planes.

    The solution of this quadratic program is x, y itself, or its projection onto one line, or a corner of two: all are
    tried. Where no point obeys all, the bounds are raised together by as little as makes one do.
    """
    found = candidate(x, y, near, count, 0.0)
    if found[2] < inf:
        return found[0], found[1]
    found = candidate(x, y, near, count, least_violation(near, count) + SLACK)
    if found[2] < inf:
        return found[0], found[1]
    return 0.0, 0.0  # two that nearly face each other may have no corner in reach


def candidate(x: float, y: float, near: Nearby, count: int, raised: float) -> Candidate:
    """As `closest`, with all bounds `raised` [m/s]."""
    planes = near.planes
    best = better((x, y, inf), x, y, x, y, near, count, raised)
    for k in range(count):
        plane = planes[k]
        over = max(plane.x * x + plane.y * y - (plane.b + raised), 0.0)
        best = better(best, x - over * plane.x, y - over * plane.y, x, y, near, count, raised)
    for i in range(count):
        for j in range(i + 1, count):
            first, second = planes[i], planes[j]
            sine = first.x * second.y - first.y * second.x
            if abs(sine) > PARALLEL:
                b, c = first.b + raised, second.b + raised
                corner_x, corner_y = (b * second.y - c * first.y) / sine, (first.x * c - second.x * b) / sine
                best = better(best, corner_x, corner_y, x, y, near, count, raised)
    return best


def better(  # noqa: PLR0917 - numbers alone
    best: Candidate, x: float, y: float, wanted_x: float, wanted_y: float, near: Nearby, count: int, raised: float
) -> Candidate:
    """The point x, y in place of the `best` so far if it obeys all planes and is nearer to what is wanted."""
    off_x, off_y = x - wanted_x, y - wanted_y
    cost = off_x * off_x + off_y * off_y
    if not cost < best[2]:
        return best
    for k in range(count):
        plane = near.planes[k]
        if not x * plane.x + y * plane.y <= plane.b + raised + SLACK:
            return best
    return x, y, cost


def least_violation(near: Nearby, count: int) -> float:
    """How far all bounds must be raised so that a point obeys all of the first `count` planes [m/s].

    By Helly's theorem three half-planes settle that: by −Σ λ b, where λ ≥ 0 are the weights (Σ λ = 1) with which their
    normals cancel out; or two that face each other.
    """
    raised, planes = 0.0, near.planes
    for i in range(count):
        for j in range(i + 1, count):
            p, q = planes[i], planes[j]
            sine, cosine = p.x * q.y - p.y * q.x, p.x * q.x + p.y * q.y
            if abs(sine) <= PARALLEL and cosine < 0.0:
                raised = max(raised, -0.5 * (p.b + q.b))
            for k in range(j + 1, count):
                r = planes[k]
                first, second = q.x * r.y - q.y * r.x, r.x * p.y - r.y * p.x
                total = first + second + sine
                agree = first >= 0.0 and second >= 0.0 and sine >= 0.0
                agree = agree or (first <= 0.0 and second <= 0.0 and sine <= 0.0)
                if agree and abs(total) > PARALLEL:
                    raised = max(raised, -(first * p.b + second * q.b + sine * r.b) / total)
    return raised


def scaled(x: float, y: float, speed: float, near: Nearby) -> Planar:
    """Velocity made so much smaller that it breaks no limit, and no half-plane that standing still obeys."""
    share = least = min(1.0, speed / max(sqrt(x * x + y * y), SLACK))
    for k in range(near.count):
        thing = near.things[k]
        reached = -(thing.away_x * x + thing.away_y * y) * share
        if thing.counts and reached > thing.bound + SLACK and thing.bound >= 0.0:
            least = min(least, share * thing.bound / reached)
    return x * least, y * least
