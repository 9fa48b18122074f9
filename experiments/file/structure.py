"""Type check of a parsed document against the structs of an experiment; each error has its path.

`msgspec.convert` stops at the first error and does not tell which entry of a table it is in. The walk here goes down
the same annotations and lets msgspec judge one value at a time, so that everything is found, each with its path.
"""

from __future__ import annotations

import re
import types
from collections.abc import Iterator, Mapping, Sequence
from math import radians
from typing import Any, Final, Literal, Union, get_args, get_origin

import msgspec

from agents.errors import did_you_mean
from agents.fields import bare, fields_of, structs_in
from agents.plugins import files, registry
from experiments.definition.experiment import LONGEST_NAME, Experiment
from experiments.file.choices import group_of, parameters, struct_of
from experiments.file.problems import DocumentError, Fault, Path, Problem, key_name, refusal, shown

_REMEDY: Final = {  # remedy for a missing key
    "title": 'add title = "what this experiment shows"',
    "duration_s": "add duration_s = 30.0",
    "robots": 'add at least one: [robots.KH01] with kind = "khepera4" and start = [0.0, 0.0]',
    "start": "add start = [0.0, 0.0], in metres",
    "at_s": "add at_s = 0.0, in seconds after the common start",
    "robot": 'add robot = "..." with the name of one of the robots',
    "plan": 'add plan = { kind = "line", move_by = [0.5, 0.0], speed = 0.1 }',
}
_WORDS: Final = {
    "float": "a number", "int": "a whole number", "str": "text", "bool": "true or false", "array": "a list",
    "object": "a table",
}  # fmt: skip
_QUANTITY: Final = re.compile(r"\s*([-+]?\d+(?:[.,]\d*)?)\s*([a-zA-Z°/]*)\s*")  # number and unit
_UNITS: Final = {
    **dict.fromkeys(("", "s", "m", "hz", "rad", "m/s"), 1.0),
    **{"ms": 1e-3, "mm": 1e-3, "cm": 1e-2, "min": 60.0, "deg": radians(1.0), "°": radians(1.0)},
}  # same unit as SI
_UNIONS: Final = (Union, types.UnionType)
LINK: Final = 'write "{name}" = 0.5, in metres; or "{name}" = {{ offset = [0.5, 0.0] }}, or "{name}" = "shape"'
_FIELDS: Final = frozenset(Experiment.__struct_fields__)


def faults(document: Mapping[str, Any], struct: type[msgspec.Struct] = Experiment) -> list[Fault]:
    """All faults of type, range and key; empty if `msgspec.convert` takes the document."""
    found = table_faults(document, struct, ())
    found = [*_strangers(document, found)]
    strayed = {f"'{fault.path[-1]}' is missing" for fault in found if "belongs at the top" in fault.hint}
    return [fault for fault in found if fault.path or fault.message not in strayed]


def _strangers(document: Mapping[str, Any], found: Sequence[Fault]) -> Iterator[Fault]:
    """Faults, of which those that a robot lacks kind and start are one: it was to be another robot."""
    for fault in found:
        path, robots = fault.path, document.get("robots")
        table = robots.get(path[1]) if path[:1] == ("robots",) and len(path) == 2 and isinstance(robots, dict) else None
        if not isinstance(table, dict) or {"kind", "start"} & table.keys() or len(robots) < 2:  # type: ignore[arg-type]
            yield fault
        elif fault.message.startswith("'kind' is missing"):
            others = [name for name in robots if name != path[1]]  # type: ignore[union-attr]
            hint = f"{did_you_mean(str(path[1]), others)}; to add a robot give it kind and start"
            yield Fault(path, f"no robot is called '{path[1]}'", hint, on_key=True)
        elif not fault.message.startswith("'start' is missing"):
            yield fault


