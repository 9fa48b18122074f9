"""Commands that read results (report, export) and find or remove their folders (runs, clean)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Argument, Option

from agents.errors import ExplainedError, writing
from tools import completion
from tools.options import AsJson, at_home, example, known_words, print_json, print_result, warn
from tools.terminal import say

if TYPE_CHECKING:
    from experiments.metrics.results import CaseMetrics
    from experiments.recording.run_folder import PastRun
    from experiments.report.page import Table
    from experiments.run import Run

app: Final = typer.Typer()

ELSEWHERE: Final = "choose another place with --out"


@app.command(epilog=example("report runs/first", "report runs/first runs/second --out comparison.html"))
def report(
    runs: Annotated[
        list[str],
        Argument(
            metavar="RUN...", help="Folders of runs, full of runs, or of a sweep.", autocompletion=completion.folders
        ),
    ],
    out: Annotated[
        str | None,
        Option(
            metavar="PLACE",
            help="Folder of the report; FILE.html of a comparison, FILE of tables. [the run's folder]",
            callback=at_home,
        ),
    ] = None,
    *,
    label: Annotated[list[str] | None, Option(metavar="NAME", help="Name of each run, in order. [A, B, ...]")] = None,
    pool: Annotated[bool, Option("--pool", help="Pool runs that differ in seed only: means and intervals.")] = False,
    width: Annotated[
        float, Option(min=2.0, max=12.0, metavar="INCHES", help="Width of figures and LaTeX tables: 3.5 or 7.16.")
    ] = 3.5,
    pdf: Annotated[bool, Option("--pdf", help="Write the figures as PDF as well, into figures/.")] = False,
    as_latex: Annotated[bool, Option("--latex", help="Print LaTeX tables (booktabs, adjustbox) instead.")] = False,
    as_markdown: Annotated[bool, Option("--markdown", help="Print the tables as Markdown instead.")] = False,
    metrics: Annotated[
        str | None, Option(metavar="NAMES", help="Metrics for --latex or --markdown, as f,iae,itae.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Write the report of one run, or compare several with the first; of a sweep, its figures or its table."""
    from experiments.file.problems import refusal
    from experiments.metrics.metric import short_name
    from experiments.recording.reader import RecordingError
    from experiments.recording.run_folder import SWEEP
    from experiments.report import report as pages  # matplotlib takes 0.6 s
    from experiments.report import typeset
    from experiments.report.tables import summary_metrics
    from experiments.run import pool_seeds, read_metrics, reopen_seeds

    form = partial(typeset.latex, width=width) if as_latex else typeset.markdown if as_markdown else None
    if metrics and form is None:
        raise refusal("--metrics", "chooses numbers of a printed table", "add --latex or --markdown")
    if pdf and form is not None:
        raise refusal("--pdf", "writes figures, not the table", "give --latex or --markdown in a command of its own")
    if len(runs) == 1 and (Path(runs[0]) / SWEEP).is_file():
        return _report_sweep(Path(runs[0]), out, width, metrics, form, pdf=pdf, as_json=as_json)
    folders = _folders_of_runs(runs)
    labels = label or [chr(ord("A") + k) if k < 26 else f"{k + 1}" for k in range(len(folders))]
    if len(labels) != len(folders):
        message = f"{len(labels)} labels for {len(folders)} runs"
        raise refusal("--label", message, "give one for each run, in their order")
    several = len(folders) > 1 and not pool
    if out and form is None and not several and Path(out).suffix.lower() in (".html", ".pdf", ".tex", ".md"):
        hint = "name a folder; FILE.html names the page of a comparison of several runs"
        raise refusal(f"--out {out}", "the report of one run is a folder with its figures", hint)
    if pdf and several:
        raise refusal("--pdf", "writes the figures of one run", "report each run by itself, or pool them (--pool)")
    read = [] if several else [reopen_seeds(folder) for folder in folders]
    named = [(name, read_metrics(folder)) for name, folder in zip(labels, folders, strict=True)] if several else []
    begun = [bool(cases) for _, cases in named] or [bool(seeds[0].traces) for seeds in read]
    for folder, known in zip(folders, begun, strict=True):
        if not known:
            raise RecordingError(f"{folder}: no case had begun; there is nothing to report")
    pooled = len(read) > 1
    seeds = pool_seeds(folders, read) if pooled else [run for found in read for run in found]
    cases = pages.labelled(named) if several else [case for run in seeds for case in run.metrics.values()]
    if form is not None:
        names = {short_name(name): name for name in summary_metrics(cases)}
        tables = pages.result_tables(cases, [names[name] for name in known_words("--metrics", [metrics or ""], names)])
        _put(form(tables), out)
        return 0
    if several:
        return _compare(folders, named, Path(out or "comparison.html"), as_json=as_json)
    target = Path(out or (f"{Path(folders[0])}-pooled" if pooled else folders[0]))
    with writing(target, ELSEWHERE):
        write_metrics(seeds, target)
        page = write_report(seeds, target, width, pdf=pdf)
    found = [{"folder": seeds[0].folder, **summary(seeds)}] if as_json else []
    warn([note for run in seeds for note in run.notes])
    print_result({"report": page, "runs": found}, str(page), as_json=as_json)
    return 0


