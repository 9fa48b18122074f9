"""Flying one Crazyflie, against a link and a clock made by hand: what is sent when answers are lost."""

import math
import threading
import types
from collections import Counter
from itertools import count

import numpy as np
import pytest

from agents.body.interface import UNANSWERED
from agents.protocols import crtp
from agents.protocols.crazyflie import CrazyflieSettings
from agents.protocols.crtp import HighLevel, Info, LogStatus, Port
from agents.safety.detection import LOWEST_DESCENT_M_S
from agents.vectors import ZERO
from bridges.crazyflie import flight as module
from bridges.crazyflie import pilot
from bridges.crazyflie.flight import FlightControl, FlightPhase
from bridges.crazyflie.telemetry import Telemetry
from bridges.crazyflie.trajectory import HOLD_S, SINK, TAKEOFFS, TrajectoryMemory
from tests.bridges.crazyflie_clock import clocked
from tests.waiting import ManualClock, until

PLACE = (0.1, 0.2, 0.5, 0.0)


class Air(ManualClock):
    """A clock, and a Crazyflie that notes what is sent and when; no answer ever comes from it."""

    def __init__(self, monkeypatch):
        super().__init__(100.0)
        clocked(monkeypatch, self)
        self.sent, self.replies, self.written = [], {}, 0
        self.target = lambda: PLACE  # of the robot's loop; None: it does not command
        self.telemetry = Telemetry(lighthouse=False)
        self.flight = FlightControl(CrazyflieSettings(), self.telemetry, lambda seconds: self.sleep(seconds))  # noqa: PLW0108
        self.flight.link = types.SimpleNamespace(
            cf=self,
            error=None,
            busy=False,
            planner_reply=lambda command: self.replies.get(command, (0, 0)),
            trajectories=TrajectoryMemory(self.wire),
        )
        self.supervisor = self.commander = self.high_level_commander = self
        self.flying, self.info = True, Info.ARMED | Info.CAN_FLY

    def __getattr__(self, what):
        if what.startswith("_"):
            raise AttributeError(what)
        return lambda *_args, **_named: self.sent.append((self.now, what))

    def wire(self, port, channel, data):
        """Notes starts of trajectories, and confirms what is written."""
        trajectories = self.flight.link.trajectories
        if port == Port.MEMORY:
            self.written += 1
            trajectories.note_answer(crtp.MEMORY.unpack_from(data)[1], 0)
        elif data[0] == HighLevel.START_2:
            self.sent.append((self.now, "climb" if data[5] in TAKEOFFS else "setpoint"))

    def stand(self, *, info=Info.ARMED | Info.CAN_FLY):
        """On the ground, its position known."""
        self.telemetry.settled, self.telemetry.pose = True, (0.0,) * 7
        self.flying, self.info = False, info
        return self.pass_(0.1)

    def fly(self):
        self.telemetry.settled, self.telemetry.pose = True, (0.1, 0.2, 0.5, *[0.0] * 4)
        self.flight.enter(FlightPhase.CLIMBING)
        return self.pass_(0.1)

    def pass_(self, seconds):
        """As the pilot's thread goes round, its loop commanding."""
        end = self.now + seconds
        while self.now < end:
            self.now += 0.02
            self.telemetry.status_time = self.telemetry.pose_time = self.telemetry.arrival = self.now
            self.telemetry.info = self.info | (Info.FLYING if self.flying else 0)
            if self.target is not None:
                self.flight.set_target(self.now, self.target())
            self.flight.update_phase(self.now)
            self.flight.send_due(self.now)
        return self

    def times(self, what, since=-math.inf):
        return [at for at, sent in self.sent if sent == what and at > since]

    def during(self, seconds):
        """How often each thing is sent in the next seconds."""
        self.sent.clear()
        self.pass_(seconds)
        return Counter(what for _, what in self.sent)

    @property
    def phase(self):
        return self.flight.phase


@pytest.fixture
def air(monkeypatch):
    return Air(monkeypatch).fly()


@pytest.fixture
def grounded(monkeypatch):
    return Air(monkeypatch).stand()


def sweep(*places):
    """Targets with these x [m], one after the other."""
    endless = (places[k % len(places)] for k in count())
    return lambda: (next(endless), *PLACE[1:])


# ---------------------------------------------------------------------- take-off


