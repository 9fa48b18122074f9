"""Files in the structure of Robotic Park's authors become experiments that are sound and run."""

import numpy as np
import pytest

from experiments import assign, document, virtual
from experiments.check import check, figures
from experiments.importing import command, imported
from experiments.problem import DocumentError
from tests.experiments.robotic_park_files import column, dome, file, robot

FILES = {
    5: lambda: dome(5, speaks="Continuous", pose_ms=50),
    8: lambda: dome(8, real=(1, 2, 5)),
    12: lambda: column(12, 4, real=(0, 3)),
    15: lambda: column(15, positioning="Extern", protocol="EventBased"),
    20: lambda: dome(20, origin=True),
}


def converted(tmp_path, text, name="park"):
    made, notes = imported(text, f"{name}.yaml", 20.0)
    path = tmp_path / f"{name}.toml"
    path.write_text(made)
    return document.read(path), notes


@pytest.mark.parametrize("count", FILES)
def test_they_convert_and_pass_the_check(tmp_path, count):
    read, notes = converted(tmp_path, FILES[count]())
    assert len(read.experiment.robots) == count
    assert [(found.code, found.message) for found in check(read) if found.severity != "note"] == []
    assert figures(read.experiment).residual_mm < 1.0
    for note in notes:  # each stands in the file as well
        assert note.split()[0] in read.text


@pytest.mark.slow
@pytest.mark.parametrize("count", FILES)
def test_they_run(tmp_path, count):
    experiment = converted(tmp_path, FILES[count]())[0].experiment
    log = virtual.simulate(experiment, [1])
    law = assign.assign(experiment, tuple(experiment.robots)).law
    net = assign.all_links(experiment)
    last = log.true_position[np.searchsorted(log.time, 19.9)]
    allowed = experiment.tolerance if experiment.formation.update is None else 0.15  # what a chain of thresholds leaves
    assert law.error(last, last[net.speaker], net).max() < allowed


def test_a_distance_task(tmp_path):
    experiment = converted(tmp_path, dome(5, speaks="Continuous", pose_ms=50))[0].experiment
    assert experiment.trigger == {"kind": "periodic", "period_s": 0.05}
    assert (experiment.rates.pose_hz, experiment.rates.coordination_hz) == (20.0, 10.0)
    assert experiment.formation.law == "distance"
    assert experiment.formation.clamp == 0.1
    distances = list(experiment.formation.links.values())
    assert experiment.formation.gain == pytest.approx(2.0 * 0.25 / np.mean(distances), rel=1e-3)
    assert all(" - " in link for link in experiment.formation.links)
    assert {robot.body for robot in experiment.robots.values()} == {"twin"}


def test_a_hybrid_one_keeps_addresses_and_shares_the_radio(tmp_path):
    read, notes = converted(tmp_path, FILES[8]())
    robots = read.experiment.robots
    assert [name for name, each in robots.items() if each.body != "twin"] == ["dron02", "dron03", "dron06"]
    assert robots["dron02"].body == "radio://0/80/2M/E7E7E7E702"
    assert {each.process for each in robots.values()} == {None, "radio0"}
    assert any("--bodies twin" in note for note in notes)


def test_drones_hover_at_the_heights_of_the_shape(tmp_path):
    read, notes = converted(tmp_path, FILES[20]())
    experiment = read.experiment
    heights = np.array([robot.hover for robot in experiment.robots.values()])
    assert heights.min() == pytest.approx(0.7, abs=1e-3)  # where all of them start
    assert np.ptp(heights) > 0.8
    centre = {tuple(anchor.to) for anchor in experiment.formation.anchors.values()}
    assert len(centre) == 1
    assert len(experiment.formation.anchors) == 20
    assert any("lifted" in note for note in notes)


def test_a_pose_task_with_twins_beside_robots(tmp_path):
    experiment = converted(tmp_path, FILES[12]())[0].experiment
    assert experiment.formation.law == "displacement"
    assert experiment.formation.stiffness == 0.25
    first, second = experiment.robots["khepera00"], experiment.robots["khepera01"]
    assert first.body == "khepera4://192.168.0.21:50000"
    assert first.shadow is not None
    assert second.body == "twin"
    link = experiment.formation.links["khepera00 > khepera01"]
    assert link.offset == [0.0, 0.5]  # of khepera01 from khepera00
    assert experiment.robots["dron11"].hover == 0.7


