"""Flying one Crazyflie, against a link and a clock made by hand: what is sent when answers are lost; its telemetry."""

import math
import threading
import types
from collections import Counter
from itertools import count
from unittest.mock import MagicMock

import numpy as np
import pytest

from agents.body.interface import UNANSWERED
from agents.body.limits import LOWEST_DESCENT_M_S
from agents.vectors import ZERO
from bridges.crazyflie import flight as module
from bridges.crazyflie import pilot
from bridges.crazyflie.flight import FlightControl, FlightPhase
from bridges.crazyflie.link import LinkError
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.addresses import CrazyflieSettings
from bridges.crazyflie.protocol.crtp import HighLevel, Info, LogStatus, Port
from bridges.crazyflie.telemetry import PacketAge, Telemetry
from bridges.crazyflie.trajectory import HOLD_S, SINK, TAKEOFFS, TrajectoryMemory
from tests.bridges.crazyflie.flights import clocked
from tests.waiting import ManualClock, until

PLACE = (0.1, 0.2, 0.5, 0.0)


class Air(ManualClock):
    """A clock, and a Crazyflie that notes what is sent and when; no answer ever comes from it."""

    def __init__(self, monkeypatch):
        super().__init__(100.0)
        clocked(monkeypatch, self)
        self.sent, self.replies, self.written, self.confirms = [], {}, 0, True
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
            if self.confirms:
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


@pytest.mark.parametrize(
    ("info", "yaw", "old_s", "refusal"),
    [
        (Info.CRASHED, math.nan, 0.0, "no take-off: crashed"),
        (Info.TUMBLED, math.nan, 0.0, "no take-off: "),
        (Info.CAN_FLY, 0.5 + math.tau, 0.0, "its own yaw is 29° beside"),
        (Info.CAN_FLY, math.nan, 1.1, "status is 1.1 s old; is its radio too full"),
    ],
)
def test_crashed_turned_or_late_drone_stays_down(monkeypatch, info, yaw, old_s, refusal):
    """A crash is not recovered by a take-off; the decision turns by the yaw from outside, the firmware by its own."""
    air = Air(monkeypatch).stand(info=Info.ARMED | info)
    air.flight.note_external(0.0, yaw, 0.0)
    air.now += old_s
    air.flight.takeoff(0.5)
    assert (air.phase, air.sent) == (FlightPhase.GROUND, [])
    assert refusal in air.flight.trouble


def test_refusal_is_noted_until_its_cause_goes(monkeypatch):
    air = Air(monkeypatch).stand(info=Info.ARMED | Info.TUMBLED)
    air.flight.takeoff(0.5)
    assert "upside down" in air.pass_(1.0).flight.trouble
    air.info = Info.ARMED | Info.CAN_FLY
    assert air.pass_(0.1).flight.trouble == ""


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
    refusing = Air(monkeypatch).stand(info=Info(0))
    refusing.flight.takeoff(0.5)
    assert (refusing.phase, refusing.times("climb")) == (FlightPhase.GROUND, [])
    assert refusing.flight.trouble.startswith("arming refused")


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


def test_constant_setpoint_is_repeated_in_time(air):
    """Before the descent behind it begins; one that changes is sent at the rate of setpoints."""
    assert np.diff(air.pass_(2.0).times("setpoint")[3:]).max() < 0.5 * HOLD_S
    air.target = sweep(*np.linspace(0.2, 0.8, 1000))
    assert 15 < air.during(2.0)["setpoint"] < 25
    air.flight.scale_setpoints(0.1)  # over a slow radio: rarer, and held for longer
    begin = air.now
    gaps = np.diff(air.pass_(4.0).times("setpoint", since=begin + 0.3))
    assert gaps.min() > 0.9 / module.SLOWEST_HZ
    assert gaps.max() < 0.5 * air.flight.hold_s
    air.flight.scale_setpoints(1.0)
    air.target = sweep(0.1, 0.1004)  # below the wire's resolution: no change
    assert air.during(2.0)["setpoint"] < 10


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


