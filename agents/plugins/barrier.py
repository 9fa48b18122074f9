"""A control barrier function: the least change of the commanded velocity that keeps a robot from touching things.

All of it is quiet.
"""

from __future__ import annotations

from math import copysign, cos, inf, sin, sqrt
from typing import Annotated, Final

from msgspec import Meta

from agents.plugins.avoidance import HURRY, Avoidance, Nearby, OwnState, Plane, Thing, measure_gap
from agents.vectors import NotNegative, Positive, Setpoint, Vector, clamp

SLACK: Final = 1e-9  # [m/s] violations smaller than this are arithmetic
ROUNDS: Final = 64  # rounds of raising bounds that clash; 60,000 random scenes of up to 30 half-planes took 18 at most
PARALLEL: Final = 1e-9  # sine of the angle below which two half-planes have no corner
SKEW: Final = 0.2  # a robot on wheels hardly flees along a heading this far (its cosine) from broadside
LEAST: Final = 1e-100  # smallest divisor: beyond any speed, and still a number

Planar = tuple[float, float]  # x, y
Solution = tuple[float, float, float]  # x, y, and the excess of clashing bounds, or -1: none clash [m/s]


class Barrier(Avoidance, frozen=True):
    """A control barrier function, kept by a quadratic program in closed form.

    For each thing near a robot let n be the horizontal unit vector from it to the robot and h the gap between their
    surfaces less `margin`. If both stopped now, s = h − τ_i [−n·v_i]₊ − τ_j [n·v_j]₊ of it would remain: a body that
    follows its commands with time constant τ moves on by τ v. The commanded velocity u must obey

        −n·u ≤ α s / 2                  its half; the other robot keeps the other half
        −n·u ≤ α s − [n·v_j]₊           for the received velocity of the other robot
        −n·u ≤ α s                      in place of the first, where s < 0: back off

    and is the one nearest to the wanted velocity w (‖u − w‖² least, a quadratic program in two variables). In the end,
    the same inequalities limit the speed of robots on wheels along their heading; none forbids turning on the spot.
    Before that their goal is shifted in the direction of u, so that they drive around things rather than stop. A
    smaller α (`steering`) applies there, so that they have turned in time.

    All inequalities are kept wherever some velocity within the limit of speed does so. Those that standing still obeys
    are always kept. Where only a velocity beyond the limit would obey the others (something comes faster than the
    robot can flee), u points where that one does, at the limit. Where none would, the largest violation of the others
    is made as small as it can be.

    For u that obeys, s' ≥ −α s: s stays positive once it is, and h ≥ s, so that no two robots touch under the
    conditions that docs/plugins.md names. Arrival is not guaranteed. Against deadlocks of robots that meet head-on, the
    share `right` of the barred velocity is given back to the right: all pass each other on the same side. A robot that
    comes faster than this one can flee is dodged to the side of its way on which this one is.

    Barrier functions: Ames et al., European Control Conference 2019; shared between robots: Wang, Ames and Egerstedt,
    IEEE Transactions on Robotics 33(3), 2017.
    """

    margin: Annotated[NotNegative, Meta(description="gap between surfaces that is kept [m]")] = 0.05
    alpha: Annotated[Positive, Meta(description="α: speed at which a gap may shrink, per metre of it [1/s]")] = 3.0
    steering: Annotated[
        Positive,
        Meta(description="share of α with which robots on wheels steer around robots with received poses", le=1),
    ] = 0.2
    right: Annotated[
        NotNegative, Meta(description="share of the barred velocity that is driven to the right instead")
    ] = 1.0

    def kept_gap(self) -> float:
        return self.margin

    def horizon(self, own: OwnState) -> float:
        """Beyond it b is greater than any speed."""
        return self.margin + (own.lag + 2.0 / self.alpha) * HURRY * own.speed

    def bound(self, thing: Thing, share: float) -> float:
        """b [m/s] of the half-plane −n·u ≤ b that a measured thing asks for, if this `share` of α is used."""
        left = thing.gap - self.margin
        used = self.alpha * share * left
        half = 0.5 * used if left > 0.0 else used
        coming = thing.away_x * thing.velocity_x + thing.away_y * thing.velocity_y
        return used - coming if coming > 0.0 and used - coming < half else half

    def deviate(self, goal: Vector, own: OwnState, near: Nearby, period: float) -> Vector:
        """Steer a robot that cannot move sideways."""
        if near.count == 0 or not own.by_twist:
            return goal
        here_x, here_y, _ = own.position
        wanted_x, wanted_y = own.response * (goal[0] - here_x), own.response * (goal[1] - here_y)
        share = min(1.0, own.speed / max(sqrt(wanted_x * wanted_x + wanted_y * wanted_y), SLACK))
        wanted_x, wanted_y = wanted_x * share, wanted_y * share
        self.set_planes(own, near, self.steering)
        worst = most_violated(wanted_x, wanted_y, near)
        if worst < 0:
            return goal
        x, y = self.nearest(wanted_x, wanted_y, worst, own, near)
        return here_x + x / own.response, here_y + y / own.response, goal[2]

    def restrain(self, setpoint: Setpoint, own: OwnState, near: Nearby) -> Setpoint:
        if near.count == 0:
            return setpoint
        self.set_planes(own, near, 1.0)
        a, b, c, d = setpoint
        if own.by_twist:
            return along_heading(a, own, near), b, c, d
        here_x, here_y, _ = own.position
        wanted_x, wanted_y = a, b
        if own.by_position:
            wanted_x, wanted_y = own.response * (a - here_x), own.response * (b - here_y)
        worst = most_violated(wanted_x, wanted_y, near)
        if worst < 0:
            return setpoint
        x, y = self.nearest(wanted_x, wanted_y, worst, own, near)
        if own.by_position:
            x, y = here_x + x / own.response, here_y + y / own.response
        return x, y, c, d

    def set_planes(self, own: OwnState, near: Nearby, share: float) -> None:
        """Measure all things, and set their half-planes; this `share` of α is used toward robots.

        A bound that no speed of the robot reaches is none.
        """
        for k in range(near.count):
            thing, plane = near.things[k], near.planes[k]
            measure_gap(own, thing)
            plane.x, plane.y = -thing.away_x, -thing.away_y
            bound = self.bound(thing, share if thing.is_robot else 1.0)
            plane.b = bound if bound < HURRY * own.speed else inf

    def nearest(self, x: float, y: float, worst: int, own: OwnState, near: Nearby) -> Planar:
        """The velocity nearest to a wanted one x, y [m/s] that the half-planes allow, of which `worst` bars it most."""
        plane = near.planes[worst]
        side_x, side_y = self.evasion(near.things[worst], own)
        give = clamp(plane.x * x + plane.y * y - plane.b, 0.0, own.speed)
        return closest(x + give * side_x, y + give * side_y, own.speed, near)

    def evasion(self, thing: Thing, own: OwnState) -> Planar:
        """Evasion per m/s that a thing bars: to the right, seen toward the thing.

        One that comes faster than the robot can flee will not mind it: there it is the side of its way where the robot
        is.
        """
        x, y = -thing.away_x, -thing.away_y
        share = self.right
        if x * thing.velocity_x + y * thing.velocity_y < -own.speed:
            off = x * thing.velocity_y - y * thing.velocity_x  # > 0: the robot is left of its way
            if off < 0.0:
                share = -1.0
            elif off > 0.0:
                share = 1.0
        return share * y, -share * x


