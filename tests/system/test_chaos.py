"""Faults and long runs in real processes."""

import csv
import json

import pytest

from tests.commands import python
from tests.system.lab import NEAR_TRIANGLE, options

pytestmark = pytest.mark.system


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param(["conductor"], marks=pytest.mark.mechanism("chaos")),
        ["router", "clock", "double", "conductor"],
        ["mocap-frozen"],
        ["sleep"],
    ],
)
def test_faults_are_made_and_recovered_from(tmp_path, kinds):
    folder = tmp_path / "chaos"
    of = ("--faults", len(kinds), "--seed", "1", "--kinds", ",".join(kinds), *NEAR_TRIANGLE, "duration_s=40")
    words = options("-m", "tests", "--chaos", "triangle", *of, "--json", "--out", folder)
    done = python(*words, code=None, timeout_s=150.0)
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert sorted(each["fault"]["kind"] for each in result["outcomes"]) == sorted(kinds), done.stderr
    assert all(each["recovered"] for each in result["outcomes"]), done.stderr
    assert not [each for each in result["outcomes"] if each["fault"]["kind"] == "double" and each["violations"]]
    assert not any("left behind" in text for each in result["rounds"] for text in each["violations"])
    assert json.loads((folder / "chaos.json").read_text()) == result


def test_a_fault_that_nobody_knows_is_refused(tmp_path):
    done = python("-m", "tests", "--chaos", "triangle", "--kinds", "kil", code=2)
    assert "--kinds kil: is not known" in done.stderr
    assert done.stderr.count("\n") <= 2


def test_three_robots_for_a_few_seconds(tmp_path):
    asked = ("triangle", "--minutes", "0.1", "--json", "--out", str(tmp_path / "soak"))
    done = python("-m", "tests", "--soak", *asked, code=None, timeout_s=120.0)
    assert done.stdout, done.stderr
    said = json.loads(done.stdout)
    texts = [finding["text"] for finding in said["findings"]]
    assert texts[0].startswith("all 3 robots lived"), texts
    assert any(text.startswith("0 of ") and text.endswith("poses were lost") for text in texts), texts
    with (tmp_path / "soak" / "soak.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["process"] for row in rows} == {"KH01", "KH02", "CF01", "router", "recorder", "conductor"}
    assert all(float(row["rss_mb"]) > 5.0 and int(row["threads"]) > 0 for row in rows)
