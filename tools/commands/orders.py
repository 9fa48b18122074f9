"""Orders to robots (`./zenpark robot`), to a world (`./zenpark world`), and the emergency stop (`./zenpark estop`)."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Argument, Option

from tools import completion
from tools.options import (
    CONNECT,
    As,
    AsJson,
    Connect,
    Lab,
    Realm,
    RealmOfRun,
    example,
    group,
    place,
    plain,
    print_json,
    routers,
    session,
    with_options,
)
from tools.terminal import listed, printable, say

if TYPE_CHECKING:
    import zenoh

    from agents.network import messages
    from agents.network.keys import Keys
    from experiments.real_time.conductor.orders import EmergencyStop

app: Final = typer.Typer()
robot_app: Final = group("Give orders to robots: those of a run that is under way, and those started by hand.")
world_app: Final = group("Run a world by hand, and give orders to the one that is running.")

Place = tuple[float, float]
Names = Annotated[
    list[str], Argument(metavar="NAME...", help="Robots.", autocompletion=completion.robots, callback=plain)
]
NamesOrAll = Annotated[
    list[str] | None,
    Argument(metavar="[NAME...]", help="Robots. [all]", autocompletion=completion.robots, callback=plain),
]

IDENTITY: Final = "operator"
WAIT_S: Final = 2.0  # patience for a router
MOST_NAMES: Final = 20  # robots that a line of the emergency stop names; --json names all
# orders to the robots themselves, in a run or by hand, without names to all of them: help, and what a robot does then
ORDERS: Final[Mapping[messages.OrderKind, tuple[str, str]]] = {
    "takeoff": ("Let robots take off that were started by hand.", "takes off"),
    "start": ("Begin the experiment of robots that were started by hand, at one common time.", "starts"),
    "hold": ("Let robots hold where they are; the others go on.", "holds where it is"),
    "resume": ("Let robots continue after a hold.", "goes on"),
    "land": ("Land robots where they are.", "lands"),
}
# phases in which an order changes nothing, but that a start ends a hold of a running robot
UNDER_WAY: Final[Mapping[messages.OrderKind, Sequence[str]]] = {
    "takeoff": ("airborne", "running"),
    "start": ("running",),
}
UNCHANGED: Final[Mapping[messages.OrderKind, str]] = {
    "takeoff": "is {} already",
    "start": "is {} already; if it was held, it goes on",
}
# changes of a run, which its conductor makes
CHANGES: Final[Mapping[messages.ChangeKind, str]] = {
    "remove": "Land robots and end their processes; the others go on without them.",
    "restart": "Start robots of a run again, whether they fly, were removed or crashed.",
    "add": "Let robots join a run: on standby, missing at the start, or started by hand.",
}


@dataclass(frozen=True)
class Operator:
    """Options of a command that gives orders: where, as whom, and how the result is printed."""

    connect: Connect = None
    realm: Realm = "park"
    lab: Lab = None
    identity: As = "operator"
    as_json: AsJson = False

    @contextmanager
    def joined(self) -> Iterator[tuple[zenoh.Session, Keys]]:
        """A session at the routers, and the keys of the realm."""
        from agents.network.keys import Keys

        with session("robot", place(self.connect, self.lab, acting=True), self.identity, WAIT_S) as opened:
            yield opened, Keys(self.realm)

    def print_results(self, done: Mapping[str, str], refused: Mapping[str, str]) -> int:
        """Print the result of an order for each robot; the exit code: 1 if a robot refused, else 0."""
        if self.as_json:
            print_json({"ok": not refused, "done": done, "refused": refused})
        else:
            for name, text in done.items():
                print(f"{printable(name)}: {printable(text)}")
            for name, text in refused.items():
                print(f"{printable(name)}: no: {printable(text)}", file=sys.stderr)
            if "no answer" in refused.values():
                print("`./zenpark keys` shows the members", file=sys.stderr)
        return int(bool(refused))

    def refuse(self, reason: str) -> int:
        """Print why a whole order was refused; the exit code."""
        if self.as_json:
            print_json({"ok": False, "error": reason})
        print(f"zenpark: {printable(reason)}", file=sys.stderr)
        return 2


def _order_robots(what: messages.OrderKind, robots: Sequence[str], by: Operator) -> int:
    """Give an order to the robots themselves, to all if none is named, and tell the recorder; the exit code."""
    from agents.network import messages
    from experiments.real_time.conductor import orders

    with by.joined() as (opened, keys):
        receivers = robots or sorted(orders.alive(opened, keys))
        if not receivers:
            return by.refuse(f"no robot in the realm '{by.realm}'; `./zenpark keys` shows the members")
        at = time.time() + orders.start_lead_s(len(receivers)) if what == "start" else None
        if what == "stop":
            replies = orders.send_stop_order(opened, keys, receivers)
        else:
            replies = orders.send_order(opened, keys, receivers, messages.Order(what, at=at))
        _, does = ORDERS.get(what, ("", "has stopped"))
        already = UNDER_WAY.get(what, ())
        done = {
            name: reply.reason or (UNCHANGED[what].format(reply.phase) if reply.phase in already else does)
            for name, reply in replies.items()
            if reply.ok
        }
        refused = {name: reply.reason or reply.phase for name, reply in replies.items() if not reply.ok}
        text = f"{what}: {', '.join(done) or 'no robot'}"
        if refused:
            text += f"; refused by {', '.join(refused)}"
        event = messages.Event(time.time(), "order", by.identity, text)
        opened.put(keys.event, messages.encode(event), encoding=messages.JSON)
    return by.print_results(done, refused)


def _change(order: messages.RunOrder, by: Operator) -> int:
    """Give an order to the conductor, wait until it is done, and print the result for each robot.

    Returns the exit code: 0, 1 if something was refused, 2 if the whole order was.
    """
    from experiments.real_time.conductor import orders

    with by.joined() as (opened, keys):
        reply = orders.send_run_order(opened, keys, order)
    return by.refuse(reply.reason) if reply.reason else by.print_results(reply.done, reply.refused)


def _order_command(what: messages.OrderKind) -> Callable[..., int]:
    def order(names: NamesOrAll = None, *, by: Operator) -> int:
        return _order_robots(what, names or [], by)

    return with_options(order)


def _change_command(what: messages.ChangeKind) -> Callable[..., int]:
    def change(names: Names, *, by: Operator) -> int:
        from agents.network.messages import RunOrder

        return _change(RunOrder(what, names, operator=by.identity), by)

    return with_options(change)


for _order, (_help, _) in ORDERS.items():
    _lines = example(f"robot {_order}", f"robot {_order} CF01")
    robot_app.command(name=_order, help=_help, epilog=_lines)(_order_command(_order))


@robot_app.command(epilog=example("robot stop KH01"))
@with_options
def stop(names: Names, *, by: Operator) -> int:
    """Cut the motors of robots: a drone falls. `./zenpark estop` cuts those of all."""
    return _order_robots("stop", names, by)


for _what, _help in CHANGES.items():
    robot_app.command(name=_what, help=_help, epilog=example(f"robot {_what} KH01 KH02"))(_change_command(_what))


@robot_app.command(epilog=example("robot replace CF02 --with S1", "robot replace KH01 --body twin --at 0.5 -0.2"))
@with_options
def replace(
    name: Annotated[str, Argument(metavar="NAME", help="A robot of the run.", autocompletion=completion.robots)],
    *,
    spare: Annotated[str | None, Option("--with", metavar="SPARE", help="A spare of the file.")] = None,
    body: Annotated[str | None, Option(metavar="URI", help="Address of another body.")] = None,
    at: Annotated[Place | None, Option(metavar="X Y", help="Start of a twin [m]. [the file's]")] = None,
    yaw: Annotated[float, Option(help="Yaw of a twin that is moved [rad].")] = 0.0,
    by: Operator,
) -> int:
    """Let another body take over a robot's name, links and plan; by default a spare of its kind."""
    from agents.network.messages import RunOrder

    return _change(RunOrder("replace", [name], operator=by.identity, spare=spare, body=body, at=at, yaw=yaw), by)


