"""The lifeline of a process: what counts as its loss, and the lines that it carries."""

import os
import threading

import pytest

from agents.network.endpoints import free_endpoint
from agents.runtime.lifeline import Lifeline
from tests.commands import started


@pytest.fixture
def lifeline_end(pipe):
    """Runs a lifeline while `feed` acts on the two ends of its pipe; returns it and whether it was lost."""

    def lifeline_end(feed, timeout_s=60.0, **given):
        lost, reader = threading.Event(), pipe[0]
        line = Lifeline(lost, timeout_s=timeout_s, fd=reader, **given)
        line.start()
        feed(pipe)
        line.join(10.0)
        return line.reason, lost.is_set()

    return lifeline_end


def hang_up(ends, *written):
    for part in written:
        os.write(ends[1], part)
    os.close(ends.pop())


def test_end_of_file_is_loss(lifeline_end):
    assert lifeline_end(lambda ends: hang_up(ends, b"..")) == ("the starter is gone", True)


def test_silence_is_loss(lifeline_end):
    assert lifeline_end(lambda _ends: None, timeout_s=0.05) == ("nothing from the starter for 0.05 s", True)


def test_a_descriptor_that_is_closed_is_loss(pipe):
    closed = pipe.pop()
    os.close(closed)
    line = Lifeline(threading.Event(), timeout_s=60.0, fd=closed)
    line.start()
    line.join(10.0)
    assert line.reason == "the lifeline broke: Bad file descriptor"


def test_whole_lines_pass_without_heartbeats(lifeline_end):
    lines = []
    parts = (b"\n\nclock -0.", b"2001\n", b"\n\nclock 1\nx", b"x" * 10_000)
    lifeline_end(lambda ends: hang_up(ends, *parts), on_line=lines.append)
    assert lines == [b"clock -0.2001", b"clock 1"]


@pytest.mark.mechanism("lifeline: the router ends with its starter")
@pytest.mark.system
def test_router_ends_with_its_starter():
    endpoint = free_endpoint(preferred_port=0)
    with started("-m", "agents.runtime.router", "--lifeline", "--listen", endpoint) as process:
        assert process.stdout.readline() == f"router ready on {endpoint}\n"
        _, errors = process.communicate(timeout=30)
        assert (process.returncode, errors) == (0, "router: ends with its starter\n")
