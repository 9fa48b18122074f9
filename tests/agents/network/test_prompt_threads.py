"""Threads that carry messages ask for short slices; the thread that starts them keeps its own."""

import re
import threading
from pathlib import Path

import pytest

from agents.network.session import SLICE_NS, prompt_threads


def granted() -> int:
    """The slice of this thread [ns], as the kernel says it."""
    try:
        text = Path("/proc/thread-self/sched").read_text()
    except OSError:
        pytest.skip("this kernel does not say how long slices are")
    found = re.search(r"se\.slice\s*:\s*(\d+)", text)
    if found is None:
        pytest.skip("this kernel does not say how long slices are")
    return int(found[1])


def test_threads_that_are_started_inside_have_short_slices():
    before, inside = granted(), []
    with prompt_threads():
        if granted() != SLICE_NS:
            pytest.skip("this kernel grants no slices")
        thread = threading.Thread(target=lambda: inside.append(granted()))
        thread.start()
        thread.join()
    assert inside == [SLICE_NS]
    assert granted() == before > SLICE_NS
