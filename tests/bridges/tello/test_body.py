"""The Tello bridge: its pilot against a drone made of lists and a clock made of numbers; then djitellopy and twins."""

import fcntl
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import UNANSWERED, BodyError, settings
from agents.protocols import tello as protocol
from bridges.tello.body import TelloBody
from bridges.tello.pilot import Duty
from tests.bridges.tello.cockpit import Cockpit
from tests.twins.loopback import request

ROOT = Path(__file__).resolve().parents[3]
SPEED = st.floats(-1.0, 1.0)


@given(SPEED, SPEED, SPEED, st.floats(-1.7, 1.7), st.floats(-10.0, 10.0))
def test_sticks_say_the_velocity_in_the_world(x, y, z, turn, yaw):
    rc = protocol.sticks((x, y, z), turn, yaw)
    assert all(isinstance(stick, int) and abs(stick) <= 100 for stick in rc)
    if abs(np.cos(yaw) * x + np.sin(yaw) * y) <= 1.0 and abs(np.cos(yaw) * y - np.sin(yaw) * x) <= 1.0:
        assert protocol.motion(rc, yaw) == pytest.approx((x, y, z, turn), abs=0.01)


def test_sticks_by_hand():
    assert protocol.sticks((0.5, 0.0, 0.0), 0.0, 0.0) == (0, 50, 0, 0)
    assert protocol.sticks((0.0, 0.5, 0.2), np.radians(30.0), 0.0) == (-50, 0, 20, -30)
    assert protocol.sticks((0.0, 0.5, 0.0), 0.0, np.pi / 2) == (0, 50, 0, 0)
    assert protocol.sticks((9.0, 0.0, -9.0), 9.0, 0.0) == (0, 100, -100, -100)


def test_take_off_is_sent_once_and_answered_aloft():
    cockpit = Cockpit()
    cockpit.pass_(0.2)
    cockpit.pilot.position = (1.0, 2.0, 0.0)
    cockpit.drone.said.clear()
    cockpit.drone.responses.append(b"ok")  # of something that was said before
    cockpit.pilot.take_off(0.6, cockpit.now)
    assert cockpit.pilot.flying
    cockpit.pass_(0.5)
    assert cockpit.pilot.duty is Duty.RISE
    cockpit.drone.responses.append(b"ok")  # too early: no drone is up by then
    cockpit.pass_(3.0)
    assert cockpit.pilot.duty is Duty.RISE
    cockpit.drone.responses.append(b"ok\r\n")
    cockpit.pass_(0.1)
    assert cockpit.pilot.duty is Duty.HOLD
    assert cockpit.drone.said == ["takeoff"]


def test_tello_climbs_and_holds_until_setpoints_come():
    cockpit = Cockpit().fly()
    cockpit.pilot.position, cockpit.pilot.yaw = (0.9, 2.0, 0.8), 0.0
    cockpit.pass_(0.05)
    assert cockpit.drone.sticks[-1] == (0, 10, -20, 0)
    cockpit.pilot.position = (np.nan,) * 3
    cockpit.pass_(0.05)
    assert cockpit.drone.sticks[-1] == (0, 0, 0, 0)
    cockpit.aim((0.0, 0.3, 0.0, 0.0))
    cockpit.pass_(0.5)
    assert cockpit.drone.sticks[-1] == (-30, 0, 0, 0)
    cockpit.pass_(0.1)
    assert cockpit.drone.sticks[-1] == (0, 0, 0, 0)  # a setpoint of half a second ago is none


def test_a_climb_with_markers_on_the_floor_ends():
    cockpit = Cockpit().fly()
    pilot = cockpit.pilot
    pilot.position = (1.0, 2.0, 0.02)
    cockpit.pass_(1.0, h=150, time=5)
    assert pilot.duty is Duty.HOLD
    cockpit.pass_(0.2, h=170)
    assert (pilot.duty, cockpit.drone.said[-1]) == (Duty.LAND, "land")
    assert pilot.trouble == "landing: it is 1.7 m high, and its positions do not rise with it"


