"""Runs that are conducted: their hardware, their emergency stop, and what serves them and is started again."""

import math
import socket
import threading
import time
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from agents.network.endpoints import Endpoint, free_endpoint
from agents.network.keys import Keys
from agents.network.session import Unreachable
from agents.runtime.router import serve_router
from experiments.definition.experiment import Formation, Host, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.real_time.conductor import conduct
from experiments.real_time.conductor.case_processes import STARTS, CaseContext, CaseProcesses
from experiments.real_time.conductor.conduct import PORT_CHOICES, RunOptions, Supervision, run_setup, with_bodies
from experiments.real_time.conductor.orders import STARTING_S, Emergency
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import ROUTER, Launcher, RouterEnded
from tests.small import changed, pair

RADIO = "radio://0/80/2M/E7E7E7E701"


def test_hardware_is_known_by_address_settings_and_host():
    robots = {
        "CF01": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.5, body=RADIO),
        "TE01": RobotTable(kind="tello", start=[0.5, 0.0], hover=0.5, body="tello"),
        "KH01": RobotTable(kind="khepera4", start=[-0.5, 0.0], body="khepera4://10.0.0.7", device={"port": 344}),
        "KH02": RobotTable(kind="khepera4", start=[-0.5, 0.5]),
        "KH03": RobotTable(kind="khepera4", start=[-0.5, 0.9], body="khepera4-twin"),
    }
    real = pair(robots=robots, formation=Formation())
    away = changed(real, hosts={"lab2": Host(address="ana@lab2", robots=["TE01"])})
    wanted = dict.fromkeys(robots, "") | {
        "CF01": RADIO,
        "TE01": "tello on lab2",
        "KH01": 'khepera4://10.0.0.7 {"port": 344}',
    }
    assert conduct.hardware([Plan(real), Plan(away)]) == wanted


def registered(robots, title="here", born=None):
    made = run_registry.own_entry("run", title, ["tcp/127.0.0.1:7448"], folder=Path("/runs/other"), robots=robots)
    return made if born is None else changed(made, born=born)


@pytest.mark.parametrize(
    ("mine", "theirs", "refused"),
    [
        ({"CF01": RADIO}, {"CF01": RADIO}, True),
        ({"CF09": RADIO}, {"CF01": RADIO}, True),
        ({"TE01": "tello"}, {"TE01": "tello"}, True),
        ({"TE02": "rmw"}, {"TE01": "rmw"}, False),
        ({"CF01": RADIO}, {"CF01": RADIO[:-1] + "2"}, False),
        ({"CF01": RADIO}, {"CF01": ""}, False),
    ],
)
def test_hardware_that_another_run_has_is_refused(monkeypatch, mine, theirs, refused):
    me, other = registered(mine), registered(theirs, "there", born="another")
    assert conduct.check_other_runs(me, [other], "x.toml") == [], "it has died"
    monkeypatch.setattr(run_registry, "born", lambda _pid: "another")
    there = "there, /runs/other, at tcp/127.0.0.1:7448"
    if not refused:
        told = [f"another run is up with robots of these names ({name}): {there}" for name in mine.keys() & theirs]
        assert conduct.check_other_runs(me, [me, other], "x.toml") == told
        return
    with pytest.raises(DocumentError) as caught:
        conduct.check_other_runs(me, [me, other], "x.toml")
    (problem,) = caught.value.problems
    (name, body), *_ = mine.items()
    assert problem.message == f"{name} ({body}) is in another run, {there}"
    assert problem.hint.endswith("or `./zenpark estop --connect tcp/127.0.0.1:7448`")


@pytest.fixture
def endpoint():
    return free_endpoint(preferred_port=0)


@pytest.mark.slow
def test_router_that_just_started_is_waited_for(endpoint):
    over = threading.Event()
    late = threading.Timer(0.6, serve_router, ([endpoint], over))
    late.start()
    try:
        with Emergency().throughout([endpoint], Keys(), "operator", STARTING_S):
            pass
    finally:
        over.set()
        late.join()


def test_one_of_somebody_else_is_not(endpoint):
    with pytest.raises(Unreachable), Emergency().throughout([endpoint], Keys(), "operator", 0.2):
        pass


class Starts:
    """Stands for a launcher, and keeps what it was to start."""

    def __init__(self):
        self.told = []

    def start(self, *words):
        self.told.append(words)


def case(folder, name="only", listens=()):
    """Context of a case of the triangle, and the launcher that it has."""
    launcher, plan = Starts(), Plan(document.read("triangle").experiment)
    hosts = Hosts(launcher, list(listens))
    return CaseContext(plan, name, folder, folder / "case.toml", ["tcp/127.0.0.1:7447"], launcher, hosts), launcher


def test_dead_router_listens_again_where_machines_expect_it(tmp_path):
    context, launcher = case(tmp_path, listens=["tcp/0.0.0.0:7447"])
    processes = CaseProcesses(context)
    dead = SimpleNamespace(name=ROUTER, exit="killed by SIGKILL")
    said = [processes.again(dead) for _ in range(STARTS)]
    assert [words[:2] for words in launcher.told] == [(ROUTER, "agents.runtime.router")] * (STARTS - 1)
    assert all(words[2:4] == ("--listen", "tcp/0.0.0.0:7447") for words in launcher.told)
    assert said[0] == (ROUTER, "the router ended (killed by SIGKILL); started again")
    assert said[-1] == (ROUTER, "the router ended (killed by SIGKILL); given up: the robots hold, and land at the end")
    assert processes.again(SimpleNamespace(name="only-KH01", exit="exit code 2")) is None


@pytest.mark.system
def test_router_with_port_taken_meanwhile_listens_elsewhere(tmp_path, monkeypatch):
    taken = free_endpoint(preferred_port=0)
    with socket.create_server(("127.0.0.1", Endpoint.parse(taken).port)):
        free = [[taken], [taken], [free_endpoint(preferred_port=0)]]
        chosen = iter(free)
        monkeypatch.setattr(conduct, "free_endpoints", lambda *_, **__: next(chosen))
        read, user = document.read("triangle"), Supervision(nullcontext(), lambda: False)
        with run_setup(read, with_bodies(read, RunOptions()), tmp_path, RunOptions(), user) as (contexts, _):
            assert contexts["event"].endpoints == free[-1]
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
    names = ["rights", "run", "metrics", "x", "x-joining", "x-changed", "cases"]
    files = {case(tmp_path, name)[0].variant(word).relative_to(tmp_path).parts for name in names}
    assert len(files) == len(names)
    assert {(parts[0], len(parts)) for parts in files} == {("cases", 3)}
