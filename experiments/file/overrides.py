"""Changes to a document: those of a case, and those of `--set path=value` on the command line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Final

from agents.errors import did_you_mean
from experiments.definition.experiment import Experiment
from experiments.definition.links import pairs_or_none
from experiments.file.choices import Adopted, group_of, parameters
from experiments.file.problems import DocumentError, Path, refusal
from experiments.file.text import number_faults

_PART: Final = re.compile(r"\s*+(?:\"([^\"]*)\"|'([^']*)'|([^.\"']++))\s*+(?:\.|$)")
_KEY: Final = re.compile(rf"(?:{_PART.pattern})++(?<!\.)")
_SHAPES: Final = frozenset({"box", "radius", "wall"})
SHAPE: Final = "shape"  # a link with its target from [formation.shape]
_DEFAULTS: Final = Experiment(title="", robots={}, duration_s=1.0)


@dataclass(frozen=True, eq=False)
class Override:
    """A `--set`: a path into the document, or into the table of the only `case` that it is for."""

    flag: str
    path: Path
    value: Any  # value of the type that TOML gives it
    case: str | None

    @property
    def whole(self) -> Path:
        """Path from the top of the file."""
        return self.path if self.case is None else ("cases", self.case, *self.path)

    def refused(self, message: str, hint: str) -> DocumentError:
        return of_flag(self.flag, message, hint)


def of_flag(flag: str, message: str, hint: str) -> DocumentError:
    return refusal(f"--set {flag}", message, hint)


def parse_all(flags: Sequence[str], document: Mapping[str, Any], adopted: Adopted) -> list[Override]:
    """The changes, with files of plug-ins adopted; raises DocumentError with all that is wrong in them."""
    overrides, problems = [], []
    for flag in flags:
        try:
            override = parse(flag, document)
        except DocumentError as error:
            problems += error.problems
            continue
        value, faults = adopted.adopt(override.value, override.path)
        overrides.append(replace(override, value=value))
        for fault in [*number_faults(value, override.path), *faults]:
            problems += override.refused(fault.message, fault.hint).problems
    if problems:
        raise DocumentError(problems)
    return overrides


def parse(flag: str, document: Mapping[str, Any]) -> Override:
    """`path=value`; the shell may have eaten the quotes of a key, so blanks are part of one.

    Raises DocumentError if it is not of that form, or names a case that the document does not have.
    """
    key, equals, text = flag.partition("=")
    path = _path(key)
    if not equals or not path:
        raise of_flag(flag, "this is not of the form path=value", "write, for example, --set formation.gain=2.5")
    if not flag.isprintable():
        raise of_flag(flag, "this holds characters that are no text", "leave them out")
    case = None
    if path[0] == "cases" and len(path) > 2:
        cases = document.get("cases")
        known = cases if isinstance(cases, dict) else {}
        case, path = str(path[1]), path[2:]
        if not isinstance(known.get(case), dict):
            hint = did_you_mean(case, known) or "it has no [cases] at all"
            raise of_flag(flag, f"the file has no case '{case}'", hint)
    if path[0] == "timeline" and len(path) > 1 and re.fullmatch(r"[0-9]{1,6}", str(path[1])):
        path = (path[0], int(path[1]), *path[2:])
    return Override(flag, path, _typed(text.strip()), case)


def assign(document: dict[str, Any], override: Override, *, part: bool = False) -> list[str] | None:
    """Puts the value in its place; raises DocumentError if the path leads nowhere.

    A parameter of a trigger, law or plan is left alone where the kind that is chosen has no such parameter: `--set
    trigger.threshold=0.02` is for the cases that have a threshold.

    Args:
        part: `document` holds the changes of a case alone, so that any key may be missing.

    Returns:
        None, or the parameters that the kind has if this is none of them.
    """
    at: Any = document
    *way, last = override.path
    path: Path = ()
    for name in way:
        path = (*path, name)
        step, below = _known(at, name, path, override, part=part), override.path[len(path)]
        group = group_of(path)
        inside = at[step] if isinstance(at, list) else at.get(step)
        if inside is None and group and not part and len(path) <= 2:  # the file makes no choice there; no plan has one
            inside = attrgetter(".".join(map(str, path)))(_DEFAULTS)
        inside = {} if inside is None else _as_table(inside, path)
        if not isinstance(inside, dict | list):
            raise override.refused(f"'{step}' is no table, so it has no '{below}'", f"set {step} itself")
        known = parameters(group, str(inside.get("kind"))) if group and isinstance(inside, dict) else None
        if known is not None and not part and below not in ("kind", *known):
            return known
        at[step] = inside
        at = inside
    last = _known(at, last, override.path, override, part=True)
    if group_of(path) and last == "kind" and at.get("kind") != override.value:
        at.clear()
    at[last] = deepcopy(override.value)
    return None


def merged(document: Mapping[str, Any], changes: Mapping[str, Any], path: Path = ()) -> dict[str, Any]:
    """A document with the changes of a case: tables merge, everything else replaces.

    A trigger, law or plan of another kind replaces the whole table, because the parameters of the old kind mean nothing
    to the new one. An obstacle has one shape, and a new one replaces it. A link is the same link however it is written.
    """
    result = dict(document)
    for name, value in changes.items():
        key = _same_link(name, result) if path == ("formation", "links") else name
        here = (*path, key)
        old = _as_table(result.get(key), here) if isinstance(value, dict) else None
        if isinstance(old, dict) and here[:-1] == ("arena", "obstacles") and _SHAPES & value.keys():
            old = {part: each for part, each in old.items() if part not in _SHAPES}
        other = group_of(here) and isinstance(old, dict) and value.get("kind", old.get("kind")) != old.get("kind")
        result[key] = merged(old, value, here) if isinstance(old, dict) and not other else value
    return result


def _known(at: Any, step: str | int, path: Path, override: Override, *, part: bool) -> Any:  # noqa: ANN401
    """The step as the document knows it."""
    if isinstance(at, list):
        if not re.fullmatch(r"[0-9]{1,6}", str(step)) or int(step) >= len(at):
            raise override.refused(f"there is no '{step}' in '{path[-2]}'", f"it is a list: 0 to {len(at) - 1}")
        return int(step)
    if path[:-1] == ("formation", "links"):
        return _same_link(str(step), at)
    if path[0] == "robots" and len(path) == 2 and not part and step not in at:
        raise override.refused(f"no robot is called '{step}'", did_you_mean(str(step), at))
    return str(step)


def _as_table(value: object, path: Path) -> object:
    """The long form of what may be written short: a choice by its name, a link by its distance."""
    if group_of(path) and isinstance(value, str):
        return {"kind": value}
    if path[:-1] == ("formation", "links") and isinstance(value, int | float) and not isinstance(value, bool):
        return {"distance": value}
    if path[:-1] == ("formation", "links") and value == SHAPE:
        return {}
    return value


def _same_link(text: str, links: Mapping[str, Any]) -> str:
    """The key under which a document already has this link, or `text`."""
    ends = {*pairs_or_none(text)}
    return text if text in links or not ends else next((key for key in links if {*pairs_or_none(key)} == ends), text)


def _path(key: str) -> Path:
    """The parts of a dotted key; empty if it is none."""
    parts = [next(filter(None, groups), "").strip() for groups in _PART.findall(key)]
    return tuple(parts) if all(parts) and _KEY.fullmatch(key) else ()


def _typed(text: str) -> object:
    """A value as TOML reads it; else the bare text."""
    try:
        values = tomllib.loads(f"value = {text}")
    except ValueError:
        return text
    return values["value"] if len(values) == 1 else text
