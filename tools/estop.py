"""`zenpark estop`: motors off, everybody."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Final

import zenoh

from agents import session as network
from agents import topology, wire
from agents.endpoint import DEFAULT_ENDPOINT
from agents.keys import Keys
from agents.leaving import held

ANSWER_S: Final = 2.0
AGAIN_S: Final = 0.05
STOPPED: Final = "done"


def command(*, connect: Sequence[str], realm: str, reason: str, who: str) -> int:
    """Says stop until every robot that is there says that it has stopped; prints who has not.

    Returns:
        The exit code: 0, or 1 if one has not stopped in time.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    keys = Keys(realm)
    endpoints = list(connect) or [DEFAULT_ENDPOINT]
    # who does not answer must not keep it from those who do
    opened = network.open_session(endpoints, name="estop", wait_s=2.0, identity=who, gather_s=0.0)
    with held(opened) as (session, declared):
        stop = wire.encode(wire.Stop(who, reason))
        urgent = session.declare_publisher(
            keys.estop,
            encoding=wire.JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        urgent.put(stop)
        begun = time.monotonic()
        statuses = network.pose_subscriber(session, keys.status("*"), 4096)
        declared += [urgent, statuses]
        there = {
            keys.robot(str(reply.ok.key_expr))
            for reply in session.liveliness().get(keys.alive("*"), timeout=ANSWER_S)
            if reply.ok is not None
        }
        left = set(there)
        watch = network.alive_watch(session, keys.alive("*"))
        while (left or _awaited(session, endpoints, begun)) and time.monotonic() < begun + ANSWER_S:
            urgent.put(stop)
            time.sleep(AGAIN_S)
            for token in network.received(watch.handler):
                robot = keys.whose(str(token.key_expr))
                if robot is not None and token.kind == zenoh.SampleKind.PUT and robot not in there:
                    there.add(robot)
                    left.add(robot)
            for sample in network.received(statuses.handler):
                try:
                    status = wire.decode(sample.payload.to_bytes(), str(sample.encoding), wire.Status)
                except wire.Malformed:
                    continue
                if status.phase == STOPPED and keys.robot(str(sample.key_expr)) == status.robot:
                    left.discard(status.robot)
    if not there:
        where = ", ".join(topology.bare(endpoints))
        print(
            f"NOTHING WAS STOPPED: no robot is seen in the realm '{realm}' at {where}. Name the router of the run: "
            "--connect, which `zenpark run` prints when it starts, or --connect @FOLDER/network.txt of its folder",
            file=sys.stderr,
        )
        return 1
    if left:
        print(f"NOT known to have stopped: {', '.join(sorted(left))}", file=sys.stderr)
        return 1
    print(f"stopped: {', '.join(sorted(there))}")
    return 0


def _awaited(session: zenoh.Session, endpoints: Sequence[str], begun: float) -> bool:
    """Whether members of a mesh may yet be linked."""
    late = time.monotonic() > begun + network.GATHER_S
    return topology.is_mesh(endpoints) and not late and network.links(session) < len(endpoints)
