"""A control barrier function: the least change of the commanded velocities that keeps robots from touching things."""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from msgspec import Meta

from agents.arrays import Array, Index, Mask, NotNegative, Positive, clamp, every, norm, some
from agents.plugins.avoidance import Avoidance, Nearby, OwnState

SECTORS: Final = 8  # of what surrounds a robot; the tightest half-plane of each takes part in the exact solution
SLACK: Final = 1e-9  # [m/s] violations smaller than this are arithmetic
PARALLEL: Final = 1e-9  # sine of the angle below which two half-planes have no corner
SKEW: Final = 0.2  # a robot on wheels hardly flees along a heading this far (its cosine) from broadside
LEAST: Final = 1e-100  # to divide by: beyond any speed, and still a number


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

    def bounds(self, own: OwnState, near: Nearby, share: Array | float = 1.0) -> tuple[Array, Array]:
        """The half-planes a·u ≤ b that the commanded velocities must obey: unit vectors a (K, 2), b (K,) [m/s].

        `share` (K,) of α is used.
        """
        away, gap = near.gaps(own)
        left = gap - self.margin
        coming = np.maximum(np.vecdot(away, near.velocity), 0.0)
        used = self.alpha * share * left
        return -away, np.minimum(np.where(left > 0.0, 0.5 * used, used), used - coming)

    def deviate(self, goal: Array, own: OwnState, near: Nearby, period: float) -> Array:
        """Steer robots that cannot move sideways."""
        if not len(near):
            return goal
        mine = own.by_twist[near.row]
        if not some(mine):
            return goal
        near = near if every(mine) else near.take(mine)
        here, response = own.position[:, :2], own.response[:, None]
        wanted = response * (goal[:, :2] - here)
        wanted *= np.minimum(1.0, own.speed / np.maximum(norm(wanted), SLACK))[:, None]
        share = np.where(near.is_robot, self.steering, 1.0)
        rows, allowed = self._nearest(wanted, own, near, *self.bounds(own, near, share))
        if not len(rows):
            return goal
        steered = goal.copy()
        steered[rows, :2] = here[rows] + allowed / response[rows]
        return steered

    def restrain(self, setpoint: Array, own: OwnState, near: Nearby) -> Array:
        if not len(near):
            return setpoint
        twist = own.by_twist[near.row]
        driving = some(twist)
        if driving and every(twist):
            return self._along_heading(setpoint, own, near)
        others = near.take(~twist) if driving else near
        restrained = self._along_heading(setpoint, own, near.take(twist)) if driving else setpoint
        response, here = own.response[:, None], own.position[:, :2]
        aims = own.by_position[:, None]
        wanted = np.where(aims, response * (setpoint[:, :2] - here), setpoint[:, :2])
        rows, allowed = self._nearest(wanted, own, others, *self.bounds(own, others))
        if len(rows):
            restrained = restrained.copy() if restrained is setpoint else restrained
            restrained[rows, :2] = np.where(aims[rows], here[rows] + allowed / response[rows], allowed)
        return restrained

    def _nearest(self, wanted: Array, own: OwnState, near: Nearby, normal: Array, bound: Array) -> tuple[Index, Array]:
        """Rows (M,) whose `wanted` velocity (N, 2) the half-planes do not allow, and what they do (M, 2) [m/s]."""
        excess = np.vecdot(normal, wanted[near.row]) - bound
        barred = excess > SLACK
        if not some(barred):
            return near.row[:0], wanted[:0]
        rows = np.unique(near.row[barred])
        matters = np.zeros(len(wanted), dtype=bool)
        matters[rows] = True
        limit = own.speed[near.row]
        taking = matters[near.row] & ((bound < limit) | barred)
        aside = self._evasion(own, near, normal)[taking]
        normal, bound, excess, of = normal[taking], bound[taking], excess[taking], near.row[taking]
        place = np.searchsorted(rows, of)
        order = np.lexsort((-excess, place))
        worst = order[np.flatnonzero(np.diff(place[order], prepend=-1))]  # what bars each row most
        velocity = wanted[rows] + np.clip(excess, 0.0, limit[taking])[worst, None] * aside[worst]
        chosen, tightest = _tightest(normal, bound, place, len(rows))
        velocity = _closest(velocity, chosen, tightest)
        return rows, _scaled(velocity, own.speed[rows], normal, bound, place)

    def _evasion(self, own: OwnState, near: Nearby, normal: Array) -> Array:
        """Evasion of each row, per m/s that a thing bars (K, 2): to its right, seen toward the thing.

        One that comes faster than the row can flee will not mind it: there it is the side of its way where the row is.
        """
        x, y = normal[:, 0], normal[:, 1]
        share = np.full(len(x), self.right)
        fast = np.vecdot(normal, near.velocity) < -own.speed[near.row]
        if some(fast):
            off = x * near.velocity[:, 1] - y * near.velocity[:, 0]  # > 0: the row is left of its way
            share[fast & (off < 0.0)] = -1.0
            share[fast & (off > 0.0)] = 1.0
        return share[:, None] * np.stack([y, -x], axis=1)

    def _along_heading(self, setpoint: Array, own: OwnState, near: Nearby) -> Array:
        """The speeds of twists (N, 4) within the interval that all half-planes leave along the heading."""
        row = near.row
        normal, bound = self.bounds(own, near)
        heading = np.stack([np.cos(own.yaw), np.sin(own.yaw)], axis=1)
        gain = np.vecdot(normal, heading[row])
        barred = gain * setpoint[row, 0] > bound + SLACK
        if not some(barred):
            return setpoint
        # where standing still is allowed the limit is exact; where it is not, a robot that stands broadside to what it
        # should flee from must not be driven at full speed for next to nothing
        stands = bound >= 0.0
        safe = np.copysign(np.maximum(np.abs(gain), LEAST), gain)
        limit = np.where(stands, bound / safe, bound * gain / (gain**2 + SKEW**2))
        high, low = np.full(len(own.yaw), np.inf), np.full(len(own.yaw), -np.inf)
        ahead, behind = gain > 0.0, gain < 0.0
        np.minimum.at(high, row[ahead], limit[ahead])
        np.maximum.at(low, row[behind], limit[behind])
        v = clamp(setpoint[:, 0], low, high)
        torn = low > high  # it should go both ways: only as far as what is not touched yet allows
        if some(torn):
            v = np.where(torn, np.where(high >= 0.0, high, np.where(low <= 0.0, low, 0.0)), v)
        rows = np.unique(row[barred])
        restrained = setpoint.copy()
        restrained[rows, 0] = clamp(v[rows], -own.speed[rows], own.speed[rows])
        return restrained


