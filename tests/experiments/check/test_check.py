"""`./zenpark check`: the reference, its neighbours, what cannot work, obstacles, sensors, worlds, mirrors, shadows."""

import json
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from agents.body.limits import Safety
from agents.decision.position_control import REACHED
from agents.network import messages
from agents.plugins import registry
from agents.plugins.law import Control, Law
from agents.plugins.laws import Gradient
from agents.vectors import UNKNOWN, ZERO, norm
from experiments.check import check as checks
from experiments.check.analysis import Analysis
from experiments.check.check import check, examine, figures
from experiments.check.findings import CheckNumbers, Finding
from experiments.check.ideal_run import Prediction
from experiments.check.safety import batteries, safety
from experiments.definition.experiment import LegTable, RobotTable
from experiments.definition.plan import Plan
from experiments.file import catalogue, document
from experiments.file.document import loads
from tests.commands import invoke
from tests.experiments.checked import GROUND, assert_found, bad, findings, ground
from tests.small import changed, reference, small

pytestmark = pytest.mark.slow  # each check flies the experiment on the virtual clock

PARK, TRIANGLE = "robotic-park", "triangle"


@pytest.fixture(scope="module")
def examined():
    return examine(document.read(PARK))


def test_numbers_of_the_reference(examined):
    found = examined[1]["event"]
    assert (found.robots, found.links, found.edges, found.parts, found.leaders) == (7, 21, 12, 1, ("TB01",))
    assert (found.rank, found.rank_needed, found.rank_space, found.rank_space_needed) == (11, 11, 12, 15)
    assert (found.residual_mm, found.loop_gain) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.96, abs=0.02))
    assert (found.speed_needed, found.speed_available) == (0.15, pytest.approx(0.0952, abs=1e-4))
    assert (found.end["TB01"], found.end_inside) == (pytest.approx((0.15, 0.8, 0.0), abs=REACHED), True)
    assert 5.0 < found.slowest_mode_s < 40.0
    assert 13.0 <= found.acquired_s <= 16.0
    assert 15.0 < found.messages_hz < 45.0  # 7 robots; published: 5.07 Hz for each follower
    assert examined[1]["periodic"].messages_hz == pytest.approx(350.0)
    velocities = document.read(TRIANGLE, ['formation.law="consensus"']).plan
    assert figures(velocities).speed_available == min(kind.speed for kind in velocities.kinds)  # not clamped


def test_reference_is_feasible_with_a_quick_leader(examined):
    (found,) = [each for each in examined[0] if each.severity != "note"]
    assert (found.code, found.severity) == ("followers-lag", "warning")
    assert "0.095 m/s" in found.message
    assert "clamp" in found.remedy
    lines = catalogue.path(PARK).read_text("utf-8").splitlines()
    (line,) = (number for number, line in enumerate(lines, 1) if line.startswith("plan = "))
    assert found.where.endswith(f"robotic-park.toml:{line}:8")
    notes = {each.code: each.message for each in examined[0] if each.severity == "note"}
    assert {"connected", "realisable", "rigid", "stable", "starts", "acquired", "inside"} <= notes.keys()
    assert "any one" in notes["redundancy"]
    assert "rank 11 of 11" in notes["rigid"]


@pytest.mark.parametrize("name", ["triangle", "convoy"])
def test_other_catalogue_experiments_have_no_findings(name):
    assert bad(name) == {}


class Steep(Gradient, frozen=True):
    largest: float = 30.0

    def pull(self, apart, link):
        length = max(norm(apart), 1e-6)
        share = self.largest * (link.distance - length) / length
        return share * apart[0], share * apart[1], share * apart[2]

    def error(self, apart, link):
        return abs(link.distance - norm(apart))


class Weak(Steep, frozen=True):
    largest: float = 0.01


class Undefined(Steep, frozen=True):
    def pull(self, apart, link):
        return ZERO if self.error(apart, link) > 1e-3 else UNKNOWN


class Comparing(Law, frozen=True):
    def step(self, view, memory):
        return Control(velocity=(0.1 * sum(each.link.relative[0] > 0.0 for each in view.neighbours), 0.0, 0.0))


class Listing(Steep, frozen=True):
    def error(self, apart, link):
        return abs(link.distance - sum(sorted(each * each for each in apart)) ** 0.5)


