"""Lets the threads that carry messages run before those that compute, without any privilege.

Linux gives every thread that wants the processor a slice of about 3 ms; since 6.12 a thread may ask for shorter ones
instead, and one that wakes up then goes before those that asked for longer (sched(7), sched_setattr(2), EEVDF). It gets
no more of the processor in all. Elsewhere nothing happens.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

SLICE_NS: Final = 100_000  # the shortest that is granted
_CALL: Final = {"x86_64": 314, "aarch64": 274}  # sched_setattr, which glibc has only since 2.41


@contextmanager
def prompt_threads() -> Iterator[None]:
    """Threads that are started inside, and by them, ask for short slices; the caller gets its own back."""
    asked = _ask(SLICE_NS)
    try:
        yield
    finally:
        if asked:
            _ask(0)


def _ask(slice_ns: int) -> bool:
    """Asks for slices of a length for the calling thread, 0 for the usual; whether that was possible."""
    number = _CALL.get(platform.machine())
    if sys.platform != "linux" or number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    # struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period
    attributes = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    return bool(ctypes.CDLL(None).syscall(number, 0, attributes, 0) == 0)
