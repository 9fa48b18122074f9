"""Reference of the experiment file: each key with its text, unit, default, limits and an example.

Read off the JSON schema, that is, off the fields of the structs, plug-ins included. `./zenpark explain` and the
reference pages print the same entries.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec

from agents.body.kinds import KINDS, Kind
from agents.fields import description
from agents.plugins import files, registry
from agents.plugins.registry import split
from experiments.catalogue.index import FOLDER
from experiments.definition.experiment import Experiment
from experiments.file.choices import PLACES, group_of, struct_of, usable_metric
from experiments.file.json_schema import CASE, described, map_children, table_of

NONE: Final[Mapping[str, object]] = {}
_NAMES: Final = {  # tables with names as keys, and an example of such a name
    "robots": ("ROBOT", "CF01"), "disturbance": ("KIND", "crazyflie"), "hosts": ("HOST", "lab1"),
    "cases": ("CASE", "event"), "obstacles": ("OBSTACLE", "post"), "starts": ("PLACE", "left"),
    "links": ("LINK", '"TB01 > KH01"'), "anchors": ("ROBOT", "TB01"),
}  # fmt: skip
_LISTS: Final = ("timeline", "changes", "outages", "criteria")  # keys that are lists of tables
_LIMITS: Final = {
    "minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}",
    "pattern": "matches `{}`", "minProperties": "at least {} of them",
}  # fmt: skip
_TYPES: Final = {
    "number": "a number", "integer": "a whole number", "string": "a text", "boolean": "true or false",
    "object": "a table", "null": "",
}  # fmt: skip


class Entry(msgspec.Struct, frozen=True):
    """Key of the experiment file, with all that a reader needs."""

    key: str  # path with the names in capitals: robots.ROBOT.start; plug-ins: trigger(send-on-delta).threshold
    text: str
    type: str  # type, said in words
    limits: str  # limits, said in words; empty without any
    default: str  # default as it would be written; empty if there is none
    required: bool
    example: str  # lines of a file

    @property
    def words(self) -> tuple[str, ...]:
        """Parts of the key that a user types: without names in capitals and without plug-ins."""
        return tuple(part for part in re.sub(r"\([^)]*\)", "", self.key).split(".") if not part.isupper())


@cache
def entries() -> tuple[Entry, ...]:
    """Every key, tables before their keys, in the order of the structs."""
    whole = described()
    return tuple(_walk(_inlined(whole, whole["definitions"]), ""))


def _inlined(node: Mapping[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """A node of the schema with the definitions that it refers to in their places, except those of cases."""
    name = node.get("$ref", CASE).rpartition("/")[2]
    inner = {} if name.endswith(CASE) else definitions[name]
    own = {key: value for key, value in node.items() if key not in ("$ref", "definitions")}
    return map_children({**inner, **own}, lambda each: _inlined(each, definitions))


def matching(asked: str) -> list[Entry]:
    """Entries of a key as a user writes it, or of a kind of robot.

    Names may be real ones, in capitals, or left out; a plug-in stands in the place of its kind (`trigger.send-on-
    delta.threshold`) or is left out. The end of a key is enough if no key is meant in full, such as `plan.circle`,
    `circle`. A key of a table is followed by the keys of that table.
    """
    if asked in KINDS:
        return [_kind(KINDS[asked])]
    sought = "".join(f".{part}" for part in re.split(r"[.()\[\]]+", asked.strip().strip('"')) if part)
    end = sought.rpartition(".")[2]  # most patterns need not be compiled
    near = [entry for entry in entries() if sought and (end in entry.key or entry.key[-1].isupper())]
    found = [entry for entry in near if re.fullmatch("".join(map(_pattern, _split(entry.key))), sought)]
    if not found and end.isupper():  # a name of a table
        table = matching(sought.rpartition(".")[0])
        return table if any(re.match(rf"{re.escape(table[0].key)}\.[A-Z]", each.key) for each in table) else []
    if not found:
        ends = [entry for entry in near if _has_end(entry, sought)]
        found = sorted(ends, key=lambda entry: len(entry.words))
    tables = tuple(f"{entry.key}{sign}" for entry in found for sign in ".(")
    return found + [each for each in entries() if each.key.startswith(tables) and each not in found]


def in_file(choice: str) -> list[Entry]:
    """Entries of a class in a file of the current folder.

    Raises PluginError if there is no such file or class, or it is no plug-in with parameters.
    """
    try:
        name, _ = files.adopt(choice, Path.cwd())
    except ValueError as error:
        raise registry.PluginError(str(error)) from None
    faults = []
    for group in registry.STRUCTS:
        definitions: dict[str, Any] = {}
        try:
            table = table_of(group, name, definitions)
        except registry.PluginError as fault:
            faults.append(fault)
            continue
        return list(_keys_below(PLACES[group], "", {"anyOf": [_inlined(table, definitions)]}))
    try:
        metric = usable_metric(name)
        return [Entry(choice, metric.meaning, f"a metric: {metric.head}", "", "", False, f'metrics = ["{choice}"]')]
    except registry.PluginError as fault:
        faults.append(fault)
    bases = ", ".join(registry.BASES[group].partition(":")[2] for group in registry.NAMED_BY_FILE)
    none = registry.PluginError(f"{choice} must be a class that inherits from one of {registry.FACE}'s {bases}")
    raise next((each for each in faults if "must be a class" not in str(each)), none)


def unit(asked: str, experiment: Experiment) -> str:
    """Unit of a key as a user writes it; empty if it has none. A parameter has that of the plug-in in `experiment`."""
    path = re.sub(r"^cases\.[^.]+\.", "", asked)
    steps = [int(step) if step.isdigit() else step for step in path.split(".")]
    if (group := group_of(tuple(steps[:-1]))) is None:
        texts = [entry.text for entry in matching(path)]
    else:
        choice: Any = experiment
        for step in steps[:-1]:
            choice = getattr(choice, str(step)) if isinstance(choice, msgspec.Struct) else choice[step]
        texts = [description(struct_of(group, split(choice)[0]), str(steps[-1]))]
    found = [re.search(r"\[([^\]\s]+)\]", text) for text in texts]
    units = {each[1] if each and each[1] != "1" else "" for each in found}
    return units.pop() if len(units) == 1 else ""


def containing(asked: str) -> list[Entry]:
    """Entries that have every word of `asked` in their key or text."""
    words = re.findall(r"[a-z0-9]+", asked.lower())
    return [each for each in entries() if words and all(word in f"{each.key} {each.text}".lower() for word in words)]


def tables() -> list[Entry]:
    """The keys at the top of a file."""
    return [entry for entry in entries() if not set(entry.key) & set(".(")]


def _kind(kind: Kind) -> Entry:
    text = (
        f"A kind of robot that {'flies' if kind.flies else 'drives on wheels'} and takes a {kind.takes} as setpoint: "
        f"radius {kind.radius:g} m, height {kind.height:g} m, {kind.mass:g} kg, at most {kind.speed:.3g} m/s and "
        f"{kind.turn_rate:.3g} rad/s, {kind.endurance_s / 60.0:g} min with a full battery.\n\n"
        f"Its position controller closes an error at response = {kind.response:.3g} 1/s, of yaw at turn_response = "
        f"{kind.turn_response:.3g} 1/s; its velocity follows commands with lag = {kind.lag:.3g} s"
        + (f"; smallest turning radius {kind.turn_radius:.3g} m." if kind.turn_radius else ".")
    )
    chosen = f"kind = {written(kind.name)}"
    example = f"[robots.R01]\n{chosen}\nstart = [0.0, 0.0]" + "\nhover = 0.5" * kind.flies
    return Entry(f"robots.ROBOT.{chosen}", text, "a kind of robot", "", "", False, example)


def _split(key: str) -> list[str]:
    """Words, names in capitals, and plug-ins in parentheses."""
    return [part for part in re.split(r"\.|(\([^)]*\))", key) if part]


def _pattern(part: str) -> str:
    """Pattern of a part of a key: words as they are; names, and plug-ins in the place of their kind, if given."""
    if part.isupper():
        return r"(\.[^.]+)?"
    return rf"(\.{re.escape(part[1:-1])})?" if part[0] == "(" else rf"\.{part}"


def _has_end(entry: Entry, sought: str) -> bool:
    """Whether a key ends with `sought`, from a word or a plug-in on."""
    parts = _split(entry.key)
    patterns = [*map(_pattern, parts)]
    return any(re.fullmatch("".join(patterns[k:]), sought) for k in range(1, len(parts)) if not parts[k].isupper())


def _walk(node: Mapping[str, Any], path: str, needed: Mapping[str, object] = NONE) -> Iterator[Entry]:
    """Entries below a path; in a plug-in with the parameters that it cannot do without."""
    for name, field in node.get("properties", {}).items():
        if name == "kind" and {"const", "pattern"} & field.keys():  # kind of a plug-in
            continue
        key = f"{path}.{name}" if path else name
        yield _entry(key, field, name in node.get("required", []), needed)
        if key != "cases":  # a case repeats what stands above
            yield from _keys_below(key, name, field)


def _keys_below(key: str, name: str, field: Mapping[str, Any]) -> Iterator[Entry]:
    """Keys of the tables that a field can hold."""
    for inner in field.get("anyOf", [field]):
        if isinstance(more := inner.get("additionalProperties"), dict):
            named = f"{key}.{_NAMES.get(name, ('NAME', ''))[0]}"
            for each in more.get("anyOf", [more]):
                yield from _walk(each, named)
        elif inner.get("type") == "array" and isinstance(inner.get("items"), dict):
            yield from _walk(inner["items"], key)
        elif "kind" in inner.get("properties", {}) and "const" in inner["properties"]["kind"]:
            plugin = f"{key}({inner['properties']['kind']['const']})"
            text = _joined(inner.get("description", ""))
            needed = {each: _made(inner["properties"][each]) for each in inner.get("required", [])}
            needed.pop("kind", None)
            yield Entry(plugin, text, "a plug-in", "", "", False, _example(plugin, {}, needed))
            yield from _walk(inner, plugin, needed)
        else:
            yield from _walk(inner, key)


def _entry(key: str, field: Mapping[str, Any], required: bool, needed: Mapping[str, object]) -> Entry:
    text = _joined(field.get("description", ""))
    default = "" if "default" not in field or field["default"] is None else written(field["default"])
    example = _example(key, field, needed)
    return Entry(key, text, _type(field), _limits(field), default, required, example)


def _joined(text: str) -> str:
    """A docstring or description as paragraphs of one line each."""
    return "\n\n".join(" ".join(part.split()) for part in re.split(r"\n\s*\n", text.strip()))


def _type(field: Mapping[str, Any]) -> str:
    if "enum" in field:
        return "one of " + ", ".join(written(each) for each in field["enum"])
    if "anyOf" in field:
        kinds = dict.fromkeys(_type(each) for each in field["anyOf"])
        return " or ".join(kind for kind in kinds if kind)
    if field.get("type") == "array":
        items = field.get("items", {})
        each = items[0] if isinstance(items, list) and items else items
        least, most = field.get("minItems"), field.get("maxItems")
        count = f"{least} " if least == most and least else f"{least} to {most} " if most else ""
        many = {"number": "numbers", "integer": "whole numbers", "string": "texts", "array": "lists"}
        return f"a list of {count}{many.get(each.get('type', ''), 'tables')}"
    if isinstance(field.get("additionalProperties"), dict) and not field.get("properties"):
        return "a table of names"
    return _TYPES.get(str(field.get("type")), "a value")


def _limits(field: Mapping[str, Any]) -> str:
    options = [field, *field.get("anyOf", [])]
    found = [text.format(option[name]) for option in options for name, text in _LIMITS.items() if name in option]
    return ", ".join(dict.fromkeys(found))


def written(value: object) -> str:
    """A value as TOML writes it, on one line."""
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        pairs = ", ".join(f"{_quoted(key)} = {written(each)}" for key, each in value.items())
        return f"{{ {pairs} }}" if pairs else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(written(each) for each in value) + "]"
    return f"{value:g}" if isinstance(value, float) and not value.is_integer() else str(value)


def _example(key: str, field: Mapping[str, Any], needed: Mapping[str, object]) -> str:
    """Lines from a ready-made experiment, or else made of the default and the limits."""
    parts = _split(key)
    if found := [lines for document in _documents() for lines in _occurrences(document, parts, ())]:
        return min(found, key=len)
    value = field.get("default") or next(iter(field.get("examples", ())), None)
    made = _made(field) if value in (None, {}, [], math.inf) else value
    names = dict(_NAMES.values())
    path = [(names.get(part, "A"), None) if part.isupper() else (part, part in _LISTS) for part in parts]
    return _lines(path, made, needed)


@cache
def _documents() -> tuple[dict[str, Any], ...]:
    """The ready-made experiments."""
    return tuple(tomllib.loads(path.read_text("utf-8")) for path in sorted(FOLDER.glob("*.toml")))


Step = tuple[str, bool | None]  # a part of a key, and whether it is one of a list of tables


def _occurrences(value: object, parts: Sequence[str], path: tuple[Step, ...]) -> Iterator[str]:
    """The lines at which a document has a key."""
    if not parts:
        if not (isinstance(value, dict | list) and len(written(value)) > 80):
            yield _lines(path, value)
        return
    first, *later = parts
    if isinstance(value, list):
        for each in value:
            yield from _occurrences(each, parts, (*path[:-1], (path[-1][0], True)))
    elif not isinstance(value, dict):
        return
    elif first.startswith("("):
        if value.get("kind") == first.strip("()") and (not later or later[0] in value):  # complete: others may count
            yield from _occurrences(value, (), (*path, (first, None)))
    elif first.isupper():
        for name, each in value.items():
            yield from _occurrences(each, later, (*path, (_quoted(name), None)))
    elif first in value:
        yield from _occurrences(value[first], later, (*path, (first, None)))


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name) else written(name)


def _lines(path: Sequence[Step], value: object, needed: Mapping[str, object] = NONE) -> str:
    """A key and its value below the header of its table; a plug-in as a table in one line, with what it needs."""
    *tables, (last, _) = path
    if tables and tables[-1][0].startswith("("):
        kind = tables.pop()[0].strip("()")
        *tables, (owner, _) = tables
        last, value = owner, {"kind": kind, **needed, last: value}
    if last.startswith("("):
        *tables, (owner, _) = tables
        own = value if isinstance(value, Mapping) else needed
        last, value = owner, {"kind": last.strip("()"), **own}
    header = ".".join(name for name, _ in tables)
    many = bool(tables and tables[-1][1])
    return (f"[[{header}]]\n" if many else f"[{header}]\n" if header else "") + f"{last} = {written(value)}"


def _made(field: Mapping[str, Any]) -> object:
    """A value that the schema permits."""
    value: object = {"boolean": True, "string": "a text"}.get(str(field.get("type")), 1.0)
    if "enum" in field:
        value = field["enum"][0]
    elif "anyOf" in field:
        value = _made(next(each for each in field["anyOf"] if each.get("type") != "null"))
    elif field.get("type") == "array":
        items = field.get("items", {"type": "number"})
        each = items if isinstance(items, list) else [items] * max(1, field.get("minItems", 1))
        value = [_made(item) for item in each]
    elif field.get("type") == "object":
        needed = {name: _made(field["properties"][name]) for name in field.get("required", [])}
        more = field.get("additionalProperties")
        value = {"A": _made(more)} if not needed and isinstance(more, dict) else needed
    elif field.get("type") in {"number", "integer"}:
        least = field.get("minimum", field.get("exclusiveMinimum", 0))
        most = field.get("maximum", field.get("exclusiveMaximum", least + 2))
        number = (least + most) / 2 if most < least + 2 else least + 1
        value = int(number) if field["type"] == "integer" else number
    return value
