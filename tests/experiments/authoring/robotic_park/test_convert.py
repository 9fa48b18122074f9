"""Files in the structure of Robotic Park's authors become experiments that are sound and run."""

import numpy as np
import pytest

from experiments.authoring.robotic_park.convert import convert, convert_text
from experiments.authoring.robotic_park.file import ParkTrigger, _Threshold, starts_from
from experiments.check.check import check, examine, figures
from experiments.definition.formation import law_errors
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.virtual_time import simulation
from tests.experiments.robotic_park_files import OTHERS, column, dome, file, flat, robot

FILES = {
    5: lambda: dome(5, speaks="Continuous", pose_ms=50),
    8: lambda: dome(8, real=(1, 2, 5)),
    12: lambda: column(12, 4, real=(0, 3)),
    15: lambda: column(15, positioning="Extern", protocol="EventBased"),
    20: lambda: dome(20, origin=True),
}


def converted(tmp_path, text, name="park"):
    made, notes = convert_text(text, f"{name}.yaml", 20.0)
    path = tmp_path / f"{name}.toml"
    path.write_text(made)
    return document.read(path), notes


@pytest.mark.slow
@pytest.mark.parametrize("count", FILES)
def test_they_convert_and_pass_the_check(tmp_path, count):
    read, notes = converted(tmp_path, FILES[count]())
    assert len(read.experiment.robots) == count
    # their files have no disturbance; the gain of 8 and 20 is near or above what a real drone bears at their decisions
    expected = {"not-random"} | {8: {"oscillates"}, 20: {"unstable", "keeps-oscillating", "anchor-missed"}}.get(
        count, set()
    )
    if read.experiment.formation.update is not None:
        expected.add("not-acquired")  # what a chain of thresholds leaves
    said, numbers = examine(read)
    assert {found.code for found in said if found.severity != "note"} <= expected
    assert all(each.residual_mm < 1.0 for each in numbers.values())
    for note in notes:  # each stands in the file as well
        assert note.split()[0] in read.text


@pytest.mark.slow
@pytest.mark.parametrize("count", FILES)
def test_converted_formations_settle(tmp_path, count):
    experiment = converted(tmp_path, FILES[count]())[0].experiment
    log = simulation.simulate(Plan(experiment), 1)
    plan = Plan(experiment)
    last = log.true_position[np.searchsorted(log.time, 19.9)]
    allowed = experiment.tolerance if experiment.formation.update is None else 0.15  # what a chain of thresholds leaves
    if count == 20:  # unstable
        allowed = 0.1
    assert law_errors(plan.law, last, last[plan.links.sender], plan.links).max() < allowed


def test_a_distance_task(tmp_path):
    experiment = converted(tmp_path, dome(5, speaks="Continuous", pose_ms=50))[0].experiment
    assert experiment.trigger == {"kind": "periodic", "period_s": 0.05}
    assert (experiment.rates.pose_hz, experiment.rates.coordination_hz) == (20.0, 10.0)
    assert experiment.formation.law == "distance"
    assert experiment.formation.clamp == 0.1
    assert experiment.formation.gain == 0.5  # 2 k: their simulator's driver of that time does not divide
    assert all(" - " in link for link in experiment.formation.links)
    assert {robot.body for robot in experiment.robots.values()} == {"twin"}


def test_hybrid_file_keeps_addresses_and_shares_the_radio(tmp_path):
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
    assert links["khepera02 > khepera01"].gain == pytest.approx(0.8)  # 2 · 0.4
    assert links["khepera01 > khepera02"] == 0.8
    assert links["khepera03 - khepera02"] == 0.8


def test_a_pid_pulls_as_the_square(tmp_path):
    formation = converted(tmp_path, file(three(TRIANGLE, law="pid")))[0].experiment.formation
    assert formation.gain == pytest.approx(0.25 / 0.64, rel=1e-3)


