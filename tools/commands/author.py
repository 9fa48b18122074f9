"""Commands that write experiment files: a new one, one of Robotic Park's authors, or one of Crazyswarm2."""

from __future__ import annotations

import textwrap
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from experiments.catalogue import index
from tools.options import WIDEST, AsJson, example, print_result, warn

app: Final = typer.Typer()


class Gain(StrEnum):
    """Gains of an imported file."""

    THEIRS = "theirs"
    STABLE = "stable"


@app.command(epilog=example("new triangle mine.toml", "new --hemisphere 40 swarm.toml"))
def new(
    name: Annotated[
        str | None,
        Argument(
            metavar="NAME", help="Ready-made (`./zenpark list`); TARGET behind a formation.", autocompletion=index.names
        ),
    ] = None,
    target: Annotated[str | None, Argument(metavar="TARGET", help="The file to write. [NAME.toml]")] = None,
    *,
    polygon: Annotated[int | None, Option(metavar="N", help="Place robots on a regular polygon.")] = None,
    grid: Annotated[str | None, Option(metavar="RxC", help="Place robots on a grid, such as 5x8.")] = None,
    hemisphere: Annotated[
        int | None, Option(metavar="N", help="Place robots on a hemisphere, with Delaunay links.")
    ] = None,
    kind: Annotated[str, Option(metavar="KIND", help="Kind of the robots of a formation.")] = "crazyflie",
    spacing: Annotated[float, Option(min=0.01, max=1000.0, help="Distance between neighbours [m].")] = 0.6,
    scatter: Annotated[
        float | None, Option(min=0.0, max=1000.0, help="Largest random offset of starts, by seed [m]. [0.3 spacing]")
    ] = None,
    law: Annotated[str, Option(metavar="distance|displacement", help="Law of a formation.")] = "distance",
    seed: Annotated[int, Option(min=0, help="Of the file.")] = 1,
    duration: Annotated[float, Option(min=1.0, max=86400.0, help="[s]")] = 60.0,
) -> None:
    """Begin an experiment file from a ready-made one, or with a formation of any size."""
    from experiments.authoring.generate import LayoutOptions, generate
    from experiments.file import catalogue, json_schema

    asked = {"polygon": polygon, "grid": grid, "hemisphere": hemisphere}
    warn(json_schema.unusable())
    formations = [(what, str(size)) for what, size in asked.items() if size is not None]
    if not formations:
        if name is None:
            raise typer.BadParameter("give a NAME (`./zenpark list`), or a formation such as --hemisphere 40")
        path = catalogue.copy_entry(name, Path(target) if target else Path(f"{name}.toml"))
        print(f"{path}: a copy of {name}; change it, then `./zenpark check {path}` and `./zenpark run {path}`")
        return
    if len(formations) > 1 or target is not None:
        what = f"--{formations[1][0]}" if len(formations) > 1 else f"'{target}'"
        raise typer.BadParameter(f"{what} is too much behind --{formations[0][0]}: one formation, one TARGET")
    wanted = LayoutOptions(kind=kind, spacing=spacing, scatter=scatter, seed=seed, duration_s=duration, law=law)
    path, made = generate(*formations[0], name, wanted)
    print(f"{path}: {made.title}, {len(made.pairs)} links; `./zenpark check {path}`, `./zenpark run {path} --virtual`")


@app.command(name="import", epilog=example("import crazyflies.yaml", "import park.yaml park.toml --duration 60"))
def import_(
    file: Annotated[
        str, Argument(metavar="FILE.yaml", help="crazyflies.yaml of Crazyswarm2, or a file of Robotic Park's authors.")
    ],
    target: Annotated[str | None, Argument(metavar="TARGET", help="The file to write. [FILE.toml]")] = None,
    *,
    duration: Annotated[float, Option(min=1.0, max=86400.0, help="Duration, which their files lack [s].")] = 60.0,
    poses: Annotated[
        str | None, Option(metavar="FILE", help="Starts (Robotic Park): index (.yaml) or Webots world (.wbt).")
    ] = None,
    gain: Annotated[
        Gain | None, Option(help="Gains of the file (Robotic Park), or lowered where the twins would swing. [theirs]")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Turn an experiment file of Robotic Park's authors, or the drones of Crazyswarm2, into a file of zenpark."""
    from experiments.authoring import crazyswarm
    from experiments.authoring.robotic_park.convert import convert
    from experiments.authoring.robotic_park.file import text_of

    text = text_of(file, "name an experiment file of Robotic Park's authors, or a crazyflies.yaml of Crazyswarm2")
    if crazyswarm.is_crazyswarm(file, text):
        if poses is not None or gain is not None:
            raise typer.BadParameter("--poses and --gain are for files of Robotic Park; this is one of Crazyswarm2")
        path, notes = crazyswarm.convert(file, text, target, duration)
    else:
        path, notes = convert(file, target, duration, poses, calm=gain is Gain.STABLE)
    lines = [f"{path}: from {file}; `./zenpark check {path}`, `./zenpark run {path} --virtual`"]
    if notes:
        lines.append("Not carried over, or not as it was:")
    lines += [textwrap.fill(note, WIDEST, initial_indent="  - ", subsequent_indent="    ") for note in notes]
    print_result({"file": path, "notes": notes}, *lines, as_json=as_json)
