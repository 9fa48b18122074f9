"""Commands that run experiments, and those that deal with their files and results."""

from __future__ import annotations

from typing import Annotated, Final

import typer

from tools.cli.options import Anyway, As, AsJson, Bodies, Case, Cases, File, Lab, OpenReport, Out, Report, Settings

app: Final = typer.Typer()


@app.command()
def run(
    file: File,
    *,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="In virtual time, in this process, as fast as it goes.")
    ] = False,
    case: Cases = None,
    out: Out = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all randomness, instead of the file's.")] = None,
    settings: Settings = None,
    as_json: AsJson = False,
    seeds: Annotated[
        int, typer.Option(min=1, max=100_000, help="Runs so many seeds: mean and 95 % interval (virtual only).")
    ] = 1,
    bodies: Bodies = None,
    here: Annotated[bool, typer.Option("--here", help="All robots on this machine, whatever [hosts] says.")] = False,
    anyway: Anyway = False,
    report: Report = True,
    open_report: OpenReport = False,
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Run an experiment: one process per robot, or in virtual time."""
    from experiments.real_time.conductor.conduct import RunOptions  # noqa: PLC0415
    from tools.commands.run import run as command  # noqa: PLC0415

    raise typer.Exit(
        command(
            file,
            RunOptions(case or [], bodies, here, lab, identity),
            virtual=virtual,
            out=out,
            seed=seed,
            settings=settings or [],
            as_json=as_json,
            seeds=seeds,
            anyway=anyway,
            report=report,
            open_report=open_report,
        )
    )


@app.command()
def sweep(
    file: File,
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PATH=VALUES...]",
            help="What changes: trigger.threshold=0.002:0.05:log12, or lin12, or a list 1,2,3; several make a grid. "
            "seeds=50 or seeds=101:150 [20 from the file's on]; tuning=1001:1060 for --optimize.",
        ),
    ] = None,
    *,
    case: Cases = None,
    settings: Settings = None,
    optimize: Annotated[
        str | None,
        typer.Option(
            metavar="WISH",
            help="Seeks values in the ranges instead: 'messages, iae<=1.01' (relative to the first case).",
        ),
    ] = None,
    out: Out = None,
    processes: Annotated[int | None, typer.Option(min=1, help="How many at once. [one per core]")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="On the workers of this dask scheduler, tcp://HOST:PORT.")
    ] = None,
    as_json: AsJson = False,
    anyway: Anyway = False,
    report: Report = True,
    open_report: OpenReport = False,
) -> None:
    """Run cases x values x seeds in virtual time on all cores; what is done is never run again."""
    from tools.commands.sweep import Request  # noqa: PLC0415
    from tools.commands.sweep import command as run_sweep  # noqa: PLC0415

    raise typer.Exit(
        run_sweep(
            Request(
                file=file,
                given=given or [],
                settings=settings or [],
                cases=case or [],
                out=out,
                scheduler=scheduler,
                processes=processes,
                optimize=optimize,
                as_json=as_json,
                anyway=anyway,
                report=report,
                open_report=open_report,
            )
        )
    )


@app.command()
def soak(
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="Experiment file. [robots that move for ever]")
    ] = None,
    *,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440.0, help="How long.")] = 60.0,
    robots: Annotated[int, typer.Option(min=2, help="Of the ready-made experiment.")] = 20,
    case: Case = None,
    out: Out = None,
    settings: Settings = None,
    bodies: Bodies = None,
    as_json: AsJson = False,
) -> None:
    """Run an experiment for long and say whether anything grows, is lost, slows down or dies."""
    from tools.reliability.soak import command  # noqa: PLC0415

    raise typer.Exit(
        command(
            file,
            minutes=minutes,
            robots=robots,
            case=case,
            out=out,
            settings=settings or [],
            bodies=bodies,
            as_json=as_json,
        )
    )


@app.command()
def chaos(
    file: File,
    *,
    faults: Annotated[int, typer.Option(min=1, help="How many.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of the script; the same seed gives the same.")] = 1,
    kinds: Annotated[
        list[str] | None, typer.Option(metavar="KIND,KIND", help="Only these: kill, freeze, partition, ... [all]")
    ] = None,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the last]")] = None,
    out: Out = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Run an experiment again and again while faults befall it, and say what did not hold."""
    from tools.reliability.chaos import command  # noqa: PLC0415

    raise typer.Exit(
        command(
            file,
            faults=faults,
            seed=seed,
            kinds=kinds or [],
            case=case,
            out=out,
            settings=settings or [],
            as_json=as_json,
        )
    )


@app.command()
def check(file: File, settings: Settings = None, as_json: AsJson = False) -> None:
    """Check an experiment file and say what theory says of it."""
    from experiments.check.check import command  # noqa: PLC0415

    raise typer.Exit(command(file, settings=settings or [], as_json=as_json))


@app.command()
def report(
    runs: Annotated[list[str], typer.Argument(metavar="RUN...", help="Folders of runs.")],
    out: Annotated[str | None, typer.Option(metavar="FILE", help="Where the report goes. [the run's folder]")] = None,
) -> None:
    """Write the report of one run, or compare several."""
    from tools.commands.run import report as command  # noqa: PLC0415

    raise typer.Exit(command(runs, out=out))


