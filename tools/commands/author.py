"""Commands that write experiment files: a new one, an import, the exercises of a course, which are then marked."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Argument, Option

from experiments.catalogue import index
from tools.options import WIDEST, AsJson, example, print_result, warn
from tools.terminal import say

if TYPE_CHECKING:
    from experiments.course.marking import Mark

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
        if target is None and name.endswith(".toml") and not Path(name).exists():
            raise typer.BadParameter(f"say what {name} begins with: `./zenpark new triangle {name}`, or --polygon 5")
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


Origin = Annotated[
    Path | None, Option("--from", metavar="COURSE", help="Folder of a course of your own, with solutions. [zenpark's]")
]


@app.command(epilog=example("course exercises"))
def course(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder to write them into.")], *, origin: Origin = None
) -> None:
    """Write the exercises of the course, without their solutions, into a folder."""
    from experiments.course.exercises import OURS, read_course, write_exercises

    known = read_course(origin or OURS)
    write_exercises(known, folder)
    first = folder / next(iter(known.exercises.values())).file
    print(f"{folder}: {len(known.exercises)} exercises; fill in what is blank, then `./zenpark run {first} --virtual`")


@app.command(epilog=example("mark groups/*", "mark groups/* --only 04-events --seeds 10"))
def mark(
    folders: Annotated[list[Path], Argument(metavar="FOLDER...", help="Of each group, with the files it filled in.")],
    *,
    origin: Origin = None,
    only: Annotated[
        list[str] | None, Option("--only", metavar="EXERCISE", help="Only this exercise; may be repeated.")
    ] = None,
    seeds: Annotated[int, Option(min=1, max=1000, help="Number of seeds, all of which must pass.")] = 3,
    seed: Annotated[int | None, Option(min=0, help="The first of them. [an unknown one]")] = None,
    limit: Annotated[int, Option(min=1, help="Computing time for an exercise of a group [s].")] = 60,
    as_json: AsJson = False,
) -> int:
    """Mark what groups handed in, by code of the course alone; exit code 1 unless all criteria are met."""
    import secrets

    from agents.errors import did_you_mean
    from experiments.course.exercises import OURS, CourseError, read_course
    from experiments.course.marking import DEFAULT, SOLUTION, marks
    from experiments.course.wall import lacking

    known = read_course(origin or OURS)
    if stranger := next((name for name in only or [] if name not in known.exercises), None):
        raise CourseError(f"no exercise '{stranger}'; {did_you_mean(stranger, known.exercises)}")
    asked = {name: each for name, each in known.exercises.items() if not only or name in only}
    first = secrets.randbelow(1_000_000) if seed is None else seed
    if missing := lacking():
        say(
            f"no wall around {' and '.join(missing)} on this system: what groups wrote could reach yours", to=sys.stderr
        )
    found = []
    limits = DEFAULT._replace(cpu_s=limit)
    for each in marks(known, [*asked.values()], folders, range(first, first + seeds), limits):
        found.append(each)
        say(*(f"{each.group} {each.exercise}: {word}" for word in each.words), to=sys.stderr)
    names = [SOLUTION, *(folder.resolve().name for folder in folders)]
    found.sort(key=lambda each: (names.index(each.group), each.exercise))
    passed = all(each.passed for each in found)
    if faulty := [each.exercise for each in found if each.group == SOLUTION and not each.passed]:
        say(
            f"the solution itself misses criteria of {', '.join(faulty)}: mend these first, their marks say nothing",
            to=sys.stderr,
        )
    again = f"seeds {first} to {first + seeds - 1}; the same again with --seed {first}"
    result = {"passed": passed, "seed": first, "seeds": seeds, "marks": found}
    print_result(result, *_table(found, [*asked]), again, as_json=as_json)
    return int(not passed)


def _table(found: Sequence[Mark], exercises: Sequence[str]) -> list[str]:
    """A line for each group: criteria met of those that there are, by exercise; `-` where nothing was handed in."""
    groups: dict[str, dict[str, Mark]] = {}
    for each in found:
        groups.setdefault(each.group, {})[each.exercise] = each
    wide = max(map(len, groups))
    of = sum(each.of for each in next(iter(groups.values())).values())
    heads = [name.partition("-")[0][:8] for name in exercises]
    lines = [f"{'group':<{wide}}  " + "".join(f"{head:>6}" for head in heads) + f"{'all':>8}"]
    for group, marks in groups.items():
        cells = [f"{each.met}/{each.of}" if each.of else "-" for each in map(marks.__getitem__, exercises)]
        all_met = f"{sum(each.met for each in marks.values())}/{of}"
        lines.append(f"{group:<{wide}}  " + "".join(f"{cell:>6}" for cell in cells) + f"{all_met:>8}")
    return lines
