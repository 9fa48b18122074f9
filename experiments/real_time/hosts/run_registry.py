"""Registry of the runs on this machine: one small file each, so that an emergency stop finds all of them.

The files lie in each folder that belongs to the user alone (`agents.user_folder`), so that a shell with another
environment finds them, and still does when one of them was deleted. Runs of other users are listed for root only.
"""

from __future__ import annotations

import os
import socket
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final, Literal, NamedTuple

import msgspec

from agents.clock import Clock
from agents.network import endpoints as topology
from agents.network import lab, messages
from agents.network.endpoints import UNIX, Endpoint
from agents.user_folder import readable_folders, runtime_folders

MAX_ENTRY_BYTES: Final = 1 << 20  # [bytes] largest file
KNOCK_S: Final = 0.3  # longest time of a local router to accept a connection
TELL_S: Final = 3.0  # limit for a run to answer a stop: it waits for its robots meanwhile
TURN_S: Final = 0.5  # pause of two looks whether a run has ended
SOCKET: Final = ".stop"  # suffix of the socket of a run, beside its file


class RegisteredRun(msgspec.Struct, frozen=True):
    """A run, or a router that was started by hand."""

    what: Literal["run", "router"]
    pid: int
    born: str  # start of the process, in ticks of the operating system; empty if unknown
    since: float  # [s] UTC start of the process
    title: str  # title of the experiment
    folder: str  # folder of the results, absolute
    endpoints: list[str]  # routers, or members of a mesh, each with its lab
    realm: str = "park"  # first chunk of the keys
    identity: str = "operator"  # name in the certificate that may stop it, in a lab
    robots: dict[str, str] = {}  # name and address of hardware of each robot; the address is empty for a twin
    # set by who reads its file, whatever it says: the user to whom the file belongs, and the socket beside it, if any
    user: int = -1
    socket: str = ""

    @property
    def alive(self) -> bool:
        """Whether its process runs; processes that it started may outlive it for a while."""
        return born(self.pid) == self.born and self._is_of_user()

    def _is_of_user(self) -> bool:
        """Whether the process is one of the user who wrote the file: root must not end another's for it."""
        try:
            return self.user in (-1, Path(f"/proc/{self.pid}").stat().st_uid)
        except OSError:
            return not Path("/proc/self").exists()

    @property
    def where(self) -> str:
        return topology.describe(self.endpoints)

    @property
    def words(self) -> str:
        """Title, folder and routers, for people."""
        return f"{self.title}, {self.folder}, at {self.where}" if self.folder else f"{self.title}, at {self.where}"


