"""Processes of this machine that share work: one for each core, which end with the process that began them."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Final

ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
KILLED: Final = "was killed, perhaps for want of memory"  # what happened to a process of a `BrokenProcessPool`


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def pool(count: int) -> Iterator[ProcessPoolExecutor | None]:
    """Pool of `count` processes; the end of the block ends them, and their work.

    A process with a single thread forks them here, with all that it has imported and compiled. A fork would take the
    locks of other threads along: then they are spawned as the work comes in. None for a single process, and with a note
    where the system has no semaphores: the work is then done in this one.
    """
    others = frozenset(multiprocessing.active_children())
    alone = sys.platform == "linux" and len([*Path("/proc/self/task").iterdir()]) == 1
    context = multiprocessing.get_context("fork" if alone else "spawn")
    try:
        made = ProcessPoolExecutor(count, context, initializer=_prepare) if count > 1 else None
    except (OSError, ImportError, NotImplementedError) as error:  # a container without /dev/shm, or with a full one
        text = (
            f"no processes can share work here ({error}; is there a /dev/shm?): all is done in one, which takes longer"
        )
        print(f"zenpark: {text}", file=sys.stderr)
        made = None
    if made is None:
        yield None
        return
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # set for the processes
    try:
        if alone:
            made.submit(int)  # forks all, before a thread of a progress bar begins
        yield made
    finally:
        for name in ONE_THREAD:
            os.environ.pop(name)
        os.environ.update(before)
        for child in multiprocessing.active_children():
            if child not in others:
                child.terminate()
        # once, and waiting: a thread of the pool that still runs when the interpreter ends may print a traceback
        made.shutdown(cancel_futures=True)


def _prepare() -> None:
    """In each process: Ctrl-C is the parent's, and the process ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    gc.freeze()  # what the parent has made is no garbage, and its pages stay shared
    if "numpy.random" in sys.modules:
        sys.modules["numpy.random"].seed()  # a fork has the parent's state; `random` sees to that itself
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