@pytest.mark.parametrize(
    ("relation", "anchor", "note"),
    [
        ("origin_0.462", "distance = 0.462, to = [0.0, 0.0, 0.0]", ""),
        ("sphere_0.5-0.1-0.2-0.0", "distance = 0.5, to = [0.1, 0.2, 0.0]", ""),
        ("line_0.0_0.1_0.0_1.0_0.0_0.0", "to = [0.0, 0.1, 0.0], along = [1.0, 0.0, 0.0]", ""),
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


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "theirs"), [("distributed", True), ("centralized", False)])
def test_origin_of_real_crazyflies_follows_their_driver(tmp_path, architecture, theirs):
    relations = [[*each, "origin_0.4726"] for each in TRIANGLE]  # √(0.8²/3 + 0.1²): at 0.7 m, from (0, 0, 0.8)
    text = file(three(relations, place="physical"), "physical", architecture).replace("khepera", "dron")
    text = text.replace("pose: 0.00, 0.00, 0.00", "pose: 0.01, 0.00, 0.00")
    read, notes = converted(tmp_path, text)
    anchors = [anchor.to for anchor in read.experiment.formation.anchors.values()]
    assert anchors == [[0.0, 0.0, 0.8 if theirs else anchors[0][2]]] * 3
    hover = [each.hover for each in read.experiment.robots.values()]
    assert (hover == [0.7] * 3) == theirs
    assert figures(read.plan).residual_mm < 0.1
    assert any("the origin: lifted" in note for note in notes) != theirs  # the central controller's is at 0


def test_origin_contradicting_distances_is_left_out(tmp_path):
    relations = [[*each, "origin_2.0"] for each in TRIANGLE]
    read, notes = converted(tmp_path, file(three(relations)))
    assert not read.experiment.formation.anchors
    assert any("no shape was found that meets them" in note for note in notes)


def test_everything_that_is_left_behind_is_told(tmp_path):
    robots = three(TRIANGLE)
    robots[1] = robot(2, "khepera02", (0.9, 0, 0.3), TRIANGLE[1], place="physical", threshold=0.02)
    robots[1] = robots[1].replace("agent_ip: 192.168.0.22", "agent_ip: ''").replace("role: consensus", "role: leader")
    text = file(robots, "hybrid", "centralized", "True").replace("period: 0.1\n", "period: 0.15\n")
    text = text.replace("type: Constant", "type: Adaptive", 2)
    read, notes = converted(tmp_path, text)
    assert read.experiment.architecture == "centralised"
    told = " | ".join(notes)
    for word in (
        "threshold.type: Adaptive",
        "simulator",
        "Data_Logging",
        "khepera02: real",
        "leader",
        "commonest",
        "6.66667 Hz become",
    ):
        assert word in told
    assert read.experiment.robots["khepera02"].start == [0.9, 0.0, 0.3]  # the third number of robots on wheels: yaw


@pytest.mark.parametrize(("spelt", "noted"), [("centralized", False), ("Centralized", True)])
def test_central_controller_reads_relations_of_disabled_tasks(tmp_path, spelt, noted):
    text = file(three([[*each, "origin_0.4619"] for each in TRIANGLE]), architecture=spelt)
    text = text.replace("enable: True\n      T: 100", "enable: False\n      T: 100")
    read, notes = converted(tmp_path, text)
    assert read.experiment.architecture == "centralised"
    assert len(read.experiment.formation.links) == 3
    assert {anchor.gain for anchor in read.experiment.formation.anchors.values()} == {1.0}  # twice that of a link
    assert any("starts a centre" in note for note in notes) == noted


def test_tasks_that_are_off_are_counted(tmp_path):
    text = file(three(TRIANGLE)).replace("enable: True\n      T: 100", "enable: False\n      T: 100")
    read, notes = converted(tmp_path, text)
    assert not read.experiment.formation.links
    assert any("khepera01, khepera02, khepera03: 6 relations are left out" in note for note in notes)


