"""Check of a robot's motion: it must move when commanded, and only then.

The commanded motion is that of the setpoint: the speed at which a body closes a position error, a velocity, or a twist
along the nose. It is added up on every tick, because a setpoint of slow decisions is large after each and small before
the next. Commanded and measured motion are compared over pieces of half a second, so that neither the rate of the
measured positions nor their resolution matters.

A turn of the wrong sign, or swapped wheels, need not lead far away. They show in the correlation of commanded and
measured motion, however slow. Commands that take effect late let a right body move against those of the moment, if they
alternate: only a body that moves against those of the piece before as well is wrong. A wind carries drones against
slow commands, so that their way is judged by its length alone. (`direction_check` finds mirrored ones.) Commands
against a steady wind do not count: a drone without an integral part leans against it, by an error of its place.

Quiet: all but `words`.
"""

from __future__ import annotations

from math import cos, inf, isfinite, nan, sin, sqrt
from typing import Final

from agents.body.kinds import Kind
from agents.ticks import ROUNDING_S
from agents.vectors import UNKNOWN, ZERO, Setpoint, Vector, clamp, difference, distance, dot, is_finite, norm, wrap

SAMPLE_S: Final = 0.1  # period in which the setpoints of all ticks are added up
MISSED_S: Final = 2.0 * SAMPLE_S  # time without a tick after which the commanded motion is unknown
PIECE: Final = 5  # samples of a comparison of commanded and measured motion
PIECE_S: Final = PIECE * SAMPLE_S
SLOW_FLIES, SLOW_WHEELS = 0.25, 0.1  # shares of a kind's speed: slower setpoints are no command to move
MOVES: Final = 0.2  # least share of the commanded travel that a robot moves
WITHOUT_S: Final = 1.5  # commanded travel without motion, in seconds at top speed, that counts as unresponsive,
LEAST_WITHOUT_S: Final = 2.0  # shortest time without motion that counts
FORGET_S: Final = 5.0  # time after which uncommanded motion is forgotten
KEPT: Final = 1.0 - PIECE_S / FORGET_S  # share of earlier uncommanded motion that a piece keeps
RUSH_S: Final = 0.5  # tolerated uncommanded travel, in seconds at top speed, besides the size of the robot
RESTS_S, MOVES_S = 1.0, 8.0  # time to learn a steady wind, of a drone that rests, and of one that moves
OUTSIDE_M: Final = 0.4  # [m] the same of robots that fly on board by positions from outside, which may ring
TURN: Final = 1.5  # tolerated uncommanded rotation of a wheeled robot [rad]
REMEMBER_S: Final = 10.0  # time after which the correlation forgets a piece
REMEMBERED: Final = 1.0 - PIECE_S / REMEMBER_S  # share of earlier pieces that a piece keeps
LEAST_WAY, LEAST_TURN = 0.03, 0.1  # least sums of squared commanded pieces [m²], [rad²]: smaller ones are noise
ALIKE: Final = 4.0  # largest ratio of the sums of measured and commanded squares: noise, a push or a wall
AGAINST: Final = -0.3  # correlation below which a robot moves against its commands
HALF_TURN: Final = 2.5  # [rad] faster turns of a piece have no certain sign


