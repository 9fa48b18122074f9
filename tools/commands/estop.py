"""`estop`: cut the motors of every robot. `runs`, `clean`: the runs of this machine, up and past."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import CONNECT, AsJson, Lab, example, print_json, routers

if TYPE_CHECKING:
    from experiments.real_time.conductor.orders import EmergencyStop
    from experiments.recording.run_folder import PastRun

app: Final = typer.Typer()

IDENTITY: Final = "operator"


@app.command(epilog=example("estop", "estop --connect @runs/first/network.txt"))
def estop(
    *,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENDPOINT",
            help=f"Only at this router; may be repeated. [all runs of this machine, and the routers of ${CONNECT}]",
        ),
    ] = None,
    realm: Annotated[str | None, typer.Option(metavar="NAME", help="First chunk of the keys. [the run's]")] = None,
    reason: Annotated[str, typer.Option(metavar="TEXT", help="Sent with the stop.")] = "zenpark estop",
    lab: Lab = None,
    identity: Annotated[
        str | None, typer.Option("--as", metavar="NAME", help="Whose certificate, in a lab. [the run's operator]")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Cut the motors of every robot of every run of this machine, or at a router."""
    from agents.network import endpoints as topology
    from agents.runtime import run_registry
    from experiments.real_time.conductor.orders import EmergencyStop

    if given := routers(connect, lab):
        return _stop_all([EmergencyStop(given, realm or "park", identity or IDENTITY)], reason, as_json=as_json)
    up = run_registry.runs()
    stops = [EmergencyStop(run.endpoints, realm or run.realm, identity or run.identity, run) for run in up]
    known = {endpoint for stop in stops for endpoint in topology.bare(stop.endpoints)}
    for others in (_of_environment(lab), [topology.DEFAULT_ENDPOINT]):  # of another machine; of a zenohd, say
        if others and known.isdisjoint(topology.bare(others)):
            stops.append(EmergencyStop(others, realm or "park", identity or IDENTITY))
            known |= {*topology.bare(others)}
    return _stop_all(stops, reason, as_json=as_json)


def _of_environment(lab: str | None) -> list[str]:
    """Routers that the environment names; none if they are wrong, which must not keep the others from being stopped."""
    import os

    from agents.network.endpoints import EndpointError
    from agents.network.lab import LabError

    try:
        return routers(os.environ.get(CONNECT, "").split(), lab)
    except (EndpointError, LabError) as error:
        print(f"zenpark: {CONNECT}: {error}", file=sys.stderr)
        return []