def _folders_of_runs(folders: Sequence[str]) -> list[str]:
    """Folders of runs in the given order; one that is full of them stands for those in it, the oldest first."""
    from experiments.recording.run_folder import past_runs

    found = list[str]()
    for folder in folders:
        inside = [run.folder for run in past_runs([Path(folder)])]
        found += [folder] if str(Path(folder)) in inside or not inside else inside
    return found


def _compare(
    folders: Sequence[str], named: Sequence[tuple[str, Sequence[CaseMetrics]]], target: Path, *, as_json: bool
) -> int:
    """Print how runs differ and their key figures against the first, and write the page of their comparison."""
    from experiments.metrics.metric import console_metrics
    from experiments.recording.run_folder import differences_from_first, past_runs
    from experiments.report import report as pages
    from experiments.report.tables import summary_table
    from experiments.report.typeset import plain
    from experiments.report.verdict import interruptions, spoiled
    from tools.progress import columns

    known = {run.folder: run for run in past_runs([Path(folder) for folder in folders])}
    past = [known[place] for folder in folders if (place := str(Path(folder))) in known]
    differ = differences_from_first([name for name, _ in named], folders)
    with writing(target, ELSEWHERE):
        titles = "; ".join(dict.fromkeys(run.origin.title for run in past))
        page = pages.compare(target, named, source=titles, differences=differ)
    if as_json:
        shown = {"report": page, "reference": folders[0], "runs": [_as_json(run) for run in past]}
        print_json(shown | {"differences": {folder: found for _, folder, found in differ[1:]}})
        return 0
    cases = pages.labelled(named)
    table = summary_table(cases, [*console_metrics()])
    say(*columns(plain(pages.differences_table(differ))), "")
    say(*columns([*zip(*plain(table), strict=True)]), table.note)
    say(*map(str, (*spoiled(cases), *interruptions(cases))), str(page))
    return 0


def _put(text: str, out: str | None) -> None:
    """Print a text, or write it into a file and print where that is."""
    if out is None:
        print(text)
        return
    with writing(out, ELSEWHERE):
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        Path(out).write_text(f"{text}\n", encoding="utf-8")
    print(out)


def _report_sweep(
    folder: Path,
    out: str | None,
    width: float,
    metrics: str | None,
    form: Callable[[Sequence[Table]], str] | None,
    *,
    pdf: bool,
    as_json: bool,
) -> int:
    """Write the table of a sweep for a paper, or its figures in a width [in]."""
    import msgspec

    from experiments.recording.reader import RecordingError
    from experiments.recording.run_folder import SWEEP
    from experiments.sweep import page as pages
    from experiments.sweep import table

    try:
        document, rows, known = table.read_json(folder / SWEEP)
    except ValueError as error:
        raise RecordingError(f"{folder / SWEEP}: cannot be read: {error}; make the sweep again") from None
    if form is not None:
        chosen = known_words("--metrics", [metrics or ""], table.numbers(known))
        _put(form([pages.table(rows, known, str(document.get("experiment", folder.name)), chosen)]), out)
        return 0
    searched = "tuning" in document  # its figures show all that was tried
    if searched:
        try:
            tried = msgspec.convert(document.get("tried"), list[table.CellRow])
        except ValueError:
            raise RecordingError(f"{folder}: a search of another version; make it again") from None
        rows = [*(row for row in rows if row.reference), *tried]
    target = Path(out or folder)
    pages.pictures(target, rows, known, joined=not searched, width=width, pdf=pdf)
    figures = target / "figures"
    print_result({"figures": figures, "cells": len(rows)}, str(figures), as_json=as_json)
    return 0


