"""Arena files: one arena in a file of its own, with which the [arena] of an experiment begins.

`file = "lab.toml"` in [arena] names a TOML file beside the experiment file, or one of the catalogue. It holds the
single table [arena]; the experiment's own keys win over it, obstacles and start boxes merge by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import msgspec

from agents.errors import did_you_mean
from experiments.catalogue import index
from experiments.definition.experiment import Arena, FileTable
from experiments.file import structure
from experiments.file import text as syntax
from experiments.file.completion import LOOKED_AT
from experiments.file.consistency.arena import arena_faults
from experiments.file.problems import Fault, Text, refusal

KEPT: Final = "experiment.toml"  # name of the experiment in the folder of a run, in which its arena files lie as well
SUFFIX: Final = ".toml"  # unused by any other file there
_HERE: Final = ("arena", "file")
_BELONGS: Final = "belongs in the experiment file: an arena file holds nothing but [arena]"


class _Whole(FileTable, frozen=True):
    """Content of an arena file."""

    arena: Arena


@dataclass(frozen=True)
class ArenaFile(Text):
    """Arena file without errors."""

    name: str  # name in the experiment
    table: dict[str, Any]  # its [arena]


def arena_file_name(document: Mapping[str, Any]) -> str | None:
    arena = document.get("arena")
    name = arena.get("file") if isinstance(arena, dict) else None
    return name if isinstance(name, str) else None


def named_in(document: Mapping[str, Any], folder: Path, known: Iterable[ArenaFile]) -> ArenaFile | Fault | None:
    """The arena file that a document names, one of those `known` or as by `load`; None if it names none."""
    name = arena_file_name(document)
    return None if name is None else next((each for each in known if each.name == name), None) or load(name, folder)


def load(name: str, folder: Path) -> ArenaFile | Fault:
    """Reads and checks an arena file; if there is none of that name, the fault in the experiment file.

    Raises DocumentError with everything that is wrong in it.
    """
    file = index.file_beside(name, folder)
    if file is None:
        hint = "put it beside the experiment file, and give its name alone"
        return Fault(_HERE, f"{name!r} is no name of a file", hint)
    if name.lower() == KEPT or file.suffix.lower() != SUFFIX:
        why = f"does not end with {SUFFIX}" if name.lower() != KEPT else "is the experiment in the folder of a run"
        return Fault(_HERE, f"{name!r} {why}", f"call it otherwise, such as lab{SUFFIX}")
    label = str(file)
    try:
        text = syntax.content(file, label)
    except FileNotFoundError:
        hint = did_you_mean(name, _known_arena_files(folder))
        return Fault(_HERE, f"there is no arena file {label}", hint or "write one beside this file")
    try:
        content = syntax.parsed(text, label, json=False)
    except RecursionError:
        raise refusal(label, "tables or lists are nested too deeply", "flatten them") from None
    read = ArenaFile(label, text, is_json=False, name=name, table=content.get("arena", {}))
    read.refuse([*syntax.number_faults(content), *_faults_of_shape(content)])
    read.refuse(arena_faults(msgspec.convert(content, _Whole).arena, {}))
    return read


def _known_arena_files(folder: Path) -> list[str]:
    """Known arena files: those beside the experiment file (tables [arena], no robots), and those of the catalogue."""
    found = []
    for file in sorted(folder.glob("*.toml"))[:LOOKED_AT]:
        try:
            text = file.read_text("utf-8", errors="replace")
        except OSError:
            continue  # a folder, or without permission to read
        if "[arena" in text and "[robots" not in text:
            found.append(file.name)
    return list(dict.fromkeys([*found, *index.arenas()]))


def _faults_of_shape(content: Mapping[str, Any]) -> Iterator[Fault]:
    """Faults by which the content is no arena file."""
    for fault in structure.faults(content, _Whole):
        if not fault.path:
            yield replace(fault, hint="write [arena] above its keys, such as size = [4.0, 4.0, 2.5]")
        elif fault.path[0] != "arena" or "belongs at the top" in fault.hint:
            above = fault.path[0] in Arena.__struct_fields__
            yield replace(fault, hint="write [arena] above it" if above else f"'{fault.path[-1]}' {_BELONGS}")
        else:
            yield fault
    arena = content.get("arena")
    if isinstance(arena, dict) and "file" in arena:
        yield Fault(_HERE, "an arena file cannot name another", "copy its tables from there", on_key=True)
