from dataclasses import dataclass
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
REGISTERED = [(group, name) for group in GROUPS for name in registry.names(group)]
STRUCTS = [(group, name) for group, name in REGISTERED if group != BODIES]


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


@pytest.fixture
def foreign(monkeypatch):
    """A group of plug-ins as a stranger's distribution would register it."""
    here = __name__
    entries = {
        "pulse": EntryPoint("pulse", f"{here}:Pulse", "test"),
        "gone": EntryPoint("gone", "no_such_module_anywhere:Thing", "test"),
        "misnamed": EntryPoint("misnamed", f"{here}:Puls", "test"),
        "function": EntryPoint("function", f"{here}:foreign", "test"),
        "keeper": EntryPoint("keeper", f"{here}:Keeper", "test"),
        "glider": EntryPoint("glider", f"{here}:Glider", "test"),
        "pairs": EntryPoint("pairs", f"{here}:Pairs", "test"),
    }
    listed = [
        *entries.values(),
        entries["pulse"],
        EntryPoint("twice", "one:A", "test"),
        EntryPoint("twice", "two:B", "test"),
    ]
    monkeypatch.setattr(registry, "installed", lambda: SimpleNamespace(select=lambda group: listed))
    monkeypatch.setattr(registry, "registered", registry.registered.__wrapped__)
    return "test"


@pytest.mark.parametrize(("group", "name"), REGISTERED)
def test_everything_registered_loads(group, name):
    assert callable(registry.load(group, name))


@pytest.mark.parametrize(("group", "name"), STRUCTS)
def test_every_plug_in_is_a_frozen_strict_struct(group, name):
    config = registry.struct(group, name).__struct_config__
    assert config.frozen
    assert config.forbid_unknown_fields


@pytest.mark.parametrize(("group", "name"), STRUCTS)
def test_every_plug_in_refuses_unknown_parameters(group, name):
    with pytest.raises(msgspec.ValidationError, match="nonsense"):
        registry.build(group, {"kind": name, "nonsense": 1})


def test_names_are_sorted():
    assert registry.names(TRIGGERS) == sorted(registry.names(TRIGGERS))
    assert {"periodic", "send-on-delta"} <= set(registry.names(TRIGGERS))
    assert {"hold", "line", "waypoints", "circle", "lemniscate"} <= set(registry.names(PLANNERS))
    assert registry.names("zenpark.nothing") == []


def test_build_by_name_and_by_table():
    assert registry.build(TRIGGERS, "periodic").period_s == 0.02
    assert registry.build(TRIGGERS, {"kind": "send-on-delta", "threshold": 0.25}).threshold == 0.25


def test_build_leaves_its_table_alone():
    choice = {"kind": "periodic", "period_s": 0.5}
    registry.build(TRIGGERS, choice)
    assert choice == {"kind": "periodic", "period_s": 0.5}


def test_bad_parameter_keeps_its_path(foreign):
    with pytest.raises(msgspec.ValidationError, match=r"Expected `float`, got `str` - at `\$\.width`"):
        registry.build(foreign, {"kind": "pulse", "width": "wide"})
    with pytest.raises(msgspec.ValidationError, match="missing required field `width`"):
        registry.build(foreign, "pulse")
    with pytest.raises(msgspec.ValidationError, match="width must be positive"):
        registry.build(foreign, {"kind": "pulse", "width": -1.0})


@pytest.mark.parametrize(("choice", "message"), [({}, "required field `kind`"), ({"kind": 3}, r"at `\$\.kind`")])
def test_table_needs_a_kind(choice, message):
    with pytest.raises(msgspec.ValidationError, match=message):
        registry.build(TRIGGERS, choice)


def test_unknown_name_gets_the_nearest():
    with pytest.raises(registry.UnknownPlugin, match=r"no 'periodc' among the triggers; did you mean 'periodic'?"):
        registry.load(TRIGGERS, "periodc")
    with pytest.raises(registry.UnknownPlugin, match=r"known: .*periodic.*send-on-delta"):
        registry.load(TRIGGERS, "xyzzy")
    with pytest.raises(registry.UnknownPlugin, match="none is installed"):
        registry.load("zenpark.nothing", "xyzzy")


def test_failing_import_names_owner_and_reason(foreign):
    with pytest.raises(registry.PluginError, match=r"'gone' .*unnamed distribution.*No module named 'no_such_module"):
        registry.load(foreign, "gone")
    with pytest.raises(registry.PluginError, match=r"AttributeError: .*Puls"):
        registry.load(foreign, "misnamed")