def _tightest(normal: Array, bound: Array, place: Index, rows: int) -> tuple[Array, Array]:
    """The half-plane of the smallest bound in each sector of each row: (M, L, 2) and (M, L), filled up with 0·u ≤ 0."""
    sector = np.floor((np.arctan2(normal[:, 1], normal[:, 0]) / np.pi + 1.0) * (0.5 * SECTORS)).astype(np.intp)
    key = place * (SECTORS + 1) + sector  # exactly π falls into a sector of its own
    order = np.lexsort((bound, key))
    first = order[np.flatnonzero(np.diff(key[order], prepend=-1))]
    of = place[first]
    begin = np.searchsorted(of, np.arange(rows))
    slot = np.arange(len(of)) - begin[of]
    width = int(slot.max(initial=0)) + 1
    chosen, tightest = np.zeros((rows, width, 2)), np.zeros((rows, width))
    chosen[of, slot], tightest[of, slot] = normal[first], bound[first]
    return chosen, tightest


def _closest(wanted: Array, normal: Array, bound: Array) -> Array:
    """The points (M, 2) nearest to `wanted` (M, 2) with a_k·u ≤ b_k for all of normal (M, L, 2), bound (M, L).

    The solution of this quadratic program is `wanted` itself, or its projection onto one line, or a corner of two: all
    are tried. Where no point obeys all, the bounds are raised together by as little as makes one do.
    """
    nearest, solved = _candidate(wanted, normal, bound)
    if not every(solved):
        rows = np.flatnonzero(~solved)
        nearest[rows] = _least_violation(wanted[rows], normal[rows], bound[rows])
    return nearest


