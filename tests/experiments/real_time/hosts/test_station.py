"""A host: errors of ssh with remedies, its station, which leaves nobody behind, and its clock, which drifts."""

import os
import shlex
import signal
import threading
import time
from contextlib import contextmanager
from unittest.mock import Mock

import msgspec
import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.clock import STEP_S, Clock, correction_line
from agents.network import messages
from agents.network.endpoints import Endpoint, free_endpoint
from agents.network.messages import HostClock
from agents.runtime.lifeline import BEAT_S, FAR_SILENCE_S, stop_in, stop_line
from experiments.definition.experiment import Host as HostTable
from experiments.real_time.conductor.orders import EmergencyStop
from experiments.real_time.hosts import hosts, run_registry, ssh
from experiments.real_time.hosts.hosts import HostError
from experiments.real_time.hosts.launcher import RUN, Launcher
from experiments.real_time.hosts.run_registry import own_entry
from experiments.real_time.hosts.station import Answer, Question, answer, devices
from experiments.real_time.processes import zygote
from experiments.recording import version
from experiments.recording.clocks import Correction
from tests.commands import GUARD, environment, started
from tests.small import changed
from tests.waiting import PATIENCE_S, until


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
        ("zenpark: preparing .venv\nzenpark: getting the packages failed:\n  No space left on device\n"
         "Is this machine online? Behind a proxy set HTTPS_PROXY", "No space left", "by hand: zenpark/zenpark -"),
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
    for endpoint, there in (
        ("tcp/127.0.0.1:7", "127.0.0.1:7"),
        ("tls/[::1]:7", "[::1]:7"),
        ("unixsock-stream//z", "/z"),
    ):
        assert ssh.forwarded(Endpoint.parse(endpoint)) == f"127.0.0.1:0:{there}"
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
    digest = version.digest.__wrapped__
    first = digest(tmp_path)
    file.with_name("notes.txt").write_text("not code")
    assert digest(tmp_path) == first
    file.rename(file.with_name("b.py"))
    assert digest(tmp_path) != first


@pytest.mark.slow
def test_absent_router_is_not_reached():
    (found,) = answer(Question("reach", endpoints=["tcp/127.0.0.1:9"]), 0.0).found
    assert not found.well
    assert "no router answers" in found.text


def test_serial_ports_are_looked_at():
    (found,) = devices(["kteam:///dev/no-such-port", "twin", "world"])
    assert (found.what, found.well) == ("/dev/no-such-port", False)


@pytest.mark.parametrize("script", ["exec sleep 60", "exec sleep 60 >&-"])
def test_silent_station_is_noted_and_its_ssh_ended(tmp_path, monkeypatch, script):
    """A station that stood still for some seconds; or whose connection has closed and lingers."""
    ssh_file = tmp_path / "ssh"
    ssh_file.write_text(f"#!/bin/sh\n{script}\n")
    ssh_file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(hosts, "ANSWER_S", 0.1)
    with Launcher(tmp_path / "logs") as launcher:
        used = hosts.Hosts(launcher, [])
        station = hosts.Station("lab2", HostTable(address="lab2"), launcher=launcher, routers=[], run="run")
        used._stations["lab2"] = station
        with pytest.raises(HostError, match="lab2: "):
            station.ask(Question("clock"), 0.1)
        (note,) = used.sweep()
        assert note.startswith("lab2: ")
        assert not station.process.alive


SERVE = "from experiments.real_time.hosts.station import serve; serve(patience_s=0.5)"


OWN = f"run{os.getpid()}"  # a run ends all processes of its name, those of other workers too


def process_of(run, code="input()", env=None, **options):
    return started("-c", code, env=environment(**{RUN: run}, **(env or {})), **options)


@contextmanager
def station(run, **options):
    """A station process of a run, of which one can `ask` a question."""

    def ask(*question):
        print("\n" + msgspec.json.encode(Question(*question)).decode(), file=process.stdin, flush=True)
        return msgspec.json.decode(process.stdout.readline(), type=Answer)

    with process_of(run, SERVE, stderr=None, **options) as process:
        yield ask, process
        process.stdin.close()
        assert process.wait(100.0) == 0