def test_name_that_zenpark_has_not_gets_the_nearest(monkeypatch, tmp_path):
    (tmp_path / "misled.py").write_text("from zenpark import law\n", "utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = EntryPoint("misled", "misled:Law", LAWS)
    monkeypatch.setattr(registry, "registered", lambda _: {"misled": [entry]})
    with pytest.raises(registry.PluginError, match="fails to import: zenpark has no 'law'; did you mean 'Law'"):
        registry.load(LAWS, "misled")


def test_plug_in_must_be_a_struct(foreign):
    with pytest.raises(registry.PluginError, match=r"no msgspec.Struct"):
        registry.build(foreign, "function")


@pytest.mark.parametrize(
    ("address", "name"), [("radio://0/80/2M/E7E7E7E701", "radio"), ("twin", "twin"), ("", ""), ("a:b", "a:b")]
)
def test_body_name(address, name):
    assert registry.body_name(address) == name


@pytest.mark.parametrize(
    ("word", "known", "answer"),
    [
        ("treshold", ["threshold", "period_s"], "did you mean 'threshold'?"),
        ("kh01", ["KH01", "CF01"], "did you mean 'KH01'?"),
        ("zzz", ["a", "b"], "known: a, b"),
        ("zzz", [], ""),
    ],
)
def test_did_you_mean(word, known, answer):
    assert registry.did_you_mean(word, known) == answer


@pytest.mark.parametrize("group", registry.BASES)
@pytest.mark.parametrize("name", ["pulse", "function"])
@pytest.mark.usefixtures("foreign")
def test_plug_in_inherits_from_its_base(group, name):
    base = registry.BASES[group].partition(":")[2]
    assert base in zenpark.__all__
    with pytest.raises(registry.PluginError, match=rf"'{name}' .* must be a class that inherits from zenpark.{base}"):
        registry.load(group, name)


@pytest.mark.usefixtures("foreign")
def test_incomplete_body_names_missing_methods():
    with pytest.raises(registry.PluginError, match=r"'glider' .* lacks the methods close, command, land, locate, open"):
        registry.load(BODIES, "glider")


@pytest.mark.usefixtures("foreign")
def test_unknown_class_variable_is_refused():
    with pytest.raises(
        registry.PluginError, match=r"'pairs' .* says NEEDS = 'pairs', none of \('distance', 'relative'"
    ):
        registry.struct(LAWS, "pairs")


def test_ambiguous_name_is_refused(foreign):
    with pytest.raises(registry.PluginError, match=r"'twice' .* is ambiguous: .*one:A.* and .*two:B.*another name"):
        registry.load(foreign, "twice")
    assert registry.struct(foreign, "pulse") is Pulse, "found by two paths, it is one"


def test_changeable_plug_in_is_refused(foreign):
    with pytest.raises(registry.PluginError, match=r"Keeper.* can be changed.* frozen=True"):
        registry.build(foreign, "keeper")


def test_plug_ins_inherit_frozen_from_their_base(monkeypatch):
    class Plain(Law):
        gain: float = 1.0

    monkeypatch.setattr(registry, "load", lambda group, name: Plain)
    with pytest.raises(AttributeError, match="immutable"):
        registry.build(LAWS, "plain").gain = 2.0


def test_unusable_plug_ins_are_named_with_remedy(foreign, monkeypatch):
    monkeypatch.setattr(registry, "CHOSEN", (foreign,))
    lines = registry.unusable(registry.struct)
    assert [line.partition(" (")[0] for line in lines] == [
        f"left out: plug-in '{name}'" for name in ("function", "glider", "gone", "keeper", "misnamed")
    ] + ["left out: 'twice' among the test is ambiguous: plug-in 'twice'"]
    assert all(line.endswith("; mend or uninstall it (docs/plugins.md)") for line in lines)


@dataclass(frozen=True)
class Named:
    name: str


def failing():
    raise LookupError("of the plug-in")


def test_foreign_culprit_is_named_with_its_line(monkeypatch):
    entry = SimpleNamespace(module=__name__, dist=Named("theirs"))
    monkeypatch.setattr(registry, "installed", lambda: SimpleNamespace(select=lambda group: [entry]))
    with pytest.raises(LookupError) as caught:
        failing()
    place = registry.culprit(caught.value)
    assert place is not None
    assert place.startswith(f"plug-in {__name__} of theirs failed at {__file__}:")
    entry.dist = Named("zenpark")
    assert registry.culprit(caught.value) is None


def test_sound_struct_reads_no_metadata(monkeypatch):
    monkeypatch.setattr(registry, "_name", lambda _: pytest.fail("the metadata of a distribution were read"))
    assert registry.struct(registry.TRIGGERS, "periodic").__name__ == "Periodic"