@pytest.mark.parametrize(
    ("law", "code", "message", "remedy"),
    [
        ("Steep", "unstable", ", limit 2", "does not use `links.gain`: let it ask for less by the law's own"),
        ("Undefined", "not-finite", "the law 'mine' gives for", "a length of 0"),
        ("Comparing", "reads-unknown", 'give the law NEEDS = "relative"', "a comparison with an unknown number"),
        ("Weak", "not-acquired", "not acquired in time", "raise the law's own parameters (largest)"),
        ("Listing", "uncompiled", "Listing.error uses", ""),
    ],
)
def test_remedy_for_a_users_law_names_the_law(monkeypatch, law, code, message, remedy):
    before, entry = registry.registered, EntryPoint("mine", f"{__name__}:{law}", registry.LAWS)
    mine = {registry.LAWS: {"mine": [entry]}}
    monkeypatch.setattr(registry, "registered", lambda group: before(group) | mine.get(group, {}))
    found = findings(document.read(TRIANGLE, ["formation.law=mine", "duration_s=1"]), ["event"])[code]
    assert message in found.message
    assert remedy in found.remedy
    assert (found.severity == "remark") == (code == "uncompiled")


@pytest.mark.parametrize(
    ("change", "expected", "message", "remedy"),
    [
        ('formation.links."KH01 - KH03"=1.3', ("error", "no-triangle"), "KH01 - KH03 (1.3 m)", "shorten"),
        ("timeline.0.plan.speed=0.3", ("error", "leader-too-fast"), "0.3 m/s; it has 0.22", "0.2 m/s"),
        ("safety.speed=0.1", ("error", "leader-too-fast"), "it has 0.1 m/s", "0.09 m/s"),
        ("disturbance={}", ("warning", "not-random"), "runs of other seeds are the same", "position_sigma"),
        ("timeline.0.plan.speed=0.21", ("warning", "leader-near-limit"), "of the 0.22 m/s", "0.2 m/s"),
        ("timeline.0.plan.speed=0.02", ("warning", "leg-cut"), "lasts 37.5 s", "59"),
        ("robots.KH01.start=[-0.98,-0.8]", ("warning", "start-margin"), "starts in a wall", "margin"),
        ("robots.CF01.start=[-0.6,0.75]", ("error", "start-overlap"), "TB01 and CF01 start 0.05 m", "floor"),
        ("cases.periodic.trigger.period_s=0.005", ("warning", "trigger-too-fast"), "in case 'periodic'", "to 200"),
        ("cases.periodic.trigger.period_s=0.03", ("warning", "trigger-uneven"), "every 0.04 s", "multiple of 0.02"),
        ("robots.CF01.hover=0.81", ("error", "too-high"), "TB01 - CF01 (0.86 m)", "lower than 0.806 m"),
        ("formation.gain=8", ("warning", "oscillates"), "", "below 6.8"),  # of links without drones
        ("formation.gain=12", ("error", "unstable"), "", "below 6.8"),
        ("rates.pose_hz=5", ("warning", "decides-unheard"), "at 5 Hz at most", "pose_hz"),
        ("channel.loss=1", ("error", "all-lost"), "no message ever arrives", "below 1"),
        ('formation.links={ "TB01 - KH01" = 600 }', ("error", "too-long"), "millimetres?", "write 0.6"),
    ],
)
@pytest.mark.usefixtures("unflown")
def test_variants_that_do_not_work_in_theory(change, expected, message, remedy):
    assert_found(PARK, change, expected, message, remedy)


@pytest.mark.usefixtures("unflown")
def test_numbers_just_within_limits_are_sound():
    found = bad(PARK, "robots.CF01.hover=0.805", "formation.gain=5")
    assert not {"too-high", "oscillates", "unstable"} & found.keys()


SQUARE = {"A - B": 1.0, "B - D": 1.0, "D - C": 1.0, "A - C": 1.0, "A - D": 1.4, "B - C": 1.1}


