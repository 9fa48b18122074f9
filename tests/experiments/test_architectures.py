"""Architectures in virtual time: the same decision wherever it is made, and what the way to it costs."""

import msgspec
import numpy as np
import pytest

from experiments.check import check
from experiments.definition.experiment import ChannelTable, Experiment, Formation, Hybrid, LegTable, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.metrics import measure
from experiments.recording import playback
from experiments.report import metrics_files, report
from experiments.report.tables import architecture_table
from experiments.report.verdict import findings
from experiments.virtual_time import simulation
from experiments.virtual_time.log import RunRecorder
from twins.arrays import norm

pytestmark = pytest.mark.slow  # runs and reports, whole

HYBRID = Hybrid(kind="hybrid", robots=["KH02", "CF02", "CF03"])
LINE = {"kind": "line", "move_by": [0.3, 0.0], "speed": 0.15}


@pytest.fixture(scope="module")
def cases():
    return {name: plan.experiment for name, plan in document.read("robotic-park").cases().items()}


def short(experiment, **parts):
    """Five seconds of it, with a leader that drives."""
    given = {"duration_s": 5.0, "timeline": [LegTable(at_s=3.0, robot="TB01", plan=LINE)], **parts}
    return msgspec.structs.replace(experiment, **given)


def with_delay(experiment, delay_s, architecture="distributed", **more):
    return msgspec.structs.replace(experiment, channel=ChannelTable(delay_s=delay_s, **more), architecture=architecture)


FLOWN = {}


def fly(experiment, seed=1):
    """Recording of a run; each is flown once."""
    key = msgspec.json.encode(experiment), seed
    if key not in FLOWN:
        FLOWN[key] = simulation.simulate(Plan(experiment), seed)
    return FLOWN[key]


def traced(experiment, case=""):
    return RunRecorder(fly(experiment), Plan(experiment), case or str(experiment.architecture)[:11]).trace()


def measured(experiment):
    return measure.measure(traced(experiment))


def assert_same_motion(first, second):
    one, other = first.time > -1e-9, second.time > -1e-9
    assert one.sum() == other.sum()
    for what in ("true_position", "true_yaw", "goal"):
        wanted, found = getattr(first, what)[one], getattr(second, what)[other]
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9, err_msg=what)


# ---------------------------------------------------------------- without delay, and with it


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("architecture", ["centralised", HYBRID])
def test_architectures_without_delay_move_the_same(cases, architecture, whole):
    park = cases["periodic"] if whole else short(cases["periodic"])
    first = fly(with_delay(park, 0.0))
    assert first.time[-1] > park.duration_s
    assert_same_motion(first, fly(with_delay(park, 0.0, architecture)))


@pytest.mark.parametrize(("update", "seed"), [(None, 1), ("relative-control", 2)])
def test_motion_is_alike_when_updates_have_events(cases, update, seed):
    formation = msgspec.structs.replace(cases["periodic"].formation, update=update)
    park = short(cases["periodic"], duration_s=4.0, timeline=[LegTable(at_s=2.0, robot="TB01", plan=LINE)],
                 formation=formation)  # fmt: skip
    first = fly(with_delay(park, 0.0), seed)
    for architecture in ("centralised", HYBRID):
        second = fly(with_delay(park, 0.0, architecture), seed)
        assert_same_motion(first, second)
        np.testing.assert_array_equal(second.updates >= first.updates, True)  # goals are said again now and then


def test_centralised_events_differ_only_by_the_robots_belief(cases):
    """Poses are said on events: the centre knows of a robot what its neighbours know."""
    park = short(cases["event"])
    first, second = (fly(with_delay(park, 0.0, a)) for a in ("distributed", "centralised"))
    apart = norm(first.true_position - second.true_position).max()
    assert 1e-4 < apart < 0.05


def test_delay_makes_the_centre_worse_and_itself_known(cases):
    park = cases["periodic"]
    near, far = ({a: measured(with_delay(short(park), d, a)) for a in ("distributed", "centralised")}
                 for d in (0.0, 0.1))  # fmt: skip
    assert near["centralised"].mean["iae"] == pytest.approx(near["distributed"].mean["iae"], rel=1e-9)
    assert far["centralised"].mean["iae"] > 1.03 * far["distributed"].mean["iae"]
    assert near["centralised"].guidance.delay_max_s == pytest.approx(0.0, abs=1e-9)
    late = far["centralised"].guidance
    assert (late.delay_mean_s, late.delay_max_s) == pytest.approx((0.2, 0.2), abs=1e-9)  # both ways, on the grid
    assert late.load is None
    assert far["distributed"].guidance is None


def test_goals_are_delayed_by_network_and_decision_grid(cases):
    park = with_delay(short(cases["periodic"]), 0.031, "centralised")
    delay = traced(park).goals.delay
    # said at 0, 20, 40, 60 ms before a decision: the newest that is there is 40 ms old; the goal acts on the next tick
    np.testing.assert_allclose(delay, 0.04 + 0.04, atol=1e-9)