def _tell_world(order: messages.WorldOrder, done: str, by: Operator) -> int:
    """Give an order to the world of a realm and print its reply; the exit code."""
    from experiments.real_time.conductor import orders

    with by.joined() as (opened, keys):
        reply = orders.send_world_order(opened, keys, order)
    if by.as_json:
        print_json(reply)
    elif reply.ok:
        print(f"{done}; the world {'stands still' if reply.paused else 'runs'} at {reply.time:.2f} s")
    else:
        say(f"no: {reply.reason}", to=sys.stderr)
    return int(not reply.ok)


@world_app.command(epilog=example("world pause"))
@with_options
def pause(*, by: Operator) -> int:
    """Let the world stand still; robots hold, because their positions are still published."""
    from agents.network.messages import WorldOrder

    return _tell_world(WorldOrder("pause"), "paused", by)


@world_app.command(epilog=example("world resume"))
@with_options
def resume(*, by: Operator) -> int:
    """Let a paused world go on."""
    from agents.network.messages import WorldOrder

    return _tell_world(WorldOrder("resume"), "goes on", by)


@world_app.command(epilog=example("world reset", "world reset KH01"))
@with_options
def reset(
    name: Annotated[str | None, Argument(metavar="[NAME]", help="A robot. [all, and pushed obstacles]")] = None,
    *,
    by: Operator,
) -> int:
    """Put a robot of a world back to its start, or all of them and what was pushed."""
    from agents.network.messages import WorldOrder

    done = f"{name} is back at its start" if name else "all are back at their starts"
    return _tell_world(WorldOrder("reset", name=name), done, by)


