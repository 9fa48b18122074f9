"""Station of a host: answers the launcher's questions over ssh, and leaves no process of the run behind.

`./zenpark station`: questions come in on standard input, a line of JSON each, answers go out on standard output.
Standard input is the lifeline as well. When it is lost, the station waits until the robots of its run are down and
gone, and kills those that are late: a frozen process obeys no other order.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Literal

import msgspec

from agents.clock import Clock, wait_until
from agents.errors import ExplainedError
from agents.network import lab, messages
from agents.network import session as network
from agents.network.shutdown import AFTER_S
from agents.plugins import registry
from agents.runtime.lifeline import FAR_SILENCE_S, stop_line
from experiments.definition.bodies import missing_library
from experiments.real_time.hosts import certificates, run_registry
from experiments.real_time.hosts.launcher import RUN, tagged
from experiments.real_time.hosts.run_registry import RegisteredRun, StopReport
from experiments.real_time.processes import zygote
from experiments.real_time.processes.zygote import NoZygote
from experiments.recording import version

POLL_S: Final = 0.1
FROZEN_S: Final = 2.0  # patience after the loss of the lifeline; a process that is frozen for longer is killed
REACH_S: Final = 3.0
USB: Final = Path("/sys/bus/usb/devices")
RADIO: Final = {"1915:7777": "Crazyradio", "0483:5740": "Crazyflie on USB"}
UDEV: Final = "add a udev rule for it and plug it in again (docs/crazyflie.md)"


class Question(msgspec.Struct, frozen=True, omit_defaults=True):
    ask: Literal["hello", "clock", "reach", "devices", "certificates", "sweep", "preload", "register"]
    endpoints: list[str] = []  # routers to reach
    bodies: list[str] = []  # robots with devices in question
    lab: str | None = None  # folder of certificates
    names: list[str] = []  # certificates that are asked for, or shown to routers
    run: RegisteredRun | None = None  # entry to be listed on this machine


class HostCheck(msgspec.Struct, frozen=True):
    """A thing that was looked for."""

    what: str
    well: bool
    text: str  # the fault, if it is not well


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    zenpark: str  # digest of its code
    clock: float  # [s] UTC of this machine when the question was read
    version: str = ""
    python: str = ""
    machine: str = ""
    seen_from: str = ""
    found: list[HostCheck] = []
    content: certificates.FolderContent = certificates.FolderContent()


def answer(question: Question, clock: float) -> Answer:
    code, found = version.digest(), list[HostCheck]()
    match question.ask:
        case "hello":
            installed = version.installed("zenpark") or "unknown"
            machine = f"{socket.gethostname()} ({platform.system()} {platform.machine()})"
            seen_from = os.environ.get("SSH_CONNECTION", "").partition(" ")[0]
            return Answer(code, clock, installed, platform.python_version(), machine, seen_from)
        case "certificates":
            return Answer(code, clock, content=certificates.read_folder(Path(question.lab or "."), question.names))
        case "reach":
            found = [_reach(endpoint, question) for endpoint in question.endpoints]
        case "devices":
            found = list(devices(question.bodies))
        case "sweep":
            found = [HostCheck(str(pid), False, "was killed") for pid in kill(_other_processes())]
    return Answer(code, clock, found=found)


def _reach(endpoint: str, question: Question) -> HostCheck:
    began = time.monotonic()
    identity = question.names[0] if question.names else None
    try:
        routers = lab.secured([endpoint], question.lab)
        with network.open_session(routers, name="zenpark hosts", wait_s=REACH_S, identity=identity):
            return HostCheck(endpoint, True, f"{(time.monotonic() - began) * 1e3:.0f} ms")
    except ExplainedError as error:
        return HostCheck(endpoint, False, str(error))


def devices(bodies: Sequence[str]) -> Iterator[HostCheck]:
    """Needs of the bodies of a host's robots: libraries, radios, serial ports, and the right to use them."""
    words = {registry.body_name(body) for body in bodies}
    for library in sorted(filter(None, {missing_library(word) for word in words})):
        yield HostCheck(library, False, "is missing: `./zenpark hardware` there adds it")
    if words & {"radio", "usb"}:
        none = "none is plugged in: plug one in there, or let its robots run on another host"
        yield from list(_radios()) or [HostCheck("Crazyradio", False, none)]
    for port in sorted({match[0] for body in bodies if (match := re.search(r"/dev/[\w./-]+", body))}):
        if not Path(port).exists():
            yield HostCheck(port, False, "is not there: is it plugged in?")
        elif not os.access(port, os.R_OK | os.W_OK):
            yield HostCheck(port, False, "may not be used: sudo usermod -aG dialout $USER, then log in again")
        else:
            yield HostCheck(port, True, "may be used")


