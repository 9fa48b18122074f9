"""`./zenpark run`: an experiment in real or in virtual time."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Option

from tools.commands import view as viewing
from tools.commands.results import summary, write_metrics, write_report
from tools.options import (
    Anyway,
    As,
    AsJson,
    Bodies,
    Cases,
    File,
    Here,
    Lab,
    OpenReport,
    Out,
    Report,
    Settings,
    check_bodies,
    example,
    open_in_browser,
    print_json,
    print_result,
    warn,
    with_options,
)
from tools.terminal import lasting_console, say

if TYPE_CHECKING:
    from experiments.file.document import Document
    from experiments.metrics.results import CaseMetrics
    from experiments.real_time.conductor.conduct import RunOptions
    from experiments.recording.run_folder import RunOrigin
    from experiments.run import Run

app: Final = typer.Typer()

STOPPED: Final = 1  # exit code of a run that an emergency stop has ended,
FAILED: Final = 1  # code of one in which a robot did not do its part, or that does not keep a criterion
SPOILED: Final = 3  # code of a run with figures that cannot be compared
FEW: Final = 6  # hazards of runs in virtual time that are printed


@dataclass(frozen=True)
class Handling:
    """Options of a run that its results do not depend on: identity, consent, destination and display."""

    out: Out = None
    as_json: AsJson = False
    report: Report = True
    open_report: OpenReport = False
    lab: Lab = None
    identity: As = "operator"
    yes: Annotated[
        bool, Option("--yes", help="Agree to machines, devices and code that a bundle or another person's file names.")
    ] = False
    view: Annotated[bool, Option("--view", help="Show it in the browser, in three dimensions.")] = False
    pace: Annotated[
        float | None, Option(min=0.01, max=100.0, help="Speed of --virtual --view, as a multiple of real time. [1]")
    ] = None


@app.command(epilog=example("run robotic-park --virtual --seed 1", "run triangle --case event --tag paper"))
@with_options
def run(
    file: File,
    *,
    virtual: Annotated[bool, Option("--virtual", help="Run in virtual time, in this process, at full speed.")] = False,
    case: Cases = None,
    seed: Annotated[int | None, Option(min=0, help="Seed of all randomness, instead of the file's.")] = None,
    settings: Settings = None,
    seeds: Annotated[int, Option(min=1, max=100_000, help="Number of seeds: means and intervals (virtual only).")] = 1,
    bodies: Bodies = None,
    here: Here = False,
    anyway: Anyway = False,
    tag: Annotated[
        list[str] | None, Option("--tag", metavar="WORD", help="Label by which `./zenpark runs --past` finds it.")
    ] = None,
    handling: Handling,
) -> int:
    """Run an experiment: one process per robot, or in virtual time; a bundle repeats its run."""
    from experiments.file.problems import refusal
    from experiments.recording import bundle
    from experiments.recording.run_folder import RunOrigin

    if any(not word.isprintable() or not word.strip() or "," in word for word in tag or []):
        raise typer.BadParameter("a tag is a word without commas", param_hint="--tag")
    changes = [*(settings or []), *([] if seed is None else [f"seed={seed}"])]
    origin = RunOrigin(
        file=file, virtual=virtual, cases=case or [], changes=changes, seeds=seeds, bodies=bodies, here=here,
        anyway=anyway, tags=tag or [],
    )  # fmt: skip
    of_bundle = file.lower().endswith(bundle.SUFFIX)
    if of_bundle and origin != RunOrigin(file=file, virtual=virtual, tags=origin.tags):
        hint = "unpack it, and run its experiment file with other options"
        raise refusal(file, "a bundle repeats its own run, and takes no options of it", hint)
    with lasting_console():
        return _repeat(origin, handling) if of_bundle else _run(origin, handling)


def _run(origin: RunOrigin, handling: Handling, *, former: Path | None = None, bundle: str = "") -> int:
    """Run an experiment; of a `bundle`, in virtual time the results are compared with those of the folder `former`."""
    from experiments.file.document import load
    from experiments.metrics.criteria import has_passed, judge
    from experiments.real_time.conductor.conduct import RunOptions
    from experiments.recording.cleaning import using
    from experiments.recording.run_folder import SOURCE, check_folder, new_folder, remove_unused
    from experiments.report import verdict

    options = RunOptions(origin.cases, origin.bodies, origin.here, handling.lab, handling.identity)
    read = load(origin.file, *origin.changes)
    check_folder(handling.out)
    _refuse(origin, handling)
    real = not origin.virtual and origin.bodies is None
    seeds, as_json, anyway = origin.seeds, handling.as_json, origin.anyway
    if code := refused(read, origin.cases, real=real, seeds=seeds, as_json=as_json, anyway=anyway):
        return code
    if not origin.virtual:
        from experiments.real_time.conductor.conduct import with_bodies
        from tools import consent

        if bundle or consent.belongs_to_another(read.path):
            consent.require(bundle or str(read.path), with_bodies(read, options), given=handling.yes)
    folder = new_folder(read, handling.out)
    unwritten: list[str] = []  # what the disk did not take
    try:
        read.keep(folder / SOURCE)
        with using(folder), _kept_origin(folder, origin, read, options, unwritten):
            if origin.virtual:
                runs = _simulate(read, folder, options, origin.seeds, unwritten)
                stopped, code = "", 0
            else:
                with viewing.following(folder, options.identity) if handling.view else nullcontext():
                    runs, stopped, code = _conduct(read, folder, options, unwritten, quiet=handling.as_json)
        if not runs:
            return code
        if not runs[0].traces:
            why = stopped or ("interrupted" if code else "failed: no begin of a robot is recorded")
            why += "" if why.startswith("failed: ") else ", before the common start"
            why += f": there is nothing to report; logs: {folder / 'logs'}"
            print_result({"ok": False, "error": why}, why, as_json=handling.as_json)
            return code or FAILED
        _write(runs, folder, handling, unwritten)
        warn([*([stopped] if stopped else []), *unwritten])
        if not code:
            cases = [case for each in runs for case in each.metrics.values()]
            failures = verdict.failures(cases)
            warn([finding.text for finding in failures])
            code = FAILED if failures or stopped or unwritten or has_passed(judge(cases)) is False else 0
            if not code and any(case.spoiled for case in cases):
                code = SPOILED
        if origin.virtual and handling.view and not unwritten:
            viewing.play(folder, handling.pace or 1.0)
        return code if former is None else max(code, _print_differences(folder, former, quiet=handling.as_json))
    finally:
        remove_unused(folder)


@contextmanager
def _noting(folder: Path, unwritten: list[str]) -> Iterator[None]:
    """Note that the disk takes no more, instead of an end: the figures of a run are printed in any case."""
    try:
        yield
    except OSError as error:
        if not unwritten:
            remedy = f"make room there, then `./zenpark report {folder}`"
            unwritten.append(f"{folder}: cannot be written: {error.strerror}; {remedy}")


@contextmanager
def _kept_origin(
    folder: Path, origin: RunOrigin, read: Document, options: RunOptions, unwritten: list[str]
) -> Iterator[None]:
    """Keep how a run is made in its folder, from the beginning on; its end as well."""
    import time

    import msgspec

    from experiments.recording.run_folder import keep_origin, read_origin
    from experiments.recording.version import load, provenance
    from experiments.report.page import date_of

    begun = time.time()
    made = msgspec.structs.replace(
        origin,
        # of a repeated one the command is known, and the file is gone afterwards
        file=Path(origin.file).name if origin.command else origin.file,
        command=origin.command or _command(origin, options),
        date=date_of(begun),
        title=read.experiment.title,
        begun=begun,
        made_by=provenance(read.text),
    )
    keep_origin(folder, made)
    try:
        yield
    finally:
        end = msgspec.structs.replace(read_origin(folder) or made, ended=time.time(), load_after=load())
        with _noting(folder, unwritten):
            keep_origin(folder, end)


def _repeat(asked: RunOrigin, handling: Handling) -> int:
    """Repeat the run of a bundle; in virtual time the results are compared to the last bit."""
    from tempfile import TemporaryDirectory

    import msgspec

    from experiments.file.problems import refusal
    from experiments.recording import bundle
    from experiments.recording.run_folder import SOURCE
    from experiments.recording.version import provenance

    with TemporaryDirectory(prefix="zenpark-bundle-") as unpacked:
        former = Path(unpacked)
        origin = bundle.unpack(Path(asked.file), former)
        code = [file.name for file in sorted(former.rglob("*.py")) if file.parent.name != "plugins"]
        if code and not handling.yes:
            hint = "unpack it and look at them, then agree with --yes"
            raise refusal(asked.file, f"its run executes Python files of the bundle: {', '.join(code)}", hint)
        if origin.made_by is not None:
            text = (former / SOURCE).read_text("utf-8")
            warn([f"{asked.file}: {each}" for each in provenance(text).differences(origin.made_by)])
        again = msgspec.structs.replace(
            origin,
            command=f"./zenpark run {asked.file}" + " --virtual" * (asked.virtual and not origin.virtual),
            virtual=origin.virtual or asked.virtual,
            tags=asked.tags,
            failures=[],
            ended=None,
            load_after=None,
        )
        if again.virtual:
            again = msgspec.structs.replace(again, bodies=None, here=False)
        return _run(again, handling, former=former if origin.virtual else None, bundle=asked.file)


def _print_differences(folder: Path, former: Path, *, quiet: bool) -> int:
    """Print whether a repeated run gave the same results to the last bit; returns the exit code."""
    from experiments.recording import bundle

    found = bundle.differences(folder, former)
    for each in found:
        warn([f"differs from the bundle: {each}"])
    if not found and not quiet:
        say("the same as in the bundle, to the last bit: figures and recordings")
    return int(bool(found))


def _simulate(read: Document, folder: Path, options: RunOptions, seeds: int, unwritten: list[str]) -> list[Run]:
    """Run in virtual time, one run for each seed from the file's on."""
    from experiments.run import Unrecorded, simulate_seeds
    from tools.progress import Bar

    first = read.experiment.seed
    try:
        with Bar(passing=True) as bar:
            return simulate_seeds(
                read,
                range(first, first + seeds),
                cases=options.cases,
                folder=folder,
                progress=lambda case, done, of: bar.show(f"{case}, simulated s", done, of),
            )
    except Unrecorded as error:
        unwritten.append(str(error))
        return error.runs
    except KeyboardInterrupt:
        cases = ", ".join(sorted(file.stem for file in folder.glob("*.mcap")))
        kept = f"kept is seed {first} of {cases}, in {folder}" if cases else "nothing is kept"
        more = "; `./zenpark sweep` keeps every seed that is done, and goes on from there" if seeds > 1 else ""
        print(f"\ninterrupted: {kept}{more}", file=sys.stderr)
        raise


