"""Axes and seeds as they are written, the cells that they span, and what is said of those that cannot be."""

from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.file import document, reference
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.metrics.metric import swept_metrics
from experiments.metrics.statistics import Spread
from experiments.sweep.optimise import BROKEN, Limit, Objective, parse_objective, tune
from experiments.sweep.page import fewest
from experiments.sweep.pareto import by_environment, front
from experiments.sweep.plan import Span, arguments, cells, seeds_of
from experiments.sweep.table import CellRow, relative_metrics
from tools.commands import sweep as commands

HEAVY = """
from typing import Annotated
import msgspec
from zenpark import Law

class Heavy(Law):
    gain: float = 1.0
    inertia: Annotated[float, msgspec.Meta(description="m [kg]")] = 1.0

    def step(self, view, memory): ...
"""


@pytest.fixture(scope="module")
def triangle_document():
    return load("triangle")


def planned(read, *axes, cases=(), settings=()):
    return cells(read, str(read.path), settings, arguments(axes)[0], cases)


def test_ranges_have_both_ends():
    axes, words = arguments(["formation.gain=2:4:lin5", 'trigger.kind="a,b",[1, 2],3', "seeds=7"])
    wanted = [("2", "2.5", "3", "3.5", "4"), ('"a,b"', "[1, 2]", "3")]
    assert ([axis.values for axis in axes], words) == (wanted, {"seeds": "seeds=7"})
    (axis,), _ = arguments(["trigger.threshold=0.002:0.05:log12"])
    values = [float(value) for value in axis.values]
    assert (values[0], values[-1]) == (0.002, 0.05)
    assert [b / a for a, b in pairwise(values)] == pytest.approx([25 ** (1 / 11)] * 11, rel=1e-3)


@given(st.floats(1e-6, 1e3), st.floats(1.01, 1e3), st.floats(0.0, 1.0), st.sampled_from(["log", "lin"]))
def test_a_value_of_a_range_lies_within_it(low, factor, share, scale):
    span = Span(low, low * factor, scale, whole=False)
    assert low <= float(span.at(share)) <= low * factor
    assert float(span.at(share)) == pytest.approx(
        low * factor**share if scale == "log" else low + share * (factor - 1) * low, rel=1e-3
    )


def test_a_case_without_the_parameter_is_one_cell(triangle_document):
    plan = planned(triangle_document, "trigger.threshold=0.01,0.02,0.04")
    event = [("event", {"trigger.threshold": value}) for value in (0.01, 0.02, 0.04)]
    assert [(cell.case, dict(cell.parameters)) for cell in plan] == [("periodic", {}), *event]
    assert {cell.reference for cell in plan} == {plan[0].digest}
    assert plan[2].plan.experiment.trigger == {"kind": "send-on-delta", "threshold": 0.02}


def test_value_of_one_case_and_a_chosen_case(triangle_document):
    plan = planned(triangle_document, "cases.event.trigger.threshold=0.01,0.02", cases=["event"])
    assert [cell.case for cell in plan] == ["periodic", "event", "event"]
    assert planned(triangle_document, "trigger.threshold=0.01,0.02", cases=["periodic"])[0].parameters == {}
    path = "cases.periodic.trigger.period_s"
    plan = planned(triangle_document, f"{path}=0.02,0.1", cases=["event"])
    assert [cell.parameters.get(path) for cell in plan] == [0.02, 0.1, None]


def test_loss_is_environment_and_threshold_is_chosen(triangle_document):
    delay = "cases.event.channel.delay_s=0.01,0.02"
    plan = planned(triangle_document, "trigger.threshold=0.005,0.02", "channel.loss=0,0.1", delay)
    met = {frozenset(cell.environment) for cell in plan if cell.case == "event"}
    assert met == {frozenset(("channel.loss", "cases.event.channel.delay_s"))}


@pytest.mark.parametrize(
    ("fixed", "axis", "swept"),
    [
        ('trigger={ kind = "send-on-delta", threshold = 0.03 }', "trigger.threshold=0.01,0.02", [{}]),
        ("channel.loss=0.3", "channel.loss=0.1,0.2", [{"channel.loss": 0.1}, {"channel.loss": 0.2}]),
        ("robots.KH01.start=[0.1,0.1]", "robots.KH01.start=[0.0,0.0]", [{"robots.KH01.start": [0.0, 0.0]}]),
    ],
)
def test_set_of_a_case_is_not_swept(fixed, axis, swept):
    fixed = f"cases.event.{fixed}"
    plan = planned(load("triangle", fixed), axis, cases=["event"], settings=[fixed])
    assert [dict(cell.parameters) for cell in plan] == [*swept, {}]