@pytest.mark.parametrize(
    ("place", "name", "recent", "expected"),
    [
        ("virtual", "khepera", False, (0.5, 4.0)),
        ("virtual", "khepera", True, (0.5, 4.0)),
        ("physical", "khepera", False, (0.5 / 0.8, 2.0)),
        ("virtual", "dron", False, (0.5, 4.0)),
        ("virtual", "dron", True, (0.5, 4.0)),
        ("physical", "dron", False, (0.5, 2.0)),
        ("physical", "dron", True, (0.5, 2.0)),
    ],
)
def test_gains_follow_the_driver_of_the_file(tmp_path, place, name, recent, expected):
    gain, weight = expected
    radius = 0.8 / np.sqrt(3.0)
    relations = [[*each, f"sphere_{radius:.4f}-0.4-0.2309-0.7"] for each in TRIANGLE]
    text = file(three(relations, place=place)).replace("khepera", name)
    text = text.replace("pose: 0.00, 0.00, 0.00", "pose: 0.01, 0.00, 0.00")
    if recent:
        text = text.replace("    local_pose:", "    mars_data:\n      enable: True\n    local_pose:")
    read, notes = converted(tmp_path, text)
    formation = read.experiment.formation
    assert any("for which driver" in note for note in notes) == (recent and place == "virtual")
    assert formation.gain == pytest.approx(gain, rel=1e-3)
    if name == "dron":  # on the floor a sphere about 0.7 m is out of reach
        divided = 1.0 if gain == 0.5 else radius
        gains = [anchor.gain for anchor in formation.anchors.values()]
        assert gains == pytest.approx([0.5 / divided * weight] * 3, rel=1e-3)


@pytest.mark.parametrize(("place", "hz"), [("physical", 20.0), ("virtual", 10.0)])
def test_real_crazyflies_decide_by_task_period(tmp_path, place, hz):
    text = file(three(TRIANGLE, place=place)).replace("khepera", "dron").replace("      T: 100\n", "      T: 50\n")
    assert converted(tmp_path, text)[0].experiment.rates.coordination_hz == hz


def test_relative_pose_by_slashes(tmp_path):
    text = file(three([["khepera02_-0.3/-0.3/0.2"], [], []], kind="relative_pose"))
    links = converted(tmp_path, text)[0].experiment.formation.links
    assert links["khepera02 > khepera01"].offset == [-0.3, -0.3]


def test_missing_files_of_robots_are_counted_once(tmp_path):
    listed = index(tmp_path)
    for each in tmp_path.glob("AC_*.yaml"):
        each.unlink()
    with pytest.raises(DocumentError) as raised:
        convert_text(listed, "AC.yaml", 20.0)
    (problem,) = raised.value.problems
    assert problem.file == "AC.yaml"
    assert "3 files of robots that are not beside it: AC_dron01.yaml" in problem.message


def test_import_of_toml_names_the_check():
    with pytest.raises(DocumentError, match=r"is no file of Robotic Park's authors(.|\n)*zenpark check park.toml"):
        convert_text('title = "park"\n', "park.toml", 20.0)


def test_velocity_law_becomes_a_step(tmp_path):
    text = file(three(TRIANGLE)).replace("type: gradient", "type: gradient_v").replace("period: 0.1\n", "period: 0.2\n")
    formation = converted(tmp_path, text)[0].experiment.formation
    assert (formation.gain, formation.clamp) == (pytest.approx(0.1), pytest.approx(0.02))


def test_the_address_may_be_called_ip(tmp_path):
    text = file(three(TRIANGLE, place="physical"), "physical").replace("agent_ip:", "ip:")
    robots = converted(tmp_path, text)[0].experiment.robots
    assert robots["khepera02"].body == "khepera4://192.168.0.22:50000"