@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize(
    "formation",
    [
        "anchors = { A = 0.7 }\n[formation.links]\n'A - B' = 0.3",
        "links = { 'A - B' = 2.0, 'B - C' = 2.0, 'A - C' = 2.8 }",
        "links = { 'A > B' = 0.6, 'B > C' = 1.5 }",
    ],
)
def test_gain_that_is_left_out_is_calm(tmp_path, formation):
    drones = "".join(
        f"{name} = {{ kind = 'crazyflie', start = [{k}, 0.1], hover = 0.8 }}\n" for k, name in enumerate("ABC")
    )
    (tmp_path / "x.toml").write_text(f"title = 'x'\nduration_s = 5\n[robots]\n{drones}[formation]\n{formation}\n")
    made = document.read(tmp_path / "x.toml")
    assert figures(next(iter(made.cases().values()))).loop_gain < 1.65  # stable below 2
    assert made.experiment.formation.gain <= 3.0
    assert document.read(tmp_path / "x.toml", ["formation.gain=3.0"]).experiment.formation.gain == 3.0


@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize(
    ("links", "leader", "code", "message"),
    [
        ({"A > B": 1.0, "C - D": 1.0}, "A", "leader-unknown", "C, D cannot be reached by the leader (A)"),
        ({"B - C": 1.0, "C - D": 1.0, "B - D": 1.0}, "A", "leader-not-received", ""),
        ({"A > B": 1.0, "A > C": 1.0, "B - C": 1.0}, "A", "no-incoming-links", ""),
        ({"A > B": 1.0, "B > C": 1.0, "C > D": 1.0}, None, "not-rigid", "rank 3 of 5"),
        (SQUARE, None, "not-realisable", "A - D"),
        ({"A - B": 0.5, "B - C": 0.5, "A - C": 1.0, "A - D": 0.5, "B - D": 0.6}, None, "bends", "rank 4 of 5"),
    ],
)
def test_networks_that_make_no_formation(links, leader, code, message):
    assert message in ground(links, leader)[code].message


def test_no_links_are_no_formation():
    made = small(GROUND, duration_s=5.0)
    assert (figures(Plan(made)).rank, "no-formation" in findings(made)) == (None, True)
    circle = {"kind": "circle", "radius": 0.5, "period_s": 40.0}  # for ever, it is not cut off
    assert ground({}, timeline=[LegTable(at_s=1.0, robot="D", plan=circle)]) == {}


def test_only_the_cases_of_a_run_are_checked():
    read = document.read(TRIANGLE, ["cases.periodic.robots.KH01.start=[0.6, -0.45]", "duration_s=1"])
    for cases in ([], ["periodic"]):
        assert {each.code for each in check(read, cases) if each.severity == "error"} == {"start-overlap"}
    assert not [each for each in check(read, ["event"]) if each.severity == "error" or "in case" in each.message]


@pytest.mark.usefixtures("unflown")
def test_place_is_in_the_case_that_changes_it(tmp_path):
    text = catalogue.path(PARK).read_text("utf-8")
    file = tmp_path / "mine.toml"
    file.write_text(f"{text}\n[cases.wild]\nformation = {{ gain = 12.0 }}\n", encoding="utf-8")
    found = findings(document.read(file))["unstable"]
    assert found.where == f"{file}:{text.count(chr(10)) + 3}:22"
    assert found.message.startswith("in case 'wild': the sampled loop is unstable")


@pytest.mark.usefixtures("unflown")
def test_command_prints_a_table_or_json():
    output = invoke("check", PARK).stdout
    assert "periodic 350.0 per second, event" in output
    assert output.endswith("no errors, 1 warning\n")
    assert "✗ the sampled loop is unstable" in invoke("check", PARK, "--set", "formation.gain=12", code=1).stdout
    printed = json.loads(invoke("check", PARK, "--set", "robots.CF01.hover=0.81", "--json", code=1).stdout)
    assert (printed["ok"], printed["findings"][0]["code"]) == (False, "too-high")
    assert printed["figures"].keys() == {"periodic", "event"}
    assert printed["figures"]["event"].keys() == set(CheckNumbers.__struct_fields__)
    assert json.loads(invoke("check", TRIANGLE, "--json").stdout)["ok"] is True
    unread = json.loads(invoke("check", PARK, "--set", "formation.leader=TB02", "--json", code=2).stdout)
    assert (unread["ok"], unread["findings"][0]["code"], unread["figures"]) == (False, "document", {})


