"""`./zenpark new --hemisphere 40` and its like: experiment files of formations of any size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from agents.body.kinds import KINDS, Kind
from agents.errors import did_you_mean
from experiments.authoring import layouts
from experiments.authoring.layouts import Layout, LayoutError
from experiments.catalogue import index
from experiments.definition.formation import bearable_factors
from experiments.file import catalogue as entries
from experiments.file.problems import refusal
from twins.arrays import Array, norm

LAWS: Final = ("distance", "displacement")
HOVER: Final = 0.8  # [m] height of flying robots in a plane
ROOM: Final = 0.5  # [m] room around the formation, on all sides and above
TAKEN: Final = 0.9  # share of the stiffest error that one decision takes: the loop settles without ringing
POWER: Final = 200  # rounds of the power method: λ to a few percent
HIGHEST: Final = 3.0  # gain of the reference experiment
FREE: Final = 0.3  # share of the spacing that starts may be scattered by, on each axis
PASSING: Final = 0.1  # [m] distance of robots on their way
MAX_ROBOTS: Final = 5000  # robots: five times as many as anything here was tried with
TELEMETRY: Final = 5000.0  # samples in a second, of all robots: 1,000 at 50 Hz are 10 MB, which fill a disk
WOBBLE: Final = "# hover_jitter = { sigma = 0.01, correlation_s = 0.5 }   # m, s: real drones wobble"


@dataclass(frozen=True)
class LayoutOptions:
    """Options of a generated experiment."""

    kind: str = "crazyflie"  # kind of all robots
    spacing: float = 0.6  # distance of neighbours [m]
    scatter: float | None = None  # deviation of the starts [m]; None for as much as keeps neighbours apart
    seed: int = 1  # seed of the file
    duration_s: float = 60.0  # [s]
    law: str = "distance"  # distance, or displacement, which finds the shape from any starts


def layout(what: str, size: str, wanted: LayoutOptions) -> Layout:
    """A formation by name.

    Args:
        what: polygon, grid or hemisphere.
        size: How many robots; of a grid, ROWSxCOLUMNS.
    """
    kind = _kind(wanted)
    if what == "grid":
        rows, by, columns = size.lower().replace("×", "x").partition("x")
        if not (by and rows.strip().isdecimal() and columns.strip().isdecimal()):
            raise LayoutError(f"a grid is given as ROWSxCOLUMNS, such as 5x8, not {size!r}")
        _allow(int(rows) * int(columns))
        return layouts.grid(int(rows), int(columns), wanted.spacing)
    count = int(size)
    _allow(count)
    if what == "polygon":
        return layouts.polygon(count, wanted.spacing)
    if not kind.flies:
        flying = " or ".join(each.name for each in KINDS.usable() if each.flies)
        raise LayoutError(f"a hemisphere needs robots that fly, not a {kind.name}: choose --kind {flying}")
    return layouts.hemisphere(count, wanted.spacing, 2.0 * kind.radius + PASSING)


def _allow(count: int) -> None:
    if count > MAX_ROBOTS:
        raise LayoutError(f"{count} robots are more than {MAX_ROBOTS}: give fewer")


def experiment_file(made: Layout, wanted: LayoutOptions) -> str:
    """The text of an experiment file, one line for each robot and each link.

    Raises LayoutError if robots of that kind cannot stand that near to one another.
    """
    kind = _kind(wanted)
    if wanted.law not in LAWS:
        raise LayoutError(f"no {wanted.law!r} among the laws of formations: choose {' or '.join(LAWS)}")
    position = _rounded(made, kind)
    first, second = position[made.pairs].transpose(1, 0, 2)
    distance = norm(first - second)
    needed = 2.0 * kind.radius + PASSING
    least = distance.min()
    if not least >= needed:  # refused as well if it is no number
        raise LayoutError(f"robots of kind {kind.name} need a spacing of {needed:.2f} m or more, not {least:.2f} m")
    scatter = round(FREE * wanted.spacing, 3) if wanted.scatter is None else wanted.scatter
    digits = max(2, len(str(len(made))))
    names = [f"{kind.prefix}{number:0{digits}d}" for number in range(1, len(made) + 1)]
    size = _arena(position, kind, scatter)
    width = max(len(f"{x:.3f}, {y:.3f}") for x, y in position[:, :2])
    starts = [f"[{x:.3f}, {y:.3f}]".ljust(width + 2) for x, y in position[:, :2].tolist()]
    held = [f", hover = {z:.3f}" if kind.flies else "" for z in position[:, 2].tolist()]
    rows = zip(names, starts, held, strict=True)
    robots = [f'{name} = {{ kind = "{kind.name}", start = {start}{hover} }}' for name, start, hover in rows]
    hz = next((each for each in (50.0, 25.0, 20.0, 10.0, 5.0, 4.0, 2.0) if each * len(made) <= TELEMETRY), 1.0)
    rates = ["[rates]", f"state_hz = {hz:g}".ljust(31) + "# telemetry", ""] if hz < 50.0 else []
    by_offset = wanted.law == "displacement"
    links = []
    for (i, j), (x, y, _), d in zip(made.pairs.tolist(), (second - first).tolist(), distance.tolist(), strict=True):
        asked = f"{{ offset = [{x + 0.0:.3f}, {y + 0.0:.3f}] }}" if by_offset else f"{d:.4f}"
        links.append(f'"{names[i]} - {names[j]}" = {asked}')
    strength = _taken(position, made, kind, 1.0 if by_offset else HIGHEST, by_offset=by_offset)
    pull = f"stiffness = {strength:g}" if by_offset else f"gain = {strength:g}"
    return "\n".join(
        [
            f"#:schema ./{index.SCHEMA}",
            f'title = "{made.title}"',
            f"duration_s = {wanted.duration_s:g}",
            f"seed = {wanted.seed}" + " " * 24 + "# of all noise and of the starts; another seed is another run",
            'trigger = { kind = "send-on-delta", threshold = 0.01 }   # m',
            "",
            "[arena]",
            f"size = [{size[0]:g}, {size[1]:g}, {size[2]:g}]",
            "",
            *rates,
            "[start]",
            f"scatter = {scatter:g}".ljust(31) + "# m, on each axis: where a robot starts is drawn around its place",
            f"deadline_s = {20.0 + 0.2 * len(made):g}",
            "",
            "[formation]",
            f'law = "{wanted.law}"',
            pull.ljust(31) + f"# 1/{'decision' if by_offset else '(m² · decision)'}: no decision overshoots",
            "clamp = 0.1",
            "",
            "[disturbance.all]",
            "position_sigma = 0.0003        # m, white noise of motion capture",
            *([WOBBLE] if kind.flies else []),
            "",
            f"[robots]                       # {len(made)}; start: its place in the formation",
            *robots,
            "",
            f"[formation.links]              # {len(links)}; metres; both listen",
            *links,
            "",
        ]
    )


def generate(what: str, size: str, target: str | None, wanted: LayoutOptions) -> tuple[Path, Layout]:
    """Write the experiment file of a formation; return its path and its layout.

    Raises DocumentError if there is no such formation, or the file cannot be written.
    """
    try:
        made = layout(what, size, wanted)
        text = experiment_file(made, wanted)
    except LayoutError as error:
        message, _, hint = str(error).partition(": ")
        raise refusal(f"--{what} {size}", message, hint) from None
    path = entries.write_new(text, Path(target or f"{what}-{size.lower().replace('×', 'x')}.toml"))
    return path, made


def _kind(wanted: LayoutOptions) -> Kind:
    if wanted.kind not in KINDS:
        raise LayoutError(f"no {wanted.kind!r} among the kinds of robots: {did_you_mean(wanted.kind, KINDS)}")
    return KINDS[wanted.kind]


def _rounded(made: Layout, kind: Kind) -> Array:
    """Places (N, 3) as they are written: the distances are those of the written heights, so that they can be met."""
    position = np.round(made.position, 3) + 0.0
    if not kind.flies:
        position[:, 2] = 0.0
    elif not made.position[:, 2].any():
        position[:, 2] = HOVER
    return position


def _arena(position: Array, kind: Kind, scatter: float) -> Array:
    """Size (3,) [m] in which the formation, its starts and their scatter have room, to the next half metre."""
    reach = 2.0 * (np.abs(position[:, :2]).max(axis=0) + kind.radius + scatter + ROOM)
    size = np.array([*reach, max(2.5, float(position[:, 2].max()) + ROOM)])
    return np.asarray(np.ceil(2.0 * size) / 2.0)


def _taken(position: Array, made: Layout, kind: Kind, highest: float, *, by_offset: bool) -> float:
    """The gain with which a decision takes `TAKEN` of the stiffest error: h·μ·λ, or h·k·λ of a law by offsets.

    λ is the largest eigenvalue of RᵀR, or of the Laplacian, by the power method on the links themselves: for thousands
    of robots as for ten.
    """
    i, j = made.pairs.T
    offset = (position[i] - position[j])[:, :2]
    way = np.column_stack([np.cos(np.arange(len(position))), np.sin(2.0 * np.arange(len(position)))])
    stiffest = 0.0
    for _ in range(POWER):
        stretch = way[i] - way[j]
        pull = stretch if by_offset else np.vecdot(offset, stretch)[:, None] * offset
        sums = [np.bincount(i, pull[:, k], len(way)) - np.bincount(j, pull[:, k], len(way)) for k in (0, 1)]
        way = np.column_stack(sums)
        stiffest = float(np.sqrt(np.vdot(way, way)))
        way = way / stiffest
    gain = min(highest, 0.5 * TAKEN * float(bearable_factors([kind], 10.0)[0]) / stiffest)
    digits = 1 - math.floor(math.log10(gain))
    return round(math.floor(gain * 10.0**digits) / 10.0**digits, max(digits, 0))
