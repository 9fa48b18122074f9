"""What `zenpark run`, `report`, `export`, `recover`, `new` and `list` do and print."""

from __future__ import annotations

import json
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from agents.plugins import registry
from agents.runtime.command_line import Interrupts
from experiments.definition.bodies import BODIES
from experiments.file import catalogue, document
from experiments.file.document import chosen, load
from experiments.file.problems import DocumentError, Problem
from experiments.metrics.statistics import across_seeds
from experiments.real_time.conductor.conduct import RunOptions, conduct
from experiments.real_time.conductor.run_view import Emergency
from experiments.recording.reader import RecordingError
from experiments.recording.run_folder import SOURCE, new_folder, remove_unused
from experiments.report import metrics_files, verdict
from experiments.run import Run, read_back, reopen, simulate_seeds
from tools.commands.progress import Bar, shown

STOPPED: Final = 1  # exit code of a run that an emergency stop has ended


def run(
    file: str,
    staging: RunOptions,
    *,
    virtual: bool,
    out: str | None,
    seed: int | None,
    settings: Sequence[str],
    as_json: bool,
    seeds: int,
    anyway: bool,
    report: bool,
    open_report: bool,
) -> int:
    """`zenpark run`; returns the exit code: 0, 1 after an emergency stop, 2 if the check finds errors, 130 if ended."""
    changes = [*settings, *([] if seed is None else [f"seed={seed}"])]
    read = load(file, *changes)
    _refuse(staging, virtual=virtual, seeds=seeds)
    chosen(read, staging.cases)
    if not sound(read, changes, seeds=seeds) and not anyway:
        print("zenpark: not run; mend the file (`zenpark check` says more), or run it --anyway", file=sys.stderr)
        return 2
    folder = new_folder(read, out)
    try:
        again = _command(file, staging, virtual=virtual, changes=changes, seeds=seeds, anyway=anyway)
        way = _Way(virtual, seeds, as_json=as_json, report=report, open_report=open_report, again=again)
        return _fly(read, folder, staging, way)
    finally:
        remove_unused(folder)


@dataclass(frozen=True)
class _Way:
    """What to make of a run, and the command that makes it again."""

    virtual: bool
    seeds: int
    as_json: bool
    report: bool
    open_report: bool
    again: str


def _fly(read: document.Document, folder: Path, staging: RunOptions, way: _Way) -> int:
    """Runs, writes and tells; returns the exit code."""
    virtual, seeds, as_json = way.virtual, way.seeds, way.as_json
    read.keep(folder / SOURCE)
    interrupted, emergency = Interrupts(), Emergency()
    if virtual:
        first = read.experiment.seed
        with Bar(passing=True) as bar:
            runs = simulate_seeds(
                read,
                range(first, first + seeds),
                cases=staging.cases,
                folder=folder,
                tell=lambda case, done, of: bar.show(f"{case}, simulated s", done, of),
            )
    else:
        with interrupted:
            show = shown(quiet=as_json)
            try:
                flown = conduct(
                    read, folder, staging, show=show, interrupted=interrupted, emergency=emergency, tell=_warn
                )
                runs = [read_back(folder, *flown)]
            except KeyboardInterrupt:
                print(f"\nended at once; `zenpark report {folder}` shows what was recorded", file=sys.stderr)
                return 130
    if not runs[0].traces:
        why = emergency.words or "interrupted"
        print(f"{why}, before the common start: there is nothing to report; logs: {folder / 'logs'}")
        return STOPPED if emergency else 130
    _write_figures_of_merit(runs, folder)
    page = _keep(runs, folder, way.again) if way.report else None
    summary: dict[str, Any] = runs[0].summary()
    if seeds > 1:
        summary["across"] = across_seeds([each.summary() for each in runs])
    if as_json:
        print(json.dumps(summary))
    else:
        _tell(runs, summary, page)
    if way.open_report and page is not None:
        webbrowser.open(page.resolve().as_uri())
    if emergency:
        print(f"zenpark: {emergency.words}", file=sys.stderr)
        return STOPPED
    return 130 if interrupted.asked else 0


def _warn(lines: Sequence[str]) -> None:
    for line in lines:
        print(f"zenpark: {line}", file=sys.stderr)


