"""Plug-ins are found by name, and refused by name and owner; errors of a tick name the plug-in to blame."""

import re
from dataclasses import replace
from importlib.metadata import EntryPoint
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import msgspec
import numpy as np
import pytest

import zenpark
from agents.body.interface import Body
from agents.decision.lifecycle import READY
from agents.formation.link import BY_NOTHING, Link
from agents.plugins import registry
from agents.plugins.avoidance import Avoidance
from agents.plugins.calls import explain, failure, unknown_reads, wrong
from agents.plugins.law import Control, Law, NeighbourView, RobotFacts, Said, View
from agents.plugins.laws import Distance
from agents.plugins.planners import Leg, Planner
from agents.plugins.predictors import Predictor
from agents.plugins.registry import AVOIDANCES, BODIES, FAILURES, LAWS, PLANNERS, PREDICTORS, TRIGGERS, PluginError
from agents.plugins.triggers import Trigger
from agents.vectors import ZERO
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.small import pair

GROUPS = (BODIES, TRIGGERS, PREDICTORS, LAWS, PLANNERS, AVOIDANCES)


class Pulse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    width: float
    count: int = 2

    def __post_init__(self):
        if self.width <= 0.0:
            raise ValueError("width must be positive")


class Keeper(msgspec.Struct, dict=True):
    width: float = 1.0


class Glider(Body):
    def read(self, t):
        return []

    def stop(self, rows):
        pass


class Pairs(Law, frozen=True):
    NEEDS = "pairs"


class Plain(Law):
    gain: float = 1.0


ENTRIES = {
    **{name: f"{__name__}:{name.title()}" for name in ("pulse", "keeper", "glider", "pairs", "plain")},
    "gone": "no_such_module_anywhere:Thing",
    "misled": "misled:Law",
    "misnamed": f"{__name__}:Puls",
    "function": f"{__name__}:foreign",
}


