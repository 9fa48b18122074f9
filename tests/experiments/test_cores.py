"""Processes that share the work of sweeps and seeds."""

import os
import subprocess
import sys

from experiments.cores import ONE_THREAD

DRAWS = """
import time
import numpy
from experiments.cores import pool

def draw(_):
    time.sleep(0.05)
    return numpy.random.random()

numpy.random.random()
with pool(2) as made:
    print(made._mp_context.get_start_method(), len({*made.map(draw, range(20))}))
"""


def test_forked_processes_draw_different_numbers() -> None:
    alone = os.environ | dict.fromkeys(ONE_THREAD, "1")  # numpy begins no threads
    done = subprocess.run([sys.executable, "-c", DRAWS], capture_output=True, text=True, check=True, env=alone)
    assert done.stdout.split() == ["fork", "20"]
