"""Files in the structure of Robotic Park's authors become experiments that are sound and run."""

import math
from functools import cache, partial
from itertools import combinations

import msgspec
import numpy as np
import pytest

from agents.formation.anchors import Anchor
from agents.formation.link import BY_DISTANCE, BY_RELATIVE
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from experiments.authoring import layouts
from experiments.authoring.robotic_park.convert import convert, convert_text
from experiments.authoring.robotic_park.file import ParkTrigger, starts_from
from experiments.authoring.robotic_park.heights import Room, find_shape
from experiments.check.check import examine, figures
from experiments.check.realisation import ENOUGH, Solids
from experiments.definition.experiment import Shadow
from experiments.definition.formation import law_errors
from experiments.definition.graph import Links, links
from experiments.file import document
from experiments.file.problems import DocumentError
from tests.experiments.robotic_park_files import OTHERS, column, dome, drones, file, flat, robot
from tests.runs import fly

FILES = {
    5: dome(5, speaks="Continuous", pose_ms=50),
    8: dome(8, real=(1, 2, 5)),
    12: column(12, 4, real=(0, 3)),
    15: column(15, positioning="Extern", protocol="EventBased"),
    20: dome(20, origin=True),
}


@cache
def converted(text):
    """Document of the converted file, and the notes on all that was not carried over."""
    made, notes = convert_text(text, "park.yaml", 20.0)
    return document.loads(made), " | ".join(notes)


def trio(relations, architecture="distributed", mode="virtual", kind="khepera", **more):
    """Robots on a triangle of 0.8 m, or near it; `relations` of each."""
    place = [(0.01, 0.0, 0.0), (0.9, 0.0, 0.0), (0.4, 0.7, 0.0)]
    robots = [robot(k + 1, f"khepera0{k + 1}", place[k], relations[k], **more) for k in range(3)]
    return file(robots, mode, architecture).replace("khepera", kind)


TRIANGLE = (["khepera02_0.8", "khepera03_0.8"], ["khepera01_0.8", "khepera03_0.8"], ["khepera01_0.8", "khepera02_0.8"])
TASK = "enable: True\n      T: 100"
OFF = TASK.replace("True", "False")


def triangle_with(relation, **more):
    return trio([[*each, relation] for each in TRIANGLE], **more)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "allowed"), [(5, None), (12, None), (15, 0.15)])
def test_files_convert_pass_the_check_and_settle(count, allowed):
    read, notes = converted(FILES[count])
    plan = read.plan
    # their files have no disturbance; a chain of thresholds leaves an error
    expected = {"not-random"} | ({"not-acquired"} if read.experiment.formation.update is not None else set())
    found, numbers = examine(read)
    assert {each.code for each in found if each.severity != "note"} <= expected
    assert all(each.residual_mm < 1.0 for each in numbers.values())
    assert all(note.split()[0] in read.text for note in notes.split(" | "))
    log = fly(read.experiment).log
    last = log.true_position[np.searchsorted(log.time, 19.9)]
    errors = law_errors(plan.law, last, last[plan.links.sender], plan.links)
    assert errors.max() < (allowed or read.experiment.tolerance)


def worst_error(text):
    """Largest error of a link in the last five of twenty seconds [m]."""
    plan, log = document.loads(text).plan, fly(document.loads(text).experiment).log
    late = log.true_position[np.searchsorted(log.time, 15.0) : np.searchsorted(log.time, 19.9)]
    return max(law_errors(plan.law, each, each[plan.links.sender], plan.links).max() for each in late)


@pytest.mark.slow
def test_gains_that_ring_are_said_and_lowered():
    made = dome(8, gain=0.5)
    (text, notes), (calm, lowered) = (convert_text(made, "park.yaml", 20.0, calm=calm) for calm in (False, True))
    assert notes[0].startswith("gain 1: with zenpark's twins the sampled loop swings for ever (gain 2.5, limit 2)")
    assert "# - gain 1: with" in text.partition("title")[0]
    assert (notes[1:], lowered[0][:20]) == (lowered[1:], "gain 1 of theirs is ")
    assert worst_error(text) > 0.05
    assert worst_error(calm) < 0.02


