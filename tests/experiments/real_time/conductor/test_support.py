"""Who serves a whole run is started again, where others look for it, and not for ever."""

import math
import socket
import time
from contextlib import ExitStack, nullcontext
from types import SimpleNamespace

import pytest

from agents.network.endpoints import Endpoint, free_endpoint
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.real_time.conductor import conduct
from experiments.real_time.conductor.case_context import CaseContext
from experiments.real_time.conductor.conduct import PORT_CHOICES, RunOptions, Supervision, run_setup, with_bodies
from experiments.real_time.conductor.support import STARTS, RouterEnded, SupportProcesses
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import ROUTER, Launcher


class Starts:
    """Stands for a launcher, and keeps what it was to start."""

    def __init__(self) -> None:
        self.told: list[tuple[str, ...]] = []

    def start(self, *words: str) -> None:
        self.told.append(words)


def test_dead_router_listens_again_where_machines_expect_it(tmp_path):
    launcher = Starts()
    here, everywhere = "tcp/127.0.0.1:7447", "tcp/0.0.0.0:7447"
    experiment = document.read("triangle").experiment
    hosts = Hosts(launcher, [everywhere])
    servants = SupportProcesses(
        CaseContext(Plan(experiment), "only", tmp_path, tmp_path / "case.toml", [here], launcher, hosts)
    )
    dead = SimpleNamespace(name=ROUTER, exit="killed by SIGKILL")
    said = [servants.again(dead) for _ in range(STARTS)]
    assert [words[:2] for words in launcher.told] == [(ROUTER, "agents.runtime.router")] * (STARTS - 1)
    assert all(words[2:4] == ("--listen", everywhere) for words in launcher.told)
    assert said[0] == (ROUTER, "the router ended (killed by SIGKILL); started again")
    assert said[-1] == (ROUTER, "the router ended (killed by SIGKILL); given up: the robots hold, and land at the end")
    assert servants.again(SimpleNamespace(name="only-KH01", exit="exit code 2")) is None


@pytest.mark.system
def test_router_with_port_taken_meanwhile_listens_elsewhere(tmp_path, monkeypatch):
    taken = free_endpoint(preferred_port=0)
    with socket.create_server(("127.0.0.1", Endpoint.parse(taken).port)):
        free = [[taken], [taken], [free_endpoint(preferred_port=0)]]
        chosen = iter(free)
        monkeypatch.setattr(conduct, "free_endpoints", lambda *_, **__: next(chosen))
        read, user = document.read("triangle"), Supervision(nullcontext(), lambda: False)
        with run_setup(read, with_bodies(read, RunOptions()), tmp_path, RunOptions(), user) as stage:
            assert stage.context("event").endpoints == free[-1]
            (run,) = [run for run in run_registry.runs() if run.folder == str(tmp_path)]
            assert run.endpoints == free[-1]
        chosen = iter([[taken]] * PORT_CHOICES)
        with pytest.raises(RouterEnded, match="already in use"), ExitStack() as up:
            up.enter_context(run_setup(read, with_bodies(read, RunOptions()), tmp_path, RunOptions(), user))


def test_suspended_launcher_knows_when_its_robots_have_landed(tmp_path, monkeypatch):
    launcher, zero = Launcher(tmp_path), time.monotonic()
    for since, silence in ((3.0, -math.inf), (3.7, zero + 3.7), (40.0, zero + 40.0)):
        with monkeypatch.context() as patched:
            patched.setattr(time, "monotonic", lambda at=zero + since: at)
            assert launcher.last_silence == silence


@pytest.mark.parametrize("word", ["experiment", "joining", "changed", "addressed"])
def test_no_name_of_a_case_shares_a_file(tmp_path, word):
    hosts, experiment = Hosts(Starts(), []), document.read("triangle").experiment
    names = ["rights", "run", "metrics", "x", "x-joining", "x-changed", "cases"]
    files = [
        CaseContext(Plan(experiment), name, tmp_path, tmp_path / "a.toml", [], Starts(), hosts).variant(word)
        for name in names
    ]
    assert len(set(files)) == len(names)
    assert all(file.relative_to(tmp_path).parts[0] == "cases" for file in files)
    assert all(len(file.relative_to(tmp_path).parts) == 3 for file in files)