def _refuse(staging: RunOptions, *, virtual: bool, seeds: int) -> None:
    """Raises DocumentError for options that do not go together."""
    if seeds > 1 and not virtual:
        raise DocumentError([Problem("--seeds", 0, 0, "needs --virtual", "in real time, run once per --seed")])
    if staging.bodies not in (None, *BODIES):
        raise DocumentError(
            [Problem(f"--bodies {staging.bodies}", 0, 0, "is not known", f"there are: {', '.join(BODIES)}")]
        )
    for option, given in (("--bodies", staging.bodies), ("--lab", staging.lab)):
        if given is not None and virtual:
            raise DocumentError([Problem(option, 0, 0, "is for real time", "leave out --virtual")])


def sound(read: document.Document, changes: Sequence[str], *, seeds: int) -> bool:
    """Says on standard error what the check warns of, for a run of so many seeds; False if it finds errors."""
    from experiments.check.check import NOT_RANDOM, check  # noqa: PLC0415

    found = [finding for finding in check(read, changes) if finding.severity != "note"]
    if seeds == 1:
        found = [finding for finding in found if finding.code != NOT_RANDOM]
    for finding in found:
        print(finding, file=sys.stderr)
    return all(finding.severity != "error" for finding in found)


def report(folders: Sequence[str], *, out: str | None) -> int:
    """`zenpark report`: of one run again, or of several beside each other."""
    from experiments.report import report as pages  # noqa: PLC0415 - matplotlib takes 0.6 s

    runs = [reopen(Path(folder)) for folder in folders]
    for folder, run in zip(folders, runs, strict=True):
        if not run.traces:
            raise RecordingError(f"{folder}: no case had begun; there is nothing to report")
    target = Path(out or "comparison.html") if len(runs) > 1 else Path(out or folders[0])
    try:
        if len(runs) == 1:
            _write_figures_of_merit(runs, target)
            print(_keep(runs, target, ""))
        else:
            named = [(Path(f).name, list(r.traces.values())) for f, r in zip(folders, runs, strict=True)]
            print(pages.compare(target, named))
    except OSError as error:
        raise RecordingError(
            f"{target}: cannot be written: {error.strerror}; choose another place with --out"
        ) from None
    return 0


def export(folder: str, target: str | None, *, as_csv: bool) -> int:
    """`zenpark export`: a run as `run.mat` or `run.csv` in its folder, or as the file `target`.

    Raises:
        ExportError: If the file cannot be written, or scipy is missing.
        RecordingError: If the folder holds no recording, or one cannot be read.
    """
    from experiments.report.export import ExportError, require_savemat, write_csv, write_mat  # noqa: PLC0415

    file = Path(target) if target else Path(folder) / f"run{'.csv' if as_csv else '.mat'}"
    suffix = file.suffix.lower()
    if suffix not in (".mat", ".csv") or (as_csv and suffix == ".mat"):
        raise ExportError(f"{file}: is no name for the {'table' if as_csv else 'file'}; let it end with .mat or .csv")
    if suffix == ".mat":
        require_savemat()  # before a long recording is read
    found = reopen(Path(folder))
    if not found.traces:
        raise ExportError(f"{folder}: no case had begun; there is nothing to export")
    if suffix == ".mat":
        write_mat(found.traces, found.metrics, file)
    else:
        write_csv(found.traces, file)
    print(f"{file}: {', '.join(found.traces)}")
    return 0


def recover(file: str, target: str | None) -> int:
    """`zenpark recover`: repairs `file` into `target`, beside it if left out, and prints the number of messages.

    Raises:
        RecordingError: If `file` is no recording, or `target` exists or cannot be written.
    """
    from experiments.recording.reader import recover as recovered  # noqa: PLC0415

    source = Path(file)
    chosen = Path(target) if target else source.with_name(f"{source.stem}-recovered.mcap")
    found = recovered(source, chosen)
    what = f"{found.messages} messages of {', '.join(found.robots) or 'no robot'}"
    print(f"{source} is whole already: {what}" if found.complete else f"{chosen}: {what}")
    return 0


def new(name: str, target: str | None) -> int:
    """`zenpark new`: copies a catalogue entry to begin from."""
    path = catalogue.copy(name, Path(target) if target else Path(f"{name}.toml"))
    print(f"{path}: a copy of {name}; change it, then `zenpark check {path}` and `zenpark run {path}`")
    return 0