def test_files_that_ring_are_as_many_as_before():
    """Counts of files whose gains swing for ever, or oscillate first, of four shapes and three gains."""
    makers = (dome, 5), (dome, 8), (partial(dome, origin=True), 8), (partial(column, drones=4), 12)
    notes = [convert_text(make(count, gain=gain), "park.yaml", 20.0)[1]
             for make, count in makers for gain in (0.25, 0.5, 1.0)]  # fmt: skip
    found = [sum(f"{words} (gain" in each[0] for each in notes) for words in ("for ever", "settles")]
    assert found == [7, 2]
    made, _ = convert_text(dome(8, gain=1.0), "park.yaml", 20.0, calm=True)
    assert not {each.code for each in examine(document.loads(made))[0]} & {"unstable", "oscillates"}


def test_drones_hover_at_the_heights_of_the_shape():
    read, notes = converted(FILES[20])
    heights = [robot.hover for robot in read.experiment.robots.values()]
    assert min(heights) == pytest.approx(0.7, abs=1e-3)  # where all of them start
    assert max(heights) > 1.5
    anchors = [tuple(anchor.to) for anchor in read.experiment.formation.anchors.values()]
    assert (len(anchors), len({*anchors}), "lifted" in notes) == (20, 1, True)


def test_one_way_links_and_those_of_two_minds():
    relations = (["khepera02_0.8"], ["khepera01_0.9", "khepera03_0.8"], ["khepera02_0.8", "khepera01_0.8"])
    read, notes = converted(trio(relations))
    lengths = {"02 > khepera01": 0.8, "01 > khepera02": 0.9, "03 - khepera02": 0.8, "01 > khepera03": 0.8}
    assert read.experiment.formation.links == {f"khepera{pair}": length for pair, length in lengths.items()}
    assert "different things" in notes
    made = converted(trio(TRIANGLE).replace("gain: 0.25", "gain: 0.4", 1))[0].experiment.formation.links
    assert made["khepera02 > khepera01"].gain == pytest.approx(0.8)  # 2 · 0.4
    assert (made["khepera01 > khepera02"], made["khepera03 - khepera02"]) == (0.8, 0.8)


GRADIENT_V = trio(TRIANGLE).replace("period: 0.1\n", "period: 0.2\n").replace("type: gradient", "type: gradient_v")
DRONES = trio(TRIANGLE, kind="dron").replace("      T: 100\n", "      T: 50\n")