@pytest.mark.system
def test_it_sweeps_up_its_own_run_only():
    with process_of(f"{OWN}.lab1") as mine, process_of(f"{OWN}.lab2") as other:
        with station(f"{OWN}.lab1") as (ask, process):
            before = time.time()
            said = ask("clock")
            assert before - 1e-3 <= said.clock <= time.time() + 1e-3
            print("nonsense", file=process.stdin)
            assert ask("clock").clock > said.clock
            found = []  # a process has its environment only after its exec
            until(lambda: found.extend(ask("sweep").found) or found, "it is found")
            assert [each.what for each in found] == [str(mine.pid)]
            assert mine.wait(100.0) == -9
        assert other.poll() is None


@pytest.mark.system
def test_station_lists_run_for_a_stop(runtime_folder):
    endpoint = free_endpoint(preferred_port=0)  # as the host reaches it
    desk = changed(own_entry("run", "two", [endpoint], realm="hall", robots={"A": "", "B": ""}), pid=1, born="x")
    with station(f"{OWN}.lab1", env={"ZENPARK_RUNTIME_DIR": str(runtime_folder)}) as (ask, process):
        ask("clock")
        print(msgspec.json.encode(Question("register", run=desk)).decode(), file=process.stdin, flush=True)
        process.stdout.readline()
        (found,) = run_registry.runs()
        assert (found.pid, found.realm, found.endpoints) == (process.pid, "hall", [endpoint])
        stop = EmergencyStop(found.endpoints, found.realm, found.identity, found)
        stop.send("a person is there")
        line = process.stdout.readline().encode()
        assert stop_in(line.strip()) == messages.Stop("operator", "a person is there"), "the starter gets it"
        assert stop.answered
        assert stop.moving == {"A", "B"}, "no router answers"
    assert run_registry.runs() == []


def test_starter_obeys_stops_between_answers(tmp_path, monkeypatch):
    said = stop_line(messages.Stop("operator", "typed there")).decode() + '{"zenpark": "x", "clock": 1.0}\n'
    ssh_file = tmp_path / "ssh"
    ssh_file.write_text(f"#!/bin/sh\nread line\nprintf '%s' '{said}{said}'\nexec sleep 60\n")
    ssh_file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    stops = []
    with Launcher(tmp_path / "logs") as launcher:
        host = HostTable(address="lab2")
        station = hosts.Station("lab2", host, launcher=launcher, routers=[], run="run", obey=stops.append)
        assert station.ask(Question("clock"))[0].clock == 1.0
        launcher.end([station.process.name], grace_s=0.0)
    assert set(stops) == {messages.Stop("operator", "typed there")}


@pytest.mark.mechanism("station: way out on a host")
@pytest.mark.system
def test_station_awaits_landing_robots_and_kills_frozen_ones():
    with process_of(f"{OWN}.lab1") as frozen:
        with station(f"{OWN}.lab1") as (ask, _):
            ask("clock")
            frozen.send_signal(signal.SIGSTOP)
        assert frozen.wait(100.0) == -signal.SIGKILL


@pytest.mark.system
@pytest.mark.parametrize("number", [None, signal.SIGKILL, signal.SIGTERM])
def test_a_preloaded_station_forks_its_robots(number):
    robot_words = ("agent", "-", "KH01", "--lifeline")
    with station(f"{OWN}.lab3") as (ask, _):
        ask("preload")
        with started(*GUARD, *robot_words, env=environment(**{RUN: f"{OWN}.lab3"})) as robot:
            forked = psutil.Process(int(robot.stdout.readline().rpartition(" ")[2]))
            assert forked.pid != robot.pid
            assert zygote.MODULE in forked.parent().cmdline()
            assert [word for word in forked.cmdline() if word][2:] == [zygote.ROBOT, *robot_words[1:]]
            if number is signal.SIGKILL:
                forked.kill()
            elif number is not None:
                robot.send_signal(number)
            if number is not None:
                robot.wait(100.0)  # before its lifeline ends
            out, errors = robot.communicate(timeout=100)
            assert robot.returncode == (2 if number is None else -number)
            assert (out, "no experiment came" in errors) == ("", number is None)
        assert ask("sweep").found == []


DT, UNCERTAINTY_S = 0.01, 1e-4


