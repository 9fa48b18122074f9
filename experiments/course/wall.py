"""Wall around a process that computes the law of a group: it reads libraries, computes, and answers.

Landlock refuses all files but libraries, and every write. A seccomp filter refuses new processes, sockets, signals to
others, changes of files that Landlock does not know, and ways by which two robots could talk without the network. Both
are parts of Linux that need no rights. Where they are missing, limits of time and memory are all that there is.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import resource
import struct
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

SYSTEM: Final = (sysconfig.get_path("platlib"), sysconfig.get_path("purelib"), sys.prefix, sys.base_prefix, "/usr",
                 "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/sys/devices/system/cpu", "/proc/self",
                 "/proc/cpuinfo", "/dev/null", "/dev/urandom")  # fmt: skip
PARTS: Final = ("agents", "experiments", "twins", "bridges", "face")  # parts of zenpark in a checkout, without its docs
CHECKOUT: Final = Path(__file__).resolve().parents[2]
# Landlock: system calls, rights by version, and what is granted
CREATE, ADD, RESTRICT = 444, 445, 446
RIGHTS: Final = (13, 14, 15, 15, 16)  # number of rights that versions 1 to 5 know; later ones have no more
READ, LIST = 1 << 2, 1 << 3
# Options of prctl
NO_NEW_PRIVILEGES, GET_SECCOMP, SET_SECCOMP, FILTER = 38, 21, 22, 2
AUDIT: Final = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}  # machines by the word that the kernel has for them
# Instructions of the filter: load a word, compare with a constant (equal, greater or equal, any bit), return
LOAD, EQUAL, FROM, BITS, RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
ALLOW, ERROR, KILL = 0x7FFF0000, 0x00050000, 0x80000000
NUMBER, MACHINE, ARGUMENT = 0, 4, 16  # places of the call, the machine and the first argument in what a filter sees
THREAD: Final = 0x10000  # flag of `clone`
# Numbers of system calls on x86_64 and aarch64; −1: there is none
CLONE, CLONE3 = (56, 220), (435, 435)
OF_ITSELF: Final = ((62, 129), (234, 131), (302, 261))  # kill, tgkill, prlimit64: the process itself alone
REFUSED: Final = (
    (57, -1), (58, -1), (59, 221), (322, 281),  # fork, vfork, execve, execveat
    (41, 198), (53, 199), (425, 425), (112, 157), (109, 154),  # socket, socketpair, io_uring_setup, setsid, setpgid
    (200, 130), (129, 138), (297, 240), (424, 424),  # tkill, rt_sigqueueinfo, rt_tgsigqueueinfo, pidfd_send_signal
    (101, 117), (310, 270), (311, 271), (438, 438),  # ptrace, process_vm_readv and _writev, pidfd_getfd
    (29, 194), (68, 186), (64, 190), (240, 180), (319, 279), (73, 32),  # shmget, msgget, semget, mq_open, memfd, flock
    (90, -1), (91, 52), (268, 53), (452, 452), (92, -1), (93, 55), (94, -1), (260, 54),  # chmod, chown
    (76, 45),  # truncate, of which Landlock knows from its version 3 on
    (132, -1), (235, -1), (261, -1), (280, 88),  # times of files
    (188, 5), (189, 6), (190, 7), (197, 14), (198, 15), (199, 16),  # attributes of files
)  # fmt: skip


def lacking() -> list[str]:
    """Protections that this system does not have; empty where the wall is whole."""
    found = []
    if _version() < 1:
        found.append("files (Landlock)")
    if platform.machine() not in AUDIT or not sys.platform.startswith("linux") or _prctl(GET_SECCOMP) < 0:
        found.append("processes and the network (seccomp)")
    return found


def wall_in(cpu_s: int, memory: int, readable: Iterable[Path]) -> None:
    """Wall in this process, for ever; raises OSError if that fails, although `lacking` finds nothing.

    Args:
        cpu_s: Its computing time [s].
        memory: Memory beside what it has [bytes].
        readable: Folders and files that it may read, beside libraries.
    """
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):  # a system without /proc
        size = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize() + memory
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        size = size if most == resource.RLIM_INFINITY else min(size, most)
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    missing = lacking()
    if len(missing) < 2:
        _done(_prctl(NO_NEW_PRIVILEGES, 1))
    if not [each for each in missing if each.startswith("files")]:
        _refuse_files(readable)
    if not [each for each in missing if each.startswith("processes")]:
        _refuse_calls()


def _refuse_files(readable: Iterable[Path]) -> None:
    rights = (1 << RIGHTS[min(_version(), len(RIGHTS)) - 1]) - 1
    rules = ctypes.create_string_buffer(struct.pack("Q", rights), 8)
    number = _done(_call(CREATE, rules, ctypes.c_size_t(8), 0))
    libraries = [Path(each) for each in {*SYSTEM, *sys.path} if each and Path(each) != CHECKOUT]
    granted = [(each, READ | LIST) for each in (*libraries, *(CHECKOUT / part for part in PARTS), *readable)]
    for place, right in [*granted, (CHECKOUT, LIST)]:
        with suppress(OSError):  # a place that is not here
            opened = os.open(place, os.O_PATH)
            allowed = right if place.is_dir() else right & READ
            rule = ctypes.create_string_buffer(struct.pack("=Qi", allowed, opened), 12)
            _done(_call(ADD, number, 1, rule, 0))
            os.close(opened)
    _done(_call(RESTRICT, number, 0))
    os.close(number)


def _refuse_calls() -> None:
    lines = b"".join(struct.pack("=HBBI", *line) for line in _filter())
    text = ctypes.create_string_buffer(lines, len(lines))
    program = ctypes.create_string_buffer(struct.pack("@HP", len(lines) // 8, ctypes.addressof(text)))
    if os.geteuid() == 0:  # rights of root that no rule above is about
        head = ctypes.create_string_buffer(struct.pack("=Ii", 0x20080522, 0))
        _done(ctypes.CDLL(None, use_errno=True).capset(head, ctypes.create_string_buffer(24)))
    _done(_prctl(SET_SECCOMP, FILTER, ctypes.addressof(program)))


def _filter() -> Iterator[tuple[int, int, int, int]]:
    """Instructions: each with the numbers of lines to leave out if its condition holds, and if not."""
    machine, itself = platform.machine(), os.getpid()
    column = [*AUDIT].index(machine)
    yield LOAD, 0, 0, MACHINE
    yield EQUAL, 1, 0, AUDIT[machine]
    yield RETURN, 0, 0, KILL
    yield LOAD, 0, 0, NUMBER
    if machine == "x86_64":  # calls of its other convention
        yield FROM, 0, 1, 0x40000000
        yield RETURN, 0, 0, ERROR | errno.EPERM
    yield EQUAL, 0, 1, CLONE3[column]  # the C library asks `clone` instead
    yield RETURN, 0, 0, ERROR | errno.ENOSYS
    yield EQUAL, 0, 4, CLONE[column]
    yield LOAD, 0, 0, ARGUMENT
    yield BITS, 0, 1, THREAD
    yield RETURN, 0, 0, ALLOW
    yield RETURN, 0, 0, ERROR | errno.EPERM
    for call in OF_ITSELF:
        no_number = 0 if call == OF_ITSELF[-1] else itself  # 0 is the own process, for `kill` its whole group
        yield EQUAL, 0, 5, call[column]
        yield LOAD, 0, 0, ARGUMENT
        yield EQUAL, 1, 0, itself
        yield EQUAL, 0, 1, no_number
        yield RETURN, 0, 0, ALLOW
        yield RETURN, 0, 0, ERROR | errno.EPERM
    for call in REFUSED:
        if call[column] >= 0:
            yield EQUAL, 0, 1, call[column]
            yield RETURN, 0, 0, ERROR | errno.EPERM
    yield RETURN, 0, 0, ALLOW


def _version() -> int:
    """Version of Landlock; less than 1 without."""
    return _call(CREATE, None, ctypes.c_size_t(0), 1) if sys.platform.startswith("linux") else -1


def _call(*words: object) -> int:
    return int(ctypes.CDLL(None, use_errno=True).syscall(*words))


def _prctl(option: int, *words: int) -> int:
    padded = [ctypes.c_ulong(each) for each in (*words, 0, 0, 0, 0)[:4]]
    return int(ctypes.CDLL(None, use_errno=True).prctl(option, *padded))


def _done(result: int) -> int:
    """A result; raises OSError for −1."""
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result
