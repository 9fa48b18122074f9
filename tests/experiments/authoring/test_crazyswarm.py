"""The drones of Crazyswarm2 and Crazyswarm become experiments that are sound and fly."""

import math
from itertools import combinations

import pytest

from experiments.authoring.crazyswarm import convert_text, is_crazyswarm
from experiments.check.check import examine
from experiments.file import document
from experiments.file.problems import DocumentError
from tests.commands import invoke
from tests.runs import fly

HEAD = "# drones of a laboratory\nrobots:\n"
DRONE = """  {name}:
    enabled: {enabled}
    uri: {uri}
    initial_position: {place}
    type: cf21  # see robot_types
    firmware_params: {{kalman: {{pNAcc_xy: 1.0}}}}
"""
TYPES = """robot_types:
  cf21:
    motion_capture: {{enabled: {captured}, marker: default, dynamics: default}}
    big_quad: false
    battery: {{voltage_warning: 3.8, voltage_critical: 3.7}}
all:
  firmware_logging: {{enabled: false, default_topics: {{pose: {{frequency: 10}}}}}}
  firmware_params:
    stabilizer: {{estimator: 2, controller: 2}}
    kalman: {{pNAcc_xy: 0.7}}
    posCtlPid: {{xKp: 90.0}}
    pm: {{lowVoltage: 2.9}}
  broadcasts: {{num_repeats: 15, delay_between_repeats_ms: 1}}
"""
OLD = "crazyflies:\n- {id: 1, channel: 100, initialPosition: [1.5, 1.5, 0.0], type: default}\n"
OLD += "- {id: 12, channel: 110, initialPosition: [0.5, 1.5, 0.0], type: default}\n"


def drone(number, enabled="true", radio=0, channel=80, place=None):
    uri = f"radio://{radio}/{channel}/2M/E7E7E7E7{number:02X}"
    return DRONE.format(name=f"cf{number}", enabled=enabled, uri=uri, place=place or f"[0.0, {0.5 * number}, 0.0]")


def swarm(*drones, captured="false"):
    return HEAD + "".join(drones) + TYPES.format(captured=captured)


def converted(text, folder="."):
    made, notes = convert_text(text, f"{folder}/crazyflies.yaml", 20.0)
    return document.loads(made), " | ".join(notes)


def test_enabled_drones_fly_by_their_radios():
    read, notes = converted(swarm(drone(1), drone(2, "false"), drone(3, radio=1, channel=90), captured="true"))
    robots = read.experiment.robots
    assert {name: (each.body, each.process, each.start) for name, each in robots.items()} == {
        "cf1": ("radio://0/80/2M/E7E7E7E701", "radio0", [0.0, 0.5]),
        "cf3": ("radio://1/90/2M/E7E7E7E703", "radio1", [0.0, 1.5]),
    }
    assert {each.position for each in robots.values()} == {"external"}
    assert read.experiment.positioning == "vicon-twin"
    assert all(word in notes for word in ("left out: cf2", "motion_capture.yaml", "stabilizer.estimator", "broadcasts"))
    assert robots["cf1"].device == {"parameters": {"stabilizer.controller": 2, "kalman.pNAcc_xy": 1.0}}
    assert "posCtlPid.xKp = 90 is far from the firmware's own 2; choose 0.5 to 8" in notes
    assert "pm.lowVoltage is a protection of the drone" in notes
    assert "cf1, cf3: Crazyswarm tells drones with equal markers apart" in notes
    found, _ = examine(read)
    assert {each.severity for each in found} == {"note"}  # none says that something is not compiled
    log = fly(read.experiment).log
    assert log.true_position[:, :, 2].max(axis=0) == pytest.approx([0.63, 0.63], abs=0.06)


@pytest.mark.parametrize(("tracking", "said"), [("vendor", False), ("librigidbodytracker", True)])
def test_equal_markers_need_rigid_bodies_of_a_name(tracking, said):
    text = swarm(drone(1)).replace("enabled: false, marker", f'tracking: "{tracking}", marker')
    read, notes = converted(text)
    assert read.experiment.robots["cf1"].position == "external"
    assert ("equal markers" in notes) == said


