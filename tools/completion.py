"""Completion of arguments in a shell: experiments, cases, robots, paths of `--set`, folders of runs, benchmarks.

Each press of a key starts a process, so that nothing here may import numpy or check a file: it is only read.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import typer

from experiments.catalogue import index

ROOT: Final = Path(__file__).resolve().parents[1]
SITE_PACKAGES: Final = Path(typer.__file__).parents[1]
FIND_KEYS: Final = """
import re
from experiments.file.reference import entries
keys = {re.sub(r"\\([^)]*\\)", "", each.key): not each.type.startswith("a table") for each in entries()}
print(*(key for key, is_value in keys.items() if is_value and ".LINK" not in key), sep="\\n")
"""


def experiments(incomplete: str) -> list[str]:
    """Experiments of the catalogue, and experiment files below the folder that is typed."""
    folder = incomplete.rpartition("/")[0]
    files = sorted(Path(folder or ".").glob("*.toml"))
    return [*index.names(), *(str(file) for file in files if not file.name.endswith(".arena.toml"))]


def folders(incomplete: str) -> list[str]:
    """Folders of runs: those with a `run.json` in `runs`, and in the folder that is typed."""
    places = [Path("runs"), Path(incomplete.rpartition("/")[0] or ".")]
    return sorted({str(found.parent) for place in places for found in place.glob("*/run.json")})


def cases(context: typer.Context) -> list[str]:
    """Cases of the experiment that is named before."""
    return list(_table(_document(context), "cases"))


def members(context: typer.Context) -> list[str]:
    """Robots of the experiment that is named before."""
    return list(_table(_document(context), "robots"))


def robots() -> list[str]:
    """Robots of the runs that are up on this machine."""
    from experiments.real_time.hosts import run_registry  # noqa: PLC0415 - help and other completion are quicker without

    return sorted({name for run in run_registry.runs() for name in run.robots})


def paths(context: typer.Context, incomplete: str) -> list[str]:
    """Paths of values that the experiment that is named before may have, each with `=`, or with `.` for its table."""
    document = _document(context)
    *above, _ = incomplete.split(".")
    depth, found = len(above), set()
    if above[:1] == ["cases"] and depth > 1:  # a case may override every key
        prefix, above = above[:2], above[2:]
        document = {**document, **_table(_table(document, "cases"), prefix[1])}
    else:
        prefix = []
    known = [path for key in _keys() for path in _named(key.split("."), document)]
    for key in (*_leaves(document), *known):
        if len(key) > len(above) and list(key[: len(above)]) == above:
            found.add(".".join([*prefix, *key[: len(above) + 1]]) + ("=" if len(key) == len(above) + 1 else "."))
    return sorted(found)


def _leaves(table: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Paths of the values of a table; links are left out: their names would have to be quoted."""
    for key, value in table.items():
        if key.replace("_", "").replace("-", "").isalnum():
            yield from ((key, *path) for path in (_leaves(value) if isinstance(value, dict) else ((),)))


def _named(key: Sequence[str], document: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """A key of the reference, with the names of the experiment in the place of those in capitals."""
    if not key:
        yield ()
        return
    first, *rest = key
    for name in document if first.isupper() else (first,):
        if not first.isupper() or name.isidentifier():
            yield from ((name, *path) for path in _named(rest, _table(document, name)))


def _keys() -> list[str]:
    """Keys of the experiment file, plug-ins' included, as the reference has them.

    Finding them takes a second, so that a process of its own does it, once for each state of code and packages.
    """
    from agents.user_folder import runtime_folder  # noqa: PLC0415 - other completion is quicker without

    places = [*(ROOT / "experiments" / "definition").glob("*.py"), SITE_PACKAGES]
    try:
        kept = runtime_folder() / f"keys-{max(place.stat().st_mtime_ns for place in places):x}.txt"
        if not kept.exists():
            found = subprocess.run(
                [sys.executable, "-c", FIND_KEYS], cwd=ROOT, capture_output=True, text=True, check=True, timeout=20.0
            )
            part = kept.with_suffix(f".{os.getpid()}")
            part.write_text(found.stdout, "utf-8")
            part.replace(kept)
        return kept.read_text("utf-8").split()
    except (OSError, subprocess.SubprocessError):
        return []


def _table(document: dict[str, Any], name: str) -> dict[str, Any]:
    found = document.get(name)
    return found if isinstance(found, dict) else {}


def _document(context: typer.Context) -> dict[str, Any]:
    """The experiment that is named before on the command line; empty if it cannot be read."""
    import tomllib  # noqa: PLC0415 - help is quicker without

    # behind an option without a value, arguments are not distinguished
    file = str(context.params.get("file") or next(iter(context.args), ""))
    place = index.FOLDER / f"{file}.toml" if file in index.names() else Path(file)
    try:
        return tomllib.loads(place.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
