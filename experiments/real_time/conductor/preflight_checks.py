"""Checks of one robot before the first flight, from what it said of itself: pure, with a remedy for each red one."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from typing import Final, Literal

import msgspec
import numpy as np

from agents.body.kinds import KINDS, Trial
from agents.body.limits import Safety, behind_limit_s
from agents.body.measured_positions import FROZEN
from agents.network import messages
from agents.plugins import registry
from agents.safety.detection import clock_off, clock_text
from agents.safety.preflight import FRAME, TURNED
from experiments.definition.bodies import driven_kind
from experiments.definition.experiment import WORLD, RobotTable
from experiments.definition.plan import latest_s
from experiments.real_time.conductor.run_view import AHEAD_S, BEHIND_S
from twins.arrays import Array

Verdict = Literal["ok", "warn", "bad", "unknown"]

HOP_M: Final = 0.2  # height of the hop
HOP_OFF_M: Final = 0.08  # farther from this height on average: bad
HELD: Final = 25  # last states of a hop, by which its height is measured
# a hop that goes farther to the side is bad, and ends there: of a drone of which the take-off ends at its hop,
HOP_ASIDE_M: Final = 0.1
HOP_DRIFT_M: Final = 0.2  # drift of one that climbs to a height of its own
DRIFTS: Final = f"yaw of its positions against its nose ({FRAME}), propellers, calibration of its IMU"  # remedy
SLOW: Final = "is slow: its filters, the network, a busy computer"  # remedy
SLOW_BEFORE: Final = f"motion capture {SLOW}; its stamps need not know of it"
DRIVE_M: Final = 0.1  # way of the drive of a robot on wheels
DRIVE_OFF_M: Final = 0.03  # farther from this way: bad
STEADY_M: Final = 0.02  # largest spread of the position of a robot at rest without a warning,
UNSTEADY_M: Final = 0.05  # noise with which it must not fly
HOP_LATE_S: Final = 0.1  # positions that a hop shows to be later are bad
STALE: Final = 0.5  # share of `position_timeout_s`: positions older than this at times are bad
OLD_MONTHS: Final = 24  # firmware older than this: a warning
STOP_S: Final = 1.0  # a stop that takes longer is bad
STOP_WAY_M: Final = 0.05  # a robot on wheels rolls no farther after a stop
RELEASE: Final = re.compile(r"(20\d\d)\.(\d{1,2})")  # numbers that Bitcraze gives


class Check(msgspec.Struct, frozen=True):
    """Check of a robot: verdict, reading and remedy."""

    check: str
    verdict: Verdict
    found: str
    remedy: str = ""  # remedy of a warning and of a bad one


class RobotChecks(msgspec.Struct, frozen=True):
    """The checks of one robot, in the order in which they are to be mended."""

    robot: str
    kind: str
    body: str  # address
    checks: list[Check]

    @property
    def red(self) -> bool:
        return any(check.verdict == "bad" for check in self.checks)


@dataclass
class Observed:
    """Reports of a robot about itself while it stood."""

    robot: RobotTable
    status: messages.Status | None = None  # the last one
    ended: str = ""  # last words of its process, if that has ended
    states: list[messages.State] = field(default_factory=list)
    inspections: list[messages.Inspection] = field(default_factory=list)
    behind_s: float = math.inf  # least time from a stamp of it to its arrival

    def yaw(self) -> float | None:
        """Mean measured yaw [rad]; None if it is not measured."""
        turned = [state.yaw for state in self.states if state.yaw is not None]
        return math.atan2(np.sin(turned).sum(), np.cos(turned).sum()) if turned else None

    @property
    def last(self) -> messages.Inspection:
        """Last inspection; an empty one if there was none."""
        return self.inspections[-1] if self.inspections else messages.Inspection()


@dataclass
class Tried:
    """Result of a hop, a drive or a stop."""

    failure: str = ""  # why it could not be tried, or what went wrong on the way
    over: bool = False  # it was over before the user, or an emergency stop, ended the checks
    stopped_s: float = math.nan  # time from the order to motors off
    states: list[messages.State] = field(default_factory=list)  # states since the order to move, or since that to stop
    volts: float | None = None  # lowest
    charge: float | None = None  # lowest
    delay_s: float | None = None  # delay of positions from outside
    note: str = ""  # note of the body, at the end


def positions_of(states: Sequence[messages.State]) -> Array:
    """Measured positions (n, 3) [m]."""
    return np.array([state.position for state in states if state.position is not None]).reshape(-1, 3)


def at_rest(observed: Mapping[str, Observed], safety: Safety, today: date) -> dict[str, list[Check]]:
    """Checks of robots that stand, by robot; some compare one robot with the others."""
    made = {name: [_address(each)] for name, each in observed.items()}
    for name, each in observed.items():
        if (status := each.status) is not None:  # else there is nothing to look at
            made[name] += [_firmware(name, observed, today), _battery(each, status, safety), _position(each, safety)]
            made[name] += [_start(name, observed, safety), _radio(each), _clock(name, each, safety), _ready(status)]
    return made


def _address(each: Observed) -> Check:
    kind = driven_kind(registry.body_name(each.robot.body))  # another body knows its robot better than we do
    remedy = (kind.connect if kind else "") or "is it switched on, and its address right?"
    if each.status is None:
        return Check("address", "bad", each.ended or "its process says nothing", remedy)
    silent = not len(positions_of(each.states)) and each.status.battery is None and each.last.firmware is None
    trouble = each.status.body
    if silent and trouble:
        return Check("address", "bad", trouble, remedy)
    if silent:
        return Check("address", "unknown", "it does not say whether it answers")
    if trouble:
        return Check("address", "warn", f"answers; {trouble}", "its bridge says so")
    return Check("address", "ok", "answers")


def _firmware(name: str, observed: Mapping[str, Observed], today: date) -> Check:
    each = observed[name]
    version = each.last.firmware
    if version is None:
        return _not_known("firmware", each)
    same = [other for other, seen in observed.items() if seen.robot.kind == each.robot.kind]
    other = next((o for o in same if observed[o].last.firmware not in (None, version)), None)
    found, remedy = version, ""
    if (release := RELEASE.match(version)) is not None:
        months = 12 * (today.year - int(release[1])) + today.month - int(release[2])
        found += f", {months} months old"
        if months > OLD_MONTHS:
            remedy = f"older than {OLD_MONTHS} months: flash the current release"
    if other is not None and not remedy:
        remedy = f"{other} has {observed[other].last.firmware}: flash the same to all of a kind"
    return Check("firmware", "warn" if remedy else "ok", found, remedy)


def _battery(each: Observed, status: messages.Status, safety: Safety) -> Check:
    charge, volts = status.battery, each.last.volts
    if charge is None and volts is None:
        return _not_known("battery", each)
    said = _charged(charge, volts)
    if charge is not None and charge < safety.battery_min:
        return Check("battery", "bad", f"{said}, less than {safety.battery_min:.0%}", KINDS[each.robot.kind].charge)
    return Check("battery", "ok", f"{said} at rest")


def _charged(charge: float | None, volts: float | None) -> str:
    known = ("" if charge is None else f"{charge:.0%}", "" if volts is None else f"{volts:.2f} V")
    return ", ".join(filter(None, known))


def _position(each: Observed, safety: Safety) -> Check:
    positions = positions_of(each.states)
    source = "motion capture" if each.robot.position == "external" else "its positioning system"
    frozen = f"{source} is frozen: is it live, and not paused? It must not fly by that"
    if each.status is not None and FROZEN in each.status.body:
        return Check("position", "bad", FROZEN, frozen)
    if not len(positions):
        remedy = f"does {source} see it where it stands? `./zenpark echo 'park/*/position'`"
        return Check("position", "bad", "none", remedy)
    spread = float(positions.std(axis=0).max())
    captured = each.robot.position == "external" and registry.body_name(each.robot.body) != WORLD
    if captured and len(positions) > 1 and not np.ptp(positions, axis=0).any():
        return Check("position", "bad", "the same to the last bit, which no measurement is", frozen)
    ages = [seen.age_s for seen in each.inspections if seen.age_s is not None]
    age = f"at most {1e3 * max(ages):.0f} ms old" if ages else "of unknown age"
    found = f"spread {1e3 * spread:.1f} mm, {age}"
    delay = float(np.median([-seen.ahead_s for seen in each.inspections if seen.ahead_s is not None] or [0.0]))
    late = delay > behind_limit_s(safety, latest_s(each.robot))
    if late or (ages and max(ages) > STALE * safety.position_timeout_s):
        remedy = f"gaps in {source}: markers or stations hidden, network or radio overloaded"
        if late:
            found += f", {1e3 * delay:.0f} ms late"
            remedy = f"{source} {SLOW}; two clocks that differ look the same"
        return Check("position", "bad", found, remedy)
    if spread > STEADY_M:
        remedy = f"{source} is unsteady for a robot at rest: calibrate it, remove reflections, look for lost markers"
        return Check("position", "bad" if spread > UNSTEADY_M else "warn", found, remedy)
    return Check("position", "ok" if ages else "unknown", found)


def _start(name: str, observed: Mapping[str, Observed], safety: Safety) -> Check:
    each = observed[name]
    positions = positions_of(each.states)
    if not len(positions):
        return _not_known("start pose", each)
    here = np.median(positions[:, :2], axis=0)
    away = _distance(here, each.robot)
    yaw, wanted = each.yaw(), each.robot.start[2] if len(each.robot.start) > 2 else None
    turned = None if yaw is None or wanted is None else math.remainder(yaw - wanted, math.tau)
    said = f"{away:.2f} m from `start`" + ("" if turned is None else f", turned by {math.degrees(turned):.0f}°")
    nearer = min(observed, key=lambda other: _distance(here, observed[other].robot))
    if _distance(here, observed[nearer].robot) < min(away, safety.start_within):
        remedy = f"it stands where {nearer} begins: addresses, markers or robots are swapped"
        return Check("start pose", "bad", said, remedy)
    if safety.start_within and away > safety.start_within:
        remedy = (
            f"put it at ({each.robot.start[0]:g}, {each.robot.start[1]:g}) m, or correct `start`; its positioning "
            "system may have another origin"
        )
        return Check("start pose", "bad", said, remedy)
    if turned is not None and abs(turned) > TURNED:
        frame = f"if its nose is right, {FRAME}; else " if each.robot.position == "external" else ""
        return Check("start pose", "bad", said, f"{frame}turn it to {wanted:g} rad, or correct `start`")
    if _counts_from_start(each.robot):
        return Check("start pose", "unknown", "counts from `start`")
    return Check("start pose", "ok", said)


def _counts_from_start(robot: RobotTable) -> bool:
    """Whether a real robot, or its protocol twin, measures its way only: it is at its `start` wherever it stands."""
    if robot.position == "external" or driven_kind(registry.body_name(robot.body)) is None:
        return False
    return robot.hover is None or not robot.device.get("positioning")


def _distance(here: Array, robot: RobotTable) -> float:
    return math.dist(here.tolist(), robot.start[:2])


def _radio(each: Observed) -> Check:
    asked, carried = each.last.packets_hz, each.last.capacity_hz
    if asked is None or carried is None:
        return Check("radio", "unknown", "no shared radio")
    found = f"{asked:.0f} of {carried:.0f} packets/s"
    if asked > carried:
        return Check("radio", "bad", found, "lower stream_hz and log_hz, or plug in another radio for some robots")
    return Check("radio", "ok", found)


def _clock(name: str, each: Observed, safety: Safety) -> Check:
    if each.behind_s == math.inf:
        return _not_known("clock", each)
    if not AHEAD_S < each.behind_s < BEHIND_S:
        found = f"its computer's is {-each.behind_s:+.2f} s off"
        return Check("clock", "bad", found, "set it (chrony or NTP), or use [hosts]")
    ahead = math.nan if each.last.ahead_s is None else each.last.ahead_s
    if clock_off(ahead, behind_limit_s(safety, latest_s(each.robot))):
        return Check("clock", "bad", clock_text(name, ahead), "set the clock of the computer that measures positions")
    return Check("clock", "ok", f"{1e3 * each.behind_s:.1f} ms from stamp to arrival")


def _ready(status: messages.Status) -> Check:
    """Conditions of take-off, as the robot's own process checks them in a run (`agents.safety.preflight`)."""
    if status.phase == "ready":
        return Check("ready", "ok", "yes")
    why = status.reason or f"it is {status.phase}"
    return Check("ready", "bad", why, "docs/safety.md, section `Before take-off`, has every condition")


