"""Commands before a run: check an experiment file, check its robots."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Option

from tools.options import (
    WIDEST,
    As,
    AsJson,
    Bodies,
    Cases,
    File,
    Here,
    Lab,
    Out,
    Settings,
    check_bodies,
    example,
    json_text,
    print_json,
    warn,
)

if TYPE_CHECKING:
    from experiments.check.analysis import Analysis
    from experiments.check.findings import CheckNumbers, Finding
    from experiments.file.document import Document
    from experiments.real_time.conductor.preflight_checks import RobotChecks

app: Final = typer.Typer()

CHECKED: Final = {"ok": "✓", "warn": "!", "bad": "✗", "unknown": "·"}


@app.command(epilog=example("check triangle.toml", "check triangle.toml --fix --plot triangle.svg"))
def check(
    file: File,
    *,
    settings: Settings = None,
    fix: Annotated[bool, Option("--fix", help="Print the links with the nearest targets that fit together.")] = False,
    plot: Annotated[Path | None, Option("--plot", help="Draw shape, links, expected ways (.svg, .pdf, .png).")] = None,
    as_json: AsJson = False,
) -> int:
    """Check an experiment file and say what theory says of it; exit code 2 for errors of the file, 1 of theory."""
    from experiments.check.check import analyses, examine, unreadable
    from experiments.file import document
    from experiments.file.problems import DocumentError

    if plot is not None and plot.suffix not in {".svg", ".pdf", ".png"}:
        raise typer.BadParameter(f"{plot}: the name must end in .svg, .pdf or .png", param_hint="--plot")
    try:
        given = document.read(file, settings or [])
        analysed = analyses(given.cases())
    except DocumentError as error:
        if not as_json:
            raise
        _print_json(file, [unreadable(each) for each in error.problems], {})
        return 2
    findings, numbers = examine(given, analysed)
    if as_json:
        _print_json(str(given.path), findings, numbers)
    else:
        _print_table(given, findings, numbers)
    if fix and not as_json:
        _print_fitting(analysed)
    if plot is not None:
        _draw(analysed, plot)
    return 1 if any(each.severity == "error" for each in findings) else 0


def _print_fitting(analysed: Mapping[str, Analysis]) -> None:
    """Prints the links of the first case, and of further cases where they differ."""
    from msgspec import to_builtins

    from experiments.file.reference import written

    printed: list[object] = []
    for case, known in analysed.items():
        links = known.fitting_links()
        if links in printed:
            continue
        print(f"\n[{'formation.links' if not printed else f'cases.{case}.formation.links'}]")
        for text, link in links.items():
            target = to_builtins(link)
            print(f"{written(text)} = {written(target['distance'] if set(target) == {'distance'} else target)}")
        printed.append(links)


def _draw(analysed: Mapping[str, Analysis], file: Path) -> None:
    from experiments.report.trajectories import expected_motion

    try:
        expected_motion(analysed).savefig(file, dpi=200)
    except OSError as error:
        raise typer.BadParameter(f"{file}: {error.strerror}", param_hint="--plot") from None
    print(f"\n{file}: target shape, links and expected ways")


@app.command(epilog=example("preflight lab.toml", "preflight lab.toml --hop --case event"))
def preflight(
    file: File,
    *,
    case: Cases = None,
    settings: Settings = None,
    bodies: Bodies = None,
    hop: Annotated[bool, Option("--hop", help="Robot by robot: drones hop 20 cm, others drive 10 cm.")] = False,
    stop: Annotated[bool, Option("--stop", help="Robot by robot: an emergency stop as it climbs or drives.")] = False,
    sticks: Annotated[bool, Option("--sticks", help="Tello by Tello: its speed at a fifth of its sticks.")] = False,
    here: Here = False,
    lab: Lab = None,
    identity: As = "operator",
    out: Out = None,
    as_json: AsJson = False,
) -> int:
    """Check the robots of an experiment before the first flight; motors turn with --hop, --stop and --sticks only."""
    from agents.runtime.command_line import interrupts
    from experiments.file.document import chosen, load
    from experiments.real_time.conductor.conduct import RunOptions, Supervision
    from experiments.real_time.conductor.orders import Emergency
    from experiments.real_time.conductor.preflight import Trials, check_robots
    from experiments.recording.run_folder import new_folder, remove_unused
    from tools.progress import shown
    from tools.terminal import lasting_console

    options = RunOptions(case or [], bodies, here, lab, identity)
    read = load(file, *(settings or []))
    check_bodies(bodies)
    chosen(read, options.cases)
    folder, emergency = new_folder(read, out, "preflight"), Emergency()
    try:
        with lasting_console(), interrupts() as interrupted:
            user = Supervision(shown(quiet=as_json), interrupted, emergency, tell=warn)
            found = check_robots(read, folder, options, Trials(hop=hop, stop=stop, own=sticks), user)
            ended = interrupted()
    finally:
        remove_unused(folder)
    red = [each.robot for each in found if each.red]
    ok = not (red or ended or emergency)
    text = json_text({"file": read.path, "ok": ok, "robots": found, "folder": folder})
    if folder.exists():
        (folder / "preflight.json").write_text(f"{text}\n", encoding="utf-8")
    if as_json:
        print(text)
    else:
        _print_checks(found)
        stopped = "interrupted" if ended else "ended by an emergency stop" if emergency else ""
        verdict = f"red: {', '.join(red)}" if red else stopped or "nothing is red"
        print(f"\n{verdict}; {folder / 'preflight.json'}, logs: {folder / 'logs'}")
    if emergency:
        print(f"zenpark: {emergency.words}", file=sys.stderr)
    return 130 if ended else int(bool(red or emergency))


def _print_checks(found: Sequence[RobotChecks]) -> None:
    """A table for each robot: a line for each check, and what to do about each that is not green."""
    width, lines = _width(), []
    for robot in found:
        lines += ["", f"{robot.robot}  {robot.kind}  {robot.body}"]
        for check in robot.checks:
            head = f"  {CHECKED[check.verdict]} {check.check:<16} "
            lines += textwrap.wrap(check.found, width, initial_indent=head, subsequent_indent=" " * len(head))
            if check.remedy:
                lines += textwrap.wrap(check.remedy, width, initial_indent=" " * 21 + "→ ", subsequent_indent=" " * 23)
    _print_text("\n".join(lines))


def _width() -> int:
    """Columns of print: those of the terminal, if it is not wide."""
    import shutil

    return min(WIDEST, shutil.get_terminal_size((WIDEST, 24)).columns)


def _print_text(text: str) -> None:
    encoding = sys.stdout.encoding or "utf-8"  # a terminal may know neither ticks nor Greek
    print(text.encode(encoding, "replace").decode(encoding))


def _print_json(file: str, found: Sequence[Finding], numbers: Mapping[str, CheckNumbers]) -> None:
    ok = all(each.severity != "error" for each in found)
    print_json({"file": file, "ok": ok, "findings": found, "figures": numbers})


def _print_table(read: Document, findings: Sequence[Finding], numbers: Mapping[str, CheckNumbers]) -> None:
    from experiments.check.findings import MARK

    width = _width()
    lines = [f"{read.path}: {read.experiment.title}", ""]
    for each in findings:
        lines += textwrap.wrap(each.message, width, initial_indent=f"{MARK[each.severity]} ", subsequent_indent="  ")
        if each.severity in {"error", "warning"}:
            remedy = f"{each.where}: {each.remedy}" if each.where else each.remedy
            lines += textwrap.wrap(
                remedy, width, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False
            )
    lines += ["", *_rows(numbers), ""]
    count = {severity: sum(each.severity == severity for each in findings) for severity in MARK}
    lines.append(f"{_counted(count['error'], 'error')}, {_counted(count['warning'], 'warning')}")
    _print_text("\n".join(lines))


def _counted(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'s' * (count != 1)}"


def _rows(numbers: Mapping[str, CheckNumbers]) -> list[str]:
    """A line for each figure; where the cases differ, each with its name."""
    worded = {name: _formatted(each) for name, each in numbers.items()}
    lines = []
    for label in next(iter(worded.values())):
        values = {name: words[label] for name, words in worded.items()}
        if set(values.values()) == {"-"}:  # it has no meaning for this law
            continue
        same = len(set(values.values())) == 1
        shown = next(iter(values.values())) if same else ", ".join(f"{name} {word}" for name, word in values.items())
        lines.append(f"  {label:<36}{shown}")
    return lines


def _formatted(of: CheckNumbers) -> dict[str, str]:
    from agents.errors import join_names

    def number(value: float | None, form: str, unit: str = "") -> str:
        return "-" if value is None else f"{value:{form}}{unit}"

    of_loop = "not known for a law with a memory" if of.remembers else None
    return {
        "robots": f"{of.robots}, leader: {', '.join(of.leaders) or 'none'}",
        "arena": f"{' × '.join(f'{length:g}' for length in of.arena)} m",
        "obstacles": join_names([f"{name} ({what})" for name, what in of.obstacles.items()]) or "none",
        "links": f"{of.links} one-way, {of.edges} pairs",
        "algebraic connectivity": number(of.algebraic_connectivity, ".3f"),
        "rigidity rank, heights held": _rank_text(of.rank, of.rank_needed),
        "rigidity rank in space": _rank_text(of.rank_space, of.rank_space_needed),
        "smallest rigidity eigenvalue": number(of.smallest_eigenvalue, ".2g", " m²"),
        "single links it can lose": _redundancy_text(of.spare_links, len(of.vital_links)),
        "single robots it can lose": _redundancy_text(of.spare_robots, len(of.vital_robots)),
        "distances met to": number(of.residual_mm, ".1f", " mm"),
        "loop gain (unstable from 2)": of_loop or number(of.loop_gain, ".3g"),
        "slowest mode": of_loop
        or number(of.slowest_mode_s, ".1f", " s to fall to 37 %; acquired is within the tolerance")
        + (f", {of.free_modes} slower than the run: free" if of.free_modes else ""),
        "speed of the fastest plan": number(of.speed_needed, ".3f", " m/s"),
        "speed of the slowest follower": number(of.speed_available, ".3f", " m/s"),
        "formation acquired after": number(of.acquired_s, ".1f", " s")
        + (f", with noise {of.acquired_noisy_s:.1f} s" if _differs(of.acquired_s, of.acquired_noisy_s) else ""),
        "worst link at the end": number(of.end_error_mm, ".1f", " mm"),
        "all end inside the arena": ("yes" if of.end_inside else "no") if of.predicted_s else "-",
        "poses sent by all, estimated": number(of.messages_hz if of.predicted_s else None, ".1f", " per second"),
        "payload of one pose, at most": f"{of.pose_bytes} bytes"
        + (f", {of.words_bytes} of them said by the law" if of.words_bytes else ""),
        "payload of one robot, at most": number(of.pose_kbit_s, ".0f", " kbit/s"),
    }


def _differs(ideal: float | None, noisy: float | None) -> bool:
    """Whether the time with noise says something else than the one without."""
    from experiments.check.findings import DELAYED

    return noisy is not None and (ideal is None or noisy > max(DELAYED * ideal, ideal + 1.0))


def _rank_text(rank: int | None, needed: int | None) -> str:
    return "-" if rank is None or needed is None else f"{rank} of {needed}"


def _redundancy_text(spare: int | None, vital: int) -> str:
    return "-" if spare is None else f"{spare} of {spare + vital}"