def _value(value: object, annotation: object, path: Path, note: str) -> list[Fault]:
    group = group_of(path)
    if group is not None and isinstance(value, str | dict):
        return _choice(value, group, path)
    plain, meta = bare(annotation)
    note = meta.description or note
    inner: list[Fault] = []
    if structs_in(plain) == [plain]:
        return table_faults(value, plain, path) if isinstance(value, dict) else [_no_table(value, path)]
    if get_origin(plain) is dict:
        if not isinstance(value, dict):
            return [_no_table(value, path)]
        of_key, of_value = get_args(plain)
        for key, each in value.items():
            inner += _key(key, of_key, (*path, key)) or _value(each, of_value, (*path, key), note)
    elif _many(plain) and isinstance(value, dict):
        header = ".".join(map(str, path))
        return [
            Fault(path, f"'{key_name(path)}' must be a list, not a table", f"write [[{header}]], with two brackets")
        ]
    elif _many(plain) and isinstance(value, list):
        for number, each in enumerate(value):
            inner += _value(each, get_args(plain)[0], (*path, number), note)
    elif get_origin(plain) in _UNIONS and isinstance(value, dict):
        tables = structs_in(plain)
        if len(tables) == 1 or (tables and tables[0].__struct_config__.tag_field is not None):
            return _one_table(value, tables, path)
    return inner or _judged(value, annotation, path, note)


def _many(plain: object) -> bool:
    """Whether an annotation is that of a list of any length, or of a tuple, which a frozen struct has in its place."""
    return get_origin(plain) is list or (get_origin(plain) is tuple and get_args(plain)[-1] is ...)


def table_faults(
    value: Mapping[str, Any], struct: type[msgspec.Struct], path: Path, plugin: tuple[str, str] | None = None
) -> list[Fault]:
    """A table against a struct: unknown keys, missing keys, then each value, then the struct's own checks.

    Args:
        plugin: Group and kind, if these are a plug-in's parameters.
    """
    fields = fields_of(struct)
    found, guessed = [], set()
    for key in value:
        if key not in fields:
            hint = did_you_mean(key, fields)
            guessed |= {name for name in fields if hint == f"did you mean '{name}'?"}
            found.append(_unknown_key(key, hint, path, plugin))
    for name, field in fields.items():
        if name in value:
            plain = isinstance(field.default, bool | int | float | str)
            found += _value(
                value[name], field.type, (*path, name), f"left out: {shown(field.default)}" if plain else ""
            )
        elif field.required and name not in guessed:
            hint = _REMEDY.get(name) or f"add {name} = ... ({bare(field.type)[1].description or ''})"
            found.append(Fault(path, f"'{name}' is missing{_place_in_file(path)}", hint))
    return found or _own_checks(value, struct, path)


def _one_table(value: Mapping[str, Any], tables: Sequence[type[msgspec.Struct]], path: Path) -> list[Fault]:
    """A table against a struct, of several the one that its tag names."""
    field = tables[0].__struct_config__.tag_field
    if field is None:
        return table_faults(value, tables[0], path)
    by_tag = {str(table.__struct_config__.tag): table for table in tables}
    tag = value.get(field)
    if tag not in by_tag:
        known = ", ".join(by_tag)
        if tag is None:
            return [Fault(path, f"'{field}' is missing{_place_in_file(path)}", f"add {field} = ...; known: {known}")]
        return [Fault((*path, field), f"'{field}' cannot be {shown(tag)}", did_you_mean(str(tag), by_tag))]
    fields = {key: each for key, each in value.items() if key != field}
    return table_faults(fields, by_tag[str(tag)], path)


def _unknown_key(key: str, hint: str, path: Path, plugin: tuple[str, str] | None) -> Fault:
    """Fault of an unknown key; the hint names another table or plug-in that has it."""
    if plugin is not None:
        group, kind = plugin
        if others := [repr(other) for other in _kinds_with(group, [key])]:
            hint = f"it is a parameter of {', '.join(others)}"
        return Fault((*path, key), f"unknown parameter '{key}' of {kind!r}", hint, on_key=True)
    if path and key in _FIELDS:
        hint = f"'{key}' belongs at the top of the file, above the first [table]"
    return Fault((*path, key), f"unknown key '{key}'{_place_in_file(path)}", hint, on_key=True)