def _conduct(
    read: Document, folder: Path, options: RunOptions, unwritten: list[str], *, quiet: bool
) -> tuple[list[Run], str, int]:
    """Run in real time.

    Returns the run, none if it was ended at once; why it was stopped or failed, else an empty text; the exit code.
    """
    import msgspec

    from agents.runtime.command_line import interrupts
    from experiments.real_time.conductor.conduct import Supervision, conduct
    from experiments.real_time.conductor.orders import Emergency
    from experiments.recording.run_folder import keep_origin, read_origin
    from experiments.run import read_back
    from tools.progress import shown

    emergency = Emergency()
    with interrupts() as interrupted:
        try:
            user = Supervision(shown(quiet=quiet), interrupted, emergency, tell=warn)
            ended = conduct(read, folder, options, user)
            if ended.failures and (made := read_origin(folder)) is not None:
                with _noting(folder, unwritten):
                    keep_origin(folder, msgspec.structs.replace(made, failures=ended.failures))
            runs = [read_back(folder, ended.recordings, ended.notes, ended.failures)]
        except KeyboardInterrupt:
            print(f"\nended at once; `./zenpark report {folder}` shows what was recorded", file=sys.stderr)
            return [], "", 130
    # of a case with figures they stand beside these
    untold = [why for why in ended.failures if why.partition(": ")[0] not in runs[0].metrics]
    failed = f"failed: {'; '.join(untold)}" if untold and not interrupted() else ""
    return runs, emergency.words or failed, STOPPED if emergency else 130 if interrupted() else 0


