"""Criteria of a file: what passes, what does not and why, over cases and seeds, in files and on the command line."""

import json

import pytest
from msgspec.structs import replace

from experiments.catalogue import index
from experiments.definition.experiment import JUDGED, Criterion
from experiments.file.document import loads, write_json
from experiments.metrics.criteria import document, has_passed, judge
from experiments.metrics.metric import OURS
from experiments.report.page import number
from experiments.report.tables import criteria_table
from experiments.report.verdict import criteria_met
from experiments.run import reopen, simulate, simulate_seeds
from tests.commands import invoke

FILE = index.find_file("triangle").read_text("utf-8")
SHORT = ("duration_s=4.0", "timeline=[]", "cases.periodic.trigger.period_s=0.1", "cases.event.trigger.threshold=0.05")
HALF = '[[criteria]]\nmetric = "f_hz"\ncase = "event"\nrelative_to = "periodic"\nat_most = 0.5\nwhy = "events save"\n'
TIGHT = '[[criteria]]\nmetric = "rmse"\nof = "worst"\nat_most = 0.001\nwhy = "nobody is that good"\n'


@pytest.fixture(scope="module")
def cases():
    return list(simulate(loads(FILE + HALF + TIGHT, *SHORT)).metrics.values())


def with_criteria(cases, *criteria):
    return [replace(case, criteria=criteria) for case in cases]


def answer(cases, **criterion):
    return [each.passed for each in judge(with_criteria(cases, Criterion(**criterion)))]


def test_each_criterion_is_judged_in_its_cases(cases):
    assert {*OURS} <= {*JUDGED}
    judged = [(each.case, each.passed) for each in judge(cases)]
    assert judged == [("event", True), ("periodic", False), ("event", False)]
    first, *missed, met = criteria_met(cases)
    assert (first.mark, first.text) == ("bad", "Not passed: 1 of 3 criteria are met.")
    assert all("nobody is that good" in each.text for each in missed)
    assert "event" in met.text
    table = criteria_table(cases)
    assert [row.cells[3] for row in table.rows] == ["1 of 1", "0 of 1", "0 of 1"]
    assert criteria_table(with_criteria(cases)).rows == ()
    found = document(judge(cases))
    assert found["passed"] is False
    assert found["criteria"][0]["metric"] == "f_hz"
    assert found["criteria"][0]["values"]["1"] < 0.5
    assert document([]) == {}


@pytest.mark.parametrize(
    ("criterion", "passed"),
    [
        ({"metric": "f_hz", "at_least": 9.0, "at_most": 11.0}, True),
        ({"metric": "f_hz", "at_most": 9.0}, False),
        ({"metric": "f_hz", "of": "KH02", "at_least": 9.0}, True),
        ({"metric": "collisions", "of": "worst", "at_most": 0.0}, True),
        ({"metric": "residual", "at_most": 1.0}, True),
        ({"metric": "j2", "of": "worst", "at_least": 0.1}, True),
        ({"measure": "spread", "at_most": 1.0}, False),
    ],
)
def test_numbers_that_can_be_judged(cases, criterion, passed):
    assert answer(cases, case="periodic", **criterion) == [passed]


def test_the_value_farthest_out_of_range_is_named(cases):
    found = [replace(case, seed=k, case="one") for k, case in enumerate(cases)]
    event, periodic = sorted(case.mean["f_hz"] for case in cases)
    middle = 0.5 * (event + periodic)
    for below, above, farthest in ((0.1, 0.2, event), (0.2, 0.1, periodic)):
        limits = Criterion(metric="f_hz", at_least=middle - below, at_most=middle + above)
        assert f"is {number(farthest)} for 2 of 2 seeds" in criteria_met(with_criteria(found, limits))[1].text


def test_what_was_not_run_is_not_judged(cases):
    event = cases[1:]
    assert answer(event, metric="f_hz", case="periodic", at_most=1.0) == [None]
    assert answer(event, metric="f_hz", case="event", relative_to="periodic", at_most=1.0) == [None]
    assert has_passed(judge(event)) is False
    assert has_passed(judge(with_criteria(event, cases[0].criteria[0]))) is None
    short = [replace(case, interrupted=True) for case in cases]
    assert answer(short, metric="f_hz", at_least=0.0) == [False, False]


def test_every_seed_must_pass():
    runs = simulate_seeds(loads(FILE, *SHORT), [1, 2, 3], cases=["event"])
    found = [case for run in runs for case in run.metrics.values()]
    middle = sorted(case.mean["rmse"] for case in found)[1]
    judged = with_criteria(found, Criterion(metric="rmse", at_most=middle))
    (only,) = judge(judged)
    assert (len(only.values), len(only.failed)) == (3, 1)
    assert "for 1 of 3 seeds" in criteria_met(judged)[1].text


def test_a_case_keeps_criteria_when_it_is_written():
    periodic, event = loads(FILE + HALF).cases().values()
    assert periodic.experiment.criteria == event.experiment.criteria
    assert b'"relative_to"' in write_json(event)


@pytest.mark.slow
@pytest.mark.parametrize(("limits", "code"), [(HALF, 0), (HALF + TIGHT, 1)])
def test_a_run_ends_by_its_criteria(limits, code, tmp_path):
    file, out = tmp_path / "task.toml", tmp_path / "run"
    file.write_text(FILE + limits, "utf-8")
    done = invoke("run", file, "--virtual", "--json", "--out", out, "--set", SHORT[0], "--set", SHORT[1], code=code)
    passed = code == 0
    assert json.loads(done.stdout)["passed"] is passed
    page = (out / "report.html").read_text("utf-8")
    assert ("Passed: 1 of 1 criteria are met." if passed else "nobody is that good") in page
    assert reopen(out).summary()["passed"] is passed
