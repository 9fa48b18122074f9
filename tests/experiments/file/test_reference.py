"""Reference of the experiment file: every key has a type and an example that is TOML and holds the key."""

import tomllib
from importlib.metadata import EntryPoint

import pytest

from agents.body.kinds import KINDS
from agents.plugins import registry
from experiments.file import reference
from experiments.file.document import loads
from experiments.file.problems import DocumentError
from tests.cases import for_each
from tests.commands import invoke

GROUPS = {
    "plan": registry.PLANNERS, "law": registry.LAWS, "trigger": registry.TRIGGERS, "update": registry.TRIGGERS,
    "prediction": registry.PREDICTORS, "avoidance": registry.AVOIDANCES, "engine": registry.ENGINES,
}  # fmt: skip


@for_each("entry", reference.entries())
def test_example_is_a_part_of_a_file(entry):
    value = tomllib.loads(entry.example)
    for part in entry.words:
        while part not in value:  # below a name
            (value,) = value.values()
        value = value[part]
        value = value[0] if isinstance(value, list) and value and isinstance(value[0], dict) else value
    assert entry.type
    if "(" in entry.key:  # it has all that the plug-in needs
        *tables, choice = entry.example.split("\n")
        ((owner, parameters),) = tomllib.loads(choice).items()
        registry.build(GROUPS[owner], parameters)
        assert tables in ([], ["[[timeline]]"]) or not tables[0].startswith("[timeline")


@pytest.mark.parametrize(
    ("asked", "first"),
    [
        ("disturbance.crazyflie.hover_jitter", "disturbance.KIND.hover_jitter"),
        ("robots.CF01.start", "robots.ROBOT.start"),
        ("trigger.send-on-delta.threshold", "trigger(send-on-delta).threshold"),
        ("body_hz", "rates.body_hz"),
        ("plan.circle", "timeline.plan(circle)"),
        ("send-on-delta", "trigger(send-on-delta)"),
        ("tello", 'robots.ROBOT.kind = "tello"'),
    ],
)
def test_key_is_found_as_users_write_it(asked, first):
    assert reference.matching(asked)[0].key == first


def test_entry_of_a_table_and_of_a_number():
    (entry,) = reference.matching("rates.body_hz")
    assert (entry.type, entry.limits, entry.default) == ("a number", "> 0, ≤ 2000", "100.0")
    keys = [entry.key for entry in reference.matching("safety")]
    assert keys[0] == "safety"
    assert {"safety.speed", "safety.separation"} < set(keys)
    keys = [entry.key for entry in reference.matching("formation.law")]
    assert len(keys) == len(set(keys)) > 4


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("rates.body_hz", ["rates.body_hz", "position control and body", "> 0, ≤ 2000", "100.0", "[rates]"]),
        ("IAE", ["metric: "]),
        ("acquired_s", ["metric: "]),
        ("ackermann", [f"turning radius {KINDS['ackermann'].turn_radius:.3g} m",
                       *(f"{key} = {getattr(KINDS['ackermann'], key):.3g}"
                         for key in ("response", "turn_response", "lag"))]),
    ],
)  # fmt: skip
def test_explain_tells(words, parts):
    text = " ".join(invoke("explain", words).output.split())
    assert all(part in text for part in parts)


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("qqqq.zzzz", ["`./zenpark explain` lists what there is"]),
        ("trigger.qqqqqqqqqqqq", ["`./zenpark explain trigger` lists"]),
        ("saftey", ["did you mean 'safety'?"]),
        ("battery", ["nothing in the experiment file is named 'battery'; keys about it:", "\nsafety.battery_low "]),
    ],
)
def test_explain_of_an_unknown_key_names_others(words, parts):
    text = invoke("explain", words, code=2).output
    assert all(part in text for part in parts)


def test_tables_are_explained_on_one_screen():
    lines = invoke("explain", "formation").output.splitlines()
    assert len(lines) < 24
    keys = [line.partition(" ")[0] for line in lines]
    assert {"formation.law", "formation.gain", "formation.links"} <= {*keys}
    assert not any("(" in key for key in keys)
    assert "`./zenpark explain formation.law`" in lines[-1]
    lines = invoke("explain").output.splitlines()
    assert [line.partition(" ")[0] for line in lines] == list(reference.described()["properties"])


@pytest.fixture
def broken(monkeypatch):
    entry, listed = EntryPoint("broken", "no_such_module_anywhere:Law", registry.LAWS), registry.registered

    def with_it(group):
        return {**listed(group), "broken": [entry]} if group == registry.LAWS else listed(group)

    monkeypatch.setattr(registry, "registered", with_it)
    reference.entries.cache_clear()
    yield
    reference.entries.cache_clear()


@pytest.mark.parametrize(
    "words", [["explain", "formation.law"], ["schema"], ["new", "triangle", "mine.toml"]], ids=lambda words: words[0]
)
def test_broken_plugin_stops_no_command_that_needs_none(broken, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = invoke(*words)
    assert "left out: plug-in 'broken' (no_such_module_anywhere:Law)" in done.stderr
    assert done.stderr.count("\n") == 1
    assert "broken" not in done.stdout


def test_file_with_a_broken_plugin_is_refused_there(broken):
    robot = 'title = "A"\nduration_s = 5.0\n[robots.A]\nkind = "khepera4"\nstart = [0.0, 0.0]\n'
    with pytest.raises(DocumentError) as caught:
        loads(f'{robot}[formation]\nlaw = "broken"\n')
    (problem,) = caught.value.problems
    assert problem.line == 7
    assert "fails to import: ModuleNotFoundError" in problem.message
