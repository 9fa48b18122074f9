"""The one way in which tests wait for something."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

PATIENCE_S = 30.0  # nothing takes so long, on the slowest machine


def until(true: Callable[[], object], what: str = "it is true", limit_s: float = PATIENCE_S) -> None:
    """Waits until something is true."""
    deadline = time.monotonic() + limit_s
    pause = threading.Event()
    while not true():
        assert time.monotonic() < deadline, f"not in {limit_s:g} s: {what}"
        pause.wait(0.005)