def stop_in_motion(observed: Observed, tried: Tried) -> Check:
    """Emergency stop of a drone that begins to climb, or of a robot that drives."""
    check = stop("stop, motors on", tried)
    positions = positions_of(tried.states)
    way = float(np.linalg.norm(positions - positions[:1], axis=1).max(initial=0.0))
    if check.verdict == "ok" and observed.robot.hover is None and way > STOP_WAY_M:
        remedy = "lower its speed; do its brakes and wheels hold?"
        return Check(check.check, "bad", f"rolled on for {way:.2f} m", remedy)
    if check.verdict == "ok" and KINDS[observed.robot.kind].locks:
        return msgspec.structs.replace(check, found=f"{check.found}; locked until it is switched off and on")
    return check


def stop_at_rest(robot: RobotTable, tried: Tried) -> Check:
    check = stop("stop, motors off", tried)
    kind = driven_kind(registry.body_name(robot.body))
    if check.verdict == "ok" and kind is not None and kind.locks:
        return Check(check.check, "unknown", "not tried: --stop tries it")
    return check


def stop(what: str, tried: Tried) -> Check:
    """Emergency stop: order accepted, motors off."""
    remedy = "do not fly it: end its other clients, look at its log, and keep a hand on its switch"
    if tried.failure:
        return Check(what, "bad", tried.failure, remedy)
    if not tried.stopped_s <= STOP_S:
        took = f"not in {STOP_S:g} s" if math.isnan(tried.stopped_s) else f"after {tried.stopped_s:.2f} s"
        return Check(what, "bad", f"motors off {took}" + (f": {tried.note}" if tried.note else ""), remedy)
    return Check(what, "ok", f"after {tried.stopped_s:.2f} s")


