import dataclasses

import numpy as np
import pytest

from experiments.authoring.generate import LayoutOptions, experiment_file, generate, layout
from experiments.authoring.layouts import LayoutError
from experiments.check.check import check, examine
from experiments.definition import bodies
from experiments.definition.formation import law_errors
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.virtual_time import simulation


def written(tmp_path, what, size, wanted=None):
    wanted = wanted or LayoutOptions()
    path = tmp_path / f"{what}.toml"
    path.write_text(experiment_file(layout(what, size, wanted), wanted))
    return document.read(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "size", "kind"),
    [
        ("polygon", "3", "khepera4"),
        pytest.param("polygon", "9", "crazyflie", marks=pytest.mark.nightly),
        pytest.param("grid", "3x4", "turtlebot3", marks=pytest.mark.nightly),
        ("hemisphere", "4", "crazyflie"),
        pytest.param("hemisphere", "40", "crazyflie", marks=pytest.mark.nightly),
        ("hemisphere", "12", "tello"),
    ],
)
def test_files_pass_the_check_without_a_word(tmp_path, what, size, kind):
    read = written(tmp_path, what, size, LayoutOptions(kind=kind))
    found, figures = examine(read)
    assert [each for each in found if each.severity != "note"] == []
    (numbers,) = figures.values()
    assert numbers.residual_mm < 0.3
    assert 0.3 < numbers.loop_gain < 1.1
    if (what, size) == ("hemisphere", "40"):  # nothing is needed
        assert numbers.vital_links == numbers.vital_robots == ()
        assert numbers.spare_robots == 40
    assert {robot.kind for robot in read.experiment.robots.values()} == {kind}


def test_every_robot_and_every_link_has_a_line(tmp_path):
    made = layout("hemisphere", "100", LayoutOptions())
    lines = experiment_file(made, LayoutOptions()).splitlines()
    assert 'CF001 = { kind = "crazyflie", start = [' in "\n".join(lines)
    assert sum(line.startswith("CF") for line in lines) == 100
    assert sum(line.startswith('"CF') for line in lines) == len(made.pairs)
    assert max(map(len, lines)) < 100
    read = written(tmp_path, "hemisphere", "100")
    heights = [robot.hover for robot in read.experiment.robots.values()]
    assert min(heights) == pytest.approx(0.4)
    assert len(set(heights)) > 90


def test_starts_do_not_overlap_whatever_the_seed(tmp_path):
    experiment = written(tmp_path, "hemisphere", "40").experiment
    names = tuple(experiment.robots)
    for seed in range(5):
        scattered, _ = bodies.scattered_poses(Plan(experiment), names, seed)
        place = np.array(scattered)
        apart = np.linalg.norm(place[:, None] - place[None], axis=2)[np.triu_indices(40, 1)]
        assert apart.min() > 2 * 0.065
        assert np.abs(place - np.array(Plan(experiment).start_poses()[0])).max() > 0.1


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [1, 2])
def test_hundred_drones_form_hemisphere_from_random_starts(tmp_path, seed):
    experiment = written(tmp_path, "hemisphere", "100", LayoutOptions(duration_s=25.0)).experiment
    log = simulation.simulate(Plan(experiment), seed)
    net = Plan(experiment).links
    apart = np.linalg.norm(log.true_position[:, net.receiver] - log.true_position[:, net.sender], axis=2)
    worst = np.abs(apart - net.distance).max(axis=1)
    running = (log.time >= 0.0) & (log.time <= 25.0)
    assert worst[running][0] > 0.25
    assert worst[running][-250:].max() < experiment.tolerance


@pytest.mark.slow
def test_offsets_are_met_from_anywhere(tmp_path):
    wanted = LayoutOptions(law="displacement", scatter=3.0, duration_s=30.0)
    read = written(tmp_path, "hemisphere", "20", wanted)
    assert [found for found in check(read) if found.severity != "note"] == []
    log = simulation.simulate(read.plan, 1)
    plan = read.plan
    begin, end = (log.true_position[np.searchsorted(log.time, at)] for at in (0.0, 29.9))
    links = plan.links
    assert law_errors(plan.law, begin, begin[links.sender], links).max() > 3.0
    assert (
        law_errors(plan.law, end, end[plan.links.sender], plan.links).max() < 0.07
    )  # three times the threshold at which robots speak


@pytest.mark.slow
def test_large_formations_say_less_of_themselves(tmp_path):
    assert written(tmp_path, "polygon", "100").experiment.rates.state_hz == 50.0
    large = written(tmp_path, "polygon", "1000").experiment
    assert large.rates.state_hz == 5.0
    assert len(large.robots) == 1000


@pytest.mark.parametrize(
    ("what", "size", "wanted", "said"),
    [
        ("hemisphere", "9", {"kind": "khepera4"}, "robots that fly"),
        ("polygon", "5", {"kind": "kehpera4"}, "khepera4"),
        ("polygon", "5", {"spacing": 0.1}, "0.23 m or more"),
        ("polygon", "5", {"law": "bearing"}, "distance or displacement"),
        ("grid", "5", {}, "such as 5x8"),
        ("grid", "5xx", {}, "such as 5x8"),
    ],
)
def test_what_cannot_be_had(what, size, wanted, said):
    chosen = dataclasses.replace(LayoutOptions(), **wanted)
    with pytest.raises(LayoutError, match=said):
        experiment_file(layout(what, size, chosen), chosen)


def test_generate_writes_a_file_and_never_overwrites(tmp_path):
    target = tmp_path / "nine.toml"
    path, made = generate("polygon", "9", str(target), LayoutOptions())
    assert (path, len(made.pairs)) == (target, 18)
    assert (tmp_path / "zenpark.schema.json").exists()
    with pytest.raises(DocumentError, match="exists already"):
        generate("polygon", "9", str(target), LayoutOptions())
    with pytest.raises(DocumentError, match="cannot be written"):
        generate("polygon", "9", str(tmp_path / "no" / "where.toml"), LayoutOptions())
