"""Progress is a bar in a terminal and lines elsewhere; what is soon over, or seen by nobody, shows none."""

import io

import pytest

from tools import progress as module
from tools.progress import Bar


class Terminal(io.StringIO):
    """A standard error that a person looks at."""

    def isatty(self):
        return True


class Clock:
    """Stands in for the module `time`."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(module, "time", made)
    return made


@pytest.fixture
def terminal(monkeypatch):
    """Makes one; called by the test, because pytest puts its own in place before that."""

    def make():
        made = Terminal()
        monkeypatch.setattr("sys.stderr", made)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "100")
        return made

    return make


def test_lines_without_a_terminal(capsys, clock):
    with Bar() as bar:
        bar.show("runs", 0, 4)
        clock.now += 4.9
        bar.show("runs", 1, 4)
        clock.now += 0.2
        bar.show("runs", 2, 4)
        bar.show("runs", 4, 4)
    assert capsys.readouterr().err == "runs 0 of 4\nruns 2 of 4\nruns 4 of 4\n"


def test_a_bar_in_a_terminal(terminal, clock):
    screen = terminal()
    with Bar() as bar:
        bar.show("runs", 0, 4)
        clock.now += 3.0
        bar.show("runs", 4, 4)
    assert "runs" in screen.getvalue()
    assert "4/4" in screen.getvalue()


def test_passing_bar_appears_late_and_counts_from_beginning(terminal, clock):
    screen = terminal()
    with Bar(passing=True) as bar:
        bar.show("event", 0, 60)
        clock.now += 1.9
        bar.show("event", 20, 60)
        assert screen.getvalue() == ""
        clock.now += 1.1
        bar.show("event", 40, 60)
    assert "40/60" in screen.getvalue()
    assert "0:00:03" in screen.getvalue()


def test_a_passing_bar_is_not_for_files(capsys, clock):
    with Bar(passing=True) as bar:
        bar.show("event", 0, 60)
        clock.now += 30.0
        bar.show("event", 60, 60)
    assert capsys.readouterr().err == ""
