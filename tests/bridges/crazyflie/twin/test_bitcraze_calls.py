"""What Bitcraze's examples and acceptance tests ask of a Crazyflie, by the same calls of the unmodified cflib over UDP.

One connection serves all: each test is a row of the list in docs/crazyflie.md.
"""

import math
import subprocess
import sys
import threading
from contextlib import closing

import pytest
from cflib import crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.mem import CompressedSegment, CompressedStart, MemoryElement, Poly4D
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crazyflie.syncLogger import SyncLogger
from cflib.utils.power_switch import PowerSwitch

from bridges.crazyflie.twin.device import CrazyflieTwin
from tests.requests import request
from tests.twins.loopback import Served
from tests.waiting import until
from twins.device import DeviceRequest, Faults

pytestmark = pytest.mark.system

ANSWER_S = 20.0


@pytest.fixture(scope="module")
def connected(tmp_path_factory):
    """A twin, and cflib connected to it with all parameters read."""
    if not crtp.CLASSES:
        crtp.init_drivers()
    with Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"])) as twin:
        cf = Crazyflie(rw_cache=str(tmp_path_factory.mktemp("cache")))
        cf.link_statistics.start = lambda: None  # its thread of pings may join itself at the end
        with SyncCrazyflie(twin.addresses[0], cf=cf) as scf:
            scf.wait_for_params()
            yield scf, twin


@pytest.fixture
def scf(connected):
    return connected[0]


@pytest.fixture
def cf(scf):
    return scf.cf


def memory(cf, kind):
    (found,) = cf.mem.get_mems(kind)
    return found


def updates(cf, name):
    """Values of a parameter that arrive from now on, as text."""
    said = []
    group, own = name.split(".")
    cf.param.add_update_callback(group=group, name=own, cb=lambda _, text: said.append(text))
    return said


def answered(call, *arguments):
    """Arguments of the callback that `call` gets as its last argument."""
    said, came = [], threading.Event()

    def callback(*values):
        said.extend(values)
        came.set()

    call(*arguments, callback)
    assert came.wait(ANSWER_S)
    return said


def logged(scf, **variables):
    block = LogConfig("test", 10)
    for name, kind in variables.items():
        block.add_variable(name.replace("__", "."), kind)
    with SyncLogger(scf, block) as logger:
        return [next(logger)[1]]


def test_parameters_of_examples(cf):
    for name, value in (
        ("led.bitmask", 255),  # sbs_swarm, lights of a swarm
        ("ring.fadeTime", 0.5),  # synchronized_sequence
        ("colorLedBot.wrgb8888", 0x10203040),  # color_led_set
        ("pid_attitude.pitch_kd", 0.1234),  # basicparam
        ("powerDist.idleThrust", 1200),
    ):
        said = updates(cf, name)
        cf.param.set_value(name, value)
        until(lambda said=said, value=value: said and float(said[-1]) == pytest.approx(value), f"{name} confirmed")
        assert float(cf.param.get_value(name)) == pytest.approx(value)
    said = updates(cf, "ring.effect")
    cf.param.set_value_raw("ring.effect", 0x08, 13)
    cf.param.request_param_update("ring.effect")
    until(lambda: "13" in said, "set by its name")
    said = updates(cf, "deck.bcFlow2")  # sbs_motion_commander waits for it
    cf.param.request_param_update("deck.bcFlow2")
    until(lambda: said == ["1"], "the deck is there")


def test_variables_of_examples(scf):
    state = {f"kalman__state{axis}": "float" for axis in ("X", "Y", "Z", "PX", "PY", "PZ")}
    assert set(logged(scf, **state)[0]) == {name.replace("__", ".") for name in state}
    variances = {f"gyro__{axis}Variance": "float" for axis in "xyz"}  # the largest block, 26 bytes
    angles = dict.fromkeys(("stabilizer__roll", "stabilizer__pitch", "acc__z"), "float")
    (values,) = logged(scf, **angles, stabilizer__thrust="uint16_t", **variances)
    assert 0.9 < values["acc.z"] < 1.1
    assert all(values[f"gyro.{axis}Variance"] > 0.0 for axis in "xyz")
    power = logged(scf, pm__vbat="FP16", pm__batteryLevel="uint8_t", health__batteryPass="uint8_t")[0]
    assert (3.0 < power["pm.vbat"] < 4.3, power["pm.batteryLevel"]) == (True, 90)
    supervisor = logged(scf, supervisor__info="uint16_t", sys__canfly="uint8_t", radio__isConnected="uint8_t")[0]
    assert (supervisor["supervisor.info"] & 8, supervisor["sys.canfly"], supervisor["radio.isConnected"]) == (8, 1, 1)


