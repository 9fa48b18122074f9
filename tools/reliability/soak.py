"""`zenpark soak`: an experiment in real time for hours, and whether anything grows, is lost, slows down or dies.

Sampled from outside, by a process that takes no part in the run: memory, threads, descriptors and CPU of each process,
what the robots count, and how long their poses take. Everything is written down as it comes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import AsJson, Bodies, Case, Out, Settings

if TYPE_CHECKING:
    import zenoh

    from agents.network import messages
    from agents.network.keys import Keys
    from experiments.file.document import Document
    from tools.reliability.soak_verdict import Row, Soaked

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
        for kind, (dx, dy), heard in MEMBERS[: count - group * len(MEMBERS)]:
            name = f"{PREFIX[kind]}{len(robots) + 1:02}"
            hover = ", hover = 0.8" if kind == "crazyflie" else ""
            yaw = "" if names else ", 0.0"
            robots.append(f'{name} = {{ kind = "{kind}", start = [{x + dx:g}, {y + dy:g}{yaw}]{hover} }}')
            for other in heard:
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


SAMPLE_S: Final = 5.0
SAMPLES: Final = 60  # at least so many, however short it is
POLL_S: Final = 0.1
START_S: Final = 120.0  # 20 robots on a small machine take their time
ROUTER_S: Final = 30.0
OVER_S: Final = 90.0  # landing, and the end of the recording
TABLE: Final = "soak.csv"
TELL_S: Final = 60.0
MARKS: Final = {"good": "✓", "fair": "!", "bad": "✗", "plain": "·"}


@dataclass
class _Counts:
    """What a robot said of itself last, and the delays [s] of poses that it heard since the last sample."""

    status: messages.Status | None = None
    delays: list[float] = field(default_factory=list)


class _Ear:
    """Takes in what robots say."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str]) -> None:
        from agents.network import pubsub

        self._keys = keys
        self.robots = {name: _Counts() for name in robots}
        self._statuses = pubsub.pose_subscriber(session, keys.status("*"), 4096)
        self._states = pubsub.subscriber(session, keys.state("*"), 16384)

    def listen(self) -> None:
        from agents.network import messages
        from experiments.real_time.conductor.run_view import by_robots

        for status in by_robots(self._statuses.handler, messages.Status, keys=self._keys, robots=self.robots):
            self.robots[status.robot].status = status
        for state in by_robots(self._states.handler, messages.State, keys=self._keys, robots=self.robots):
            if state.phase == "running":
                self.robots[state.robot].delays += [heard.arrived - heard.stamp for heard in state.heard]


