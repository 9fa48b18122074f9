"""The zygote of a machine imports once what the processes of robots need, and forks one for each request.

`python -m experiments.real_time.processes.zygote SOCKET PADDING`; SOCKET is the number of a listening socket that it
inherits, standard input the lifeline. A request is a packet with the program and three file descriptors, which become
standard input, output and error of the new process. The answer is its id with a pidfd, then, in another packet, its
exit code. A forked process is held by its own lifeline; it survives the end of the zygote.

A fork copies only the thread that asks for it: the zygote has one, or refuses. Without a zygote, or if it refuses, the
launcher spawns. Linux only. This module is light to import: on other machines the ssh of each robot runs a process that
does no more than `stand_for` the robot's.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from agents.user_folder import runtime_folder

MODULE: Final = "experiments.real_time.processes.zygote"
ROBOT: Final = "experiments.real_time.processes.robot"
PRELOADED: Final = (ROBOT, "numpy.random", "twins.body", "bridges.external")
SWITCH: Final = "ZENPARK_ZYGOTE"  # variable of the environment: 0 spawns each process
ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # numpy starts others at its import
TITLE: Final = 4096  # room for the command line that tools show [bytes]
LIFELINE: Final = 0  # standard input
NAME: Final = 15  # longest name of a process, as `ps` and `top` show it [bytes]
PACKET: Final = 65536  # [bytes]
REPLY_S: Final = 10.0  # patience for an answer; the zygote imports before the first one
CODE_S: Final = 2.0  # patience for the exit code of a process that has ended
UNKNOWN: Final = 256  # exit code of a process after the end of its zygote


class NoZygote(Exception):
    """No zygote here, or one that did not answer."""


def address(run: str) -> Path:
    """Path of the socket of a zygote, by a word that only its run has; raises NoZygote without a folder for it."""
    try:
        return runtime_folder() / f"zygote-{run}"
    except OSError as error:
        raise NoZygote(str(error)) from None


def listen(path: Path) -> socket.socket:
    """The socket at which a zygote will be asked; raises NoZygote where there can be none."""
    if sys.platform != "linux" or not hasattr(os, "pidfd_open") or os.environ.get(SWITCH) == "0":
        raise NoZygote
    made = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        made.bind(str(path))
        made.listen(64)
    except OSError as error:
        made.close()
        raise NoZygote(str(error)) from None
    return made


def command(listener: socket.socket) -> list[str]:
    """Command line of a zygote, which must inherit the socket."""
    return [sys.executable, "-m", MODULE, str(listener.fileno()), "-" * TITLE]


# ---------------------------------------------------------------------- who asks


class Request(NamedTuple):
    """Module to run, as `python -m MODULE ARGUMENT...` does."""

    name: str  # name of the process, for `ps`
    module: str
    arguments: Sequence[str]
    environment: Mapping[str, str] = {}  # added to that of the zygote


class Forked:
    """A process that a zygote has forked, with as much of `subprocess.Popen` as a launcher uses."""

    stdout: BinaryIO | None = None

    def __init__(self, pid: int, pidfd: int, zygote: socket.socket, stdin: BinaryIO | None) -> None:
        self.pid, self.stdin = pid, stdin
        self.returncode: int | None = None
        self._pidfd, self._zygote = pidfd, zygote
        self._lock = threading.Lock()

    def poll(self) -> int | None:
        """Exit code, minus the number of the signal that killed it, `UNKNOWN`, or None while it runs."""
        return self._ended(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end [s]; raises subprocess.TimeoutExpired."""
        code = self._ended(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal to this process, and to no later one of the same id."""
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def _ended(self, timeout_s: float | None) -> int | None:
        if self.returncode is None and _readable(self._pidfd, timeout_s):
            with self._lock:
                if self.returncode is None:
                    self.returncode = self._exit_code()
        return self.returncode

    def _exit_code(self) -> int:
        try:
            return int(self._zygote.recv(PACKET) if _readable(self._zygote.fileno(), CODE_S) else b"")
        except (OSError, ValueError):
            return UNKNOWN
        finally:
            self._zygote.close()
            os.close(self._pidfd)


def _readable(fd: int, timeout_s: float | None) -> bool:
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(None if timeout_s is None else 1e3 * timeout_s))


def fork(path: Path, request: Request, streams: Sequence[int], stdin: BinaryIO | None = None) -> Forked:
    """Have the zygote at a socket fork a process; `stdin` is the other end of the first of its standard `streams`.

    Raises NoZygote without an answer. A process that is forked late all the same ends with its lifeline.
    """
    zygote = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        zygote.settimeout(REPLY_S)
        zygote.connect(str(path))
        socket.send_fds(zygote, [json.dumps(request).encode()], streams)
        answer, pidfds, _, _ = socket.recv_fds(zygote, PACKET, 1)
        return Forked(int(answer), pidfds[0], zygote, stdin)
    except (OSError, ValueError) as error:
        zygote.close()
        raise NoZygote(str(error)) from None


def stand_for(run: str, arguments: Sequence[str]) -> int | None:
    """Have the zygote of a run fork a robot's process with the standard streams of this one; return its exit code.

    Signals are passed on, in both directions. Returns None without a zygote.
    """
    try:
        forked = fork(address(run), Request("robot", ROBOT, arguments), (0, 1, 2))
    except NoZygote:
        return None
    show("stand-in", [MODULE])
    nothing = os.open(os.devnull, os.O_RDWR)
    for fd in (0, 1, 2):
        os.dup2(nothing, fd)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: forked.send_signal(number))
    code = forked.wait()
    if code < 0:
        with contextlib.suppress(OSError):  # the handler of SIGKILL cannot be set
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    return min(code, 255)


# ---------------------------------------------------------------------- in the zygote


class Zygote:
    """Forks, and passes the ends of its children on."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._path = Path(listener.getsockname())
        # by pidfd: id, and the socket that gets the exit code
        self._children: dict[int, tuple[int, socket.socket]] = {}
        self._poll = select.poll()

    def serve(self) -> Request | None:
        """Fork on request until the lifeline is lost; the starter of the zygote ends its processes before that.

        Returns None in the zygote, at its end; in each forked process, the request that it must run.
        """
        for fd in (self._listener.fileno(), LIFELINE):
            self._poll.register(fd, select.POLLIN)
        while True:
            for fd, _ in self._poll.poll():
                if fd in self._children:
                    self._reap(fd)
                elif fd == self._listener.fileno():
                    if (request := self._accept()) is not None:
                        return request
                elif not os.read(fd, PACKET):
                    self._path.unlink(missing_ok=True)
                    return None

    def _accept(self) -> Request | None:
        """Fork for the next one who asks; returns the request in the new process."""
        asker, _ = self._listener.accept()
        streams: list[int] = []
        try:
            asker.settimeout(CODE_S)
            text, streams, _, _ = socket.recv_fds(asker, PACKET, 3)
            request = Request(*json.loads(text))
            if (threads := len(list(Path("/proc/self/task").iterdir()))) != 1:
                raise NoZygote(f"{threads} threads")
            if (pid := os.fork()) == 0:
                self._leave(asker, streams)
                return request
        except (OSError, ValueError, TypeError, NoZygote) as error:
            print(f"zygote: nothing was forked: {error}", file=sys.stderr)
            asker.close()  # closing is the answer
            return None
        finally:
            for fd in streams:
                os.close(fd)
        pidfd = os.pidfd_open(pid)
        self._children[pidfd] = pid, asker
        self._poll.register(pidfd, select.POLLIN)
        with contextlib.suppress(OSError):  # the asker has gone
            socket.send_fds(asker, [str(pid).encode()], [pidfd])
        return None

    def _leave(self, asker: socket.socket, streams: Sequence[int]) -> None:
        """In a process that was forked: take its streams, and keep nothing of the zygote but what is imported."""
        try:
            os.setsid()
            for number, fd in enumerate(streams):
                os.dup2(fd, number)
            for each in (self._listener, asker, *(other for _, other in self._children.values())):
                each.close()
            for pidfd in self._children:
                os.close(pidfd)
        except OSError:
            os._exit(1)  # there must be no second zygote

    def _reap(self, pidfd: int) -> None:
        pid, asker = self._children.pop(pidfd)
        self._poll.unregister(pidfd)
        os.close(pidfd)
        _, status = os.waitpid(pid, 0)
        with contextlib.suppress(OSError):
            asker.send(str(os.waitstatus_to_exitcode(status)).encode())
        asker.close()


def show(name: str, words: Sequence[str]) -> None:
    """Give this process a name and a command line, as `ps` shows them, in the place of its first one."""
    Path("/proc/self/comm").write_bytes(os.fsencode(name)[-NAME:])
    stat = Path("/proc/self/stat").read_text("ascii", "replace").rpartition(")")[2].split()
    start, end = map(int, stat[45:47])  # counted from the state, which is field 3 of proc_pid_stat(5)
    line = b"".join(os.fsencode(word) + b"\0" for word in words)
    if 0 < start < end:
        ctypes.memmove(start, line[: end - start - 1].ljust(end - start, b"\0"), end - start)


def main() -> None:
    """Import, fork, and run in each process what was asked for."""
    show("zygote", [sys.executable, "-m", MODULE])
    sys.modules["_hashlib"] = None  # type: ignore[assignment]  # as in the process of a robot
    for module in PRELOADED:
        import_module(module)
    del sys.modules[ROBOT]  # it runs as the main module of the new process
    os.register_at_fork(after_in_child=import_module("numpy.random").seed)  # done by `random` as well
    gc.collect()
    gc.freeze()  # the collector would write to the pages that all share
    request = Zygote(socket.socket(fileno=int(sys.argv[1]))).serve()
    if request is not None:
        os.environ.update(request.environment)
        show(request.name, [sys.executable, "-m", request.module, *request.arguments])
        sys.argv[:] = [request.module, *request.arguments]
        runpy.run_module(request.module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
