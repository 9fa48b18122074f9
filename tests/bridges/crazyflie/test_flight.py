"""Flying one Crazyflie, against a link and a clock made by hand: what is sent when answers are lost."""

import types

import numpy as np
import pytest

from agents.body.interface import UNANSWERED
from agents.protocols.crazyflie import CrazyflieSettings
from agents.protocols.crtp import Info
from bridges.crazyflie import flight as module
from bridges.crazyflie import telemetry as telemetry_module
from bridges.crazyflie.flight import Flight, Phase
from bridges.crazyflie.telemetry import Board, Telemetry

PLACE = (0.1, 0.2, 0.5, 0.0)
LEVELS_S = 0.5  # without a setpoint the firmware levels after this, and cuts the motors after 2 s


class Air:
    """A clock, and a Crazyflie that notes what is sent and when; no answer ever comes from it."""

    def __init__(self, monkeypatch, **chosen):
        self.now, self.sent = 100.0, []
        for each in (module, telemetry_module):
            monkeypatch.setattr(each, "time", types.SimpleNamespace(monotonic=lambda: self.now))
        self.board = Board(1)
        self.telemetry = Telemetry(self.board, 0, lighthouse=False)
        self.flight = Flight(CrazyflieSettings(**chosen), self.telemetry, self.pause)
        self.flight.link = types.SimpleNamespace(
            cf=self, error=None, busy=False, planner_reply=lambda command: self.replies.get(command, (0, 0))
        )
        self.replies = {}
        self.supervisor = self.commander = self.high_level_commander = self
        self.flying, self.info = True, Info.ARMED | Info.CAN_FLY

    def __getattr__(self, what):
        if what.startswith("_"):
            raise AttributeError(what)
        return lambda *_args, **_named: self.sent.append((self.now, what))

    def pause(self, seconds):
        self.now += seconds

    def fly(self):
        self.board.settled[:], self.board.pose[0] = True, [0.1, 0.2, 0.5, 0.0, 0.0, 0.0, 0.0]
        self.flight._enter(Phase.CLIMBING)
        return self.pass_(0.1)

    def pass_(self, seconds):
        """As the pilot's thread goes round, its loop commanding."""
        end = self.now + seconds
        while self.now < end:
            self.now += 0.02
            self.board.status_time[0] = self.board.pose_time[0] = self.telemetry.arrival = self.now
            self.board.info[0] = int(self.info | (Info.FLYING if self.flying else 0))
            self.flight.set_target(self.now, PLACE)
            self.flight.update_phase(self.now)
            self.flight.send_due(self.now)
        return self

    def times(self, *whats):
        return [at for at, what in self.sent if what in whats]


@pytest.fixture
def air(monkeypatch):
    return Air(monkeypatch).fly()


def test_setpoints_go_on_while_a_landing_is_not_answered(air):
    begin = air.now
    air.flight.land()
    assert air.flight.phase is Phase.LANDING
    assert len(air.times("land")) == module.TRIES
    told = [begin, *(at for at in air.times("send_position_setpoint", "send_notify_setpoint_stop") if at >= begin)]
    assert air.now - begin > 1.8  # which would have been just short of the 2 s after which the firmware cuts
    assert np.diff(told).max() < LEVELS_S
    assert air.sent[-1][1] == "send_notify_setpoint_stop"


def test_an_emergency_stop_is_said_until_it_is_answered(air):
    air.flight.stop()
    before = air.now
    air.pass_(10.0)
    assert len(air.times("send_emergency_stop")) > 400
    assert not [at for at in air.times("send_position_setpoint") if at > before]
    assert air.flight.airborne
    assert air.flight.trouble == UNANSWERED
    air.info |= Info.LOCKED
    air.pass_(0.04)
    assert air.flight.phase is Phase.STOPPED
    assert not air.flight.airborne
    assert air.flight.trouble == ""
    air.sent.clear()
    air.pass_(5.0)
    assert air.sent == []


def test_a_firmware_that_does_not_say_that_it_is_locked_says_that_it_does_not_fly(air):
    air.flight.stop()
    air.flying = False
    air.pass_(2.2)
    assert air.flight.phase is Phase.STOPPED


def test_a_stop_outlives_the_link(monkeypatch):
    air = Air(monkeypatch, control="high-level").fly()
    air.flight.stop()
    air.flight.mark_out_of_reach()
    assert air.flight.airborne
    assert air.flight.resume()
    air.sent.clear()
    air.pass_(0.1)
    assert air.times("send_emergency_stop")


def test_one_that_stands_is_not_locked(monkeypatch):
    air = Air(monkeypatch)
    air.flying = False
    air.pass_(0.1)
    air.flight.stop()
    assert air.sent == []


