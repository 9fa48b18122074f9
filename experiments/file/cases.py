"""Documents of the cases of a file: its text, the tables of the cases, `--set` and arena files, put together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from agents.errors import did_you_mean
from experiments.file import arena_file
from experiments.file.arena_file import ArenaFile
from experiments.file.choices import group_of
from experiments.file.overrides import Override, assign, merged
from experiments.file.problems import DocumentError, Fault, Problem, Text, nearest
from experiments.file.problems import Path as Keys

Table = dict[str, Any]
_ABOVE: Final = (("arena",), ("arena", "file"))  # changes after which the arena may begin with another file


@dataclass(frozen=True)
class Source(Text):
    """Text of an experiment with its changes and its arena files."""

    overrides: Sequence[Override] = ()
    arenas: dict[str, ArenaFile] = field(default_factory=dict)

    def located(self, fault: Fault) -> Problem:
        """A fault in the text, in an arena file or in a `--set`."""
        path = fault.path
        case, inside = (path[1], path[2:]) if path[:1] == ("cases",) and len(path) > 1 else ("", path)
        for override in reversed(self.overrides):
            whole = override.whole
            if path[: len(whole)] == whole or (override.case is None and inside[: len(whole)] == whole):
                return override.refused(fault.message, fault.hint).problems[0]
            if whole[: len(path)] == path and path not in self.places:
                return override.refused(fault.message, fault.hint).problems[0]
        stands, _ = nearest(self.places, path)
        file = self.arenas.get(str(case), self.arenas.get(""))
        if file is not None and len(nearest(file.places, inside)[0]) > len(stands) - (len(path) - len(inside)):
            return file.located(replace(fault, path=inside))
        return super().located(fault)


def resolve(source: Source, content: Table, folder: Path) -> tuple[dict[str | None, Table], dict[str, Table]]:
    """The document of the file, under None, and of each case, all with `--set`; and the tables of the cases.

    The keys of an arena file, which is in `folder` or the catalogue, are put below those of the [arena] of the
    experiment, where `--set` finds them. Only a change of which file that is must come first.
    """
    content, of_all = deepcopy(content), list[Override]()
    for override in source.overrides:
        if override.case is not None:
            assign(_case_tables(content).get(override.case, {}), override, part=True)
        elif override.path[0] == "cases":  # makes a case, or replaces one
            assign(content, override)
        else:
            of_all.append(override)
    tables, top = _case_tables(content), _without_cases(content)
    documents: dict[str | None, Table] = {None: deepcopy(top)}
    documents |= {name: deepcopy(merged(top, _without_cases(table))) for name, table in tables.items()}
    unused: dict[Override, list[str]] = {override: [] for override in of_all if override.path not in _ABOVE}
    for name, document in documents.items():
        changes = [*of_all, *(each for each in source.overrides if each.case is not None and each.case == name)]
        for override in (each for each in changes if each.path in _ABOVE):
            assign(document, override)
        _add_arena_file(source, document, name, folder)
        for override in (each for each in changes if each.path not in _ABOVE):
            known = assign(document, override)
            if known is None:
                unused.pop(override, None)
            elif override in unused:
                unused[override] += known
    if unused:
        raise DocumentError([_unused(override, known) for override, known in unused.items()])
    if "cases" in content:
        documents[None]["cases"] = content["cases"]
    return documents, tables


def _add_arena_file(source: Source, document: Table, case: str | None, folder: Path) -> None:
    """Merge the arena file into the [arena] of a document, which then names no file."""
    file = arena_file.named_in(document, folder, source.arenas.values())
    if isinstance(file, Fault):
        source.refuse([file if case is None else replace(file, path=("cases", case, *file.path))])
    elif file is not None:
        source.arenas[case or ""] = file
        table = {key: value for key, value in document["arena"].items() if key != "file"}
        document["arena"] = deepcopy(merged(file.table, table, ("arena",)))


def _unused(override: Override, known: Sequence[str]) -> Problem:
    """Problem of a parameter that no trigger, law or plan of the experiment has; they have those `known`."""
    end = next(end for end in range(1, len(override.path)) if group_of(override.path[:end]))
    parameter = str(override.path[end])
    message = f"no {override.path[end - 1]} of this experiment has a parameter '{parameter}'"
    return override.refused(message, did_you_mean(parameter, dict.fromkeys(known))).problems[0]


def each_once(found: Mapping[str | None, Sequence[Fault]], tables: Mapping[str, Table]) -> Iterator[Fault]:
    """Faults of the file, and those that a case adds to them, at the key of the case that causes them."""
    yield from found[None]
    for name, table in tables.items():
        for fault in found[name]:
            if fault in found[None]:
                continue
            own = _beginning(table, fault.path)
            message = fault.message
            if own != fault.path:
                message = f"in case '{name}', {'.'.join(map(str, fault.path))}: {message}"
            yield Fault(("cases", name, *own), message, fault.hint, fault.on_key and own == fault.path)


def _case_tables(document: Table) -> dict[str, Table]:
    """Tables of the cases; values that are no tables are left out."""
    cases = document.get("cases")
    return {name: table for name, table in cases.items() if isinstance(table, dict)} if isinstance(cases, dict) else {}


def _without_cases(table: Table) -> Table:
    return {key: value for key, value in table.items() if key != "cases"}


def _beginning(table: object, path: Keys) -> Keys:
    """The longest beginning of a path that leads somewhere in a table."""
    at: Any = table
    for length, step in enumerate(path):
        try:
            at = at[step]
        except (KeyError, IndexError, TypeError):
            return path[:length]
    return path
