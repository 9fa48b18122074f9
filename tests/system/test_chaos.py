"""The fault laboratory on a small experiment, with real processes."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.system.lab import NEAR_TRIANGLE, zenpark

pytestmark = pytest.mark.system


def chaos(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return zenpark("--chaos", *arguments, "--out", folder, timeout_s=150.0, module="tests")


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param(["conductor"], marks=pytest.mark.mechanism("chaos")),
        ["router", "clock", "double", "conductor"],
        ["mocap-frozen"],
        ["sleep"],
    ],
)
def test_faults_are_made_and_recovered_from(tmp_path: Path, kinds: list[str]) -> None:
    folder = tmp_path / "chaos"
    faults = str(len(kinds))
    of = ("--faults", faults, "--seed", "1", "--kinds", ",".join(kinds), *NEAR_TRIANGLE, "--set", "duration_s=40")
    done = chaos(folder, "triangle", *of, "--json")
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert sorted(each["fault"]["kind"] for each in result["outcomes"]) == sorted(kinds), done.stderr
    assert all(each["recovered"] for each in result["outcomes"]), done.stderr
    assert not [each for each in result["outcomes"] if each["fault"]["kind"] == "double" and each["violations"]]
    assert not any("left behind" in text for each in result["rounds"] for text in each["violations"])
    assert json.loads((folder / "chaos.json").read_text()) == result


def test_a_fault_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    done = chaos(tmp_path / "chaos", "triangle", "--kinds", "kil")
    assert done.returncode == 2
    assert "--kinds kil: is not known" in done.stderr
    assert done.stderr.count("\n") <= 2
