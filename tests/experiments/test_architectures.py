"""Architectures in virtual time: the same decision wherever it is made, and what the way to it costs."""

import csv

import numpy as np
import pytest

from agents.network import messages, validation
from agents.network.messages import Goal, Malformed
from experiments.check import check
from experiments.definition.experiment import ChannelTable, Hybrid, LegTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.report import metrics_files, report
from experiments.report.tables import architecture_table
from experiments.report.verdict import findings
from tests.experiments.virtual_time.evaluators import alike, played_back
from tests.runs import fly
from tests.small import changed, reference, small
from twins.arrays import norm

pytestmark = pytest.mark.slow  # runs and reports, whole

HYBRID = Hybrid(kind="hybrid", robots=["KH02", "CF02", "CF03"])
PERIODIC, EVENT = reference("periodic"), reference("event")
BOTH, ALL = ("distributed", "centralised"), ("distributed", "centralised", HYBRID)


def short(experiment, **parts):
    """Five seconds of it, with a leader that drives."""
    leg = LegTable(at_s=3.0, robot="TB01", plan={"kind": "line", "move_by": [0.3, 0.0], "speed": 0.15})
    return changed(experiment, **{"duration_s": 5.0, "timeline": [leg], **parts})


def with_delay(experiment, delay_s, architecture="distributed", **more):
    return changed(experiment, channel=ChannelTable(delay_s=delay_s, **more), architecture=architecture)


ALONE = small(
    {"A": "khepera4"},
    duration_s=5.0,
    timeline=[LegTable(at_s=0.0, robot="A", plan={"kind": "waypoints", "points": [[0.3, 0.0]], "speed": 0.1})],
)


@pytest.mark.parametrize(
    ("park", "seed"),
    [
        (short(PERIODIC), 1),
        (short(PERIODIC, duration_s=4.0, formation=changed(PERIODIC.formation, update="relative-control")), 2),
        (short(PERIODIC, duration_s=2.0, timeline=[], avoidance={"kind": "potential"}), 1),
        (ALONE, 1),
        pytest.param(PERIODIC, 1, marks=pytest.mark.nightly),
    ],
    ids=["formation", "updates on events", "avoidance", "no formation", "whole"],
)
def test_architectures_without_delay_move_the_same(park, seed):
    first = fly(with_delay(park, 0.0), seed).log
    assert first.time[-1] >= park.duration_s
    for architecture in ALL[1:] if park is not ALONE else BOTH[1:]:
        second = fly(with_delay(park, 0.0, architecture), seed).log
        for what in ("true_position", "true_yaw", "goal"):
            wanted, found = (getattr(log, what)[log.time > -1e-9] for log in (first, second))
            np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9, err_msg=what)
        assert (second.updates >= first.updates).all()  # goals are said again now and then


def test_centralised_events_differ_only_by_the_robots_belief():
    """Poses are said on events: the centre knows of a robot what its neighbours know."""
    first, second = (fly(with_delay(short(EVENT), 0.0, a)).log.true_position for a in BOTH)
    assert 1e-4 < norm(first - second).max() < 0.05


def test_delay_makes_the_centre_worse_and_itself_known():
    near, far = ([fly(with_delay(short(PERIODIC), d, a)).metrics for a in BOTH] for d in (0.0, 0.1))
    assert near[1].mean["iae"] == pytest.approx(near[0].mean["iae"], rel=1e-9)
    assert far[1].mean["iae"] > 1.03 * far[0].mean["iae"]
    late, delays = far[1].guidance, near[1].guidance.delay_max_s
    assert (delays, late.delay_mean_s, late.delay_max_s) == pytest.approx((0.0, 0.2, 0.2), abs=1e-9)  # both ways
    assert (late.load, far[0].guidance) == (None, None)
    delay = fly(with_delay(short(PERIODIC), 0.031, "centralised")).trace.goals.delay
    # said at 0, 20, 40, 60 ms before a decision: the newest that is there is 40 ms old; the goal acts on the next tick
    np.testing.assert_allclose(delay, 0.04 + 0.04, atol=1e-9)


def test_lost_poses_and_goals_are_counted():
    case = fly(with_delay(short(PERIODIC), 0.01, "centralised", loss=0.2)).metrics
    late, sent = case.guidance, sum(robot.messages for robot in case.robots)
    assert (late.goals, late.received + late.poses_lost) == pytest.approx((7 * 50, sent), abs=7)  # some under way
    assert late.goals_lost / late.goals == pytest.approx(0.2, abs=0.06)
    assert late.poses_lost / sent == pytest.approx(0.2, abs=0.02)
    assert case.lost == 0, "the real network lost nothing"
    assert all(robot.worst is not None for robot in case.robots)


