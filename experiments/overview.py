"""What the conductor hears of a run, and what it says: its session, and what becomes of each robot by what arrives."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from math import inf
from pathlib import Path
from typing import Final

import zenoh

from agents import lab, topology, wire
from agents import session as network
from agents.clock import Clock
from agents.endpoint import DEFAULT_ENDPOINT
from agents.keys import Keys
from agents.leaving import held
from agents.lifecycle import Phase
from experiments import hosts as machines
from experiments import mesh, orders
from experiments.experiment import Experiment
from experiments.said import by_robots
from experiments.seen import ORDER, Progress

ROUTER_S: Final = 10.0
MISSED_S: Final = 1.0  # who changes from one router to another is back sooner


class Overview:
    """The network as the conductor of a case sees it.

    Attributes:
        robots: What is known of each.
        recording_begun: Whether the recorder is there.
        orders: Asked of the conductor.
    """

    def __init__(
        self,
        stack: ExitStack,
        experiment: Experiment,
        endpoints: Sequence[str],
        progress: Progress,
        folder: Path,
        *,
        identity: str,
        clock: Clock,
    ) -> None:
        """Joins the network.

        Args:
            stack: Closes the session.
            experiment: The case.
            endpoints: Routers.
            progress: Takes in what is said, and has the robots.
            folder: Of the run, where the endpoints are written down.
            identity: Whose certificate it shows, in a lab.
            clock: By which its events are stamped.

        Raises:
            Unreachable: If no router answers.
        """
        self.clock = clock
        self.robots, self._progress = progress.robots, progress
        self._keys = keys = Keys(experiment.network.realm)
        opened = network.open_session(
            endpoints,
            name="conductor",
            wait_s=ROUTER_S,
            identity=identity,
            rights=mesh.rights(experiment, endpoints),
        )
        self._session, declared = stack.enter_context(held(opened))
        declared.append(self)
        self._events = network.pose_publisher(self._session, keys.event, wire.JSON, network.EVENTS)
        if list(endpoints) != [DEFAULT_ENDPOINT]:
            options = lab.options(endpoints[0]) if len(endpoints) == 1 else f"--connect @{folder / mesh.ENDPOINTS}"
            where = "a mesh" if topology.is_mesh(endpoints) else ", ".join(lab.bare(endpoints))
            self.say("router", "conductor", f"{where}: look with `zenpark keys {options}`")
        self._clock = network.publisher(self._session, keys.clock, wire.JSON)
        self._told = network.pose_publisher(self._session, keys.experiment, wire.JSON)
        self._told.put(machines.document(experiment))
        self.orders = network.orders(self._session, keys.run_order)
        self._token = network.alive_token(self._session, keys.conductor)
        self._statuses = network.pose_subscriber(self._session, keys.status("*"), 4096)
        self._states = network.subscriber(self._session, keys.state("*"), 4096)
        self._watch = network.alive_watch(self._session, keys.alive("*"))
        self._recorder_watch = network.alive_watch(self._session, keys.recorder)
        self.recording_begun = False
        self._cut_off = -inf
        self._router = network.RouterWatch(self._session, keys.conductor, endpoints)
        self._safety, self._mesh = experiment.safety, topology.is_mesh(endpoints)

    @property
    def session(self) -> zenoh.Session:
        """Its session, for whoever hears more by it."""
        return self._session

    def close_doors(self) -> None:
        """Who joins from now on waits for the next run."""
        self._told.undeclare()  # type: ignore[no-untyped-call]

    def look(self) -> list[str]:
        """Takes in what has arrived since the last look; gives the robots whose token has vanished for good."""
        for sample in network.received(self._recorder_watch.handler):
            self.recording_begun |= sample.kind == zenoh.SampleKind.PUT
        for status in by_robots(self._statuses.handler, wire.Status, keys=self._keys, robots=self.robots):
            self._heed(status)
        for state in by_robots(self._states.handler, wire.State, keys=self._keys, robots=self.robots):
            seen = self.robots[state.robot]
            if seen.error is not None:
                seen.error = state.error
            seen.place = state.true_position or state.position or seen.place
        for sample in network.received(self._watch.handler):
            name = self._keys.whose(str(sample.key_expr))
            if name is not None and (known := self.robots.get(name)) is not None:
                known.alive = sample.kind == zenoh.SampleKind.PUT
                known.vanished = inf if known.alive else time.monotonic()
        return self._missed()

    def order(self, names: Sequence[str], order: wire.Order) -> dict[str, wire.Reply]:
        """Gives an order to robots, see `orders.give`."""
        return orders.give(self._session, self._keys, names, order)

    def say(self, kind: str, source: str, text: str, stamp: float | None = None) -> None:
        """An event of the run, now or at `stamp` [s, UTC]."""
        event = wire.Event(self.clock.utc() if stamp is None else stamp, kind, source, text)
        self._progress.events.append(event)
        self._events.put(wire.encode(event))

    def tell_clocks(self, clocks: Sequence[wire.HostClock]) -> None:
        """Says how the hosts' clocks lie, for the recording."""
        for each in clocks:
            self._clock.put(wire.encode(each))
            self.say("clock", each.host, f"{each.offset * 1e3:+.2f} ms ± {each.uncertainty * 1e3:.2f} ms against ours")

    def tell_drift(self, measured: Iterable[wire.HostClock], trouble: Iterable[str]) -> None:
        """Says, for the recording, how the hosts' clocks have drifted and what their robots do about it."""
        for each in measured:
            self._clock.put(wire.encode(each))
        for text in trouble:
            self.say("clock", "conductor", text)

    def _missed(self) -> list[str]:
        """Robots whose token has been missing for long: where there is another router, it comes back at once."""
        now = time.monotonic()
        self._watch_router(now)
        missed = [name for name, seen in self.robots.items() if now - max(seen.vanished, self._cut_off) > MISSED_S]
        for name in missed:
            self.robots[name].vanished = inf
        return missed

    def _watch_router(self, now: float) -> None:
        """Says once that the router is silent for as long as robots wait before they hold, and once that it is back."""
        since, progress = self._router.silent_since(now), self._progress
        if since < inf:
            self._cut_off = now
            safety = self._safety
            if progress.silent_since == inf and not self._mesh and now - since > safety.link_silence_s:
                progress.silent_since = since
                what = f"robots hold, and land after {safety.offline_s:g} s"
                self.say("router", "conductor", f"no router answers for {now - since:.1f} s: {what}")
        elif progress.silent_since < inf:
            away_s, progress.silent_since = now - progress.silent_since, inf
            self.say("router", "conductor", f"a router answers again, after {away_s:.1f} s")

    def _heed(self, status: wire.Status) -> None:
        seen = self.robots[status.robot]
        if status.phase not in ORDER or status.pid == seen.former:
            return
        if seen.status is not None and (seen.status.phase, seen.status.reason) != (status.phase, status.reason):
            self.say("robot", status.robot, status.phase + (f": {status.reason}" if status.reason else ""))
        if seen.status is not None and seen.status.pid != status.pid:
            seen.told = 0
        for incident in status.incidents:
            if incident.seq > seen.told:
                seen.told = incident.seq
                self.say("hazard", status.robot, incident.text)
        since, sent = seen.counted
        if status.stamp - since >= 0.9:
            seen.rate = max(0.0, (status.sent - sent) / (status.stamp - since)) if since else 0.0
            seen.counted = (status.stamp, status.sent)
        if status.phase == Phase.RUNNING.word and seen.phase != status.phase:
            seen.began = status.stamp
        seen.status = status
        seen.origin = status.origin or seen.origin
        seen.behind = min(seen.behind, self.clock.utc() - status.stamp)
