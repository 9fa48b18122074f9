"""Figures of a run in a sweep: those of the report to the bit; and what outdates them."""

import msgspec
import numpy as np
import pytest

from experiments.definition.experiment import ChannelTable, Start, WorldTable
from experiments.definition.plan import Plan
from experiments.file import structure
from experiments.file.document import load
from experiments.metrics import measure
from experiments.sweep import runs
from experiments.sweep.runs import WorkResult, code_of, digest, fly, run_metrics
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate


@pytest.fixture(scope="module")
def park():
    return msgspec.structs.replace(load("robotic-park").cases()["event"].experiment, duration_s=6.0, timeline=[])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 8])
def test_lean_figures_are_those_of_the_report(park, seed):
    lean, whole = (
        RunRecorder(simulate(Plan(park), seed, lean=lean), Plan(park), "event").trace() for lean in (True, False)
    )
    figures, measured = run_metrics(lean), measure.measure(whole)
    assert figures == run_metrics(whole)
    assert figures.seed == seed
    for index in ("f_hz", "messages", "iae", "itae", "rmse", "acquired_s"):
        assert figures.values[index] == measured.mean[index], index
    assert figures.gap_min_s == min(robot.gap_min_s for robot in measured.robots if robot.gap_min_s is not None)
    assert figures.values["dropped"] == measured.dropped
    followers = [robot.updates for robot in measured.robots if robot.robot not in measured.leaders]
    assert figures.values["updates"] == np.mean(followers) == measured.mean["updates"]


@pytest.mark.slow
def test_lean_log_is_small(park):
    lean = simulate(Plan(park), 1, lean=True)
    assert lean.true_position.shape == (len(lean.time), 7, 3)
    for column in (lean.position, lean.velocity, lean.goal, lean.setpoint, lean.error, lean.phase):
        assert column.size == 0
    assert len(lean.received) == 0
    assert len(lean.sent) > 50


def flown(experiment, seeds):
    return msgspec.json.decode(fly(msgspec.json.encode(experiment), seeds, code_of(Plan(experiment))), type=WorkResult)


@pytest.mark.slow
def test_run_depends_on_its_seed_alone(park):
    lossy = msgspec.structs.replace(
        park, duration_s=2.0, channel=ChannelTable(delay_s=0.05, jitter_s=0.4, loss=0.2), start=Start(scatter=0.05)
    )
    seeds = list(range(1, 5))
    together = flown(lossy, seeds)
    assert [run.seed for run in together.runs] == seeds
    assert flown(lossy, [4, 2]).runs == [together.runs[3], together.runs[1]]
    assert sum(run.values["dropped"] for run in together.runs) > 0


@pytest.mark.slow
def test_stuck_run_leaves_the_others(park, monkeypatch):
    real = runs.simulate

    def fails_with_2(plan, seed, *, lean):
        if seed == 2:
            raise runs.Stuck("not airborne after 60 s: CF01")
        return real(plan, seed, lean=lean)

    monkeypatch.setattr(runs, "simulate", fails_with_2)
    short = msgspec.structs.replace(park, duration_s=1.0)
    outcome = flown(short, [1, 2, 3])
    assert [run.seed for run in outcome.runs] == [1, 3]
    assert outcome.failed == {2: "not airborne after 60 s: CF01"}


def test_work_for_other_code_is_refused(park):
    answer = msgspec.json.decode(fly(msgspec.json.encode(park), [1], "of another version"), type=WorkResult)
    assert answer.runs == []
    assert answer.stranger.endswith("not of another version")


def test_digest_ignores_what_does_not_change_a_run(park):
    same = msgspec.structs.replace(park, title="Another", source="", seed=99, cases={"a": {}})
    assert digest(Plan(same)) == digest(Plan(park))
    other = msgspec.structs.replace(park, duration_s=6.02)
    assert digest(Plan(other)) != digest(Plan(park))


def test_a_plug_in_that_changes_changes_the_code(park, tmp_path, monkeypatch):
    file = tmp_path / "my_triggers.py"
    file.write_text("one")
    before = code_of(Plan(park))
    real = structure.getfile
    monkeypatch.setattr(structure, "getfile", lambda of: str(file) if of.__name__ == "SendOnDelta" else real(of))
    foreign = code_of(Plan(park))
    runs.file_digest.cache_clear()
    file.write_text("two")
    assert len({before, foreign, code_of(Plan(park))}) == 3
    runs.file_digest.cache_clear()


def test_the_version_of_the_engines_library_counts(park, monkeypatch):
    """Runs of another pymunk or mujoco are other runs; of one that is not used they are the same."""
    real = runs.engine_versions
    pymunk = msgspec.structs.replace(park, world=WorldTable(engine="pymunk"))
    before = code_of(Plan(park)), code_of(Plan(pymunk))
    monkeypatch.setattr(runs, "engine_versions", lambda name: ["0.0"] if name == "pymunk" else real(name))
    assert code_of(Plan(park)) == before[0]
    assert code_of(Plan(pymunk)) != before[1]


def test_the_version_of_the_laws_library_counts(park, monkeypatch):
    formation = msgspec.structs.replace(park.formation, law="mpc")
    planned = msgspec.structs.replace(park, formation=formation)
    before = code_of(Plan(park)), code_of(Plan(planned))
    monkeypatch.setattr(runs, "engine_versions", lambda name: ["0.0"] if name == "daqp" else [])
    assert code_of(Plan(park)) == before[0]
    assert code_of(Plan(planned)) != before[1]
