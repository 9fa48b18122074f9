"""The simulator itself: one seed gives one history, and whatever would make two of it ends the flight."""

import os
import threading
import time

import pytest

from tests.simulated import kernel as simulated
from tests.simulated.kernel import BEGIN, EPOCH, FlightError, Kernel, Process, guard


def two_workers(seed, preempt=0.3):
    """Digest and log of two threads of a process that share a lock."""
    with Kernel(seed, preempt) as kernel:
        lock, log = simulated.Lock(), []

        def work(name):
            for _ in range(20):
                with lock:
                    log.append((kernel.now, name))
                    simulated.sleep(0.001 * kernel.rng.random())

        def main():
            threads = [simulated.Thread(target=work, args=(name,), name=name) for name in "ab"]
            for each in threads:
                each.start()
            for each in threads:
                each.join()

        process = Process("p", main)
        kernel.run()
        assert process.code == 0
        return kernel.digest, log


def test_one_seed_is_one_history():
    first = two_workers(1)
    assert first == two_workers(1)
    assert first[0] != two_workers(2)[0]
    assert len(first[1]) == 40


def test_clocks_of_a_process_are_its_own():
    with Kernel(1) as kernel:
        seen = []

        def main():
            simulated.sleep(10.0)
            seen.append((simulated.monotonic(), simulated.wall()))

        process = Process("p", main)
        process.drift, process.wall = 0.1, 2.0
        kernel.run()
    assert kernel.now == pytest.approx(BEGIN + 10.0 / 1.1, abs=0.01)
    assert seen[0] == pytest.approx((BEGIN + 10.0, BEGIN + EPOCH + 12.0), abs=0.01)


def test_a_paused_process_does_nothing_until_resumed():
    with Kernel(1) as kernel:
        times = []

        def main():
            for _ in range(3):
                simulated.sleep(1.0)
                times.append(round(kernel.now - BEGIN, 2))

        process = Process("p", main)
        kernel.after(1.5, process.pause)
        kernel.after(5.0, process.resume)
        kernel.run()
    assert times == [1.0, 5.0, 6.0]


def test_a_killed_process_runs_no_further():
    with Kernel(1) as kernel:
        turns = []

        def main():
            while True:
                simulated.sleep(1.0)
                turns.append(kernel.now)

        process = Process("p", main)
        kernel.after(2.5, process.kill)
        kernel.run()
    assert (process.code, len(turns), kernel.crashes) == (-9, 2, [])


def test_an_exception_is_noted_with_its_thread():
    with Kernel(1) as kernel:
        process = Process("p", lambda: 1 / 0)
        kernel.run()
    assert process.code == 1
    assert [(who, thread) for _, who, thread, _ in kernel.crashes] == [("p", "main")]


def spin():
    while simulated.monotonic() < BEGIN + 1.0:
        pass


def test_guard_concerns_simulated_threads_alone():
    """A real thread that another test has left behind, for instance."""
    go, answers = threading.Event(), []

    def ask():
        go.wait()
        answers.append(time.monotonic())

    def main():
        go.set()
        other.join()

    other = threading.Thread(target=ask)
    other.start()
    with guard(), Kernel(1) as kernel:
        process = Process("p", main)
        kernel.run()
    assert (process.code, kernel.crashes, len(answers)) == (0, [], 1)


@pytest.mark.parametrize(
    "leak", [spin, lambda: time.time() + 1.0, lambda: os.urandom(1), lambda: threading.Event().wait(0.01)]
)
def test_what_would_make_two_histories_ends_the_flight(leak):
    def main():
        try:
            leak()
        except Exception:  # noqa: BLE001 - product code catches much
            simulated.sleep(1.0)

    with guard(), Kernel(1) as kernel:
        Process("spinner", main)
        if leak is spin:
            with pytest.raises(FlightError, match="spinner/main spins"):
                kernel.run()
        else:
            with pytest.raises(FlightError, match="spinner/main asks the real world"):
                kernel.run()
