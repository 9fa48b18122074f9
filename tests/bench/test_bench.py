"""The parts of the benchmarks that are no timings: the law, the dialogue with a simulator, the tables, processes."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from docs.bench import __main__ as renewal
from docs.bench import growth, peers
from docs.bench.drivers import ring
from tests.bench.process import Meter
from tests.reliability.soak import usage_of


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))


def test_law_closes_the_ring():
    place, position = ring.places(7), ring.starts(7)
    assert np.linalg.norm(place - np.roll(place, 1, axis=0), axis=1) == pytest.approx([ring.SPACING] * 7)
    before = ring.link_error(position)
    for _ in range(500):
        position = position + ring.STEP_S * ring.velocities(position, place)
    assert ring.link_error(position) < 0.01 * before


def test_wheels_move_the_point_ahead():
    velocity, yaw = np.array([[0.1, -0.2]]), np.array([0.7])
    speed, rate = ring.wheels(velocity, yaw)
    ahead = np.array([np.cos(0.7), np.sin(0.7)])
    aside = np.array([-np.sin(0.7), np.cos(0.7)])
    assert speed * ahead + 0.05 * rate * aside == pytest.approx(velocity[0])


def test_zenpark_counts_its_agent_steps():
    found = peers.measured(peers.WHEELS, 3, "2", "loop")
    assert found["agent_steps"] == 3 * 50 * 2
    assert found["cpu_s"] > 0.0


def test_ended_process_gives_its_last_words(monkeypatch):
    monkeypatch.setattr(peers, "DRIVERS", "docs.bench.missing")
    with pytest.raises(peers.Failed, match=r"7 robots: .*docs\.bench\.missing"):
        peers.measured(peers.WHEELS, 7, "10", "loop")


def test_table_gives_ratios_to_zenpark():
    own = peers.Row(7, peers.WHEELS, "", 0.02, 20_000.0, {})
    other = peers.Row(7, "irsim", "2.12.0", 0.02, 8_123.0, {peers.WHEELS: 0.406})
    lines = peers.table([own, other]).splitlines()
    assert lines[2] == "| 7 | zenpark, khepera4 point-mass plain | 20 | 20,000 |  |"
    assert lines[3] == "| 7 | irsim 2.12.0 | 20 | 8,100 | 0.41 × khepera4 point-mass plain |"


@pytest.mark.nightly
def test_growth_has_a_line_for_each_number(monkeypatch):
    monkeypatch.setitem(growth.DURATIONS, 7, 20.0)
    lines = growth.report(sizes=(3, 5), rounds=1, settings=[peers.WHEELS]).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| 3", "| 5"]


def test_page_has_places_for_the_tables():
    page = renewal.PAGE.read_text("utf-8")
    names = ("circumstances", "peers", "growth")
    again = renewal.renewed(page, {name: f"new {name}" for name in names})
    assert all(f"<!-- {name} -->\n\nnew {name}\n\n<!-- end -->" in again for name in names)
    with pytest.raises(ValueError, match="no place"):
        renewal.renewed(page, {"other": ""})


def test_what_another_process_spends_is_read_exactly():
    before = usage_of(os.getpid())
    begun = time.process_time()
    while time.process_time() < begun + 0.05:
        pass
    after = usage_of(os.getpid())
    assert before is not None
    assert after is not None
    assert 0.05 <= after.cpu_s - before.cpu_s <= time.process_time() - begun + 0.01
    assert after.rss_mb > 1.0


def test_a_process_that_has_ended_is_left_out():
    over = subprocess.Popen([sys.executable, "-c", "pass"])
    over.wait()
    meter = Meter()
    for _ in range(2):
        meter.measure({"CF01": os.getpid(), "CF02": over.pid})
    assert set(meter.shares()) == {"CF01"}
