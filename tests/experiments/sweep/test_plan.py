"""Axes and seeds as they are written, the cells that they span, and what is said of those that cannot be."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.file import reference
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.sweep.plan import Span, arguments, cells, seeds_of


@pytest.fixture(scope="module")
def triangle_document():
    return load("triangle")


def planned(read, *axes, cases=(), settings=()):
    return cells(read, str(read.path), settings, arguments(axes)[0], cases)


def test_ranges_have_both_ends():
    axes, words = arguments(["formation.gain=2:4:lin5", 'trigger.kind="a,b",[1, 2],3', "seeds=7"])
    assert axes[0].values == ("2", "2.5", "3", "3.5", "4")
    assert axes[1].values == ('"a,b"', "[1, 2]", "3")
    assert words == {"seeds": "seeds=7"}
    (axis,), _ = arguments(["trigger.threshold=0.002:0.05:log12"])
    values = [float(value) for value in axis.values]
    assert (len(values), values[0], values[-1]) == (12, 0.002, 0.05)
    ratios = [b / a for a, b in pairwise(values)]
    assert ratios == pytest.approx([25 ** (1 / 11)] * 11, rel=1e-3)


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
    plan = planned(triangle_document, "cases.periodic.trigger.period_s=0.02,0.1", cases=["event"])
    assert [cell.parameters.get("cases.periodic.trigger.period_s") for cell in plan] == [0.02, 0.1, None]


def test_loss_is_environment_and_threshold_is_chosen(triangle_document):
    delay = "cases.event.channel.delay_s=0.01,0.02"
    plan = planned(triangle_document, "trigger.threshold=0.005,0.02", "channel.loss=0,0.1", delay)
    met = {frozenset(cell.environment) for cell in plan if cell.case == "event"}
    assert met == {frozenset(("channel.loss", "cases.event.channel.delay_s"))}
    assert {reference.unit(path) for path in ("trigger.threshold", "cases.event.trigger.threshold")} == {"m"}


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
    with pytest.raises(DocumentError) as caught:
        planned(triangle_document, argument)
    (problem,) = caught.value.problems
    assert problem.file == argument
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
