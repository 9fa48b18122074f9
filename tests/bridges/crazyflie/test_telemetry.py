"""Telemetry of a Crazyflie: age of poses by the drone's own stamps, and charge by the voltage under load."""

import numpy as np
import pytest

from agents.protocols.crtp import Info
from bridges.crazyflie.telemetry import PacketAge, Telemetry


@pytest.mark.parametrize(
    ("packets", "ages"),
    [
        # ten poses a second are measured, five arrive: the tenth is a second old, although it arrives like the first
        pytest.param([(1000 + 100 * k, 50.0 + 0.2 * k) for k in range(11)], [0.1 * k for k in range(11)], id="queue"),
        pytest.param([(1000, 50.03), (1100, 50.11), (1200, 50.25), (1300, 50.31)], [0, 0, 0.04, 0], id="fastest"),
        pytest.param([((1 << 24) - 50, 50.0), (50, 50.1), (150, 50.5)], [0, 0, 0.3], id="overflow"),
    ],
)
def test_age_is_lateness_behind_the_fastest_packet(packets, ages):
    stamps = PacketAge()
    assert [stamps.age(arrival, stamp) for stamp, arrival in packets] == pytest.approx(ages, abs=1e-3)
    assert not stamps.restarted


def test_clocks_drift():
    """A drone whose clock is 50 ppm slow for an hour: its poses do not seem to grow old."""
    stamps = PacketAge()
    assert max(stamps.age(50.0 + s, int(1000 * s * (1.0 - 50e-6)) % (1 << 24)) for s in range(3600)) < 2e-3


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


class Blocks:
    """Log blocks of a link, by name."""

    def __init__(self, telemetry):
        self.logged = {}
        telemetry.start_logging(self, log_hz=50.0, ranges_hz=None)

    def start_log(self, name, _rate, _variables, logged):
        self.logged[name] = logged


@pytest.fixture
def telemetry():
    return Telemetry(lighthouse=False)


def test_poses_carry_the_time_of_their_measurement(telemetry):
    blocks = Blocks(telemetry)
    state = {"stateEstimateZ.x": 1500, "stateEstimateZ.vy": -20, "stateEstimate.yaw": 90.0}
    blocks.logged["state"](10.0, 5000, state)
    blocks.logged["state"](13.0, 5020, state)
    assert [telemetry.pose[k] for k in (0, 4, 6)] == pytest.approx([1.5, -0.02, np.pi / 2])
    assert telemetry.pose_time == pytest.approx(10.02, abs=1e-3)


def test_charge_by_the_voltage_under_load(telemetry):
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


def test_firmware_without_supervisor(telemetry):
    """Telemetry of older firmwares is enough to take off and to land."""
    flags = {"pm.state": 3, "sys.canfly": 1, "sys.isFlying": 1, "sys.isTumbled": 0}
    Blocks(telemetry).logged["state"](1.0, 0, {"pm.vbat": 3.55, **flags})
    assert telemetry.info == Info.ARMED | Info.CAN_FLY | Info.FLYING
    assert telemetry.battery == pytest.approx(0.5)
    assert telemetry.battery_low
    assert telemetry.status_text() == "battery low"