def most_violated(x: float, y: float, near: Nearby) -> int:
    """The half-plane that bars the velocity x, y [m/s] most; -1: none does."""
    worst, most = -1, SLACK
    planes = near.planes
    for k in range(near.count):
        plane = planes[k]
        over = plane.x * x + plane.y * y - plane.b
        if over > most:
            worst, most = k, over
    return worst


def along_heading(v: float, own: OwnState, near: Nearby) -> float:
    """The speed nearest to v [m/s] in the interval that all half-planes leave along the heading."""
    head_x, head_y = cos(own.yaw), sin(own.yaw)
    high, low = inf, -inf
    any_bars = False
    for k in range(near.count):
        plane = near.planes[k]
        bound, gain = plane.b, plane.x * head_x + plane.y * head_y
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


def closest(x: float, y: float, speed: float, near: Nearby) -> Planar:
    """Velocity nearest to x, y [m/s] among those within `speed` that obey all half-planes.

    If none obeys them, the nearest of all velocities that do is scaled down to `speed`. If there is none at all, bounds
    below 0 are raised together by as little as makes one obey; the other half-planes have standing still in common.
    """
    found_x, found_y, clash = solution(x, y, speed, near, 0.0)
    if clash < 0.0:
        return found_x, found_y
    raised, rounds = 0.0, 0
    found_x, found_y, clash = solution(x, y, inf, near, 0.0)
    while clash >= 0.0:
        raised, rounds = raised + clash + SLACK, rounds + 1
        if rounds > ROUNDS:
            return 0.0, 0.0  # absurd velocities, beyond the accuracy of numbers
        found_x, found_y, clash = solution(x, y, inf, near, raised)
    if raised > 0.0:
        within_x, within_y, clash = solution(x, y, speed, near, raised)
        if clash < 0.0:
            return within_x, within_y
    share = min(1.0, speed / max(sqrt(found_x * found_x + found_y * found_y), SLACK))
    return found_x * share, found_y * share