def _choice(value: str | dict[str, Any], group: str, path: Path) -> list[Fault]:
    """Faults of a plug-in choice and its parameters."""
    known, what = registry.names(group), group.rpartition(".")[2]
    if isinstance(value, dict) and not isinstance(value.get("kind"), str):
        for key in value:
            if key != "kind" and (hint := did_you_mean(key, ["kind"])).startswith("did you mean"):
                message = f"unknown key '{key}' in '{key_name(path)}', which lacks its kind"
                return [Fault((*path, key), message, hint, on_key=True)]
        likely = _kinds_with(group, [key for key in value if key != "kind"])
        hint = f'add kind = "{likely[0]}"' if likely else f'add kind = "..."; known: {", ".join(known)}'
        return [Fault((*path, "kind"), f"'{key_name(path)}' needs its kind, as text", hint)]
    kind, where = (value, path) if isinstance(value, str) else (value["kind"], (*path, "kind"))
    given = {} if isinstance(value, str) else {key: each for key, each in value.items() if key != "kind"}
    if kind not in known and not files.is_choice(kind):
        hint = f"write '{kind}:CLASS' for a class of that file" if kind.endswith(".py") else did_you_mean(kind, known)
        return [Fault(where, f"no {shown(kind)} among the {what}", hint)]
    try:
        struct = struct_of(group, kind)
    except registry.PluginError as error:
        hint = "mend that file" if files.is_choice(kind) else "repair or uninstall it"
        return [Fault(where, str(error), f"{hint}, or choose another of the {what}")]
    return table_faults(given, struct, path, (group, kind))


def _kinds_with(group: str, keys: Sequence[str]) -> list[str]:
    """Plug-ins that have all these parameters."""
    return [kind for kind in registry.names(group) if set(keys) <= set(parameters(group, kind))]


def _own_checks(value: Mapping[str, Any], struct: type[msgspec.Struct], path: Path) -> list[Fault]:
    """Faults of a table with values that are right one by one; the struct's own check names fields in words alone."""
    try:
        msgspec.convert(value, struct)
    except msgspec.ValidationError as error:
        text, _, hint = str(error).partition(" - at `")[0].partition("; ")
        named = [name for name in fields_of(struct) if name in value and re.search(rf"\b{re.escape(name)}\b", text)]
        return [Fault((*path, *named[:1]), text, hint)]
    return []


def _judged(value: object, annotation: object, path: Path, note: str) -> list[Fault]:
    """Faults that msgspec finds in a value, in words."""
    try:
        msgspec.convert(value, annotation)
    except msgspec.ValidationError as error:
        text, _, where = str(error).partition(" - at `")
        for step in re.findall(r"\[(\d+)\]", where):
            path, value = (*path, int(step)), value[int(step)] if isinstance(value, list) else None
        return [_in_words(text, value, annotation, path, note)]
    return []


