"""The station of a host: what it answers, and that nobody of its run stays behind."""

import signal
import sys
import time
from contextlib import contextmanager

import msgspec
import psutil
import pytest

from experiments.real_time.hosts.launcher import RUN
from experiments.real_time.hosts.station import Answer, Question, answer, devices
from experiments.real_time.processes import zygote
from experiments.recording import version
from tests.commands import GUARD, environment, started
from tests.waiting import until


def test_it_says_who_it_is():
    said = answer(Question("hello"), 12.0)
    assert (said.zenpark, said.clock) == (version.digest(), 12.0)
    assert said.python == ".".join(map(str, sys.version_info[:3]))
    assert len(said.zenpark) == 64


def test_a_digest_is_that_of_names_and_contents(tmp_path):
    (tmp_path / "agents").mkdir()
    file = tmp_path / "agents" / "a.py"
    file.write_text("x = 1\n")
    first = version.digest(tmp_path)
    (tmp_path / "agents" / "notes.txt").write_text("not code")
    version.digest.cache_clear()
    assert version.digest(tmp_path) == first
    file.rename(tmp_path / "agents" / "b.py")
    version.digest.cache_clear()
    assert version.digest(tmp_path) != first


@pytest.mark.slow
def test_absent_router_is_not_reached():
    (found,) = answer(Question("reach", endpoints=["tcp/127.0.0.1:9"]), 0.0).found
    assert not found.well
    assert "no router answers" in found.text


def test_serial_ports_are_looked_at():
    (found,) = devices(["kteam:///dev/no-such-port", "twin"])
    assert (found.what, found.well) == ("/dev/no-such-port", False)
    assert "plugged in" in found.text
    assert list(devices(["twin", "world"])) == []


SERVE = "from experiments.real_time.hosts.station import serve; serve(patience_s=0.5)"


class Station:
    """A station process of a run, and a pipe to it."""

    def __init__(self, process):
        self.process = process

    def ask(self, question):
        print("\n" + msgspec.json.encode(question).decode(), file=self.process.stdin, flush=True)
        return msgspec.json.decode(self.process.stdout.readline(), type=Answer)

    def leave(self):
        self.process.stdin.close()
        return self.process.wait(30)


@contextmanager
def station(run):
    with started("-c", SERVE, env=environment(**{RUN: run}), stderr=None) as process:
        yield Station(process)


def sleeper(run):
    return started("-c", "input()", env=environment(**{RUN: run}))


@pytest.mark.system
def test_it_answers_until_its_lifeline_ends():
    with station("a") as here:
        before = time.time()
        said = here.ask(Question("clock"))
        assert before - 1e-3 <= said.clock <= time.time() + 1e-3
        print("nonsense", file=here.process.stdin)
        assert here.ask(Question("clock")).clock > said.clock
        assert here.leave() == 0


@pytest.mark.system
def test_it_sweeps_up_its_own_run_only():
    with station("run.lab1") as here, sleeper("run.lab1") as mine, sleeper("run.lab2") as other:
        found = []  # a process has its environment only after its exec
        until(lambda: found.extend(here.ask(Question("sweep")).found) or found, "it is found")
        assert [each.what for each in found] == [str(mine.pid)]
        assert mine.wait(30) == -9
        assert here.leave() == 0
        assert other.poll() is None


@pytest.mark.mechanism("station: way out on a host")
@pytest.mark.system
def test_station_awaits_landing_robots_and_kills_frozen_ones():
    with station("run.lab1") as here, sleeper("run.lab1") as frozen:
        here.ask(Question("clock"))
        frozen.send_signal(signal.SIGSTOP)
        assert here.leave() == 0
        assert frozen.wait(30) == -signal.SIGKILL


@pytest.mark.system
@pytest.mark.parametrize("number", [None, signal.SIGKILL, signal.SIGTERM])
def test_a_preloaded_station_forks_its_robots(number):
    robot_words = ("agent", "-", "KH01", "--lifeline")
    with station("run.lab3") as here:
        here.ask(Question("preload"))
        with started(*GUARD, *robot_words, env=environment(**{RUN: "run.lab3"})) as robot:
            forked = psutil.Process(int(robot.stdout.readline().rpartition(" ")[2]))
            assert forked.pid != robot.pid
            assert zygote.MODULE in forked.parent().cmdline()
            assert [word for word in forked.cmdline() if word][2:] == [zygote.ROBOT, *robot_words[1:]]
            if number is signal.SIGKILL:
                forked.kill()
            elif number is not None:
                robot.send_signal(number)
            if number is not None:
                robot.wait(30)  # before its lifeline ends
            out, errors = robot.communicate(timeout=30)
            assert robot.returncode == (2 if number is None else -number)
            assert (out, "no experiment came" in errors) == ("", number is None)
        assert here.ask(Question("sweep")).found == []
        assert here.leave() == 0
