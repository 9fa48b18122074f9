"""Words, output and interruption of a process, and its lifeline."""

import os
import pty
import signal
import threading
from pathlib import Path

import pytest

from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT, free_endpoint
from agents.network.lab import LabError
from agents.network.messages import MAX_WORDS, UNKNOWN, Stop
from agents.runtime.command_line import NetworkLaunch, Output, interrupts, on_termination, parse
from agents.runtime.lifeline import LONGEST, Lifeline, LifelineEnd, stop_in, stop_line
from tests.commands import started
from tests.waiting import PATIENCE_S


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_each_signal_is_handled_while_listening(number):
    before = signal.getsignal(number)
    told = []

    def end_twice():
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), on_termination(lambda: told.append(1)):
        end_twice()
    assert told == [1, 1]
    assert signal.getsignal(number) is before


def test_the_arguments_of_the_network():
    assert parse("twin", NetworkLaunch, []) == NetworkLaunch()
    words = "--connect tcp/a:1 --connect tcp/b:2 --realm hall --lifeline --as CF01"
    given = parse("twin", NetworkLaunch, words.split())
    assert given == NetworkLaunch(connect=["tcp/a:1", "tcp/b:2"], realm="hall", lifeline=True, identity="CF01")
    assert given.endpoints() == ["tcp/a:1", "tcp/b:2"]
    assert NetworkLaunch().endpoints() == [DEFAULT_ENDPOINT]
    with pytest.raises(LabError, match="asks for no certificate"):
        parse("twin", NetworkLaunch, ["--connect", "tcp/a:1", "--lab", "folder"]).endpoints()


@pytest.fixture
def pipe():
    ends = list(os.pipe())
    yield ends
    for end in ends:
        os.close(end)


def test_output_waits_for_no_reader(pipe):
    out = Output(pipe[1])
    print("über", 1, file=out, flush=True)
    assert os.read(pipe[0], 100).decode() == "über 1\n"
    for _ in range(100):
        print("x" * 4000, file=out)  # a pipe holds 64 kB: a print that waited would wait for ever
    assert len(os.read(pipe[0], 1 << 20)) >= 4096
    os.close(pipe.pop(0))
    print("nobody reads", file=out, flush=True)


def test_terminal_and_full_disk_end_no_print():
    ends = pty.openpty()
    with Path("/dev/full").open("w") as full:
        for fd in (ends[1], full.fileno()):
            out = Output(fd)
            for _ in range(100):
                print("x" * 4000, file=out, flush=True)  # nobody reads the terminal
    assert os.get_blocking(ends[1]), "as the shell has it"
    for end in ends:
        os.close(end)


@pytest.fixture(params=[signal.SIG_DFL, signal.SIG_IGN], ids=["terminal", "nohup"])
def hang_up(request):
    before = signal.signal(signal.SIGHUP, request.param)
    yield request.param
    signal.signal(signal.SIGHUP, before)


def test_the_first_asks_and_the_second_insists(hang_up):
    with interrupts() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGHUP)
        assert interrupted() == (hang_up == signal.SIG_DFL), "who was started by nohup outlives its terminal"
        if hang_up == signal.SIG_IGN:
            signal.raise_signal(signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGHUP) == hang_up


@pytest.fixture
def lifeline_end(pipe):
    """Runs a lifeline after `parts` were written to it, and its far end was closed; returns why it was lost."""

    def lifeline_end(*parts, fd=pipe[0], timeout_s=60.0, **given):
        lost = threading.Event()
        line = Lifeline(lost, timeout_s=timeout_s, line=LifelineEnd(fd), **given)
        line.start()
        if parts:
            line.join(0.05)  # it waits for what comes later
        for part in parts:
            os.write(pipe[1], part)
        if parts:
            os.close(pipe.pop())
        line.join(60.0)
        assert lost.is_set()
        return line.reason

    return lifeline_end


def test_each_end_of_the_lifeline_is_loss(lifeline_end, pipe):
    assert lifeline_end(timeout_s=0.05) == "nothing from the starter for 0.05 s"
    closed = os.dup(pipe[0])
    os.close(closed)
    assert lifeline_end(fd=closed) == "the lifeline broke: Bad file descriptor"
    assert lifeline_end(b"..") == "the starter is gone"


def test_whole_lines_pass_without_heartbeats(lifeline_end):
    lines = []
    lifeline_end(b"\n\nclock -0.", b"2001\n", b"\n\nclock 1\nx", b"x" * 10_000, on_line=lines.append)
    assert lines == [b"clock -0.2001", b"clock 1"]


def test_lifeline_outlives_a_line_that_fails(lifeline_end, capsys):
    lines = []

    def fails(line):
        lines.append(line)
        raise OSError("no radio")

    assert lifeline_end(b"a\nb\n", on_line=fails) == "the starter is gone"
    assert lines == [b"a", b"b"]
    assert "lifeline: OSError: no radio" in capsys.readouterr().err


def test_stop_passes_the_lifeline_as_a_line():
    stop = Stop("a\nb", "x" * 10_000)
    line = stop_line(stop)
    assert (line.count(b"\n"), line[-1:]) == (1, b"\n")
    assert len(line) < LONGEST
    assert stop_in(line[:-1]) == Stop("a b", "x" * MAX_WORDS)
    assert stop_in(b"stop {") == Stop(UNKNOWN, "{"), "a stop, whatever follows"
    assert stop_in(b"clock 1") is None


@pytest.mark.system
def test_full_disk_of_a_log_ends_no_router():
    endpoint = free_endpoint(preferred_port=0)
    words = ("-m", "agents.runtime.router", "--lifeline", "--listen", endpoint)
    with Path("/dev/full").open("w") as full, started(*words, stdout=full, stderr=full) as process:
        with network.open_session([endpoint], name="test", wait_s=PATIENCE_S):
            assert process.poll() is None
        process.stdin.close()
        assert process.wait(PATIENCE_S) == 0


@pytest.mark.mechanism("lifeline: the router ends with its starter")
@pytest.mark.system
def test_router_ends_with_its_starter():
    endpoint = free_endpoint(preferred_port=0)
    with started("-m", "agents.runtime.router", "--lifeline", "--listen", endpoint) as process:
        assert process.stdout.readline() == f"router ready on {endpoint}\n"
        _, errors = process.communicate(timeout=100)
        assert (process.returncode, errors) == (0, "router: ends with its starter\n")