def test_setpoints_that_are_not_confirmed_end_in_landing(air):
    """The drone descends by itself, and would stand with its motors on; the radio is not flooded."""
    air.pass_(1.0)
    air.confirms, air.written = False, 0
    air.target = sweep(*np.linspace(0.2, 0.8, 1000))
    assert air.pass_(1.0).phase is FlightPhase.FLYING
    assert air.written < 10
    assert air.pass_(2.5).phase is FlightPhase.LANDING
    assert air.flight.trouble == "landed: its setpoints are not confirmed"


def test_setpoints_of_old_poses_are_ignored(air):
    for age, after, written in ((0.4, 1.0, False), (0.2, 2.0, True)):
        air.telemetry.pose_time, before = air.now - age, air.written
        air.flight.set_target(air.now, (1.0, 0.2, 0.5, 0.0))
        air.flight.stream(air.now + after)
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


def test_nothing_is_ordered_into_a_silent_radio(air):
    """Neither for setpoints that are not confirmed nor for a landing: packets would wait for the end of the gap."""
    air.pass_(1.0)
    air.flight.link.busy = True
    assert air.during(2.9) == {}
    air.flight.link.busy = False
    for gap, phase in ((0.7, FlightPhase.FLYING), (0.9, FlightPhase.LANDING)):
        air.flight.land_after_gap(gap)
        assert air.phase is phase
    air.flight.link.busy = True
    assert air.during(1.5) == {}


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
    assert (air.phase, air.flight.trouble) == (FlightPhase.GROUND, "")


def test_link_lost_as_a_climb_is_started(air):
    """Nobody is sent to a drone that may be on its way up."""

    def sleep(seconds):
        air.now += seconds
        if air.times("climb"):
            raise LinkError

    air.flight.enter(FlightPhase.GROUND)
    air.stand().sleep = sleep
    with pytest.raises(LinkError):
        air.flight.takeoff(2.0)
    for seconds, down in ((0.0, False), (2.0 / module.CLIMB + HOLD_S + 2.0 / SINK, False), (6.0, True)):
        air.now += seconds
        assert air.flight.mark_out_of_reach() is down
        assert ("lands by itself" in air.flight.trouble) is not down


