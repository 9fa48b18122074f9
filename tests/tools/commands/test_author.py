"""Commands of an author, as they are typed: `new` with a formation, `import`, and `check`."""

import re
import tomllib
from functools import partial

import pytest

from experiments.file import document
from tests.commands import invoke
from tests.experiments.robotic_park_files import dome


@pytest.fixture
def parsed_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return invoke


def test_formations(parsed_options):
    for words, file, robots in (
        ("--hemisphere 40", "hemisphere-40.toml", 40),
        ("--grid 2x3 --spacing 0.8", "grid-2x3.toml", 6),
        ("triangle", "triangle.toml", 3),
        ("--polygon 5 --kind khepera4 --scatter 0 --duration 12 mine.toml", "mine.toml", 5),
    ):
        assert f"zenpark check {file}" in parsed_options("new", *words.split()).output
        experiment = document.read(file).experiment
        assert len(experiment.robots) == robots
    assert (experiment.duration_s, experiment.start.scatter) == (12.0, 0.0)


def test_one_formation_at_a_time(parsed_options, tmp_path):
    for words, said in (
        ("", "--hemisphere 40"),
        ("--polygon 5 --grid 2x2", "--grid is too much"),
        ("--polygon 5 a.toml b.toml", "'b.toml' is too much"),
    ):
        assert said in parsed_options("new", *words.split(), code=2).output
    assert list(tmp_path.iterdir()) == []


def test_import(parsed_options, tmp_path):
    (tmp_path / "five.yaml").write_text(dome(5))
    assert "Not carried over" in parsed_options("import", "five.yaml", "--duration", "30").output
    assert document.read("five.toml").experiment.duration_s == 30.0


CONTRADICTION = """
title = "Contradiction"
duration_s = 5.0
[robots]
A = { kind = "khepera4", start = [0.0, 0.0] }
B = { kind = "khepera4", start = [0.8, 0.0] }
C = { kind = "khepera4", start = [0.8, 0.8] }
D = { kind = "khepera4", start = [0.0, 0.8] }
[formation.links]
"A - B" = 0.8
"B - C" = 0.8
"C - D" = 0.8
"A - D" = { distance = 0.8, gain = 2.0 }
"A - C" = 1.2
"B - D" = 1.2
"""


@pytest.fixture
def check(parsed_options, tmp_path):
    """`check`, in the folder of a file whose links contradict each other."""
    (tmp_path / "square.toml").write_text(CONTRADICTION)
    return partial(parsed_options, "check")


@pytest.mark.slow
def test_experiment_error_exits_1_and_malformed_file_2(check, tmp_path):
    (tmp_path / "wrong.toml").write_text("title = ")
    check("square.toml", code=1)
    check("wrong.toml", "--json", code=2)
    check("triangle", "--set", "duration_s=3", "--plot", "a.svg")
    assert (tmp_path / "a.svg").read_text().count("<path") > 20


@pytest.mark.slow
def test_fix_prints_links_that_fit_together(check, tmp_path):
    said = check("square.toml", "--fix", code=None).stdout
    links = said[said.index("[formation.links]") :]
    fixed = tomllib.loads(links)["formation"]["links"]
    assert set(fixed) == {"A - B", "B - C", "C - D", "A - D", "A - C", "B - D"}
    assert fixed["A - D"]["gain"] == 2.0
    assert fixed["A - C"] == pytest.approx(2**0.5 * fixed["A - B"], abs=2e-3)
    (tmp_path / "fixed.toml").write_text(CONTRADICTION[: CONTRADICTION.index("[formation.links]")] + links)
    assert float(re.search(r"distances met to +([0-9.]+) mm", check("fixed.toml").stdout)[1]) < 0.2