@pytest.mark.parametrize(
    "change",
    [
        'formation.links."KH01 - KH03"=1e200',
        "formation.gain=1e300",
        "timeline.0.plan.speed=1e300",
        pytest.param("safety.speed=1e-9", marks=pytest.mark.nightly),
        "arena.size=[1e300,1e300,1e300]",
        pytest.param("rates.coordination_hz=0.01", marks=pytest.mark.nightly),
    ],
)
def test_absurd_numbers_end_in_findings(change):
    sets = [word for each in (change, "timeline.0.at_s=3", "duration_s=6") for word in ("--set", each)]
    done = invoke("check", PARK, "--json", *sets, code=None)
    assert done.exit_code in (0, 1, 2)
    assert "Infinity" not in done.stdout
    found = json.loads(done.stdout)["findings"]
    assert found
    assert not [each for each in found if each["severity"] != "note" and not (each["remedy"] and each["where"])]


def test_batteries_ending_before_the_run_are_all_named():
    def messages_after(duration_s: float, **safety: float) -> list[str]:
        plan = Plan(changed(reference(), duration_s=duration_s, safety=changed(reference().safety, **safety)))
        standing = Prediction(plan, np.zeros(1), np.zeros((1, len(plan.names), 3)), 0, 0.0)
        return [each.message for each in batteries(Analysis(plan, standing)) if each.code == "battery-ends"]

    wheels, drones = messages_after(12000.0)
    assert "TB01 stops after about 8095 s of 12000 s" in wheels  # a Khepera lasts five hours
    assert "CF01, CF02, CF03 land after about 373 s" in drones
    assert not messages_after(300.0)
    assert not messages_after(12000.0, battery_low=0.0)


def test_linked_robots_that_come_nearer_than_the_separation():
    robots = {name: RobotTable(kind="khepera4", start=[x, 0.0]) for name, x in (("A", -0.5), ("B", 0.5))}
    plan = Plan(small(robots, {"A - B": 1.0}, safety=Safety(separation=0.5)))
    places = np.array([[(-0.5, 0, 0), (0.5, 0, 0)], [(-0.2, 0, 0), (0.2, 0, 0)]])
    motion = Prediction(plan, np.arange(2.0), places, 2, 1.0)
    (found,) = safety(Analysis(plan, motion))
    assert (found.code, "come within 0.40 m" in found.message) == ("separation-path", True)


@pytest.mark.usefixtures("unflown")
def test_payload_of_the_variables_of_a_law():
    bare, average = (figures(document.read(name).cases()["event"]) for name in ("triangle", "average"))
    assert bare.words_bytes == 0
    assert 140 < bare.pose_bytes < 200
    assert bare.pose_kbit_s == pytest.approx(0.008 * bare.pose_bytes * 50.0)
    words = [messages.encode(messages.Variable(name, [-1.234567e-05]), "json") for name in "xqn"]
    assert average.words_bytes == len(',"shared":[]') + sum(map(len, words)) + len(",,")
    periodic = figures(document.read("average").cases()["periodic"])
    assert periodic.pose_kbit_s == pytest.approx(0.008 * average.pose_bytes * 10.0)


def test_landed_drone_keeps_its_height_in_the_shape():
    found = findings(document.read("triangle", ["safety.battery_low=0.985", "duration_s=8"]))
    assert {"stable", "unstable"} & found.keys() == {"stable"}


HEAD = 'title = "One"\nduration_s = 20.0\n'
ROBOTS = """[robots]
KH01 = { kind = "khepera4", start = [-1.5, 0.0] }
CF01 = { kind = "crazyflie", start = [-1.5, 0.6], hover = 0.8 }
[formation.links]
"KH01 > CF01" = 1.0
[[timeline]]
at_s = 2.0
robot = "KH01"
plan = { kind = "line", move_by = [2.5, 0.0], speed = 0.15 }
"""
POST = "[arena.obstacles.post]\nradius = 0.1\nat = [0.5, 0.0]\n"
LOW = POST + "height = 0.3\n"
CART = '[arena.obstacles.cart]\nbox = [0.2, 0.2]\nat = [0.5, 1.0]\nheight = 0.3\nplan = { kind = "line", '
AVOIDS = '[avoidance]\nkind = "barrier"\n'
ALL = AVOIDS + 'hears = "all"\n'
PYMUNK = '[world]\nengine = "pymunk"\n'
OPEN = "[arena]\nwalls = false\n"
NEAR_WALL = ROBOTS.replace("[-1.5, 0.0]", "[-1.95, 0.0]")
SEEING = ROBOTS.replace("hover", 'sensors = ["multiranger"], hover')
APART = ROBOTS.replace(
    "[formation.links]",
    """A = { kind = "khepera4", start = [-1.0, -1.0] }
B = { kind = "khepera4", start = [-1.0, -1.5] }
[formation.links]
"A > B" = 0.5""",
)