class MotionCheck:
    """Commanded and measured motion of one robot."""

    # more than CPython keeps beside an object: the tick would look each up in a dictionary
    __slots__ = (
        "anchor", "anchor_yaw", "before_turn", "before_x", "before_y", "begin", "begin_yaw", "by_position", "by_twist",
        "commanded", "commanded_s", "commanded_turn", "drift", "drifted", "due", "expected_turn", "expected_x",
        "expected_y", "flies", "follows", "free", "last", "late_turn", "late_x", "late_y", "push_x", "push_y",
        "response", "rim", "samples", "slow", "speed", "turn", "turn_before", "turned", "turned_asked",
        "turned_asked_before", "turned_both", "turned_both_before", "turns_against", "unanswered", "unanswered_turn",
        "uncommanded", "uncommanded_turn", "unresponsive", "way", "way_against", "way_asked", "way_asked_before",
        "way_before", "way_both", "way_both_before", "way_moved", "without", "x", "y", "z",
    )  # fmt: skip

    def __init__(self, kind: Kind, *, outside: bool = False) -> None:
        """`outside`: of a robot that flies on board by positions from outside."""
        self.flies, self.speed, self.response = kind.flies, kind.speed, kind.response
        self.by_position, self.by_twist = kind.takes == "position", kind.takes == "twist"
        self.follows = SAMPLE_S / (SAMPLE_S + kind.lag)  # share of a commanded change that a sample follows
        self.rim = 0.0 if kind.flies else kind.radius  # [m] turning moves wheels by it
        self.slow = (SLOW_FLIES if kind.flies else SLOW_WHEELS) * kind.speed  # slower: no command to move [m/s]
        # least commanded travel without motion that counts [m]
        self.without = WITHOUT_S * kind.speed * (1.0 if kind.flies else 0.5)
        # tolerated uncommanded travel [m]
        self.free = OUTSIDE_M if outside else RUSH_S * kind.speed + kind.radius
        self.last = self.due = -inf  # time of the last tick, and end of the sample [s]
        self.x = self.y = self.z = self.commanded_turn = 0.0  # commanded in this sample [m], [rad]
        self.samples = 0  # count of this piece
        self.forget(UNKNOWN, nan)

    def forget(self, position: Vector, yaw: float) -> None:
        """Restart at a `position` [m] and `yaw` [rad]."""
        self.unresponsive = False  # it does not obey commands to move
        self.uncommanded = False  # it moves without a command
        # commanded in this piece and in the one before [m], [rad]: a body is late and moves after its command has ended
        self.way = self.way_before = ZERO
        self.turn = self.turn_before = 0.0
        self.drift, self.drifted = ZERO, 0.0  # recent uncommanded travel [m], and its length [m]
        self.push_x = self.push_y = 0.0  # what a piece commands in vain, against a steady wind [m]
        self.uncommanded_turn = 0.0  # recent uncommanded rotation [rad]
        # commanded motion with the lag of the body, of the last sample and of the piece [m], [rad]
        self.late_x = self.late_y = self.late_turn = 0.0
        self.expected_x = self.expected_y = self.expected_turn = 0.0
        self.forget_sums()
        # commanded since its last motion: travel not moved [m], time less the pauses [s], way [m] and turn [rad]
        self.commanded = self.commanded_s = 0.0
        self.unanswered, self.unanswered_turn = ZERO, 0.0
        # pose at the begin of the piece, and at its last motion [m], [rad]; a place of which a part is unknown is none:
        # nothing would ever be nearer to it
        known = is_finite(position) and isfinite(yaw)
        self.begin = self.anchor = position if known else UNKNOWN
        self.begin_yaw = self.anchor_yaw = yaw

    def forget_sums(self) -> None:
        """Restart the correlation of commanded and measured motion."""
        self.way_against = self.turns_against = False  # it moves or turns against its commands
        self.before_x = self.before_y = self.before_turn = 0.0  # expected in the piece before [m], [rad]
        # sums over pieces: products of both, squares of commanded and of measured ones [m²], [rad²]
        self.way_both = self.way_asked = self.way_moved = 0.0
        self.turned_both = self.turned_asked = self.turned = 0.0
        # the same with what was commanded in the piece before
        self.way_both_before = self.way_asked_before = 0.0
        self.turned_both_before = self.turned_asked_before = 0.0

    def update(self, t: float, setpoint: Setpoint, position: Vector, yaw: float, watched: bool) -> None:
        """Add up the commanded motion, and compare at the end of each sample; call it on every tick, at `t` [s].

        `setpoint` is that of the tick before, NaN without one; `position` [m] and `yaw` [rad] are measured; a `watched`
        robot follows its setpoints and has a valid pose.
        """
        since = t - self.last
        self.last = t
        if since >= MISSED_S:  # too many ticks, or it is the first one
            self.end_sample(t)
            self.forget(position, yaw)
            return
        if self.by_position:
            x = self.response * (setpoint[0] - position[0])
            y = self.response * (setpoint[1] - position[1])
            z = self.response * (setpoint[2] - position[2])
            speed = sqrt(x * x + y * y + z * z)
            if speed <= self.speed:
                self.x += x * since
                self.y += y * since
                self.z += z * since
            elif speed < inf:  # setpoint and pose are known
                share = self.speed / speed
                self.x += x * share * since
                self.y += y * share * since
                self.z += z * share * since
        else:
            self.add(since, setpoint, yaw)
        if t >= self.due:
            self.compare(t, setpoint, position, yaw, watched)

    def add(self, since: float, setpoint: Setpoint, yaw: float) -> None:
        """Add the motion that a velocity or a twist commands in `since` [s]; none without a setpoint or a pose."""
        if self.by_twist:
            v, turn = setpoint[0], setpoint[1]
            if v != 0.0 and isfinite(v) and isfinite(yaw):
                self.x += cos(yaw) * v * since
                self.y += sin(yaw) * v * since
        else:
            turn = setpoint[3]
            if isfinite(setpoint[0]):
                self.x += setpoint[0] * since
            if isfinite(setpoint[1]):
                self.y += setpoint[1] * since
            if isfinite(setpoint[2]):
                self.z += setpoint[2] * since
        if isfinite(turn):
            self.commanded_turn += turn * since

    def compare(self, t: float, setpoint: Setpoint, position: Vector, yaw: float, watched: bool) -> None:
        """Compare commanded and measured motion at the end of a sample; without one of them the count restarts."""
        way, turn = (self.x, self.y, self.z), self.commanded_turn
        self.end_sample(t)
        commanded = isfinite(setpoint[0]) and isfinite(setpoint[1]) and isfinite(setpoint[2]) and isfinite(setpoint[3])
        known = is_finite(position) and isfinite(yaw)
        if not (watched and commanded and known) or self.begin[0] != self.begin[0]:
            self.forget(position, yaw)
            return
        before = self.way
        self.way = before[0] + way[0], before[1] + way[1], before[2] + way[2]
        self.turn += turn
        follows = self.follows
        self.late_x += follows * (way[0] - self.late_x)
        self.late_y += follows * (way[1] - self.late_y)
        self.late_turn += follows * (turn - self.late_turn)
        self.expected_x += self.late_x
        self.expected_y += self.late_y
        self.expected_turn += self.late_turn
        self.count_unresponsive(position, yaw, way, turn)
        self.samples += 1
        if self.samples >= PIECE:
            self.samples = 0
            self.count_uncommanded(position, yaw)

    def end_sample(self, t: float) -> None:
        self.due = t + SAMPLE_S - ROUNDING_S
        self.x = self.y = self.z = self.commanded_turn = 0.0

    def count_unresponsive(self, position: Vector, yaw: float, way: Vector, turn: float) -> None:
        """Add a commanded `way` [m] and `turn` [rad]; the count restarts after a motion."""
        rim = self.rim
        if norm(way) + rim * abs(turn) >= self.slow * SAMPLE_S:
            unanswered = self.unanswered
            self.unanswered = unanswered[0] + way[0], unanswered[1] + way[1], unanswered[2] + way[2]
            self.unanswered_turn += turn
            self.commanded_s += SAMPLE_S
        else:
            self.commanded_s -= SAMPLE_S  # a pause that was as long lets it be forgotten
        commanded = norm(self.unanswered) + rim * abs(self.unanswered_turn)  # motion to and fro is no way
        moved = distance(position, self.anchor) + rim * abs(wrap(yaw - self.anchor_yaw))
        if moved > MOVES * max(commanded, self.without) or self.commanded_s < 0.0:
            commanded = self.commanded_s = self.unanswered_turn = 0.0
            self.unanswered = ZERO
            self.anchor, self.anchor_yaw = position, yaw
        self.commanded = commanded
        self.unresponsive = commanded >= self.without and self.commanded_s >= LEAST_WITHOUT_S

    def count_uncommanded(self, position: Vector, yaw: float) -> None:
        """Add the motion beyond, against or aside of the commanded travel, in the piece that ends."""
        moved = difference(position, self.begin)
        x, y, z = self.way[0] + self.way_before[0], self.way[1] + self.way_before[1], self.way[2] + self.way_before[2]
        x, y = x - 2.0 * self.push_x, y - 2.0 * self.push_y
        length = sqrt(x * x + y * y + z * z)
        least = max(length, 1e-9)
        toward = x / least, y / least, z / least
        obeyed = clamp(dot(moved, toward), 0.0, length)
        if norm(moved) > 4.0 * self.speed * PIECE_S:
            # no robot is so fast: it was moved in the world, or its position comes from something else now
            self.drift, self.uncommanded_turn = ZERO, 0.0
            self.forget_sums()
        else:
            turned = wrap(yaw - self.begin_yaw)
            self.correlate(moved[0], moved[1], turned)
            drift = self.drift
            self.drift = (
                KEPT * drift[0] + moved[0] - obeyed * toward[0],
                KEPT * drift[1] + moved[1] - obeyed * toward[1],
                KEPT * drift[2] + moved[2] - obeyed * toward[2],
            )
            if self.flies:
                self.feel_wind(moved[0], moved[1])
            if self.by_twist:
                commanded = self.turn + self.turn_before
                stray = turned - clamp(turned, min(commanded, 0.0), max(commanded, 0.0))
                self.uncommanded_turn = KEPT * self.uncommanded_turn + stray
        self.drifted = norm(self.drift)
        self.uncommanded = (
            self.drifted > self.free
            or abs(self.uncommanded_turn) > TURN
            or self.turns_against
            or (self.way_against and not self.flies)
        )
        self.expected_x = self.expected_y = self.expected_turn = 0.0
        self.way_before, self.turn_before = self.way, self.turn
        self.way, self.turn = ZERO, 0.0
        self.begin, self.begin_yaw = position, yaw

    def feel_wind(self, x: float, y: float) -> None:
        """Learn what a piece with a motion of x, y [m] commanded in vain; no more than a slow command."""
        way_x, way_y = 0.5 * (self.way[0] + self.way_before[0]), 0.5 * (self.way[1] + self.way_before[1])
        vain_x, vain_y = way_x - x, way_y - y
        push_x, push_y = self.push_x, self.push_y
        fades = vain_x * vain_x + vain_y * vain_y < push_x * push_x + push_y * push_y
        if fades or vain_x * way_x + vain_y * way_y > 0.0:  # else it drifts
            rests = x * x + y * y < MOVES * MOVES * (way_x * way_x + way_y * way_y)
            share = PIECE_S / (RESTS_S if rests else MOVES_S)
            push_x, push_y = push_x + share * (vain_x - push_x), push_y + share * (vain_y - push_y)
            most = self.slow * PIECE_S
            less = most / max(sqrt(push_x * push_x + push_y * push_y), most)
            self.push_x, self.push_y = less * push_x, less * push_y

    def correlate(self, x: float, y: float, turned: float) -> None:
        """Correlate the measured motion of a piece, x, y [m] and `turned` [rad], with the commanded one."""
        x_now, y_now, now = self.expected_x, self.expected_y, self.expected_turn
        x_before, y_before, before = self.before_x, self.before_y, self.before_turn
        self.before_x, self.before_y, self.before_turn = x_now, y_now, now
        self.way_both = REMEMBERED * self.way_both + x_now * x + y_now * y
        self.way_asked = REMEMBERED * self.way_asked + x_now * x_now + y_now * y_now
        self.way_both_before = REMEMBERED * self.way_both_before + x_before * x + y_before * y
        self.way_asked_before = REMEMBERED * self.way_asked_before + x_before * x_before + y_before * y_before
        self.way_moved = REMEMBERED * self.way_moved + x * x + y * y
        self.way_against = opposed(self.way_both, self.way_asked, self.way_moved, LEAST_WAY) and opposed(
            self.way_both_before, self.way_asked_before, self.way_moved, LEAST_WAY
        )
        if abs(now) < HALF_TURN and abs(before) < HALF_TURN:
            self.turned_both = REMEMBERED * self.turned_both + now * turned
            self.turned_asked = REMEMBERED * self.turned_asked + now * now
            self.turned_both_before = REMEMBERED * self.turned_both_before + before * turned
            self.turned_asked_before = REMEMBERED * self.turned_asked_before + before * before
            self.turned = REMEMBERED * self.turned + turned * turned
        self.turns_against = opposed(self.turned_both, self.turned_asked, self.turned, LEAST_TURN) and opposed(
            self.turned_both_before, self.turned_asked_before, self.turned, LEAST_TURN
        )

    def words(self) -> str:
        """Extent of uncommanded motion, with its probable cause; rare."""
        if self.turns_against:
            return "it turns against its commands; is the sign of its turn wrong, are its wheels swapped?"
        if self.way_against:
            blown = ", or does a wind carry it" if self.flies else ""
            return f"{self.drifted:.2f} m lately, against its commands; are its axes swapped or mirrored{blown}?"
        return f"{self.drifted:.2f} m lately"


def opposed(both: float, asked: float, moved: float, least: float) -> bool:
    """Whether sums of products, of commanded and of measured squares show motion against the commands; not by noise."""
    alike = asked > least and asked < ALIKE * moved and moved < ALIKE * asked
    return alike and both < AGAINST * sqrt(asked * moved)