def _stop_all(stops: Sequence[EmergencyStop], reason: str, *, as_json: bool) -> int:
    """Send all stops at the same time and print their results.

    Returns:
        The exit code: 0, or 1 if a robot has not stopped in time, or if no robot was seen.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    threads = [threading.Thread(target=stop.send, args=(reason,), daemon=True) for stop in stops]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if as_json:
        routers_asked = [
            {
                "where": stop.where,
                "stopped": sorted(stop.seen - stop.moving),
                "not_known_to_have_stopped": sorted(stop.moving),
                "failure": None if stop.failure is None else str(stop.failure),
            }
            for stop in stops
        ]
        missed = any(stop.moving or (stop.expected and not stop.seen) for stop in stops)
        ok = not missed and any(stop.seen for stop in stops)
        print_json({"ok": ok, "routers": routers_asked})
        return int(not ok)
    bad = False
    seen = [stop for stop in stops if stop.seen]
    for stop in stops:
        known = "" if stop.run is None else f" ({stop.where})"
        if stop.moving:
            print(f"NOT known to have stopped: {', '.join(sorted(stop.moving))}{known}", file=sys.stderr)
            bad = True
        elif stop.seen:
            print(f"stopped: {', '.join(sorted(stop.seen))}{known}", flush=True)
        elif stop.expected:
            why = "no robot is there" if stop.failure is None else str(stop.failure)
            print(f"NOT known to have stopped: {stop.where}: {why}", file=sys.stderr)
            bad = True
    if seen or bad:
        return int(bad)
    failures = [stop.failure for stop in stops if stop.failure is not None]
    if len(failures) == len(stops):
        raise failures[-1]
    where = "; ".join(f"in the realm '{stop.realm}' {stop.where}" for stop in stops if stop.failure is None)
    print(
        f"NOTHING WAS STOPPED: no robot is seen {where}. Name the router of the run: "
        "--connect, which `./zenpark run` prints when it starts, or --connect @FOLDER/network.txt of its folder",
        file=sys.stderr,
    )
    return 1


Words = Annotated[
    list[str] | None, typer.Argument(metavar="[WORD...]", help="Runs with all of these as tag, or in name and title.")
]
Below = Annotated[list[str] | None, typer.Option("--in", metavar="FOLDER", help="Where to look for runs. [runs]")]


@app.command(epilog=example("runs", "runs --past paper --json"))
def runs(
    words: Words = None,
    *,
    past: Annotated[bool, typer.Option("--past", help="Those that are over.")] = False,
    below: Below = None,
    as_json: AsJson = False,
) -> None:
    """Show which runs are up on this machine; with --past those that left their folders, with key figures."""
    if past or words or below:
        return _show_past(words or [], below, as_json=as_json)
    return _show_running(as_json=as_json)


def _show_running(*, as_json: bool) -> None:
    import msgspec

    from agents.runtime import run_registry

    found = run_registry.runs()
    if as_json:
        print_json([{**msgspec.to_builtins(run), "alive": run.alive} for run in found])
        return
    for run in found:
        since = time.strftime("%H:%M:%S", time.localtime(run.since))
        died = "" if run.alive else "; its process has died"
        print(f"{run.title}  since {since}, pid {run.pid}, at {run.where}, realm {run.realm}{died}")
        if run.folder:
            print(f"  {run.folder}")
        if run.robots:
            print("  " + ", ".join(f"{name} ({body})" if body else name for name, body in run.robots.items()))
    if not found:
        print("no run is up on this machine")


def _past(words: Sequence[str], below: list[str] | None) -> list[PastRun]:
    from pathlib import Path

    from experiments.recording.run_folder import RUNS, past_runs

    folders = [Path(each) for each in below] if below else [RUNS]
    return [run for run in past_runs(folders) if run.matches(words)]


def _show_past(words: Sequence[str], below: list[str] | None, *, as_json: bool) -> None:
    from experiments.recording.run_folder import day_of
    from tools.progress import columns

    found = _past(words, below)
    if as_json:
        print_json(found)
        return
    if not found:
        print("no run of that kind" if words else f"no run in {', '.join(below or ['runs'])}")
        return
    head = ("when, UTC", "run", "case", "1/s", "IAE", "RMSE, m", "acquired, s", "MB", "tags")
    rows = []
    for run in found:
        clock = " (virtual)" * run.origin.virtual
        first = [day_of(run), f"{run.folder}{clock}"]
        for k, (case, figures) in enumerate((run.cases or {"-": {}}).items()):
            values = ["-" if value is None else f"{value:.3g}" for value in figures.values()] or ["-"] * 4
            last = [f"{run.megabytes:.1f}", ", ".join(run.origin.tags)] if k == 0 else ["", ""]
            rows.append([*(first if k == 0 else ["", ""]), case, *values, *last])
    print("\n".join(columns([head, *rows])))
    print(f"runs: {len(found)}, {sum(run.megabytes for run in found):.1f} MB")


@app.command(epilog=example("clean --older 30", "clean --older 30 --recordings --yes"))
def clean(
    words: Words = None,
    *,
    older: Annotated[float | None, typer.Option(min=0.0, metavar="DAYS", help="Older than this.")] = None,
    recordings: Annotated[
        bool, typer.Option("--recordings", help="Only recordings and logs; figures, report and file stay.")
    ] = False,
    tagged: Annotated[bool, typer.Option("--tagged", help="Also runs that have a tag.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Does it; else it is only shown.")] = False,
    below: Below = None,
) -> int:
    """Remove folders of past runs: those of some words or age, never one with a tag or one that is up."""
    import shutil
    from pathlib import Path

    from agents.runtime import run_registry
    from experiments.recording.run_folder import age_days

    if not words and older is None:
        raise typer.BadParameter("say which: words, or --older DAYS (0: all)")
    up = {Path(run.folder).resolve() for run in run_registry.runs() if run.folder}
    now = time.time()
    chosen = [
        run
        for run in _past(words or [], below)
        if (tagged or not run.origin.tags) and Path(run.folder).resolve() not in up
        if older is None or age_days(run, now) > older
    ]
    for run in chosen:
        folder = Path(run.folder)
        parts = [*folder.glob("*.mcap"), *folder.glob("logs")] if recordings else [folder]
        try:
            for part in parts if yes else ():
                shutil.rmtree(part) if part.is_dir() else part.unlink()
        except OSError as error:
            print(f"zenpark: {error.filename}: cannot be removed: {error.strerror}", file=sys.stderr)
            return 1
        print(f"{'removed' if yes else 'would remove'} {', '.join(map(str, parts)) or f'nothing of {folder}'}")
    print(f"runs: {len(chosen)}" + ("" if yes or not chosen else "; --yes does it"))
    return 0