def test_the_default_network_is_one_tick(cases):
    late = measured(msgspec.structs.replace(short(cases["periodic"]), architecture="centralised")).guidance
    assert late.delay_mean_s == pytest.approx(0.02 + 0.01, abs=1e-9)


# ---------------------------------------------------------------- losses


def test_deciding_robots_are_unaffected_by_guided_ones(cases):
    """Who is guided moves as before where it hears at once; what it says is heard as ever."""
    park = short(cases["periodic"], duration_s=3.0, timeline=[])
    first = fly(with_delay(park, 0.0))
    second = fly(with_delay(park, 0.0, HYBRID))
    np.testing.assert_array_equal(first.sent.link, second.sent.link)
    names = np.array(first.names)
    links = Plan(with_delay(park, 0.0, HYBRID)).pose_links
    assert not set(names[links.receiver]) & set(HYBRID.robots)
    assert len(second.received) == len(first.received) * len(links) / len(Plan(park).pose_links)


def test_lost_poses_and_goals_are_counted(cases):
    park = with_delay(short(cases["periodic"]), 0.01, "centralised", loss=0.2)
    case = measured(park)
    late = case.guidance
    assert late.goals == pytest.approx(7 * 50, abs=7)
    assert late.goals_lost / late.goals == pytest.approx(0.2, abs=0.06)
    sent = sum(robot.messages for robot in case.robots)
    assert late.poses_lost / sent == pytest.approx(0.2, abs=0.02)
    assert case.lost == 0, "the real network lost nothing"
    assert late.received + late.poses_lost == pytest.approx(sent, abs=7)  # the last ones are under way
    assert case.acquired_s == (None, None)
    assert max(robot.worst is None for robot in case.robots) is False


def test_links_of_avoidance_stay_with_the_robots(cases):
    park = with_delay(short(cases["periodic"], duration_s=2.0, timeline=[], avoidance={"kind": "barrier"}), 0.0)
    first = fly(park)
    second = fly(msgspec.structs.replace(park, architecture="centralised"))
    assert_same_motion(first, second)
    np.testing.assert_array_equal(first.setpoint, second.setpoint)


# ---------------------------------------------------------------- what is recorded, measured and said


def test_a_recording_tells_the_same(tmp_path, cases):
    park = with_delay(short(cases["event"], duration_s=4.0, timeline=[]), 0.03, HYBRID, loss=0.05)
    log = fly(park, 3)
    book = RunRecorder(log, Plan(park), "hybrid")
    book.record(tmp_path / "hybrid.mcap", "")
    first, second = book.trace().goals, playback.read(tmp_path / "hybrid.mcap").trace.goals
    np.testing.assert_allclose(second.sent.stamp, first.sent.stamp, rtol=0.0, atol=3e-6)
    for what in ("acted", "delay"):
        np.testing.assert_allclose(getattr(second, what), getattr(first, what), rtol=0.0, atol=3e-6)
    for what in ("link", "bytes"):
        np.testing.assert_array_equal(getattr(second.sent, what), getattr(first.sent, what))
    for what in ("reached", "follower", "received", "lost", "dropped"):
        np.testing.assert_array_equal(getattr(second, what), getattr(first, what))
    assert len(first.sent) == 3 * 40
    assert first.dropped.sum() > 0


def test_messages_of_the_whole_network_are_counted_alike(cases):
    park = short(cases["periodic"], duration_s=4.0, timeline=[])
    distributed, centralised, hybrid = (
        measured(with_delay(park, 0.0, a)) for a in ("distributed", "centralised", HYBRID)
    )
    poses = sum(robot.messages for robot in distributed.robots)
    assert poses == sum(robot.messages for robot in centralised.robots) == 7 * 200
    assert distributed.network_messages == poses
    assert distributed.deliveries == 21 * 200
    assert centralised.network_messages == centralised.deliveries == poses + 7 * 40
    # of 21 links 10 are those of KH02, CF02, CF03; the centre hears all but the leader
    listened = {robot.robot: robot.receivers for robot in hybrid.robots}
    links = Plan(with_delay(park, 0.0, HYBRID)).pose_links
    assert hybrid.deliveries == (len(links) + 6) * 200 + 3 * 40
    assert sum(listened.values()) == len(links) + 6
    assert centralised.guidance.goals_hz == pytest.approx(70.0)
    assert centralised.network_bytes > distributed.network_bytes
    assert {robot.received for robot in centralised.robots} == {200}
    assert [robot.goals for robot in hybrid.robots] == [0, 0, 40, 0, 0, 40, 40]
    assert hybrid.guidance.guided == ("KH02", "CF02", "CF03")