def khepera(keys):
    return ROBOTS.replace('"khepera4"', f'"khepera4", {keys}')


BLIND = khepera("sensors = []")


@pytest.mark.parametrize(
    ("text", "severity", "code", "message", "absent"),
    [
        (LOW + ROBOTS, "warning", "hits-obstacle", "KH01 would run into 'post' at 15.3 s, around (0.34, 0.00)", ""),
        (LOW.replace("0.0", "0.5") + ROBOTS, "note", "obstacles", "", "hits-obstacle"),  # aside
        (POST + "bottom = 1.5\n" + ROBOTS, "note", "obstacles", "", "hits-obstacle"),  # high above
        (f"{CART}move_by = [0.0, -1.0], speed = 0.1 }}\n{ROBOTS}", "warning", "hits-obstacle",
         "KH01 would run into 'cart'", ""),
        (f"{CART}move_by = [0.0, -2.9], speed = 0.5 }}\n{ROBOTS}", "note", "obstacles", "", "hits-obstacle"),  # gone
        (f"{CART}move_by = [0.0, 3.0], speed = 0.5 }}\n{ROBOTS}", "warning", "obstacle-leaves",
         "the middle of 'cart' leaves the arena at 2.1 s", ""),
        # CF01 flies over it, and receives its neighbour
        (AVOIDS + LOW + ROBOTS, "note", "avoidance-acts", "avoidance will have to act", "hits-obstacle sees-nothing"),
        (AVOIDS + LOW + khepera("avoids = false"), "warning", "hits-obstacle", "KH01 would run", "avoidance-acts"),
        (LOW + "mass = 1.0\n" + ROBOTS, "warning", "not-pushed", "in the engine 'point-mass' nothing is pushed", ""),
        (LOW + "mass = 1.0\n" + ROBOTS, "note", "pushes", "", ""),
        (PYMUNK + LOW + "mass = 1.0\n" + ROBOTS, "note", "pushes", "", "not-pushed"),
        (PYMUNK + NEAR_WALL, "error", "start-overlap",
         "KH01 starts in a wall of the arena: 0.05 m off, but needs 0.07 m", ""),
        (PYMUNK + OPEN + NEAR_WALL, "note", "connected", "", "start-overlap"),
        (AVOIDS + POST + ROBOTS, "warning", "sees-nothing", "CF01 has no range sensors: it cannot avoid 'post'", ""),
        (AVOIDS + POST + SEEING, "note", "connected", "", "sees-nothing"),
        (AVOIDS + BLIND, "warning", "sees-nothing", "KH01 has neither neighbours nor range sensors", ""),
        # links of avoidance are none of the formation
        (ALL + BLIND, "note", "connected", "the network is whole; every robot is reached by KH01", "sees-nothing"),
        (APART, "error", "parts", "", ""),
        (AVOIDS + APART, "note", "parts", "", ""),
        (OPEN + khepera('body = "world", ranges = "world"'), "warning", "ranges-twice", "adds nothing", ""),
        (OPEN + khepera('body = "khepera4-twin", sensors = [], ranges = "world"'), "warning", "ranges-of-nothing",
         "no range sensors", ""),
        (OPEN + khepera('body = "khepera4-twin", ranges = "world"'), "warning", "ranges-of-nothing",
         "without obstacles and robots", ""),
        (OPEN + khepera('body = "world", shadow = {}'), "warning", "shadow-of-twin", "one twin with another", ""),
        (LOW + khepera('body = "khepera4-twin", ranges = "world", shadow = {}'), "warning", "hits-obstacle", "",
         "ranges-twice ranges-of-nothing shadow-of-twin"),
    ],
)  # fmt: skip
def test_surroundings_are_judged(text, severity, code, message, absent):
    found = findings(loads(HEAD + text))
    assert found[code].severity == severity
    assert message in found[code].message
    assert not found[code].message.startswith("in case")  # there is one alone
    assert not found.keys() & set(absent.split())


