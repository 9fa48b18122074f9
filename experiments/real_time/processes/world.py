"""The world process: `python -m experiments.real_time.processes.world FILE` simulates any number of twins in real time.

Robots reach it by keys only (`docs/external-simulators.md`). Here are clock, orders and process; beside it
`experiments.real_time.processes.world_network` and `experiments.real_time.processes.world_population`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final

import msgspec
import zenoh

from agents.clock import Clock, uptime
from agents.errors import Refusal
from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.network.shutdown import Farewell, end
from agents.runtime import command_line
from agents.runtime.lifeline import stop_in
from agents.ticks import Ticks
from experiments.definition.experiment import WORLD
from experiments.definition.plan import Plan
from experiments.file.problems import refusal
from experiments.real_time.processes.joining import Launch, Network, joined
from experiments.real_time.processes.world_network import Commands, Events, Publications, States
from experiments.real_time.processes.world_population import WorldBodies

REPORT_S: Final = 1.0
SLIP_S: Final = 0.05  # lateness that is caught up; the rest of the time is lost, which shows in the factor


@dataclass
class Pace:
    """Pace over the last second: simulated over real time, and the share of real time that was worked."""

    factor: float = 1.0
    load: float = 0.0
    since: float = 0.0
    ticks: int = 0
    worked: float = 0.0

    def update(self, now: float, dt: float) -> bool:
        """Updates the figures when a second is over at `now` [s]; returns whether it is."""
        span = now - self.since
        if span < REPORT_S:
            return False
        self.factor, self.load = self.ticks * dt / span, self.worked / span
        self.since = now
        self.ticks, self.worked = 0, 0.0
        return True


class WorldProcess:
    """Runs a population in real time, and obeys orders."""

    def __init__(
        self,
        plan: Plan,
        population: WorldBodies,
        joint: Network,
        lost: threading.Event,
        clock: Callable[[], float] = uptime,
        *,
        stopped: threading.Event | None = None,
    ) -> None:
        """`lost` is set to end as soon as the robots have landed, `stopped` to stop them all at once."""
        session, self._keys = joint.session, joint.keys
        self._ownership, self._over = joint.ownership, threading.Event()
        self._population, self._session, self._lost = population, session, lost
        self._engine, hz = plan.engine_name, plan.experiment.rates.body_hz
        self._ticks = Ticks(hz, catch_up=round(SLIP_S * hz), clock=clock)
        self._clock = Clock()
        self.utc = self._clock.utc()  # time at which the clock of the world was 0 [s]
        self.events = Events(joint, self._clock)
        self.commands = Commands(plan, population, joint, self.events)
        self.states = States(plan, population, joint, self.events, self._clock)
        self.publications = Publications(plan, population, joint, self.events)
        self._reports = pubsub.pose_publisher(session, self._keys.world, messages.JSON)
        self._orders = pubsub.Orders(session, self._keys.world_order, messages.WorldOrder)
        self._stopped = stopped = stopped or threading.Event()
        self._estop = pubsub.ImmediateSubscriber(session, self._keys.estop, lambda _: stopped.set())
        self._pace = Pace()
        self.paused = False
        names = zip(population.names, population.carried, strict=True)
        self.carried = [name for name, here in names if here]
        self._farewell = Farewell(session, self._keys, self.carried, lost)

    def run(self, over: threading.Event) -> None:
        """Runs until `over` is set, or until launcher and then robots are gone."""
        pace, ticks = self._pace, self._ticks
        command_line.spare_imports()
        self.utc = self._clock.at(ticks.start())
        token = pubsub.alive_token(self._session, self._keys.world_alive)
        self._report(0.0)
        self._over = over
        while not over.is_set():
            time.sleep(ticks.until_next())
            if self._ownership.wait_while_checking(self._session, self._ended):
                continue
            ticks.until_next()  # a sleep that lasted too long is lost time as well
            if missed := ticks.begin():
                self.commands.forgive(missed * ticks.period, ticks.t)
            began = ticks.elapsed()
            self._tick(ticks.t)
            pace.worked += ticks.elapsed() - began
            if pace.update(began, ticks.period):
                self._report(ticks.next)
            if self._ended():
                break
        token.undeclare()

    def _ended(self) -> bool:
        return self._over.is_set() or (self._lost.is_set() and self._farewell.over())

    def _tick(self, t: float) -> None:
        changed = False
        for query, order in self._orders.read():
            changed |= self._obey(query, order)
        if self._lost.is_set() and self.paused:
            self.paused, changed = False, True  # robots that must land cannot wait
        self.commands.receive(t)
        if self._stopped.is_set():  # commands that came before do not count
            self._stopped.clear()
            self.commands.stop()
        self.states.receive(t, self.utc)
        if not self.paused:
            self.commands.apply(t)
            self._population.advance()
            self._pace.ticks += 1
        if self._ownership.wait_while_checking(self._session, self._ended):
            return
        self.publications.publish(round(self.utc + t, 6))
        if changed:
            self._report(t)

    def _obey(self, query: zenoh.Query, order: messages.WorldOrder) -> bool:
        """Carries out one order, and replies; returns whether it changed anything."""
        with query:
            reason = ""
            try:
                if order.order == "reset":
                    self._population.reset(order.name)
                    self.commands.restart()
                    self.states.update_body()
                    self.publications.restart()
                else:
                    self.paused = order.order == "pause"
            except Refusal as refusal:
                reason = str(refusal)
                self.events.refuse(f"{order.order}: {reason}")
            reply = messages.WorldReply(not reason, self.paused, round(self._population.time, 6), reason)
            query.reply(self._keys.world_order, messages.encode(reply), encoding=messages.JSON)
            return not reason

    def _report(self, t: float) -> None:
        population, events = self._population, self.events
        state = messages.WorldState(
            stamp=self.utc + t,
            engine=self._engine,
            time=round(population.time, 6),
            factor=round(self._pace.factor, 4),
            load=round(self._pace.load, 4),
            paused=self.paused,
            robots=self.carried,
            mirrored=self.states.mirrored(),
            obstacles=[messages.ObstaclePose(name, pose) for name, pose in population.obstacles().items()],
            contacts=self.publications.contacts,
            refused=events.refused,
            malformed=events.malformed + self._orders.malformed,
            trouble=events.trouble,
        )
        self._reports.put(messages.encode(state))


class WorldLaunch(Launch, frozen=True, kw_only=True, rename="kebab"):
    """The world of an experiment."""

    engine: Annotated[str | None, msgspec.Meta(description="instead of the file's")] = None


def serve(launch: WorldLaunch) -> int:
    """Runs the world of an experiment until it is asked to end and its robots are down; returns the exit code."""
    plan, endpoints = launch.read()
    robots = plan.experiment.robots.values()
    if not any(WORLD in (robot.body, robot.ranges) for robot in robots):
        hint = 'give robots `body = "world"` (or start it all with `./zenpark run FILE --bodies world`)'
        raise refusal(launch.file, "no robot of this experiment lives in a world", hint)
    if launch.engine is not None:
        plan = plan.changed(world=msgspec.structs.replace(plan.experiment.world, engine=launch.engine))
    over, lost, stopped = threading.Event(), threading.Event(), threading.Event()

    def leave() -> None:
        (over if lost.is_set() else lost).set()  # a second signal does not wait for robots to land

    def obey(line: bytes) -> None:
        if stop_in(line) is not None:
            stopped.set()

    population = WorldBodies(plan)
    with joined(
        plan,
        endpoints,
        name="world",
        stop=lost,
        on_signal=leave,
        lost=lost if launch.lifeline else None,
        on_line=obey,
        token=Keys(plan.experiment.network.realm).world_alive,
        taken="a world runs",
    ) as joint:
        # before a watch of those tokens begins: a session that watches answers from what it has received
        alive = _alive(joint.session, joint.keys)
        world = WorldProcess(plan, population, joint, lost, stopped=stopped)
        joint.declared.append(world)
        back = world.states.restore(alive)
        for name, flying in back.items():
            world.commands.expect(name, flying=flying)
        mirrored = ", ".join(name for name in plan.names if name not in world.carried) or "none"
        print(
            f"world ready: {plan.engine_name} at {plan.experiment.rates.body_hz:g} Hz "
            f"carries {', '.join(world.carried) or 'none'}; mirrors {mirrored}; "
            f"realm {joint.keys.realm} at {', '.join(endpoints)}"
            + (f"; {', '.join(back)} where they were" if back else ""),
            flush=True,
        )
        world.run(over)
    return 0


def _alive(session: zenoh.Session, keys: Keys) -> set[str]:
    """Robots that are on the network already: a former world may have simulated them."""
    replies = session.liveliness().get(keys.alive("*"), timeout=1.0)
    found = {keys.robot_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}
    return {name for name in found if name is not None}


if __name__ == "__main__":
    end(lambda: command_line.run("zenpark world serve", WorldLaunch, serve))
