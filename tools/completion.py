"""Completion of arguments in a shell: experiments, cases, robots, paths of `--set`, folders of runs, benchmarks.

Each press of a key starts a process, so that nothing here may import numpy or check a file: it is only read.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from experiments.catalogue import index


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
    from agents.runtime import run_registry  # noqa: PLC0415 - help and other completion are quicker without

    return sorted({name for run in run_registry.runs() for name in run.robots})


def paths(context: typer.Context, incomplete: str) -> list[str]:
    """Paths of values that stand in the experiment that is named before, each with `=`, or with `.` for its table."""
    depth = incomplete.count(".")
    found = ["".join(path) for path in _paths(_document(context), depth)]
    return sorted(found)


def _paths(table: dict[str, Any], depth: int) -> Iterator[tuple[str, ...]]:
    for key, value in table.items():
        if not key.replace("_", "").replace("-", "").isalnum():
            continue  # a link: its name would have to be quoted
        if not isinstance(value, dict):
            yield (key, "=")
        elif depth == 0:
            yield (key, ".")
        else:
            yield from ((f"{key}.", *path) for path in _paths(value, depth - 1))


def _table(document: dict[str, Any], name: str) -> dict[str, Any]:
    found = document.get(name)
    return found if isinstance(found, dict) else {}


def _document(context: typer.Context) -> dict[str, Any]:
    """The experiment that is named before on the command line; empty if it cannot be read."""
    # behind an option that has no value yet, arguments are not told apart
    file = str(context.params.get("file") or next(iter(context.args), ""))
    place = index.FOLDER / f"{file}.toml" if file in index.names() else Path(file)
    try:
        return tomllib.loads(place.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
