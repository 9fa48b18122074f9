"""Sweeps in several processes: interrupted, killed, continued, and on a cluster of which half dies; always the same."""

import json
import signal
import socket
import subprocess
from contextlib import ExitStack

import psutil
import pytest

from tests.commands import GUARD, environment, started
from tests.system.lab import options, until

pytestmark = pytest.mark.system

GIVEN = ["trigger.threshold=0.002:0.05:log4", "seeds=5"]
SETTINGS = ["duration_s=2.0"]
RUNS = 5 * 5


def begun_sweep(folder, *more, given=GIVEN):
    words = options("sweep", "triangle", "--out", folder, "--no-report", *SETTINGS, *more)
    return started(*GUARD, *words, *given, env=environment(OMP_NUM_THREADS="1"), stdin=subprocess.DEVNULL)


def finished(folder, *more, **given):
    with begun_sweep(folder, *more, **given) as process:
        _, said = process.communicate()
        assert process.returncode == 0, said


def seeds_done(folder):
    """Every run that is kept, as cell and seed; a line that is being written does not count."""
    path = folder / "runs.jsonl"
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    records = [json.loads(line) for line in lines if line.endswith(b"\n")]
    return [(record["cell"], run["seed"]) for record in records for run in record["runs"]]


def tables(folder):
    return [(folder / f"sweep.{kind}").read_bytes() for kind in ("csv", "json")]


@pytest.fixture(scope="module")
def whole_table(tmp_path_factory):
    """The table of the same sweep in one process."""
    folder = tmp_path_factory.mktemp("whole")
    finished(folder, "--processes", "1")
    return tables(folder)


def test_seeds_of_one_experiment_are_split_over_processes(tmp_path):
    """The runs, by seed, are the same to the last bit however many processes share them."""
    found = []
    for count in ("1", "2", "3"):
        folder = tmp_path / count
        finished(folder, "--processes", count, "--case", "event", given=["seeds=9"])
        records = [json.loads(line) for line in (folder / "runs.jsonl").read_text().splitlines()]
        assert len(records) > int(count)
        found.append((tables(folder), sorted(json.dumps(run) for record in records for run in record["runs"])))
    assert found[0] == found[1] == found[2]


def interrupted(folder, end):
    """Exit code and errors of a sweep that is ended after its first cell by `end`, which gets it and its children."""
    with begun_sweep(folder, "--processes", "2") as process:
        until(lambda: seeds_done(folder), "a cell is done")
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        end(process, children)
        _, said = process.communicate()
        assert "Traceback" not in said
        assert not psutil.wait_procs(children, timeout=60.0)[1]
        return process.returncode, said


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        pytest.param(signal.SIGKILL, -signal.SIGKILL, "", marks=pytest.mark.mechanism("sweep: killed")),
        (signal.SIGINT, 130, "the same command goes on from here"),
        (signal.SIGTERM, 130, "the same command goes on from here"),
    ],
)
def test_ended_sweep_leaves_no_process_and_resumes(tmp_path, whole_table, number, code, words):
    ended, said = interrupted(tmp_path, lambda process, _: process.send_signal(number))
    assert ended == code
    assert words in said
    before = seeds_done(tmp_path)
    assert 0 < len(before) < RUNS
    finished(tmp_path, "--processes", "2")
    done = seeds_done(tmp_path)
    assert len(done) == len(set(done)) == RUNS
    assert done[: len(before)] == before
    assert tables(tmp_path) == whole_table


def test_a_process_that_is_killed_is_explained(tmp_path):
    code, said = interrupted(
        tmp_path, lambda _, children: max(children, key=lambda child: child.memory_info().rss).kill()
    )
    assert code == 2
    assert "a process of the sweep was killed" in said


def test_cluster_with_a_killed_worker_gives_same_table(tmp_path, whole_table):
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    scheduler = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    worker = ["-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny"]
    worker += ["--no-dashboard", "--local-directory"]
    folder = tmp_path / "sweep"
    with ExitStack() as stack:
        stack.enter_context(started(*scheduler, **quiet))
        one, two = (stack.enter_context(started(*worker, str(tmp_path / name), **quiet)) for name in ("one", "two"))
        process = stack.enter_context(begun_sweep(folder, "--scheduler", address))
        until(lambda: seeds_done(folder), "a cell is done")
        (one if process.pid % 2 else two).kill()
        assert len(seeds_done(folder)) < RUNS
        _, said = process.communicate()
        assert process.returncode == 0, said
    done = seeds_done(folder)
    assert len(done) == len(set(done)) == RUNS
    assert tables(folder) == whole_table