def test_the_report_compares_them(tmp_path, cases):
    park = short(cases["periodic"], duration_s=4.0, timeline=[])
    traces = []
    for name, architecture in (("apart", "distributed"), ("together", "centralised")):
        experiment = with_delay(park, 0.05, architecture)
        traces.append(traced(experiment, name))
    found = [measure.measure(trace) for trace in traces]
    table = architecture_table(found)
    cells = {row.cells[0]: row.cells[1:] for row in table.rows}
    assert cells["Decides"] == ("every robot", "the centre")
    assert cells["Delay, mean [ms]"] == ("–", "110")
    assert cells["Goals per second"] == ("–", "70.0")
    assert cells["IAE relative to apart"][0] == "1.00"
    assert float(cells["IAE relative to apart"][1]) > 1.0
    assert any("a centre decides for TB01" in finding.text for finding in findings(found))
    page = report.write(tmp_path, traces, measured=found, drawings={}).read_text()
    assert "Architecture</h2>" in page
    alone = report.write(tmp_path, traces[:1], measured=found[:1], drawings={}).read_text()
    assert "Architecture</h2>" not in alone
    metrics_files.write_csv(tmp_path / "metrics.csv", found)
    header, *rows = (tmp_path / "metrics.csv").read_text().splitlines()
    columns = dict(zip(header.split(","), rows[9].split(","), strict=True))
    assert (columns["case"], columns["goals"]) == ("together", "40")
    assert float(columns["delay_p95_s"]) == pytest.approx(0.11)
    together = metrics_files.document("", 1, found)["cases"]["together"]
    assert together["guidance"]["goals"] == 280
    assert together["network"]["messages"] == found[1].network_messages


# ---------------------------------------------------------------- the file

TWO = """
title = "two"
duration_s = 5.0
[robots]
A = { kind = "khepera4", start = [-0.5, 0.0] }
B = { kind = "khepera4", start = [0.5, 0.0] }
[formation.links]
"A - B" = 0.6
"""


@pytest.mark.parametrize(
    ("architecture", "says"),
    [
        ('"centralized"', "did you mean 'centralised'"),
        ('{ kind = "hybrid", robots = [] }', "length >= 1"),
        ('{ kind = "hybrid", robots = ["A", "C"] }', "no robot is called 'C'"),
        ('{ kind = "hybrid", robots = ["A", "A"] }', "named twice"),
        ('{ kind = "hybrid", robots = ["B", "A"] }', 'write architecture = "centralised"'),
        ('{ kind = "hybrid" }', "'robots' is missing"),
        ("3", "must be text or a table"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, architecture, says):
    file = tmp_path / "two.toml"
    file.write_text(TWO + f"[cases.odd]\narchitecture = {architecture}\n")
    with pytest.raises(DocumentError) as caught:
        document.read(file)
    (problem,) = caught.value.problems
    assert says in f"{problem.message}; {problem.hint}"
    assert problem.line == 10


def test_no_robot_is_called_as_the_centre(tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(TWO.replace("B =", "centre =").replace("A - B", "A - centre"))
    with pytest.raises(DocumentError, match="a robot cannot be called 'centre'"):
        document.read(file)


def test_check_says_what_it_means(tmp_path, unflown):
    file = tmp_path / "two.toml"
    file.write_text(TWO + '[cases.a]\narchitecture = "centralised"\n[cases.b]\n'
                    'architecture = { kind = "hybrid", robots = ["A"] }\ntrigger = "lyapunov"\n')  # fmt: skip
    found = {finding.code: finding for finding in check.check(document.read(file))}
    assert "decides for all 2 robots 10 times a second" in found["centralised"].message
    assert "decides for A 10 times" in found["hybrid"].message
    assert found["error-unknown"].where.endswith(":13:11")
    late = check.check(document.read(file, ["safety.neighbour_timeout_s=0.1"]))
    assert [each.code for each in late if each.severity == "error"] == ["goals-too-old"]
    assert not {"centralised", "hybrid"} & {each.code for each in check.check(document.read("robotic-park"))}


def test_who_is_guided(cases):
    park = cases["periodic"]
    assert Plan(park).guided == ()
    assert Plan(with_delay(park, 0.0, "centralised")).guided == tuple(park.robots)
    assert Plan(with_delay(park, 0.0, HYBRID)).guided == ("KH02", "CF02", "CF03")


def test_robots_without_a_formation_are_guided_too():
    robots = {"A": RobotTable(kind="khepera4", start=[0.0, 0.0])}
    plan = LegTable(at_s=0.0, robot="A", plan={"kind": "waypoints", "points": [[0.3, 0.0]], "speed": 0.1})
    one = Experiment(title="one", duration_s=5.0, robots=robots, timeline=[plan], formation=Formation())
    first, second = (fly(with_delay(one, 0.0, a)) for a in ("distributed", "centralised"))
    assert_same_motion(first, second)
    assert second.true_position[-1, 0, 0] > 0.25
