import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from agents.network.endpoints import free_endpoint
from agents.runtime.lifeline import Lifeline

ROOT = Path(__file__).resolve().parents[3]


def test_end_of_file_is_loss(pipe):
    lost = threading.Event()
    line = Lifeline(lost, timeout_s=60.0, fd=pipe[0])
    line.start()
    os.write(pipe[1], b"..")
    os.close(pipe.pop())
    line.join(10.0)
    assert lost.is_set()
    assert line.reason == "the starter is gone"


def test_silence_is_loss(pipe):
    lost = threading.Event()
    line = Lifeline(lost, timeout_s=0.05, fd=pipe[0])
    line.start()
    line.join(10.0)
    assert lost.is_set()
    assert line.reason == "nothing from the starter for 0.05 s"


def test_a_descriptor_that_is_closed_is_loss(pipe):
    closed = pipe.pop()
    os.close(closed)
    line = Lifeline(threading.Event(), timeout_s=60.0, fd=closed)
    line.start()
    line.join(10.0)
    assert line.reason == "the lifeline broke: Bad file descriptor"


def test_nothing_is_lost_before_it_is(pipe):
    lost = threading.Event()
    line = Lifeline(lost, timeout_s=60.0, fd=pipe[0])
    line.start()
    os.write(pipe[1], b".")
    assert line.reason is None
    assert not lost.is_set()
    os.close(pipe.pop())
    line.join(10.0)


@pytest.mark.mechanism("lifeline: the router ends with its starter")
@pytest.mark.system
def test_router_ends_with_its_starter():
    endpoint = free_endpoint(preferred_port=0)
    process = subprocess.Popen(
        [sys.executable, "-m", "agents.runtime.router", "--lifeline", "--listen", endpoint],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == f"router ready on {endpoint}\n"
    _, said = process.communicate(timeout=30)
    assert process.returncode == 0
    assert said == "router: ends with its starter\n"


def test_whole_lines_pass_without_heartbeats(pipe):
    lines = []
    line = Lifeline(threading.Event(), timeout_s=60.0, fd=pipe[0], on_line=lines.append)
    line.start()
    for part in (b"\n\nclock -0.", b"2001\n", b"\n\nclock 1\nx", b"x" * 10_000):
        os.write(pipe[1], part)
    os.close(pipe.pop())
    line.join(10.0)
    assert lines == [b"clock -0.2001", b"clock 1"]