def test_a_drone_that_flies_without_an_order_is_landed_and_not_cut(monkeypatch):
    """Its take-off was given up, or another session began it: the flag of the supervisor counts."""
    air = Air(monkeypatch)
    air.board.pose[0] = [0.1, 0.2, 0.8, 0.0, 0.0, 0.0, 0.0]
    air.pass_(0.1)
    assert air.flight.phase is Phase.LANDING
    assert air.flight.airborne
    assert air.times("land")
    assert not air.times("send_emergency_stop")


def test_a_take_off_without_an_answer_goes_on(monkeypatch):
    air = Air(monkeypatch)
    air.board.settled[:], air.flying = True, False
    air.pass_(0.1)
    air.flight.takeoff(0.5)
    assert air.flight.phase is Phase.CLIMBING
    air.pass_(1.0)
    assert air.flight.trouble == ""
    air.pass_(3.0)  # its motors never turn
    assert air.flight.phase is Phase.GROUND
    assert air.flight.trouble == "its motors do not turn"


def test_no_setpoint_follows_an_order_to_land(air):
    """A setpoint makes the planner forget the landing: then the notice that setpoints end would stop the motors."""
    air.flight.link.planner_reply = lambda command: (len(air.times("land")), 0)
    air.flight.land()
    whats = [what for _, what in air.sent]
    after = whats[len(whats) - whats[::-1].index("land") :]
    assert set(after) == {"send_notify_setpoint_stop"}


@pytest.mark.parametrize(("gap", "phase"), [(0.3, Phase.FLYING), (0.7, Phase.FLYING), (0.9, Phase.LANDING)])
def test_after_a_gap(air, gap, phase):
    air.sent.clear()
    air.flight.hold_after_gap(gap)
    whats = [what for _, what in air.sent]
    assert air.flight.phase is phase
    if phase is Phase.FLYING:
        assert whats[0] == "go_to"  # before the notice, without which the planner is not followed
        assert set(whats[1:]) == {"send_notify_setpoint_stop"}
        air.sent.clear()
        air.pass_(1.5)
        assert air.times("send_position_setpoint") == []
        air.pass_(1.0)
        assert air.times("send_position_setpoint")


def test_a_radio_that_stutters_on_ends_in_a_landing(air):
    for _ in range(4):
        air.flight.hold_after_gap(0.3)
        air.pass_(1.0)
        assert air.flight.phase is Phase.FLYING
    air.flight.hold_after_gap(0.3)
    assert air.flight.phase is Phase.LANDING
    assert "5 gaps of the radio" in air.flight.trouble


def test_an_old_status_tells_of_an_earlier_phase(air):
    """Behind a full queue: `flying` of before the take-off's end, `not flying` of before the take-off."""
    air.flying = False
    for _ in range(200):
        air.now += 0.02
        air.telemetry.arrival, air.board.status_time[0] = air.now, 100.0
        air.flight.set_target(air.now, PLACE)
        air.flight.update_phase(air.now)
    assert air.flight.phase is Phase.FLYING


def test_setpoints_of_old_poses_are_ignored(air):
    air.board.pose_time[0] = air.now - 0.4
    air.flight.set_target(air.now, (1.0, 0.2, 0.5, 0.0))
    air.flight._stream(air.now + 1.0)
    assert air.flight._target == PLACE


@pytest.mark.parametrize("info", [Info.CRASHED, Info.TUMBLED])
def test_a_crashed_drone_is_not_recovered_by_a_take_off(monkeypatch, info):
    air = Air(monkeypatch)
    air.board.settled[:], air.flying, air.info = True, False, Info.ARMED | info
    air.pass_(0.1)
    air.flight.takeoff(0.5)
    assert air.flight.phase is Phase.GROUND
    assert "no take-off" in air.flight.trouble
    assert air.sent == []


def test_armed_is_not_yet_able_to_fly(monkeypatch):
    """Motors that are checked after arming: no take-off before the supervisor permits it, and one request to arm."""
    air = Air(monkeypatch)
    air.board.settled[:], air.flying, air.info = True, False, Info.ARMED
    air.pass_(0.1)
    pause = air.pause

    def spun_up(seconds):
        pause(seconds)
        if air.now > 101.5:
            air.board.info[0] = int(Info.ARMED | Info.CAN_FLY)

    air.flight._pause = spun_up
    air.flight.takeoff(0.5)
    assert air.flight.phase is Phase.CLIMBING
    assert min(air.times("takeoff")) > 101.5
    assert air.times("send_arming_request") == []