def _write(runs: Sequence[Run], folder: Path, handling: Handling, unwritten: list[str]) -> None:
    """Write and print the results."""
    page = None
    with _noting(folder, unwritten):
        write_metrics(runs, folder)
        page = write_report(runs, folder) if handling.report else None
    found = summary(runs)
    print_result(found, *_lines(runs, found, page), as_json=handling.as_json)
    if handling.open_report and page is not None:
        open_in_browser(page.resolve().as_uri())


def _refuse(origin: RunOrigin, handling: Handling) -> None:
    """Raise DocumentError for options that do not go together, before anything is started."""
    from experiments.file.problems import refusal

    if origin.seeds > 1 and not origin.virtual:
        hint = "in real time, run once per --seed; `./zenpark report RUN RUN --pool` makes one of them"
        raise refusal("--seeds", "only for --virtual", hint)
    check_bodies(origin.bodies)
    for option, given in (("--bodies", origin.bodies), ("--lab", handling.lab)):
        if given is not None and origin.virtual:
            raise refusal(option, "only for real time", "leave out --virtual")
    if handling.pace is not None and not (origin.virtual and handling.view):
        raise refusal("--pace", "only for --virtual --view", "add both, or leave it out")
    if handling.view:
        viewing.require_viser()
        if origin.seeds > 1:
            raise refusal("--seeds", "one run is viewed", "leave out --view or --seeds")


