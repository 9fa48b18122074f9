"""What a sweep compares: whole runs of equal length, in one environment, made by the same code of the same file."""

import msgspec
import pytest

from experiments.definition.experiment import WorldTable
from experiments.definition.plan import Plan
from experiments.file import reference
from experiments.file.document import load
from experiments.metrics.metric import swept_metrics
from experiments.metrics.statistics import Spread
from experiments.recording import version
from experiments.sweep import table
from experiments.sweep.optimise import parse_objective
from experiments.sweep.page import fewest
from experiments.sweep.pareto import by_environment, front
from experiments.sweep.plan import arguments, cells
from experiments.sweep.runs import RunMetrics, WorkResult, code_of, digest, fly
from experiments.sweep.table import CellRow, relative_metrics


def _cells(*given):
    return cells(load("triangle"), "triangle", (), arguments(given)[0], ())


def _figures(seed=1, *, messages=100.0, duration_s=20.0):
    return RunMetrics(seed, dict.fromkeys(swept_metrics(), 1.0) | {"messages": messages}, 0.02, duration_s)


def _row(messages, iae, *, failed=0, **environment):
    ratio = {
        index: Spread({"messages": messages, "iae": iae}.get(index, 1.0), 0.0, 0.01, 9) for index in relative_metrics()
    }
    mean = {index: Spread(1.0, 0.0, 0.01, 9) for index in swept_metrics()}
    return CellRow("event", {**environment}, environment, {}, False, 9, failed, mean, ratio, 1.0, 0.02)


def test_run_in_which_robots_landed_has_failed():
    case = load("triangle", "duration_s=2.0", "safety.battery_low=0.999").cases()["periodic"].experiment
    found = msgspec.json.decode(fly(msgspec.json.encode(case), [1, 2], code_of(Plan(case))), type=WorkResult)
    assert found.runs == []
    assert all("battery" in found.failed[seed] for seed in (1, 2))


def test_runs_of_other_length_have_no_ratio():
    (first, other) = _cells("cases.event.trigger.threshold=0.01")
    whole, short = {1: _figures()}, {1: _figures(messages=20.0, duration_s=10.0)}
    assert table.row(other, short, whole).ratio["messages"] == Spread(None, None, None, 0)
    assert table.row(other, {1: _figures(messages=20.0)}, whole).ratio["messages"].mean == pytest.approx(0.2)
    assert first.digest == first.reference


def test_cell_with_failed_runs_is_on_no_front():
    landed, whole = _row(0.2, 0.5, failed=1), _row(0.4, 1.0)
    assert front([landed, whole]) == [whole]
    assert parse_objective("messages, iae<=1.01").rank(landed) > parse_objective("messages, iae<=1.01").rank(whole)
    (finding,) = fewest([landed, whole])
    assert "60.0 %" in finding.text


def test_fronts_are_per_environment():
    rows = [_row(0.2, 1.0, loss=0.0), _row(0.3, 1.1, loss=0.0), _row(0.25, 1.04, loss=0.1)]
    parts = by_environment(rows)
    assert [front(part) for part in parts.values()] == [rows[:1], rows[2:]]
    assert [finding.text.split(":")[0] for finding in fewest(rows)] == ["With loss=0", "With loss=0.1"]


def test_loss_is_environment_and_threshold_is_chosen():
    plan = _cells("trigger.threshold=0.005,0.02", "channel.loss=0,0.1", "cases.event.channel.delay_s=0.01,0.02")
    met = {frozenset(cell.environment) for cell in plan if cell.case == "event"}
    assert met == {frozenset(("channel.loss", "cases.event.channel.delay_s"))}
    assert {reference.unit(path) for path in ("trigger.threshold", "cases.event.trigger.threshold")} == {"m"}


def test_digest_knows_the_order_of_robots():
    case = load("triangle").cases()["periodic"].experiment
    turned = msgspec.structs.replace(case, robots=dict(reversed(case.robots.items())))
    assert digest(Plan(turned)) != digest(Plan(case))


def test_code_knows_the_engines_library(monkeypatch):
    case = msgspec.structs.replace(load("triangle").cases()["periodic"].experiment, world=WorldTable(engine="mujoco"))
    found = set()
    for number in ("4.0", "4.1"):
        monkeypatch.setattr(version, "installed", lambda name, number=number: number if name == "mujoco-core" else None)
        assert version.engine_versions("mujoco") == [f"mujoco-core {number}"]
        found.add(code_of(Plan(case)))
    assert len(found) == 2
    assert "mujoco-core" in version.LIBRARIES
