"""The JSON schema of the experiment file, for editors: completion, units and errors while typing.

Draft 7, because Taplo (the TOML extension of most editors) misreads the tuples of later drafts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from math import inf
from pathlib import Path as File
from typing import Any, Final

import msgspec

from agents.body.kinds import KINDS
from agents.plugins import files, registry
from experiments.definition.experiment import TARGETS, Experiment
from experiments.file.choices import group_of, struct_of
from experiments.file.completion import ALONE
from experiments.file.consistency.whole import judged_metrics
from experiments.file.overrides import SHAPE
from experiments.file.problems import Path
from experiments.file.text import MAX_NUMBER

_OWNERS: Final[dict[str, Path]] = {  # structs with a choice of a plug-in, and where each stands in a file
    "Experiment": (),
    "Formation": ("formation",),
    "LegTable": ("timeline", 0),
    "Obstacle": ("arena", "obstacles", "any"),
    "WorldTable": ("world",),
}
CASE: Final = "InCase"
SHAPES: Final = ("box", "radius", "wall")  # shapes of an obstacle, likewise
WORD: Final = 2**63  # integers lie below it, and not below its negative


def schema() -> dict[str, Any]:
    """The schema, with every plug-in that is installed and can be used; `unusable` names the others.

    It takes what the parser takes, and little else: 3.0 is a whole number to JSON, and relations between tables, such
    as links to robots that there are, are beyond it.
    """
    whole = described()
    _exclude(whole["definitions"])
    return dict(msgspec.json.decode(msgspec.json.encode(_bounded(whole))))  # plain lists and tables


def described() -> dict[str, Any]:
    """The schema without the bounds of all numbers and names, and without choices between fields."""
    _, definitions = msgspec.json.schema_components([Experiment], ref_template="#/definitions/{name}")
    definitions = {name: _draft7(each) for name, each in definitions.items()}
    for owner, path in _OWNERS.items():
        fields = definitions[owner]["properties"]
        for name, field in fields.items():
            if (group := group_of((*path, name))) is not None:
                kept = {key: field[key] for key in ("description", "default") if key in field}
                fields[name] = {**kept, **_choice(group, definitions)}
    for name, field in definitions["LinkChannelTable"]["properties"].items():  # same as at the channel
        field["description"] = definitions["ChannelTable"]["properties"][name]["description"]
    definitions["Formation"]["properties"]["links"]["additionalProperties"]["anyOf"].append({"enum": [SHAPE, ALONE]})
    definitions["RobotTable"]["properties"]["kind"]["enum"] = [kind.name for kind in KINDS.usable()]
    judged = definitions["Criterion"]["properties"]["metric"]
    judged["anyOf"] = [{"enum": judged_metrics()}, {"type": "string", "pattern": f"^{files.CHOICE}$"}]
    partial = {name + CASE: _partial(each) for name, each in definitions.items()}
    for key in ("cases", "criteria", "metrics"):
        del partial["Experiment" + CASE]["properties"][key]
    case = {"$ref": f"#/definitions/Experiment{CASE}"}
    definitions["Experiment"]["properties"]["cases"]["additionalProperties"] = case
    top = definitions.pop("Experiment")  # written in full: a reference would hide its neighbours from draft-7 readers
    whole = {"$schema": "http://json-schema.org/draft-07/schema#", **top, "definitions": definitions | partial}
    return dict(msgspec.to_builtins(whole))


def _exclude(definitions: dict[str, Any]) -> None:
    """Adds the choices between fields of which one is given: in a case none may be, the file has it."""
    for name, fields in (("TargetTable", TARGETS), ("LinkTable", TARGETS), ("Obstacle", SHAPES)):
        several = [{"required": list(pair)} for pair in combinations(fields, 2)]
        for each in (name, name + CASE):
            definitions[each]["not"] = {"anyOf": several}
    for owner, key, elsewhere, fields in (
        ("Formation", "links", "shape", TARGETS), ("ChangeTable", "links", "shape", TARGETS),
        ("Arena", "obstacles", "file", SHAPES),
    ):  # fmt: skip
        one = {"anyOf": [{"not": {"type": "object"}}, *({"required": [field]} for field in fields)]}
        definitions[owner] |= {
            "if": {"not": {"required": [elsewhere]}},
            "then": {"properties": {key: {"additionalProperties": one}}},
        }


def _bounded(node: Mapping[str, Any]) -> dict[str, Any]:
    """The same with bounds of all numbers, and with names that do not end with a line end."""
    result = map_children(node, _bounded)
    largest = {"number": MAX_NUMBER, "integer": WORD - 1}.get(str(node.get("type")))
    if largest is not None:
        if not {"minimum", "exclusiveMinimum"} & node.keys():
            result["minimum"] = -largest
        if not {"maximum", "exclusiveMaximum"} & node.keys():
            result["maximum"] = largest
    if str(node.get("pattern", "")).endswith("$"):
        result["not"] = {"pattern": "\n"}
    return result


def unusable() -> list[str]:
    """Plug-ins that the schema leaves out: a line for each, with the reason and the remedy."""
    return registry.unusable(lambda group, name: KINDS[name] if group == registry.ROBOTS else _parameters(group, name))


def write_schema(path: File) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(schema()), indent=2) + b"\n")


def _choice(group: str, definitions: dict[str, Any]) -> dict[str, Any]:
    """A plug-in by name, if it needs no parameters, or as a table with its `kind`."""
    bare, tables = [], []
    for name in registry.names(group):
        try:
            own = table_of(group, name, definitions)
        except registry.PluginError:
            continue
        if own["required"] == ["kind"]:
            bare.append(name)
        tables.append(own)
    beside = {"type": "string", "pattern": f"^{files.CHOICE}$", "description": "a class in a file beside this one"}
    tables.append({"type": "object", "properties": {"kind": beside}, "required": ["kind"]})
    return {"anyOf": [*([{"enum": bare}] if bare else []), beside, *tables]}


def table_of(group: str, name: str, definitions: dict[str, Any]) -> dict[str, Any]:
    """The table of a plug-in, its parts among the `definitions`; raises PluginError if it cannot be used."""
    reference, parts = _parameters(group, name)
    own = _draft7(parts.pop(reference["$ref"].rpartition("/")[2]))
    definitions.update({part: _draft7(each) for part, each in parts.items()})
    own["properties"] = {"kind": {"const": files.plain(name)}, **own.get("properties", {})}
    own["required"] = ["kind", *own.get("required", [])]
    return own


def _parameters(group: str, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reference to the parameters of a plug-in, and the definitions that they need.

    Raises PluginError if the plug-in cannot be used, or no file can have a parameter of the type.
    """
    chosen = struct_of(group, name)
    try:
        (reference,), parts = msgspec.json.schema_components([chosen], ref_template="#/definitions/{name}")
    except (TypeError, NameError) as error:
        why = str(error).splitlines()[-1]  # remedies for programs stand before it
        raise registry.PluginError(f"plug-in {name!r} ({chosen.__module__}:{chosen.__name__}): {why}") from error
    return reference, parts


def _draft7(node: Mapping[str, Any]) -> dict[str, Any]:
    """Tuples as draft 7 writes them; an infinite default, which no file can have, is none."""
    result = map_children(node, _draft7)
    if result.get("default") == inf:
        del result["default"]
    if "prefixItems" in result:
        result["items"], result["additionalItems"] = result.pop("prefixItems"), False
    return result


def _partial(node: Mapping[str, Any]) -> dict[str, Any]:
    """The same with nothing required: a case holds only what it changes."""
    result = map_children(node, _partial)
    if "$ref" in result:
        result["$ref"] += CASE
    return {key: value for key, value in result.items() if key not in ("required", "default")}


def map_children(node: Mapping[str, Any], change: Callable[[Mapping[str, Any]], dict[str, Any]]) -> dict[str, Any]:
    """A node with every node right below it changed."""
    result: dict[str, Any] = {}
    for key, value in node.items():
        if isinstance(value, dict):
            result[key] = change(value)
        elif isinstance(value, list):
            result[key] = [change(each) if isinstance(each, dict) else each for each in value]
        else:
            result[key] = value
    return result