def _candidate(wanted: Array, normal: Array, bound: Array) -> tuple[Array, Mask]:
    """As `_closest`; rows whose half-planes have nothing in common are not solved (M,)."""
    over = np.vecdot(normal, wanted[:, None]) - bound
    onto = wanted[:, None] - np.maximum(over, 0.0)[..., None] * normal
    tried = [wanted[:, None], onto]
    apart = np.ones((len(wanted), 1 + onto.shape[1]), dtype=bool)
    if onto.shape[1] > 1:
        sides = np.arange(onto.shape[1])
        i, j = np.nonzero(sides[:, None] < sides)
        x, y = normal[..., 0], normal[..., 1]
        sine = x[:, i] * y[:, j] - y[:, i] * x[:, j]
        crosses = np.abs(sine) > PARALLEL
        sine = np.where(crosses, sine, 1.0)
        corner_x = (bound[:, i] * y[:, j] - bound[:, j] * y[:, i]) / sine
        corner_y = (x[:, i] * bound[:, j] - x[:, j] * bound[:, i]) / sine
        tried.append(np.stack([corner_x, corner_y], axis=2))
        apart = np.concatenate([apart, crosses], axis=1)
    points = np.concatenate(tried, axis=1)  # (M, C, 2)
    # written out: a matrix product would round by how many there are
    reached = points[:, :, None, 0] * normal[:, None, :, 0] + points[:, :, None, 1] * normal[:, None, :, 1]
    obeys = (reached <= bound[:, None] + SLACK).all(axis=2) & apart
    change = points - wanted[:, None]
    cost = np.where(obeys, np.vecdot(change, change), np.inf)
    best = cost.argmin(axis=1)
    every_row = np.arange(len(wanted))
    return points[every_row, best], np.isfinite(cost[every_row, best])


def _least_violation(wanted: Array, normal: Array, bound: Array) -> Array:
    """The points (M, 2) that violate the most violated half-plane as little as can be.

    By Helly's theorem three half-planes settle how far all bounds must be raised: by −Σ λ b, where λ ≥ 0 are the
    weights (Σ λ = 1) with which their normals cancel out; or two that face each other.
    """
    sides = np.arange(normal.shape[1])
    i, j = np.nonzero(sides[:, None] < sides)
    x, y = normal[..., 0], normal[..., 1]
    sine, cosine = x[:, i] * y[:, j] - y[:, i] * x[:, j], x[:, i] * x[:, j] + y[:, i] * y[:, j]
    facing = (np.abs(sine) <= PARALLEL) & (cosine < 0.0)
    raised = np.where(facing, -0.5 * (bound[:, i] + bound[:, j]), 0.0).max(axis=1, initial=0.0)  # one alone: no pair
    i, j, k = np.nonzero((sides[:, None, None] < sides[:, None]) & (sides[:, None] < sides))
    if len(i):
        weights = np.stack(
            [
                x[:, j] * y[:, k] - y[:, j] * x[:, k],
                x[:, k] * y[:, i] - y[:, k] * x[:, i],
                x[:, i] * y[:, j] - y[:, i] * x[:, j],
            ]
        )
        total = weights[0] + weights[1] + weights[2]
        cancel = ((weights >= 0.0).all(axis=0) | (weights <= 0.0).all(axis=0)) & (np.abs(total) > PARALLEL)
        sums = weights[0] * bound[:, i] + weights[1] * bound[:, j] + weights[2] * bound[:, k]
        violation = np.where(cancel, -sums / np.where(cancel, total, 1.0), 0.0)
        raised = np.maximum(raised, violation.max(axis=1))
    nearest, solved = _candidate(wanted, normal, bound + (raised + SLACK)[:, None])
    return np.where(solved[:, None], nearest, 0.0)  # two that nearly face each other may have no corner in reach


def _scaled(velocity: Array, speed: Array, normal: Array, bound: Array, place: Index) -> Array:
    """Velocities (M, 2) made so much smaller that none breaks a limit, or a half-plane that standing still obeys."""
    share = np.minimum(1.0, speed / np.maximum(norm(velocity), SLACK))
    reached = np.vecdot(normal, velocity[place]) * share[place]
    over = (reached > bound + SLACK) & (bound >= 0.0)
    if some(over):
        np.minimum.at(share, place[over], (share[place] * bound / np.where(over, reached, 1.0))[over])
    return velocity * share[:, None]