def refused(read: Document, cases: Sequence[str] = (), *, real: bool, seeds: int, as_json: bool, anyway: bool) -> int:
    """Print the warnings and errors of the check of a run, errors that prevent it as JSON too.

    Of the devices of robots only those of a run with `real` bodies.

    Returns:
        Exit code of the refusal, 0 for none; `FAILED` where robots flee each other, which no criterion is met by.

    Raises:
        DocumentError: If there is no such case.
    """
    from experiments.check.check import check
    from experiments.check.findings import APART, DEVICE, NOT_RANDOM

    found = [finding for finding in check(read, cases) if finding.severity in {"error", "warning"}]
    if not real:
        found = [finding for finding in found if finding.code != DEVICE]
    if seeds == 1:
        found = [finding for finding in found if finding.code != NOT_RANDOM]
    say(*map(str, found), to=sys.stderr)
    errors = {finding.code for finding in found if finding.severity == "error"}
    if anyway or not errors:
        return 0
    criteria = read.experiment.criteria if errors == {APART} else ()
    if as_json:
        verdict = {"passed": False} if criteria else {}
        print_json({"ok": False, "error": "the check found errors", "findings": found, **verdict})
    if criteria:
        say(*(f"✗ Not passed. {each.why}" for each in criteria[:1]), to=sys.stderr)
        return FAILED
    print("zenpark: not run; mend the file (`./zenpark check` says more), or run it --anyway", file=sys.stderr)
    return 2


def _command(origin: RunOrigin, options: RunOptions) -> str:
    parts = ["./zenpark", "run", origin.file, *(["--virtual"] if origin.virtual else [])]
    parts += [part for case in origin.cases for part in ("--case", case)]
    parts += [part for change in origin.changes for part in ("--set", f"'{change}'")]
    parts += ["--seeds", str(origin.seeds)] if origin.seeds > 1 else []
    parts += ["--bodies", origin.bodies] if origin.bodies is not None else []
    parts += ["--here"] if origin.here else []
    parts += ["--lab", options.lab] if options.lab is not None else []
    parts += ["--as", options.identity] if options.identity != "operator" else []
    return " ".join([*parts, *(["--anyway"] if origin.anyway else [])])


def _lines(runs: Sequence[Run], found: dict[str, Any], page: Path | None) -> Iterator[str]:
    """The results in a few lines."""
    from experiments.report import verdict

    cases = [case for each in runs for case in each.metrics.values()]
    yield from map(str, verdict.spoiled(cases))
    yield from (finding.text for finding in verdict.interruptions(cases))
    yield from (finding.text for finding in verdict.troubles(cases) if finding.mark == "fair")
    yield from _hazards(runs)
    yield from (_case_line(name, runs, found) for name in found["cases"])
    if any(case.leaders for case in cases):
        yield verdict.left_out(cases)
    yield from (finding.text for finding in verdict.contacts(cases) if finding.mark == "bad")
    yield from (finding.text for finding in verdict.metric_faults(cases))
    yield from map(str, verdict.criteria_met(cases))
    if len(runs) > 1:
        yield f"± is the half-width of the 95 % confidence interval of the mean over {len(runs)} seeds (Student's t)"
    yield from (f"note: {note}" for note in runs[0].notes)
    yield f"run: {runs[0].folder}"
    if page is not None:
        yield f"report: {page}"
    yield f"replay in the browser: ./zenpark view {runs[0].folder}"


