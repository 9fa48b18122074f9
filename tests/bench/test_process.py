"""What a process has spent, as seen from outside of it."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from tests.bench.process import Meter
from tests.reliability.soak_sampler import usage_of


def test_what_another_process_spends_is_read_exactly() -> None:
    before = usage_of(os.getpid())
    begun = time.process_time()
    while time.process_time() < begun + 0.05:
        pass
    after = usage_of(os.getpid())
    assert before is not None
    assert after is not None
    assert 0.05 <= after.cpu_s - before.cpu_s <= time.process_time() - begun + 0.01
    assert after.rss_mb > 1.0


def test_a_process_that_has_ended_is_left_out() -> None:
    over = subprocess.Popen([sys.executable, "-c", "pass"])
    over.wait()
    meter = Meter()
    for _ in range(2):
        meter.measure({"CF01": os.getpid(), "CF02": over.pid})
    assert set(meter.shares()) == {"CF01"}
