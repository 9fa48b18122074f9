"""`./zenpark check`: the reference experiment, its neighbours, and experiments that cannot work, each with its code."""

from __future__ import annotations

import io
import json
import sys
from importlib.metadata import EntryPoint

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.decision.position_control import REACHED
from agents.network import messages
from agents.plugins import registry
from agents.plugins.law import Control, Law
from agents.plugins.laws import Gradient
from agents.vectors import UNKNOWN, ZERO, norm
from experiments.check.analysis import analyse
from experiments.check.check import check, examine, figures
from experiments.check.findings import CheckNumbers
from experiments.check.ideal_run import Prediction
from experiments.check.safety import batteries
from experiments.definition.experiment import Experiment, Formation, LegTable, RobotTable
from experiments.definition.plan import Plan
from experiments.file import catalogue, document
from experiments.file.problems import DocumentError
from tests.experiments.checked import GROUND, assert_found, bad, ground, of
from tools.commands import check as commands

pytestmark = pytest.mark.slow  # each check flies the experiment on the virtual clock

PARK, TRIANGLE = "robotic-park", "triangle"


# ------------------------------------------------------------------ experiments that work


def test_laws_of_velocities_are_not_clamped():
    plan = document.read(TRIANGLE, ['formation.law="consensus"']).plan
    found = figures(plan)
    assert found.speed_available == min(kind.speed for kind in plan.kinds)


@pytest.fixture(scope="module")
def examined():
    """Findings on the reference experiment and figures of both cases."""
    return examine(document.read(PARK))


@pytest.fixture
def park(examined):
    return examined[0]


def test_numbers_of_the_reference(examined):
    found = examined[1]["event"]
    assert (found.robots, found.links, found.edges, found.parts) == (7, 21, 12, 1)
    assert found.leaders == ("TB01",)
    assert (found.rank, found.rank_needed) == (11, 11)
    assert (found.rank_space, found.rank_space_needed) == (12, 15)
    assert found.residual_mm == pytest.approx(0.0, abs=1e-3)
    assert found.loop_gain == pytest.approx(0.96, abs=0.02)
    assert found.slowest_mode_s is not None
    assert 5.0 < found.slowest_mode_s < 40.0
    assert found.speed_needed == 0.15
    assert found.speed_available == pytest.approx(0.0952, abs=1e-4)
    assert found.acquired_s is not None
    assert 13.0 <= found.acquired_s <= 16.0
    assert found.end["TB01"] == pytest.approx((0.15, 0.8, 0.0), abs=REACHED)
    assert found.end_inside
    assert 15.0 < found.messages_hz < 45.0  # 7 robots; published: 5.07 Hz for each follower
    assert examined[1]["periodic"].messages_hz == pytest.approx(350.0)


def test_reference_is_feasible_with_a_quick_leader(park):
    (found,) = [each for each in park if each.severity != "note"]
    assert (found.code, found.severity) == ("followers-lag", "warning")
    assert "0.095 m/s" in found.message
    assert "0.15 m/s" in found.message
    assert "clamp" in found.remedy
    lines = catalogue.path(PARK).read_text("utf-8").splitlines()
    (line,) = (number for number, line in enumerate(lines, 1) if line.startswith("plan = "))
    assert found.where.endswith(f"robotic-park.toml:{line}:8")


@pytest.mark.parametrize("name", ["triangle", "convoy"])
def test_other_catalogue_experiments_have_no_findings(name):
    assert bad(name) == {}


def test_notes_say_what_was_found(park):
    notes = {each.code: each.message for each in park if each.severity == "note"}
    assert {"connected", "realisable", "rigid", "stable", "starts", "acquired", "inside"} <= notes.keys()
    assert "rank 11 of 11" in notes["rigid"]
    assert "12 of 15, not needed" in notes["rigid"]


# ------------------------------------------------------------------ experiments that do not


@pytest.mark.usefixtures("unflown")
def test_a_hover_above_the_limit_names_the_limit():
    severity, message, remedy, where = bad(PARK, "robots.CF01.hover=0.81")["too-high"]
    assert severity == "error"
    assert message.startswith("CF01 is too high at 0.81 m for")
    assert "TB01 - CF01 (0.86 m)" in message
    assert "lower than 0.806 m" in remedy
    assert where == "--set robots.CF01.hover=0.81"
    assert "too-high" not in bad(PARK, "robots.CF01.hover=0.805")


@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize(
    ("gain", "code"),
    [(5.0, None), (8.0, "oscillates"), (12.0, "unstable")],  # of links without drones
)
def test_gains(gain, code):
    found = bad(PARK, f"formation.gain={gain}")
    assert found.keys() & {"oscillates", "unstable"} == ({code} if code else set())
    if code:
        assert found[code][0] == ("error" if code == "unstable" else "warning")
        assert "below 6.8" in found[code][2]


