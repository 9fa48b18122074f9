"""Geometry of Lighthouse and Loco, and firmware parameters: what is refused before it is sent, and by `check`."""

import math

import pytest
import yaml

from agents.body.interface import BodyEntry, BodyError
from bridges.crazyflie.body import CrazyflieBody
from bridges.crazyflie.geometry import check_anchors, stations
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.crazyflie.positioning import configure
from bridges.crazyflie.protocol.addresses import CrazyflieSettings, Lighthouse, Loco

for_each = pytest.mark.parametrize
EYE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
MIRROR = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
TWICE = [[2.0 * value for value in row] for row in EYE]
SWEEP = dict.fromkeys(("phase", "tilt", "curve", "gibmag", "gibphase", "ogeemag", "ogeephase"), 0.0)
ABOVE, CUBE = [(x, y, 3.0) for x in (0, 3) for y in (0, 3)], [(0, 0, 0), (3, 0, 2), (0, 3, 2), (3, 3, 0)]


@pytest.fixture
def saved(tmp_path):
    def save(number=1, origin=(0.5, -0.8, 2.2), rotation=EYE, phase=0.0, change=str):
        station = {"origin": list(origin), "rotation": [list(row) for row in rotation]}
        calibration = {"sweeps": [SWEEP | {"phase": phase}, SWEEP], "uid": 7}
        content = {"type": "lighthouse_system_configuration", "version": "1", "systemType": 2}
        content |= {"geos": {0: {"origin": [0.0, 0.0, 2.0], "rotation": EYE}, number: station}}
        file = tmp_path / "stations.yaml"
        file.write_text(change(yaml.safe_dump(content | {"calibs": {number: calibration}})))
        return str(file)

    return save


@for_each(
    ("wrong", "said"),
    [
        ({"origin": [-500.0, -800.0, 2200.0]}, "base station 2 is at (-500, -800, 2200) m"),
        ({"rotation": MIRROR}, "base station 2 has a rotation that mirrors, with the determinant -1"),
        ({"rotation": TWICE}, "base station 2 has a rotation with rows that are not orthonormal, by 3"),
        ({"origin": [math.nan, 0.0, 0.0]}, "base station 2 has a place or rotation that is no number"),
        ({"phase": math.inf}, "a calibration of base station 2 is no number"),
        ({"number": -1}, "base station 0, the firmware knows 4"),
    ],
)
def test_impossible_stations_are_refused_unsent(saved, wrong, said):
    file = saved(**wrong)
    with pytest.raises(BodyError) as caught:
        configure(None, CrazyflieSettings(positioning=Lighthouse(file=file), estimator=None))  # no link: unsent
    assert said in str(caught.value)


def test_other_writers_numbers_are_read(saved):
    """A writer that gives 1e-05 without a point, which YAML reads as text; a rotation rounded to three digits."""
    turn = [[0.866, -0.5, 0.0], [0.5, 0.866, 0.0], [0.0, 0.0, 1.0]]
    file = saved(rotation=turn, origin=[1e-05, 0.5, 2.0], change=lambda text: text.replace("1.0e-05", "1e-05"))
    read = stations(file, 4)
    assert read.geos[1].origin == [1e-05, 0.5, 2.0]


@for_each(
    ("anchors", "said"),
    [
        ([(0, 0, 2000), *CUBE], "anchor 0 is at (0, 0, 2000) m"),
        ([*CUBE, (math.nan, 0, 0)], "anchor 4 is at (nan, 0, 0) m"),
        (CUBE[:3], "3 anchors tell no position in space"),
        ([(x, 0.0, 2.0) for x in range(4)], "in one line"),
        ([(x, y, 0.1) for x, y, _ in CUBE], "in one plane at 0.1 m"),
    ],
)
def test_anchors_that_tell_no_position(anchors, said):
    with pytest.raises(BodyError) as caught:
        configure(None, CrazyflieSettings(positioning=Loco(anchors=anchors)))  # no link: unsent
    assert said in str(caught.value)
    for right in (CUBE, ABOVE, []):
        check_anchors(right)


def faults(positioning=None, host="", **device):
    device |= {"positioning": positioning} if positioning else {}
    address = "radio://0/80/2M/E7E7E7E701"
    entry = BodyEntry("CF01", CRAZYFLIE, address, device, external=False, process="CF01", host=host)
    return [(each.severity, each.here, each.key[1:], each.message) for each in CrazyflieBody.faults([entry])]


@for_each(
    ("name", "value", "said"),
    [
        ("posCtlPid.xKp", 8.0, ""),
        ("posCtlPid.xKp", 8.1, "error: posCtlPid.xKp = 8.1 is far from the firmware's own 2"),
        ("posCtlPid.xKi", 0.1, ""),
        ("posCtlPid.xKi", -0.1, "error: posCtlPid.xKi = -0.1 is no gain"),
        ("posCtlPid.xKi", math.nan, "error: posCtlPid.xKi = nan is no gain"),
        ("stabilizer.controller", 2.0, ""),
        ("stabilizer.controller", 9.0, "error: stabilizer.controller = 9 is no choice"),
        ("posCtlPid.thrustBase", 40000.0, ""),
        ("posCtlPid.thrustBase", 140000.0, "error: posCtlPid.thrustBase = 140000 cannot be held on board"),
        ("posCtlPid.thrustBase", 36000.5, "error: posCtlPid.thrustBase = 36000.5 cannot be held on board"),
        ("motion.disable", 1.0, "error: motion.disable is a protection of the drone"),
        ("flightmode.posSet", 1.0, "error: flightmode.posSet: not for a file"),
        ("supervisor.tmblChckEn", 0.0, "error: supervisor.tmblChckEn is a protection of the drone"),
        ("motorPowerSet.enable", 1.0, "error: motorPowerSet.enable: not for a file, as it turns motors"),
        ("deck.bcLoco", 1.0, "error: deck.bcLoco: not for a file"),
        ("posCtlPid.xKq", 1.0, "warning: posCtlPid.xKq is none of the 402 parameters"),
    ],
)
def test_parameters_are_bounded(name, value, said):
    found = [f"{severity}: {message}" for severity, _, _, message in faults(parameters={name: value})]
    assert [each[: len(said)] for each in found] == [said] * bool(said)
    allowed = faults(parameters={name: value}, unprotected=[name])
    assert allowed == [] or not name.startswith(("supervisor", "motion"))


def test_file_faults_find_geometry_where_it_lies(saved):
    file = saved(rotation=MIRROR)
    ((*of, message),) = faults({"system": "lighthouse", "file": file})
    assert of == ["error", True, ("positioning", "file")]
    assert message.startswith(f"{file}: base station 2 has a rotation that mirrors")
    assert "nowhere.yaml: No such file" in faults({"system": "lighthouse", "file": "nowhere.yaml"})[0][-1]
    assert faults({"system": "lighthouse", "file": "nowhere.yaml"}, host="lab") == []  # it lies there
    ((severity, here, key, _),) = faults({"system": "loco", "anchors": ABOVE})
    assert (severity, here, key) == ("warning", False, ("positioning", "anchors"))
