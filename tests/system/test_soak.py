"""A short soak, with real processes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.system.lab import zenpark

pytestmark = pytest.mark.system


def test_three_robots_for_a_few_seconds(tmp_path: Path) -> None:
    asked = ("triangle", "--minutes", "0.1", "--json", "--out", str(tmp_path / "soak"))
    done = zenpark("--soak", *asked, timeout_s=120.0, module="tests")
    assert done.stdout, done.stderr
    said = json.loads(done.stdout)
    texts = [finding["text"] for finding in said["findings"]]
    assert texts[0].startswith("all 3 robots lived"), texts
    assert any(text.startswith("0 of ") and text.endswith("poses were lost") for text in texts), texts
    with (tmp_path / "soak" / "soak.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["process"] for row in rows} == {"KH01", "KH02", "CF01", "router", "recorder", "conductor"}
    assert all(float(row["rss_mb"]) > 5.0 and int(row["threads"]) > 0 for row in rows)