def _in_words(text: str, value: object, annotation: object, path: Path, note: str) -> Fault:
    name = key_name(path)
    plain, _ = bare(annotation)
    literals = [part for part in (plain, *get_args(plain)) if get_origin(part) is Literal]
    if literals and (literals[0] is plain or (isinstance(value, str) and get_origin(plain) in _UNIONS)):
        words = [str(word) for part in literals for word in get_args(part)]
        return Fault(path, f"'{name}' cannot be {shown(value)}", did_you_mean(str(value), words))
    match = re.fullmatch(r"Expected `([^`]+)`(.*?)(?:, got `.*`)?", text)
    if match is None:
        return Fault(path, f"'{name}': {text}", note)
    wanted = [_WORDS.get(word, word) for word in match[1].split(" | ") if word != "null"]
    limit = re.sub(r"\.0$", "", match[2])
    if "matching regex" in limit:
        limit = " of letters, digits and _ that begins with a letter"
    if isinstance(value, bool) or not isinstance(value, list | dict):
        limit += f", not {shown(value)}"
    if path[:2] == ("formation", "links"):
        return Fault(path, f"'{name}' must be {' or '.join(wanted)}{limit}", LINK.format(name=name))
    if path[-2:-1] == ("shape",) and isinstance(value, list):
        message = f"'{name}' must be numbers, x, y (, z) [m], not {shown(value)}"
        return Fault(path, message, f"write {name} = [0.5, 0.0]")
    if isinstance(value, str) and {_WORDS["float"], _WORDS["int"], _WORDS["array"]} & {*wanted}:
        note = _number_meant(value, name) or note
    for table in structs_in(plain)[:1] if not isinstance(value, dict) else []:
        fields = fields_of(table)
        needed = [name for name, field in fields.items() if field.required] or [next(iter(fields))]
        form = ", ".join(f"{field} = ..." for field in needed)
        note = f"write {name} = {{ {form} }}: {note}" if note else f"write {name} = {{ {form} }}"
    return Fault(path, f"'{name}' must be {' or '.join(wanted)}{limit}", note)


def _number_meant(text: str, name: str) -> str:
    """Remedy for a text that holds a number with a unit or a comma, or a list of numpy's numbers; empty for others."""
    if "np.float64(" in text:
        return "numbers of numpy 2 print so; use float(...) of each before"
    match = _QUANTITY.fullmatch(text)
    factor = _UNITS.get(match[2].lower()) if match else None
    if match is None or factor is None:
        return ""
    number = f"{float(match[1].replace(',', '.')) * factor:g}"
    return f"write {name} = {number if '.' in number or 'e' in number else number + '.0'}, without unit and quotes"


def _key(key: str, annotation: object, path: Path) -> list[Fault]:
    if len(key) > LONGEST_NAME and path[0] in ("robots", "spares", "cases", "hosts"):
        message = f"a name of {len(key)} letters is too long"
        return [Fault(path, message, f"use at most {LONGEST_NAME}", on_key=True)]
    if _judged(key, annotation, path, "") or "\n" in key:  # `$` of a pattern lets a last line end pass
        what = "letters, digits and _ . -" if path[0] == "cases" else "letters, digits and _, beginning with a letter"
        return [Fault(path, f"{shown(key)} cannot be a name", f"use {what}", on_key=True)]
    return []


def _no_table(value: object, path: Path) -> Fault:
    header = ".".join(map(str, path))
    if isinstance(value, list) and path == ("robots",):
        return Fault(path, "'robots' must be tables with names", "write [robots.KH01], one header for each robot")
    return Fault(path, f"'{key_name(path)}' must be a table, not {shown(value)}", f"write [{header}] above its keys")


def _place_in_file(path: Path) -> str:
    return f" in '{key_name(path)}'" if path else ""


OBJECT: Final = "write an object, '{\"name\": value}'"


def parse_object(flag: str, text: str, struct: type[msgspec.Struct] | None = None) -> dict[str, Any]:
    """JSON object of a command-line flag; raises DocumentError if it is no JSON, no object, or not what it must be.

    Args:
        struct: Its type; None: any object.
    """
    place = f"{flag} {text}"
    try:
        value = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        why = str(error).removeprefix("JSON is malformed: ")
        raise refusal(place, f"is not JSON: {why}", OBJECT) from None
    if not isinstance(value, dict):
        raise refusal(place, "is no JSON object", OBJECT)
    found = [] if struct is None else faults(value, struct)
    if found:
        raise DocumentError([Problem(place, 0, 0, fault.message, fault.hint) for fault in found])
    return value
