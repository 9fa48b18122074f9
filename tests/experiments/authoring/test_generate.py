"""Layouts, and the experiment files that are generated from them."""

import math
from itertools import combinations

import numpy as np
import pytest

from experiments.authoring import layouts
from experiments.authoring.generate import LayoutOptions, experiment_file, generate, layout
from experiments.authoring.layouts import LayoutError
from experiments.check.check import examine
from experiments.definition import bodies
from experiments.definition.rigidity import rigidity
from experiments.file import document
from experiments.file.problems import DocumentError


def generated(what, size, **options):
    chosen = LayoutOptions(**options)
    return document.loads(experiment_file(layout(what, size, chosen), chosen))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "size", "kind", "vital"), [("polygon", "3", "khepera4", None), ("hemisphere", "12", "tello", ("DT03",))]
)
def test_files_pass_the_check(what, size, kind, vital):
    found, figures = examine(generated(what, size, kind=kind))
    assert [each for each in found if each.severity != "note"] == []
    (numbers,) = figures.values()
    assert numbers.residual_mm < 0.3 < numbers.loop_gain < 1.1
    assert vital is None or (numbers.vital_links, numbers.vital_robots, numbers.spare_robots) == ((), vital, 11)


def test_every_robot_and_every_link_has_a_line():
    made = layout("hemisphere", "100", LayoutOptions())
    lines = experiment_file(made, LayoutOptions()).splitlines()
    assert any(line.startswith('CF001 = { kind = "crazyflie", start = [') for line in lines)
    assert sum(line.startswith("CF") for line in lines) == 100
    assert sum(line.startswith('"CF') for line in lines) == len(made.pairs)
    assert max(map(len, lines)) < 100
    heights = {robot.hover for robot in generated("hemisphere", "100").experiment.robots.values()}
    assert (min(heights), len(heights) > 90) == (pytest.approx(0.4), True)
    rates = [generated("polygon", count).experiment.rates.state_hz for count in ("100", "1000")]
    assert rates == [50.0, 5.0]


def test_starts_do_not_overlap_whatever_the_seed():
    plan = generated("hemisphere", "40").plan
    for seed in range(5):
        place, _ = bodies.scattered_poses(plan, tuple(plan.experiment.robots), seed)
        assert nearest_gap(place) > 2 * 0.065
        assert np.abs(np.subtract(place, plan.start_poses()[0])).max() > 0.1


@pytest.mark.parametrize(
    ("what", "size", "wanted", "said"),
    [
        ("hemisphere", "9", {"kind": "khepera4"}, "robots that fly"),
        ("polygon", "5", {"kind": "kehpera4"}, "khepera4"),
        ("polygon", "5", {"spacing": float("nan")}, "0.23 m or more, not nan"),
        ("polygon", "5", {"law": "bearing"}, "distance or displacement"),
        ("grid", "5xx", {}, "such as 5x8"),
        ("grid", "1x9", {}, "2x2 or more"),
        ("polygon", "2", {}, "3 robots or more"),
        ("hemisphere", "3", {}, "4 robots or more"),
    ],
)
def test_what_cannot_be_had(what, size, wanted, said):
    with pytest.raises(LayoutError, match=said):
        generated(what, size, **wanted)


def test_generate_writes_a_file_and_never_overwrites(tmp_path):
    target = tmp_path / "nine.toml"
    path, made = generate("polygon", "9", str(target), LayoutOptions())
    assert (path, len(made.pairs), (tmp_path / "zenpark.schema.json").exists()) == (target, 18, True)
    for place, said in ((target, "exists already"), (tmp_path / "no" / "where.toml", "cannot be written")):
        with pytest.raises(DocumentError, match=said):
            generate("polygon", "9", str(place), LayoutOptions())


def rigid(made):
    """With the heights held."""
    return rigidity(made.position, made.pairs, np.tile([True, True, False], (len(made), 1))).rigid


def lengths(made):
    return np.linalg.norm(made.position[made.pairs[:, 0]] - made.position[made.pairs[:, 1]], axis=1)


def nearest_gap(points):
    return min(math.dist(a, b) for a, b in combinations(np.asarray(points).tolist(), 2))


@pytest.mark.parametrize("count", [3, 4, 5, 12])
def test_polygons_are_regular_and_rigid(count):
    made = layouts.polygon(count, 0.6)
    assert rigid(made)
    assert nearest_gap(made.position) == pytest.approx(0.6)
    assert np.linalg.norm(made.position, axis=1) == pytest.approx(np.full(count, 0.3 / np.sin(np.pi / count)))
    assert len(made.pairs) == min(2 * count, count * (count - 1) // 2)


def test_grids_have_all_neighbours():
    made = layouts.grid(4, 3, 0.5)
    assert rigid(made)
    assert set(np.round(lengths(made), 6)) == {0.5, round(0.5 * np.sqrt(2.0), 6)}
    assert len(made.pairs) == 4 * 2 + 3 * 3 + 2 * 3 * 2
    assert made.position.mean(axis=0) == pytest.approx(np.zeros(3))


@pytest.mark.parametrize("count", [4, 12, 80])
def test_hemispheres_are_rigid_and_keep_their_distances(count):
    made = layouts.hemisphere(count, 0.6, 0.25)
    assert rigid(made)
    assert nearest_gap(made.position) >= 0.6 - 1e-9
    assert nearest_gap(made.position[:, :2]) >= 0.25 - 1e-9
    assert made.position[:, 2].min() == pytest.approx(layouts.LOWEST)
    assert lengths(made).max() < 2.1 * 0.6  # no link bridges a bay of the rim