def _hazards(runs: Sequence[Run]) -> Iterator[str]:
    """The first hazards of runs in virtual time, in the words of a run in real time, which prints each as it comes."""
    found = [
        f"{case}: hazard {event.source}: {event.text} (at {event.stamp:.1f} s{f', seed {run.seed}' * (len(runs) > 1)})"
        for run in runs
        for case, trace in run.traces.items()
        for event in trace.events
        if event.kind == "hazard" and run.metrics[case].clock == "virtual"
    ]
    yield from found[:FEW]
    if (more := len(found) - FEW) > 0:
        yield f"and {more} more, in the recording and the report"


def _case_line(name: str, runs: Sequence[Run], found: dict[str, Any]) -> str:
    """The key figures of a case, over all seeds: means of a robot; losses are sums over all robots."""
    from experiments.metrics.metric import OF_LAW, OURS, console_metrics, terminal_labels
    from experiments.metrics.statistics import Spread, spread
    from experiments.report.page import interval
    from experiments.report.tables import ratio_words

    case = found["cases"][name]
    means, shares = ({k: spread([v]) for k, v in case[what].items()} for what in ("mean", "ratio"))
    if "across" in found:
        across = found["across"]["cases"][name]
        means, shares = ({k: Spread(**v) for k, v in across[what].items()} for what in ("mean", "ratio"))
    mean, ratio = {k: interval(v) for k, v in means.items()}, {k: ratio_words(v) for k, v in shares.items()}
    measured = [each.metrics[name] for each in runs if name in each.metrics]
    linked = case["mean"]["iae"] is not None
    metrics = {each: metric for each, metric in console_metrics(measured).items() if each in mean}
    for each in OURS:
        if case["mean"].get(each) is None and each != "f_hz" and not (linked and each == "acquired_s"):
            metrics.pop(each, None)
    of_law = [each for each in metrics if each.startswith(OF_LAW)]
    for each in of_law[0 if linked else FEW :]:  # measures stand for errors
        del metrics[each]
    labels = terminal_labels(metrics)
    parts = {each: f"{labels[each]} {mean[each]} {metric.unit}".rstrip() for each, metric in metrics.items()}
    parts["f_hz"] += " per robot" if linked else " per robot, no link was measured"
    if linked:
        parts["acquired_s"] = _acquired(mean["acquired_s"], measured)
    line = f"{name:>12}: {', '.join(parts.values())}"
    line += f", lost {sum(each.lost for each in measured)}"
    if missed := sum(each.missed_deadlines for each in measured):
        share = spread([each.missed_share for each in measured]).mean or 0.0
        line += f", {missed} deadlines missed ({100.0 * share:.2g} %)"
    if dropped := sum(each.dropped for each in measured):
        line += f", {dropped} dropped by the modelled network"
    if name != next(iter(found["cases"])) and shares["f_hz"].mean is not None:
        judged = [each for each, metric in metrics.items() if each == "f_hz" or (metric.relative and metric.shown)]
        line += f"   (ratios: {', '.join(f'{labels[each]} {ratio[each]}' for each in judged)})"
    return line


def _acquired(mean: str, runs: Sequence[CaseMetrics]) -> str:
    """Time of acquisition in words, over the seeds: `mean` is over those in which all robots acquired."""
    n, of = sum(run.mean["acquired_s"] is not None for run in runs), len(runs)
    if n:
        return f"acquired after {mean} s (mean{f' of {n} of {of} seeds, the others never' * (n < of)})"
    judged = [robot for run in runs for robot in run.robots if robot.robot not in {*run.leaders, *run.died}]
    some = sum(robot.acquired_s is not None for robot in judged)
    return f"not acquired by all{f' in any of {of} seeds' * (of > 1)} ({some} of {len(judged)} robots were there)"
