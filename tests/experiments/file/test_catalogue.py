"""The catalogue: experiments that can be flown, copies of them, and the schema beside them."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from agents.body.kinds import KINDS
from experiments.catalogue import index
from experiments.file import catalogue as entries
from experiments.file import json_schema
from experiments.file.document import DocumentError, read


def test_names_and_titles():
    found = index.titles()
    assert list(found) == sorted(found)
    assert found["robotic-park"] == tomllib.loads(entries.path("robotic-park").read_text("utf-8"))["title"]
    assert all(entries.path(name).read_text("utf-8").startswith(f"#:schema ./{index.SCHEMA}\n") for name in found)
    with pytest.raises(DocumentError, match="did you mean 'convoy'"):
        entries.path("convoi")


def test_copy_is_readable_whole_and_never_overwrites(tmp_path, monkeypatch):
    target = entries.copy_entry("triangle", tmp_path / "mine.toml")
    assert read(target).experiment == read("triangle").experiment
    assert json.loads((tmp_path / index.SCHEMA).read_bytes()) == json_schema.schema()
    assert entries.copy_entry("convoy", tmp_path) == tmp_path / "convoy.toml"
    for name, place, message in (
        ("convoy", target, "exists already"),
        ("convoy", tmp_path / "nowhere" / "x.toml", "cannot be written: No such file"),
    ):
        with pytest.raises(DocumentError, match=message):
            entries.copy_entry(name, place)
    assert read(target).experiment == read("triangle").experiment
    monkeypatch.setattr(entries, "write_schema", lambda _: Path("/dev/full").write_text("{}"))
    (tmp_path / "full").mkdir()
    with pytest.raises(DocumentError, match="cannot be written: No space left"):
        entries.copy_entry("triangle", tmp_path / "full")
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
    case = schema["properties"]["cases"]["additionalProperties"]["$ref"].rpartition("/")[2]
    assert "required" not in schema["definitions"][case]
    assert "cases" not in schema["definitions"][case]["properties"]


SMALL = """title = "t"
duration_s = 10
[robots.A]
kind = "khepera4"
start = [0.0, 0.0]
[robots.B]
kind = "khepera4"
start = [0.6, 0.0]
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
    try:
        read(tmp_path / "small.toml")
    except DocumentError:
        assert not taken
    else:
        assert taken
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