def test_process_woken_from_suspension_sends_nothing_stale():
    """Suspended in the middle of a step, which is a stick of before; then it lands, as it does in a take-off."""
    cockpit = Cockpit().fly()
    pilot, drone = cockpit.pilot, cockpit.drone
    cockpit.aim((0.0, 0.3, 0.0, 0.0))
    sticks, read = pilot._sticks, cockpit.now

    def suspended(now, last_read):
        cockpit.now += 3.0
        return sticks(now, last_read)

    pilot._sticks = suspended
    drone.sticks.clear()
    pilot.step(cockpit.now, read)
    pilot._sticks = sticks
    assert drone.sticks == []
    pilot.step(cockpit.now, read)
    assert drone.sticks == [(0, 0, 0, 0)]
    assert (pilot.duty, drone.said[-1]) == (Duty.LAND, "land")
    rising = Cockpit()
    rising.take_off(0.6, at=(1.0, 2.0, 0.0))
    rising.drone.said.clear()
    rising.pilot.step(rising.now + 8.0, rising.now)
    assert rising.drone.said == ["land"]


def test_sticks_of_another_scale():
    """A drone that flies 0.5 m/s at full deflection gets twice the sticks of one that flies 1 m/s."""
    cockpit = Cockpit(stick_speed=0.5).fly()
    cockpit.pilot.position, cockpit.pilot.yaw = (0.9, 2.0, 0.6), 0.0
    cockpit.pass_(0.05)
    assert cockpit.drone.sticks[-1] == (0, 20, 0, 0)
    cockpit.aim((0.0, 0.2, 0.0, 0.0))
    cockpit.pass_(0.05)
    assert cockpit.drone.sticks[-1] == (-40, 0, 0, 0)


def test_the_stick_test_closes_no_loop():
    """Forward for 2 s, back for 2 s, whatever setpoints say; with the position lost the sticks rest."""
    cockpit = Cockpit(stick_test=True).fly()
    cockpit.drone.sticks.clear()
    flown = []
    for _ in range(70):
        cockpit.aim((0.5, 0.5, 0.5, 0.5))
        cockpit.pass_(0.1)
        flown.append(cockpit.drone.sticks[-1])
    forward = [sticks[1] for sticks in flown]
    assert {sticks[:1] + sticks[2:] for sticks in flown[:68]} == {(0, 0, 0)}
    assert (forward.count(20), forward.count(-20)) == (20, 20)
    assert forward.index(20) == pytest.approx(9, abs=1)
    assert flown[-1] == (-50, 50, 50, -29)  # it is over
    lost = Cockpit(stick_test=True).fly()
    lost.pilot.position = (np.nan,) * 3
    lost.pass_(2.0)
    assert lost.drone.sticks[-1] == (0, 0, 0, 0)


def test_the_sticks_keep_it_alive():
    cockpit = Cockpit().fly()
    before = len(cockpit.drone.sticks)
    cockpit.pass_(10.0, time=4)
    cockpit.report["time"] = 14
    assert len(cockpit.drone.sticks) - before == 200


@pytest.mark.parametrize("answer", [b"error", b"out of range", b"unknown command: takeoff"])
def test_a_drone_that_refuses_says_so(answer):
    cockpit = Cockpit()
    cockpit.take_off(0.6)
    cockpit.drone.responses.append(answer)
    cockpit.pass_(0.1)
    assert cockpit.pilot.duty is Duty.REST
    assert "refuses to take off" in cockpit.pilot.note(cockpit.now)


def test_lost_answers_and_lost_commands():
    cockpit = Cockpit()
    cockpit.pass_(0.2)
    cockpit.pilot.position = (0.0, 0.0, 0.0)
    cockpit.drone.said.clear()
    cockpit.pilot.take_off(0.6, cockpit.now)
    cockpit.pass_(6.5)  # nothing happens: the command was lost
    assert cockpit.drone.said == ["takeoff", "takeoff"]
    cockpit.pass_(6.5, h=80, time=6)  # it is up: the answer was lost
    assert cockpit.pilot.duty is Duty.HOLD
    cockpit.pilot.land(cockpit.now)
    cockpit.pass_(2.2)
    assert cockpit.drone.said[2:] == ["land", "land", "land"]
    cockpit.pass_(3.3, h=10)  # it is down, its motors' clock stands
    assert cockpit.pilot.duty is Duty.REST
    assert not cockpit.pilot.flying


