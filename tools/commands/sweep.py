"""`zenpark sweep`: cases x values x seeds in virtual time, or a search for the best values."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from tools.commands.options import Anyway, AsJson, Cases, File, OpenReport, Out, Report, Settings

if TYPE_CHECKING:
    from experiments.sweep.optimise import TuningResult
    from experiments.sweep.sweep import SweepResult
    from experiments.sweep.table import CellRow


app: Final = typer.Typer()


@dataclass
class _Request:
    """Arguments of the command."""

    file: str
    given: Sequence[str]
    settings: Sequence[str]
    cases: Sequence[str]
    out: str | None
    scheduler: str | None
    processes: int | None
    optimize: str | None
    as_json: bool
    report: bool
    open_report: bool

    @property
    def line(self) -> str:
        """The command that repeats it."""
        parts = ["zenpark", "sweep", self.file, *self.given]
        parts += [part for case in self.cases for part in ("--case", case)]
        parts += [part for setting in self.settings for part in ("--set", setting)]
        parts += ["--optimize", self.optimize] if self.optimize else []
        return shlex.join(parts)


@app.command()
def sweep(
    file: File,
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PATH=VALUES...]",
            help="What changes: trigger.threshold=0.002:0.05:log12, or lin12, or a list 1,2,3; several make a grid. "
            "seeds=50 or seeds=101:150 [20 from the file's on]; tuning=1001:1060 for --optimize.",
        ),
    ] = None,
    *,
    case: Cases = None,
    settings: Settings = None,
    optimize: Annotated[
        str | None,
        typer.Option(
            metavar="WISH",
            help="Seeks values in the ranges instead: 'messages, iae<=1.01' (relative to the first case).",
        ),
    ] = None,
    out: Out = None,
    processes: Annotated[int | None, typer.Option(min=1, help="How many at once. [one per core]")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="On the workers of this dask scheduler, tcp://HOST:PORT.")
    ] = None,
    as_json: AsJson = False,
    anyway: Anyway = False,
    report: Report = True,
    open_report: OpenReport = False,
) -> int:
    """Run cases x values x seeds in virtual time on all cores; what is done is never run again."""
    from experiments.file.document import load
    from tools.commands.run import sound

    changes = settings or []
    if not sound(load(file, *changes), seeds=2) and not anyway:
        print("zenpark: not run; mend the file (`zenpark check` says more), or run it --anyway", file=sys.stderr)
        return 2
    request = _Request(
        file=file,
        given=given or [],
        settings=changes,
        cases=case or [],
        out=out,
        scheduler=scheduler,
        processes=processes,
        optimize=optimize,
        as_json=as_json,
        report=report,
        open_report=open_report,
    )
    return _sweep(request) if optimize is None else _optimise(request, optimize)


def _sweep(request: _Request) -> int:
    import json

    from experiments.sweep import table as sweep_table
    from experiments.sweep.sweep import sweep
    from tools.progress import Bar

    with Bar() as bar:
        found = sweep(
            request.file,
            request.given,
            settings=request.settings,
            cases=request.cases,
            out=request.out,
            scheduler=request.scheduler,
            processes=request.processes,
            progress=lambda done, of: bar.show("runs", done, of),
        )
    table = sweep_table.document(found.read.experiment.title, found.seeds, found.rows)
    _write_table(found.folder, found.rows, table)
    page = _page(request, found) if request.report and found.rows else None
    if request.as_json:
        print(json.dumps(table))
    else:
        print(found)
        _print(found.folder, found.notes, page)
    for failure in found.failures[:3]:
        print(f"failed: {failure}", file=sys.stderr)
    if found.missing:
        print(f"interrupted: {found.missing} runs are missing; the same command goes on from here", file=sys.stderr)
        return 130
    _open(request, page)
    return 1 if found.failures else 0


def _optimise(request: _Request, wished: str) -> int:
    import json

    from experiments.sweep import table as sweep_table
    from experiments.sweep.optimise import tune
    from tools.progress import Bar

    try:
        with Bar() as bar:
            tuned = tune(
                request.file,
                request.given,
                wished,
                settings=request.settings,
                cases=request.cases,
                out=request.out,
                scheduler=request.scheduler,
                processes=request.processes,
                progress=lambda case, done, of: bar.show(f"{case}: tried", done, of),
            )
    except KeyboardInterrupt:
        print("interrupted: what was tried is kept; the same command goes on from there", file=sys.stderr)
        return 130
    table = sweep_table.document(
        tuned.read.experiment.title, tuned.seeds, tuned.rows, tuning=list(tuned.tuning), wish=wished
    )
    _write_table(tuned.folder, tuned.rows, table)
    sweep_table.write_csv(tuned.folder / "tried.csv", tuned.tried)
    page = _page(request, tuned) if request.report else None
    if request.as_json:
        print(json.dumps(table))
    else:
        print(f"tuned on seeds {_ends(tuned.tuning)}, reported on seeds {_ends(tuned.seeds)}")
        print("\n".join(sweep_table.text(tuned.rows)))
        for row in (row for row in tuned.rows if not row.reference):
            limits = ", ".join(map(str, tuned.wish.limits))
            print(f"{row.label}: {'keeps' if tuned.wish.kept(row) else 'DOES NOT KEEP'} {limits}")
        _print(tuned.folder, tuned.notes, page)
    _open(request, page)
    return 0 if all(row.reference or tuned.wish.kept(row) for row in tuned.rows) else 1


def _write_table(folder: Path, rows: Sequence[CellRow], table: dict[str, Any]) -> None:
    from experiments.sweep import table as sweep_table

    sweep_table.write_csv(folder / "sweep.csv", rows)
    sweep_table.write_json(folder / "sweep.json", table)


def _page(request: _Request, found: SweepResult | TuningResult) -> Path:
    from experiments.sweep import page as pages
    from experiments.sweep.sweep import SweepResult

    return (
        pages.write(found, request.line) if isinstance(found, SweepResult) else pages.write_tuned(found, request.line)
    )


def _print(folder: Path, notes: Sequence[str], page: Path | None) -> None:
    for note in notes:
        print(f"note: {note}")
    print(f"table: {folder / 'sweep.csv'}, {folder / 'sweep.json'}")
    if page is not None:
        print(f"page: {page}")


def _open(request: _Request, page: Path | None) -> None:
    import webbrowser

    if request.open_report and page is not None:
        webbrowser.open(page.resolve().as_uri())


def _ends(seeds: Sequence[int]) -> str:
    return str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
