"""`./zenpark sweep`: cases x values x seeds in virtual time, or a search for the best values."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Argument, Option

from tools.options import (
    Anyway,
    AsJson,
    Cases,
    File,
    OpenReport,
    Out,
    Report,
    Settings,
    example,
    open_in_browser,
    print_result,
)

if TYPE_CHECKING:
    from experiments.file.document import Document
    from experiments.sweep.optimise import TuningResult
    from experiments.sweep.sweep import SweepResult

    Outcome = tuple[SweepResult | TuningResult, dict[str, Any], list[str], int]

app: Final = typer.Typer()

INTERRUPTED: Final = 130  # exit code
UNDRAWN: Final = "no metric with a ratio is known: give links a target, or the law a measure"


@app.command(
    epilog=example(
        "sweep robotic-park trigger.threshold=0.002:0.05:log12 seeds=50",
        "sweep triangle trigger.threshold=0.002:0.05 --optimise 'messages, iae<=1.01'",
    )
)
def sweep(
    file: File,
    given: Annotated[
        list[str] | None,
        Argument(
            metavar="[PATH=VALUES...]",
            help="Axes: trigger.threshold=0.002:0.05:log12, or lin12, or a list 1,2,3; several make a grid. "
            "seeds=50 or seeds=101:150 [20 from the file's on]; tuning=1001:1060 for --optimise.",
        ),
    ] = None,
    *,
    case: Cases = None,
    settings: Settings = None,
    optimise: Annotated[
        str | None,
        Option(
            "--optimise",
            "--optimise",
            metavar="WISH",
            help="Optimise values in the ranges instead: 'messages, iae<=1.01' (relative to the first case).",
        ),
    ] = None,
    metrics: Annotated[
        list[str] | None,
        Option("--metrics", metavar="FILE.py:CLASS", help="A metric in a file beside FILE; may be repeated."),
    ] = None,
    out: Out = None,
    processes: Annotated[int | None, Option(min=1, help="Number at once. [one per core]")] = None,
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="Dask scheduler with the workers to use, tcp://HOST:PORT.")
    ] = None,
    as_json: AsJson = False,
    anyway: Anyway = False,
    report: Report = True,
    open_report: OpenReport = False,
) -> int:
    """Run cases x values x seeds in virtual time on all cores; finished runs are never repeated."""
    from experiments.file.document import load
    from experiments.recording.run_folder import SWEEP, naming
    from experiments.sweep import table as tables
    from tools.commands.run import refused

    changes = [*(settings or []), *added_metrics(file, metrics or [])]
    read = load(file, *changes)
    _parse_axes(read, file, changes, given or [], case or [])
    if code := refused(read, real=False, seeds=2, as_json=as_json, anyway=anyway):
        return code
    options = {"settings": changes, "cases": case or [], "out": out, "scheduler": scheduler, "processes": processes}
    if optimise is None:
        found, more, lines, code = _sweep(file, given or [], options)
    else:
        try:
            found, more, lines, code = _optimise(file, given or [], optimise, options)
        except KeyboardInterrupt:
            print("interrupted: all that was tried is kept; the same command goes on from there", file=sys.stderr)
            return 130
    table = tables.document(found.read.experiment.title, found.seeds, found.rows, found.metrics, **more)
    with naming(found.folder):
        tables.write_csv(found.folder / "sweep.csv", found.rows, found.metrics)
        tables.write_json(found.folder / SWEEP, table)
    lines += [f"note: {note}" for note in found.notes]
    lines.append(f"table: {found.folder / 'sweep.csv'}, {found.folder / SWEEP}")
    page = None
    if report and found.rows:
        from experiments.sweep import page as pages  # matplotlib takes 0.6 s

        words = ["./zenpark", "sweep", file, *(given or [])]
        words += [part for name in case or [] for part in ("--case", name)]
        words += [part for setting in changes for part in ("--set", setting)]
        with naming(found.folder):
            page = pages.write(found, shlex.join([*words, *(["--optimise", optimise] if optimise else [])]))
        figures = found.folder / "figures"
        lines += [f"figures: {figures}" if any(figures.glob("*")) else f"figures: none, {UNDRAWN}", f"page: {page}"]
    print_result(table, *lines, as_json=as_json)
    if open_report and page is not None and code != INTERRUPTED:
        open_in_browser(page.resolve().as_uri())
    return code


def added_metrics(file: str, names: Sequence[str]) -> list[str]:
    """The `--set` that adds metrics to those of a file; none without names."""
    from agents.plugins.files import plain
    from experiments.file.document import inline, load

    known = [plain(name) for name in load(file).experiment.metrics] if names else []
    return [f"metrics={inline([*known, *names])}"] if names else []


def _parse_axes(read: Document, file: str, changes: list[str], given: list[str], cases: list[str]) -> None:
    """Refuse bad axes, seeds and cases before the check, which may take long; of each axis its first value is tried."""
    from dataclasses import replace

    from experiments.sweep.plan import arguments, cells, seeds_of

    axes, words = arguments(given)
    seeds_of(words.get("seeds"), read.experiment.seed)
    cells(read, file, changes, [replace(axis, values=axis.values[:1]) for axis in axes if axis.values], cases)


def _sweep(file: str, given: Sequence[str], options: dict[str, Any]) -> Outcome:
    """Sweep; return the result, further entries of its table, lines to print and the exit code."""
    from experiments.sweep.sweep import sweep
    from tools.progress import Bar

    with Bar() as bar:
        found = sweep(file, given, **options, progress=lambda done, of: bar.show("runs", done, of))
    for failure in found.failures[:3]:
        print(f"failed: {failure}", file=sys.stderr)
    if found.missing:
        print(f"interrupted: {found.missing} runs are missing; the same command goes on from here", file=sys.stderr)
    return found, {}, [str(found)], INTERRUPTED if found.missing else 1 if found.failures else 0


def _optimise(file: str, given: Sequence[str], objective: str, options: dict[str, Any]) -> Outcome:
    """Search; return as `_sweep`; raises KeyboardInterrupt on Ctrl-C."""
    import msgspec

    from experiments.report.page import seeds_in_words
    from experiments.sweep import table as tables
    from experiments.sweep.optimise import tune
    from tools.progress import Bar

    with Bar() as bar:
        found = tune(
            file, given, objective, **options, progress=lambda case, done, of: bar.show(f"{case}: tried", done, of)
        )
    tables.write_csv(found.folder / "tried.csv", found.tried, found.metrics)
    tuning, seeds = seeds_in_words(found.tuning), seeds_in_words(found.seeds)
    lines = [f"tuned on seeds {tuning}, reported on seeds {seeds}", *tables.text(found.rows, found.metrics)]
    kept = {row.label: found.objective.kept(row) for row in found.rows if not row.reference}
    limits = found.objective.limits_in_words(", ")
    lines += [f"{label}: {'keeps' if well else 'DOES NOT KEEP'} {limits}" for label, well in kept.items()]
    more = {
        "tuning": list(found.tuning),
        "objective": objective,
        "tried": [msgspec.to_builtins(row) for row in found.tried],
    }
    return found, more, lines, 0 if all(kept.values()) else 1
