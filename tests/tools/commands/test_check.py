"""`./zenpark check`: exit codes, the nearest links that fit together, and a picture."""

import re
import tomllib

import pytest
from typer.testing import CliRunner

from tools.main import app

FILE = """
title = "Contradiction"
duration_s = 5.0
[robots.A]
kind = "khepera4"
start = [0.0, 0.0]
[robots.B]
kind = "khepera4"
start = [0.8, 0.0]
[robots.C]
kind = "khepera4"
start = [0.8, 0.8]
[robots.D]
kind = "khepera4"
start = [0.0, 0.8]
[formation.links]
"A - B" = 0.8
"B - C" = 0.8
"C - D" = 0.8
"A - D" = { distance = 0.8, gain = 2.0 }
"A - C" = 1.2
"B - D" = 1.2
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "square.toml"
    path.write_text(FILE)
    return path


def check(*words):
    return CliRunner().invoke(app, ["check", *map(str, words)])


@pytest.mark.slow
def test_experiment_error_exits_1_and_malformed_file_2(file, tmp_path):
    assert check(file).exit_code == 1
    (tmp_path / "wrong.toml").write_text("title = ")
    wrong = check(tmp_path / "wrong.toml", "--json")
    assert wrong.exit_code == 2
    assert check("triangle", "--set", "duration_s=3").exit_code == 0


@pytest.mark.slow
def test_fix_prints_links_that_fit_together(file, tmp_path):
    said = check(file, "--fix")
    fixed = tomllib.loads(said.stdout[said.stdout.index("[formation.links]") :])["formation"]["links"]
    assert set(fixed) == {"A - B", "B - C", "C - D", "A - D", "A - C", "B - D"}
    assert fixed["A - D"]["gain"] == 2.0
    assert fixed["A - C"] == pytest.approx(2**0.5 * fixed["A - B"], abs=2e-3)
    body = FILE[: FILE.index("[formation.links]")]
    (tmp_path / "fixed.toml").write_text(body + said.stdout[said.stdout.index("[formation.links]") :])
    again = check(tmp_path / "fixed.toml")
    assert again.exit_code == 0
    assert float(re.search(r"distances met to +([0-9.]+) mm", again.stdout)[1]) < 0.2


@pytest.mark.slow
def test_plot_draws_and_refuses_other_names(file):
    assert check("triangle", "--set", "duration_s=3", "--plot", file.parent / "a.svg").exit_code == 0
    drawing = (file.parent / "a.svg").read_text()
    assert drawing.count("<path") > 20
    refused = check("triangle", "--plot", file.parent / "a.xyz")
    assert refused.exit_code == 2
    assert ".svg, .pdf or .png" in refused.output
