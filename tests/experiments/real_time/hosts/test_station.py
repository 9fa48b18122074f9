"""A host by ssh: errors with remedies, what its station answers, and that nobody of its run stays behind."""

import shlex
import signal
import time
from contextlib import contextmanager

import msgspec
import psutil
import pytest

from agents.network.endpoints import Endpoint
from agents.runtime.lifeline import BEAT_S, FAR_SILENCE_S
from experiments.real_time.hosts import ssh
from experiments.real_time.hosts.launcher import RUN
from experiments.real_time.hosts.station import Answer, Question, answer, devices
from experiments.real_time.processes import zygote
from experiments.recording import version
from tests.commands import GUARD, environment, started
from tests.waiting import until


@pytest.mark.parametrize(
    ("said", "cause", "remedy"),
    [
        ("ssh: connect to host 192.0.2.7 port 22: Connection refused", "cannot be reached", "sshd run"),
        ("ssh: connect to host lab1 port 22: Connection timed out", "cannot be reached", "Try ssh pi@lab1"),
        ("ssh: connect to host lab1 port 22: No route to host", "cannot be reached", "network"),
        ("ssh: Could not resolve hostname lab1: Name or service not known", "no machine of that name", "HostName"),
        ("No ED25519 host key is known for lab1 and you have requested strict checking.\nHost key verification failed.",
         "host key is not known", "ssh pi@lab1"),
        ("@    WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!     @\nHost key verification failed.",
         "not the one that is known", "ssh-keygen -R"),
        ("pi@lab1: Permission denied (publickey,password).", "none of our keys", "ssh-copy-id pi@lab1"),
        ("Error: remote port forwarding failed for listen port 0", "forwards no ports", "AllowTcpForwarding"),
        ("env: 'zenpark/zenpark': No such file or directory", "no zenpark at 'zenpark/zenpark'", "hosts install"),
        ("env: ‘zenpark/zenpark’: Permission denied", "may not be started", "chmod +x zenpark/zenpark"),
        ("/usr/bin/env: 'python3': No such file or directory", "no Python", "apt install python3"),
        ("Usage: zenpark [OPTIONS]\nError: No such command 'station'.", "too old", "hosts install"),
        ("Timeout, server lab1 not responding.", "connection to it broke", "still on"),
        ("something new\nthat nobody knows", "ssh failed: that nobody knows", "must ask nothing: ssh pi@lab1"),
        ("", "it said nothing", ""),
    ],
)  # fmt: skip
def test_trouble_has_a_cause_and_a_remedy(said, cause, remedy):
    told = ssh.explained("pi@lab1", "zenpark/zenpark", said)
    assert cause in told
    assert remedy in told


def test_words_arrive_as_they_are():
    words = ["env", "zenpark/zenpark", "agent", "a b", "$(reboot)", "it's"]
    command = ssh.command("pi@lab1", words, ["-R", "x"])
    assert command[-3:-1] == ["--", "pi@lab1"], "an address never is an option"
    assert shlex.split(command[-1].removeprefix("exec ")) == words
    assert {"BatchMode=yes", "-T"} < set(command)


def test_what_is_forwarded():
    assert ssh.forwarded(Endpoint.parse("tcp/127.0.0.1:7447")) == "127.0.0.1:0:127.0.0.1:7447"
    assert ssh.forwarded(Endpoint.parse("tls/[::1]:7447")) == "127.0.0.1:0:[::1]:7447"
    assert ssh.forwarded(Endpoint.parse("unixsock-stream//run/z")) == "127.0.0.1:0:/run/z"
    with pytest.raises(ValueError, match="use tcp or tls"):
        ssh.forwarded(Endpoint.parse("quic/127.0.0.1:7447"))
    said = (f"Allocated port {port} for remote forward to 127.0.0.1:7447" for port in (36225, 41000))
    assert ssh.allocated("Welcome\n" + "\r\n".join(said) + "\n") == [36225, 41000]


def test_a_far_lifeline_outlasts_a_short_cut():
    sent_again_s = [0.2 * (2**k - 1) for k in range(1, 6)]  # after a cut: TCP doubles its pauses
    in_time = [at for at in sent_again_s if at + BEAT_S < FAR_SILENCE_S]
    assert in_time[-1] == pytest.approx(3.0)
    interval, count = (int(ssh.OPTIONS[f"ServerAlive{word}"]) for word in ("Interval", "CountMax"))
    assert interval * (count + 1) > FAR_SILENCE_S, "the connection lives as long"


def test_a_digest_is_that_of_names_and_contents(tmp_path):
    said = answer(Question("hello"), 12.0)
    assert (said.zenpark, len(said.zenpark), said.clock) == (version.digest(), 64, 12.0)
    file = tmp_path / "agents" / "a.py"
    file.parent.mkdir()
    file.write_text("x = 1\n")
    first = version.digest(tmp_path)
    file.with_name("notes.txt").write_text("not code")
    version.digest.cache_clear()
    assert version.digest(tmp_path) == first
    file.rename(file.with_name("b.py"))
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
