"""`zenpark view`: a run in three dimensions in the browser, live or from its recording."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TextIO

import typer

from tools.commands.options import Connect, Lab, Realm, routers

if TYPE_CHECKING:
    from agents.runtime.run_registry import Run
    from experiments.run import Watch
    from experiments.view.acting import Watched

app: Final = typer.Typer()

PORT: Final = 8080
START_S: Final = 30.0  # until a run that was started just now is registered
POLL_S: Final = 0.1


class ViewError(RuntimeError):
    """A view that cannot be opened, with the remedy."""


@app.command()
def view(
    run: Annotated[
        str | None, typer.Argument(metavar="[RUN]", help="Folder of a run. [the run that is up on this machine]")
    ] = None,
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: Annotated[
        str | None,
        typer.Option(
            "--as", metavar="NAME", help="Whose certificate, in a lab; only an operator gives orders. [observer]"
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Of the page; the next free one if it is taken.")] = PORT,
    dark: Annotated[bool, typer.Option("--dark", help="Dark colours.")] = False,
    open_page: Annotated[bool, typer.Option("--open", help="Opens it in the browser.")] = False,
    with_run: Annotated[
        bool, typer.Option("--with-run", hidden=True, help="Waits for the run, and ends with it.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after this time [s].")] = None,
) -> int:
    """Show a run in the browser, in three dimensions: a live one, or a recording."""
    require_viser()
    from agents.runtime.command_line import on_termination

    ended = threading.Event()
    with on_termination(ended.set):
        if seconds is not None:
            threading.Timer(seconds, ended.set).start()
        up = None if run is None else _up(Path(run), wait_s=START_S if with_run else 0.0, ended=ended)
        if run is not None and up is None:
            return _replay(Path(run), ended, port=port, dark=dark, open_page=open_page)
        watched = _watched(connect, realm, lab, identity) if up is None else _of_run(up, identity)
        _live(watched, ended, port=port, dark=dark, open_page=open_page, with_run=with_run)
    return 0


def require_viser() -> None:
    """Check that the library of the view is installed.

    Raises:
        ViewError: If it is not.
    """
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise ViewError("the view needs viser: `./zenpark view` installs it; elsewhere `pip install zenpark[view]`")


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
        viewer.wait()


@contextmanager
def paced(pace: float) -> Iterator[Watch]:
    """Inside, runs in virtual time are shown in this process, `pace` times as fast as they would be in real time."""
    from experiments.view import live
    from experiments.view.paced import PacedView

    server = live.open_server(PORT, "zenpark", dark=False)
    try:
        _tell(server.get_port(), "virtual time: begins when the page is open", open_page=True, to=sys.stderr)
        yield PacedView(server, pace=pace, dark=False).begin
    finally:
        live.close_server(server)


def _up(folder: Path, *, wait_s: float, ended: threading.Event) -> Run | None:
    """The run of a folder, if it is up, or is within `wait_s` [s]."""
    import time

    from agents.runtime import run_registry

    here, deadline = str(folder.absolute()), time.monotonic() + wait_s
    while True:
        found = next((run for run in run_registry.runs() if run.folder == here and run.alive), None)
        if found is not None or time.monotonic() >= deadline or ended.wait(POLL_S):
            return found


def _of_run(run: Run, identity: str | None) -> Watched:
    from experiments.view.acting import Watched

    return Watched(run.endpoints, run.realm, identity or _usual(run.endpoints), run)


def _replay(folder: Path, ended: threading.Event, *, port: int, dark: bool, open_page: bool) -> int:
    from experiments.recording.reader import RecordingError
    from experiments.scene import tracks
    from experiments.view import live, replay

    if folder.suffix == ".mcap":
        files = [folder]
    else:
        files = sorted(folder.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
    if not files:
        raise RecordingError(f"{folder}: holds no recording (.mcap); name the folder of a run")
    films = [replay.Film(tracks.read(file)) for file in files]
    server = live.open_server(port, "zenpark", dark=dark)
    page = replay.ReplayView(server, films, str(folder), dark=dark)
    _tell(server.get_port(), str(folder), open_page=open_page)
    try:
        page.run(ended.is_set)
    finally:
        live.close_server(server)
    return 0


def _watched(connect: list[str] | None, realm: str, lab: str | None, identity: str | None) -> Watched:
    """The run on the command line, else the newest one of this machine.

    Raises:
        ViewError: If none is up.
    """
    from agents.runtime import run_registry
    from experiments.view.acting import Watched

    if given := routers(connect, lab):
        return Watched(given, realm, identity or _usual(given))
    up = [run for run in run_registry.runs() if run.what == "run" and run.alive]
    if not up:
        raise ViewError(
            "no run is up on this machine: start one (`zenpark run robotic-park`), name its router (--connect), or "
            "the folder of a recording"
        )
    if len(up) > 1:
        print(f"zenpark: {len(up)} runs are up; this is the newest one", file=sys.stderr)
    return _of_run(up[-1], identity)


def _usual(endpoints: Sequence[str]) -> str:
    """Identity of a page: in a lab it only looks, unless --as names an operator."""
    from agents.network.lab import lab_of

    return "operator" if lab_of(endpoints) is None else "observer"


def _live(watched: Watched, ended: threading.Event, *, port: int, dark: bool, open_page: bool, with_run: bool) -> None:
    from agents.network.session import open_session
    from agents.network.shutdown import held
    from experiments.view import live
    from experiments.view.acting import Acting, may_act

    opened = open_session(watched.endpoints, name="view", wait_s=5.0, identity=watched.identity)
    with held(opened) as (session, declared):
        server = live.open_server(port, "zenpark", dark=dark)
        acting = Acting(session, watched) if may_act(watched) else None
        page = live.LiveView(server, session, watched, dark=dark, acting=acting)
        declared.append(page)
        _tell(server.get_port(), watched.words, open_page=open_page)
        try:
            page.run(lambda: ended.is_set() or (with_run and watched.run is not None and not watched.run.alive))
        finally:
            live.close_server(server)


def _tell(port: int, what: str, *, open_page: bool, to: TextIO | None = None) -> None:
    import webbrowser

    address = f"http://127.0.0.1:{port}"
    print(f"{address}  {what}", flush=True, file=to)
    if open_page:
        webbrowser.open(address)