@pytest.mark.parametrize(
    ("text", "path", "expected"),
    [
        (FILES[5], "trigger", {"kind": "periodic", "period_s": 0.05}),
        (FILES[5], "rates.coordination_hz", 10.0),
        (FILES[5], "formation.clamp", 0.1),
        (FILES[5], "formation.gain", 0.5),  # 2 k: their simulator's driver of that time does not divide
        (FILES[8], "robots.dron02.body", "radio://0/80/2M/E7E7E7E702"),
        (FILES[8], "robots.dron02.process", "radio0"),
        (FILES[8], "robots.dron01.process", None),
        (FILES[12], "formation.law", "displacement"),
        (FILES[12], "formation.stiffness", 0.25),
        (FILES[12], "formation.links.khepera00 > khepera01.offset", [0.0, 0.5]),  # of khepera01 from khepera00
        (FILES[12], "robots.khepera00.body", "khepera4://192.168.0.21:50000"),
        (FILES[12], "robots.khepera00.shadow", Shadow()),
        (FILES[15], "formation.update", {"kind": "relative-control", "floor": 0.005, "share": 0.1}),
        (FILES[15], "robots.khepera00.position", "body"),  # no motion capture sees a twin in its own process
        (FILES[15].replace("virtual", "physical"), "positioning", "vicon-twin"),
        (FILES[15].replace("virtual", "physical"), "robots.khepera00.position", "external"),
        (trio(TRIANGLE, law="pid"), "formation.gain", pytest.approx(0.25 / 0.64, rel=1e-3)),  # pulls as the square
        (GRADIENT_V, "formation.gain", pytest.approx(0.1)),
        (GRADIENT_V, "formation.clamp", pytest.approx(0.02)),
        (trio([["khepera02_-0.3/-0.3/0.2"], [], []]).replace("type: distance", "type: relative_pose"),
         "formation.links.khepera02 > khepera01.offset", [-0.3, -0.3]),
        (trio(TRIANGLE, mode="physical", place="physical").replace("agent_ip:", "ip:"), "robots.khepera02.body",
         "khepera4://192.168.0.22:50000"),
        (trio(TRIANGLE).replace("pose: 0.90, 0.00, 0.00", "pose: {y: 0.0, x: 0.9}"), "robots.khepera02.start",
         [0.9, 0.0]),
        (DRONES.replace("type: virtual", "type: physical"), "rates.coordination_hz", 20.0),
        (DRONES, "rates.coordination_hz", 10.0),
    ],
)  # fmt: skip
def test_keys_become_those_of_zenpark(text, path, expected):
    found = converted(text)[0].experiment
    for key in path.split("."):
        found = found[key] if isinstance(found, dict) else getattr(found, key)
    assert found == expected


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
def test_relations_to_places_become_anchors(relation, anchor, note):
    read, notes = converted(trio(([*TRIANGLE[0], relation], *TRIANGLE[1:])))
    assert anchor in read.text
    assert ("[formation.anchors]" in read.text) == bool(anchor)
    assert note in notes
    read, notes = converted(triangle_with("origin_2.0"))  # it contradicts the distances
    assert not read.experiment.formation.anchors
    assert "no shape was found that meets them" in notes


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "theirs"), [("distributed", True), ("centralized", False)])
def test_origin_of_real_crazyflies_follows_their_driver(architecture, theirs):
    # √(0.8²/3 + 0.1²): at 0.7 m, from (0, 0, 0.8)
    text = triangle_with("origin_0.4726", architecture=architecture, mode="physical", kind="dron", place="physical")
    read, notes = converted(text)
    anchors = [anchor.to for anchor in read.experiment.formation.anchors.values()]
    assert anchors == [[0.0, 0.0, 0.8 if theirs else anchors[0][2]]] * 3
    assert ([each.hover for each in read.experiment.robots.values()] == [0.7] * 3) == theirs
    assert figures(read.plan).residual_mm < 0.1
    assert ("the origin: lifted" in notes) != theirs  # the central controller's is at 0


def test_everything_that_is_left_behind_is_told():
    robots = [robot(k + 1, f"khepera0{k + 1}", (0.9 * k, 0.7 * (k == 2), 0), TRIANGLE[k]) for k in range(3)]
    robots[1] = robot(2, "khepera02", (0.9, 0, 0.3), TRIANGLE[1], place="physical", threshold=0.02)
    robots[1] = robots[1].replace("agent_ip: 192.168.0.22", "agent_ip: ''").replace("role: consensus", "role: leader")
    text = file(robots, "hybrid", "centralized", "True").replace("period: 0.1\n", "period: 0.15\n")
    text = text.replace("      threshold:\n        type: Constant", "      threshold:\n        type: Adaptive", 2)
    tools = "  Agent00:\n    enable: False\n  Agent01:\n    enable: True\n  Reconfiguration:\n    enable: True\n"
    read, notes = converted(text + tools)
    assert read.experiment.architecture == "centralised"
    assert read.experiment.robots["khepera02"].start == [0.9, 0.0, 0.3]  # the third number of robots on wheels: yaw
    words = ("simulator", "Data_Logging", "khepera02: real", "leader", "commonest", "6.66667 Hz become", "Agent00")
    words += ("threshold.type: Adaptive", "Other.Agent01: zenpark records", "the first shape is imported")
    assert [word for word in words if word not in notes] == ["Agent00"]


@pytest.mark.parametrize(("spelt", "noted"), [("centralized", False), ("Centralized", True)])
def test_central_controller_reads_relations_of_disabled_tasks(spelt, noted):
    read, notes = converted(triangle_with("origin_0.4619", architecture=spelt).replace(TASK, OFF))
    assert read.experiment.architecture == "centralised"
    assert len(read.experiment.formation.links) == 3
    assert {anchor.gain for anchor in read.experiment.formation.anchors.values()} == {1.0}  # twice that of a link
    assert ("starts a centre" in notes) == noted
    read, notes = converted(trio(TRIANGLE).replace(TASK, OFF))  # without a centre
    assert not read.experiment.formation.links
    assert "khepera01, khepera02, khepera03: 6 relations are left out" in notes


