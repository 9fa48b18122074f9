"""What a terminal shows: text that cannot steer it, progress, the consent before files of others touch machines."""

import contextlib
import io
import os
import sys
import time
import webbrowser
from pathlib import Path
from types import SimpleNamespace

import pytest

from agents.network import messages
from experiments.file.document import load, loads
from experiments.file.problems import DocumentError
from experiments.real_time.conductor.run_view import Progress, RobotView
from tools import consent
from tools.options import open_in_browser, print_result, warn
from tools.progress import Bar, Lines, ProgressTable
from tools.terminal import lasting_console, printable, say

ESCAPES = "\x1b]0;owned\x07\x1b[2J\r\x9b2J\u202e"


def test_no_escape_reaches_the_terminal(capsys):
    say(f"a{ESCAPES}\nb")
    say(f"a{ESCAPES}\nb", to=sys.stderr)
    warn([f"a{ESCAPES}\nb"])
    print_result({}, f"a{ESCAPES}\nb", as_json=False)
    printed = "".join(capsys.readouterr())
    assert not {"\x1b", "\x07", "\x9b", "\r", "\u202e"} & set(printed)
    assert printed.count("\n") == 8
    assert printable("Böhm 1 234 → δ [m²]\u202f–") == "Böhm 1 234 → δ [m²]\u202f–"


def test_page_is_named_where_no_browser_opens_it(monkeypatch, capsys):
    for opened in (True, False):
        monkeypatch.setattr(webbrowser, "open", lambda address, opened=opened: opened)
        open_in_browser("file:///report.html")
        assert ("open file:///report.html by hand" in capsys.readouterr().err) is not opened


@pytest.fixture
def clock(monkeypatch):
    """Stands in for the module `time`: `now` [s]."""
    made = SimpleNamespace(now=100.0, monotonic=lambda: made.now)
    monkeypatch.setattr("tools.progress.time", made)
    return made


def test_lines_without_a_terminal(capsys, clock):
    with Bar(passing=True) as bar:
        bar.show("event", 0, 60)
        clock.now += 30.0
        bar.show("event", 60, 60)
    with Bar() as bar:
        bar.show("runs", 0, 4)
        clock.now += 4.9
        bar.show("runs", 1, 4)
        clock.now += 0.2
        bar.show("runs", 2, 4)
        bar.show("runs", 4, 4)
    assert capsys.readouterr().err == "runs 0 of 4\nruns 2 of 4\nruns 4 of 4\n"


def test_passing_bar_appears_late_and_counts_from_beginning(monkeypatch, clock):
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    with Bar() as bar:
        bar.show("runs", 0, 4)
        bar.show("runs", 4, 4)
    assert "runs" in screen.getvalue()
    assert "4/4" in screen.getvalue()
    screen.truncate(0)
    with Bar(passing=True) as bar:
        bar.show("event", 0, 60)
        clock.now += 1.9
        bar.show("event", 20, 60)
        assert screen.getvalue() == ""
        clock.now += 1.1
        bar.show("event", 40, 60)
    assert "40/60" in screen.getvalue()
    assert "0:00:03" in screen.getvalue()


