"""Orders to the robots of a run or to those started by hand (`./zenpark robot`), and to a world (`./zenpark world`)."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from tools import completion
from tools.commands.options import As, AsJson, Connect, Lab, Realm, example, group, print_json, session

if TYPE_CHECKING:
    import zenoh

    from agents.network import messages
    from agents.network.keys import Keys

robot_app: Final = group("Give orders to robots: those of a run that is under way, and those started by hand.")
world_app: Final = group("Run a world by hand, and give orders to the one that is running.")

Place = tuple[float, float]
Names = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME...",
        help="Robots.",
        autocompletion=completion.robots,
    ),
]
NamesOrAll = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[NAME...]",
        help="Robots. [all]",
        autocompletion=completion.robots,
    ),
]

WAIT_S: Final = 2.0  # for a router
# orders to the robots themselves, in a run or by hand; without names to all of them
ORDERS: Final[Mapping[messages.OrderKind, str]] = {
    "takeoff": "Let robots take off that were started by hand.",
    "start": "Begin the experiment of robots that were started by hand, at one common time.",
    "hold": "Let robots hold where they are; the others go on.",
    "resume": "Let robots go on that were told to hold.",
    "land": "Land robots where they are.",
}
DONE: Final[Mapping[str, str]] = {
    "takeoff": "takes off",
    "start": "starts",
    "hold": "holds where it is",
    "resume": "goes on",
    "land": "lands",
    "stop": "stops",
}
# changes of a run, which its conductor makes
CHANGES: Final[Mapping[messages.ChangeKind, str]] = {
    "remove": "Land robots and end their processes; the others go on without them.",
    "restart": "Start robots of a run again, whether they fly, were removed or crashed.",
    "add": "Let robots join a run: on standby, missing at the start, or started by hand.",
}


def _print_results(done: Mapping[str, str], refused: Mapping[str, str], *, as_json: bool) -> int:
    """Print the result of an order for each robot; the exit code: 1 if a robot refused, else 0."""
    from tools.commands.network import printable

    if as_json:
        print_json({"ok": not refused, "done": done, "refused": refused})
    else:
        for name, text in done.items():
            print(f"{printable(name)}: {printable(text)}")
        for name, text in refused.items():
            print(f"{printable(name)}: no: {printable(text)}", file=sys.stderr)
    return int(bool(refused))


def _refuse(reason: str, *, as_json: bool) -> int:
    from tools.commands.network import printable

    if as_json:
        print_json({"ok": False, "error": reason})
    print(f"zenpark: {printable(reason)}", file=sys.stderr)
    return 2


def _alive(opened: zenoh.Session, keys: Keys) -> list[str]:
    """Robots of the realm that are on the network, by name."""
    replies = opened.liveliness().get(keys.alive("*"), timeout=2.0)
    found = [keys.whose(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None]
    return sorted(name for name in found if name is not None)


def _give(
    what: messages.OrderKind, robots: Sequence[str], opened: zenoh.Session, keys: Keys, who: str, *, as_json: bool
) -> int:
    """Give an order to the robots themselves, to all if none is named, and tell the recorder; the exit code."""
    from agents.network import messages
    from experiments.real_time.conductor import orders

    receivers = robots or _alive(opened, keys)
    if not receivers:
        return _refuse(f"no robot in the realm '{keys.realm}'; `./zenpark keys` shows the members", as_json=as_json)
    at = time.time() + orders.start_lead_s(len(receivers)) if what == "start" else None
    replies = orders.send_order(opened, keys, receivers, messages.Order(what, at=at))
    done = {name: reply.reason or DONE[what] for name, reply in replies.items() if reply.ok}
    refused = {name: reply.reason or reply.phase for name, reply in replies.items() if not reply.ok}
    text = f"{what}: {', '.join(done) or 'no robot'}" + f"; refused by {', '.join(refused)}" * bool(refused)
    event = messages.Event(time.time(), "order", who, text)
    opened.put(keys.event, messages.encode(event), encoding=messages.JSON)
    return _print_results(done, refused, as_json=as_json)


def _change(order: messages.RunOrder, opened: zenoh.Session, keys: Keys, *, as_json: bool) -> int:
    """Give an order to the conductor, wait until it is done, and print the result for each robot.

    Returns:
        The exit code: 0, 1 if something was refused, 2 if the whole order was.
    """
    from experiments.real_time.conductor import orders

    reply = orders.send_run_order(opened, keys, order)
    if reply.reason:
        return _refuse(reply.reason, as_json=as_json)
    return _print_results(reply.done, reply.refused, as_json=as_json)


def _order_command(what: messages.OrderKind) -> Callable[..., int]:
    def order(
        names: NamesOrAll = None,
        *,
        connect: Connect = None,
        realm: Realm = "park",
        lab: Lab = None,
        identity: As = "operator",
        as_json: AsJson = False,
    ) -> int:
        from agents.network.keys import Keys

        with session("robot", connect, lab, identity, WAIT_S) as opened:
            return _give(what, names or [], opened, Keys(realm), identity, as_json=as_json)

    return order


def _change_command(what: messages.ChangeKind) -> Callable[..., int]:
    def change(
        names: Names,
        *,
        connect: Connect = None,
        realm: Realm = "park",
        lab: Lab = None,
        identity: As = "operator",
        as_json: AsJson = False,
    ) -> int:
        from agents.network.keys import Keys
        from agents.network.messages import RunOrder

        with session("robot", connect, lab, identity, WAIT_S) as opened:
            return _change(RunOrder(what, names, who=identity), opened, Keys(realm), as_json=as_json)

    return change


for _order, _help in ORDERS.items():
    robot_app.command(name=_order, help=_help, epilog=example(f"robot {_order}", f"robot {_order} CF01"))(
        _order_command(_order)
    )


@robot_app.command(epilog=example("robot stop KH01"))
def stop(
    names: Names,
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
    as_json: AsJson = False,
) -> int:
    """Cut the motors of robots: a drone falls. `./zenpark estop` cuts those of all."""
    from agents.network.keys import Keys

    with session("robot", connect, lab, identity, WAIT_S) as opened:
        return _give("stop", names, opened, Keys(realm), identity, as_json=as_json)


for _what, _help in CHANGES.items():
    robot_app.command(name=_what, help=_help, epilog=example(f"robot {_what} KH01 KH02"))(_change_command(_what))


@robot_app.command(epilog=example("robot replace CF02 --with S1", "robot replace KH01 --body twin --at 0.5 -0.2"))
def replace(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="A robot of the run.",
            autocompletion=completion.robots,
        ),
    ],
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
    as_json: AsJson = False,
) -> int:
    """Let another body take over a robot's name, links and plan; by default a spare of its kind."""
    from agents.network.keys import Keys
    from agents.network.messages import RunOrder

    order = RunOrder("replace", [name], who=identity, spare=spare, body=body, at=at, yaw=yaw)
    with session("robot", connect, lab, identity, WAIT_S) as opened:
        return _change(order, opened, Keys(realm), as_json=as_json)


