"""Formations of every sort from their file to where robots end, and what `check` refuses."""

import numpy as np
import pytest

from experiments.check import check
from experiments.check.realisation import contradictions
from experiments.definition.formation import compile_anchors, errors_over_time
from experiments.file import document
from tests.experiments.checked import findings
from tests.runs import fly

pytestmark = pytest.mark.slow  # runs and reports, whole

ROBOTS = """title = "Four"
duration_s = {duration}
arena = {{ size = [4.0, 4.0, 2.5] }}
[robots]
A = {{ kind = "khepera4", start = [-0.6, -0.5] }}
B = {{ kind = "khepera4", start = [0.6, -0.5] }}
C = {{ kind = "crazyflie", start = [0.5, 0.6], hover = 0.6 }}
D = {{ kind = "crazyflie", start = [-0.5, 0.9], hover = 0.6 }}
"""
SQUARE = """
[formation]
law = "displacement"
[formation.links]
"A - B" = { offset = [0.6, 0.0] }
"B - C" = { offset = [0.0, 0.6] }
"C - D" = { offset = [-0.6, 0.0, 0.0] }
"D - A" = { offset = [0.0, -0.6] }
"""
BEARINGS = """
[formation]
law = "bearing"
leader = "A"
[formation.links]
"A > B" = { bearing = [1.0, 0.0] }
"B - C" = { bearing = [0.0, 1.0] }
"C - D" = { bearing = [-1.0, 0.0] }
"D - B" = { bearing = [1.0, -1.0] }
"A > D" = { bearing = [0.0, 1.0] }
[formation.anchors]
B = 0.9
"""
MIXED = """
[formation]
law = "mixed"
leader = "A"
[formation.links]
"A > B" = { offset = [0.6, 0.0] }
"B - C" = 0.8
"A > C" = 0.8
"C - D" = 0.5
"A > D" = { bearing = [0.0, 1.0] }
"""


PARTED = '[formation.links]\n"A - B" = 0.5\n"C - D" = 0.5\n"B - C" = { distance = 0.8, from_s = 8.0, until_s = 20.0 }\n'


def four_with(text, duration=40.0):
    return document.loads(ROBOTS.format(duration=duration) + text)


def errors_in_flight(plan):
    """Times, true positions (T, N, 3) from the common start on, and errors of the links (T, E)."""
    log = fly(plan.experiment).log
    running = (log.time >= 0.0) & (log.time < plan.experiment.duration_s)
    time, position = log.time[running], log.true_position[running]
    return time, position, errors_over_time(plan.law, plan.formation, time, position)


def test_both_ends_of_a_link_want_the_same():
    links = four_with(SQUARE).plan.one_way_links
    asked = {(link.receiver, link.sender): link.target for link in links}
    assert asked["B", "A"].relative == (0.6, 0.0, 0.0)  # B stands 0.6 m along x from A
    assert asked["A", "B"].relative == (-0.6, -0.0, -0.0)
    assert asked["C", "B"].relative == (0.0, 0.6, 0.6)  # the heights that they hold
    assert asked["B", "C"].distance == pytest.approx(np.hypot(0.6, 0.6))
    assert {link.target.gain for link in links} == {0.5}  # the stiffness, not the gain of distances
    mixed = four_with(MIXED).plan
    calm, gains = (
        mixed.experiment.formation.gain,
        {f"{e.sender}{e.receiver}": e.target.gain for e in mixed.one_way_links},
    )
    assert gains == {"AB": 0.5, "CB": calm, "BC": calm, "AC": calm, "DC": calm, "CD": calm, "AD": 0.5}
    distance = four_with(SQUARE.replace('"displacement"', '"distance"')).plan.formation.links.distance
    assert distance[:2].tolist() == pytest.approx([0.6, np.hypot(0.6, 0.6)])


def test_anchors_from_the_file():
    anchored = """[formation.anchors]
A = 1.0
B = { along = [0.0, 2.0], to = [0.5, 0.0] }
C = { across = [0, 0, 1], distance = 0.6 }
D = { distance = 0.7, gain = 9.0 }
[formation.links]
"A - B" = 0.5
"""
    given = four_with(anchored).experiment
    anchors, twice = compile_anchors(given), 2.0 * given.formation.gain
    assert [anchor.gain for (anchor,) in anchors.values()] == [twice, 0.5, twice, 9.0]
    place = np.array([[1.0, 0.0, 0.0], [0.5, 7.0, 0.0], [3.0, 4.0, 0.6], [0.0, 0.7, 0.0]])
    for (anchor,), at in zip(anchors.values(), place.tolist(), strict=True):
        assert anchor.error(tuple(at)) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.usefixtures("unflown")  # it is flown beside the check
