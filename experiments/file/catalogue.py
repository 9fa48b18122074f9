"""Catalogue of ready-made experiments, and new files that begin as copies of them."""

from __future__ import annotations

import tomllib
from pathlib import Path

from agents.errors import did_you_mean
from experiments.catalogue import index
from experiments.file import arena_file
from experiments.file.arena_file import ArenaFile
from experiments.file.json_schema import write_schema
from experiments.file.problems import DocumentError, Fault, refusal
from experiments.file.text import reason


def path(name: str) -> Path:
    """The file of a catalogue entry; raises DocumentError if there is none of that name."""
    if name not in index.names():
        raise no_entry(name)
    return index.FOLDER / f"{name}.toml"


def copy_entry(name: str, target: Path) -> Path:
    """Copies a catalogue entry to a file or into a folder; see `write_new`."""
    source = path(name)
    return write_new(source.read_text("utf-8"), target / source.name if target.is_dir() else target, furnished=True)


def write_new(text: str, target: Path, *, furnished: bool = False) -> Path:
    """Writes a new experiment file and, beside it, the schema that its first line shows to editors.

    Args:
        furnished: The text is a catalogue entry's: the arena file that it names comes along.

    Raises:
        DocumentError: If the target exists or cannot be written, or another arena file of that name is there.
    """
    created = False
    try:
        beside = _arena_beside(text, target.parent) if furnished else None
        with target.open("x", encoding="utf-8") as new:
            created = True
            new.write(text)
        if beside is not None:
            (target.parent / beside.name).write_text(beside.text, encoding="utf-8")
        if not (target.parent / index.SCHEMA).exists():
            write_schema(target.parent / index.SCHEMA)
    except FileExistsError:
        hint = "choose another name; nothing was changed"
        raise refusal(str(target), "exists already", hint) from None
    except (OSError, ValueError) as error:
        if created:  # half of it would stand in the way of the next attempt
            target.unlink(missing_ok=True)
        hint = "choose a place that exists and may be written to"
        raise refusal(str(target), f"cannot be written: {reason(error)}", hint) from error
    return target


def _arena_beside(text: str, folder: Path) -> ArenaFile | None:
    """The arena file that an entry needs in a folder."""
    name = arena_file.arena_file_name(tomllib.loads(text))
    if name is None:
        return None
    wanted, place = arena_file.load(name, index.FOLDER), folder / name
    if isinstance(wanted, Fault):
        raise refusal(name, wanted.message, wanted.hint)
    if place.exists() and place.read_text("utf-8") != wanted.text:
        hint = "choose another folder, or rename that file; nothing was changed"
        raise refusal(str(place), "is another arena than that of the entry", hint)
    return wanted


def no_entry(name: str) -> DocumentError:
    """Error of a name that is neither a file nor an entry."""
    hint = f"{did_you_mean(name, index.names())} (./zenpark new copies one)"
    if name == "-":
        hint = "/dev/stdin is the standard input"
    return refusal(name, "neither a file nor an experiment of the catalogue", hint)