def hop(observed: Observed, tried: Tried, safety: Safety) -> Check:
    """Hop of a drone to its `hover`, or drive of a robot on wheels by `DRIVE_M`; the battery under load."""
    what = hop_of(observed.robot)
    load = _charged(tried.charge, tried.volts)
    loaded = _delayed(observed.robot, tried) + (f"; battery {load} under load" if load else "")
    slow = SLOW_BEFORE if (tried.delay_s or 0.0) > HOP_LATE_S else ""
    positions = positions_of(tried.states)
    if tried.failure:
        strays = what == "hop" and aside(tried.states) > hop_limit(observed.robot)
        remedy = DRIFTS if strays else "look at its log; do not fly it before the cause is clear"
        return Check(what, "bad", tried.failure + loaded, slow or remedy)
    if not len(positions):
        return Check(what, "bad", "its position was not known", "see the line on its position")
    side, remedy = aside(tried.states), slow
    if what == "drive":
        said = f"{side:.3f} m of {DRIVE_M:g} m{loaded}"
        if side < DRIVE_OFF_M:
            remedy = "does not drive although commanded to: motors on, wheels free, server and message type right?"
        elif abs(side - DRIVE_M) > DRIVE_OFF_M:
            remedy = "its speed is not the commanded one: units and wheel sizes of its server, slipping wheels"
    else:
        wanted = observed.robot.hover or HOP_M
        height = float(np.median(positions[-HELD:, 2]) - positions[0, 2])
        said = f"{height:.2f} m of {wanted:g} m high, {side:.2f} m to the side{loaded}"
        if not slow and abs(height - wanted) > HOP_OFF_M:
            remedy = "does not keep its height: propellers, battery, trim, height of its positioning system"
        elif not slow and side > hop_limit(observed.robot):
            remedy = DRIFTS
    if not remedy and tried.charge is not None and tried.charge < safety.battery_low:
        return Check(what, "bad", said, KINDS[observed.robot.kind].charge)
    return Check(what, "bad" if remedy else "ok", said, remedy)


