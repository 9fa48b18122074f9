"""What a Crazyflie twin lists, its values, and whose tables they are."""

import json
import math
import struct
from pathlib import Path

import pytest

from agents.body.interface import BodyError
from agents.protocols.crtp import Log, Port
from tests.twins.crazyflie_wire import Wire
from twins.devices.crazyflie.tables import EXTENDED, LOG_CODES, PACKINGS, READ_ONLY, inventory, pack

# parameters and log variables of a real firmware, where this machine has them: names and types only
PLACES = [folder / "shared" / "prototypes" / "crazyflie-toc.json" for folder in Path(__file__).parents[5:]]
FIRMWARE = next(filter(Path.exists, PLACES), PLACES[0])
CTYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t"}


@pytest.fixture
def files(tmp_path):
    """Tables of parameters and logs of that firmware, as cflib writes them to its cache."""
    if not FIRMWARE.exists():
        pytest.skip(f"{FIRMWARE} with the firmware's tables is not there")
    parameters, logs = json.loads(FIRMWARE.read_text())
    tables = {
        "ParamTocElement": {name: (kind, {"access": int(fixed), "extended": kept})
                            for name, (kind, fixed, kept) in parameters.items()},
        "LogTocElement": {name: (kind, {"access": 0}) for name, kind in logs.items()},
    }  # fmt: skip
    for element, entries in tables.items():
        table = {}
        for ident, (name, (kind, rest)) in enumerate(entries.items()):
            group, own = name.split(".")
            entry = {"__class__": element, "ident": ident, "group": group, "name": own, "pytype": ""}
            table.setdefault(group, {})[own] = entry | {"ctype": CTYPES.get(kind, kind)} | rest
        (tmp_path / f"{element}.json").write_text(json.dumps(table))
    return [str(tmp_path / f"{element}.json") for element in tables]


def logged(wire, *names):
    """Values of log variables, in the type that they have on board."""
    table, values = wire.drone.log_table, []
    for name in names:
        number = table.number[name]
        kind = table.variables[number].type
        wire.put(Port.LOG, 1, Log.RESET)
        wire.log(Log.CREATE, 0, struct.pack("<BH", LOG_CODES[kind], number))
        wire.log(Log.START, 0, 1)
        values.append(PACKINGS[kind].unpack(wire.wait(0.01)[0][2][4:])[0])
    return values


def test_size_of_the_firmware_and_its_numbers():
    tables = inventory()
    assert (len(tables.parameters.variables), len(tables.logs.variables)) == (402, 637)
    assert sum(bool(variable.flags & EXTENDED) for variable in tables.parameters.variables) == 146
    assert pack("u8", 257.9) == b"\1"
    assert pack("i16", -1.0) == b"\xff\xff"
    assert pack("half", 1e9) == PACKINGS["half"].pack(math.inf)


def test_values_of_a_drone_that_stands():
    wire = Wire()
    assert wire.drone.value("system.selftestPassed") == 1
    assert wire.drone.value("deck.bcFlow2") == 1  # without another system of positioning it has a Flow deck
    assert wire.drone.value("pid_rate.roll_kp") == 250.0
    assert logged(wire, "stabilizer.roll", "stabilizer.pitch", "stateEstimate.yaw") == pytest.approx([0.4, -0.3, 0.0])
    assert logged(wire, "acc.x", "acc.y", "acc.z") == pytest.approx([0.0, 0.0, 1.0], abs=0.03)
    assert logged(wire, "supervisor.accNorm") == pytest.approx([1.0])
    assert logged(wire, "motor.m1", "range.front", "stabilizer.thrust") == [0, 0, 0.0]  # it has no Multi-ranger
    assert 0.0 < logged(wire, "gyro.xVariance")[0] < 0.1


def test_values_of_a_drone_that_flies():
    wire = Wire().streaming()
    wire.wait(0.1, lambda: wire.goal(1.0, 0.0, 1.0))
    roll, pitch, qx, qy, qw = logged(wire, *(f"stateEstimate.{name}" for name in ("roll", "pitch", "qx", "qy", "qw")))
    assert pitch < -5.0
    assert abs(roll) < 1.0
    assert (qx, qy, qw) == pytest.approx((0.0, math.sin(math.radians(-0.5 * pitch)), 1.0), abs=0.02)
    assert logged(wire, "motor.m1")[0] == pytest.approx(39300.0, rel=0.01)


def test_tables_of_a_real_firmware(files):
    tables = inventory(tuple(files))
    assert (len(tables.parameters.variables), len(tables.logs.variables)) == (402, 637)
    number = tables.parameters.number
    assert tables.parameters.variables[number["deck.bcFlow2"]].flags == READ_ONLY
    assert tables.parameters.variables[number["pid_rate.roll_kp"]].value == 250.0
    wire = Wire(device={"tables": files, "positioning": {"system": "loco"}})
    assert wire.drone.value("deck.bcLoco") == 1
    assert wire.drone.value("firmware.revision0") == 0.0  # this one has none
    own, real = inventory(), tables
    for tables in ((own.parameters, real.parameters), (own.logs, real.logs)):
        mine, known = ({each.name: (each.type, each.flags) for each in table.variables} for table in tables)
        shared = known.keys() & mine.keys()
        assert {name: mine[name] for name in shared} == {name: known[name] for name in shared}
        assert {name.split(".")[0] for name in mine.keys() - shared} <= {"spare", "firmware", "loco"}
    with pytest.raises(BodyError, match="second table"):
        inventory((files[0], files[0]))


ENTRY = """{"pm": {"vbat": {"__class__": "LogTocElement", "ident": %d, "group": "pm", "name": "vbat",
                        "ctype": "%s", "pytype": "<f", "access": 0}}}"""


def test_other_files_are_refused(tmp_path):
    for k, (text, said) in enumerate(
        (
            ("", "no table of a Crazyflie"),
            ("[]", "no table of a Crazyflie"),
            ('{"pm": {"vbat": {"ident": 0}}}', "no table of a Crazyflie"),
            (ENTRY % (3, "float"), "0, 1, 2"),
            (ENTRY % (0, "float128"), "unknown type float128"),
        )
    ):
        file = tmp_path / f"table{k}.json"
        file.write_text(text)
        with pytest.raises(BodyError, match=said):
            inventory((str(file),))