@pytest.mark.parametrize(
    ("place", "kind", "gain", "weight", "recent"),
    [
        ("virtual", "khepera", 0.5, 4.0, True),
        ("physical", "khepera", 0.5 / 0.8, 2.0, False),
        ("virtual", "dron", 0.5, 4.0, False),
        ("physical", "dron", 0.5, 2.0, True),
    ],
)
def test_gains_follow_the_driver_of_the_file(place, kind, gain, weight, recent):
    text = triangle_with(f"sphere_{0.8 / np.sqrt(3.0):.4f}-0.4-0.2309-0.7", kind=kind, place=place)
    if recent:
        text = text.replace("    local_pose:", "    mars_data:\n      enable: True\n    local_pose:")
    read, notes = converted(text)
    formation = read.experiment.formation
    assert ("for which driver" in notes) == (recent and place == "virtual")
    assert formation.gain == pytest.approx(gain, rel=1e-3)
    if kind == "dron":  # on the floor a sphere about 0.7 m is out of reach
        gains = [anchor.gain for anchor in formation.anchors.values()]
        assert gains == pytest.approx([0.5 * weight] * 3, rel=1e-3)


def test_threshold_of_communication_is_positive():
    given = ({"co": 0.02, "threshold": 0.5}, {"threshold": 0.5}, {})
    made = [msgspec.convert({"protocol": "EventBased", "threshold": each}, ParkTrigger).event for each in given]
    assert made == [(0.02, 0.0), (0.5, 0.0), (0.01, 0.0)]
    with pytest.raises(ValueError, match="crossed always"):
        _ = msgspec.convert({"protocol": "EventBased", "threshold": {"threshold": 0}}, ParkTrigger).event


def test_pyramid_is_not_folded():
    """Four drones on a square and one above it, from one height: folded, two opposite corners are in one place."""
    place = np.array([[1.2, 0, 0], [0, 1.2, 0], [-1.2, 0, 0], [0, -1.2, 0], [0, 0, 1.0]])
    pairs = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)]
    plan = converted(drones(place, [(1.1 * x, 0.9 * y, 0.7) for x, y, _ in place], pairs))[0].plan
    hover = [each.hover for each in plan.experiment.robots.values()]
    assert hover[4] > max(hover[:4]) + 0.7
    predicted = figures(plan)
    assert predicted.acquired_s is not None
    assert min(math.dist(a, b) for a, b in combinations(predicted.end.values(), 2)) > 1.0


@pytest.mark.parametrize(
    ("old", "new", "said", "line"),
    [
        ("name: khepera02", "name: rover02", "Robots.Robot02: no kind of robot is in the name 'rover02'", 0),
        ("name: khepera02", "name: khepera01", "Robot01: two robots are called 'khepera01'", 0),
        ("pose: 0.90, 0.00, 0.00", "pose: 0.90", "Robots.Robot02.pose: Expected", 0),
        ("    pose: 0.90, 0.00, 0.00\n", "", "Robots.Robot02: pose is missing", 0),
        ("khepera03_0.8", "khepera04_0.8", "no other robot is called 'khepera04'", 0),
        ("khepera03_0.8", "khepera03_x", "task: 'khepera03_x' is no relation of a distance task", 0),
        ("khepera03_0.8", "khepera03_-0.8", "not positive", 0),
        ("khepera03_0.8", "khepera01_0.8", "no other robot is called 'khepera01'", 0),
        ("      type: distance\n", "", "Robots.Robot01.task: type or relationship is missing", 0),
        ("type: distance", "type: bearing", "Robot01.task: the type 'bearing' is unknown", 0),
        ("upperLimit: 0.1", "upperLimit: -0.2", "no step lies between", 0),
        ("Robots:\n", "Robots: none\nElse:\n", "Robots: Expected `object`, got `str`", 0),
        ("Robots:\n", "Robotss:\n", "'Robots' is missing", 0),
        ("  mode: virtual ", " \tmode: virtual ", "", 3),
        ("tool: Webots", "tool: !!python/object/apply:os.system ['true']", "the tag", 4),
        ("tool: Webots", "tool: *nothing", "the alias '*nothing' is not read", 4),
        ("  tool: Webots\n", "  tool: Webots\n  tool: Gazebo\n", "stands twice", 5),
    ],
)  # fmt: skip
def test_error_names_the_key_or_the_line(old, new, said, line):
    text = trio(TRIANGLE)
    assert old in text
    with pytest.raises(DocumentError) as raised:
        convert_text(text.replace(old, new), "park.yaml", 20.0)
    assert said in str(raised.value)
    assert (raised.value.problems[0].file, raised.value.problems[0].line) == ("park.yaml", line)