def test_refused_second_take_off_means_it_flies():
    cockpit = Cockpit()
    cockpit.take_off(0.6)
    cockpit.pass_(2.0, h=80)
    cockpit.drone.responses.append(b"error")
    cockpit.pass_(0.1)
    assert cockpit.pilot.duty is Duty.HOLD


def test_a_drone_that_never_gets_up_is_landed():
    cockpit = Cockpit()
    cockpit.take_off(0.6)
    cockpit.pass_(20.2)
    assert cockpit.drone.said[-1] == "land"
    cockpit.pass_(1.2)  # it may have obeyed the last of the orders to take off, 3 s ago
    assert not cockpit.pilot.flying
    assert "did not take off in 20 s" in cockpit.pilot.note(cockpit.now)


def test_landing_ends_when_answered_and_low():
    cockpit = Cockpit().fly()
    cockpit.pilot.land(cockpit.now)
    cockpit.drone.responses.append(b"ok")  # of the sticks: some firmware answers them
    cockpit.pass_(0.1)
    assert cockpit.pilot.duty is Duty.LAND
    cockpit.pass_(0.5, h=0)
    cockpit.drone.responses.append(b"ok")
    cockpit.pass_(0.1)
    assert cockpit.pilot.duty is Duty.REST


def test_emergency_stop_is_repeated_until_motors_stand():
    cockpit = Cockpit().fly()
    cockpit.drone.said.clear()
    cockpit.pilot.cut(cockpit.now)
    assert cockpit.drone.said == ["emergency"]
    cockpit.pilot.cut(cockpit.now)  # the loop's own stop, after that of the thread that receives
    for second in range(4, 9):  # all are lost: the clock of its motors runs on
        cockpit.pass_(1.0, time=second)
        assert cockpit.drone.said == ["emergency"] * (2 + 20 * (second - 3))
        assert cockpit.pilot.flying
        assert (UNANSWERED in cockpit.pilot.note(cockpit.now)) == (second > 5)
    cockpit.pass_(0.4, h=0)  # one is heard
    assert cockpit.pilot.flying
    cockpit.pass_(0.3)
    assert cockpit.pilot.duty is Duty.REST
    assert cockpit.pilot.note(cockpit.now) == ""
    cockpit.drone.said.clear()
    cockpit.pass_(1.0)
    assert cockpit.drone.said == []


def test_silent_drone_is_stopped_until_surely_landed():
    cockpit = Cockpit().fly()
    cockpit.speaks = False
    cockpit.pilot.cut(cockpit.now)
    cockpit.drone.said.clear()
    cockpit.pass_(19.0)
    assert cockpit.drone.said == ["emergency"] * 380
    assert UNANSWERED in cockpit.pilot.note(cockpit.now)
    cockpit.pass_(1.2)
    assert cockpit.pilot.duty is Duty.REST
    assert "landed by itself" in cockpit.pilot.note(cockpit.now)


def test_standing_drone_answers_a_stop_at_once():
    cockpit = Cockpit()
    cockpit.pass_(2.0)
    cockpit.pilot.cut(cockpit.now)
    assert cockpit.drone.said[-1] == "emergency"
    cockpit.pass_(0.05)
    assert not cockpit.pilot.flying


def test_stopped_take_off_counts_as_flying_until_standing():
    cockpit = Cockpit()
    cockpit.take_off(0.6, at=(1.0, 2.0, 0.0), rested_s=5.0)
    cockpit.pass_(0.1)
    cockpit.pilot.cut(cockpit.now)  # its motors' clock has not moved yet
    cockpit.pass_(1.4)
    assert cockpit.pilot.flying
    cockpit.pass_(0.5)
    assert not cockpit.pilot.flying


def test_undrivable_drone_keeps_no_other_from_stopping():
    body = TelloBody(request("tello", ["tello://10.0.0.2", "tello://10.0.0.3"], external=True))
    lost, good = Cockpit().fly(), Cockpit().fly()
    body.pilots = [lost.pilot, good.pilot]
    lost.drone.get_own_udp_object = lambda: {}
    for what in (body.land, body.stop):
        with pytest.raises(KeyError, match="responses"):
            what(range(2))
    assert good.drone.said[-2:] == ["land", "emergency"]