def pyramid(**more):
    """Four drones on a square and one above it, from one height: folded, two opposite corners are in one place."""
    place = np.array([[1.2, 0, 0], [0, 1.2, 0], [-1.2, 0, 0], [0, -1.2, 0], [0, 0, 1.0]])
    names = [f"dron0{k + 1}" for k in range(5)]
    robots = []
    for k, (x, y, _) in enumerate(place):
        others = range(4) if k == 4 else ((k + 1) % 4, (k - 1) % 4, 4)
        relations = [f"{names[j]}_{np.linalg.norm(place[k] - place[j]):.4f}" for j in others]
        robots.append(robot(k + 1, names[k], (1.1 * x, 0.9 * y, 0.7), relations, **more))
    return file(robots)


def test_pyramid_is_not_folded(tmp_path):
    experiment = converted(tmp_path, pyramid())[0].experiment
    hover = [each.hover for each in experiment.robots.values()]
    assert hover[4] > max(hover[:4]) + 0.7
    predicted = figures(Plan(experiment))
    assert predicted.acquired_s is not None
    place = np.array(list(predicted.end.values()))
    apart = np.linalg.norm(place[:, None] - place[None, :], axis=2)[np.triu_indices(5, 1)]
    assert apart.min() > 1.0


@pytest.mark.slow
@pytest.mark.usefixtures("unflown")
def test_flat_formation_stays_flat_whatever_the_origin(tmp_path):
    place = [(0.8, 0.0), (0.25, 0.76), (-0.65, 0.47), (-0.65, -0.47), (0.25, -0.76)]
    names = [f"dron0{k + 1}" for k in range(5)]
    robots = []
    for k, (x, y) in enumerate(place):
        apart = [(names[j], np.hypot(x - place[j][0], y - place[j][1])) for j in range(5) if j != k]
        relations = [*(f"{name}_{distance:.4f}" for name, distance in apart), "origin_0.5"]
        robots.append(robot(k + 1, names[k], (1.2 * x, 1.1 * y, 0.7), relations))
    text = file(robots)
    read, notes = converted(tmp_path, text)
    assert [each.hover for each in read.experiment.robots.values()] == [0.7] * 5
    assert not read.experiment.formation.anchors
    assert figures(read.plan).residual_mm < 0.2
    assert not any("climb" in note for note in notes)


def test_enabled_tools_are_reported_and_no_others(tmp_path):
    off = "  Agent00:\n    enable: False\n  Agent01:\n    enable: True\n  Reconfiguration:\n    enable: True\n"
    notes = converted(tmp_path, file(three(TRIANGLE)) + off)[1]
    told = " | ".join(notes)
    assert "Agent00" not in told
    assert "Other.Agent01: zenpark records" in told
    assert "the first shape is imported" in told


