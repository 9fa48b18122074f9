"""`./zenpark view`: a run in the browser, live or from its recording. `top`: its table."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TextIO

import typer
from typer import Argument, Option

from agents.clock import wait_until
from agents.errors import ExplainedError
from tools import completion
from tools.options import (
    As,
    AsJson,
    Connect,
    Lab,
    Realm,
    RealmOfRun,
    example,
    open_in_browser,
    place,
    print_json,
    routers,
)

if TYPE_CHECKING:
    import zenoh
    from rich.console import Group

    from experiments.real_time.hosts.run_registry import RegisteredRun
    from experiments.scene.condition import RobotRow
    from experiments.view.acting import WatchedRun
    from experiments.view.serving import PageServer
    from tools.options import Place

app: Final = typer.Typer()

PORT: Final = 8080
START_S: Final = 30.0  # time until a run that was started just now is registered
POLL_S: Final = 0.1
END_S: Final = 10.0  # limit for the page of a run to end with it
REFRESH_S: Final = 0.25  # period of the table
FIRST_S: Final = 5.0  # limit for the reports of a table that is printed once


@app.command(epilog=example("view", "view runs/first --open", "view runs/first/event.mcap --send --loop"))
def view(
    run: Annotated[
        str | None,
        Argument(metavar="[RUN]", help="Folder of a run. [that which is up here]", autocompletion=completion.folders),
    ] = None,
    *,
    send: Annotated[bool, Option("--send", help="Play the recording onto the network instead.")] = False,
    loop: Annotated[bool, Option("--loop", help="With --send: restart at the end.")] = False,
    connect: Connect = None,
    realm: RealmOfRun = None,
    lab: Lab = None,
    identity: Annotated[
        str | None,
        Option("--as", metavar="NAME", help="Name of the certificate, in a lab; operators give orders. [observer]"),
    ] = None,
    port: Annotated[int, Option(min=1, max=65535, help="Port of the page; the next free one if it is taken.")] = PORT,
    dark: Annotated[bool, Option("--dark", help="Use dark colours.")] = False,
    open_page: Annotated[bool, Option("--open", help="Open it in the browser.")] = False,
    with_run: Annotated[bool, Option("--with-run", hidden=True, help="Wait for the run, and end with it.")] = False,
) -> int:
    """Show a run in the browser, in three dimensions: a live one, or a recording."""
    from agents.runtime.command_line import on_termination
    from experiments.recording.reader import RecordingError

    ended = threading.Event()
    if send:
        if run is None:
            raise typer.BadParameter("name the run that is sent", param_hint="--send")
        with on_termination(ended.set):
            who = identity or "operator"
            return _send(_recordings(Path(run))[0], place(connect, lab, acting=True), realm, who, ended, loop=loop)
    require_viser()
    with on_termination(ended.set):
        up = None if run is None else _running_run(Path(run), wait_s=START_S if with_run else 0.0, ended=ended)
        if run is not None and up is None:
            try:
                return _replay(Path(run), ended, port=port, dark=dark, open_page=open_page)
            except RecordingError:
                up = _starting_run(Path(run), ended)
                if up is None:
                    raise
        watched = _watched(connect, realm or "park", lab, identity) if up is None else _of_run(up, identity)
        _live(watched, ended, port=port, dark=dark, open_page=open_page, with_run=with_run)
    return 0


@app.command(epilog=example("top"))
def top(
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "observer",
    as_json: AsJson = False,
) -> int:
    """Show the live table of a run, from any shell; in a pipe and as JSON, the table once."""
    from agents.network.session import open_session
    from agents.network.shutdown import closing_cleanly
    from agents.runtime.command_line import on_termination

    ended = threading.Event()
    with on_termination(ended.set):
        watched = _watched(connect, realm, lab, identity)
        opened = open_session(watched.endpoints, name="top", wait_s=5.0, identity=watched.identity)
        with closing_cleanly(opened) as (session, declared):
            table = _Top(session, watched)
            declared.append(table)
            return table.run(ended, as_json=as_json)


class _Top:
    """The table of a run that is seen from outside."""

    def __init__(self, session: zenoh.Session, watched: WatchedRun) -> None:
        from agents.network.keys import Keys
        from experiments.view.observer import Observer
        from tools.live_table import Trends

        self._watched, self._trends = watched, Trends()
        self._observer = Observer(session, Keys(watched.realm))

    def run(self, ended: threading.Event, *, as_json: bool) -> int:
        """Draw until it is ended or the run is over; return the exit code."""

        from rich.console import Console
        from rich.live import Live

        console = Console()
        over = False
        if as_json or not console.is_terminal:
            over = wait_until(self._all_reported, FIRST_S, POLL_S, ended)
            if as_json:
                seen = self._observer
                print_json({"case": seen.case, "time_s": seen.elapsed, "robots": self._rows()})
            else:
                console.print(self._table(console.width, len(self._observer.robots) + 20), soft_wrap=True)
            return int(not over)
        with Live(console=console, auto_refresh=False, screen=True) as live:
            while not (over or ended.wait(REFRESH_S)):
                over = self._watched.run is not None and not self._watched.run.alive
                self._observer.update()
                live.update(self._table(console.width, console.height), refresh=True)
        console.print(self._table(console.width, console.height - 1))  # what stood there last stays
        return 0

    def _all_reported(self) -> bool:
        """Whether each robot has reported twice, or is gone."""
        from experiments.scene.condition import Condition

        self._observer.update()
        reports = self._observer.robots
        return bool(reports) and all(
            row.cpu is not None or row.condition >= Condition.STOPPED or not reports[row.name].known
            for row in self._rows()
        )

    def _rows(self) -> list[RobotRow]:
        from experiments.scene.stage import touched

        observer, now = self._observer, self._observer.now()
        rows = []
        stage = observer.stage
        linked = {stage.names[row] for row in stage.links.receiver.tolist()}
        for name in [*stage.names, *sorted(observer.robots.keys() - {*stage.names})]:
            report = observer.robots[name]
            error = report.state.error if report.state is not None and (name in linked or not linked) else None
            known, touches = observer.condition(name), touched(name, observer.overlaps)
            rows.append(self._trends.row(name, known, report.status, error, now=now, touches=touches))
        return rows

    def _table(self, width: int, height: int) -> Group:
        from experiments.file.document import UNNAMED
        from tools.live_table import common_phase, drawn, heading

        stage, rows = self._observer.stage, self._rows()
        where = self._watched
        title = stage.title or (where.run.title if where.run is not None else f"realm {where.realm}")
        duration = None if stage.plan is None else stage.plan.experiment.duration_s
        phase, case = common_phase([row.phase for row in rows]), self._observer.case
        phase = f"{case}: {phase}" if case not in ("", UNNAMED) else phase
        title = heading(phase, self._observer.elapsed, duration, title)
        return drawn(title, rows, [each for each in self._observer.events if each.kind != "robot"], width, height)


def _send(file: Path, where: Place, realm: str | None, identity: str, ended: threading.Event, *, loop: bool) -> int:
    """Play a recording onto the network; return the exit code."""
    from agents.network.session import open_session
    from agents.network.shutdown import closing_cleanly
    from experiments.view.broadcast import Broadcast
    from experiments.view.replay import ReplayClock

    opened = open_session(where.endpoints, name="replay", wait_s=5.0, identity=identity)
    with closing_cleanly(opened) as (session, declared):
        played = Broadcast(session, file, realm)
        declared.append(played)
        clock = ReplayClock(0.0, played.end - played.begin)
        clock.playing, clock.loop = True, loop
        print(f"{file}: {clock.end:.1f} s, in the realm {played.keys.realm}", flush=True)
        print(f"messages sent: {played.run(ended, clock, where.endpoints)}")
    return 0


def _recordings(folder: Path) -> list[Path]:
    """Recordings of a run, the oldest first."""
    from experiments.recording.reader import RecordingError

    if folder.suffix == ".mcap":
        return [folder]
    files = sorted(folder.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
    if not files:
        raise RecordingError(f"{folder}: holds no recording (.mcap); name the folder of a run")
    return files


def require_viser() -> None:
    """Check that the library of the view is installed."""
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise ExplainedError(
            "the view needs viser: `./zenpark view` installs it; elsewhere `pip install zenpark[view]`"
        )


@contextmanager
def following(folder: Path, identity: str) -> Iterator[None]:
    """Inside, a run that begins is shown by a process of its own, which ends with it."""
    import subprocess

    command = [sys.executable, "-m", "tools.guard", "view", str(folder), "--with-run", "--open", "--as", identity]
    # its address is for people: standard output may be JSON
    viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sys.stderr, start_new_session=True)
    try:
        yield
    finally:
        viewer.terminate()
        try:
            viewer.wait(END_S)
        except subprocess.TimeoutExpired:  # the results of the run must not wait for it
            viewer.kill()
            viewer.wait()


def play(folder: Path, pace: float) -> None:
    """Play the run of a folder in the browser, `pace` times as fast as real time, until Ctrl-C."""
    from agents.runtime.command_line import on_termination

    ended = threading.Event()
    with on_termination(ended.set):
        _replay(folder, ended, port=PORT, dark=False, open_page=True, pace=pace)


def _running_run(folder: Path, *, wait_s: float, ended: threading.Event) -> RegisteredRun | None:
    """The run of a folder, if it is up, or is within `wait_s` [s]."""

    from experiments.real_time.hosts import run_registry

    here = str(folder.absolute())

    def found() -> RegisteredRun | None:
        return next((run for run in run_registry.runs() if run.folder == here and run.alive), None)

    wait_until(found, wait_s, POLL_S, ended)
    return found()


def _starting_run(folder: Path, ended: threading.Event) -> RegisteredRun | None:
    """The run that begins in a folder, if its experiment file was written just now."""
    import time

    from experiments.recording.run_folder import SOURCE

    file = folder / SOURCE
    if not file.is_file() or time.time() - file.stat().st_mtime > START_S:
        return None
    print(f"zenpark: {folder}: nothing to show yet; the run may be starting, and is waited for", file=sys.stderr)
    return _running_run(folder, wait_s=START_S, ended=ended)


def _of_run(run: RegisteredRun, identity: str | None) -> WatchedRun:
    from experiments.view.acting import WatchedRun

    return WatchedRun(run.endpoints, run.realm, identity or _default_identity(run.endpoints), run)


def _replay(
    folder: Path, ended: threading.Event, *, port: int, dark: bool, open_page: bool, pace: float | None = None
) -> int:
    from experiments.recording.playback import read_whole
    from experiments.view import replay as replaying
    from experiments.view.serving import served

    files = _recordings(folder)
    films = [replaying.Film(read_whole(file)) for file in files]
    with served(port, dark=dark) as server:
        page = replaying.ReplayView(server, films, str(folder), dark=dark, pace=pace)
        _tell(server, f"{folder}; Ctrl-C ends it", open_page=open_page, to=sys.stdout if pace is None else sys.stderr)
        page.run(ended.is_set)
    return 0


def _watched(connect: list[str] | None, realm: str, lab: str | None, identity: str | None) -> WatchedRun:
    """The run on the command line, else the newest one of this machine."""
    from experiments.real_time.hosts import run_registry
    from experiments.view.acting import WatchedRun

    if given := routers(connect, lab):
        return WatchedRun(given, realm, identity or _default_identity(given))
    found = run_registry.look()
    up = [run for run in found.runs if run.what == "run" and run.alive]
    if not up:
        raise ExplainedError(
            f"{found.words}: start one (`./zenpark run robotic-park`), name its router (--connect), or the folder of a "
            "recording"
        )
    if len(up) > 1:
        print(f"zenpark: {len(up)} runs are up; this is the newest one", file=sys.stderr)
    return _of_run(up[-1], identity)


def _default_identity(endpoints: Sequence[str]) -> str:
    """Identity of a page: in a lab it only looks, unless --as names an operator."""
    from agents.network.lab import lab_of

    return "operator" if lab_of(endpoints) is None else "observer"


def _live(
    watched: WatchedRun, ended: threading.Event, *, port: int, dark: bool, open_page: bool, with_run: bool
) -> None:
    from agents.network.session import open_session
    from agents.network.shutdown import closing_cleanly
    from experiments.view import live
    from experiments.view.acting import Acting, may_act
    from experiments.view.serving import served

    opened = open_session(watched.endpoints, name="view", wait_s=5.0, identity=watched.identity)
    with closing_cleanly(opened) as (session, declared), served(port, dark=dark) as server:
        acting = Acting(session, watched) if may_act(watched) else None
        page = live.LiveView(server, session, watched, dark=dark, acting=acting)
        declared.append(page)
        _tell(
            server, f"{watched.words}; {'closes with the run' if with_run else 'Ctrl-C ends it'}", open_page=open_page
        )
        page.run(lambda: ended.is_set() or (with_run and watched.run is not None and not watched.run.alive))
        folder = watched.run.folder if with_run and watched.run is not None else ""
        page.close(f"the view has ended{f' with the run: ./zenpark view {folder} plays it' if folder else ''}")


def _tell(server: PageServer, what: str, *, open_page: bool, to: TextIO | None = None) -> None:
    print(f"{server.address}  {what}", flush=True, file=to)
    if open_page:
        open_in_browser(server.address_for_once(), server.address)
