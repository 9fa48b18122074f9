"""`zenpark view`: a run in three dimensions in the browser, live or from its recording."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.commands.options import Connect, Lab, Realm, routers

if TYPE_CHECKING:
    from experiments.view.acting import Watched

app: Final = typer.Typer()

PORT: Final = 8080


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
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after this time [s].")] = None,
) -> int:
    """Show a run in the browser, in three dimensions: a live one, or a recording."""
    try:
        import viser  # noqa: F401
    except ImportError:
        raise ViewError(
            "the view needs viser: ./zenpark view installs it; elsewhere `pip install zenpark[view]`"
        ) from None
    from agents.runtime.command_line import on_termination

    ended = threading.Event()
    with on_termination(ended.set):
        if seconds is not None:
            threading.Timer(seconds, ended.set).start()
        replayed = None if run is None else _recorded(Path(run))
        if replayed is not None:
            return _replay(replayed, ended, port=port, dark=dark, open_page=open_page)
        _live(_watched(connect, realm, lab, identity), ended, port=port, dark=dark, open_page=open_page)
    return 0


def _recorded(folder: Path) -> Path | None:
    """The folder of a run, if it is over; None if the run is still up."""
    from agents.runtime import run_registry

    here = str(folder.absolute())
    return None if any(run.folder == here and run.alive for run in run_registry.runs()) else folder


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
    newest = up[-1]
    return Watched(newest.endpoints, newest.realm, identity or _usual(newest.endpoints), newest)


def _usual(endpoints: Sequence[str]) -> str:
    """Identity of a page: in a lab it only looks, unless --as names an operator."""
    from agents.network.lab import lab_of

    return "operator" if lab_of(endpoints) is None else "observer"


def _live(watched: Watched, ended: threading.Event, *, port: int, dark: bool, open_page: bool) -> None:
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
            page.run(ended.is_set)
        finally:
            live.close_server(server)


def _tell(port: int, what: str, *, open_page: bool) -> None:
    import webbrowser

    address = f"http://127.0.0.1:{port}"
    print(f"{address}  {what}", flush=True)
    if open_page:
        webbrowser.open(address)