@pytest.mark.parametrize(
    ("old", "new", "said", "line"),
    [
        ("mode: virtual ", "mode: virtuel ", "Operation.mode: Invalid enum value 'virtuel'", 0),
        ("name: khepera02", "name: rover02", "Robots.Robot02: no kind of robot is in the name 'rover02'", 0),
        ("name: khepera02", "name: khepera01", "Robot01: two robots are called 'khepera01'", 0),
        ("type: virtual\n    name: khepera02", "type: imagined\n    name: khepera02", "type: Invalid enum value", 0),
        ("pose: 0.90, 0.00, 0.00", "pose: 0.90; 0.00", "Robots.Robot02.pose[0]: Expected `float`", 0),
        ("pose: 0.90, 0.00, 0.00", "pose: 0.90", "Robots.Robot02.pose: Expected", 0),
        ("pose: 0.90, 0.00, 0.00", "pose: {}", "Robots.Robot02.pose: Expected `object` of length >= 2", 0),
        ("    pose: 0.90, 0.00, 0.00\n", "", "Robots.Robot02: pose is missing", 0),
        ("khepera03_0.8", "khepera04_0.8", "no other robot is called 'khepera04'", 0),
        ("khepera03_0.8", "khepera03_x", "task: 'khepera03_x' is no relation of a distance task", 0),
        ("khepera03_0.8", "khepera03_-0.8", "not positive", 0),
        ("khepera03_0.8", "khepera01_0.8", "no other robot is called 'khepera01'", 0),
        ("gain: 0.25", "gain: strong", "Robot01.task.controller.gain: Expected `float`, got `str`", 0),
        ("gain: 0.25", "gain: .inf", "controller.gain: Expected `float` <= ", 0),
        ("gain: 0.25", "gain: -1", "Expected `float` > 0.0", 0),
        ("enable: True\n      T: 100", "enable: perhaps\n      T: 100", "Robot01.task.enable: Expected `bool`", 0),
        ("      type: distance\n", "", "Robots.Robot01.task: type or relationship is missing", 0),
        ("type: distance", "type: bearing", "Robot01.task: the type 'bearing' is unknown", 0),
        ("upperLimit: 0.1", "upperLimit: -0.2", "no step lies between", 0),
        ("Robots:\n", "Robots: none\nElse:\n", "Robots: Expected `object`, got `str`", 0),
        ("Architecture:\n", "Architecture: none\nElse:\n", "Architecture: Expected `object`, got `str`", 0),
        ("Robots:\n", "Robotss:\n", "'Robots' is missing", 0),
        ("  mode: virtual ", " \tmode: virtual ", "", 3),
        ("tool: Webots", "tool: 'Webots", "", None),
        ("tool: Webots", "tool: !!python/object/apply:os.system ['true']", "the tag", 4),
        ("tool: Webots", "tool: *nothing", "the alias '*nothing' is not read", 4),
        ("  tool: Webots\n", "  tool: Webots\n  tool: Gazebo\n", "stands twice", 5),
    ],
)  # fmt: skip
def test_an_error_names_the_key_or_the_line(old, new, said, line):
    text = file(three(TRIANGLE))
    assert old in text
    broken = text.replace(old, new)
    with pytest.raises(DocumentError) as raised:
        convert_text(broken, "park.yaml", 20.0)
    assert said in str(raised.value)
    problem = raised.value.problems[0]
    assert problem.file == "park.yaml"
    assert problem.line == (problem.line if line is None else line)


@pytest.mark.parametrize(
    "text", ["- 1\n- 2\n", "just text\n", "a: [1, 2\n", "a: b: c\n", "{" * 1200, "a: \x01\n", "&a [*a]\n"]
)
def test_other_files_are_refused(text):
    with pytest.raises(DocumentError):
        convert_text(text, "park.yaml", 20.0)


def test_a_table_within_itself_ends():
    with pytest.raises(DocumentError):
        convert_text("Robots: &r\n  Robot01: *r\n", "park.yaml", 20.0)


def test_the_command(tmp_path):
    source = tmp_path / "five.yaml"
    source.write_text(FILES[5]())
    path, notes = convert(str(source), str(tmp_path / "five.toml"), 20.0)
    assert path == tmp_path / "five.toml"
    assert [note.partition(":")[0] for note in notes] == ["Operation"]
    with pytest.raises(DocumentError, match="exists already"):
        convert(str(source), str(tmp_path / "five.toml"), 20.0)
    with pytest.raises(DocumentError, match="no such file"):
        convert(str(tmp_path / "six.yaml"), None, 20.0)
    source.write_bytes(b"\0\0")
    with pytest.raises(DocumentError, match="binary"):
        convert(str(source), None, 20.0)