def _as_json(run: PastRun) -> dict[str, Any]:
    """A run for scripts, its figures as statistics over the seeds."""
    import msgspec

    from experiments.metrics.statistics import spread

    cases = {
        case: {name: spread([*values.values()]) for name, values in figures.items()}
        for case, figures in run.cases.items()
    }
    return msgspec.structs.asdict(run) | {"cases": cases}


@app.command(epilog=example("export runs/first --csv", "export runs/first supplement.zip --bundle"))
def export(  # noqa: PLR0917 - a command line
    folder: Annotated[str, Argument(metavar="RUN", help="Run, or recording.", autocompletion=completion.folders)],
    target: Annotated[str | None, Argument(metavar="FILE", help="FILE.mat, .csv, .zip, .mcap. [run.mat]")] = None,
    as_csv: Annotated[bool, Option("--csv", help="A table of trajectories: case, time, robot, x, ...")] = False,
    as_bundle: Annotated[bool, Option("--bundle", help="Archive that repeats the run, for a supplement.")] = False,
    video: Annotated[
        Path | None, Option("--video", metavar="FILE", help="A film of all cases: FILE.mp4 (by ffmpeg) or .gif.")
    ] = None,
    speed: Annotated[float, Option(min=0.1, max=100.0, help="Speed of a film, as a multiple of real time.")] = 4.0,
    as_json: AsJson = False,
) -> None:
    """Write a run for MATLAB, as one table, a film or a bundle that `run` repeats; a recording: whole, if cut off."""
    from experiments.recording import bundle
    from experiments.report.export import require_savemat, write_csv, write_mat, write_video
    from experiments.run import reopen

    if video is not None and (target or as_csv or as_bundle or video.suffix.lower() not in (".mp4", ".gif")):
        raise ExplainedError(f"{video}: name the film behind --video alone, with .mp4 or .gif at its end")
    if folder.endswith(".mcap"):
        source = Path(folder)
        _repair(source, Path(target or source.with_name(f"{source.stem}-recovered.mcap")), as_json=as_json)
        return
    own = video.suffix if video else ".csv" if as_csv else ".zip" if as_bundle else ".mat"
    place = Path(folder).resolve()
    usual = place.with_name(f"{place.name}.zip") if as_bundle else place / f"run{own}"
    file = video or (Path(target) if target else usual)
    suffix = file.suffix.lower()
    if (video is None and suffix not in (".mat", ".csv", ".zip")) or (suffix != own and (as_csv or as_bundle)):
        raise ExplainedError(f"{file}: is no name for what is exported; let it end with .mat, .csv or .zip (a bundle)")
    if suffix == ".mat":
        require_savemat()  # asked before a long recording is read
    found = reopen(Path(folder))
    if not found.traces:
        raise ExplainedError(f"{folder}: no case had begun; there is nothing to export")
    if suffix == ".mat":
        write_mat(found.traces, found.metrics, file)
    elif suffix == ".zip":
        bundle.write(Path(folder), file, [trace.plan for trace in found.traces.values()])
    elif video is not None:
        write_video(found.traces, file, speed)
    else:
        write_csv(found.traces, file)
    shown = {"file": file, "cases": list(found.traces)}
    print_result(shown, f"{file}: {', '.join(found.traces)}", as_json=as_json)


def _repair(source: Path, target: Path, *, as_json: bool) -> None:
    """Write what a recorder that was killed has left as a whole recording."""
    from experiments.recording.reader import later_parts, recover

    found = recover(source, target, later_parts(source))
    made = f"{source} is whole already" if found.complete else str(target)
    shown = {"file": source if found.complete else target, "was_whole": found.complete}
    lost = f"; {found.damaged} bytes were damaged, and what was in them is missing" if found.damaged else ""
    print_result(
        shown | {"messages": found.messages, "robots": found.robots, "damaged_bytes": found.damaged},
        f"{made}: {found.messages} messages of {', '.join(found.robots) or 'no robot'}{lost}",
        as_json=as_json,
    )


def write_metrics(runs: Sequence[Run], folder: Path) -> None:
    """Write `metrics.csv` and `metrics.json` of a run into its folder."""
    from experiments.report import metrics_files

    folder.mkdir(parents=True, exist_ok=True)
    every = [case for each in runs for case in each.metrics.values()]
    metrics_files.write_csv(folder / "metrics.csv", every)
    metrics_files.write_json(folder / "metrics.json", every)