def _delayed(robot: RobotTable, tried: Tried) -> str:
    """Delay of the positions from outside by which a drone flies on board, empty where there are none."""
    if tried.delay_s is not None:
        return f", positions {1e3 * tried.delay_s:.0f} ms late"
    return "" if tried.failure or math.isinf(latest_s(robot)) else ", delay of positions unknown"


def aside(states: Sequence[messages.State]) -> float:
    """Largest distance from the first position, seen from above [m]."""
    positions = positions_of(states)
    return float(np.hypot(*(positions[:, :2] - positions[:1, :2]).T).max(initial=0.0))


def hop_limit(robot: RobotTable) -> float:
    """Distance to the side at which a hop ends [m]."""
    return HOP_DRIFT_M if math.isfinite(KINDS[robot.kind].takeoff_height) else HOP_ASIDE_M


def hop_of(robot: RobotTable) -> Literal["hop", "drive"]:
    """Counterpart of a drone's hop for this robot."""
    return "drive" if robot.hover is None else "hop"


def trial(asked: Trial, observed: Observed, tried: Tried) -> Check:
    judge = registry.find(asked.judge, f"trial {asked.name}")
    found, remedy = judge(tried.states, tried.failure, observed.robot.device)
    return Check(asked.name, "bad" if remedy else "ok", found, remedy)


def _not_known(check: str, each: Observed) -> Check:
    return Check(check, "unknown", f"not known by a {each.robot.kind} at {each.robot.body}")
