"""Words, output and interruption of a process."""

import os
import signal

import pytest

from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.lab import LabError
from agents.runtime.command_line import NetworkLaunch, Output, interrupts, on_termination, parse


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_each_signal_is_handled_while_listening(number):
    before = signal.getsignal(number)
    told = []
    with on_termination(lambda: told.append(1)):
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)
    assert told == [1, 1]
    assert signal.getsignal(number) is before


def test_what_was_before_comes_back_after_an_error():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ZeroDivisionError), on_termination(print):
        _ = 1 / 0
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_arguments_of_the_network():
    assert parse("twin", NetworkLaunch, []) == NetworkLaunch()
    words = "--connect tcp/a:1 --connect tcp/b:2 --realm hall --lifeline --as CF01"
    given = parse("twin", NetworkLaunch, words.split())
    assert given == NetworkLaunch(connect=["tcp/a:1", "tcp/b:2"], realm="hall", lifeline=True, identity="CF01")
    assert given.endpoints() == ["tcp/a:1", "tcp/b:2"]
    assert NetworkLaunch().endpoints() == [DEFAULT_ENDPOINT]
    with pytest.raises(LabError, match="asks for no certificate"):
        parse("twin", NetworkLaunch, ["--connect", "tcp/a:1", "--lab", "folder"]).endpoints()


def test_output_waits_for_no_reader(pipe):
    out = Output(pipe[1])
    print("über", 1, file=out, flush=True)
    assert os.read(pipe[0], 100).decode() == "über 1\n"
    for _ in range(100):
        print("x" * 4000, file=out)  # a pipe holds 64 kB: a print that waited would wait for ever
    assert len(os.read(pipe[0], 1 << 20)) >= 4096
    os.close(pipe.pop(0))
    print("nobody reads", file=out, flush=True)


@pytest.fixture
def hang_up():
    """Sets what becomes of SIGHUP."""
    before = signal.getsignal(signal.SIGHUP)
    yield lambda handler: signal.signal(signal.SIGHUP, handler)
    signal.signal(signal.SIGHUP, before)


def test_the_first_asks_and_the_second_insists(hang_up):
    hang_up(signal.SIG_DFL)
    with interrupts() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGHUP)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_who_was_started_by_nohup_outlives_its_terminal(hang_up):
    hang_up(signal.SIG_IGN)
    with interrupts() as interrupted:
        signal.raise_signal(signal.SIGHUP)
        assert not interrupted()
        signal.raise_signal(signal.SIGINT)
        assert interrupted()
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