def summary(runs: Sequence[Run]) -> dict[str, Any]:
    """The figures of a run for scripts: those of its first seed, and `across` its seeds if there are several."""
    from experiments.metrics import criteria
    from experiments.metrics.statistics import across_seeds

    found = runs[0].summary()
    if len(runs) > 1:
        found |= {"across": across_seeds([each.summary() for each in runs])}
        found |= criteria.document(criteria.judge([case for each in runs for case in each.metrics.values()]))
    return found


def write_report(runs: Sequence[Run], folder: Path, width: float = 3.5, *, pdf: bool = False) -> Path:
    """Write figures and report of a run into its folder; return the report."""
    from experiments.report import report as pages
    from experiments.report.page import date_of

    return pages.write(
        folder,
        [trace for each in runs for trace in each.traces.values()],
        date=date_of(runs[0].made),
        run=runs[0].folder,
        text=runs[0].source,
        measured=[case for each in runs for case in each.metrics.values()],
        notes=[note for each in runs for note in each.notes],
        width=width,
        pdf=pdf,
    )


Words = Annotated[list[str] | None, Argument(metavar="[WORD...]", help="Runs with all these in tags, name or title.")]
Below = Annotated[list[str] | None, Option("--in", metavar="FOLDER", help="Folder of runs. [runs]")]


@app.command(epilog=example("runs", "runs --past paper --json"))
def runs(
    words: Words = None,
    *,
    past: Annotated[bool, Option("--past", help="List runs that have ended.")] = False,
    below: Below = None,
    as_json: AsJson = False,
) -> None:
    """Show which runs are up on this machine; with --past those that left their folders, with key figures."""
    import msgspec

    from experiments.real_time.hosts import run_registry

    if past or words or below:
        _show_past(words or [], below, as_json=as_json)
        return
    found = run_registry.look()
    lines = []
    for run in found.runs:
        since = time.strftime("%H:%M:%S", time.localtime(run.since))
        died = "" if run.alive else "; its process has died"
        lines.append(f"{run.title}  since {since}, pid {run.pid}, at {run.where}, realm {run.realm}{died}")
        robots = ", ".join(f"{name} ({body})" if body else name for name, body in run.robots.items())
        lines += [f"  {each}" for each in (run.folder, robots) if each]
    shown = [{**msgspec.to_builtins(run), "alive": run.alive} for run in found.runs]
    print_result(shown, *(lines or [found.words]), as_json=as_json)


def _past_runs(words: Sequence[str], below: list[str] | None) -> list[PastRun]:
    from experiments.recording.run_folder import RUNS, past_runs

    folders = [Path(each) for each in below] if below else [RUNS]
    return [run for run in past_runs(folders) if run.matches(words)]


def _show_past(words: Sequence[str], below: list[str] | None, *, as_json: bool) -> None:
    from experiments.metrics.statistics import spread
    from experiments.recording.run_folder import SWEEP
    from experiments.report.page import NONE, interval
    from tools.progress import columns

    found = _past_runs(words, below)
    places = [Path(each) for each in below or ["runs"]]
    sweeps = sorted({file.parent for place in places for file in (*place.glob(SWEEP), *place.glob(f"*/{SWEEP}"))})
    sweeps = [folder for folder in sweeps if all(word.lower() in folder.name.lower() for word in words)]
    if as_json:
        print_json({"runs": [_as_json(run) for run in found], "sweeps": [_sweep_as_json(folder) for folder in sweeps]})
        return
    if not found and not sweeps:
        print("no run of that kind" if words else f"no run in {', '.join(below or ['runs'])}")
        return
    from experiments.metrics.metric import console_metrics

    shown = console_metrics()
    head = ("when, UTC", "run", "case", *(metric.head for metric in shown.values()), "MB", "tags", "remarks")
    rows = []
    for run in found:
        clock = " (virtual)" * run.origin.virtual
        first = [_minute(run.made), f"{run.folder}{clock}"]
        for k, (case, figures) in enumerate((run.cases or {"-": {}}).items()):
            values = [interval(spread([*figures[name].values()])) if name in figures else NONE for name in shown]
            last = [f"{run.megabytes:.1f}", ", ".join(run.origin.tags)] if k == 0 else ["", ""]
            known = dict.fromkeys([*run.remarks.get(case, {}).values(), *([run.fault] if run.fault and k == 0 else [])])
            rows.append([*(first if k == 0 else ["", ""]), case, *values, *last, " | ".join(known)])
    say(*(columns([head, *rows]) if rows else ["no run"]))
    for folder in sweeps:
        say(f"{_minute((folder / SWEEP).stat().st_mtime)}  {folder}  a sweep: `./zenpark report {folder}`")
    say(*_losses(found))
    print(f"runs: {len(found)}, {sum(run.megabytes for run in found):.1f} MB; sweeps: {len(sweeps)}")