def test_a_process_that_does_nothing_loses_its_drone():
    cockpit = Cockpit().fly()
    cockpit.attended = False
    cockpit.pass_(0.1)
    assert cockpit.pilot.duty is Duty.LAND
    assert "its process did nothing for 2 s" in cockpit.pilot.note(cockpit.now)


def test_a_low_battery_brings_it_down():
    cockpit = Cockpit(low_battery=0.2).fly()
    cockpit.pass_(0.2, bat=19)
    assert cockpit.pilot.duty is Duty.LAND
    assert cockpit.pilot.note(cockpit.now) == "landing: battery at 19%"
    assert cockpit.pilot.battery == 0.19


def test_a_drone_that_landed_by_itself_is_seen():
    cockpit = Cockpit().fly()
    cockpit.pass_(3.5, h=0)
    assert not cockpit.pilot.flying
    assert cockpit.pilot.note(cockpit.now) == "landed by itself, battery at 80%"


def test_silent_drone_is_landed_until_surely_down():
    cockpit = Cockpit().fly()
    cockpit.speaks = False
    cockpit.pass_(1.2)
    assert cockpit.pilot.silent(cockpit.now)
    assert cockpit.pilot.note(cockpit.now).startswith("silent for 1 s")
    cockpit.pilot.land(cockpit.now)
    cockpit.drone.said.clear()
    cockpit.pass_(5.05)
    assert cockpit.drone.said == ["land"] * 5
    assert cockpit.pilot.flying
    cockpit.pass_(15.0)
    assert not cockpit.pilot.flying
    assert "landed by itself" in cockpit.pilot.note(cockpit.now)
    cockpit.drone.said.clear()
    cockpit.pass_(1.0)
    assert cockpit.drone.said == ["command"] * 2  # once on again, it must be put into SDK mode
    cockpit.speaks = True
    cockpit.pass_(0.2)
    assert not cockpit.pilot.silent(cockpit.now)


def test_a_network_that_is_down_is_named():
    cockpit = Cockpit().fly()
    cockpit.drone.broken = True
    cockpit.pass_(0.05)
    cockpit.pilot.land(cockpit.now)
    cockpit.pilot.cut(cockpit.now)
    assert "cannot send: Network is unreachable" in cockpit.pilot.note(cockpit.now)
    cockpit.drone.broken = False
    cockpit.pass_(0.2)
    assert cockpit.pilot.note(cockpit.now) == ""


def test_yaw_counts_from_where_it_was_opened():
    cockpit = Cockpit()
    cockpit.pass_(0.2)
    assert cockpit.pilot.turned == 0.0
    cockpit.pass_(0.2, yaw=-70)  # clockwise is positive to the drone
    assert cockpit.pilot.turned == pytest.approx(np.pi / 2)
    cockpit.pass_(0.2, yaw="garbled", bat=None, h="", time=1.5)
    assert cockpit.pilot.turned == pytest.approx(np.pi / 2)
    assert cockpit.pilot.battery == 0.8


def test_drone_left_aloft_lands_when_process_ends():
    cockpit = Cockpit().fly()
    cockpit.drone.said.clear()
    cockpit.pilot.leave()
    assert cockpit.drone.said == ["land"] * 5 + ["(end)"]


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("tello://192.168.10.1", ("192.168.10.1", 8889)),
        ("tello://127.0.0.2:18889", ("127.0.0.2", 18889)),
        ("tello", ("192.168.10.1", 8889)),
        ("tello://", ("192.168.10.1", 8889)),
    ],
)
def test_addresses(address, place):
    assert protocol.endpoint("T", address) == place


@pytest.mark.parametrize("address", ["tello://kitchen", "tello://1.2.3", "tello://1.2.3.256", "tello://1.2.3.4:x"])
def test_wrong_addresses_are_named(address):
    with pytest.raises(BodyError, match=r"^R0: .*tello://192\.168\.10\.1"):
        TelloBody(request("tello", [address], external=True))


