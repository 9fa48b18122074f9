import socket
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from tools.reliability.cables import GOOD, Cables, Condition


def answer_everything(listener):
    while True:
        try:
            end, _ = listener.accept()
        except OSError:
            return
        threading.Thread(target=echo, args=(end,), daemon=True).start()


def echo(end):
    with end:
        while data := end.recv(65536):
            end.sendall(data)


@contextmanager
def laid():
    with socket.create_server(("127.0.0.1", 0)) as far, Cables(np.random.default_rng(1)) as cables:
        thread = threading.Thread(target=answer_everything, args=(far,), daemon=True)
        thread.start()
        near = cables.lay("CF01", f"tcp/127.0.0.1:{far.getsockname()[1]}")
        with socket.create_connection(("127.0.0.1", int(near.rpartition(":")[2])), timeout=30.0) as end:
            yield cables, end
        far.shutdown(socket.SHUT_RDWR)


def asked(end, data):
    """How long an answer takes [s]."""
    began = time.monotonic()
    end.sendall(data)
    got = b""
    while len(got) < len(data):
        got += end.recv(65536)
    return time.monotonic() - began, got


def test_everything_passes():
    with laid() as (_, end):
        data = bytes(range(256)) * 4096
        sender = threading.Thread(target=end.sendall, args=(data,))
        sender.start()
        got = b""
        while len(got) < len(data):
            got += end.recv(65536)
        sender.join()
        assert got == data


def test_a_cut_holds_everything_back_and_loses_nothing():
    with laid() as (cables, end):
        cables.set(Condition(cut=True), "CF01")
        end.sendall(b"late")
        end.settimeout(0.3)
        with pytest.raises(TimeoutError):
            end.recv(10)
        cables.set(GOOD)
        end.settimeout(5.0)
        assert end.recv(10) == b"late"


def test_another_cable_is_not_cut():
    with laid() as (cables, end):
        cables.set(Condition(cut=True), "CF02")
        assert asked(end, b"there")[1] == b"there"


def test_delay_counts_both_ways():
    with laid() as (cables, end):
        cables.set(Condition(delay_s=0.1))
        assert 0.2 <= asked(end, b"slow")[0] < 2.0


def test_what_is_lost_is_sent_again_after_a_timeout():
    with laid() as (cables, end):
        cables.set(Condition(loss=0.3))
        times = [asked(end, b"again")[0] for _ in range(8)]
        assert max(times) >= 0.2
        assert all(asked(end, b"again")[1] == b"again" for _ in range(2))


def test_bits_are_flipped():
    with laid() as (cables, end):
        cables.set(Condition(flips=1.0))
        _, got = asked(end, bytes(64))
        wrong = sum(byte.bit_count() for byte in got)
        assert 1 <= wrong <= 2, "one each way, unless the second takes the first back"


def test_the_end_of_a_connection_passes():
    with laid() as (_, end):
        end.shutdown(socket.SHUT_WR)
        assert end.recv(10) == b""