def test_flat_2023_file_starts_from_an_index(tmp_path):
    marker = "dron09:\n  name: khepera01\n  control_mode: None\n  task:\n    enable: False\n    relationship: Null\n"
    poses = tmp_path / "poses.yaml"
    places = {"dron01": "0.1 0.5", "khepera01": "-0.4, 0.0", "khepera02": "0.5 0.1 3.1"}
    poses.write_text("".join(f"{name}:\n  pose: {place}\n" for name, place in places.items()))
    made, notes = convert_text("".join(map(flat, OTHERS)) + marker, "AA.yaml", 20.0, str(poses))
    (tmp_path / "aa.toml").write_text(made)
    experiment = document.read(tmp_path / "aa.toml").experiment
    assert list(experiment.robots) == ["dron01", "khepera01", "khepera02"]
    assert [each.start for each in experiment.robots.values()] == [[0.1, 0.5], [-0.4, 0.0], [0.5, 0.1, 3.1]]
    assert {each.body for each in experiment.robots.values()} == {"twin"}
    assert experiment.formation.links == {
        "khepera01 - dron01": 0.9,
        "khepera02 - dron01": 0.9,
        "khepera02 - khepera01": 0.8,
    }
    assert (experiment.formation.gain, experiment.formation.clamp) == (0.5, 0.08)
    assert experiment.rates.coordination_hz == 5.0
    assert experiment.trigger == {"kind": "send-on-delta", "threshold": 0.02}
    told = " | ".join(notes)
    assert "khepera01 192.168.0.1:50000, khepera02 192.168.0.2:50000" in told
    assert "dron09: the marker" in told
    assert "MADE UP" not in told


@pytest.mark.slow
def test_starts_that_nobody_tells_are_marked(tmp_path):
    made, notes = convert_text("".join(map(flat, OTHERS)), "AA.yaml", 20.0)
    assert made.count("# start made up") == 3
    assert any("MADE UP" in note and "--poses" in note for note in notes)
    (tmp_path / "aa.toml").write_text(made)
    assert [found.code for found in check(document.read(tmp_path / "aa.toml")) if found.severity == "error"] == []


def index(tmp_path, **settings):
    """An index with the files of its robots beside it."""
    lines = []
    for number, (name, place) in enumerate(
        {"dron01": "0.1, 0.5", "khepera01": "-0.4 0.0", "khepera02": "0.5, 0.1"}.items()
    ):
        (tmp_path / f"AC_{name}.yaml").write_text(flat(name, **settings))
        kind = ("virtual", "digital_twin", "virtual")[number]
        lines.append(f"{name}:\n  name: {name}\n  config_path: AC_{name}.yaml\n  pose: {place}\n  type: {kind}\n")
    return "\n".join(lines)


def test_index_of_2023_follows_the_files_it_names(tmp_path):
    made, _ = convert_text(index(tmp_path), str(tmp_path / "AC.yaml"), 20.0)
    (tmp_path / "ac.toml").write_text(made)
    experiment = document.read(tmp_path / "ac.toml").experiment
    assert experiment.robots["khepera01"].body == "khepera4://192.168.0.1:50000"
    assert experiment.robots["khepera01"].shadow is not None
    assert experiment.robots["khepera01"].start == [-0.4, 0.0, -1.5]
    assert experiment.robots["khepera02"].body == "twin"
    links = experiment.formation.links
    assert links["khepera02 - dron01"] == 0.9
    assert links["dron01 > khepera01"].gain == pytest.approx(
        0.5 / 0.8667, rel=1e-3
    )  # the real Khepera's driver divides


@pytest.mark.parametrize(
    ("broken", "said", "where"),
    [
        (lambda folder: (folder / "AC_dron01.yaml").unlink(), "there is no such file", "AC_dron01.yaml"),
        (lambda folder: (folder / "AC_dron01.yaml").write_text("- 1\n"), "is no table", "AC_dron01.yaml"),
        (lambda folder: (folder / "AC_dron01.yaml").write_text("{}\n"), "has no robot", "AC_dron01.yaml"),
        (
            lambda folder: (folder / "AC_dron01.yaml").write_text(flat("dron01", speaks="Loud")),
            "'Loud'",
            "AC_dron01.yaml",
        ),
        (lambda folder: (folder / "AC_dron01.yaml").write_text(flat("dron01", relations="dron07_1.0")), "dron07", ""),
    ],
)
def test_faults_of_an_index_name_their_file(tmp_path, broken, said, where):
    text = index(tmp_path)
    broken(tmp_path)
    with pytest.raises(DocumentError) as raised:
        convert_text(text, str(tmp_path / "AC.yaml"), 20.0)
    assert said in str(raised.value)
    assert raised.value.problems[0].file.endswith(where)