@pytest.mark.parametrize(
    "text",
    ["- 1\n- 2\n", "just text\n", "a: [1, 2\n", "{" * 1200, "a: \x01\n", "Robots: &r\n  Robot01: *r\n"],
)
def test_other_files_are_refused(text):
    with pytest.raises(DocumentError):
        convert_text(text, "park.yaml", 20.0)
    with pytest.raises(DocumentError, match=r"is no file of Robotic Park's authors(.|\n)*zenpark check park.toml"):
        convert_text('title = "park"\n', "park.toml", 20.0)
    with pytest.raises(DocumentError, match="import the file that lists all robots"):
        convert_text(flat("dron01"), "AC_dron01.yaml", 20.0)


def test_conversion_writes_a_new_file(tmp_path):
    source, target = tmp_path / "five.yaml", tmp_path / "five.toml"
    source.write_text(FILES[5])
    path, notes = convert(str(source), str(target), 20.0)
    assert (path, [note.partition(":")[0] for note in notes]) == (target, ["Operation"])
    with pytest.raises(DocumentError, match="exists already"):
        convert(str(source), str(target), 20.0)
    with pytest.raises(DocumentError, match="no such file"):
        convert(str(tmp_path / "six.yaml"), None, 20.0)
    source.write_bytes(b"\0\0")
    with pytest.raises(DocumentError, match="binary"):
        convert(str(source), None, 20.0)


def test_flat_2023_file_starts_from_an_index(tmp_path):
    marker = "dron09:\n  name: khepera01\n  control_mode: None\n  task:\n    enable: False\n    relationship: Null\n"
    poses = tmp_path / "poses.yaml"
    poses.write_text("dron01:\n  pose: 0.1 0.5\nkhepera01:\n  pose: -0.4, 0.0\nkhepera02:\n  pose: 0.5 0.1 3.1\n")
    made, notes = convert_text("".join(map(flat, OTHERS)) + marker, "AA.yaml", 20.0, str(poses))
    experiment = document.loads(made).experiment
    starts = {"dron01": [0.1, 0.5], "khepera01": [-0.4, 0.0], "khepera02": [0.5, 0.1, 3.1]}
    found = {name: (each.start, each.body) for name, each in experiment.robots.items()}
    assert found == {name: (start, "twin") for name, start in starts.items()}
    formation = experiment.formation
    wanted = {"khepera01 - dron01": 0.9, "khepera02 - dron01": 0.9, "khepera02 - khepera01": 0.8}
    assert (formation.links, formation.gain, formation.clamp) == (wanted, 0.5, 0.08)
    assert experiment.rates.coordination_hz == 5.0
    words = ("khepera01 192.168.0.1:50000, khepera02 192.168.0.2:50000", "dron09: the marker", "MADE UP")
    assert [word for word in words if word not in " | ".join(notes)] == ["MADE UP"]
    read, noted = converted("".join(map(flat, OTHERS)))  # without starts
    assert read.text.count("# start made up") == 3
    assert "--poses" in noted


@pytest.fixture
def index(tmp_path):
    """An index of 2023 with the files of its robots beside it."""
    given = {"dron01": ("virtual", "0.1, 0.5"), "khepera01": ("digital_twin", "-0.4 0.0")}
    lines = []
    for name, (kind, place) in {**given, "khepera02": ("virtual", "0.5, 0.1")}.items():
        (tmp_path / f"AC_{name}.yaml").write_text(flat(name))
        lines.append(f"{name}:\n  name: {name}\n  config_path: AC_{name}.yaml\n  pose: {place}\n  type: {kind}\n")
    (tmp_path / "AC.yaml").write_text("\n".join(lines))
    return tmp_path / "AC.yaml"


