"""Signals are heeded inside and only there; the arguments of the network are the same for every process."""

import os
import signal

import pytest

from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.lab import LabError
from agents.runtime.command_line import NetworkLaunch, on_termination, parse


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
    words = ["--connect", "tcp/a:1", "--connect", "tcp/b:2", "--realm", "hall", "--lifeline"]
    given = parse("twin", NetworkLaunch, words)
    assert given == NetworkLaunch(connect=["tcp/a:1", "tcp/b:2"], realm="hall", lifeline=True)
    assert given.endpoints() == ["tcp/a:1", "tcp/b:2"]
    assert NetworkLaunch().endpoints() == [DEFAULT_ENDPOINT]


def test_a_lab_wants_endpoints_that_ask_for_certificates(tmp_path):
    given = parse("twin", NetworkLaunch, ["--connect", "tcp/a:1", "--lab", str(tmp_path), "--as", "CF01"])
    assert given.identity == "CF01"
    with pytest.raises(LabError, match="asks for no certificate"):
        given.endpoints()