def solution(x: float, y: float, speed: float, near: Nearby, raised: float) -> Solution:
    """As `closest`, with bounds below 0 `raised` [m/s], or the further rise that clashing bounds need.

    One half-plane after the other is added. If the nearest point so far does not obey it, then the new one lies on its
    border, in the interval that those before it leave there (Seidel, Discrete & Computational Geometry 6, 1991).
    """
    planes, slack = near.planes, min(raised, SLACK)
    share = min(1.0, speed / max(sqrt(x * x + y * y), SLACK))
    u, v = x * share, y * share
    for k in range(near.count):
        plane = planes[k]
        p, q = plane.x, plane.y
        b = plane.b + (raised if plane.b < 0.0 else slack)
        if not p * u + q * v > b + SLACK:
            continue
        if not abs(b) <= speed:
            return u, v, 0.0
        high = inf if speed == inf else sqrt((speed - b) * (speed + b))
        low = -high
        above, below = k, k
        for j in range(k):
            other = planes[j]
            sine = p * other.y - q * other.x
            # along the border of the new one, from the point nearest to 0
            room = other.b + (raised if other.b < 0.0 else slack) - b * (p * other.x + q * other.y)
            if sine > PARALLEL:
                if room < high * sine:
                    high, above = room / sine, j
            elif sine < -PARALLEL:
                if room < low * sine:
                    low, below = room / sine, j
            elif room < 0.0 and p * other.x + q * other.y < 0.0:
                low, high = inf, -inf
                above, below = j, j
                break
        if low > high:
            return u, v, clash_of(plane, planes[below], planes[above], raised, slack)
        along = clamp(p * y - q * x, low, high)
        u, v = b * p - along * q, b * q + along * p
    return u, v, -1.0


def clash_of(first: Plane, second: Plane, third: Plane, raised: float, slack: float) -> float:
    """Further rise of the bounds below 0 until three half-planes have a common point [m/s].

    They have none if −Σ λ b > 0, where λ ≥ 0 are the weights with which their normals cancel out. Two that face each
    other come as three, of which two are one.
    """
    a, b, c = 0.5, 0.25, 0.25
    if second is not third:
        a = max(third.x * second.y - third.y * second.x, 0.0)
        b = max(first.x * third.y - first.y * third.x, 0.0)
        c = max(second.x * first.y - second.y * first.x, 0.0)
    over = -a * (first.b + (raised if first.b < 0.0 else slack))
    over -= b * (second.b + (raised if second.b < 0.0 else slack))
    over -= c * (third.b + (raised if third.b < 0.0 else slack))
    soft = (a if first.b < 0.0 else 0.0) + (b if second.b < 0.0 else 0.0) + (c if third.b < 0.0 else 0.0)
    return over / soft if over > 0.0 and soft > PARALLEL else 0.0