def _radios() -> Iterator[HostCheck]:
    for device in sorted(USB.glob("*")):
        try:
            vendor, product = ((device / name).read_text().strip() for name in ("idVendor", "idProduct"))
            bus, number = (int((device / name).read_text()) for name in ("busnum", "devnum"))
        except (OSError, ValueError):
            continue
        name = RADIO.get(f"{vendor}:{product}")
        if name is not None:
            node = f"/dev/bus/usb/{bus:03}/{number:03}"
            well = os.access(node, os.W_OK)
            yield HostCheck(name, well, "may be used" if well else f"{node} may not be written: {UDEV}")


def _other_processes() -> list[int]:
    """Other processes of the same run on this machine.

    This process, its parent, the zygote and those that stand for robots are left out: these end with the robots, or
    with this one.
    """
    run, own_pids = os.environ.get(RUN), (os.getpid(), os.getppid())
    found = tagged(f"{RUN}={run}") if run else []
    return [pid for pid, words in found if pid not in own_pids and zygote.MODULE not in words]


@contextlib.contextmanager
def _preloaded() -> Iterator[None]:
    """Inside, the robots of the run that are started here are forked by a zygote, if there can be one."""
    try:
        with zygote.listen(zygote.address(os.environ.get(RUN, ""))) as listener:
            started = subprocess.Popen(
                zygote.command(listener),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, **zygote.ONE_THREAD},
                pass_fds=[listener.fileno()],
            )
    except NoZygote:
        yield
        return
    assert started.stdin is not None
    try:
        yield
    finally:
        started.stdin.close()
        try:
            started.wait(FROZEN_S)
        except subprocess.TimeoutExpired:
            started.kill()


@contextlib.contextmanager
def _listed(run: RegisteredRun, folder: str | None) -> Iterator[None]:
    """Inside, the run is listed here with its routers as this machine reaches them, for `estop` typed here.

    The stop goes on to the starter as well, which passes it on to all robots. That way needs no router, and in a lab no
    certificate of an operator.
    """

    def obey(stop: messages.Stop) -> StopReport:
        os.write(1, stop_line(stop))
        return StopReport([], [])

    endpoints = lab.secured(run.endpoints, folder)
    with run_registry.registered(
        run_registry.own_entry("run", run.title, endpoints, realm=run.realm, identity=run.identity, robots=run.robots),
        obey,
    ) as why:
        if why:
            print(f"station: {why}", file=sys.stderr)
        yield


def _frozen(pid: int) -> bool:
    """Whether a process was stopped (SIGSTOP): it will not come down by itself."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except OSError:
        return False  # gone


def kill(pids: Sequence[int]) -> list[int]:
    """Kill processes; return those that still ran."""
    killed = []
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
    return killed


def serve(fd: int = 0, patience_s: float = AFTER_S) -> int:
    """Answer until the lifeline is lost, then wait for `patience_s` [s] until the robots are down; return 0."""
    here = Clock()
    decoder = msgspec.json.Decoder(Question)
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    rest = b""
    with contextlib.suppress(OSError), contextlib.ExitStack() as until_lost:  # OSError: the other end is closed
        while poll.poll(FAR_SILENCE_S * 1e3):
            data = os.read(fd, 65536)
            clock = here.utc()
            if not data:
                break
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                if not line.strip():
                    continue  # a heartbeat
                try:
                    question = decoder.decode(line)
                except msgspec.MsgspecError as error:
                    print(f"station: not understood: {error}", file=sys.stderr)
                    continue
                if question.ask == "preload":
                    until_lost.enter_context(_preloaded())
                if question.run is not None:
                    until_lost.enter_context(_listed(question.run, question.lab))
                os.write(1, msgspec.json.encode(answer(question, clock)) + b"\n")
    soon_s = min(FROZEN_S, patience_s)
    if not wait_until(lambda: not _other_processes(), soon_s, POLL_S):  # those that are frozen do not land any more
        wait_until(lambda: all(map(_frozen, _other_processes())), patience_s - soon_s, POLL_S)
    kill(_other_processes())
    return 0