@pytest.mark.parametrize(("text", "worst"), [(SQUARE, 0.015), (BEARINGS, 0.05), (MIXED, 0.06)], ids=["s", "b", "m"])
def test_formations_come_together(text, worst):
    given = four_with(text, 60.0)
    assert not [each for each in check.check(given) if each.severity == "error"]
    _, _, error = errors_in_flight(given.plan)
    assert error[0].max() > 0.3
    assert error[-50:].max() < worst


def test_formation_that_turns_and_grows():
    given = four_with(SQUARE + "[[formation.changes]]\nat_s = 10.0\nrotate = 1.5708\nscale = 1.4\n", 30.0)
    time, position, error = errors_in_flight(given.plan)
    before, after = position[time < 10.0][-1], position[-1]
    assert max(error[time < 10.0][-1].max(), error[-1].max()) < 0.02
    np.testing.assert_allclose((before[1] - before[0])[:2], [0.6, 0.0], atol=0.02)
    np.testing.assert_allclose((after[1] - after[0])[:2], [0.0, 0.84], atol=0.02)
    assert after[2, 2] == pytest.approx(0.6, abs=0.03)


def test_links_by_range_and_by_the_clock():
    text = "[formation]\ngain = 1.5\n[formation.proximity]\nrange = 1.1\ndistance = 0.75\n"
    _, position, error = errors_in_flight(four_with(text).plan)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=3)
    there = ~np.isnan(error)
    pairs = [(i, j) for i in range(4) for j in range(4) if i != j]
    for k, (i, j) in enumerate(pairs):
        assert not there[apart[:, i, j] > 1.21, k].any()
        assert there[apart[:, i, j] <= 1.1, k].all()
    assert 0 < there[0].sum() < len(pairs)
    assert np.nanmax(error[-1]) < 0.05

    time, _, error = errors_in_flight(four_with(PARTED).plan)
    there = ~np.isnan(error)
    assert (there.sum(axis=1) == np.where((time >= 8.0 - 1e-6) & (time < 20.0 - 1e-6), 6, 4)).all()


LOOSE = BEARINGS.replace('"D - B" = { bearing = [1.0, -1.0] }\n', "").replace("B = 0.9", "A = 0.8")
APART = SQUARE.replace('"B - C" = { offset = [0.0, 0.6] }\n', "").replace('"D - A" = { offset = [0.0, -0.6] }\n', "")
CHANGING = """[formation]
anchors = { D = 0.9 }
links = { "A - B" = 0.5, "B - C" = 0.8, "C - A" = 0.8 }
changes = [{ at_s = 10.0, links = { "A - B" = 1.5 } }]
"""


CROOKED = SQUARE.replace("[0.0, -0.6]", "[0.0, -0.7]")


def test_offsets_that_do_not_add_up():
    (first, *_) = contradictions(four_with(CROOKED).plan.formation.links)
    assert sorted(first.rows) == [0, 1, 2, 3]
    assert contradictions(four_with(SQUARE).plan.formation.links) == []
    assert "offsets-contradict" not in findings(four_with(SQUARE.replace("displacement", "leader-observer")))


@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize(
    ("text", "code", "severity", "message"),
    [
        (CROOKED, "offsets-contradict", "error", "100.0 mm"),
        (CROOKED.replace("displacement", "leader-observer"), "offsets-contradict", "warning", ""),
        (SQUARE.replace('"displacement"', '"displacement"\nstiffness = 9.0'), "unstable", "error", ""),
        (SQUARE, "rigid", "note", "rank 6 of 6 in the motions that the robots have"),
        (LOOSE, "not-rigid", "warning", ""),
        (APART, "parts", "error", ""),
        (SQUARE + "[formation.anchors]\nC = 0.3\n", "anchor-not-realisable", "error", ""),
        (CHANGING, "change-not-realisable", "error", ""),
    ],
)
def test_check_judges_formations(text, code, severity, message):
    found = findings(four_with(text))[code]
    assert found.severity == severity
    assert message in found.message


def test_links_that_leave_robots_alone():
    assert "2 parts from 0.0 s to 8.0 s" in findings(four_with(PARTED, 21.0))["comes-apart"].message
    always = SQUARE + "[formation.proximity]\nrange = 3.0\n"
    assert findings(four_with(always, 10.0))["whole"].severity == "note"
