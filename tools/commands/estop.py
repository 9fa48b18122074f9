"""`zenpark estop`: cut the motors of every robot. `zenpark runs`: the runs that are up on this machine."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import AsJson, Lab, routers

if TYPE_CHECKING:
    from experiments.real_time.conductor.orders import EmergencyStop

app: Final = typer.Typer()

IDENTITY: Final = "operator"


@app.command()
def estop(
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Only at this router; may be repeated. [all runs of this machine]"),
    ] = None,
    realm: Annotated[str | None, typer.Option(metavar="NAME", help="First chunk of the keys. [the run's]")] = None,
    reason: Annotated[str, typer.Option(metavar="TEXT", help="Sent with the stop.")] = "zenpark estop",
    lab: Lab = None,
    identity: Annotated[
        str | None, typer.Option("--as", metavar="NAME", help="Whose certificate, in a lab. [the run's operator]")
    ] = None,
) -> int:
    """Cut the motors of every robot of every run of this machine, or at a router."""
    from agents.network import endpoints as topology
    from agents.runtime import run_registry
    from experiments.real_time.conductor.orders import EmergencyStop

    if given := routers(connect, lab):
        return _stop_all([EmergencyStop(given, realm or "park", identity or IDENTITY)], reason)
    up = run_registry.runs()
    stops = [EmergencyStop(run.endpoints, realm or run.realm, identity or run.identity, run) for run in up]
    known = {endpoint for stop in stops for endpoint in topology.bare(stop.endpoints)}
    if topology.DEFAULT_ENDPOINT not in known:  # of a zenohd, say
        stops.append(EmergencyStop([topology.DEFAULT_ENDPOINT], realm or "park", identity or IDENTITY))
    return _stop_all(stops, reason)


def _stop_all(stops: Sequence[EmergencyStop], reason: str) -> int:
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
        "--connect, which `zenpark run` prints when it starts, or --connect @FOLDER/network.txt of its folder",
        file=sys.stderr,
    )
    return 1


@app.command()
def runs(as_json: AsJson = False) -> None:
    """Show which runs are up on this machine: routers, robots, since when, folders."""
    import msgspec

    from agents.runtime import run_registry

    found = run_registry.runs()
    if as_json:
        shown = [{**msgspec.to_builtins(run), "alive": run.alive} for run in found]
        print(msgspec.json.format(msgspec.json.encode(shown), indent=2).decode())
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