def test_a_take_off_without_an_answer_goes_on(grounded):
    grounded.flight.takeoff(0.5)
    assert grounded.phase is FlightPhase.CLIMBING
    assert grounded.pass_(1.0).flight.trouble == ""
    assert grounded.pass_(3.0).phase is FlightPhase.GROUND
    assert grounded.flight.trouble == "its motors do not turn"


def test_end_of_climb_is_held_until_first_setpoint(grounded):
    """By the robot's loop, which may wait for others; without it, the drone is landed."""
    grounded.flight.takeoff(0.5)
    grounded.flying, grounded.target = True, lambda: None
    assert grounded.pass_(6.0).phase is FlightPhase.CLIMBING
    held = grounded.times("setpoint")
    assert held[0] - grounded.times("climb")[-1] < 1.5 + HOLD_S
    assert np.diff(held).max() < 0.5 * HOLD_S
    grounded.target = None
    assert grounded.pass_(2.0).phase is FlightPhase.LANDING


def test_no_take_off_with_a_wrong_yaw(air):
    """The decision turns by the yaw from outside, the firmware by its own."""
    air.flight.note_external(0.0, 0.3)
    assert air.flight.takeoff_refusal() == ""
    air.flight.note_external(0.0, 0.5 + math.tau)
    assert "its own yaw is 29° beside" in air.flight.takeoff_refusal()


@pytest.mark.parametrize("info", [Info.CRASHED, Info.TUMBLED])
def test_crashed_drone_is_not_recovered_by_take_off(monkeypatch, info):
    air = Air(monkeypatch).stand(info=Info.ARMED | info)
    air.flight.takeoff(0.5)
    assert (air.phase, air.sent) == (FlightPhase.GROUND, [])
    assert "no take-off" in air.flight.trouble


def test_armed_is_not_yet_able_to_fly(monkeypatch):
    """Motors that are checked after arming: no take-off before the supervisor permits it, and one request to arm."""
    air = Air(monkeypatch).stand(info=Info.ARMED)

    def spun_up(seconds):
        air.now += seconds
        if air.now > 101.5:
            air.telemetry.info = Info.ARMED | Info.CAN_FLY

    air.sleep = spun_up
    air.flight.takeoff(0.5)
    assert air.phase is FlightPhase.CLIMBING
    assert min(air.times("climb")) > 101.5
    assert air.times("send_arming_request") == []


@pytest.mark.parametrize("order", ["stop", "land"])
def test_order_while_arming_disarms(monkeypatch, order):
    """The order is repeated until the status confirms it."""
    air = Air(monkeypatch).stand(info=Info(0))

    def replaced(seconds):
        air.now += seconds
        if air.times("send_arming_request"):
            raise RuntimeError

    air.sleep = replaced
    with pytest.raises(RuntimeError):
        air.flight.takeoff(0.5)
    del air.sleep
    air.info = Info.ARMED
    air.sent.clear()
    getattr(air.flight, order)()
    air.pass_(1.0)
    assert {what for _, what in air.sent} == {"send_arming_request"}
    assert 4 < len(air.sent) < 10
    air.info = Info(0)
    assert air.during(1.0) == {}


# ---------------------------------------------------------------------- setpoints


def test_constant_setpoint_is_repeated_in_time(air):
    """Before the descent behind it begins; one that changes is sent at the rate of setpoints."""
    assert np.diff(air.pass_(2.0).times("setpoint")[3:]).max() < 0.5 * HOLD_S
    air.target = sweep(*np.linspace(0.2, 0.8, 1000))
    assert 15 < air.during(2.0)["setpoint"] < 25
    air.target = sweep(0.1, 0.1004)  # below the wire's resolution: no change
    assert air.during(2.0)["setpoint"] < 10


def test_slow_radio_gets_rarer_setpoints_held_longer(air):
    air.flight.scale_setpoints(0.1)
    air.target = sweep(*np.linspace(0.2, 0.8, 1000))
    begin = air.now
    gaps = np.diff(air.pass_(4.0).times("setpoint", since=begin))
    assert gaps.min() > 0.9 / module.SLOWEST_HZ
    assert gaps.max() < 0.5 * air.flight.hold_s


def test_setpoints_of_others_end_in_flight(air):
    """Before a start: at once where the drone reports that it follows no plan, else every second."""
    air.telemetry.reports_plans, air.info = True, air.info | Info.PLANNER_ACTIVE
    assert 1 <= len(air.pass_(2.0).times("send_notify_setpoint_stop")) <= 3
    air.info &= ~Info.PLANNER_ACTIVE
    air.pass_(0.1)
    found = air.during(0.5)
    assert [what for _, what in air.sent][:2] == ["send_notify_setpoint_stop", "setpoint"]
    assert found["send_notify_setpoint_stop"] == found["setpoint"]