def _tell_world(
    order: messages.WorldOrder, connect: list[str] | None, realm: str, lab: str | None, identity: str, *, as_json: bool
) -> int:
    """Give an order to the world of a realm and print its reply; the exit code."""
    from agents.network.keys import Keys
    from experiments.real_time.conductor import orders

    with session("world", connect, lab, identity, WAIT_S) as opened:
        reply = orders.send_world_order(opened, Keys(realm), order)
    if as_json:
        print_json(reply)
    elif reply.ok:
        print(f"{done(order)}; the world {'stands still' if reply.paused else 'runs'} at {reply.time:.2f} s")
    else:
        print(f"no: {reply.reason}", file=sys.stderr)
    return int(not reply.ok)


def _plain(what: Any) -> Callable[..., int]:  # noqa: ANN401 - a kind of WorldOrder
    def order(
        connect: Connect = None,
        realm: Realm = "park",
        lab: Lab = None,
        identity: As = "operator",
        as_json: AsJson = False,
    ) -> int:
        from agents.network.messages import WorldOrder

        return _tell_world(WorldOrder(what), connect, realm, lab, identity, as_json=as_json)

    return order


for _pace, _help in (
    ("pause", "Let the world stand still; robots hold, because their positions are still published."),
    ("resume", "Let a paused world go on."),
):
    world_app.command(name=_pace, help=_help, epilog=example(f"world {_pace}"))(_plain(_pace))


@world_app.command(epilog=example("world step --steps 50"))
def step(
    *,
    steps: Annotated[int, typer.Option(min=1, help="Ticks.")] = 1,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
    as_json: AsJson = False,
) -> int:
    """Let a world make some ticks, and pause it."""
    from agents.network.messages import WorldOrder

    return _tell_world(WorldOrder("step", steps=steps), connect, realm, lab, identity, as_json=as_json)


@world_app.command(epilog=example("world reset", "world reset KH01"))
def reset(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="A robot or an obstacle. [all]")] = None,
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
    as_json: AsJson = False,
) -> int:
    """Put a robot or an obstacle of a world back to its start, or all of them."""
    from agents.network.messages import WorldOrder

    return _tell_world(WorldOrder("reset", name=name), connect, realm, lab, identity, as_json=as_json)


@world_app.command(epilog=example("world remove KH01"))
def remove(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A robot or an obstacle.")],
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
    as_json: AsJson = False,
) -> int:
    """Take a robot or an obstacle out of a world."""
    from agents.network.messages import WorldOrder

    return _tell_world(WorldOrder("remove", name=name), connect, realm, lab, identity, as_json=as_json)


@world_app.command(
    epilog=example(
        "world spawn KH09 --kind khepera4 --at 0.5 -0.5",
        'world spawn box1 --obstacle \'{"box": [0.4, 0.2], "mass": 2.0}\' --at 1.0 0.0',
    )
)
def spawn(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A robot or an obstacle.")],
    *,
    kind: Annotated[str | None, typer.Option(help="Of a robot that is not in the file.")] = None,
    at: Annotated[Place | None, typer.Option(metavar="X Y", help="Where it is put [m].")] = None,
    yaw: Annotated[float, typer.Option(help="Of a robot that is put in [rad].")] = 0.0,
    obstacle: Annotated[
        str | None, typer.Option(metavar="JSON", help='Puts in an obstacle, such as \'{"radius": 0.1, "at": [0, 1]}\'.')
    ] = None,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
    as_json: AsJson = False,
) -> int:
    """Put a robot or an obstacle into a world."""
    from agents.network.messages import WorldOrder
    from experiments.file import structure
    from twins.scene import Obstacle

    given = None
    if obstacle is not None:
        given = structure.parse_object("--obstacle", obstacle, Obstacle, ("arena", "obstacles", name))
        if at is not None:
            given["at"] = at
        if not given.keys() & {"at", "wall"}:
            raise typer.BadParameter(f"{name} has no place; say where, with --at X Y")
    order = WorldOrder("spawn", name=name, kind=kind, at=at, yaw=yaw, obstacle=given)
    return _tell_world(order, connect, realm, lab, identity, as_json=as_json)


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
