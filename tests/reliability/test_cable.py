import os
import signal
import socket
import socketserver
import threading
from contextlib import contextmanager, suppress

import pytest

from agents.network.endpoints import free_endpoint
from tests.commands import started
from tests.waiting import until


class Echo(socketserver.BaseRequestHandler):
    def handle(self):
        while data := self.request.recv(65536):
            self.request.sendall(data)


@contextmanager
def laid():
    """A cable, and an end of a connection through it, whose other end echoes."""
    near = int(free_endpoint(0).rpartition(":")[2])
    ends = []

    def reached():
        with suppress(ConnectionRefusedError):
            ends.append(socket.create_connection(("127.0.0.1", near), timeout=30.0))
        return ends

    with (
        socketserver.ThreadingTCPServer(("127.0.0.1", 0), Echo) as far,
        started("-m", "tests.reliability.cable", near, far.server_address[1]) as cable,
    ):
        threading.Thread(target=far.serve_forever, args=(0.01,), daemon=True).start()
        until(reached, "it listens")
        with ends[0] as end:
            yield cable, end
        cable.stdin.close()
        assert cable.wait(30.0) == 0, "it ends with its standard input"
        far.shutdown()


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
    with laid() as (cable, end):
        end.sendall(b"first")
        assert end.recv(10) == b"first"
        os.kill(cable.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, cable.pid, os.WSTOPPED)
        end.sendall(b"late")
        end.settimeout(0.3)
        with pytest.raises(TimeoutError):
            end.recv(10)
        os.kill(cable.pid, signal.SIGCONT)
        end.settimeout(30.0)
        assert end.recv(10) == b"late"


def test_the_end_of_a_connection_passes():
    with laid() as (_, end):
        end.shutdown(socket.SHUT_WR)
        assert end.recv(10) == b""
