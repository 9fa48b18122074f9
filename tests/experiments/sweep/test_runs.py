"""Figures of a run in a sweep: those of the report to the bit; and what outdates them."""

import ast
import shutil

import msgspec
import numpy as np
import pytest

from experiments import run
from experiments.definition.experiment import ChannelTable, Start, WorldTable
from experiments.definition.plan import Plan
from experiments.file import choices, document
from experiments.file.document import load
from experiments.metrics import measure
from experiments.metrics.metric import swept_metrics
from experiments.metrics.statistics import Spread
from experiments.recording import version
from experiments.sweep import runs, table
from experiments.sweep.plan import arguments, cells
from experiments.sweep.runs import (
    RunMetrics,
    WorkResult,
    code_of,
    digest,
    digest_of_code,
    fly,
    run_metrics,
    without_comments,
)
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate
from tests.commands import ROOT
from tests.small import changed, reference


@pytest.fixture(scope="module")
def short_park():
    return changed(reference(), duration_s=6.0, timeline=[])


@pytest.mark.slow
def test_lean_figures_are_those_of_the_report(short_park):
    logs = [simulate(Plan(short_park), 3, lean=lean) for lean in (True, False)]
    lean, whole = (RunRecorder(log, Plan(short_park), "event").trace() for log in logs)
    figures, measured = run_metrics(lean), measure.measure(whole)
    assert figures == run_metrics(whole)
    assert figures.seed == 3
    for index in ("f_hz", "messages", "iae", "itae", "rmse", "acquired_s", "updates"):
        assert figures.values[index] == measured.mean[index], index
    assert figures.gap_min_s == min(robot.gap_min_s for robot in measured.robots if robot.gap_min_s is not None)
    followers = [robot.updates for robot in measured.robots if robot.robot not in measured.leaders]
    assert (figures.values["dropped"], figures.values["updates"]) == (measured.dropped, np.mean(followers))
    log = logs[0]
    unused = ("position", "velocity", "goal", "setpoint", "error", "phase")
    assert [len(log.received), *(getattr(log, name).size for name in unused)] == [0] * 7
    assert (log.true_position.shape, len(log.sent) > 50) == ((len(log.time), 7, 3), True)


def result(experiment, seeds):
    return msgspec.json.decode(fly(msgspec.json.encode(experiment), seeds, code_of(Plan(experiment))), type=WorkResult)


@pytest.mark.slow
def test_run_depends_on_its_seed_alone(short_park):
    channel = ChannelTable(delay_s=0.05, jitter_s=0.4, loss=0.2)
    lossy = changed(short_park, duration_s=2.0, channel=channel, start=Start(scatter=0.05))
    together = result(lossy, [1, 2, 3, 4]).runs
    assert [run.seed for run in together] == [1, 2, 3, 4]
    assert result(lossy, [4, 2]).runs == [together[3], together[1]]
    assert sum(run.values["dropped"] for run in together) > 0


def test_run_in_which_robots_landed_has_failed():
    found = result(load("triangle", "duration_s=2.0", "safety.battery_low=0.999").plan.experiment, [1, 2])
    assert (found.runs, ["battery" in found.failed[seed] for seed in (1, 2)]) == ([], [True, True])


def test_runs_of_other_length_have_no_ratio():
    plan = cells(load("triangle"), "triangle", (), arguments(["cases.event.trigger.threshold=0.01"])[0], ())
    first, other = plan
    metrics, runs_of = dict.fromkeys(swept_metrics(), 1.0), ((100.0, 20.0), (20.0, 20.0), (20.0, 10.0))
    whole, few, short = ({1: RunMetrics(1, {**metrics, "messages": n}, 0.02, length)} for n, length in runs_of)
    assert table.row(other, short, whole).ratio["messages"] == Spread(None, None, None, 0)
    assert table.row(other, few, whole).ratio["messages"].mean == pytest.approx(0.2)
    assert first.digest == first.reference


@pytest.mark.parametrize(
    ("parts", "same"),
    [
        ({"title": "Another", "source": "", "seed": 99, "cases": {"a": {}}}, True),
        ({"duration_s": 6.02}, False),
        ({"robots": dict(reversed(reference().robots.items()))}, False),
    ],
)
def test_digest_knows_what_changes_a_run(short_park, parts, same):
    assert (digest(Plan(changed(short_park, **parts))) == digest(Plan(short_park))) is same


SPELLED = "arena.walls=true", "rates.pose_hz=50.0", "safety.neighbour_timeout_s=1.0", "formation.law.kind='distance'"


