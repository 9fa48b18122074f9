"""Criteria, and a law and metrics in files beside the experiment, in a run in real time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from experiments.run import reopen
from tests.system.lab import ROOT, Flight

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]

COURSE = ROOT / "docs" / "course"
LAW = "formation.law=solutions/01_rendezvous.py:Meet"


@pytest.mark.parametrize(("changes", "passed"), [((), False), ((LAW, "criteria.0.at_most=0.6"), True)])
def test_a_run_in_real_time_is_judged(changes: tuple[str, ...], passed: bool, tmp_path: Path) -> None:
    file, out = str(COURSE / "01-rendezvous.toml"), tmp_path / "run"
    flight = Flight(out, file, *changes, "duration_s=6", "--json", report=True)
    code, text = flight.finish(120.0)
    found = json.loads(text)
    assert found["passed"] is passed, flight.said()
    assert code == (0 if passed else 1), flight.said()
    assert ("Passed: 2 of 2" if passed else "The robots are to meet") in (out / "report.html").read_text("utf-8")
    assert (out / "measures.py").is_file()
    assert (out / LAW.partition("=")[2].partition(":")[0]).is_file() is passed
    assert reopen(out).summary()["passed"] is passed
