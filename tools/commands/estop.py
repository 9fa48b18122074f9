"""`zenpark estop`: cut the motors of every robot. `zenpark runs`: the runs that are up on this machine."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import AsJson, Lab, routers

if TYPE_CHECKING:
    import zenoh

    from agents.runtime.run_registry import Run

app: Final = typer.Typer()

ANSWER_S: Final = 2.0
AGAIN_S: Final = 0.05
STOPPED: Final = "done"
IDENTITY: Final = "operator"


@dataclass
class _Stop:
    """An emergency stop at the routers of one run."""

    endpoints: Sequence[str]
    realm: str
    identity: str  # whose certificate is shown, in a lab
    run: Run | None = None  # None: only the routers are known
    seen: set[str] = field(default_factory=set)  # robots that were alive
    moving: set[str] = field(default_factory=set)  # those of them without a report of their stop
    failure: Exception | None = None  # why the routers cannot be reached

    @property
    def where(self) -> str:
        from agents.network import endpoints as topology

        return f"at {', '.join(topology.bare(self.endpoints))}" if self.run is None else self.run.words

    @property
    def expected(self) -> bool:
        """Whether robots must be alive: the process of a run on this machine is."""
        return self.run is not None and self.run.what == "run" and self.run.alive

    def send(self, reason: str) -> None:
        """Send the stop until every robot that is alive reports that it has stopped."""
        try:
            self._send(reason)
        except Exception as error:  # noqa: BLE001 - the others are stopped whatever happens to this one
            self.failure = error

    def _send(self, reason: str) -> None:
        import zenoh

        from agents.network import messages, pubsub
        from agents.network import session as network
        from agents.network.keys import Keys
        from agents.network.shutdown import held

        keys = Keys(self.realm)
        # a robot that does not answer must not delay the others' stop
        opened = network.open_session(self.endpoints, name="estop", wait_s=2.0, identity=self.identity, gather_s=0.0)
        with held(opened) as (session, declared):
            stop = messages.encode(messages.Stop(self.identity, reason))
            urgent = session.declare_publisher(
                keys.estop,
                encoding=messages.JSON,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            urgent.put(stop)
            begun = time.monotonic()
            statuses = pubsub.pose_subscriber(session, keys.status("*"), 4096)
            declared += [urgent, statuses]
            self.seen = {
                keys.robot(str(reply.ok.key_expr))
                for reply in session.liveliness().get(keys.alive("*"), timeout=ANSWER_S)
                if reply.ok is not None
            }
            self.moving = set(self.seen)
            watch = pubsub.AliveWatch(session, keys.alive("*"))
            while (self.moving or self._awaited(session, begun)) and time.monotonic() < begun + ANSWER_S:
                urgent.put(stop)
                time.sleep(AGAIN_S)
                for token in network.received(watch.handler):
                    robot = keys.whose(str(token.key_expr))
                    if robot is not None and token.kind == zenoh.SampleKind.PUT and robot not in self.seen:
                        self.seen.add(robot)
                        self.moving.add(robot)
                for sample in network.received(statuses.handler):
                    try:
                        status = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Status)
                    except messages.Malformed:
                        continue
                    if status.phase == STOPPED and keys.robot(str(sample.key_expr)) == status.robot:
                        self.moving.discard(status.robot)

    def _awaited(self, session: zenoh.Session, begun: float) -> bool:
        """Whether more members of a mesh may still be linked."""
        from agents.network import endpoints as topology
        from agents.network import session as network

        late = time.monotonic() > begun + network.GATHER_S
        return topology.is_mesh(self.endpoints) and not late and network.count_links(session) < len(self.endpoints)


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

    if given := routers(connect, lab):
        return _stop_all([_Stop(given, realm or "park", identity or IDENTITY)], reason)
    stops = [_Stop(run.endpoints, realm or run.realm, identity or run.identity, run) for run in run_registry.runs()]
    known = {endpoint for stop in stops for endpoint in topology.bare(stop.endpoints)}
    if topology.DEFAULT_ENDPOINT not in known:  # of a zenohd, say
        stops.append(_Stop([topology.DEFAULT_ENDPOINT], realm or "park", identity or IDENTITY))
    return _stop_all(stops, reason)


def _stop_all(stops: Sequence[_Stop], reason: str) -> int:
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