def test_parameter_has_the_unit_of_its_plugin(tmp_path, triangle_document):
    event = triangle_document.cases()["event"].experiment
    assert [reference.unit(f"{case}trigger.threshold", event) for case in ("", "cases.event.")] == ["m", "m"]
    assert [reference.unit(path, event) for path in ("channel.delay_s", "channel.loss")] == ["s", ""]
    relative = msgspec.structs.replace(event, trigger={"kind": "relative", "share": 0.1})
    assert reference.unit("trigger.share", relative) == ""
    (tmp_path / "heavy.py").write_text(HEAVY)
    (tmp_path / "triangle.toml").write_bytes(triangle_document.path.read_bytes())
    law = 'formation.law={ kind = "heavy.py:Heavy", gain = 1.0, inertia = 2.0 }'
    heavy = document.read(tmp_path / "triangle.toml", [law]).cases()["event"].experiment
    assert [reference.unit(f"formation.law.{key}", heavy) for key in ("gain", "inertia")] == ["", "kg"]


def test_trigger_of_the_reference_stays_as_written(triangle_document):
    """Also what the file leaves at its default is swept; the first case becomes one of those that are compared."""
    plan = planned(triangle_document, "trigger.minimum_interval_s=0.05,0.1", "formation.gain=2,3")
    first = [cell for cell in plan if cell.digest == cell.reference]
    assert [dict(cell.parameters) for cell in first] == [{"formation.gain": 2}, {"formation.gain": 3}]
    written = triangle_document.cases()["periodic"].experiment.trigger
    assert all(cell.plan.experiment.trigger == written for cell in first)
    swept = [[*cell.parameters.values()] for cell in plan if cell.case == "periodic" and cell not in first]
    assert swept == [[0.05, 2], [0.05, 3], [0.1, 2], [0.1, 3]]
    assert len(plan) == 2 + 4 + 4
    gain = {cell.digest: cell.parameters["formation.gain"] for cell in first}
    assert all(gain[cell.reference] == cell.parameters["formation.gain"] for cell in plan)


@pytest.mark.parametrize(
    ("argument", "message", "hint"),
    [
        ("trigger.treshold=1,2", "no trigger of this experiment has a parameter 'treshold'", "'threshold'?"),
        ("formaton.gain=1,2", "unknown key 'formaton'", "'formation'?"),
        ("robots.CF9.hover=0.7", "no robot is called 'CF9'", "CF01"),
        ("cases.evnt.trigger.threshold=1", "the file has no case 'evnt'", "'event'?"),
        ("trigger.threshold=-1,2", "at -1: 'threshold' must be a number > 0", "[m]"),
        ("trigger.threshold=1:2", "is no range", "0.002:0.05:log12"),
        ("trigger.threshold=0.1:0.2:quad4", "is no range", "0.002:0.05:log12"),
        ("trigger.threshold=a:b:log3", "are no two numbers", "0.002:0.05:log12"),
        ("trigger.threshold=2:1:lin3", "is no range", "the lower end comes first"),
        ("trigger.threshold=0:1:log3", "cannot reach zero", "write lin"),
        ("trigger.threshold=1e-3:1:log99999999999", "make no range", "give 2 to"),
        ("trigger.threshold=", "there is no value in it", "0.002:0.05:log12"),
        ("trigger.threshold=1,,2", "a value is missing", "0.002:0.05:log12"),
        ("trigger.threshold=1,2,1", "given twice", "each once"),
        ("trigger.threshold", "not of the form", "PATH="),
        ("trigger.\x07=1", "no text", "leave them out"),
    ],
)
def test_what_is_wrong_with_an_axis(triangle_document, argument, message, hint):
    assert_wrong(lambda: planned(triangle_document, argument), argument, message, hint)


def assert_wrong(act, file, message, hint):
    """It is refused, with one problem, and words of its message and of its remedy."""
    with pytest.raises(DocumentError) as caught:
        act()
    (problem,) = caught.value.problems
    assert problem.file == file
    assert message in problem.message
    assert hint in problem.hint


