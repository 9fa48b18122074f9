"""The README's experiment, its law, its trigger and its error are what `check` says of them."""

import re
from math import hypot

import pytest

from experiments.check.check import check
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.run import simulate
from tests.commands import ROOT

TEXT = (ROOT / "README.md").read_text("utf-8")
(FILE,) = re.findall(r"^```toml\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)
(OWN,) = re.findall(r"^```python\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)


SETTINGS = re.findall(r"--set (\S*mine\.py:\S*)", TEXT)


@pytest.mark.parametrize("settings", [[], SETTINGS])
def test_example_has_no_finding(settings, tmp_path):
    (tmp_path / "mine.py").write_text(OWN, encoding="utf-8")
    path = tmp_path / "two.toml"
    path.write_text(FILE, encoding="utf-8")
    plan = load(str(path), *settings)
    assert not [finding for finding in check(plan) if finding.severity in {"error", "warning"}]


def test_error_is_shown_as_it_is(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(FILE.replace("threshold =", "treshold ="), encoding="utf-8")
    with pytest.raises(DocumentError) as failure:
        load(str(path))
    shown = re.search(r"^    (two\.toml:.*?)\n\n", TEXT, re.DOTALL | re.MULTILINE)
    assert str(failure.value).replace(str(tmp_path) + "/", "") in shown[1].replace("\n    ", "\n")


@pytest.mark.parametrize("apart", [0.1, 1.2])
def test_sign_of_an_error_does_not_count(apart, tmp_path):
    """Links that were too short had negative errors: their sum was small, and the formation acquired at once."""
    (tmp_path / "mine.py").write_text(OWN, encoding="utf-8")
    path = tmp_path / "two.toml"
    path.write_text(FILE, encoding="utf-8")
    still = 'formation.law={ kind = "mine.py:Spring", constant = 1e-6 }'
    places = f"robots.KH01.start=[-{apart}, 0.0]", "robots.KH02.start=[0.0, 0.5]"
    run = simulate(load(str(path), still, *places, "duration_s=2.0", "timeline=[]"), cases=["event"])
    robot = run.metrics["event"].robots[1]
    assert robot.acquired_s is None
    assert robot.iae == pytest.approx(2.0 * (abs(apart - 0.5) + abs(hypot(apart, 0.5) - 0.5)), rel=0.02)
