"""Telemetry of a Crazyflie: age of poses by the drone's own stamps, and charge by the voltage under load."""

import numpy as np
import pytest

from agents.protocols.crtp import Info
from bridges.crazyflie.telemetry import PacketAge, Telemetry


def ages(packets):
    """Ages of packets, each given as stamp [ms] and arrival [s]."""
    stamps = PacketAge()
    return [stamps.age(arrival, stamp) for stamp, arrival in packets]


def test_a_queue_makes_poses_old():
    """Ten poses a second are measured, five arrive: the tenth is a second old, although it arrives like the first."""
    found = ages([(1000 + 100 * number, 50.0 + 0.2 * number) for number in range(11)])
    assert found[0] == 0.0
    assert found[10] == pytest.approx(1.0, abs=1e-3)


def test_the_fastest_packet_is_the_measure():
    found = ages([(1000, 50.03), (1100, 50.11), (1200, 50.25), (1300, 50.31)])
    assert found == pytest.approx([0.0, 0.0, 0.04, 0.0], abs=1e-4)


def test_stamps_overflow():
    found = ages([((1 << 24) - 50, 50.0), (50, 50.1), (150, 50.5)])
    assert found == pytest.approx([0.0, 0.0, 0.3], abs=1e-3)


def test_clocks_drift():
    """A drone whose clock is 50 ppm slow for an hour: its poses do not seem to grow old."""
    found = ages([(int(1000 * second * (1.0 - 50e-6)) % (1 << 24), 50.0 + second) for second in range(3600)])
    assert max(found) < 2e-3


def test_a_drone_that_was_switched_off_and_on():
    stamps = PacketAge()
    stamps.age(50.0, 100_000)
    assert not stamps.restarted
    assert stamps.age(52.0, 500) == 0.0
    assert stamps.restarted


def test_restart_half_an_overflow_later():
    """On a charger for hours: the stamp of the new start is ahead of the old one, counted around."""
    stamps = PacketAge()
    stamps.age(50.0, 10_000_000)
    assert stamps.age(53.0, 2_000) == 0.0
    assert stamps.restarted


@pytest.mark.parametrize(("stamp", "restarted"), [(15_000, False), (14_000, False), (8_000, True)])
def test_restart_found_with_a_larger_stamp(stamp, restarted):
    """Switched off and on soon after its first start: ten seconds later its clock has advanced by three."""
    stamps = PacketAge()
    stamps.age(50.0, 5_000)
    stamps.connected_anew = True
    stamps.age(60.0, stamp)
    assert stamps.restarted is restarted


class Blocks:
    """Log blocks of a link, by name."""

    def __init__(self, telemetry):
        self.logged = {}
        telemetry.start_logging(self, log_hz=50.0, ranges_hz=None)

    def start_log(self, name, _rate, _variables, logged):
        self.logged[name] = logged


def test_poses_carry_the_time_of_their_measurement():
    telemetry = Telemetry(lighthouse=False)
    blocks = Blocks(telemetry)
    state = {"stateEstimateZ.x": 1500, "stateEstimateZ.vy": -20, "stateEstimate.yaw": 90.0}
    blocks.logged["state"](10.0, 5000, state)
    blocks.logged["state"](13.0, 5020, state)
    assert [telemetry.pose[k] for k in (0, 4, 6)] == pytest.approx([1.5, -0.02, np.pi / 2])
    assert telemetry.pose_time == pytest.approx(10.02, abs=1e-3)


def test_charge_by_the_voltage_under_load():
    telemetry = Telemetry(lighthouse=False)
    blocks = Blocks(telemetry)

    def after(seconds, volts, info):
        begin = max(telemetry.status_time, 0.0)
        for tick in range(1, int(10 * seconds) + 1):
            t = begin + 0.1 * tick
            blocks.logged["state"](t, int(1000 * t), {"supervisor.info": int(info), "pm.vbat": volts})
        return telemetry.battery

    assert after(1.0, 4.2, Info.CAN_FLY) == pytest.approx(1.0)
    assert after(10.0, 3.7, Info.CAN_FLY) == pytest.approx(0.29, abs=0.01)
    assert after(10.0, 3.7, Info.CAN_FLY | Info.FLYING) == pytest.approx(0.71, abs=0.01)  # the same volts under load
    sagged = after(0.2, 3.1, Info.CAN_FLY | Info.FLYING)
    assert sagged > 0.6, "a short load is no empty battery"
    assert after(10.0, 3.25, Info.CAN_FLY | Info.FLYING) < 0.1, "low at 3.27 V, before the firmware's own 3.2 V"
