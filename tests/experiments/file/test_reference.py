"""Reference, schema and catalogue of experiment files."""

import json
import re
import tomllib
from contextlib import nullcontext
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from agents.body.kinds import KINDS
from agents.plugins import registry
from experiments.catalogue import index
from experiments.file import catalogue as files
from experiments.file import json_schema, reference
from experiments.file.document import DocumentError, loads, read
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
        ("safety", "safety"),
        ("formation.law", "formation.law"),
        ("formation.links.LINK", "formation.links"),
    ],
)
def test_key_is_found_as_users_write_it(asked, first):
    keys = [entry.key for entry in reference.matching(asked)]
    assert keys[0] == first
    assert len(keys) == len(set(keys))


PURSUIT = '''
from typing import Annotated
from msgspec import Meta
from zenpark import Law, Metric


class Pursuit(Law, frozen=True):
    """Goes after its neighbour."""

    gain: Annotated[float, Meta(ge=0.0, description="gain of the pursuit [1/s]")] = 0.5


class Other: ...


class Way(Metric):
    """Length of the way."""

    label = "Way"
    unit = "m"


class Bare(Metric):
    """Nothing."""
'''


def test_class_of_a_file_is_explained(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("pursuit.py").write_text(PURSUIT, "utf-8")
    told = invoke("explain", "pursuit.py:Pursuit").stdout
    for part in ("Goes after its neighbour.", "[formation]\n", "gain of the pursuit [1/s] [≥ 0.0, default: 0.5]"):
        assert part in told
    assert "Length of the way." in (told := invoke("explain", "pursuit.py:Way").stdout)
    assert "a metric: Way [m]" in told
    for choice, fault in {
        "pursuit.py:Other": "Law, Planner.*, Metric",
        "pursuit.py:Bare": "label",
        "pursuit.py:Third": "has no Third",
        "a.py:A": "a.py",
    }.items():
        with pytest.raises(registry.PluginError, match=fault):
            reference.in_file(choice)


@pytest.mark.parametrize(
    ("words", "code", "parts"),
    [
        ("rates.body_hz", 0, ["rates.body_hz", "position control", "a number", "> 0, ≤ 2000", "100.0", "[rates]"]),
        ("IAE", 0, ["metric: "]),
        ("acquired_s", 0, ["metric: "]),
        ("ackermann", 0, [f"turning radius {KINDS['ackermann'].turn_radius:.3g} m",
                          *(f"{key} = {getattr(KINDS['ackermann'], key):.3g}"
                            for key in ("response", "turn_response", "lag"))]),
        ("qqqq.zzzz", 2, ["`./zenpark explain` lists what there is"]),
        ("trigger.qqqqqqqqqqqq", 2, ["`./zenpark explain trigger` lists"]),
        ("saftey", 2, ["did you mean 'safety'?"]),
        ("battery", 2, ["nothing in the experiment file is named 'battery'; keys about it:", " safety.battery_low "]),
    ],
)  # fmt: skip
def test_explain_tells_or_names_others(words, code, parts):
    text = " ".join(invoke("explain", words, code=code).output.split())
    assert [part for part in parts if part not in text] == []


def test_tables_are_explained_on_one_screen():
    lines = invoke("explain", "formation").output.splitlines()
    keys = [line.partition(" ")[0] for line in lines]
    assert {"formation.law", "formation.gain", "formation.links"} <= {*keys}
    assert (len(lines) < 24, any("(" in key for key in keys)) == (True, False)
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
    "words",
    [["explain", "formation.law"], ["explain", "--schema"], ["new", "triangle", "mine.toml"]],
    ids=lambda words: words[0],
)
def test_broken_plugin_stops_no_command_that_needs_none(broken, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = invoke(*words)
    assert "left out: plug-in 'broken' (no_such_module_anywhere:Law)" in done.stderr
    assert (done.stderr.count("\n"), "broken" in done.stdout) == (1, False)


def test_file_with_a_broken_plugin_is_refused_there(broken):
    with pytest.raises(DocumentError, match=r":7:7: .*fails to import: No module .*`./zenpark install no_such"):
        loads(SMALL.replace("[formation.links]", '[formation]\nlaw = "broken"\n[formation.links]'))


def test_names_and_titles():
    found = index.titles()
    assert list(found) == sorted(found)
    assert found["robotic-park"] == tomllib.loads(files.path("robotic-park").read_text("utf-8"))["title"]
    assert all(files.path(name).read_text("utf-8").startswith(f"#:schema ./{index.SCHEMA}\n") for name in found)
    with pytest.raises(DocumentError, match="did you mean 'convoy'"):
        files.path("convoi")


def test_copy_is_readable_whole_and_never_overwrites(tmp_path, monkeypatch):
    target = files.copy_entry("triangle", tmp_path / "mine.toml")
    assert read(target).experiment == read("triangle").experiment
    assert json.loads((tmp_path / index.SCHEMA).read_bytes()) == json_schema.schema()
    assert files.copy_entry("convoy", tmp_path) == tmp_path / "convoy.toml"
    nowhere = tmp_path / "nowhere" / "x.toml"
    for place, message in ((target, "exists already"), (nowhere, "cannot be written: No such file")):
        with pytest.raises(DocumentError, match=message):
            files.copy_entry("convoy", place)
    assert read(target).experiment == read("triangle").experiment
    monkeypatch.setattr(files, "write_schema", lambda _: Path("/dev/full").write_text("{}"))
    (tmp_path / "full").mkdir()
    with pytest.raises(DocumentError, match="cannot be written: No space left"):
        files.copy_entry("triangle", tmp_path / "full")
    assert not [*(tmp_path / "full").iterdir()]


def test_schema_is_draft_7_and_knows_the_plugins():
    schema = json_schema.schema()
    assert schema["$schema"] == "http://json-schema.org/draft-07/schema#"
    assert not {"prefixItems", "$defs"} & {key for _, node in nodes(schema) for key in node}
    by_name, beside, *tables, table_beside = schema["properties"]["trigger"]["anyOf"]
    assert re.search(beside["pattern"], "my_trigger.py:Mine")
    assert table_beside["properties"]["kind"] == beside
    assert {"periodic", "send-on-delta"} <= set(by_name["enum"])
    kinds = {table["properties"]["kind"]["const"]: table for table in tables}
    assert kinds["send-on-delta"]["properties"]["threshold"]["exclusiveMinimum"] == 0
    plans = schema["definitions"]["LegTable"]["properties"]["plan"]["anyOf"]
    assert "line" not in plans[0]["enum"]  # it cannot do without its parameters
    assert schema["definitions"]["RobotTable"]["properties"]["kind"]["enum"] == list(KINDS)
    case = schema["definitions"][schema["properties"]["cases"]["additionalProperties"]["$ref"].rpartition("/")[2]]
    assert ("required" in case, "cases" in case["properties"]) == (False, False)


SMALL = """title = "t"
duration_s = 10
[robots]
A = { kind = "khepera4", start = [0.0, 0.0] }
B = { kind = "khepera4", start = [0.6, 0.0] }
[formation.links]
"A - B" = 0.8
"""


@pytest.mark.parametrize(
    ("old", "new", "taken"),
    [
        ("0.8", "{ gain = 1.0 }", False),
        ("0.8", "{ distance = 0.8, offset = [0.6, 0.0] }", False),
        ("0.8", '"shape"\n[formation.shape]\nA = [0.0, 0.0]\nB = [0.5, 0.0]', True),
        ("0.8", "0.8\n[arena.obstacles.o]\nat = [1.0, 1.0]\nradius = 0.1", True),
        ("0.8", "0.8\n[arena.obstacles.o]\nat = [1.0, 1.0]", False),
        ("0.8", "0.8\n[arena.obstacles.o]\nradius = 0.1\nbox = [0.1, 0.1]", False),
        ("0.8", "0.8\n[cases.e.formation.links]\n'A - B' = { gain = 2.0 }", True),
        ("0.8", '0.8\n[cases."e\\n"]', False),
        ("10", "10\ntolerance = 1e13", False),
        ("10", "10\nseed = -1", False),
    ],
)
def test_schema_takes_what_the_parser_takes(old, new, taken, tmp_path):
    jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema")
    text = SMALL.replace(old, new, 1)
    (tmp_path / "small.toml").write_text(text)
    with nullcontext() if taken else pytest.raises(DocumentError):
        read(tmp_path / "small.toml")
    assert jsonschema.Draft7Validator(json_schema.schema()).is_valid(tomllib.loads(text)) == taken


def nodes(node, path=""):
    """Every table of the schema with its path."""
    if isinstance(node, dict):
        yield path, node
    for key, each in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield from nodes(each, f"{path}.{key}")


def test_schema_describes_every_field():
    tables = ((path, node.get("properties", {})) for path, node in nodes(json_schema.described()))
    fields = {f"{path}.{name}": field for path, table in tables for name, field in table.items()}
    assert [name for name, field in fields.items() if not {"description", "const"} & set(field)] == []
    numbers = [node for _, node in nodes(json_schema.schema()) if node.get("type") == "number"]
    assert len(numbers) > 100
    assert not [each for each in numbers if each.get("default", 0.0) is None]
