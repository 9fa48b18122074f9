"""Reference of the experiment file: every key has a type and an example that is TOML and holds the key."""

import tomllib
from importlib.metadata import EntryPoint

import pytest
from typer.testing import CliRunner

from agents.body.kinds import KINDS
from agents.plugins import registry
from experiments.file import reference
from experiments.file.document import loads
from experiments.file.problems import DocumentError
from tests.cases import for_each
from tools.main import app


@for_each("entry", reference.entries())
def test_an_example_is_a_part_of_a_file(entry):
    value = tomllib.loads(entry.example)
    for part in entry.words:
        while part not in value:  # below a name
            (value,) = value.values()
        value = value[part]
        value = value[0] if isinstance(value, list) and value and isinstance(value[0], dict) else value
    assert entry.type


@pytest.mark.parametrize(
    ("asked", "first"),
    [
        ("disturbance.hover_jitter", "disturbance.KIND.hover_jitter"),
        ("disturbance.crazyflie.hover_jitter", "disturbance.KIND.hover_jitter"),
        ("robots.CF01.start", "robots.ROBOT.start"),
        ("trigger.send-on-delta.threshold", "trigger(send-on-delta).threshold"),
        ("trigger(send-on-delta).threshold", "trigger(send-on-delta).threshold"),
        ("body_hz", "rates.body_hz"),
        ("plan", "timeline.plan"),
        ("plan.circle", "timeline.plan(circle)"),
        ("send-on-delta", "trigger(send-on-delta)"),
        ("tello", 'robots.ROBOT.kind = "tello"'),
    ],
)
def test_a_key_is_found_as_users_write_it(asked, first):
    assert reference.matching(asked)[0].key == first


def test_a_table_is_followed_by_its_keys():
    keys = [entry.key for entry in reference.matching("safety")]
    assert keys[0] == "safety"
    assert {"safety.speed", "safety.separation"} < set(keys)


def test_an_entry_says_default_and_limits():
    (entry,) = reference.matching("rates.body_hz")
    assert (entry.type, entry.limits, entry.default) == ("a number", "> 0, ≤ 2000", "100.0")
    assert entry.example.startswith("[rates]\nbody_hz = ")


GROUPS = {
    "plan": registry.PLANNERS, "law": registry.LAWS, "trigger": registry.TRIGGERS, "update": registry.TRIGGERS,
    "prediction": registry.PREDICTORS, "avoidance": registry.AVOIDANCES, "engine": registry.ENGINES,
}  # fmt: skip


@for_each("entry", [each for each in reference.entries() if "(" in each.key])
def test_plugin_example_has_all_that_it_needs(entry):
    *tables, choice = entry.example.split("\n")
    ((owner, parameters),) = tomllib.loads(choice).items()
    registry.build(GROUPS[owner], parameters)
    assert tables in ([], ["[[timeline]]"]) or not tables[0].startswith("[timeline")


def test_no_key_is_explained_twice():
    keys = [entry.key for entry in reference.matching("formation.law")]
    assert len(keys) == len(set(keys)) > 4


def test_a_pipe_receives_the_whole_texts():
    said = CliRunner().invoke(app, ["explain", "formation.law"])
    assert not any(line.endswith("...") for line in said.output.splitlines())


def test_table_is_explained_on_one_screen():
    lines = CliRunner().invoke(app, ["explain", "formation"]).output.splitlines()
    assert len(lines) < 24
    keys = [line.partition(" ")[0] for line in lines]
    assert {"formation.law", "formation.gain", "formation.links"} <= {*keys}
    assert not any("(" in key for key in keys)
    assert "`./zenpark explain formation.law`" in lines[-1]
    assert len(CliRunner().invoke(app, ["explain", "formation", "--json"]).output) > 30_000


def test_kind_is_explained_with_its_dynamics():
    said = CliRunner().invoke(app, ["explain", "ackermann"]).output
    kind = KINDS["ackermann"]
    for name in ("response", "turn_response", "lag"):
        assert f"{name} = {getattr(kind, name):.3g}" in " ".join(said.split())
    assert f"turning radius {kind.turn_radius:.3g} m" in said


def test_explain_without_a_key_lists_the_top_level():
    lines = CliRunner().invoke(app, ["explain"]).output.splitlines()
    assert [line.partition(" ")[0] for line in lines] == list(reference.described()["properties"])


def test_of_a_stranger_no_other_key_is_named():
    said = CliRunner().invoke(app, ["explain", "qqqq.zzzz"])
    assert said.exit_code == 2
    assert "`./zenpark explain` lists what there is" in said.output
    assert "`./zenpark explain trigger` lists" in CliRunner().invoke(app, ["explain", "trigger.qqqqqqqqqqqq"]).output


def test_the_command_explains_a_key():
    said = CliRunner().invoke(app, ["explain", "rates.body_hz"])
    assert said.exit_code == 0
    for part in ("rates.body_hz", "position control and body", "> 0, ≤ 2000", "100.0", "[rates]"):
        assert part in said.output


def test_an_unknown_key_is_wrong_input():
    said = CliRunner().invoke(app, ["explain", "saftey"])
    assert said.exit_code == 2
    assert "did you mean 'safety'?" in said.output


@pytest.mark.parametrize("metric", ["IAE", "acquired", "acquired_s", "rmse"])
def test_a_metric_is_explained(metric):
    said = CliRunner().invoke(app, ["explain", metric])
    assert said.exit_code == 0
    assert said.output.startswith("metric: ")


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("battery", "safety.battery_low"),
        ("obstacle", "arena.obstacles"),
        ("hover jitter", "disturbance.KIND.hover_jitter"),
    ],
)
def test_word_that_is_no_key_finds_related_keys(word, key):
    assert key in [entry.key for entry in reference.containing(word)]
    said = CliRunner().invoke(app, ["explain", word])
    assert said.exit_code == 2
    assert f"nothing in the experiment file is named '{word}'; keys about it:" in said.output
    assert f"\n{key} " in said.output


@pytest.fixture
def broken(monkeypatch):
    """A registered law without its module."""
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
    said = CliRunner().invoke(app, words)
    assert said.exit_code == 0
    assert "left out: plug-in 'broken' (no_such_module_anywhere:Law)" in said.stderr
    assert said.stderr.count("\n") == 1
    assert "broken" not in said.stdout


def test_file_with_a_broken_plugin_is_refused_there(broken):
    with pytest.raises(DocumentError) as caught:
        loads('title = "A"\nduration_s = 5.0\n[robots.A]\nkind = "khepera4"\nstart = [0.0, 0.0]\n'
              '[formation]\nlaw = "broken"\n')  # fmt: skip
    (problem,) = caught.value.problems
    assert problem.line == 7
    assert "fails to import: ModuleNotFoundError" in problem.message
