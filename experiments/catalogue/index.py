"""Experiments that come with zenpark, one file each."""

from __future__ import annotations

from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent
SCHEMA: Final = "zenpark.schema.json"  # schema named by the first line of each entry; `./zenpark new` writes it
_ARENA: Final = ".arena.toml"  # how the names of arena files end here, which are no experiments


def names() -> list[str]:
    """Names of all entries, sorted."""
    return sorted(file.stem for file in FOLDER.glob("*.toml") if not file.name.endswith(_ARENA))


def titles() -> dict[str, str]:
    """Title of every entry, by name; nothing is checked, so that listing them imports no more."""
    import tomllib  # noqa: PLC0415 - help is quicker without

    return {name: str(tomllib.loads((FOLDER / f"{name}.toml").read_text("utf-8"))["title"]) for name in names()}


def arenas() -> list[str]:
    """Names of all arena files, sorted."""
    return sorted(file.name for file in FOLDER.glob(f"*{_ARENA}"))


def file_beside(name: str, folder: Path) -> Path | None:
    """The file of that plain name in a folder, or else in the catalogue; None if it is none, but a path or a blank."""
    if not name.strip() or "\0" in name or Path(name).name != name:
        return None
    return next((file for file in (folder / name, FOLDER / name) if file.is_file()), folder / name)


def find_file(name: str | Path) -> Path:
    """File of that name, or of the catalogue entry; a folder of the same name does not hide an entry."""
    file = Path(name)
    known = str(name) in names()
    try:
        return FOLDER / f"{name}.toml" if known and not file.is_file() else file
    except (OSError, ValueError):  # a name too long, or with a character that no name has
        return file
