"""What a Crazyflie twin lists, its values, and whose tables they are."""

import json
import math
import struct

import pytest

from agents.body.interface import BodyError
from agents.protocols.crtp import Log, Port
from tests.twins.crazyflie_wire import Wire
from tests.twins.firmware_tables import FIRMWARE, cached
from twins.devices.crazyflie.tables import EXTENDED, PACKINGS, READ_ONLY, inventory, pack


def logged(wire, *names):
    """Values of log variables, in the type that they have on board."""
    table, values = wire.drone.log_table, []
    for name in names:
        number = table.number[name]
        kind = table.variables[number].type
        wire.put(Port.LOG, 1, int(Log.RESET))
        wire.put(Port.LOG, 1, int(Log.CREATE), 0, struct.pack("<BH", {"float": 7, "u16": 2, "u8": 1}[kind], number))
        wire.put(Port.LOG, 1, int(Log.START), 0, 1)
        values.append(PACKINGS[kind].unpack(wire.wait(0.01)[0][2][4:])[0])
    return values


def test_size_of_the_firmware():
    """As many parameters, storable ones and log variables as a real drone sends when a client connects."""
    tables = inventory()
    assert len(tables.parameters.variables) == 402
    assert sum(bool(variable.flags & EXTENDED) for variable in tables.parameters.variables) == 146
    assert len(tables.logs.variables) == 637


def test_numbers_are_packed_as_in_c():
    assert pack("u8", 257.9) == b"\1"
    assert pack("i16", -1.0) == b"\xff\xff"
    assert pack("half", 1e9) == PACKINGS["half"].pack(math.inf)


def test_values_of_a_drone_that_stands():
    wire = Wire()
    assert wire.drone.value("system.selftestPassed") == 1
    assert wire.drone.value("deck.bcFlow2") == 1  # without another system of positioning it has a Flow deck
    assert wire.drone.value("pid_rate.roll_kp") == 250.0
    roll, pitch, yaw = logged(wire, "stabilizer.roll", "stabilizer.pitch", "stateEstimate.yaw")
    assert 0.1 < abs(roll) < 1.0
    assert 0.1 < abs(pitch) < 1.0
    assert yaw == 0.0
    x, y, z, norm = logged(wire, "acc.x", "acc.y", "acc.z", "supervisor.accNorm")
    assert (x, y, z) == (pytest.approx(0.0, abs=0.03), pytest.approx(0.0, abs=0.03), pytest.approx(1.0, abs=0.03))
    assert norm == pytest.approx(1.0)
    assert logged(wire, "motor.m1", "range.front", "stabilizer.thrust") == [0, 0, 0.0]  # it has no Multi-ranger
    assert 0.0 < logged(wire, "gyro.xVariance")[0] < 0.1


def test_values_of_a_drone_that_flies():
    """Nose down to accelerate; the quaternion is that of the angles."""
    wire = Wire().streaming()
    wire.wait(0.1, lambda: wire.goal(1.0, 0.0, 1.0))
    roll, pitch, qx, qy, qw = logged(
        wire, "stateEstimate.roll", "stateEstimate.pitch", *(f"stateEstimate.q{axis}" for axis in "xyw")
    )
    assert pitch < -5.0
    assert abs(roll) < 1.0
    assert qy > 0.04
    assert abs(qx) < 0.01
    assert qw == pytest.approx(1.0, abs=0.02)
    assert logged(wire, "motor.m1")[0] == pytest.approx(39300.0, rel=0.01)


# ---------------------------------------------------------------------- a lab's own tables


@pytest.fixture
def files(tmp_path):
    """Tables of a real firmware, as cflib keeps them in its cache."""
    if not FIRMWARE.exists():
        pytest.skip(f"{FIRMWARE} with the firmware's tables is not there")
    return cached(tmp_path)


@pytest.mark.slow
def test_tables_of_a_real_firmware(files):
    tables = inventory(tuple(files))
    assert (len(tables.parameters.variables), len(tables.logs.variables)) == (402, 637)
    number = tables.parameters.number
    assert tables.parameters.variables[number["deck.bcFlow2"]].flags == READ_ONLY
    assert tables.parameters.variables[number["pid_rate.roll_kp"]].value == 250.0
    wire = Wire(device={"tables": files, "positioning": {"system": "loco"}})
    assert wire.drone.value("deck.bcLoco") == 1
    assert wire.drone.value("firmware.revision0") == 0.0  # this one has none
    assert wire.hovering().flock.estimate[0, 2] == pytest.approx(1.0, abs=0.01)


def test_built_in_tables_agree_with_a_real_firmware(files):
    """Names and types; what is ours alone is known."""
    own, real = inventory(), inventory(tuple(files))
    for ours, theirs in ((own.parameters, real.parameters), (own.logs, real.logs)):
        known = {variable.name: (variable.type, variable.flags) for variable in theirs.variables}
        mine = {variable.name: (variable.type, variable.flags) for variable in ours.variables}
        shared = known.keys() & mine.keys()
        assert {name: mine[name] for name in shared} == {name: known[name] for name in shared}
        assert {name.split(".")[0] for name in mine.keys() - shared} <= {"spare", "firmware", "loco"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no table of a Crazyflie"),
        ("[]", "no table of a Crazyflie"),
        ('{"pm": {"vbat": {"ident": 0}}}', "no table of a Crazyflie"),
        (json.dumps({"pm": {"vbat": {"__class__": "LogTocElement", "ident": 3, "group": "pm", "name": "vbat",
                                     "ctype": "float", "pytype": "<f", "access": 0}}}), "0, 1, 2"),
        (json.dumps({"pm": {"vbat": {"__class__": "LogTocElement", "ident": 0, "group": "pm", "name": "vbat",
                                     "ctype": "float128", "pytype": "<f", "access": 0}}}), "unknown type float128"),
    ],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, text, said):
    file = tmp_path / "table.json"
    file.write_text(text)
    with pytest.raises(BodyError, match=said):
        inventory((str(file),))


def test_two_tables_of_a_kind_are_refused(files):
    with pytest.raises(BodyError, match="second table"):
        inventory((files[0], files[0]))