@pytest.fixture
def foreign(monkeypatch, tmp_path):
    """A group of plug-ins as a stranger's distribution would register it; all other groups have the same ones."""
    named = [*ENTRIES.items(), ("pulse", ENTRIES["pulse"]), ("twice", "one:A"), ("twice", "two:B")]
    listed = [EntryPoint(name, value, "test") for name, value in named]
    (tmp_path / "misled.py").write_text("from zenpark import law\n", "utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(registry, "installed", lambda: SimpleNamespace(select=lambda group: listed))
    monkeypatch.setattr(registry, "registered", registry.registered.__wrapped__)
    return "test"


def test_choice_is_built_and_left_alone(monkeypatch):
    monkeypatch.setattr(registry, "distribution_name", lambda _: pytest.fail("metadata of a sound plug-in were read"))
    choice = {"kind": "send-on-delta", "threshold": 0.25}
    assert registry.build(TRIGGERS, choice).threshold == 0.25
    assert choice == {"kind": "send-on-delta", "threshold": 0.25}
    assert registry.build(TRIGGERS, "periodic").period_s == 0.02


def test_bad_choice_keeps_its_path(foreign):
    for choice, message in (
        ({}, "required field `kind`"),
        ({"kind": 3}, r"at `\$\.kind`"),
        ({"kind": "pulse", "width": "wide"}, r"Expected `float`, got `str` - at `\$\.width`"),
        ({"kind": "pulse", "width": -1.0}, "width must be positive"),
        ({"kind": "pulse", "width": 1.0, "nonsense": 1}, "unknown field `nonsense`"),
        ("pulse", "missing required field `width`"),
    ):
        with pytest.raises(msgspec.ValidationError, match=message):
            registry.build(foreign, choice)


def test_unknown_name_gets_the_nearest():
    for group, name, message in (
        (TRIGGERS, "PERIODC", r"no 'PERIODC' among the triggers; did you mean 'periodic'?"),
        (TRIGGERS, "xyzzy", r"known: .*periodic.*send-on-delta"),
        ("zenpark.nothing", "xyzzy", "none is installed"),
    ):
        with pytest.raises(registry.UnknownPlugin, match=message):
            registry.load(group, name)


BASE = "must be a class that inherits from zenpark."


@pytest.mark.parametrize(
    ("group", "name", "message"),
    [
        ("test", "gone", r"'gone' .*unnamed distribution.*No module named 'no_such_module"),
        ("test", "misnamed", r"AttributeError: .*Puls"),
        ("test", "misled", "fails to import: zenpark has no 'law'; did you mean 'Law'"),
        ("test", "function", "no msgspec.Struct"),
        ("test", "keeper", r"Keeper.* can be changed.* frozen=True"),
        ("test", "twice", r"'twice' .* is ambiguous: .*one:A.* and .*two:B.*another name"),
        (BODIES, "glider", r"'glider' .* lacks the methods close, command, land, locate, open"),
        (LAWS, "pairs", r"'pairs' .* says NEEDS = 'pairs', none of \('distance', 'relative'"),
        *((group, "pulse", rf"'pulse' .* {BASE}{base.partition(':')[2]}") for group, base in registry.BASES.items()),
        *((group, "function", rf"'function' .* {BASE}") for group in registry.BASES),
    ],
)
@pytest.mark.usefixtures("foreign")
def test_unusable_plug_in_is_refused(group, name, message):
    with pytest.raises(registry.PluginError, match=message):
        registry.struct(group, name) if group in {"test", BODIES, LAWS} else registry.load(group, name)
    assert {base.partition(":")[2] for base in registry.BASES.values()} <= set(zenpark.__all__)


def test_sound_plug_ins_are_one_and_frozen(foreign):
    assert registry.struct(foreign, "pulse") is Pulse  # found by two paths
    with pytest.raises(AttributeError, match="immutable"):
        registry.build(LAWS, "plain").gain = 2.0
    lines = registry.unusable(registry.struct, [foreign])
    assert [line.partition(" (")[0] for line in lines] == [
        f"left out: plug-in '{name}'" for name in ("function", "glider", "gone", "keeper", "misled", "misnamed")
    ] + ["left out: 'twice' among the test is ambiguous: plug-in 'twice'"]
    assert all(line.endswith("; mend or uninstall it (docs/plugins.md)") for line in lines)


@pytest.mark.parametrize(
    ("owner", "named"), [("theirs", f"plug-in {__name__} of theirs failed at {__file__}:"), ("zenpark", "None")]
)
def test_foreign_culprit_is_named_with_its_line(owner, named, monkeypatch):
    entry = SimpleNamespace(module=__name__, dist=type("Distributed", (), {"name": owner}))
    monkeypatch.setattr(registry, "installed", lambda: SimpleNamespace(select=lambda group: [entry]))
    monkeypatch.setattr(registry, "_owners", registry._owners.__wrapped__)
    with pytest.raises(ValueError, match="width must") as caught:
        Pulse(width=0.0)
    assert str(registry.culprit(caught.value)).startswith(named)


def half(number):
    return 0.5 * number


class Spring(Distance, frozen=True):
    way: str = ""

    def pull(self, apart, link):
        return half(apart) / 0.0 if self.way == "fails" else None


FAILS, NOTHING = Spring(way="fails"), Spring(way="nothing")


def explained(call):
    """The error that a tick ends with."""
    try:
        call()
    except FAILURES as error:
        return explain(error, [("avoidance", Avoidance()), ("law", FAILS), ("law", NOTHING)])
    raise AssertionError


def unpack(law):
    x, y, z = law.pull(1.0, None)
    return x, y, z


def test_failure_names_plug_in_and_line():
    error = explained(lambda: unpack(FAILS))
    lines = Path(__file__).read_text("utf-8").splitlines()
    line = 1 + next(k for k, text in enumerate(lines) if "return half(apart)" in text)
    assert isinstance(error, PluginError)
    assert str(error) == f"the law Spring failed: ZeroDivisionError: float division by zero ({__file__}:{line})"
    useless = explained(lambda: unpack(NOTHING))
    assert isinstance(useless, PluginError)
    assert re.search("`pull` of the law Spring gives what cannot be used.*is a `return` missing?", str(useless))
    shown = wrong("law", NOTHING, "pull", (1.0, 2.0), "three numbers")
    assert str(shown) == f"`pull` of the law Spring must give three numbers, not (1.0, 2.0) ({__file__})"


def test_other_errors_stay_what_they_are():
    assert isinstance(explained(lambda: half("x")), TypeError)
    assert isinstance(explained(lambda: {}["x"]), KeyError)
    told = failure("law", FAILS, ValueError("no"))

    def again():
        raise told

    assert explained(again) is told


def test_variable_that_begin_did_not_give_is_named():
    class Forgets(Law):
        def step(self, view, memory):
            return Control(memory={"y": memory["z"]})

    law = Forgets()
    with pytest.raises(KeyError) as caught:
        law.step(None, {"y": (0.0,)})
    assert "KeyError: 'z'; `begin` gave no 'z', only y (" in str(failure("law", law, caught.value))


NEEDS = 'unknown with NEEDS = "nothing": give the law NEEDS = '
READS = {  # what a law reads of its view: field and remedy
    "distance": (lambda view: [each.link.distance for each in view.neighbours], f'link.distance, {NEEDS}"distance"'),
    "bearing": (lambda view: [each.link.bearing for each in view.known()], f'link.bearing, {NEEDS}"bearing"'),
    "said": (
        lambda view: [each.said["x"] for each in view.neighbours],
        "said['x'] of neighbours that have not said it yet: ask view.known for them",
    ),
    "target": (lambda view: view.target, "view.target of a robot without a plan: ask math.isfinite before"),
    "position": (lambda view: [each.position for each in view.neighbours], ""),
}


class Reader(Law):
    SAYS: ClassVar = {"x": Said()}
    reads: str

    def step(self, view, memory):
        return Control(velocity=(nan * len(READS[self.reads][0](view)), 0.0, nan))


@pytest.mark.parametrize("reads", READS)
def test_unknown_reads_name_field_and_remedy(reads):
    neighbour = NeighbourView(1, "B", ZERO, ZERO, 0.0, 0.0, {"x": (nan,)}, Link(nan, wants=BY_NOTHING))
    view = View(RobotFacts("A", 0, 2, False, 1.0, 0.1), {"x": (0.0,)}, [neighbour])
    law, words = Reader(reads), READS[reads][1]
    assert unknown_reads(law, lambda watched: law.step(watched(view), {})) == (words and f": Reader reads {words}")


class Endless(Avoidance, frozen=True):
    """An avoidance of whatever is anywhere."""

    def horizon(self, own):
        return inf


def giving(base, method, answer):
    """A plug-in, a method of which gives an answer, or raises it."""

    def give(self, *_):
        if isinstance(answer, Exception):
            raise answer
        return answer

    give.__code__ = give.__code__.replace(co_name=method)  # by which it is found in a traceback
    return msgspec.defstruct("Foreign", [], bases=(base,), namespace={method: give}, frozen=True)()


def idle(**parts):
    """A robot that has not taken off, beside one that it receives."""
    bench = Bench(replace(Plan(pair()).assignment("A"), **parts), (-0.4, 0.0, 0.0))
    bench.hear(0, (0.4, 0.1, 0.0))
    return bench


@pytest.mark.parametrize("place", ["trigger", "update"])
@pytest.mark.parametrize(("answer", "told"), [(None, "nothing: is a `return` missing"), (1.0, "1.0"), ("yes", "'yes'")])
def test_trigger_must_give_a_bool(place, answer, told):
    bench = idle(**{place: giving(Trigger, "fires", answer)})
    with pytest.raises(PluginError, match=rf"`fires` of the trigger Foreign must give True or False, not {told}"):
        bench.step()
    assert bench.life.takeoff()
    for good in (True, False, np.True_):
        assert idle(trigger=giving(Trigger, "fires", good)).step().life.phase == READY


@pytest.mark.parametrize("answer", [None, (1.0, 2.0), "abc", ("a", "b", "c")])
@pytest.mark.parametrize(
    ("part", "base", "method", "wanted"),
    [
        ("law", Distance, "pull", "three numbers"),
        ("law", Distance, "error", "a number"),
        ("predictor", Predictor, "position", "three numbers"),
        ("planner", Planner, "target", "four numbers"),
    ],
)
def test_results_must_be_numbers(part, base, method, wanted, answer):
    made = giving(base, method, answer)
    bench = idle(**({"legs": (Leg(30.0, made),)} if part == "planner" else {part: made}))
    with pytest.raises(PluginError, match=f"`{method}` of the {part} Foreign must give {wanted}"):
        bench.step()


FAILED, GIVES = "the avoidance Foreign failed: ", "`{}` of the avoidance Foreign must give {}"
PLACE = r" \(.*test_registry\.py:\d+\)$"


@pytest.mark.parametrize(
    ("method", "answer", "says"),
    [
        ("deviate", KeyError("goal"), f"{FAILED}KeyError: 'goal'{PLACE}"),
        ("deviate", AssertionError(), f"{FAILED}AssertionError"),
        ("deviate", (0.0,), GIVES.format("deviate", r"three numbers, not \(0.0,\)")),
        ("restrain", TypeError(), f"{FAILED}TypeError.*{PLACE}"),
        ("restrain", None, GIVES.format("restrain", "four numbers, not nothing: is a `return` ")),
        ("restrain", ("here",) * 4, GIVES.format("restrain", "four numbers")),
        ("restrain", (0.0, 0.0), GIVES.format("restrain", "four numbers")),
        ("horizon", KeyError("own"), f"{FAILED}KeyError: 'own'{PLACE}"),
        ("horizon", nan, GIVES.format("horizon", "a distance of 0 m or more, not nan")),
        ("horizon", None, GIVES.format("horizon", "a distance")),
    ],
)
def test_mistake_in_an_avoidance_is_named(method, answer, says):
    avoidance = giving(Endless, method, answer)
    with pytest.raises(FAILURES) as caught:
        idle(avoidance=avoidance).running(lambda bench: bench.hear(0, (0.4, 0.1, 0.0)))
    told = explain(caught.value, [("avoidance", avoidance)])
    assert isinstance(told, PluginError)
    assert re.search(says, str(told))


class Counting(Trigger, frozen=True):
    MEMORY: ClassVar = {"asked": 0}

    def fires(self, view):
        view.memory.asked += 1
        return False


def test_rehearsal_leaves_no_trace():
    assert idle(trigger=Counting()).step().robot.transmitter.asking.view.memory.asked == 1