def test_stalled_process_sends_no_stale_setpoint(air):
    """Between the choice of a setpoint and its start, too; then the robot's loop has been silent, and it lands."""
    air.sent.clear()
    chosen = air.now
    air.now += 3.0
    air.flight.stream(chosen + 0.2)
    assert air.sent == []
    air.flight.send_due(air.now)
    assert {what for _, what in air.sent} == {"land", "send_notify_setpoint_stop"}


@pytest.mark.parametrize(("age", "written"), [(0.4, False), (0.2, True)])
def test_setpoints_of_old_poses_are_ignored(air, age, written):
    air.telemetry.pose_time, before = air.now - age, air.written
    air.flight.set_target(air.now, (1.0, 0.2, 0.5, 0.0))
    air.flight.stream(air.now + 1.0)
    assert (air.written > before) == written


def test_an_old_status_tells_of_an_earlier_phase(air):
    """Behind a full queue: `flying` of before the take-off's end, `not flying` of before the take-off."""
    air.flying = False
    for _ in range(200):
        air.now += 0.02
        air.telemetry.arrival, air.telemetry.status_time = air.now, 100.0
        air.flight.set_target(air.now, PLACE)
        air.flight.update_phase(air.now)
    assert air.phase is FlightPhase.FLYING


@pytest.mark.parametrize(
    ("gap", "phase"), [(0.3, FlightPhase.FLYING), (0.7, FlightPhase.FLYING), (0.9, FlightPhase.LANDING)]
)
def test_after_a_gap(air, gap, phase):
    air.flight.land_after_gap(gap)
    assert air.phase is phase


def test_a_drone_out_of_reach_counts_as_flying(air):
    """Until it is seen: its motors may be on, on the floor."""
    air.now += HOLD_S + PLACE[2] / SINK
    air.flight.mark_out_of_reach()
    assert air.flight.airborne
    assert "lands by itself" in air.flight.trouble
    air.now += PLACE[2] / SINK + module.MARGIN_S + 0.1
    air.flight.mark_out_of_reach()
    assert air.flight.airborne
    assert "motors may be on" in air.flight.trouble
    air.telemetry.info = air.info
    assert not air.flight.resume()
    assert air.phase is FlightPhase.GROUND


def test_nothing_is_ordered_into_a_silent_radio(air):
    """Neither for setpoints that are not confirmed nor for a landing: packets would wait for the end of the gap."""
    air.pass_(1.0)
    air.flight.link.busy = True
    assert air.during(2.9) == {}
    air.flight.link.busy = False
    air.flight.land()
    air.flight.link.busy = True
    assert air.during(1.5) == {}


# ---------------------------------------------------------------------- landing


def test_unanswered_landing_is_ordered_again(air):
    air.sent.clear()
    air.flight.land()
    assert air.phase is FlightPhase.LANDING
    assert not air.times("setpoint"), "a start would make the planner forget the landing"
    assert len(air.times("land")) == module.TRIES
    air.telemetry.pose = (0.0,) * 7
    assert 2 < air.during(air.flight.span_s)["land"] < 5
    assert air.during(module.AGAIN_S)["land"] == module.TRIES


