"""Experiments of campaigns: fixed ones, and random ones made from a seed."""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist
from pathlib import Path

MIX = (Path(__file__).parent / "mix.toml").read_text("utf-8")
APART_M = 0.9  # distance of two starts
RANDOM = "random"
_HEAD, *_CASES = MIX.split("[cases.")


@dataclass(frozen=True)
class Setting:
    """An experiment, as `./zenpark run` is told: a catalogue's name or a text, a case, and changed settings."""

    experiment: str
    case: str | None = None
    settings: tuple[str, ...] = ()
    sites: int = 0  # routers that run already


def _mix(case: str) -> Setting:
    """The mixed experiment with one of its cases: reading the others takes time."""
    return Setting(f"{_HEAD}[cases.{next(each for each in _CASES if each.startswith(case))}")


SLOWLY = ("rates.body_hz=50", "rates.state_hz=10")
AVOIDING = ('avoidance.kind="barrier"', 'avoidance.hears="all"', "avoidance.clearance=1.0")
FIXED = {
    "triangle": Setting("triangle", "event", SLOWLY),
    "triangle-avoiding": Setting("triangle", "periodic", (*SLOWLY, *AVOIDING)),
    "mix-event": _mix("event"),
    "mix-capture": _mix("capture"),
    "mix-centre": _mix("centre"),
    "mix-packed": _mix("packed"),
    "mix-routers": _mix("routers"),
    "mix-world": _mix("world"),
}
# of the catalogue, at its own rates and for long enough to come to rest
LONG = {
    "robotic-park": Setting("robotic-park", "event", ("duration_s=30",)),
    "flocking": Setting("flocking", "event-loss", ("duration_s=15",)),
    "architectures": Setting("architectures", "hybrid", ("duration_s=30",)),
    "convoy": Setting("convoy", "event", ("duration_s=15",)),
    "tracking": Setting("tracking", "event", ("duration_s=15",)),
    "mpc": Setting("mpc", "event", ("duration_s=10",)),
    "obstacle-course": Setting("obstacle-course", "event", ("duration_s=15",)),
}
SITES = "random-sites"
NAMES = (*FIXED, *LONG, "mix-sites", RANDOM, SITES)


def setting_of(name: str, seed: int) -> Setting:
    """An experiment by its name; the random one is made from the seed."""
    if name == RANDOM:
        return Setting(make(random.Random(f"experiment {seed}")))
    if name == SITES:
        text = make(random.Random(f"experiment {seed}"))
        return Setting(
            "".join(line for line in text.splitlines(True) if not line.startswith("network.routers")), sites=2
        )
    return FIXED.get(name) or LONG.get(name) or replace(FIXED["mix-event"], sites=2)


def make(rng: random.Random) -> str:
    """A random experiment of two to six robots, as TOML."""
    names = "ABCDEF"[: rng.choice((2, 3, 3, 4, 4, 5, 6))]
    places = rng.sample([(APART_M * x, APART_M * y) for x in (-1, 0, 1) for y in (-1, 0, 1)], len(names))
    kinds = {name: rng.choice(("khepera4", "crazyflie", "crazyflie", "turtlebot3", "tello")) for name in names}
    heights = {name: round(rng.uniform(0.5, 1.2), 2) for name in names if kinds[name] in {"crazyflie", "tello"}}
    starts = dict(zip(names, places, strict=True))
    lines = ['title = "Random"', "duration_s = 6.0", _choice(rng, "on_loss", ("restart",))]
    lines += ["rates.body_hz = 50", "rates.state_hz = 10", "arena.size = [4.0, 4.0, 2.5]"]
    lines.append("disturbance.all.position_sigma = 0.0003")
    lines += _options(rng, kinds)
    lines += _robots(rng, kinds, starts, heights)
    lines += _links(rng, names, starts, heights)
    return "\n".join([line for line in lines if line]) + "\n"


def _choice(rng: random.Random, key: str, values: Sequence[object]) -> str:
    """A setting, or none in half of all cases."""
    if rng.random() < 0.5:
        return ""
    value = rng.choice(values)
    return f"{key} = {value!r}".replace("'", '"').replace("True", "true").replace("False", "false")


def _options(rng: random.Random, kinds: dict[str, str]) -> list[str]:
    trigger = rng.choice(('kind = "periodic", period_s = 0.1', 'kind = "send-on-delta", threshold = 0.02'))
    lines = [
        f"trigger = {{ {trigger} }}",
        _choice(rng, "architecture", ("centralised",)),
        _choice(rng, "network.encoding", ("msgpack",)),
        _choice(rng, "network.routers", (2, 3)),
        _choice(rng, "start.missing", ("go-on", "go-on", "abort")),
        _choice(rng, "start.deadline_s", (4.0, 8.0)),
        _choice(rng, "safety.separation", (0.25,)),
        _choice(rng, "safety.lost_neighbour", ("drop", "hold", "land")),
        _choice(rng, "safety.lost_conductor", ("finish", "land")),
        _choice(rng, "safety.offline_s", (5.0, 10.0)),
    ]
    if rng.random() < 0.5:
        lines.append(f'avoidance = {{ kind = "barrier", hears = "{rng.choice(("all", "neighbours"))}" }}')
    if "crazyflie" in kinds.values() and rng.random() < 0.3:
        lines.append('spares.S = { kind = "crazyflie", start = [1.6, 1.6], hover = 0.7 }')
    return lines


def _robots(
    rng: random.Random,
    kinds: dict[str, str],
    starts: dict[str, tuple[float, float]],
    heights: dict[str, float],
) -> list[str]:
    lines = []
    captured, shared = rng.random() < 0.3, rng.random() < 0.3
    for name, kind in kinds.items():
        x, y = starts[name]
        hover = f", hover = {heights[name]}" if name in heights else ""
        measured = ', position = "external"' if captured and rng.random() < 0.7 else ""
        group = ', process = "g"' if shared and rng.random() < 0.5 else ""
        lines.append(f'robots.{name} = {{ kind = "{kind}", start = [{x:.2f}, {y:.2f}]{hover}{measured}{group} }}')
    return lines


def _links(
    rng: random.Random, names: str, starts: dict[str, tuple[float, float]], heights: dict[str, float]
) -> list[str]:
    """A tree of links, and some more; how far apart two robots go is near to what they are."""
    pairs = [(rng.choice(names[:number]), name) for number, name in enumerate(names) if number]
    pairs += [pair for pair in itertools.combinations(names, 2) if pair not in pairs and rng.random() < 0.25]
    lines = []
    for one, other in pairs:
        p, q = ((*starts[name], heights.get(name, 0.0)) for name in (one, other))
        lines.append(f'formation.links."{one} - {other}" = {dist(p, q) * rng.uniform(0.85, 1.15):.2f}')
    return lines