@app.command()
def export(
    folder: Annotated[str, typer.Argument(metavar="RUN", help="Folder of a run.")],
    target: Annotated[
        str | None, typer.Argument(metavar="FILE", help="FILE.mat or FILE.csv. [run.mat in the run's folder]")
    ] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="A table of trajectories: case, time, robot, x, ...")] = False,
) -> None:
    """Write a run for MATLAB, or its trajectories as one table."""
    from tools.commands.run import export as command  # noqa: PLC0415

    raise typer.Exit(command(folder, target, as_csv=as_csv))


@app.command()
def recover(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A recording that was cut off.")],
    target: Annotated[str | None, typer.Argument(metavar="TARGET", help="Where the whole one goes.")] = None,
) -> None:
    """Repair a recording whose writer was killed."""
    from tools.commands.run import recover as command  # noqa: PLC0415

    raise typer.Exit(command(file, target))


@app.command()
def new(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="A ready-made experiment (`zenpark list`); TARGET behind a formation."),
    ] = None,
    target: Annotated[str | None, typer.Argument(metavar="TARGET", help="The file to write. [NAME.toml]")] = None,
    *,
    polygon: Annotated[int | None, typer.Option(metavar="N", help="Robots on a regular polygon.")] = None,
    grid: Annotated[str | None, typer.Option(metavar="RxC", help="Robots on a grid, such as 5x8.")] = None,
    hemisphere: Annotated[int | None, typer.Option(metavar="N", help="On a hemisphere, with Delaunay links.")] = None,
    henneberg: Annotated[int | None, typer.Option(metavar="N", help="Minimally rigid: 2N - 3 links.")] = None,
    circulant: Annotated[int | None, typer.Option(metavar="N", help="On a circle, linked by --jumps.")] = None,
    jumps: Annotated[str, typer.Option(metavar="J,J", help="Of a circulant: i hears i ± J.")] = "1,2",
    kind: Annotated[str, typer.Option(metavar="KIND", help="Of the robots of a formation.")] = "crazyflie",
    spacing: Annotated[float, typer.Option(min=0.01, help="Between neighbours [m].")] = 0.6,
    scatter: Annotated[
        float | None, typer.Option(min=0.0, help="Starts are drawn this far around, by seed [m]. [0.3 spacing]")
    ] = None,
    law: Annotated[str, typer.Option(metavar="distance|displacement", help="Of a formation.")] = "distance",
    seed: Annotated[int, typer.Option(min=0, help="Of the file.")] = 1,
    duration: Annotated[float, typer.Option(min=1.0, help="[s]")] = 60.0,
) -> None:
    """Begin an experiment file from a ready-made one, or with a formation of any size."""
    asked = {"polygon": polygon, "grid": grid, "hemisphere": hemisphere, "henneberg": henneberg, "circulant": circulant}
    formations = [(what, str(size)) for what, size in asked.items() if size is not None]
    if not formations:
        if name is None:
            raise typer.BadParameter("give a NAME (`zenpark list`), or a formation such as --hemisphere 40")
        from tools.commands.run import new as copied  # noqa: PLC0415

        raise typer.Exit(copied(name, target))
    if len(formations) > 1 or target is not None:
        what = f"--{formations[1][0]}" if len(formations) > 1 else f"'{target}'"
        raise typer.BadParameter(f"{what} is too much behind --{formations[0][0]}: one formation, one TARGET")
    from experiments.authoring.generate import Wanted, command  # noqa: PLC0415

    wanted = Wanted(kind=kind, spacing=spacing, scatter=scatter, seed=seed, duration_s=duration, law=law)
    raise typer.Exit(command(*formations[0], name, wanted, jumps))


@app.command(name="import")
def import_(
    file: Annotated[str, typer.Argument(metavar="FILE.yaml", help="An experiment of Robotic Park's authors.")],
    target: Annotated[str | None, typer.Argument(metavar="TARGET", help="The file to write. [FILE.toml]")] = None,
    duration: Annotated[float, typer.Option(min=1.0, help="Their files do not say how long [s].")] = 60.0,
    poses: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Starts: an index of robots (.yaml), a Webots world (.wbt), or a table."),
    ] = None,
) -> None:
    """Turn an experiment file of Robotic Park's authors into one of zenpark."""
    from experiments.authoring.robotic_park.convert import command  # noqa: PLC0415

    raise typer.Exit(command(file, target, duration, poses))


@app.command(name="list")
def list_() -> None:
    """List the ready-made experiments and the plugins."""
    from tools.commands.run import list_all  # noqa: PLC0415

    raise typer.Exit(list_all())


@app.command()
def schema() -> None:
    """Print the JSON schema of the experiment file."""
    import json  # noqa: PLC0415

    from experiments.file.json_schema import schema as made  # noqa: PLC0415

    typer.echo(json.dumps(made(), indent=2))


@app.command()
def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME...]", help="start, codec, virtual, process, world, encounters, safety or intruders."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure what this machine can do, each figure beside a baseline."""
    from tools.bench.bench import command  # noqa: PLC0415

    raise typer.Exit(command(names or [], as_json=as_json))