def rows(found: Mapping[int, str], robots: Mapping[str, _Counts], t: float, recording: Path) -> Iterator[Row]:
    """One row for each process, and what robots said since the rows before.

    Args:
        found: What each process is.
        robots: What robots said; their delays are taken away.
        t: From the common start [s].
        recording: The file.
    """
    import msgspec

    from tools.reliability import processes
    from tools.reliability.soak_verdict import Row

    for pid, name in found.items():
        usage = processes.usage(pid)
        if usage is None or name == processes.OTHER:
            continue
        row = Row(round(t, 2), name, round(usage.rss_mb, 3), usage.threads, usage.files, usage.cpu_s)
        members = [robots[each] for each in name.split("+") if each in robots]
        said = [each.status for each in members if each.status is not None]
        if said:
            delays = sorted(delay for each in members for delay in each.delays)
            for each in members:
                each.delays.clear()
            row = msgspec.structs.replace(
                row,
                lost=sum(sum(status.lost.values()) for status in said),
                missed=said[0].missed,  # the process counts these, not the robot
                ticks=said[0].ticks,
                malformed=said[0].malformed,
                heard=len(delays),
                delay_s=round(delays[len(delays) // 2], 6) if delays else None,
                longest_s=round(delays[-1], 6) if delays else None,
            )
        elif name == "recorder" and recording.exists():
            row = msgspec.structs.replace(row, recording_mb=round(recording.stat().st_size / 1e6, 3))
        yield row


def measured(  # noqa: PLR0915 - one loop that follows one run
    read: Document,
    file: Path,
    folder: Path,
    *,
    case: str,
    changes: Sequence[str],
    bodies: str | None,
    interrupted: Callable[[], bool],
    tell: Callable[[str], None],
) -> Soaked:
    """Runs a case and samples it until it is over.

    Args:
        read: The experiment, changes applied.
        file: Where it stands.
        folder: For recording, logs and table; it exists.
        case: The case.
        changes: What was changed, for the process that runs it.
        bodies: As behind `--bodies`.
        interrupted: Asked whether the user wants to end.
        tell: Gets a line now and then.

    Raises:
        RunFailed: If it does not begin.
    """
    import csv

    from agents.clock import Clock
    from agents.network import session as network
    from agents.network.endpoints import free_endpoint
    from agents.network.keys import Keys
    from experiments.file.document import chosen
    from experiments.real_time.conductor.conductor import RunFailed
    from experiments.real_time.hosts.launcher import Launcher
    from tools.reliability.run_process import Watched
    from tools.reliability.soak_verdict import COLUMNS, Soaked

    experiment = chosen(read, [case])[case]
    groups: dict[str, list[str]] = {}
    for name, robot in experiment.robots.items():
        groups.setdefault(robot.process or name, []).append(name)
    duration, recording = experiment.duration_s, folder / f"{case}.mcap"
    every = min(SAMPLE_S, duration / SAMPLES)
    endpoint = free_endpoint(preferred_port=0)
    sampled: list[Row] = []
    died: dict[str, float] = {}
    start: float | None = None
    began = told = time.monotonic()
    with ExitStack() as stack:
        launcher = stack.enter_context(Launcher(folder / "logs"))
        own = [*changes, f"network.listen=['{endpoint}']"]
        watched = Watched(launcher, file, folder, cases=[case], changes=own, bodies=bodies)
        session = stack.enter_context(network.open_session([endpoint], name="soak", wait_s=ROUTER_S))
        ear = _Ear(session, Keys(experiment.network.realm), list(experiment.robots))
        table = stack.enter_context((folder / TABLE).open("w", newline="", encoding="utf-8"))
        written = csv.writer(table)
        written.writerow(COLUMNS)
        due, over, clock = 0.0, False, Clock()
        while watched.process.alive and not interrupted():
            time.sleep(POLL_S)
            ear.listen()
            now = clock.utc()
            for event in watched.news():
                if event.kind == "start":
                    start = event.stamp
                    due = start + every
                elif event.kind == "lost" and start is not None and now < start + duration:
                    died[event.source] = round(now - start, 1)
                over |= event.kind == "phase" and event.text.startswith("landing")
            if start is None:
                if time.monotonic() > began + START_S:
                    raise RunFailed(f"no common start within {START_S:g} s: see {folder / 'logs'}")
                continue
            if over or now < due or now > start + duration:
                if now > start + duration + OVER_S:
                    raise RunFailed(f"it does not end {OVER_S:g} s after its time: see {folder / 'logs'}")
                continue
            due += every
            found = watched.processes()
            for row in rows(found, ear.robots, now - start, recording):
                sampled.append(row)
                written.writerow(getattr(row, column) for column in COLUMNS)
            table.flush()
            if time.monotonic() > told + TELL_S:
                told = time.monotonic()
                tell(_line(sampled, now - start, duration))
        asked = interrupted()
        watched.end()
        code = watched.process.handle.poll()
    if start is None and not asked:
        raise RunFailed(f"it never began: {watched.process.tail()}")
    return Soaked(experiment.title, tuple(map("+".join, groups.values())), duration, sampled, code, died, asked)


def _line(sampled: Sequence[Row], t: float, duration: float) -> str:
    now = [row for row in sampled if row.time_s == sampled[-1].time_s]
    lost = sum(row.lost or 0 for row in now)
    return (
        f"{t / 60.0:6.1f} of {duration / 60.0:g} min: {len(now)} processes, "
        f"{sum(row.rss_mb for row in now):.0f} MB, {lost} poses lost"
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
) -> int:
    """Run an experiment for long and say whether anything grows, is lost, slows down or dies."""
    import json

    from agents.runtime.command_line import Interrupts
    from experiments.file.document import chosen, load, loads
    from experiments.recording.run_folder import SOURCE, new_folder
    from tools.reliability import soak_verdict

    changes = [*(settings or []), f"duration_s={60.0 * minutes!r}"]
    if file is None:
        read = replace(loads(text(robots, 60.0 * minutes), *changes), path=Path("soak.toml"))
    else:
        read = load(file, *changes)
    name = case or next(iter(read.cases()))
    chosen(read, [name])
    folder = new_folder(read, out)
    read.keep(folder / SOURCE)
    with Interrupts() as interrupted:
        soaked = measured(
            read,
            folder / SOURCE,
            folder,
            case=name,
            changes=changes,
            bodies=bodies,
            interrupted=interrupted,
            tell=lambda line: print(line, file=sys.stderr, flush=True),
        )
    findings = soak_verdict.judge(soaked)
    well = soak_verdict.passed(findings)
    words = ["zenpark", "soak", *([file] if file is not None else [])]
    page = soak_verdict.write(folder, soaked, findings, " ".join([*words, "--minutes", f"{minutes:g}"]))
    if as_json:
        said = [{"mark": finding.mark, "text": finding.text} for finding in findings]
        print(json.dumps({"run": str(folder), "passed": well, "findings": said}))
    else:
        for finding in findings:
            print(f"{MARKS[finding.mark]} {finding.text}")
        print(f"report: {page}")
    if soaked.interrupted:
        return 130
    return 0 if well else 1
