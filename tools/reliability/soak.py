"""`./zenpark soak`: an experiment in real time for hours, and whether anything grows, is lost, slows down or dies.

Sampled from outside, by a process that takes no part in the run: memory, threads, descriptors and CPU of each process,
what the robots count, and how long their poses take. Everything is written down as it comes.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import typer

from tools.commands.options import AsJson, Bodies, Case, Out, Settings, example, print_json

app: Final = typer.Typer()

SPACING: Final = 2.0  # [m] between the leaders of neighbouring groups
MEMBERS: Final = (  # kind, offset from the leader [m], links to members before it by place
    ("turtlebot3", (0.0, 0.0), ()),
    ("khepera4", (-0.5, 0.0), (0,)),
    ("crazyflie", (0.5, 0.0), (0,)),
    ("crazyflie", (0.0, 0.5), (0, 2)),
    ("khepera4", (0.0, -0.5), (0, 1)),
)
PREFIX: Final = {"crazyflie": "CF", "khepera4": "KH", "turtlebot3": "TB"}
CIRCLE_M: Final = 0.3
TURN_S: Final = 30.0
HEAD: Final = """\
title = "Endurance: {count} robots in groups behind leaders that never rest"
duration_s = {duration:g}
seed = 1
trigger = {{ kind = "send-on-delta", threshold = 0.01 }}   # m

[arena]
size = [{width:g}, {width:g}, 2.0]

[rates]
state_hz = 10                        # telemetry for hours: five times less than usual

[disturbance.all]
position_sigma = 0.0003              # m

[safety]
battery_low = 0                      # it lasts longer than a drone's battery

[formation]
law = "displacement"

"""


def text(count: int, duration_s: float) -> str:
    """The experiment file for so many robots.

    Args:
        count: At least 2.
        duration_s: [s].
    """
    groups = -(-count // len(MEMBERS))
    columns = next(side for side in range(1, groups + 1) if side * side >= groups)
    robots: list[str] = []
    links: list[str] = []
    legs: list[str] = []
    for group in range(groups):
        x, y = ((place - (columns - 1) / 2) * SPACING for place in (group % columns, group // columns))
        names: list[str] = []
        for kind, (dx, dy), senders in MEMBERS[: count - group * len(MEMBERS)]:
            name = f"{PREFIX[kind]}{len(robots) + 1:02}"
            hover = ", hover = 0.8" if kind == "crazyflie" else ""
            yaw = "" if names else ", 0.0"
            robots.append(f'{name} = {{ kind = "{kind}", start = [{x + dx:g}, {y + dy:g}{yaw}]{hover} }}')
            for other in senders:
                ox, oy = MEMBERS[other][1]
                arrow = ">" if other == 0 else "-"
                links.append(f'"{names[other]} {arrow} {name}" = {{ offset = [{dx - ox:g}, {dy - oy:g}] }}')
            if not names:
                plan = f'{{ kind = "circle", radius = {CIRCLE_M:g}, period_s = {TURN_S:g} }}'
                legs.append(f'[[timeline]]\nat_s = 0.0\nrobot = "{name}"\nplan = {plan}\n')
            names.append(name)
    head = HEAD.format(count=count, duration=duration_s, width=SPACING * columns + 1.0)
    return (
        head
        + "[formation.links]\n"
        + "\n".join(links)
        + "\n\n[robots]\n"
        + "\n".join(robots)
        + "\n\n"
        + "\n".join(legs)
    )


@app.command(epilog=example("soak --minutes 60 --robots 20", "soak triangle --minutes 10"))
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
) -> int:
    """Run an experiment for long and say whether anything grows, is lost, slows down or dies."""
    from agents.runtime.command_line import Interrupts
    from experiments.file.document import chosen, load, loads
    from experiments.recording.run_folder import SOURCE, new_folder
    from tools.progress import print_findings
    from tools.reliability import soak_verdict
    from tools.reliability.run_process import Request
    from tools.reliability.soak_sampler import sample

    changes = [*(settings or []), f"duration_s={60.0 * minutes!r}"]
    if file is None:
        read = replace(loads(text(robots, 60.0 * minutes), *changes), path=Path("soak.toml"))
    else:
        read = load(file, *changes)
    name = case or next(iter(read.cases()))
    experiment = chosen(read, [name])[name]
    folder = new_folder(read, out)
    read.keep(folder / SOURCE)
    request = Request(str(folder / SOURCE), str(folder), name, changes, bodies)
    with Interrupts() as interrupted:
        soaked = sample(
            experiment,
            request,
            interrupted=interrupted,
            show=lambda line: print(line, file=sys.stderr, flush=True),
        )
    findings = soak_verdict.judge(soaked)
    well = soak_verdict.passed(findings)
    words = ["./zenpark", "soak", *([file] if file is not None else [])]
    page = soak_verdict.write(folder, soaked, findings, " ".join([*words, "--minutes", f"{minutes:g}"]))
    if as_json:
        found = [{"mark": finding.mark, "text": finding.text} for finding in findings]
        print_json({"run": folder, "passed": well, "findings": found})
    else:
        print_findings(findings)
        print(f"report: {page}")
    if soaked.interrupted:
        return 130
    return 0 if well else 1