def test_unanswered_landing_is_ordered_again(air):
    air.sent.clear()
    air.flight.land()
    assert air.phase is FlightPhase.LANDING
    assert not air.times("setpoint"), "a start would make the planner forget the landing"
    assert len(air.times("land")) == module.TRIES
    air.telemetry.pose = (0.0,) * 7
    air.pass_(air.flight.span_s)
    # others' setpoints end before each order, and again, because those that follow mute or end the landing
    assert [what for _, what in air.sent] == ["send_notify_setpoint_stop", "land"] * (len(air.sent) // 2)
    repeated = air.times("land")[module.TRIES :]
    assert len(repeated) > 2
    assert np.diff(repeated).max() < 0.6, "the drone locks 2 s after the last setpoint of the other"
    assert repeated[-1] < air.flight.phase_since + air.flight.span_s - module.NEAR_S
    air.sent.clear()
    assert air.during(module.AGAIN_S)["land"] == module.TRIES
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
@pytest.mark.parametrize("seen_from", ["climb", "setpoint", "outside"])
def test_landing_lasts_from_the_highest_place(grounded, pose, seen_from):
    """In a gap the drone climbs on; an estimate may be below what motion capture sees."""
    grounded.flight.takeoff(0.5 if seen_from == "outside" else 2.0)
    grounded.flying = True
    if seen_from == "setpoint":
        grounded.flight.set_target(grounded.now, (0.0, 0.0, 2.0, 0.0))
        grounded.flight.stream(grounded.now + 1.0)
    elif seen_from == "outside":
        grounded.flight.note_external(2.0, math.nan, 0.0)
    grounded.telemetry.pose = (0.0, 0.0, pose, *(0.0,) * 4)
    grounded.flight.land_after_gap(0.9)
    assert grounded.flight.span_s == pytest.approx(2.1 / module.DESCENT)


@pytest.mark.parametrize("height", [0.2, 8.0])
def test_landing_never_exceeds_half_a_metre_per_second(air, height):
    """At the fastest a rest-to-rest polynomial is 35/16 of its mean speed."""
    air.telemetry.pose = [0.0, 0.0, height, *[0.0] * 4]
    air.flight.land()
    assert 35.0 / 16.0 * (height - module.FLOOR) / air.flight.span_s < 0.5
    assert height == 0.2 or air.flight.span_s < height / LOWEST_DESCENT_M_S + 1.0


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


def test_emergency_stop_is_repeated_until_answered(air):
    air.flight.stop()
    found = air.during(10.0)
    assert (found["send_emergency_stop"] > 400, found["setpoint"]) == (True, 0)
    assert air.flight.airborne
    assert air.flight.trouble == UNANSWERED
    air.flight.mark_out_of_reach()
    assert air.flight.airborne
    assert air.flight.resume()  # a stop outlives the link
    assert air.during(0.1)["send_emergency_stop"]
    air.info |= Info.LOCKED
    assert air.pass_(0.04).phase is FlightPhase.STOPPED
    assert (air.flight.airborne, air.flight.trouble) == (False, "")
    assert air.during(5.0) == {}


def test_firmware_without_lock_flag_stops_once_not_flying(air):
    air.flight.stop()
    air.flying = False
    assert air.pass_(2.2).phase is FlightPhase.STOPPED
    air.flight.enter(FlightPhase.GROUND)
    air.pass_(0.1).sent.clear()
    air.flight.stop()
    assert air.sent == [], "one that stands is not locked"


def test_link_that_cannot_be_made_is_tried_again(monkeypatch):
    """With a full disk, where cflib keeps its tables: the thread lives on, which alone can send a stop."""
    made = MagicMock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(pilot, "CrazyflieLink", made)
    place, turn, telemetry = (ZERO, 0.0), threading.Lock(), Telemetry(lighthouse=False)
    flown = pilot.CrazyfliePilot("CF01", "udp://[::1]:1", CrazyflieSettings(), telemetry, place=place, turn=turn)
    flown.start()
    until(lambda: made.call_count >= 2, "it is tried again")
    assert "No space left" in str(flown.failure)
    assert "No space left" in flown.note
    flown.close()
    flown.join()


@pytest.mark.parametrize(
    ("packets", "ages"),
    [
        # ten poses a second are measured, five arrive: the tenth is a second old, although it arrives like the first
        pytest.param([(1000 + 100 * k, 50.0 + 0.2 * k) for k in range(11)], [0.1 * k for k in range(11)], id="queue"),
        pytest.param([(1000, 50.03), (1100, 50.11), (1200, 50.25), (1300, 50.31)], [0, 0, 0.04, 0], id="fastest"),
        pytest.param([((1 << 24) - 50, 50.0), (50, 50.1), (150, 50.5)], [0, 0, 0.3], id="overflow"),
        pytest.param(  # a clock that is 50 ppm slow for an hour: poses do not seem to grow old
            [(int(1000 * s * (1.0 - 50e-6)) % (1 << 24), 50.0 + s) for s in range(3600)], [0] * 3600, id="drift"
        ),
    ],
)
def test_age_is_lateness_behind_the_fastest_packet(packets, ages):
    stamps = PacketAge()
    assert [stamps.age(arrival, stamp) for stamp, arrival in packets] == pytest.approx(ages, abs=2e-3)
    assert not stamps.restarted


@pytest.mark.parametrize(
    ("before", "arrival", "stamp", "anew", "restarted"),
    [
        (100_000, 52.0, 500, False, True),
        (10_000_000, 53.0, 2_000, False, True),  # on a charger for hours: ahead of the old stamp, counted around
        # switched off and on soon after its first start: ten seconds later its clock has advanced by three
        (5_000, 60.0, 8_000, True, True),
        (5_000, 60.0, 14_000, True, False),
        (5_000, 60.0, 15_000, True, False),
    ],
)
def test_a_drone_that_was_switched_off_and_on(before, arrival, stamp, anew, restarted):
    stamps = PacketAge()
    stamps.age(50.0, before)
    stamps.connected_anew = anew
    age = stamps.age(arrival, stamp)
    assert stamps.restarted is restarted
    assert not restarted or age == 0.0


@pytest.fixture
def telemetry():
    return Telemetry(lighthouse=True, absolute=True)


@pytest.fixture
def log_state(telemetry):
    """Takes a packet of the block of states: its arrival [s], its stamp [ms] and its values."""
    blocks = {}
    link = types.SimpleNamespace(start_log=lambda name, _rate, _variables, logged: blocks.update({name: logged}))
    telemetry.start_logging(link, log_hz=50.0, ranges_hz=None)
    return blocks["state"]


def test_poses_carry_the_time_of_their_measurement(telemetry, log_state):
    state = {"stateEstimateZ.x": 1500, "stateEstimateZ.vy": -20, "stateEstimate.yaw": 90.0}
    log_state(10.0, 5000, state)
    log_state(13.0, 5020, state)
    assert [telemetry.pose[k] for k in (0, 4, 6)] == pytest.approx([1.5, -0.02, np.pi / 2])
    assert telemetry.pose_time == pytest.approx(10.02, abs=1e-3)


@pytest.mark.parametrize(
    ("stations", "variance", "age"), [(2, 0.01, 0), (0, 0.01, 1), (1, 0.01, 1), (2, 0.2, 1), (2, math.nan, 1)]
)
def test_pose_without_measurements_becomes_old(telemetry, log_state, stations, variance, age):
    telemetry.settled = True
    log_state(10.0, 0, {})
    log_state(11.0, 1000, {"lighthouse.status": stations, "kalman.varPX": variance})
    assert (telemetry.status_time, telemetry.pose_time) == (11.0, 11.0 - age)


def test_charge_by_the_voltage_under_load(telemetry, log_state):
    def after(seconds, volts, info):
        begin = max(telemetry.status_time, 0.0)
        for tick in range(1, int(10 * seconds) + 1):
            t = begin + 0.1 * tick
            log_state(t, int(1000 * t), {"supervisor.info": int(info), "pm.vbat": volts})
        return telemetry.battery

    assert after(1.0, 4.2, Info.CAN_FLY) == pytest.approx(1.0)
    assert after(10.0, 3.7, Info.CAN_FLY) == pytest.approx(0.29, abs=0.01)
    assert after(10.0, 3.7, Info.CAN_FLY | Info.FLYING) == pytest.approx(0.71, abs=0.01)  # the same volts under load
    sagged = after(0.2, 3.1, Info.CAN_FLY | Info.FLYING)
    assert sagged > 0.6, "a short load is no empty battery"
    assert after(10.0, 3.25, Info.CAN_FLY | Info.FLYING) < 0.1, "low at 3.27 V, before the firmware's own 3.2 V"


def test_firmware_without_supervisor(telemetry, log_state):
    """Telemetry of older firmwares is enough to take off and to land."""
    log_state(1.0, 0, {"pm.vbat": 3.55, "pm.state": 3, "sys.canfly": 1, "sys.isFlying": 1, "sys.isTumbled": 0})
    assert (telemetry.info, telemetry.battery) == (Info.ARMED | Info.CAN_FLY | Info.FLYING, pytest.approx(0.5))
    assert telemetry.battery_low
    assert telemetry.status_text() == "battery low"
