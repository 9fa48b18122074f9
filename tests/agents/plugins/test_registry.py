"""Plug-ins are found by name, checked for what their group asks, and refused by name and owner."""

from importlib.metadata import EntryPoint
from types import SimpleNamespace

import msgspec
import pytest

import zenpark
from agents.body.interface import Body
from agents.plugins import registry
from agents.plugins.law import Law
from agents.plugins.registry import AVOIDANCES, BODIES, LAWS, PLANNERS, PREDICTORS, TRIGGERS

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
    with pytest.raises(ValueError, match="width must") as caught:
        Pulse(width=0.0)
    assert str(registry.culprit(caught.value)).startswith(named)