def test_rows_that_cannot_be_flown():
    with pytest.raises(BodyError, match='R0: a Tello does not measure its position: write position = "external"'):
        TelloBody(request("tello", ["tello"]))
    with pytest.raises(BodyError, match=r"R1: another Tello of this process has the address 10\.0\.0\.2"):
        TelloBody(request("tello", ["tello://10.0.0.2", "tello://10.0.0.2:1"], external=True))
    with pytest.raises(BodyError, match=r"R0: device: .*silence_s must be 0.3 to 10 s"):
        TelloBody(request("tello", ["tello"], external=True, device={"silence_s": 0.01}))


@pytest.mark.parametrize(
    "table", [{"rc_hz": 500.0}, {"low_battery": 20}, {"low_battery": "half"}, {"colour": "red"}, {"rc_hz": True}]
)
def test_wrong_settings_are_named(table):
    with pytest.raises(BodyError, match=rf"^T1: device: .*{next(iter(table))}"):
        settings(protocol.TelloSettings, "T1", table)


# ---------------------------------------------------------------------- djitellopy and twins


def fly(scenario):
    """One scenario in a process of its own; the ports of djitellopy are the host's, so they take turns."""
    with (Path(tempfile.gettempdir()) / "zenpark-tello.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(
            [sys.executable, "-m", "tests.bridges.tello_flight", scenario],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60.0,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.mark.system
def test_the_unmodified_library_flies_two_twins():
    told = fly("vendor")
    assert (told["sdk"], told["battery"], told["serial"]) == ("20", 100, "0TQTWIN0001")
    assert (told["grounded"], told["unknown"]) == ("error Motor stop", "unknown command: dance")
    assert told["height"] == pytest.approx([0.8, 0.8], abs=0.05)
    assert told["go"] == pytest.approx([0.5, 0.4, 0.8], abs=0.06)
    assert told["yaw"] == pytest.approx(-np.pi / 2, abs=0.03)
    assert "out of range" in told["refused"]
    assert 8 <= told["states"] <= 12
    assert told["keys"] == 21
    assert told["reported"] == [pytest.approx(90, abs=2), pytest.approx(75, abs=5), pytest.approx(79, abs=2)]
    assert max(told["end"]) < 0.5


@pytest.mark.system
def test_the_bridge_flies_two_twins():
    flown = fly("formation")
    assert None not in (flown["up"], flown["there"], flown["turned"], flown["down"])
    assert flown["height"] == 0.0
    assert flown["error"] < 0.02
    assert flown["velocity"] < 0.2
    assert flown["yaw"] == pytest.approx([0.0, 0.0], abs=0.02)
    assert all(0.9 < charge <= 1.0 for charge in flown["battery"])
    assert flown["notes"] == ["", ""]


@pytest.mark.mechanism("Tello bridge: one of several fails")
@pytest.mark.system
def test_fault_of_one_drone_leaves_others_flying():
    flown = fly("faults")
    said = flown["said"]
    assert flown["opened"] > 1.0
    assert flown["flying"] == [True, True, True, True, False, False]
    assert (said["absent"], said["absent takeoff"], said["blind"]) == ("no answer", "no answer", True)
    assert said["empty"] == "no take-off: battery at 8%"
    assert said["killed"].startswith("silent for")
    assert said["silent"].startswith("silent for")
    assert said["silence"][0] < 0.5 < said["silence"][1]
    assert said["weak"] == "landing: battery at 9%"
    assert flown["weak_height"] < 0.05
    assert None not in (flown["there"], flown["fell"])


@pytest.mark.system
def test_what_does_not_take_off_says_why():
    flown = fly("refusals")
    assert flown["seconds"] < 5.0
    assert flown["said"]["absent"].startswith("R0 at 127.0.0.77:18889: no answer (switch it on, join its Wi-Fi")
    assert flown["said"]["nowhere"].startswith("no take-off: no fresh external position")
    assert flown["said"]["hung"] == "landing: its process did nothing for 2 s"
    assert flown["said"]["second"].startswith("UDP port 8889 of this computer is taken")
    assert not flown["flying"]
    assert flown["sinks"] is not None