def from_index(index):
    return convert_text(index.read_text(), str(index), 20.0)[0]


def test_index_of_2023_follows_the_files_it_names(index):
    experiment = document.loads(from_index(index)).experiment
    first = experiment.robots["khepera01"]
    assert (first.body, first.start, first.shadow) == ("khepera4://192.168.0.1:50000", [-0.4, 0.0, -1.5], Shadow())
    made = experiment.formation.links
    assert made["dron01 > khepera01"].gain == pytest.approx(0.5 / 0.8667, rel=1e-3)  # the real one's driver divides
    assert starts_from(str(index))["khepera02"] == (0.5, 0.1, 0.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "there is no such file"),
        ("- 1\n", "is no table"),
        ("{}\n", "has no robot"),
        (flat("dron01", speaks="Loud"), "'Loud'"),
        (flat("dron01", relations="dron07_1.0"), "dron07"),
    ],
)
def test_faults_of_an_index_name_their_file(index, text, said):
    broken = index.with_name("AC_dron01.yaml")
    broken.unlink()
    if text is not None:
        broken.write_text(text)
    with pytest.raises(DocumentError, match=said) as raised:
        from_index(index)
    assert raised.value.problems[0].file == str(index if said == "dron07" else broken)
    for each in index.parent.glob("AC_*.yaml"):
        each.unlink()
    with pytest.raises(DocumentError, match=r"3 files of robots that are not beside it: AC_dron01\.yaml") as raised:
        from_index(index)
    assert [problem.file for problem in raised.value.problems] == [str(index)]


WORLD = """#VRML_SIM R2023a utf8
WorldInfo { title "a { brace in a name" }
DEF dron01 Crazyflie {
  translation 0.1 0.5 0.015
  children [ Camera { name "camera" translation 9 9 9 } ]
  name "dron01"
}
KheperaIV { translation -0.4 0 0.01 rotation 0 0 -1 1.5 name "khepera01" } # at the wall
"""


def test_starts_from_a_webots_world(tmp_path):
    file = tmp_path / "park.wbt"
    file.write_text(WORLD)
    assert starts_from(str(file)) == {"dron01": (0.1, 0.5, 0.015), "khepera01": (-0.4, 0.0, -1.5)}
    for text, said in (
        ("Robot { name", "tells the start of no robot"),
        ('Robot { name "dron01" translation 1 x 2 }', r"dron01.translation\[1\]: Expected `float`"),
        ('Robot { name "dron01" translation }', "dron01.translation: Expected `array` of length 3"),
    ):
        file.write_text(text)
        with pytest.raises(DocumentError, match=said):
            starts_from(str(file))
    file.with_name("poses.txt").write_text("dron01: 0.1\n")
    with pytest.raises(DocumentError, match="tells the start of no robot"):
        starts_from(str(tmp_path / "poses.txt"))


def asked(position, pairs=None, *, relative=False):
    pairs = np.stack(np.triu_indices(len(position), 1), axis=1) if pairs is None else pairs
    i, j = pairs.T
    apart = position[i] - position[j]
    distance, blank = np.linalg.norm(apart, axis=1), np.full_like(apart, np.nan)
    wants = np.full(len(pairs), BY_RELATIVE if relative else BY_DISTANCE)
    return Links(i, j, distance, np.ones(len(pairs)), apart, blank, wants)


def to_origin(position, *rows):
    zero = (0.0, 0.0, 0.0)
    return [(row, Anchor(zero, zero, 1.0, 0.0, float(np.linalg.norm(position[row])), 1.0)) for row in rows]


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("rows", [4, 5, 7, 9])
def test_a_shape_is_found_again_from_nearby(rows, relative):
    rng = np.random.default_rng(rows)
    shape = rng.uniform(-1.0, 1.0, (rows, 3))
    start = shape + rng.uniform(-0.02, 0.02, shape.shape)
    found = find_shape(asked(shape, relative=relative), to_origin(shape, 0, 1), start, np.ones(rows, dtype=bool))
    assert found.worst < ENOUGH


