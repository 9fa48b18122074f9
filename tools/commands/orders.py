"""Orders to robots that were started by hand, to the robots of a run (`zenpark robot`) and to its world."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Final, get_args

import typer

from tools.commands.options import As, Connect, Lab, Realm, session

if TYPE_CHECKING:
    from agents.network import messages

app: Final = typer.Typer()
robot_app: Final = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False, no_args_is_help=True)

Place = tuple[float, float]
Names = Annotated[list[str], typer.Argument(metavar="NAME...", help="Robots of the run.")]

WAIT_S: Final = 2.0  # for a router
WORLD_ORDERS: Final = ("pause", "resume", "step", "reset", "spawn", "remove")
CHANGES: Final[Mapping[messages.ChangeKind, str]] = {
    "pause": "Let robots hold where they are; the others go on.",
    "resume": "Let robots go on that were paused.",
    "remove": "Land robots and end their processes; the others go on without them.",
    "restart": "Start robots again, whether they fly, were removed or crashed; they join the run under way.",
    "add": "Let robots join that are on standby, were missing at the start, or were started by hand.",
}


class WorldOrderError(ValueError):
    """An order that makes no sense as it was written, with how to write it."""


@app.command()
def order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help="takeoff, start, hold, land or stop.")],
    robots: Annotated[list[str] | None, typer.Argument(metavar="[ROBOT...]", help="All, if none is named.")] = None,
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> int:
    """Give an order to robots that were started by hand."""
    from agents.network import messages
    from agents.network.keys import Keys
    from experiments.real_time.conductor import orders

    kinds = [kind for kind in get_args(messages.OrderKind) if kind not in ("get", "set", "inspect", "go")]
    if what not in kinds:
        print(f"zenpark: no order '{what}'; there are: {', '.join(kinds)}", file=sys.stderr)
        return 2
    keys = Keys(realm)
    with session("order", connect, lab, identity, WAIT_S) as opened:
        alive = [
            robot
            for reply in opened.liveliness().get(keys.alive("*"), timeout=2.0)
            if reply.ok is not None and (robot := keys.whose(str(reply.ok.key_expr))) is not None
        ]
        if not alive:
            print(f"zenpark: no robot in the realm '{realm}'; `zenpark keys` shows the members", file=sys.stderr)
            return 2
        receivers = robots or sorted(alive)
        at = time.time() + orders.start_lead_s(len(receivers)) if what == "start" else None
        replies = orders.send_order(opened, keys, receivers, messages.Order(what, at=at))  # type: ignore[arg-type]
    for robot, reply in replies.items():
        print(f"{robot}: {'yes' if reply.ok else 'no'}, {reply.phase}" + (f": {reply.reason}" if reply.reason else ""))
    return int(not all(reply.ok for reply in replies.values()))


@app.command(name="world-order")
def world_order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help="pause, resume, step, reset, spawn or remove.")],
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Of the robot or obstacle; reset without one resets all.")
    ] = None,
    *,
    steps: Annotated[int, typer.Option(min=1, help="Ticks of a step.")] = 1,
    kind: Annotated[str | None, typer.Option(help="Of a new robot.")] = None,
    at: Annotated[Place | None, typer.Option(metavar="X Y", help="Where it is put [m].")] = None,
    yaw: Annotated[float, typer.Option(help="Of a robot that is put in [rad].")] = 0.0,
    obstacle: Annotated[
        str | None, typer.Option(metavar="JSON", help='Puts in an obstacle, such as \'{"radius": 0.1, "at": [0, 1]}\'.')
    ] = None,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> int:
    """Give an order to a running world."""
    from agents.network import messages
    from agents.network.keys import Keys
    from agents.plugins.registry import did_you_mean
    from experiments.file import structure
    from experiments.real_time.conductor import orders
    from twins.scene import Obstacle

    if what not in WORLD_ORDERS:
        raise WorldOrderError(f"no order '{what}' to a world; {did_you_mean(what, WORLD_ORDERS)}")
    given = None
    if obstacle is not None:
        given = structure.parse_object("--obstacle", obstacle, Obstacle, ("arena", "obstacles", name or "it"))
        if at is not None:
            given["at"] = at
        if what == "spawn" and not given.keys() & {"at", "wall"}:
            raise WorldOrderError(f"{name or 'the obstacle'} has no place; say where, with --at X Y")
    order = messages.WorldOrder(what, steps=steps, name=name, kind=kind, at=at, yaw=yaw, obstacle=given)  # type: ignore[arg-type]
    with session("world-order", connect, lab, identity, WAIT_S) as opened:
        reply = orders.send_world_order(opened, Keys(realm), order)
    if not reply.ok:
        print(f"no: {reply.reason}", file=sys.stderr)
        return 1
    print(f"{done(order)}; the world {'stands still' if reply.paused else 'runs'} at {reply.time:.2f} s")
    return 0


def done(order: messages.WorldOrder) -> str:
    """The effect of an order that the world has obeyed."""
    match order.order:
        case "pause":
            return "paused"
        case "resume":
            return "goes on"
        case "step":
            return f"makes {order.steps} tick{'s' * (order.steps != 1)}"
        case "reset":
            return f"{order.name} is back at its start" if order.name else "all are back at their starts"
        case "remove":
            return f"{order.name} is out"
    what = order.name if order.kind is None else f"{order.name}, a {order.kind},"
    where = "" if order.at is None else f" at x = {order.at[0]:g} m, y = {order.at[1]:g} m"
    return f"{what} is in{where}"


def _change(order: messages.RunOrder, connect: list[str] | None, realm: str, lab: str | None) -> int:
    """Give an order to the conductor, wait until it is done, and print the result for each robot.

    Returns:
        The exit code: 0, 1 if something was refused, 2 if the whole order was.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    from agents.network.keys import Keys
    from experiments.real_time.conductor import orders
    from tools.commands.network import printable

    with session("robot", connect, lab, order.who, WAIT_S) as opened:
        reply = orders.send_run_order(opened, Keys(realm), order)
    if reply.reason:
        print(f"zenpark: {printable(reply.reason)}", file=sys.stderr)
        return 2
    for name, text in reply.done.items():
        print(f"{printable(name)}: {printable(text)}")
    for name, text in reply.refused.items():
        print(f"{printable(name)}: no: {printable(text)}", file=sys.stderr)
    return 1 if reply.refused else 0


def _command(what: messages.ChangeKind) -> Callable[..., int]:
    """A command that asks for one change of the named robots."""

    def change(
        names: Names, *, connect: Connect = None, realm: Realm = "park", lab: Lab = None, identity: As = "operator"
    ) -> int:
        from agents.network.messages import RunOrder

        return _change(RunOrder(what, names, who=identity), connect, realm, lab)

    return change


for _what, _help in CHANGES.items():
    robot_app.command(name=_what, help=_help)(_command(_what))


@robot_app.command()
def replace(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A robot of the run.")],
    *,
    spare: Annotated[str | None, typer.Option("--with", metavar="SPARE", help="A spare of the file.")] = None,
    body: Annotated[str | None, typer.Option(metavar="URI", help="Address of another body.")] = None,
    at: Annotated[
        Place | None, typer.Option(metavar="X Y", help="Where a twin starts [m]; else as the file says.")
    ] = None,
    yaw: Annotated[float, typer.Option(help="Of a twin that is put somewhere [rad].")] = 0.0,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> int:
    """Let another body take over a robot's name, links and plan; by default a spare of its kind."""
    from agents.network.messages import RunOrder

    order = RunOrder("replace", [name], who=identity, spare=spare, body=body, at=at, yaw=yaw)
    return _change(order, connect, realm, lab)