def test_motion_capture_is_that_of_the_file_beside(tmp_path):
    beside = "/motion_capture_tracking:\n  ros__parameters: {{type: {}, hostname: 192.168.0.5}}\n"
    (tmp_path / "motion_capture.yaml").write_text(beside.format("vicon"))
    text = swarm(drone(1), captured="true")
    assert converted(text, tmp_path)[0].experiment.positioning == "vicon://192.168.0.5"
    (tmp_path / "motion_capture.yaml").write_text(beside.format("optitrack"))
    capture = converted(text, tmp_path)[0].experiment.capture
    assert (capture.source, capture.up) == ("optitrack://192.168.0.5", "z")
    (tmp_path / "motion_capture.yaml").write_text(beside.format("optitrack_closed_source"))
    assert converted(text, tmp_path)[0].experiment.positioning.source == "optitrack://192.168.0.5"
    (tmp_path / "motion_capture.yaml").write_text("just text\n")
    with pytest.raises(DocumentError, match=r"motion_capture\.yaml"):
        converted(text, tmp_path)


def test_drones_on_one_place_are_put_apart():
    read, notes = converted(swarm(*(drone(k, place="[0.0, 0.0, 0.0]") for k in range(1, 13))))
    starts = [each.start for each in read.experiment.robots.values()]
    assert starts[0] == [0.0, 0.0]
    assert min(math.dist(*pair) for pair in combinations(starts, 2)) == pytest.approx(0.5)
    assert read.text.count("# made up") == 11
    assert "cf12" in notes


def test_radio_has_one_channel_and_carries_its_drones():
    read, notes = converted(swarm(drone(1), drone(2, channel=100), *(drone(k) for k in range(3, 12)), captured="true"))
    robots = read.experiment.robots
    assert robots["cf2"].body == "radio://1/100/2M/E7E7E7E702"
    assert (robots["cf2"].process, {*robots["cf2"].device}) == ("radio1", {"parameters"})
    assert robots["cf1"].device["stream_hz"] < 10.0
    assert "channel 100, 2M, are on radio 1" in notes
    assert "radio 0 has 10 drones" in notes


def test_crazyswarm_of_ros_1():
    robots = converted(OLD)[0].experiment.robots
    assert {name: (each.body, each.start) for name, each in robots.items()} == {
        "cf1": ("radio://0/100/2M/E7E7E7E701", [1.5, 1.5]),
        "cf12": ("radio://1/110/2M/E7E7E7E70C", [0.5, 1.5]),
    }


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("    uri: radio://0/80/2M/E7E7E7E701\n", "", "robots.cf1: uri is missing|write uri: radio://"),
        ("radio://0/80/2M/E7E7E7E701", "radio://*/80/2M/E7E7E7E701", "robots.cf1.uri: 'radio://*/80|a serial number"),
        ("E7E7E7E701", "E7E7E7E702", "robots.cf2.uri: cf1 and cf2 have one address|Crazyflie client"),
        ("[0.0, 0.5, 0.0]", "[0.0, 0.5]", "robots.cf1.initial_position|give x, y"),
        ("[0.0, 0.5, 0.0]", "[0.0, here, 0.0]", "robots.cf1.initial_position[1]|`float`"),
        ("enabled: true", "enabled: maybe", "robots.cf1.enabled|`bool`"),
        ("enabled: true", "enabled: false", "no drone is enabled|enabled: true"),
        ("type: cf21 ", "type: cf2 ", "robots.cf1.type: no 'cf2'|did you mean 'cf21'"),
        ("  cf1:", "  1cf:", "'1cf' cannot be a name|beginning with a letter"),
        ("  cf1:", "  cf2:", "'cf2' stands twice"),
        ("robots:\n", "robots: [cf1, cf2]\nothers:\n", "not listed as Crazyswarm2|by name"),
    ],
)
def test_error_names_the_key_and_the_remedy(old, new, said, tmp_path):
    text = swarm(drone(1), drone(2))
    assert old in text
    (tmp_path / "crazyflies.yaml").write_text(text.replace(old, new))
    done = invoke("import", tmp_path / "crazyflies.yaml", tmp_path / "made.toml", code=None)
    assert isinstance(done.exception, DocumentError)
    assert all(word in str(done.exception) for word in said.split("|")), str(done.exception)
    assert not (tmp_path / "made.toml").exists()


def test_options_of_the_other_format_are_refused(tmp_path):
    file = tmp_path / "crazyflies.yaml"
    file.write_text(swarm(drone(1)))
    assert is_crazyswarm(str(file), file.read_text())
    assert "--poses" in invoke("import", file, "--gain", "stable", code=2).output
    assert "check" in invoke("import", file, tmp_path / "made.toml", "--duration", "30").output
    assert document.read(tmp_path / "made.toml").experiment.duration_s == 30.0