@pytest.mark.usefixtures("unflown")
def test_summary_names_the_obstacles(tmp_path):
    cart = '[arena.obstacles.cart]\nbox = [0.2, 0.3]\nat = [0.5, 1.0]\nplan = "hold"\n'
    crate = "[arena.obstacles.crate]\nradius = 0.1\nat = [1.0, 1.0]\nmass = 2.0\n"
    fence = "[arena.obstacles.fence]\nwall = [[1.0, 0.0], [1.0, 1.0]]\nbottom = 1.0\n"
    (tmp_path / "one.toml").write_text(HEAD + cart + crate + fence + ROBOTS)
    printed = invoke("check", tmp_path / "one.toml").stdout
    assert "cart (box 0.2 × 0.3 m, moves), crate (cylinder of radius 0.1 m, 2 kg), fence (wall, 1 m above" in printed


REAL = """
title = "Real drones"
duration_s = 5.0
formation = { gain = 0.5, links = { "CF01 - CF02" = 1.0 } }
[robots.CF01]
kind = "crazyflie"
start = [0.0, 0.0]
hover = 0.5
body = "radio://0/80/2M/E7E7E7E701"
device = { positioning = { system = "lighthouse", file = "nowhere.yaml" } }
[robots.CF02]
kind = "crazyflie"
start = [1.0, 0.0]
hover = 0.5
body = "radio://1/80/2M/E7E7E7E702"
position = "external"
"""


def test_devices_of_robots_are_judged(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "real.toml").write_text(REAL, "utf-8")
    found = [(each.severity, each.message, each.where) for each in check(document.read("real.toml"))
             if each.code == "device"]  # fmt: skip
    assert [(severity, where) for severity, _, where in found] == [
        ("error", "real.toml:10:58"), ("warning", "real.toml:15:8"), ("note", "real.toml:11:1")
    ]  # fmt: skip
    assert "CF01: nowhere.yaml: No such file" in found[0][1]
    assert "radios 0 and 1 are on channels 80 and 80" in found[1][1]
    assert "go to the estimators of CF02, at most 20 a second" in found[2][1]
    assert "nowhere.yaml" in invoke("run", "real.toml", code=2).stderr  # and no process has started
    assert "nowhere.yaml" not in invoke("run", "real.toml", "--virtual", "--no-report").stderr


def test_findings_name_some_of_many_cases(monkeypatch):
    found = Finding("warning", "far", "it is far", "come nearer")
    monkeypatch.setattr(checks, "SUBJECTS", (lambda number: [found] if number else [],))
    shown = checks._findings(document.read("triangle"), {f"case{k}": k for k in range(12)})
    assert shown[0].message == "in cases 'case1', 'case2', 'case3', 'case4', 'case5' and 6 more: it is far"


@pytest.mark.usefixtures("unflown")
def test_yaw_of_a_drone_is_said():
    """A third number of `start` that is meant as a height turns the drone by 57°."""
    found = findings(document.read(TRIANGLE, ["robots.CF01.start=[0.0, 0.5, 1.0]"]), ["event"])["turned"]
    assert (found.severity, "CF01 by 57°" in found.message) == ("note", True)
    assert "turned" not in findings(document.read(TRIANGLE, ["robots.KH01.start=[-0.6, -0.45, 1.0]"]), ["event"])


@pytest.mark.usefixtures("unflown")
def test_source_of_positions_is_used():
    source, external = 'positioning="optitrack://192.168.10.1"', 'robots.CF01.position="external"'
    unused = findings(document.read(TRIANGLE, [source]), ["event"])["position-unused"]
    assert unused.severity == "warning"
    published = findings(document.read(TRIANGLE, [external]), ["event"])["position-published"]
    assert published.message == "CF01: positions from outside, by a program that publishes park/CF01/position"
    both = findings(document.read(TRIANGLE, [source, external]), ["event"])
    assert not {*both} & {unused.code, published.code}
    assert both["position-unseen"].remedy == 'write body = "crazyflie-twin"'
    seen = findings(document.read(TRIANGLE, [source, external, 'robots.CF01.body="crazyflie-twin"']), ["event"])
    assert "position-unseen" not in seen