@pytest.mark.parametrize("text", ["", "x", "0", "5:3", "-1", "1:2:3", "4294967290:4294967300", "1:999999"])
def test_what_is_wrong_with_seeds(text):
    given = ("seeds=3", "seeds=101:103", None)
    assert [seeds_of(right, 5) for right in given] == [(5, 6, 7), (101, 102, 103), tuple(range(5, 25))]
    with pytest.raises(DocumentError, match="seeds="):
        seeds_of(f"seeds={text}", 1)


def test_too_many_cells_and_the_same_axis_twice(triangle_document):
    many = ["formation.gain=1:2:lin200", "formation.clamp=0.1:0.2:lin200"]
    with pytest.raises(DocumentError, match="40000 combinations"):
        planned(triangle_document, *many)
    with pytest.raises(DocumentError, match=r"'formation\.gain' is given twice"):
        arguments(["formation.gain=1", "formation.gain=2"])


def test_file_without_cases_has_nothing_to_compare(tmp_path, triangle_document):
    file = tmp_path / "alone.toml"
    file.write_text(triangle_document.text.partition("[cases.")[0])
    with pytest.raises(DocumentError, match=r"no case in it to compare with\n.*\[cases.periodic\]"):
        planned(load(file), "formation.gain=1,2")


def cell(*, failed=0, environment=None, **ratios):
    """Cell of the case `event` with nine seeds; metrics that are not given are as in the reference."""
    place, names = environment or {}, {*relative_metrics(), *ratios}
    ratio = {name: Spread(ratios.get(name, 1.0), 0.0, 0.01, 9) for name in names}
    mean = dict.fromkeys(swept_metrics(), Spread(1.0, 0.0, 0.01, 9))
    return CellRow("event", place, place, {}, False, 9, failed, mean, ratio, 1.0, 0.02)


def test_an_objective_has_limits():
    objective = parse_objective("messages, iae<=1.01 ,ITAE < 1.05, acquired<=12")
    assert objective == Objective("messages", (Limit("iae", 1.01), Limit("itae", 1.05), Limit("acquired_s", 12.0)))
    assert objective.limits_in_words("; ") == "IAE ratio <= 1.01; ITAE ratio <= 1.05; acquired_s <= 12"


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
    assert_wrong(lambda: parse_objective(text), f'--optimise "{text}"', message, hint)


def test_limits_precede_messages_and_count_with_their_interval():
    objective = parse_objective("messages, iae<=1.05")
    assert objective.rank(cell(messages=0.2, iae=1.03)) == 0.2
    assert objective.rank(cell(messages=0.1, iae=1.045)) > BROKEN  # 1.045 ± 0.01
    assert objective.rank(cell(iae=1.2)) > objective.rank(cell(iae=1.1)) > BROKEN
    assert [objective.kept(cell(iae=iae)) for iae in (1.045, 1.06)] == [True, False]


def test_fronts_are_per_environment_and_of_whole_cells():
    landed, whole, tied = cell(messages=0.2, iae=0.5, failed=1), cell(messages=0.4), cell(messages=0.4)
    assert [front(each) for each in ([landed, whole], [whole, tied])] == [[whole], [whole, tied]]
    objective = parse_objective("messages, iae<=1.01")
    assert objective.rank(landed) > objective.rank(whole)
    nearest = "No cell has an IAE ratio of at most 1.05; the nearest: "
    for rows, says in (([landed, whole], "60.0 %"), ([cell(iae=1.2), cell(iae=2.2)], nearest)):
        (finding,) = fewest(rows, swept_metrics())
        assert says in finding.text
    given = [(0.2, 1.0, 0.0), (0.3, 1.1, 0.0), (0.25, 1.04, 0.1)]
    rows = [cell(messages=messages, iae=iae, environment={"loss": loss}) for messages, iae, loss in given]
    parts = by_environment(rows)
    assert [front(part) for part in parts.values()] == [rows[:1], rows[2:]]
    assert [finding.text.split(":")[0] for finding in fewest(rows, swept_metrics())] == ["With loss=0", "With loss=0.1"]


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
    chosen = found.chosen[0]
    assert (chosen.parameters, chosen.seeds, {each.seeds for each in found.tried}) == (best.parameters, 12, {6})
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
