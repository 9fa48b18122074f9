"""What `zenpark sweep` does and prints."""

from __future__ import annotations

import json
import shlex
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.file.document import load
from experiments.sweep import table as sweep_table
from experiments.sweep.optimise import Tuned, tune
from experiments.sweep.sweep import Found, sweep
from experiments.sweep.table import Row
from tools.commands.progress import Bar
from tools.commands.run import sound


@dataclass(frozen=True)
class Request:
    """What stands on the command line; see `zenpark sweep --help`."""

    file: str
    given: Sequence[str]
    settings: Sequence[str]
    cases: Sequence[str]
    out: str | None
    scheduler: str | None
    processes: int | None
    optimize: str | None
    as_json: bool
    anyway: bool
    report: bool
    open_report: bool

    @property
    def line(self) -> str:
        """How to do it again."""
        parts = ["zenpark", "sweep", self.file, *self.given]
        parts += [part for case in self.cases for part in ("--case", case)]
        parts += [part for setting in self.settings for part in ("--set", setting)]
        parts += ["--optimize", self.optimize] if self.optimize else []
        return shlex.join(parts)


def command(asked: Request) -> int:
    """Returns the exit code: 0, 1 if runs failed or no limits were kept, 2 if the check finds errors, 130 on Ctrl-C."""
    if not sound(load(asked.file, *asked.settings), asked.settings, seeds=2) and not asked.anyway:
        print("zenpark: not run; mend the file (`zenpark check` says more), or run it --anyway", file=sys.stderr)
        return 2
    return _swept(asked) if asked.optimize is None else _tuned(asked, asked.optimize)


def _swept(asked: Request) -> int:
    with Bar() as bar:
        found = sweep(
            asked.file,
            asked.given,
            settings=asked.settings,
            cases=asked.cases,
            out=asked.out,
            scheduler=asked.scheduler,
            processes=asked.processes,
            tell=lambda done, of: bar.show("runs", done, of),
        )
    table = sweep_table.document(found.read.experiment.title, found.seeds, found.rows)
    _keep(found.folder, found.rows, table)
    page = _page(asked, found) if asked.report and found.rows else None
    if asked.as_json:
        print(json.dumps(table))
    else:
        print(found)
        _tell(found.folder, found.notes, page)
    for failure in found.failures[:3]:
        print(f"failed: {failure}", file=sys.stderr)
    if found.missing:
        print(f"interrupted: {found.missing} runs are missing; the same command goes on from here", file=sys.stderr)
        return 130
    _open(asked, page)
    return 1 if found.failures else 0


def _tuned(asked: Request, wished: str) -> int:
    try:
        with Bar() as bar:
            tuned = tune(
                asked.file,
                asked.given,
                wished,
                settings=asked.settings,
                cases=asked.cases,
                out=asked.out,
                scheduler=asked.scheduler,
                processes=asked.processes,
                tell=lambda case, done, of: bar.show(f"{case}: tried", done, of),
            )
    except KeyboardInterrupt:
        print("interrupted: what was tried is kept; the same command goes on from there", file=sys.stderr)
        return 130
    table = sweep_table.document(
        tuned.read.experiment.title, tuned.seeds, tuned.rows, tuning=list(tuned.tuning), wish=wished
    )
    _keep(tuned.folder, tuned.rows, table)
    sweep_table.write_csv(tuned.folder / "tried.csv", tuned.tried)
    page = _page(asked, tuned) if asked.report else None
    if asked.as_json:
        print(json.dumps(table))
    else:
        print(f"tuned on seeds {_ends(tuned.tuning)}, reported on seeds {_ends(tuned.seeds)}")
        print("\n".join(sweep_table.text(tuned.rows)))
        for row in (row for row in tuned.rows if not row.reference):
            limits = ", ".join(map(str, tuned.wish.limits))
            print(f"{row.label}: {'keeps' if tuned.wish.kept(row) else 'DOES NOT KEEP'} {limits}")
        _tell(tuned.folder, tuned.notes, page)
    _open(asked, page)
    return 0 if all(row.reference or tuned.wish.kept(row) for row in tuned.rows) else 1


def _keep(folder: Path, rows: Sequence[Row], table: dict[str, Any]) -> None:
    sweep_table.write_csv(folder / "sweep.csv", rows)
    sweep_table.write_json(folder / "sweep.json", table)


def _page(asked: Request, found: Found | Tuned) -> Path:
    from experiments.sweep import page as pages  # noqa: PLC0415 - matplotlib takes 0.6 s

    return pages.write(found, asked.line) if isinstance(found, Found) else pages.write_tuned(found, asked.line)


def _tell(folder: Path, notes: Sequence[str], page: Path | None) -> None:
    for note in notes:
        print(f"note: {note}")
    print(f"table: {folder / 'sweep.csv'}, {folder / 'sweep.json'}")
    if page is not None:
        print(f"page: {page}")


def _open(asked: Request, page: Path | None) -> None:
    if asked.open_report and page is not None:
        webbrowser.open(page.resolve().as_uri())


def _ends(seeds: Sequence[int]) -> str:
    return str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