def ring(count, height=0.0):
    return np.array([(np.cos(a), np.sin(a), height) for a in 2.0 * np.pi * np.arange(count) / count])


def test_what_contradicts_itself_is_measured():
    start = np.array([(0.0, 0, 0), (1.0, 0.1, 0), (2.0, 0, 0)])
    found = find_shape(links([(0, 1), (1, 2), (0, 2)], [1.0, 1.0, 2.3]), (), start, np.zeros(3, dtype=bool))
    assert found.worst == pytest.approx(0.1, abs=1e-3)  # 0.3 m, shared by three


def test_shape_met_at_start_heights_is_not_folded():
    shape = ring(6, 0.7)
    found = find_shape(asked(shape).take(np.arange(0, 15, 2)), (), shape * [1.3, 0.8, 1.0], np.ones(6, dtype=bool))
    assert found.worst < ENOUGH
    assert found.position[:, 2] == pytest.approx(0.7)


@pytest.mark.parametrize("seed", range(4))
def test_space_shapes_are_found_from_coplanar_starts(seed):
    """Twelve drones on a hemisphere, linked to their nearest: a single beginning misses most of them."""
    made = layouts.hemisphere(12, 0.6, 0.25)
    shape = made.position
    start = shape * [1.2, 1.2, 0.0] + np.random.default_rng(seed).normal(0.0, [0.25, 0.25, 0.0], shape.shape)
    assert find_shape(asked(shape, made.pairs), (), start, np.ones(12, dtype=bool)).worst < ENOUGH


def solids(flies):
    kinds = [CRAZYFLIE if each else KHEPERA4 for each in flies]
    return Room(Solids.of(kinds, links([(0, k) for k in range(1, len(flies))]), flies, 0.1), flies, 0.3)


def test_a_shape_below_the_floor_is_mirrored():
    shape = np.concatenate([ring(5), [[0.1, 0.0, 0.9], [-0.3, 0.2, 0.8]]])
    climbs = np.arange(7) >= 5
    start = shape * [1.2, 1.0, -0.2]  # nearer to the mirror image
    below = find_shape(asked(shape), (), start, climbs)
    above = find_shape(asked(shape), (), start, climbs, solids(climbs))
    assert max(below.worst, above.worst) < ENOUGH
    assert below.position[climbs, 2].max() < 0.0
    assert above.position[:, 2] == pytest.approx([0.0] * 5 + [0.9, 0.8], abs=1e-3)


def test_shape_of_crowded_drones_stays_above_the_floor():
    """Two of its drones are too near to one another, upright and mirrored."""
    top = [[0.6, 0.0, 1.0], [-0.5, 0.3, 0.9], [0.0, -0.6, 0.95], [0.0, -0.6, 1.02]]
    shape, climbs = np.concatenate([ring(5), top]), np.arange(9) >= 5
    found = find_shape(asked(shape), (), shape * [1.2, 1.0, -0.2], climbs, solids(climbs))
    assert found.worst < ENOUGH
    assert found.position[:, 2] == pytest.approx(shape[:, 2], abs=1e-3)


def test_robots_in_one_place_are_no_shape():
    """A square without diagonals may fold: two corners then are in one place."""
    square = np.array([(0.0, 0, 0.7), (1.0, 0, 0.7), (1.0, 1.0, 0.7), (0.0, 1.0, 0.7)])
    pairs = np.array([(0, 1), (1, 2), (2, 3), (0, 3)])
    flies = np.ones(4, dtype=bool)
    start = np.array([(0.0, 0, 0.7), (1.0, 0, 0.7), (0.01, 0.1, 0.7), (1.0, 0.01, 0.7)])
    assert np.ptp(find_shape(asked(square, pairs), (), start, flies).position, axis=0)[2] < 0.01
    found = find_shape(asked(square, pairs), (), start, flies, solids(flies))
    assert found.worst < ENOUGH
    assert not len(solids(flies).solids.overlaps(found.position))