@pytest.mark.parametrize("kind", [Lines, ProgressTable])
def test_console_that_goes_away_ends_nothing(kind, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w", buffering=1) as gone, monkeypatch.context() as patched:
        for name in ("stdout", "stderr"):
            patched.setattr(sys, name, gone)
        with pytest.raises(BrokenPipeError):
            print("x", flush=True)
        progress = Progress("event", "formation", 4.0, 15.0, {"KH01": RobotView(error=0.123)})
        progress.events.append(messages.Event(progress.clock.utc(), "output", "lab1/CF01", "airborne"))
        with lasting_console(), kind() as show:
            show(progress)
            warn(["one"])
            print_result({}, "two", as_json=False)
        assert sys.stderr is gone
        print("at the end", flush=True)  # of the process, which must not change the exit code


def test_console_that_stands_still_stops_no_run(monkeypatch):
    """As `less` that nobody scrolls, or a stopped terminal: Ctrl-C would not land the robots."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write, b"x" * 4096)
    os.set_blocking(write, True)
    with os.fdopen(read, "rb"), os.fdopen(write, "w", buffering=1) as full, monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", full)
        with lasting_console():
            say("dropped", to=sys.stderr)  # without that it waits for ever


@pytest.mark.parametrize("kind", [Lines, ProgressTable])
def test_errors_from_before_routers_silence_are_no_news(kind, capsys):
    progress = Progress("event", "formation", 4.0, 15.0, {"KH01": RobotView(error=0.123)})
    with kind() as show:
        show(progress)
    assert "0.123" in capsys.readouterr().err or kind is ProgressTable
    progress.silent_since = time.monotonic() - 2.0
    with kind() as show:
        show(progress)
    said = capsys.readouterr().err
    assert "no router answers for 2.0 s" in said
    assert "error [m]" not in said


def test_hazard_is_printed_with_its_beginning(capsys):
    progress = Progress("event", "formation", 9.0, 15.0, {})
    stamp = progress.clock.utc()
    progress.start = stamp - 9.0
    progress.events += [
        messages.Event(stamp - 0.5, "hazard", "Q1", "hold: its own position is lost"),
        messages.Event(stamp, "phase", "conductor", "formation"),
    ]
    with Lines() as show:
        show(progress)
    hazard, phase, *_ = capsys.readouterr().err.splitlines()
    assert hazard == "event: hazard Q1: hold: its own position is lost (at 8.5 s)"
    assert phase == "event: phase conductor: formation"


def test_orders_to_several_robots_are_one_line(capsys):
    progress = Progress("event", "formation", 9.0, 15.0, {})
    progress.start, names = progress.clock.utc() - 9.0, ("A", "B", "C")
    for kind, text in (("hazard", "hold: ordered to hold: by an operator"), ("robot", "landing: ordered to land")):
        progress.events += [messages.Event(progress.clock.utc() - 0.55, kind, name, text) for name in names]
    for text in ("done: finished", "running: ordered to hold", "done: ordered to land"):
        progress.events.append(messages.Event(progress.clock.utc(), "robot", "A", text))
    with Lines() as show:
        show(progress)
    hold, land, _ = capsys.readouterr().err.splitlines()
    assert hold.startswith("event: hazard A, B, C: hold: ordered to hold: by an operator (at 8.")
    assert land == "event: robot A, B, C: landing: ordered to land"
    progress.phase = "landing"
    with Lines() as show:
        show(progress)
    assert "ordered to land" not in capsys.readouterr().err


REACHING = """
title = "two"
duration_s = 5.0
positioning = "vicon://192.0.2.9:801"
[robots]
A = { kind = "crazyflie", start = [-0.4, 0.0], hover = 0.5, body = "radio://0/80/2M/E7E7E7E701" }
B = { kind = "khepera4", start = [0.4, 0.0] }
[formation.links]
"A - B" = 0.8
[hosts.pi]
address = "pi@192.0.2.7"
robots = ["B"]
"""


def asking(monkeypatch, answer):
    """A terminal in which the user answers; None: no terminal."""
    stdin = SimpleNamespace(isatty=lambda: answer is not None, readline=lambda: f"{answer}\n")
    monkeypatch.setattr("sys.stdin", stdin)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)


def test_others_files_run_when_agreed(monkeypatch):
    cases = loads(REACHING).cases()
    device, machine, cameras = consent.touched(cases.values())
    assert "A: radio://0/80/2M/E7E7E7E701" in device
    assert "ssh pi@192.0.2.7" in machine
    assert cameras == "motion capture: vicon://192.0.2.9:801"
    for answer in ("y", "YES"):
        asking(monkeypatch, answer)
        consent.require("a.zip", cases, given=False)
    for answer in ("n", "", None):
        asking(monkeypatch, answer)
        consent.require("a.zip", load("robotic-park").cases(), given=False)  # it is simulated
        consent.require("a.zip", cases, given=True)
        with pytest.raises(DocumentError, match="--yes" if answer is None else "--here"):
            consent.require("a.zip", cases, given=False)


def test_own_files_are_no_strangers(tmp_path, monkeypatch):
    file = tmp_path / "own.toml"
    file.touch()
    assert not consent.belongs_to_another(file)
    assert not consent.belongs_to_another(tmp_path / "missing.toml")
    owner = SimpleNamespace(st_uid=os.geteuid() + 4321)
    monkeypatch.setattr(Path, "stat", lambda self, **_: owner if self == file else SimpleNamespace(st_uid=0))
    monkeypatch.setattr(Path, "exists", lambda *_: True)
    monkeypatch.delenv("SUDO_UID", raising=False)
    assert consent.belongs_to_another(file)
    monkeypatch.setenv("SUDO_UID", str(owner.st_uid))
    assert not consent.belongs_to_another(file)
