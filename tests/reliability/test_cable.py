import os
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress

import pytest

from agents.network.endpoints import free_endpoint
from tests.waiting import until


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
    near = int(free_endpoint(0).rpartition(":")[2])
    with socket.create_server(("127.0.0.1", 0)) as far:
        thread = threading.Thread(target=answer_everything, args=(far,), daemon=True)
        thread.start()
        words = [sys.executable, "-m", "tests.reliability.cable", str(near), str(far.getsockname()[1])]
        with subprocess.Popen(words, stdin=subprocess.PIPE) as cable:

            def reached():
                with suppress(ConnectionRefusedError):
                    ends.append(socket.create_connection(("127.0.0.1", near), timeout=30.0))
                return ends

            ends = []
            until(reached, "it listens")
            with ends[0] as end:
                yield cable, end
            cable.stdin.close()
            assert cable.wait(30.0) == 0, "it ends with its standard input"
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