def list_all() -> int:
    """`zenpark list`: the catalogue, and the plug-ins that are installed."""
    width = max(len(name) for name, _ in catalogue.names())
    print("Experiments (zenpark run NAME, zenpark new NAME):")
    for name, title in catalogue.names():
        print(f"  {name:<{width}}  {title}")
    for what, group in (
        ("Bodies", registry.BODIES),
        ("Protocol twins", registry.DEVICES),
        ("Triggers", registry.TRIGGERS),
        ("Predictors", registry.PREDICTORS),
        ("Laws", registry.LAWS),
        ("Planners", registry.PLANNERS),
        ("Avoidances", registry.AVOIDANCES),
        ("Engines", registry.ENGINES),
    ):
        print(f"{what}: {', '.join(registry.names(group))}")
    return 0


def _command(file: str, staging: RunOptions, *, virtual: bool, changes: Sequence[str], seeds: int, anyway: bool) -> str:
    """What to type for the same run again."""
    parts = ["zenpark", "run", file, *(["--virtual"] if virtual else [])]
    parts += [part for case in staging.cases for part in ("--case", case)]
    parts += [part for change in changes for part in ("--set", f"'{change}'")]
    parts += ["--seeds", str(seeds)] if seeds > 1 else []
    parts += ["--bodies", staging.bodies] if staging.bodies is not None else []
    parts += ["--here"] if staging.here else []
    parts += ["--lab", staging.lab] if staging.lab is not None else []
    parts += ["--as", staging.identity] if staging.identity != "operator" else []
    return " ".join([*parts, *(["--anyway"] if anyway else [])])


def _write_figures_of_merit(runs: Sequence[Run], folder: Path) -> None:
    """Writes `metrics.csv` and `metrics.json` of a run into its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    every = [case for each in runs for case in each.metrics.values()]
    metrics_files.write_csv(folder / "metrics.csv", every)
    metrics_files.write_json(folder / "metrics.json", every)


def _keep(runs: Sequence[Run], folder: Path, command: str) -> Path:
    """Writes figures and report of a run into its folder; returns the report."""
    from experiments.report import report as pages  # noqa: PLC0415
    from experiments.report import style as figures  # noqa: PLC0415 - matplotlib takes 0.6 s
    from experiments.report.page import date_of  # noqa: PLC0415

    every = [case for each in runs for case in each.metrics.values()]
    traces = [trace for each in runs for trace in each.traces.values()]
    for name, figure in runs[0].figures().items():
        figures.save(figure, folder / "figures", name)
    return pages.write(
        folder,
        traces,
        command=command,
        date=date_of(runs[0].made),
        run=runs[0].folder,
        text=runs[0].source,
        measured=every,
        notes=[n for each in runs for n in each.notes],
    )


def _tell(runs: Sequence[Run], summary: dict[str, Any], page: Path | None) -> None:
    """The result in a few lines."""
    for finding in verdict.interruptions([case for each in runs for case in each.metrics.values()]):
        print(finding.text)
    across = summary.get("across")
    for name, case in summary["cases"].items():
        mean, ratio = case["mean"], case["ratio"]
        spread = {"f_hz": "", "iae": "", "rmse": ""}
        if across is not None:
            means = across["cases"][name]
            mean, ratio = ({k: v["mean"] for k, v in means[what].items()} for what in ("mean", "ratio"))
            spread = {k: f" ± {_figure(means['mean'][k]['ci95'])}" for k in spread}
        lost = sum(r["lost"] for r in case["robots"].values())
        line = f"{name:>12}: {_figure(mean['f_hz'])}{spread['f_hz']} messages/s"
        if mean["iae"] is None:
            line += ", no link was measured"
        else:
            acquired = "never" if mean["acquired_s"] is None else f"{mean['acquired_s']:.1f} s"
            line += f", IAE {_figure(mean['iae'])}{spread['iae']}, RMSE {_figure(mean['rmse'])}{spread['rmse']} m"
            line += f", acquired {acquired} (mean)"
        line += f", lost {lost}"
        if dropped := sum(r["dropped"] for r in case["robots"].values()):
            line += f", {dropped} dropped by the modelled network"
        if name != next(iter(summary["cases"])):
            line += f"   (ratios: f {_figure(ratio['f_hz'])}, IAE {_figure(ratio['iae'])})"
        print(line)
    for finding in verdict.contacts([case for each in runs for case in each.metrics.values()]):
        if finding.mark == "bad":
            print(finding.text)
    if across is not None:
        print(f"± is the half-width of the 95 % confidence interval of the mean over {len(runs)} seeds (Student's t)")
    for note in runs[0].notes:
        print(f"note: {note}")
    print(f"run: {runs[0].folder}")
    if page is not None:
        print(f"report: {page}")


def _figure(value: float | None) -> str:
    return "?" if value is None else f"{value:.3g}"
