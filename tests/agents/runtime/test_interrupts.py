"""How a run is asked to end."""

import signal

import pytest

from agents.runtime.command_line import interrupts


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
