"""`zenpark estop`: motors off, everybody. `zenpark runs`: which runs are up on this machine."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec
import zenoh

from agents.network import endpoints as topology
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.shutdown import held
from agents.runtime import run_registry
from agents.runtime.run_registry import Run

ANSWER_S: Final = 2.0
AGAIN_S: Final = 0.05
STOPPED: Final = "done"
WHO: Final = "operator"


@dataclass
class _Stop:
    """A stop at the routers of one run.

    Attributes:
        endpoints: Routers.
        realm: Of the keys.
        who: Whose certificate is shown, in a lab.
        run: Which one, if it is known.
        there: Robots that were seen.
        left: Those of them that have not said that they stopped.
        failure: Why the routers cannot be reached.
    """

    endpoints: Sequence[str]
    realm: str
    who: str
    run: Run | None = None
    there: set[str] = field(default_factory=set)
    left: set[str] = field(default_factory=set)
    failure: Exception | None = None

    @property
    def where(self) -> str:
        return f"at {', '.join(topology.bare(self.endpoints))}" if self.run is None else self.run.words

    @property
    def expected(self) -> bool:
        """Whether robots must be there: a run of this machine is up, with more than its name on a list."""
        return self.run is not None and self.run.what == "run" and self.run.alive

    def say(self, reason: str) -> None:
        """Says stop until every robot that is there says that it has stopped."""
        try:
            self._say(reason)
        except Exception as error:  # noqa: BLE001 - the others are stopped whatever happens to this one
            self.failure = error

    def _say(self, reason: str) -> None:
        keys = Keys(self.realm)
        # who does not answer must not keep it from those who do
        opened = network.open_session(self.endpoints, name="estop", wait_s=2.0, identity=self.who, gather_s=0.0)
        with held(opened) as (session, declared):
            stop = messages.encode(messages.Stop(self.who, reason))
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
            self.there = {
                keys.robot(str(reply.ok.key_expr))
                for reply in session.liveliness().get(keys.alive("*"), timeout=ANSWER_S)
                if reply.ok is not None
            }
            self.left = set(self.there)
            watch = pubsub.AliveWatch(session, keys.alive("*"))
            while (self.left or self._awaited(session, begun)) and time.monotonic() < begun + ANSWER_S:
                urgent.put(stop)
                time.sleep(AGAIN_S)
                for token in network.received(watch.handler):
                    robot = keys.whose(str(token.key_expr))
                    if robot is not None and token.kind == zenoh.SampleKind.PUT and robot not in self.there:
                        self.there.add(robot)
                        self.left.add(robot)
                for sample in network.received(statuses.handler):
                    try:
                        status = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Status)
                    except messages.Malformed:
                        continue
                    if status.phase == STOPPED and keys.robot(str(sample.key_expr)) == status.robot:
                        self.left.discard(status.robot)

    def _awaited(self, session: zenoh.Session, begun: float) -> bool:
        """Whether members of a mesh may yet be linked."""
        late = time.monotonic() > begun + network.GATHER_S
        return topology.is_mesh(self.endpoints) and not late and network.links(session) < len(self.endpoints)


def command(*, connect: Sequence[str], realm: str | None, reason: str, who: str | None) -> int:
    """Stops the robots at some routers, or without any every run of this machine; prints who has not stopped.

    Args:
        connect: Routers; none: those of all runs of this machine, and the usual one.
        realm: Of the keys; left out: each run's, or "park".
        reason: Said with it.
        who: Whose certificate is shown, in a lab; left out: each run's operator.

    Returns:
        The exit code: 0, or 1 if one has not stopped in time, or if no robot was seen.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    if connect:
        return _at([_Stop(list(connect), realm or "park", who or WHO)], reason)
    stops = [_Stop(run.endpoints, realm or run.realm, who or run.identity, run) for run in run_registry.runs()]
    known = {endpoint for stop in stops for endpoint in topology.bare(stop.endpoints)}
    if DEFAULT_ENDPOINT not in known:  # of a zenohd, say
        stops.append(_Stop([DEFAULT_ENDPOINT], realm or "park", who or WHO))
    return _at(stops, reason)


def _at(stops: Sequence[_Stop], reason: str) -> int:
    """Stops everybody at once, and says what came of it."""
    threads = [threading.Thread(target=stop.say, args=(reason,), daemon=True) for stop in stops]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    bad = False
    seen = [stop for stop in stops if stop.there]
    for stop in stops:
        known = "" if stop.run is None else f" ({stop.where})"
        if stop.left:
            print(f"NOT known to have stopped: {', '.join(sorted(stop.left))}{known}", file=sys.stderr)
            bad = True
        elif stop.there:
            print(f"stopped: {', '.join(sorted(stop.there))}{known}", flush=True)
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


def runs(*, as_json: bool) -> int:
    """Prints the runs that are up on this machine; returns the exit code."""
    found = run_registry.runs()
    if as_json:
        shown = [{**msgspec.to_builtins(run), "alive": run.alive} for run in found]
        print(msgspec.json.format(msgspec.json.encode(shown), indent=2).decode())
        return 0
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
    return 0