def test_a_recording_tells_the_same(tmp_path):
    park = short(EVENT, duration_s=4.0, timeline=[])
    run = fly(with_delay(park, 0.03, HYBRID, loss=0.05), 3)
    first, second = (each.goals for each in played_back(run.recorder, tmp_path))
    for what in ("acted", "delay", "reached", "follower", "received", "lost", "dropped"):
        assert alike(getattr(first, what), getattr(second, what), 3e-6), what
    for what in ("stamp", "link", "bytes"):
        assert alike(getattr(first.sent, what), getattr(second.sent, what), 3e-6), what
    assert (len(first.sent), first.dropped.sum() > 0) == (3 * 40, True)


def test_messages_of_the_whole_network_are_counted_alike():
    park = short(PERIODIC, duration_s=4.0, timeline=[])
    runs = [fly(with_delay(park, 0.0, architecture)) for architecture in ALL]
    distributed, centralised, hybrid = (run.metrics for run in runs)
    poses = sum(robot.messages for robot in distributed.robots)
    assert poses == sum(robot.messages for robot in centralised.robots) == 7 * 200
    assert (distributed.network_messages, distributed.deliveries) == (poses, 21 * 200)
    assert centralised.network_messages == centralised.deliveries == poses + 7 * 40
    # of 21 links 10 are those of KH02, CF02, CF03; the centre hears all but the leader
    links = len(runs[2].plan.pose_links) + 6
    assert hybrid.deliveries == links * 200 + 3 * 40
    assert sum(robot.receivers for robot in hybrid.robots) == links
    assert (centralised.guidance.goals_hz, {robot.received for robot in centralised.robots}) == (70.0, {200})
    assert centralised.network_bytes > distributed.network_bytes
    goals = [robot.goals for robot in hybrid.robots]
    assert (goals, hybrid.guidance.guided) == ([0, 0, 40, 0, 0, 40, 40], ("KH02", "CF02", "CF03"))


def test_the_report_compares_them(tmp_path):
    park, names = short(PERIODIC, duration_s=4.0, timeline=[]), ("apart", "together")
    flights = [fly(with_delay(park, 0.05, a), case=name) for a, name in zip(BOTH, names, strict=True)]
    traces, found = [run.trace for run in flights], [run.metrics for run in flights]
    cells = {row.cells[0]: row.cells[1:] for row in architecture_table(found).rows}
    own, more = cells["IAE relative to apart"]
    assert (cells["Decides"], cells["Delay, mean [ms]"], own) == (("every robot", "the centre"), ("–", "110"), "1.00")
    assert float(more) > 1.0
    assert any("a centre decides for TB01" in finding.text for finding in findings(found))
    page, alone = (report.write(tmp_path, traces[:n], measured=found[:n], drawn=False).read_text() for n in (2, 1))
    assert ["Architecture</h2>" in text for text in (page, alone)] == [True, False]
    metrics_files.write_csv(tmp_path / "metrics.csv", found)
    row = list(csv.DictReader((tmp_path / "metrics.csv").read_text().splitlines()))[9]
    assert (row["case"], row["goals"], float(row["delay_p95_s"])) == ("together", "40", pytest.approx(0.11))
    together = metrics_files.document("", 1, found)["cases"]["together"]
    assert (together["guidance"]["goals"], together["network"]["messages"]) == (280, found[1].network_messages)


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
        ("3", "must be text or a table"),
    ],
)
def test_what_makes_no_sense_is_refused(architecture, says):
    with pytest.raises(DocumentError) as caught:
        document.loads(TWO + f"[cases.odd]\narchitecture = {architecture}\n")
    (problem,) = caught.value.problems
    assert says in f"{problem.message}; {problem.hint}"
    assert problem.line == 10


def test_whom_the_centre_guides():
    guided = [Plan(changed(PERIODIC, architecture=architecture)).guided for architecture in ALL]
    assert guided == [(), tuple(PERIODIC.robots), ("KH02", "CF02", "CF03")]


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


def test_velocity_of_a_goal_is_checked():
    for velocity in ([0.1], [0.1, 99.0], [float("nan"), 0.0], [0.0] * 4):
        goal = Goal("A", 1, 2.0, (0.0, 0.0, 0.0), None, 2.0, velocity)
        with pytest.raises(Malformed, match="velocity"):
            validation.check_goal(goal, now=2.0, valid_box=(1.0, 1.0, 1.0), oldest_s=1.0)
    assert messages.wanted((0.1, 0.2, float("nan"))) == [0.1, 0.2]
    assert messages.wanted((float("nan"),) * 3) is None
