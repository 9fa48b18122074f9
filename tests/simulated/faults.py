"""Faults of a simulated laboratory: what they are, how they are injected, and scripts of them drawn from a seed."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experiments.definition.plan import Plan
    from tests.simulated.world import World


@dataclass(frozen=True)
class Fault:
    """Fault, order or other step of a script, injected into a flight.

    `at` counts from the common start [s] (-0.5 or later), or from another moment: `since` "launch" (the command
    begins), "ready" (all robots are, and are ordered to take off) or "landing" (the conductor orders it).

    | kind | who | size |
    |---|---|---|
    | pause, kill, term | process | |
    | cut | process | the cable of its network is out |
    | split | processes | nothing passes between them and all others; "second": those that are started by hand; "ssh": \
no lifeline either |
    | loss, duplicate, reorder | process | share of its messages that may be dropped |
    | slow | process | factor of its delays; 1 is 0.3 ms |
    | late | process | mean lateness of its sleeps [s] |
    | hang | robot | its loop alone stands still [s] |
    | step, drift | process | of its wall clock [s]; of its uptime [s/s] |
    | disk | process | "full", "read-only", or seconds that each write takes |
    | body | robot | "adrift", "aloft" (it obeys no order to land), or a word of `bodies.READINGS`; with a number |
    | capture | robot | a word of `bodies.capture`, or such a word and a number: external positions alone |
    | order | robot | words of `./zenpark robot`: "hold", "land", "replace --body twin" |
    | command | | words after `./zenpark`: "estop --json" |
    | estop | | as `./zenpark estop` |
    | interrupt | conductor | Ctrl-C |
    | corrupt | robot | a stranger sends what nobody can read on its keys |
    | twice | robot | a second process of its name; clock correction [s] |

    A process is a robot, "router", "router2", "recorder", "world", "centre", "conductor" or "capture"; a robot's name
    means the newest process of this name that was started by the run.
    """

    at: float
    kind: str
    who: str = ""
    size: Any = 1.0
    lasts: float = 0.0  # [s]
    since: str = "start"

    def __str__(self) -> str:
        since = "" if self.since == "start" else f", since={self.since!r}"
        return f"Fault({self.at:g}, {self.kind!r}, {self.who!r}, {self.size!r}, {self.lasts:g}{since})"


def inject(world: World, fault: Fault) -> None:
    """Inject a fault now."""
    world.note(str(fault))
    if fault.kind not in LASTING_KINDS:
        world.disturbed_until = max(world.disturbed_until, world.now + fault.lasts)
    KINDS[fault.kind](world, fault)


def _pause(world: World, fault: Fault) -> None:
    if (process := world.process(fault.who)) is not None:
        process.pause()
        world.after(fault.lasts, process.resume)


def _kill(world: World, fault: Fault) -> None:
    if (process := world.process(fault.who)) is not None:
        process.kill()


def _terminate(world: World, fault: Fault) -> None:
    if (process := world.process(fault.who)) is not None:
        world.signal(process, signal.SIGTERM)


def _interrupt(world: World, _: Fault) -> None:
    world.signal(world.conductor, signal.SIGINT)


def _cut(world: World, fault: Fault) -> None:
    for session in world.sessions(fault.who):
        world.network.cut(session)
        world.after(fault.lasts, partial(world.network.cut, session, cut=False))


def _split(world: World, fault: Fault) -> None:
    words, network = fault.who.split(), world.network
    names = {process.name for process in map(world.process, words) if process is not None}

    def beyond(name: str) -> bool:
        return name in names or name.partition(" ")[0] in words

    def heal() -> None:
        if network.beyond is beyond:  # no later split is there
            network.split(None)

    network.split(beyond, lifelines="ssh" in words)
    world.after(fault.lasts, heal)


def _spoil_link(world: World, fault: Fault) -> None:
    """Let the links of a process drop, repeat, swap or delay messages."""
    name = {"duplicate": "dup"}.get(fault.kind, fault.kind)
    for session in world.sessions(fault.who):
        _set_for(world, session, name, fault)


def _delay(world: World, fault: Fault) -> None:
    """Let each sleep of a process last too long."""
    if (process := world.process(fault.who)) is not None:
        _set_for(world, process, "late", fault)


def _set_for(world: World, thing: object, name: str, fault: Fault) -> None:
    """Set an attribute to the size of a fault while it lasts, and then to that of another one that does, or back."""
    usual, sizes = world.altered.setdefault((thing, name), (getattr(thing, name), []))
    sizes.append(fault)
    setattr(thing, name, fault.size)

    def end() -> None:
        sizes[:] = [each for each in sizes if each is not fault]
        setattr(thing, name, sizes[-1].size if sizes else usual)

    world.after(fault.lasts, end)


def _hang(world: World, fault: Fault) -> None:
    if (process := world.process(fault.who)) is not None:
        world.hang(process, fault.size)


def _step(world: World, fault: Fault) -> None:
    if (process := world.process(fault.who)) is not None:
        process.wall += fault.size


def _drift(world: World, fault: Fault) -> None:
    if (process := world.process(fault.who)) is not None:
        process.drift = fault.size


def _disk(world: World, fault: Fault) -> None:
    """Let the disk of a process refuse or delay what it writes; its name stands for a process started later, too."""
    world.disks[fault.who] = fault.size
    if fault.lasts:
        world.after(fault.lasts, lambda: world.disks.pop(fault.who, None))


def _body(world: World, fault: Fault) -> None:
    _misread(world, world.readings, fault)


def _capture(world: World, fault: Fault) -> None:
    _misread(world, world.captures, fault)


def _misread(world: World, table: dict[str, Any], fault: Fault) -> None:
    word, number = fault.size if isinstance(fault.size, tuple | list) else (fault.size, 0.0)
    made: tuple[str, float, dict[str, Any]] = (word, number, {})
    table[fault.who] = made
    if fault.lasts:
        world.after(fault.lasts, lambda: table.get(fault.who) is made and table.pop(fault.who))


def _order(world: World, fault: Fault) -> None:
    word, *more = fault.size.split()
    world.operate(["robot", word, fault.who, *more], fault.who)


def _command(world: World, fault: Fault) -> None:
    world.operate(fault.size.split(), fault.who)


def _estop(world: World, _: Fault) -> None:
    world.operate(["estop"], "")


def _corrupt(world: World, fault: Fault) -> None:
    world.spoil(fault.who, fault.lasts)


def _twice(world: World, fault: Fault) -> None:
    world.start_second(fault.who, float(fault.size) if fault.size != 1.0 else 0.0)


KINDS: dict[str, Callable[[World, Fault], None]] = {
    "pause": _pause,
    "kill": _kill,
    "term": _terminate,
    "interrupt": _interrupt,
    "cut": _cut,
    "split": _split,
    "loss": _spoil_link,
    "duplicate": _spoil_link,
    "reorder": _spoil_link,
    "slow": _spoil_link,
    "late": _delay,
    "hang": _hang,
    "step": _step,
    "drift": _drift,
    "disk": _disk,
    "body": _body,
    "capture": _capture,
    "order": _order,
    "command": _command,
    "estop": _estop,
    "corrupt": _corrupt,
    "twice": _twice,
}
LASTING_KINDS = ("order", "command", "estop", "late", "drift", "step", "disk")  # the network is as it was

# of random scripts: how often a kind is drawn
WEIGHTS = {
    "pause": 4, "kill": 2, "cut": 4, "loss": 2, "duplicate": 1, "reorder": 1, "slow": 1, "late": 2, "step": 2,
    "drift": 1, "hang": 2, "disk": 1.5, "body": 4, "order": 6, "estop": 0.7, "interrupt": 0.3, "twice": 1.5,
    "term": 0.7,
    "command": 1,
    "corrupt": 1,
}  # fmt: skip
SINCE = {"start": 8, "launch": 2, "ready": 1, "landing": 1}  # how often a fault counts from a moment
BEYOND = {"second": 0.6, "operator": 0.3, "conductor": 0.15, "recorder": 0.15, "world": 0.2}  # shares beyond a split
BUSY_S = {"launch": 3.0, "ready": 2.0, "landing": 2.0}  # time after it in which much happens
OF_ANY = ("pause", "kill", "term", "cut", "loss", "slow", "late", "step")  # kinds that may hit any process
COUNTS = (1, 2, 3, 5, 8, 12)
LENGTHS = (0.2, 0.7, 1.3, 2.5, 6.0, 14.0)  # [s]
ORDERS = (
    "hold", "hold", "resume", "resume", "land", "takeoff", "stop", "start", "start", "restart", "remove", "add",
    "replace --body twin",
)  # fmt: skip
SIZES: dict[str, Sequence[Any]] = {
    "loss": (0.05, 0.3, 0.9),
    "duplicate": (0.1, 0.5),
    "reorder": (0.1, 0.5),
    "slow": (30, 300, 1500),
    "late": (0.005, 0.02, 0.1),
    "step": (-60.0, -2.0, -0.3, 0.3, 2.0, 60.0),
    "drift": (-0.01, -1e-4, 1e-4, 0.01),
    "hang": (0.3, 0.8, 3.0, 12.0),
    "disk": ("full", "read-only", 0.05, 0.6),
    "twice": (0.0, -100.0, 100.0),
    "command": (
        "robot hold", "robot resume", "robot land", "robot start", "estop --dry-run", "runs", "keys", "world pause",
        "world resume", "world reset",
    ),
    "order": ORDERS,
    "body": (
        "nan", ("jump", 0.2), ("jump", -0.2), ("jump", 1.0), ("jump", -3.0), "stuck", ("stuck", 0.0005), ("late", 0.2),
        ("late", 0.6), ("late", 3.0), "silent", ("battery", 0.05), "motors", "aloft", ("adrift", 0.3), ("adrift", 1.0),
    ),
    "capture": (
        "gone", "stuck", ("stuck", 0.0005), ("jump", 0.3), ("jump", -0.6), ("jump", 2.0), ("stamp", -0.2),
        ("stamp", -0.4), ("stamp", -2.0), ("stamp", 0.3), ("stamp", 5.0), ("late", 0.1), ("late", 0.3), ("turned", 0.5),
        ("turned", 1.57), "flip", "swap",
    ),
}  # fmt: skip


def draw(
    seed: int,
    robots: Sequence[str],
    captured: Sequence[str],
    duration_s: float,
    only: Sequence[str] = (),
    *,
    others: Sequence[str] = (),
    sites: int = 0,
) -> list[Fault]:
    """A random script, sorted by time; half of them have few kinds and few victims, which meet more often.

    `captured`: robots with a motion capture; `others`: further processes of the run that faults may hit; `sites`:
    number of routers on machines of their own.
    """
    rng = random.Random(seed)
    weights = {**WEIGHTS, **({"capture": 5} if captured else {}), **({"split": 6} if sites > 1 else {})}
    names, kinds = list(robots), [kind for kind in weights if not only or kind in only]
    count = rng.choice(COUNTS)
    if rng.random() < 0.5:
        kinds, names = rng.sample(kinds, min(3, len(kinds))), rng.sample(names, min(2, len(names)))
    drawn = [_draw_one(rng, kinds, weights, names, captured, duration_s) for _ in range(count)]
    for number, fault in enumerate(drawn) if others else ():
        if fault.kind in OF_ANY and rng.random() < 0.35:
            drawn[number] = replace(fault, who=rng.choice(others))
    return sorted(drawn, key=lambda fault: fault.at)


def draw_for(plan: Plan, seed: int, kinds: Sequence[str] = ()) -> list[Fault]:
    """A random script for the processes of an experiment."""
    robots, sites = plan.experiment.robots, len(plan.experiment.network.connect or ())
    captured = [name for name, robot in robots.items() if robot.position == "external" and robot.body != "world"]
    others = [f"router{number}" for number in range(2, max(sites, plan.experiment.network.routers) + 1)]
    others += ["centre"] * (plan.experiment.architecture == "centralised")
    others += ["world"] * any(robot.body == "world" for robot in robots.values())
    return draw(seed, plan.names, captured, plan.experiment.duration_s, kinds, others=others, sites=sites)


def _draw_one(  # noqa: PLR0917 - as `draw`, which has made them
    rng: random.Random,
    kinds: Sequence[str],
    weights: dict[str, float],
    names: Sequence[str],
    captured: Sequence[str],
    duration_s: float,
) -> Fault:
    kind = rng.choices(kinds, weights=[weights[kind] for kind in kinds])[0]
    at, lasts = rng.uniform(-0.3, duration_s + 1.0), rng.choice(LENGTHS) * rng.uniform(0.7, 1.3)
    who = rng.choice(names)
    if kind in {"pause", "cut", "loss", "slow"} and rng.random() < 0.35:
        who = rng.choice(("recorder", "conductor", *(["router"] if kind == "pause" else [])))
    elif kind == "kill":
        who = rng.choice([*names, *names, "router", "recorder", *(["conductor"] if rng.random() < 0.3 else [])])
    elif kind == "disk":
        who = rng.choice(("recorder", "recorder", "conductor"))
    elif kind == "capture":
        who = rng.choice(captured)
    elif kind == "split":
        others = [each for each, share in BEYOND.items() if rng.random() < share]
        who = " ".join(["router2", *others, *(name for name in names if rng.random() < 0.5)])
    elif kind in {"estop", "interrupt", "command"}:
        who = ""
    size = rng.choice(SIZES[kind]) if kind in SIZES else 1.0
    since = rng.choices([*SINCE], weights=SINCE.values())[0]
    if since != "start":
        at = rng.uniform(0.0, BUSY_S[since])
    return Fault(round(at, 3), kind, who, size, round(lasts, 3), since)