def test_one_robot_names_what_to_import():
    with pytest.raises(DocumentError, match="import the file that lists all robots"):
        convert_text(flat("dron01"), "AC_dron01.yaml", 20.0)


WORLD = """#VRML_SIM R2023a utf8
WorldInfo { title "a { brace in a name" }
DEF dron01 Crazyflie {
  translation 0.1 0.5 0.015
  children [ Camera { name "camera" translation 9 9 9 } ]
  name "dron01"
}
KheperaIV {
  translation -0.4 0 0.01
  rotation 0 0 -1 1.5
  name "khepera01"  # at the wall
}
"""


def test_starts_from_a_webots_world_and_an_index(tmp_path):
    (tmp_path / "park.wbt").write_text(WORLD)
    found = starts_from(str(tmp_path / "park.wbt"))
    assert found["dron01"] == (0.1, 0.5, 0.015)
    assert found["khepera01"] == (-0.4, 0.0, -1.5)
    assert "camera" not in found
    (tmp_path / "AC.yaml").write_text(index(tmp_path))
    assert starts_from(str(tmp_path / "AC.yaml"))["khepera02"] == (0.5, 0.1, 0.0)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("poses.txt", "dron01: 0.1\n", "tells the start of no robot"),
        ("park.wbt", "Robot {", "tells the start of no robot"),
        ("park.wbt", 'Robot { name "dron01" translation 1 x 2 }', r"dron01.translation\[1\]: Expected `float`"),
        ("park.wbt", 'Robot { name "dron01" translation }', r"dron01.translation: Expected `array` of length 3"),
        ("park.wbt", "Robot { name", "tells the start of no robot"),
    ],
)
def test_starts_that_cannot_be_read(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(DocumentError, match=said):
        starts_from(str(tmp_path / name))


def test_pose_axes_come_in_any_order(tmp_path):
    made, *_ = converted(tmp_path, file(three(TRIANGLE)).replace("pose: 0.90, 0.00, 0.00", "pose: {y: 0.0, x: 0.9}"))
    assert made.experiment.robots["khepera02"].start[:2] == [0.9, 0.0]


def test_errors_of_a_key_have_a_remedy():
    text = file(three(TRIANGLE))
    for old, new, hint in (
        ("    pose: 0.90, 0.00, 0.00\n", "", "write pose: 0.5, 0.5, 0.0"),
        ("pose: 0.90, 0.00, 0.00", "pose: 0.90", "give x, y and, if wanted, z or the yaw"),
        ("name: khepera02", "name: rover02", "use letters, digits and _, and in it one of"),
    ):
        with pytest.raises(DocumentError) as raised:
            convert_text(text.replace(old, new), "park.yaml", 20.0)
        assert raised.value.problems[0].hint.startswith(hint)


def test_zero_threshold_is_refused_and_co_precedes_threshold():
    assert ParkTrigger("EventBased", _Threshold(co=0.02, threshold=0.5)).event == (0.02, 0.0)
    assert ParkTrigger("EventBased", _Threshold(threshold=0.5)).event == (0.5, 0.0)
    assert ParkTrigger("EventBased").event == (0.01, 0.0)
    with pytest.raises(ValueError, match="crossed always"):
        _ = ParkTrigger("EventBased", _Threshold(threshold=0)).event


def test_disabled_task_may_hold_anything(tmp_path):
    text = file(three(TRIANGLE)).replace("enable: True\n      T: 100", "enable: False\n      T: -5", 1)
    assert converted(tmp_path, text)[0].experiment.robots