def test_setpoints_of_others_end_at_each_landing(air):
    """Before the order to land; and again, because those that follow mute or end it."""
    air.sent.clear()
    air.flight.land()
    air.telemetry.pose = (0.0,) * 7
    air.pass_(air.flight.span_s)
    assert [what for _, what in air.sent] == ["send_notify_setpoint_stop", "land"] * (len(air.sent) // 2)
    repeated = air.times("land")[module.TRIES :]
    assert np.diff(repeated).max() < 0.6, "the drone locks 2 s after the last setpoint of the other"
    assert repeated[-1] < air.flight.phase_since + air.flight.span_s - module.NEAR_S
    air.replies[HighLevel.LAND] = 1, 0
    air.pass_(0.1)
    assert air.now - air.flight.phase_since < 0.2, "it was not landing any more"


def test_drone_flying_unasked_is_landed_and_not_cut(monkeypatch):
    """The take-off was given up, or belongs to another session: the flag of the supervisor counts."""
    air = Air(monkeypatch)
    air.telemetry.pose = [0.1, 0.2, 0.8, 0.0, 0.0, 0.0, 0.0]
    assert air.pass_(0.1).phase is FlightPhase.LANDING
    assert air.flight.airborne
    assert air.times("land")
    assert not air.times("send_emergency_stop")


@pytest.mark.parametrize("pose", [0.3, math.nan])
@pytest.mark.parametrize("set_point", [False, True])
def test_landing_lasts_from_the_highest_place(grounded, pose, set_point):
    """In a gap the drone climbs on; an estimate may be below what motion capture sees."""
    grounded.flight.takeoff(2.0)
    grounded.flying = True
    if set_point:
        grounded.flight.set_target(grounded.now, (0.0, 0.0, 2.0, 0.0))
        grounded.flight.stream(grounded.now + 1.0)
    grounded.telemetry.pose = (0.0, 0.0, pose, *(0.0,) * 4)
    grounded.flight.land_after_gap(0.9)
    assert grounded.flight.span_s == pytest.approx(2.1 / module.DESCENT)


@pytest.mark.parametrize("height", [0.2, 0.8, 8.0])
def test_landing_never_exceeds_half_a_metre_per_second(air, height):
    """At the fastest a rest-to-rest polynomial is 35/16 of its mean speed."""
    air.telemetry.pose = [0.0, 0.0, height, *[0.0] * 4]
    air.flight.land()
    assert 35.0 / 16.0 * (height - module.FLOOR) / air.flight.span_s < 0.5
    assert height == 0.2 or air.flight.span_s < height / LOWEST_DESCENT_M_S + 1.0


def test_the_height_seen_from_outside_counts(air):
    air.flight.note_external(1.5, math.nan)
    air.flight.land()
    assert air.flight.span_s == pytest.approx(1.6 / module.DESCENT)


def test_landing_on_a_table_ends(air):
    """Where it stands is as high as it would fly if another client had ended the landing: a few more attempts."""
    air.flight.land()
    orders, begun, end = len(air.times("land")), 1, air.now + air.flight.span_s
    for _ in range(1500):
        air.flying = air.now < end + 2.0
        answered = len(air.pass_(0.02).times("land"))
        if answered > orders:
            accepted = air.now > end
            orders, air.replies[HighLevel.LAND] = answered, (answered, LogStatus.OK if accepted else LogStatus.REFUSED)
            begun, end = begun + accepted, air.now + air.flight.span_s if accepted else end
    assert begun == 1 + module.LATE_LANDINGS
    assert air.phase is FlightPhase.GROUND


# ---------------------------------------------------------------------- emergency stop


def test_emergency_stop_is_repeated_until_answered(air):
    air.flight.stop()
    found = air.during(10.0)
    assert (found["send_emergency_stop"] > 400, found["setpoint"]) == (True, 0)
    assert air.flight.airborne
    assert air.flight.trouble == UNANSWERED
    air.info |= Info.LOCKED
    assert air.pass_(0.04).phase is FlightPhase.STOPPED
    assert (air.flight.airborne, air.flight.trouble) == (False, "")
    assert air.during(5.0) == {}


def test_firmware_without_lock_flag_stops_once_not_flying(air):
    air.flight.stop()
    air.flying = False
    assert air.pass_(2.2).phase is FlightPhase.STOPPED


def test_a_stop_outlives_the_link(air):
    air.flight.stop()
    air.flight.mark_out_of_reach()
    assert air.flight.airborne
    assert air.flight.resume()
    assert air.during(0.1)["send_emergency_stop"]


def test_one_that_stands_is_not_locked(grounded):
    grounded.flight.stop()
    assert grounded.sent == []


class NoRoom:
    """A link that cannot be made, such as with a full disk, where cflib keeps its tables."""

    made = 0

    def __init__(self, _address):
        NoRoom.made += 1
        raise OSError(28, "No space left on device")


def test_link_that_cannot_be_made_is_tried_again(monkeypatch):
    """The thread lives on: it alone can send a stop."""
    monkeypatch.setattr(pilot, "CrazyflieLink", NoRoom)
    settings = CrazyflieSettings()
    flown = pilot.CrazyfliePilot(
        "CF01", "udp://127.0.0.1:1", settings, Telemetry(lighthouse=False), place=(ZERO, 0.0), turn=threading.Lock()
    )
    flown.start()
    until(lambda: NoRoom.made >= 2, "it is tried again")
    assert "No space left" in str(flown.failure)
    assert "No space left" in flown.note
    flown.close()
    flown.join()
