"""Search for parameters: objectives, their limits, and seeds that the search never saw."""

import pytest

from experiments.file.problems import DocumentError
from experiments.sweep.optimise import BROKEN, Limit, Objective, parse_objective, tune
from experiments.sweep.page import fewest
from experiments.sweep.pareto import by_environment, front
from tests.experiments.sweep.cells import cell
from tools.commands import sweep as commands


def test_an_objective_has_limits():
    objective = parse_objective("messages, iae<=1.01 ,ITAE < 1.05, acquired<=12")
    assert objective == Objective("messages", (Limit("iae", 1.01), Limit("itae", 1.05), Limit("acquired_s", 12.0)))
    assert [str(limit) for limit in objective.limits] == ["IAE ratio <= 1.01", "ITAE ratio <= 1.05", "acquired_s <= 12"]


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("", "what is to be least", "messages, iae<=1.01"),
        ("messages", "without a limit", "iae<=1.01"),
        ("messages, iea<=1.01", "no metric is called 'iea'", "'iae'?"),
        ("mesages, iae<=1.01", "no metric is called 'mesages'", "'messages'?"),
        ("messages, iae>=1.01", "'iae>=1.01' is no limit", "iae<=1.01"),
        ("messages, iae<=", "'iae<=' is no limit", "iae<=1.01"),
    ],
)
def test_what_is_wrong_with_an_objective(text, message, hint):
    with pytest.raises(DocumentError) as caught:
        parse_objective(text)
    (problem,) = caught.value.problems
    assert problem.file == f'--optimise "{text}"'
    assert message in problem.message
    assert hint in problem.hint


def test_limits_precede_messages_and_count_with_their_interval():
    objective = parse_objective("messages, iae<=1.05")
    assert objective.rank(cell(messages=0.2, iae=1.03)) == 0.2
    assert objective.rank(cell(messages=0.1, iae=1.045)) > BROKEN  # 1.045 ± 0.01
    assert objective.rank(cell(iae=1.2)) > objective.rank(cell(iae=1.1)) > BROKEN
    assert [objective.kept(cell(iae=iae)) for iae in (1.045, 1.06)] == [True, False]


def test_fronts_are_per_environment_and_of_whole_cells():
    landed, whole = cell(messages=0.2, iae=0.5, failed=1), cell(messages=0.4)
    assert front([landed, whole]) == [whole]
    objective = parse_objective("messages, iae<=1.01")
    assert objective.rank(landed) > objective.rank(whole)
    (finding,) = fewest([landed, whole])
    assert "60.0 %" in finding.text
    (finding,) = fewest([cell(iae=1.2), cell(iae=2.2)])
    assert finding.text.startswith("No cell has an IAE ratio of at most 1.05; the nearest: ")
    tied = cell(messages=0.4)
    assert front([whole, tied]) == [whole, tied]
    given = [(0.2, 1.0, 0.0), (0.3, 1.1, 0.0), (0.25, 1.04, 0.1)]
    rows = [cell(messages=messages, iae=iae, environment={"loss": loss}) for messages, iae, loss in given]
    parts = by_environment(rows)
    assert [front(part) for part in parts.values()] == [rows[:1], rows[2:]]
    assert [finding.text.split(":")[0] for finding in fewest(rows)] == ["With loss=0", "With loss=0.1"]


@pytest.mark.nightly
def test_search_finds_fewest_messages_within_the_limit(tmp_path, capsys):
    pytest.importorskip("cma")
    given, limits = ["trigger.threshold=0.002:0.1:log", "seeds=6", "tuning=101:118"], "messages, iae<=1.02"
    options = {"settings": ["duration_s=4.0"], "out": str(tmp_path), "processes": 1}
    found = tune("triangle", given, limits, **options)
    reference, best = found.rows
    assert (reference.case, reference.reference, best.case, best.seeds) == ("periodic", True, "event", 6)
    assert found.objective.kept(best)
    assert best.ratio["messages"].mean < 0.3
    assert best.parameters == found.chosen[0].parameters
    assert found.chosen[0].seeds == 12
    assert {each.seeds for each in found.tried} == {6}
    assert not set(found.tuning) & set(found.seeds)
    assert len([each for each in found.tried if found.objective.rank(each) < BROKEN]) >= 3
    again = tune("triangle", given, limits, **options)
    assert (again.rows, again.tried) == (found.rows, found.tried)
    assert commands.sweep("triangle", given, **options, optimise=limits) == 0
    said = capsys.readouterr().out
    assert said.startswith("tuned on seeds 101 to 118, reported on seeds 1 to 6\n")
    assert f"{best.label}: keeps IAE ratio <= 1.02" in said
    assert len((tmp_path / "tried.csv").read_text().splitlines()) == 1 + len(found.tried)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["trigger.threshold=0.01:0.02:log", "tuning=1:30"], "seed 1 is to be tuned and reported on"),
        (["trigger.threshold=0.01:0.02:log", "tuning=101:103"], "3 seeds are too few to tune on"),
        (["trigger.threshold=0.01,0.02"], "the search needs a range"),
        (["trigger.period_s=0.02:0.1:log"], "no case that is looked at has it"),
    ],
)
def test_what_cannot_be_tuned(tmp_path, given, message):
    with pytest.raises(DocumentError, match=message):
        tune("triangle", given, "messages, iae<=1.02", out=tmp_path)