class Steep(Gradient, frozen=True):
    """A law with a gain of its own."""

    largest: float = 30.0

    def pull(self, apart, link):
        length = max(norm(apart), 1e-6)
        share = self.largest * (link.distance - length) / length
        return share * apart[0], share * apart[1], share * apart[2]

    def error(self, apart, link):
        return abs(link.distance - norm(apart))


class Weak(Steep, frozen=True):
    """A law that hardly pulls."""

    largest: float = 0.01


class Undefined(Steep, frozen=True):
    """A law that gives no number where the formation is met."""

    def pull(self, apart, link):
        return ZERO if self.error(apart, link) > 1e-3 else UNKNOWN


class Comparing(Law, frozen=True):
    """A law that compares what it did not ask for."""

    def step(self, view, memory):
        return Control(velocity=(0.1 * sum(each.link.relative[0] > 0.0 for each in view.neighbours), 0.0, 0.0))


class Listing(Steep, frozen=True):
    """A law that is not compiled."""

    def error(self, apart, link):
        return abs(link.distance - sum([each * each for each in apart]) ** 0.5)


def test_uncompiled_law_is_noted_once(monkeypatch):
    installed = registry.registered
    mine = {registry.LAWS: {"mine": [EntryPoint("mine", f"{__name__}:Listing", registry.LAWS)]}}
    monkeypatch.setattr(registry, "registered", lambda group: installed(group) | mine.get(group, {}))
    found = [each for each in check(document.read(TRIANGLE, ["formation.law=mine"])) if each.code == "uncompiled"]
    assert [each.severity for each in found] == ["note"]
    assert "Listing.error uses" in found[0].message
    assert "test_check.py:" in found[0].message


@pytest.mark.parametrize(
    ("law", "code", "message", "remedy"),
    [
        ("Steep", "unstable", ", limit 2", "does not use `links.gain`: let it ask for less by the law's own"),
        ("Undefined", "not-finite", "the law 'mine' gives for", "a length of 0"),
        ("Comparing", "reads-unknown", 'give the law NEEDS = "relative"', "a comparison with an unknown number"),
        ("Weak", "not-acquired", "not acquired in time", "raise the law's own parameters (largest)"),
    ],
)
def test_remedy_for_a_users_law_names_the_law(monkeypatch, law, code, message, remedy):
    installed = registry.registered
    mine = {registry.LAWS: {"mine": [EntryPoint("mine", f"{__name__}:{law}", registry.LAWS)]}}
    monkeypatch.setattr(registry, "registered", lambda group: installed(group) | mine.get(group, {}))
    found = bad(TRIANGLE, "formation.law=mine", "duration_s=1")[code]
    assert message in found[1]
    assert remedy in found[2]
    assert found[3] == ("--set duration_s=1" if code == "not-acquired" else "--set formation.law=mine")


@pytest.mark.parametrize(
    ("name", "change", "expected", "message", "remedy"),
    [
        (PARK, 'formation.links."KH01 - KH03"=1.3', ("error", "no-triangle"), "KH01 - KH03 (1.3 m)", "shorten"),
        (PARK, "robots.CF02.hover=0.9", ("error", "too-high"), "KH02 - CF02 (0.86 m)", "0.860 m"),
        (PARK, "timeline.0.plan.speed=0.3", ("error", "leader-too-fast"), "0.3 m/s; it has 0.22", "0.2 m/s"),
        (PARK, "safety.speed=0.1", ("error", "leader-too-fast"), "it has 0.1 m/s", "0.09 m/s"),
        (PARK, "disturbance={}", ("warning", "not-random"), "runs of other seeds are the same", "position_sigma"),
        (PARK, "timeline.0.plan.speed=0.21", ("warning", "leader-near-limit"), "of the 0.22 m/s", "0.2 m/s"),
        (PARK, "timeline.0.plan.speed=0.02", ("warning", "leg-cut"), "lasts 37.5 s", "59"),
        (PARK, "robots.KH01.start=[-0.98,-0.8]", ("warning", "start-margin"), "0.02 m from a wall", "margin"),
        (PARK, "robots.CF01.start=[-0.6,0.75]", ("error", "start-overlap"), "TB01 and CF01 start 0.05 m", "floor"),
        (
            PARK,
            "cases.periodic.trigger.period_s=0.005",
            ("warning", "trigger-too-fast"),
            "in case 'periodic'",
            "to 200",
        ),
        (
            PARK,
            "cases.periodic.trigger.period_s=0.03",
            ("warning", "trigger-uneven"),
            "every 0.04 s",
            "multiple of 0.02",
        ),
        (PARK, "rates.pose_hz=5", ("warning", "decides-unheard"), "at 5 Hz at most", "pose_hz"),
        (PARK, "formation.leader=CF03", ("warning", "no-incoming-links"), "TB01 has no links", "> TB01"),
    ],
)
@pytest.mark.usefixtures("unflown")
def test_variants_that_do_not_work_in_theory(name, change, expected, message, remedy):
    assert_found(name, change, expected, message, remedy)