@pytest.mark.parametrize(("ppm", "most"), [(50, 0.9e-3), (-50, 0.9e-3), (2000, 3.5e-3)])
def test_remaining_drift_stays_small_whatever_the_runs_length(ppm, most):
    """Ten minutes; without corrections up to 1.2 s would be left in stamps."""
    rng = np.random.default_rng(7)
    true = np.arange(round(600.0 / DT)) * DT
    clock, measured, left, due = Clock(-0.2), [HostClock("lab2", 0.0, 0.2, UNCERTAINTY_S, ["CF01"], 0.2)], [], 0.0
    for t, offset in zip(true, 0.2 + ppm * 1e-6 * true, strict=True):
        if t >= due + hosts.DRIFT_S:
            now = HostClock("lab2", t, offset + rng.uniform(-1, 1) * UNCERTAINTY_S, UNCERTAINTY_S, ["CF01"])
            due, applied = t, hosts.applied(now, measured[-1].applied)
            clock.follow(correction_line(-applied).strip())
            measured.append(changed(now, applied=applied))
        clock.slew(DT)
        left.append(offset + clock.correction_s)
    left = np.array(left)
    assert np.abs(left).max() < most
    assert (np.diff(true + left) > 0.9 * DT).all(), "stamps never go back"
    right = Correction(measured)
    until = true <= measured[-1].stamp
    mended = [right("CF01", float(stamp)) for stamp in (true + left)[until][::50]]
    assert np.abs(mended - true[until][::50]).max() < 2.5 * UNCERTAINTY_S, "what is left is taken off the recording"
    (lie,) = right.offsets()
    assert lie.worst == pytest.approx(np.abs(left).max(), abs=1e-3)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.1), st.floats(-1.0, 1.0))
def test_a_measurement_never_makes_it_worse(offset, uncertainty, before):
    now = hosts.applied(HostClock("lab2", 1.0, offset, uncertainty, []), before)
    for true in np.linspace(offset - uncertainty, offset + uncertainty, 5):
        assert abs(now - true) <= abs(before - true) + 1e-12


class Host:
    """A host whose clock says what it is given, then is silent; or one that only calls `asked`."""

    def __init__(self, *offsets, asked=None):
        self.name, self.clock = "lab2", HostClock("lab2", 0.0, 0.2, UNCERTAINTY_S, ["CF01"], 0.2)
        self.offsets, self.told, self.asked = list(offsets), [], asked or (lambda: None)

    def measure(self, samples):
        self.asked()
        if not self.offsets:
            raise HostError("lab2: says nothing")
        self.clock = HostClock("lab2", time.time(), self.offsets.pop(0), UNCERTAINTY_S, ["CF01"], self.clock.applied)
        return self.clock

    def correct(self, applied):
        self.told.append(applied)
        self.clock = HostClock("lab2", 0.0, self.clock.offset, UNCERTAINTY_S, self.clock.robots, applied)
        return self.clock


def followed(*there):
    """Measurements of hosts and what went wrong with them, until two things have."""
    measured, trouble = [], []

    def over():
        for every, more in zip((measured, trouble), following.news(), strict=True):
            every.extend(more)
        return len(trouble) >= 2

    with hosts.Drift(there, 0.01) as following:
        until(over, "two things went wrong")
    return measured, trouble


def test_robots_are_told_drift_and_no_jump():
    host = Host(0.21, 0.21 + 2 * STEP_S, 0.22)
    measured, (jump, silence) = followed(host)
    assert host.told == pytest.approx([0.21 - UNCERTAINTY_S, 0.22 - UNCERTAINTY_S])
    assert [each.offset for each in measured] == pytest.approx([0.21, 0.21 + 2 * STEP_S, 0.22])
    assert "its clock jumped by +1" in jump
    assert "says nothing; its clock is not corrected any more" in silence


def test_host_that_ends_meanwhile_leaves_the_others_corrected():
    other = Host(0.21, 0.22)
    followed(Host(asked=Mock(side_effect=ValueError("I/O operation on closed file"))), other)
    assert len(other.told) == 2
    with hosts.Drift([]) as following:
        assert following.news() == ([], []), "nobody abroad"


def test_end_waits_only_for_the_host_being_asked():
    asked, ending = [], threading.Event()

    def silent():
        asked.append(1)
        ending.wait(PATIENCE_S)

    with hosts.Drift([Host(asked=silent) for _ in range(3)], 0.01) as following:
        until(lambda: asked, "the first is asked")
        closing = threading.Thread(target=following.close)
        closing.start()
        threading.Event().wait(0.05)  # it has ended, and waits for the first
        ending.set()
        closing.join()
    assert len(asked) == 1