def test_control_on_events_and_positions_from_outside(tmp_path):
    experiment = converted(tmp_path, FILES[15]())[0].experiment
    assert experiment.formation.update == {"kind": "relative-control", "floor": 0.005, "share": 0.1}
    assert experiment.trigger == {"kind": "send-on-delta", "threshold": 0.01}
    assert {each.position for each in experiment.robots.values()} == {"external"}
    assert experiment.positioning == "vicon-twin"


def three(relations, **more):
    """Kheperas on a triangle of 0.8 m; `relations` of each."""
    place = [(0.0, 0.0, 0.0), (0.9, 0.0, 0.0), (0.4, 0.7, 0.0)]
    return [robot(k + 1, f"khepera0{k + 1}", place[k], relations[k], **more) for k in range(3)]


TRIANGLE = (["khepera02_0.8", "khepera03_0.8"], ["khepera01_0.8", "khepera03_0.8"], ["khepera01_0.8", "khepera02_0.8"])


def test_one_way_links_and_those_of_two_minds(tmp_path):
    relations = (["khepera02_0.8"], ["khepera01_0.9", "khepera03_0.8"], ["khepera02_0.8", "khepera01_0.8"])
    read, notes = converted(tmp_path, file(three(relations)))
    assert dict(read.experiment.formation.links) == {
        "khepera02 > khepera01": 0.8,
        "khepera01 > khepera02": 0.9,
        "khepera03 - khepera02": 0.8,
        "khepera01 > khepera03": 0.8,
    }
    assert any("different things" in note for note in notes)


def test_who_has_another_gain_keeps_it(tmp_path):
    robots = three(TRIANGLE)
    robots[0] = robot(1, "khepera01", (0, 0, 0), TRIANGLE[0], gain=0.4)
    links = converted(tmp_path, file(robots))[0].experiment.formation.links
    assert links["khepera02 > khepera01"].gain == pytest.approx(1.0)  # 2 · 0.4 / 0.8
    assert links["khepera01 > khepera02"] == 0.8
    assert links["khepera03 - khepera02"] == 0.8


def test_a_pid_pulls_as_the_square(tmp_path):
    formation = converted(tmp_path, file(three(TRIANGLE, law="pid")))[0].experiment.formation
    assert formation.gain == pytest.approx(0.25 / 0.64, rel=1e-3)


@pytest.mark.parametrize(
    ("relation", "anchor", "note"),
    [
        ("origin_0.462", "distance = 0.462, to = [0, 0, 0]", ""),
        ("sphere_0.5-0.1-0.2-0.0", "distance = 0.5, to = [0.1, 0.2, 0]", ""),
        ("line_0.0_0.1_0.0_1.0_0.0_0.0", "to = [0, 0.1, 0], along = [1, 0, 0]", ""),
        ("cone_1.0-1.0-0.0-0.0-0.0", "", "cone"),
        ("ellipsoid_0-0-0_1-1-1", "", "ellipsoid"),
    ],
)
def test_places(tmp_path, relation, anchor, note):
    relations = ([*TRIANGLE[0], relation], *TRIANGLE[1:])
    read, notes = converted(tmp_path, file(three(relations)))
    assert anchor in read.text
    assert ("[formation.anchors]" in read.text) == bool(anchor)
    assert any(note in each for each in notes)


def test_an_origin_that_contradicts_the_distances_is_left_out(tmp_path):
    relations = [[*each, "origin_2.0"] for each in TRIANGLE]
    read, notes = converted(tmp_path, file(three(relations)))
    assert not read.experiment.formation.anchors
    assert any("contradict" in note for note in notes)


def test_everything_that_is_left_behind_is_told(tmp_path):
    robots = three(TRIANGLE)
    robots[1] = robot(2, "khepera02", (0.9, 0, 0.3), TRIANGLE[1], place="physical", threshold=0.02)
    robots[1] = robots[1].replace("agent_ip: 192.168.0.22", "agent_ip: ''").replace("role: consensus", "role: leader")
    text = file(robots, "hybrid", "centralized", "True").replace("period: 0.1\n", "period: 0.15\n")
    read, notes = converted(tmp_path, text)
    assert read.experiment.architecture == "centralised"
    told = " | ".join(notes)
    for word in ("simulator", "Data_Logging", "khepera02 is real", "leader", "third number", "commonest",
                 "6.66667 Hz become"):  # fmt: skip
        assert word in told