@pytest.mark.parametrize("change", SPELLED)
def test_digest_is_the_same_with_defaults_spelled_out(change):
    plan, spelled = load("triangle").plan, load("triangle", change).plan
    assert digest(spelled) == digest(plan)
    assert document.write_json(spelled) == document.write_json(plan) or "law" in change


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        (("trigger={kind='send-on-delta'}", "trigger={kind='send-on-delta', threshold=0.01}"), True),
        (("trigger={kind='send-on-delta', threshold=1}", "trigger={kind='send-on-delta', threshold=1.0}"), True),
        (("trigger={kind='send-on-delta', threshold=0.01}", "trigger={kind='send-on-delta', threshold=0.02}"), False),
        (("trigger='send-on-delta'", "trigger='periodic'"), False),
        (("arena.walls=true", "arena.walls=false"), False),
    ],
)
def test_digest_knows_parameters_of_plug_ins(changes, same):
    first, other = (digest(load("triangle", change).plan) for change in changes)
    assert (first == other) is same


@pytest.mark.parametrize(
    ("parts", "library"),
    [
        ({"world": WorldTable(engine="mujoco")}, "mujoco-core"),
        ({"formation": changed(reference().formation, law="mpc")}, "daqp"),
    ],
)
def test_versions_of_used_libraries_count(short_park, monkeypatch, parts, library):
    plans, found = (Plan(short_park), Plan(changed(short_park, **parts))), []
    for number in ("4.0", "4.1"):
        monkeypatch.setattr(version, "installed", lambda name, number=number: number if name == library else None)
        found.append([*map(code_of, plans)])
    assert [len({*codes}) for codes in zip(*found, strict=True)] == [1, 2]
    assert library in version.LIBRARIES


def test_workers_read_the_same_code():
    """A default that a file spells out, as the park its law, is no other code in a process that gets the case."""
    for plan in document.read("robotic-park").cases().values():
        assert code_of(Plan.decoded(document.write_json(plan))) == code_of(plan)


def test_a_plug_in_that_changes_changes_the_code(short_park, tmp_path, monkeypatch):
    file = tmp_path / "my_triggers.py"
    file.write_text("one")
    before = code_of(Plan(short_park))
    real = choices.getfile
    monkeypatch.setattr(choices, "getfile", lambda of: str(file) if of.__name__ == "SendOnDelta" else real(of))
    foreign = code_of(Plan(short_park))
    runs.file_digest.cache_clear()
    file.write_text("two")
    assert len({before, foreign, code_of(Plan(short_park))}) == 3
    runs.file_digest.cache_clear()


REPORT, LAW, COUNTS = "experiments/report/figures.py", "agents/plugins/laws.py", "experiments/metrics/signals.py"


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """A copy of all code of which sweeps and reports are made, and its digest."""
    root = tmp_path_factory.mktemp("code")
    for package in ("agents", "bridges", "twins", "experiments"):
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__"))
    root.with_suffix(".py").write_text("a file beside the code\n")
    return root, digest_of_code.__wrapped__(root)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "old", "new", "same"),
    [
        (REPORT, "WIDE: Final = 8.0", "WIDE: Final = 9.0", True),
        ("experiments/recording/writer.py", "return", "return  -", True),
        ("experiments/scene/stage.py", "return", "return  -", True),
        ("experiments/recording/trace.py", "return", "return  -", False),
        ("experiments/check/motion.py", "import", "import antigravity\nimport", True),
        (LAW, "from __future__", "# a remark\n\nfrom __future__", True),
        (LAW, "return", "return  -", False),
        (COUNTS, "return", "return  -", False),
        ("experiments/definition/formation.py", "return", "return  -", False),
        ("experiments/virtual_time/network.py", "return", "return  -", False),
        ("twins/body.py", "return", "return  -", False),
        ("bridges/tello/kind.py", "speed=1.0", "speed=1.1", False),
        ("bridges/tello/body.py", "return", "return  -", True),
    ],
)
def test_only_code_that_determines_results_counts(copied, file, old, new, same):
    root, before = copied
    text = (root / file).read_text()
    (root / file).write_text(text.replace(old, new, 1))
    after = digest_of_code.__wrapped__(root)
    (root / file).write_text(text)
    assert text.count(old)
    assert (after == before) is same


@pytest.mark.slow
def test_comments_are_all_that_is_left_out():
    for file in sorted((ROOT / "experiments").rglob("*.py"))[::3]:
        text = file.read_text("utf-8")
        assert ast.dump(ast.parse(without_comments(text))) == ast.dump(ast.parse(text)), file


@pytest.mark.slow
def test_seeds_of_several_processes_are_those_of_one(tmp_path):
    told, given = [], (load("triangle", "duration_s=1.0"), range(4, 7))
    alone = run.simulate_seeds(*given, cases=["event"])
    more = {"folder": tmp_path, "processes": 2, "progress": lambda *t: told.append(t)}
    shared = run.simulate_seeds(*given, cases=["event"], **more)
    assert ([file.name for file in tmp_path.iterdir()], told[-1]) == (["event.mcap"], ("event", 1, 1))
    for one, other in zip(alone, shared, strict=True):
        assert np.array_equal(one.traces["event"].true_position, other.traces["event"].true_position)
        assert repr(one.metrics["event"]) == repr(other.metrics["event"])