def _losses(found: Sequence[PastRun]) -> list[str]:
    """A line: poses lost per hour of runs in real time, the oldest run first; none without such runs."""
    flown_h, quiet_h, lost, count = 0.0, 0.0, 0, 0
    for run in found:
        hours = sum(sum(case.values()) for case in run.lengths.values()) / 3600.0
        if run.origin.virtual or not hours:
            continue
        count += 1
        flown_h += hours
        quiet_h = 0.0 if run.lost else quiet_h + hours
        lost += run.lost
    if not count:
        return []
    rate = f"{lost} poses lost, {lost / flown_h:.3g} per hour"
    return [f"real time: {flown_h:.3g} h in {count} runs; {rate}; the last {quiet_h:.3g} h without loss"]


def _minute(at: float) -> str:
    """A time [s, UTC], to the minute."""
    return time.strftime("%Y-%m-%d %H:%M", time.gmtime(at))


def _sweep_as_json(folder: Path) -> dict[str, Any]:
    """A sweep for scripts: its table is in its folder."""
    import msgspec

    from experiments.recording.run_folder import SWEEP

    try:
        table = msgspec.json.decode((folder / SWEEP).read_bytes(), type=dict[str, Any])
    except (OSError, ValueError, RecursionError):
        table = {}
    known = {name: table.get(name) for name in ("experiment", "reference", "seeds")}
    return {"folder": folder, "made": (folder / SWEEP).stat().st_mtime, "cells": len(table.get("cells", [])), **known}


@app.command(epilog=example("clean --older 30", "clean --older 30 --recordings --yes"))
def clean(
    words: Words = None,
    *,
    older: Annotated[float | None, Option(min=0.0, metavar="DAYS", help="Least age of the runs [days].")] = None,
    recordings: Annotated[bool, Option("--recordings", help="Only recordings and logs; the results stay.")] = False,
    tagged: Annotated[bool, Option("--tagged", help="Include runs with a tag.")] = False,
    yes: Annotated[bool, Option("--yes", help="Remove; without it, only list.")] = False,
    below: Below = None,
    as_json: AsJson = False,
) -> int:
    """Remove folders of past runs: those of some words or age, never one with a tag or one that is up."""
    from experiments.real_time.hosts import run_registry
    from experiments.recording import cleaning

    if not words and older is None:
        raise typer.BadParameter("give words that the runs have, or --older DAYS (0: all)", param_hint="which runs")
    up = {Path(run.folder).resolve() for run in run_registry.runs() if run.folder}
    roots = {Path(each).resolve() for each in below or ["runs"]}
    now = time.time()
    chosen = [
        run
        for run in _past_runs(words or [], below)
        if (tagged or not run.origin.tags) and cleaning.removable(Path(run.folder))
        if (place := Path(run.folder).resolve()) not in roots and not any(each.is_relative_to(place) for each in up)
        if older is None or now - run.made > 86400.0 * older
    ]
    shown: list[dict[str, Any]] = []
    failed = False
    for run in chosen:
        folder = Path(run.folder)
        parts = [*folder.glob("*.mcap"), *folder.glob("logs")] if recordings else None
        removed = [folder] if parts is None else parts
        try:
            cleaning.remove(folder, parts, really=yes)
        except cleaning.InUse as error:
            warn([f"{error}: it stays"])
            continue
        except FileNotFoundError:  # another one has removed it meanwhile
            continue
        except OSError as error:
            warn([f"{error.filename}: cannot be removed: {error.strerror}"])
            failed = True
            continue
        shown.append({"folder": run.folder, "parts": removed, "removed": yes})
        if not as_json:
            what = ", ".join(map(str, removed)) or f"nothing of {folder}"
            say(f"{'removed' if yes else 'would remove'} {what}")
    remedy = "; --yes does it" if shown and not yes else ""
    print_result(shown, f"runs: {len(shown)}{remedy}", as_json=as_json)
    return int(failed)