@app.command(epilog=example("estop", "estop --dry-run", "estop --connect @runs/first/network.txt"))
def estop(
    *,
    connect: Annotated[
        list[str] | None,
        Option(
            metavar="ENDPOINT",
            help="Only this router, or those of one run (@RUN/network.txt); may be repeated. "
            f"[all runs of this machine, the routers of ${CONNECT}, and tcp/127.0.0.1:7447]",
        ),
    ] = None,
    dry_run: Annotated[bool, Option("--dry-run", help="Print which robots would be stopped; send nothing.")] = False,
    realm: RealmOfRun = None,
    lab: Lab = None,
    identity: Annotated[
        str | None, Option("--as", metavar="NAME", help="Name of the certificate, in a lab. [the run's operator]")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Cut the motors of every robot of every run of this machine, or at a router."""
    from agents.network.endpoints import DEFAULT_ENDPOINT
    from experiments.real_time.conductor.orders import EmergencyStop

    if given := routers(connect, lab):
        stops = [EmergencyStop(given, realm or "park", identity or IDENTITY)]
    else:
        others = _of_environment(lab), [DEFAULT_ENDPOINT]  # endpoints of another machine; of a zenohd, say
        stops = stops_of_all_runs(*others, realm=realm, identity=identity)
    return stop_all(stops, dry_run=dry_run, as_json=as_json)


def stops_of_all_runs(
    *groups: Sequence[str], realm: str | None = None, identity: str | None = None
) -> list[EmergencyStop]:
    """Emergency stops: of each run of this machine, and of each of other `groups` of routers."""
    from agents.network import endpoints as topology
    from experiments.real_time.conductor.orders import EmergencyStop
    from experiments.real_time.hosts import run_registry

    up = run_registry.runs()
    stops = [EmergencyStop(run.endpoints, realm or run.realm, identity or run.identity, run) for run in up]
    known = {(endpoint, stop.realm) for stop in stops for endpoint in topology.bare(stop.endpoints)}
    for others in groups:
        found = {(endpoint, realm or "park") for endpoint in topology.bare(others)}
        if found and known.isdisjoint(found):
            stops.append(EmergencyStop(others, realm or "park", identity or IDENTITY))
            known |= found
    return stops


def _of_environment(lab: str | None) -> list[str]:
    """Routers that the environment names; none if they are wrong, which must not keep the others from being stopped."""
    import os

    from agents.errors import ExplainedError

    try:
        return routers(os.environ.get(CONNECT, "").split(), lab)
    except ExplainedError as error:
        print(f"zenpark: {CONNECT}: {error}", file=sys.stderr)
        return []


def stop_all(stops: Sequence[EmergencyStop], *, dry_run: bool, as_json: bool) -> int:
    """Send all stops at the same time, or only look whom they would reach, and print the results.

    Returns:
        The exit code: 0, or 1 if a robot has not stopped in time, or if no robot was seen.
    """
    from experiments.real_time.hosts import run_registry

    todo = [(stop.look, ()) if dry_run else (stop.send, ("zenpark estop",)) for stop in stops]
    threads = [threading.Thread(target=act, args=given, daemon=True) for act, given in todo]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for stop in stops:
        known = {name for other in stops if _same_network(stop, other) for name in other.seen}
        stop.strangers -= known
        stop.moving_strangers -= known
    missed = any(stop.missed for stop in stops)
    seen = any(stop.seen or stop.strangers or stop.answered for stop in stops)
    if as_json:
        print_json({"ok": seen and not missed, "routers": [_as_json(stop, dry_run=dry_run) for stop in stops]})
        return int(missed or not seen)
    if seen or missed:
        for stop in stops:
            _print_stop(stop, dry_run=dry_run)
        return int(missed)
    failures = [stop.failure for stop in stops if stop.failure is not None]
    where = "; ".join(f"in the realm '{stop.realm}', {stop.where}" for stop in stops if stop.failure is None)
    nobody = f"no robot is seen {where}" if where else str(failures[-1])
    print(
        f"{'' if dry_run else 'NOTHING WAS STOPPED: '}{nobody}; {run_registry.look().words}. Name the router of the "
        "run: --connect, which `./zenpark run` prints when it starts, or --connect @FOLDER/network.txt of its folder",
        file=sys.stderr,
    )
    return 2 if len(failures) == len(stops) else 1


def _same_network(one: EmergencyStop, other: EmergencyStop) -> bool:
    from agents.network import endpoints as topology

    places = topology.bare(one.endpoints)
    return one is not other and one.realm == other.realm and not set(places).isdisjoint(topology.bare(other.endpoints))


def _as_json(stop: EmergencyStop, *, dry_run: bool) -> Mapping[str, object]:
    failure = None if stop.failure is None else str(stop.failure)
    seen, moving = stop.seen | stop.strangers, stop.moving | stop.moving_strangers
    if dry_run:
        found = {"would_be_stopped": sorted(seen)}
    else:
        found = {"stopped": sorted(seen - moving), "not_known_to_have_stopped": sorted(moving)}
    return {
        "where": stop.where,
        **found,
        "failure": failure,
        "unreached": stop.unreached,
        "run_asked_to_end": stop.run_ended or stop.answered,
    }


def _print_stop(stop: EmergencyStop, *, dry_run: bool) -> None:
    """Print the result of one stop, with title, folder and routers of its run where they are known."""
    from agents.network import endpoints as topology

    _print_robots(stop.seen, stop.moving, stop.where, dry_run=dry_run)
    at = f"at {topology.describe(stop.endpoints)}"
    _print_robots(stop.strangers, stop.moving_strangers, f"{at}, of no run here", dry_run=dry_run)
    why = "no robot is there" if stop.failure is None else str(stop.failure)
    if stop.answered and not stop.seen:
        say(f"ended, without a robot that was up: {stop.where}")
    elif stop.missed and not stop.seen:
        done = "no robot would be stopped" if dry_run else "NOT known to have stopped"
        say(f"{done}: {stop.where}: {why}", to=sys.stderr)
    elif not stop.seen and stop.run is None:
        say(f"also tried, {stop.where}: {why}", to=sys.stderr)
    elif stop.failure is not None:
        say(f"its routers were not reached: {why}", to=sys.stderr)
    if stop.unreached and (stop.run is None or not stop.answered):
        done = "are not known" if dry_run else "are NOT known to have stopped"
        say(f"robots at {', '.join(stop.unreached)}, where no router answers, {done}", to=sys.stderr)
    if stop.run_ended:
        say(f"its process was asked to end: {stop.where}", to=sys.stderr)


def _print_robots(seen: set[str], moving: set[str], where: str, *, dry_run: bool) -> None:
    if moving:
        of_all = f"{len(moving)} of {len(seen)} robots; {where}"
        say(f"NOT known to have stopped: {listed(moving, MOST_NAMES)} ({of_all})", to=sys.stderr)
    if stopped := seen - moving:
        say(f"{'would be stopped' if dry_run else 'stopped'}: {listed(stopped, MOST_NAMES)} ({where})")