@pytest.mark.usefixtures("unflown")
def test_followers_that_cannot_hear_of_the_leader():
    found = ground({"A > B": 1.0, "C - D": 1.0}, leader="A")
    assert found["leader-unknown"].startswith("C, D cannot be reached by the leader (A)")
    assert "2 parts" in found["parts"]


@pytest.mark.usefixtures("unflown")
def test_a_leader_that_nobody_listens_to():
    assert "leader-not-received" in ground({"B - C": 1.0, "C - D": 1.0, "B - D": 1.0}, leader="A")
    assert "no-incoming-links" in ground({"A > B": 1.0, "A > C": 1.0, "B - C": 1.0}, leader="A")


@pytest.mark.usefixtures("unflown")
def test_a_chain_folds():
    assert "rank 3 of 5" in ground({"A > B": 1.0, "B > C": 1.0, "C > D": 1.0})["not-rigid"]


def test_no_links_are_no_formation():
    assert ground({}) == {}
    made = Experiment(title="made", robots=GROUND, duration_s=5.0)
    assert figures(Plan(made)).rank is None
    assert "no-formation" in {each.code for each in check(of(made))}


@pytest.mark.usefixtures("unflown")
def test_distances_that_contradict_one_another_without_a_triangle():
    square = {"A - B": 1.0, "B - D": 1.0, "D - C": 1.0, "A - C": 1.0, "A - D": 1.4, "B - C": 1.1}
    assert "A - D" in ground(square)["not-realisable"]


@pytest.mark.usefixtures("unflown")
def test_only_the_case_at_fault_is_named():
    found = bad(PARK, "cases.event.formation.gain=12")
    assert found["unstable"][1].startswith("in case 'event': the sampled loop is unstable")
    assert found["unstable"][3] == "--set cases.event.formation.gain=12"


def test_only_the_cases_of_a_run_are_checked():
    read = document.read(TRIANGLE, ["cases.periodic.robots.KH01.start=[0.6, -0.45]", "duration_s=1"])
    assert {each.code for each in check(read) if each.severity == "error"} == {"start-overlap"}
    assert {each.code for each in check(read, ["periodic"]) if each.severity == "error"} == {"start-overlap"}
    assert not [each for each in check(read, ["event"]) if each.severity == "error" or "in case" in each.message]


@pytest.mark.usefixtures("unflown")
def test_place_is_in_the_case_that_changes_it(tmp_path):
    text = catalogue.path(PARK).read_text("utf-8")
    file = tmp_path / "mine.toml"
    file.write_text(f"{text}\n[cases.wild]\nformation = {{ gain = 12.0 }}\n", encoding="utf-8")
    (unstable,) = (each for each in check(document.read(file)) if each.code == "unstable")
    assert unstable.where == f"{file}:{text.count(chr(10)) + 3}:22"


# ------------------------------------------------------------------ the command


@pytest.mark.usefixtures("unflown")
def test_the_table(capsys):
    assert commands.check(PARK, settings=[], as_json=False) == 0
    said = capsys.readouterr().out
    assert "✓ the formation is rigid, rank 11 of 11" in said
    assert "! KH01 follows at 0.095 m/s" in said
    assert "periodic 350.0 per second, event" in said
    assert said.endswith("no errors, 1 warning\n")
    assert commands.check(PARK, settings=["formation.gain=12"], as_json=False) == 1
    assert "✗ the sampled loop is unstable" in capsys.readouterr().out