@pytest.mark.parametrize(
    ("old", "new", "said", "line"),
    [
        ("mode: virtual ", "mode: virtuel ", "cannot be 'virtuel'", 3),
        ("name: khepera02", "name: rover02", "what kind of robot is 'rover02'", None),
        ("name: khepera02", "name: khepera01", "two robots are called 'khepera01'", None),
        ("type: virtual\n    name: khepera02", "type: imagined\n    name: khepera02", "cannot be 'imagined'", None),
        ("pose: 0.90, 0.00, 0.00", "pose: 0.90; 0.00", "must be numbers", None),
        ("pose: 0.90, 0.00, 0.00", "pose: 0.90", "has 1 numbers", None),
        ("    pose: 0.90, 0.00, 0.00\n", "", "'pose' is missing in 'Robots.Robot02'", None),
        ("khepera03_0.8", "khepera04_0.8", "no robot is called 'khepera04'", None),
        ("khepera03_0.8", "khepera03_x", "is no relation of a distance task", None),
        ("khepera03_0.8", "khepera03_-0.8", "not positive", None),
        ("khepera03_0.8", "khepera01_0.8", "to itself", None),
        ("gain: 0.25", "gain: strong", "must be a number, not 'strong'", None),
        ("gain: 0.25", "gain: .inf", "must be a number", None),
        ("gain: 0.25", "gain: -1", "must be more than 0", None),
        ("enable: True\n      T: 100", "enable: perhaps\n      T: 100", "must be True or False", None),
        ("type: distance", "type: bearing", "cannot be 'bearing'", None),
        ("upperLimit: 0.1", "upperLimit: -0.2", "no step lies between", None),
        ("Robots:\n", "Robots: none\nElse:\n", "must be a table, not 'none'", None),
        ("Robots:\n", "Robotss:\n", "'Robots' is missing", None),
        ("  mode: virtual ", " \tmode: virtual ", "", 3),
        ("tool: Webots", "tool: 'Webots", "", None),
        ("tool: Webots", "tool: !!python/object/apply:os.system ['true']", "the tag", 4),
        ("tool: Webots", "tool: *nothing", "undefined alias", 4),
        ("  tool: Webots\n", "  tool: Webots\n  tool: Gazebo\n", "stands twice", 5),
        ("  tool: Webots\n", "  tool: &w {a: 1}\n  world: {<<: *w}\n", "write it out", 5),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_place(old, new, said, line):
    text = file(three(TRIANGLE))
    assert old in text
    broken = text.replace(old, new)
    with pytest.raises(DocumentError) as raised:
        imported(broken, "park.yaml", 20.0)
    assert said in str(raised.value)
    problem = raised.value.problems[0]
    assert problem.file == "park.yaml"
    assert problem.line == (line or problem.line) > 0


@pytest.mark.parametrize(
    "text", ["- 1\n- 2\n", "just text\n", "a: [1, 2\n", "a: b: c\n", "{" * 1200, "a: \x01\n", "&a [*a]\n"]
)
def test_other_files_are_refused(text):
    with pytest.raises(DocumentError):
        imported(text, "park.yaml", 20.0)


def test_a_table_within_itself_ends():
    with pytest.raises(DocumentError):
        imported("Robots: &r\n  Robot01: *r\n", "park.yaml", 20.0)


def test_the_command(tmp_path, capsys):
    source = tmp_path / "five.yaml"
    source.write_text(FILES[5]())
    assert command(str(source), str(tmp_path / "five.toml"), 20.0) == 0
    said = capsys.readouterr().out
    assert "Not carried over" in said
    assert "  - Operation: the simulator" in said
    with pytest.raises(DocumentError, match="exists already"):
        command(str(source), str(tmp_path / "five.toml"), 20.0)
    with pytest.raises(DocumentError, match="no such file"):
        command(str(tmp_path / "six.yaml"), None, 20.0)
    source.write_bytes(b"\0\0")
    with pytest.raises(DocumentError, match="binary"):
        command(str(source), None, 20.0)