def born(pid: int) -> str | None:
    """Start of a process, in ticks since boot; empty if unknown, None if the process is gone."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text("ascii", "replace").rpartition(")")[2].split()
        return None if status[0] in "ZX" else status[19]
    except (OSError, IndexError):
        if Path("/proc/self/stat").exists():
            return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except (OSError, OverflowError):
        pass  # belongs to another user
    return ""


def own_entry(
    what: Literal["run", "router"],
    title: str,
    endpoints: Sequence[str],
    *,
    folder: Path | None = None,
    realm: str = "park",
    identity: str = "operator",
    robots: dict[str, str] | None = None,
) -> RegisteredRun:
    pid = os.getpid()
    place = "" if folder is None else str(folder.absolute())
    return RegisteredRun(
        what, pid, born(pid) or "", Clock().utc(), title, place, list(endpoints), realm, identity, robots or {},
        os.getuid(),
    )  # fmt: skip


class StopReport(msgspec.Struct, frozen=True):
    """Answer of a run to an emergency stop that needed no router."""

    robots: list[str]  # robots that have a running process
    stopped: list[str]  # those of them that have reported motors off


Obey = Callable[[messages.Stop], StopReport]


@contextmanager
def registered(run: RegisteredRun, obey: Obey | None = None) -> Iterator[str]:
    """Inside, a run is registered; yields the reason if that failed, else an empty text.

    Emergency stops of this machine are given to `obey`, each in a thread of its own, at a socket beside the file.
    """
    files: list[Path] = []
    why = ""
    with ExitStack() as listening:
        try:
            folders = runtime_folders()
        except OSError as error:
            folders, why = [], str(error)
        for folder in folders:
            file = folder / f"{run.pid}-{run.born or 'x'}-{time.monotonic_ns()}.json"
            draft = file.with_suffix(".draft")
            try:
                draft.write_bytes(msgspec.json.encode(run))
                if obey is not None:
                    listening.enter_context(_listening(file.with_suffix(SOCKET), obey))
                draft.replace(file)
                files.append(file)
            except OSError as error:
                why = why or str(error)
        if files:
            why = ""
        elif why:
            why = f"not listed among the runs of this machine ({why}): stop it with --connect"
        try:
            yield why
        finally:
            for file in files:
                with suppress(OSError):
                    file.unlink()


@contextmanager
def _listening(path: Path, obey: Obey) -> Iterator[None]:
    """Inside, emergency stops are taken at a socket; without one, where its path is too long, say, routers are left."""
    over = threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        try:
            listener.bind(str(path))
        except OSError as error:
            print(f"zenpark: emergency stops need a router: {path}: {error}", file=sys.stderr)
            yield
            return
        listener.listen()
        listener.settimeout(TURN_S)
        thread = threading.Thread(target=_take_stops, args=(listener, obey, over), name="stops", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            with suppress(OSError):  # wakes the thread at once, on Linux
                listener.shutdown(socket.SHUT_RDWR)
            thread.join()
            path.unlink(missing_ok=True)


def _take_stops(listener: socket.socket, obey: Obey, over: threading.Event) -> None:
    while not over.is_set():
        try:
            asker, _ = listener.accept()
        except TimeoutError:
            continue
        except OSError:
            over.wait(TURN_S)  # closed, or without a free descriptor
            continue
        threading.Thread(target=_answer, args=(asker, obey), name="a stop", daemon=True).start()


def _answer(asker: socket.socket, obey: Obey) -> None:
    with asker, suppress(OSError):  # the asker may be gone
        asker.settimeout(TELL_S)
        if text := asker.makefile("rb").readline(messages.MAX_PAYLOAD):
            asker.sendall(msgspec.json.encode(obey(messages.read_stop(text, messages.JSON))))


def tell(run: RegisteredRun, stop: messages.Stop) -> StopReport | None:
    """Give an emergency stop to the process of a run; None without an answer."""
    if not run.socket:
        return None
    with suppress(OSError, msgspec.MsgspecError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.settimeout(TELL_S)
        asking.connect(run.socket)
        asking.sendall(messages.encode(stop) + b"\n")
        return msgspec.json.decode(asking.makefile("rb").read(MAX_ENTRY_BYTES), type=StopReport)
    return None


class Listing(NamedTuple):
    """Result of a look for runs."""

    runs: list[RegisteredRun]
    folders: list[Path]  # folders that were looked at
    trouble: list[str]  # why a folder could not be looked at

    @property
    def words(self) -> str:
        """Where no run was found, for people."""
        found = [f"no run is listed in {', '.join(map(str, self.folders))}"] if self.folders else []
        return "; ".join([*found, *(f"runs may be up that are not listed: {each}" for each in self.trouble)])


def runs() -> list[RegisteredRun]:
    """All runs that are up, oldest first; and those that died while a router of theirs, or their robots, may be up."""
    return look().runs


def look() -> Listing:
    """Look for `runs` in each folder that may have some.

    Files of runs that are gone are removed; what is none of ours, or cannot be read, is left alone.
    """
    folders, trouble = readable_folders()
    files = [file for folder in folders for file in folder.glob("*.json")]
    found = {file: run for file in files if (run := _read(file)) is not None}
    dead = {file: topology.bare(run.endpoints) for file, run in found.items() if not (run.alive or _listens(run))}
    silent = _silent({endpoint for endpoints in dead.values() for endpoint in endpoints})
    for file, endpoints in dead.items():
        if silent.issuperset(endpoints):
            del found[file]
            for each in (file, file.with_suffix(SOCKET)):
                with suppress(OSError):
                    each.unlink()
    # each once, by a file that has a socket if there is one
    same = {(run.user, run.pid, run.born, run.since): run for run in sorted(found.values(), key=lambda run: run.socket)}
    return Listing(sorted(same.values(), key=lambda run: run.since), folders, list(map(str, trouble)))


def _silent(endpoints: Iterable[str]) -> set[str]:
    """Endpoints that take no connections; one without an answer in time, such as an unknown name, is left out."""
    silent: list[str] = []

    def knock(endpoint: str) -> None:
        if not _answers(endpoint):
            silent.append(endpoint)

    threads = [threading.Thread(target=knock, args=(endpoint,), daemon=True) for endpoint in endpoints]
    deadline = time.monotonic() + 2.0 * KNOCK_S
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return set(silent)


def _read(file: Path) -> RegisteredRun | None:
    """A run's file, if it is one of the user to whom the folder belongs."""
    try:
        about, user = file.lstat(), file.parent.lstat().st_uid
        if not stat.S_ISREG(about.st_mode) or about.st_uid != user or about.st_size > MAX_ENTRY_BYTES:
            return None
        run = msgspec.json.decode(file.read_bytes(), type=RegisteredRun)
        for endpoint in topology.bare(run.endpoints):
            Endpoint.parse(endpoint)
        lab.lab_of(run.endpoints)
    except (OSError, ValueError, msgspec.MsgspecError, RecursionError):
        return None
    run = msgspec.structs.replace(run, user=user, socket=_socket_of(file, user))
    return run if run.pid > 0 and run.endpoints and run.realm else None


def _listens(run: RegisteredRun) -> bool:
    """Whether a process takes stops at the socket of a run; that of another container is not seen otherwise."""
    if not run.socket:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as knocking:
        knocking.settimeout(KNOCK_S)
        try:
            knocking.connect(run.socket)
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            pass  # busy
    return True


def _socket_of(file: Path, user: int) -> str:
    """Path of the socket beside a run's file, if it is one of the same user."""
    path = file.with_suffix(SOCKET)
    with suppress(OSError):
        about = path.lstat()
        return str(path) if stat.S_ISSOCK(about.st_mode) and about.st_uid == user else ""
    return ""


def _answers(endpoint: str) -> bool:
    """Whether the endpoint takes connections; of QUIC this is unknown before the first packet."""
    where = Endpoint.parse(endpoint)
    with suppress(OSError, ValueError):  # ValueError: no such name can be asked for
        if where.protocol == UNIX:
            return stat.S_ISSOCK(Path(where.host).stat().st_mode)
        with socket.create_connection((where.host, where.port), KNOCK_S):
            return True
    return False