@pytest.mark.usefixtures("unflown")
def test_json(capsys):
    assert commands.check(PARK, settings=["robots.CF01.hover=0.81"], as_json=True) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["file"].endswith("robotic-park.toml")
    assert said["ok"] is False
    assert said["findings"][0]["code"] == "too-high"
    assert said["figures"].keys() == {"periodic", "event"}
    assert said["figures"]["event"].keys() == set(CheckNumbers.__struct_fields__)
    assert commands.check("triangle", settings=[], as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["ok"] is True


def test_a_file_that_cannot_be_read(capsys):
    with pytest.raises(DocumentError, match="no robot is called"):
        commands.check(PARK, settings=["formation.leader=TB02"], as_json=False)
    assert commands.check(PARK, settings=["formation.leader=TB02"], as_json=True) == 2
    said = json.loads(capsys.readouterr().out)
    assert (said["ok"], said["findings"][0]["code"], said["figures"]) == (False, "document", {})


@pytest.mark.usefixtures("unflown")
def test_a_terminal_without_greek(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    assert commands.check("triangle", settings=[], as_json=False) == 0
    out.seek(0)
    assert "no errors, no warnings" in out.read()


# ------------------------------------------------------------------ whatever is in the file


@pytest.mark.parametrize(
    "change",
    [
        'formation.links."KH01 - KH03"=1e200',
        'formation.links."KH01 - KH03"=1e-9',
        "formation.gain=1e300",
        "formation.clamp=1e300",
        "formation.tracking_gain=1e300",
        "timeline.0.plan.speed=1e300",
        "timeline.0.plan.move_by=[1e300,0]",
        "safety.speed=1e-9",
        "arena.size=[1e300,1e300,1e300]",
        "rates.coordination_hz=0.01",
    ],
)
def test_absurd_numbers_end_in_findings(change, capsys):
    assert commands.check(PARK, settings=[change, "timeline.0.at_s=3", "duration_s=6"], as_json=True) in (0, 1, 2)
    assert "Infinity" not in capsys.readouterr().out


@st.composite
def experiments(draw: st.DrawFn) -> Experiment:
    """One to six robots anywhere in the arena, linked anyhow."""
    count = draw(st.integers(1, 6))
    place = st.floats(-2.0, 2.0)
    robots = {}
    for number in range(count):
        flies = draw(st.booleans())
        kind = draw(st.sampled_from(["crazyflie", "tello"] if flies else ["khepera4", "turtlebot3"]))
        hover = draw(st.floats(0.2, 2.0)) if flies else None
        robots[f"R{number}"] = RobotTable(kind=kind, start=[draw(place), draw(place)], hover=hover)
    pairs = [(i, j) for i in range(count) for j in range(i)]
    chosen = draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else []
    links = {f"R{i} {draw(st.sampled_from('>-'))} R{j}": draw(st.floats(0.05, 3.0)) for i, j in chosen}
    leader = draw(st.sampled_from([None, *robots]))
    move = [draw(place), draw(place)]
    plan = {"kind": "line", "move_by": move, "speed": draw(st.floats(0.01, 1.0))}
    legs = [LegTable(at_s=draw(st.floats(0.0, 4.0)), robot=draw(st.sampled_from(list(robots))), plan=plan)]
    formation = Formation(links=links, leader=leader, gain=draw(st.floats(0.1, 30.0)))
    return Experiment(
        title="made", robots=robots, duration_s=draw(st.floats(5.0, 10.0)), formation=formation, timeline=legs
    )


@settings(max_examples=10)
@given(experiments())
def test_errors_and_warnings_have_remedies_and_places(made):
    found, numbers = examine(of(made))
    assert found
    for each in found:
        assert each.message
        assert each.severity == "note" or (each.remedy and each.where)
    assert json.loads(msgspec.json.encode(numbers["default"]))["robots"] == len(made.robots)


def test_batteries_ending_before_the_run_are_all_named():
    experiment = document.read(PARK).cases()["event"].experiment

    def said(duration_s: float, **safety: float) -> list[str]:
        limits = msgspec.structs.replace(experiment.safety, **safety)
        made = msgspec.structs.replace(experiment, duration_s=duration_s, safety=limits)
        standing = Prediction(np.zeros(1), np.zeros((1, len(made.robots), 3)))
        return [each.message for each in batteries(analyse(Plan(made), standing))]

    wheels, drones = said(12000.0)
    assert "TB01 stops after about 8095 s of 12000 s" in wheels  # a Khepera lasts five hours
    assert "CF01, CF02, CF03 land after about 373 s" in drones
    assert not said(300.0)
    assert not said(12000.0, battery_low=0.0)


@pytest.mark.usefixtures("unflown")
def test_payload_of_what_a_law_says():
    bare, said = (figures(document.read(name).cases()["event"]) for name in ("triangle", "average"))
    assert bare.words_bytes == 0
    assert 140 < bare.pose_bytes < 200
    assert bare.pose_kbit_s == pytest.approx(0.008 * bare.pose_bytes * 50.0)
    assert said.words_bytes == len(',"shared":[]') + sum(
        len(messages.encode(messages.Variable(name, [-1.234567e-05]), "json")) for name in "xqn"
    ) + len(",,")  # fmt: skip
    periodic = figures(document.read("average").cases()["periodic"])
    assert periodic.pose_kbit_s == pytest.approx(0.008 * said.pose_bytes * 10.0)
