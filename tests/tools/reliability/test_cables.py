import socket
import threading
from contextlib import contextmanager

import pytest

from tools.reliability.cables import Cables


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
    with socket.create_server(("127.0.0.1", 0)) as far, Cables() as cables:
        thread = threading.Thread(target=answer_everything, args=(far,), daemon=True)
        thread.start()
        near = cables.lay("CF01", f"tcp/127.0.0.1:{far.getsockname()[1]}")
        with socket.create_connection(("127.0.0.1", int(near.rpartition(":")[2])), timeout=30.0) as end:
            yield cables, end
        far.shutdown(socket.SHUT_RDWR)


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
        cables.cut("CF01")
        end.sendall(b"late")
        end.settimeout(0.3)
        with pytest.raises(TimeoutError):
            end.recv(10)
        cables.mend()
        end.settimeout(5.0)
        assert end.recv(10) == b"late"


def test_another_cable_is_not_cut():
    with laid() as (cables, end):
        cables.lay("CF02", "tcp/127.0.0.1:9")
        cables.cut("CF02")
        end.sendall(b"there")
        assert end.recv(10) == b"there"


def test_the_end_of_a_connection_passes():
    with laid() as (_, end):
        end.shutdown(socket.SHUT_WR)
        assert end.recv(10) == b""