def test_eeprom_and_led_ring(cf):
    eeprom = memory(cf, MemoryElement.TYPE_I2C)
    answered(eeprom.update)
    assert (eeprom.elements["radio_channel"], eeprom.elements["radio_address"]) == (80, 0xE7E7E7E7E7)
    eeprom.elements["pitch_trim"] = 1.5
    answered(eeprom.write_data)
    eeprom.elements = {}
    answered(eeprom.update)
    assert (eeprom.valid, eeprom.elements["pitch_trim"]) == (True, 1.5)
    ring = memory(cf, MemoryElement.TYPE_DRIVER_LED)
    ring.leds[3].set(r=0, g=100, b=0)
    assert answered(ring.write_data)[0] is ring


def test_memories_of_decks_and_tester(cf, scf):
    assert answered(memory(cf, MemoryElement.TYPE_DECK_MEMORY).query_decks) == [{}]
    deck = memory(cf, MemoryElement.TYPE_1W)
    answered(deck.update)
    assert (deck.elements["Board name"], deck.vid, deck.pid) == ("bcFlow2", 0xBC, 0x0F)
    tester = memory(cf, MemoryElement.TYPE_MEMORY_TESTER)
    assert answered(tester.read_data, 5, 1000) == [tester]
    cf.param.set_value("memTst.resetW", "1")
    assert answered(tester.write_data, 5, 1000)[0] is tester
    assert logged(scf, memTst__errCntW="uint32_t") == [{"memTst.errCntW": 0}]


def test_console_and_supervisor(cf):
    said = []
    cf.console.receivedChar.add_callback(said.append)
    cf.param.set_value("system.assertInfo", 1)
    until(lambda: "No assert" in "".join(said), "text on the console")
    assert int(cf.param.get_value("system.selftestPassed")) == 1  # all acceptance tests begin with it
    assert cf.supervisor.is_auto_armed
    assert cf.supervisor.can_fly
    assert not any((cf.supervisor.is_crashed, cf.supervisor.is_tumbled, cf.supervisor.is_locked))


def test_scan():
    """radio/scan: twins started by hand are where cflib looks."""
    asked = DeviceRequest(request("crazyflie", ["crazyflie-twin"] * 2), Faults(), by_hand=True)
    with Served(lambda _: CrazyflieTwin(asked), asked.body) as twins:
        assert all(address.startswith("udp://127.0.0.1:1985") for address in twins.addresses)
        scan = "from cflib.crtp.udpdriver import UdpDriver; print(*(uri for uri, _ in UdpDriver().scan_interface()))"
        # a process of its own: each port without an answer leaks a socket
        found = subprocess.run([sys.executable, "-c", scan], capture_output=True, text=True, check=True, timeout=60)
        assert set(twins.addresses) <= set(found.stdout.split())


def test_power_cycle():
    other = Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"]))
    with other, closing(PowerSwitch(other.addresses[0])) as switch:
        switch.stm_power_down()
        until(lambda: not other.device.drones[0].on, "it is off")
        switch.stm_power_up()
        until(lambda: other.device.drones[0].on, "it is on again")


def test_trajectories_and_spirals_are_flown(connected):
    """autonomous_sequence_high_level, ..._compressed, circling_square, christmas_tree: flown, not only answered."""
    scf, twin = connected
    cf, high = scf.cf, scf.cf.high_level_commander
    rise = [0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0]  # from 0 to 1 m in 1 s, at rest at both ends
    trajectories = memory(cf, MemoryElement.TYPE_TRAJ)
    trajectories.trajectory = [Poly4D(1.0, x=Poly4D.Poly(rise)), Poly4D(0.2, x=Poly4D.Poly([1.0] + 7 * [0.0]))]
    assert trajectories.write_data_sync()
    trajectories.trajectory = [
        CompressedStart(0.0, 0.0, 0.0, 0.0),
        CompressedSegment(1.0, [], [0.0, 1.0, 1.0], [], []),
        CompressedSegment(0.0, [], [], [], []),
    ]
    assert trajectories.write_data_sync(0x200)
    high.define_trajectory(1, 0, 2)
    high.define_trajectory(2, 0x200, 1, high.TRAJECTORY_TYPE_POLY4D_COMPRESSED)

    def place():
        return twin.truth()[0][0]

    def reached(x, y, z):
        until(lambda: math.dist(place(), (x, y, z)) < 0.06, f"it is at {x}, {y}, {z}: {place()}")

    high.takeoff(0.4, 1.0)
    reached(0.0, 0.0, 0.4)
    high.start_trajectory(1, 0.8, relative_position=True)
    reached(1.0, 0.0, 0.4)
    high.start_trajectory(2, 1.0, relative_position=True)
    reached(1.0, 1.0, 0.4)
    high.spiral(math.pi / 2, 0.4, 0.4, 0.2, 1.0, clockwise=True)
    reached(1.4, 0.6, 0.6)
    high.land(0.0, 1.0)
    until(lambda: place()[2] == 0.0, "landed")
