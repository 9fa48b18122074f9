"""Runs that are conducted, and their emergency stop."""

import threading
from pathlib import Path

import msgspec
import pytest

from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from agents.network.session import Unreachable
from agents.runtime.router import serve_router
from experiments.definition.experiment import Formation, Host, RobotTable
from experiments.definition.plan import Plan
from experiments.file.problems import DocumentError
from experiments.real_time.conductor.conduct import check_other_runs, hardware
from experiments.real_time.conductor.emergency import STARTING_S, Emergency
from experiments.real_time.hosts import run_registry
from tests.small import pair

RADIO = "radio://0/80/2M/E7E7E7E701"
REAL = pair(
    robots={
        "CF01": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.5, body=RADIO),
        "TE01": RobotTable(kind="tello", start=[0.5, 0.0], hover=0.5, body="tello"),
        "KH01": RobotTable(kind="khepera4", start=[-0.5, 0.0], body="khepera4://10.0.0.7", device={"port": 344}),
        "KH02": RobotTable(kind="khepera4", start=[-0.5, 0.5]),
        "KH03": RobotTable(kind="khepera4", start=[-0.5, 0.9], body="khepera4-twin"),
    },
    formation=Formation(),
)


def run(robots: dict[str, str], title: str = "here", born: str | None = None) -> run_registry.RegisteredRun:
    made = run_registry.own_entry("run", title, ["tcp/127.0.0.1:7448"], folder=Path("/runs/other"), robots=robots)
    return made if born is None else msgspec.structs.replace(made, born=born)


def test_hardware_is_known_by_address_settings_and_host() -> None:
    away = msgspec.structs.replace(REAL, hosts={"lab2": Host(address="ana@lab2", robots=["TE01"])})
    assert hardware([Plan(REAL), Plan(away)]) == {
        "CF01": RADIO,
        "TE01": "tello on lab2",
        "KH01": 'khepera4://10.0.0.7 {"port": 344}',
        "KH02": "",
        "KH03": "",
    }


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
def test_hardware_that_another_run_has_is_refused(
    monkeypatch: pytest.MonkeyPatch, mine: dict[str, str], theirs: dict[str, str], refused: bool
) -> None:
    me, other = run(mine), run(theirs, "there", born="another")
    monkeypatch.setattr(run_registry, "born", lambda _pid: "another")
    if not refused:
        same = sorted(mine.keys() & theirs.keys())
        assert check_other_runs(me, [me, other], "x.toml") == [
            f"another run is up with robots of these names ({name}): there, /runs/other, at tcp/127.0.0.1:7448"
            for name in same
        ]
        return
    with pytest.raises(DocumentError) as caught:
        check_other_runs(me, [me, other], "x.toml")
    (problem,) = caught.value.problems
    (name, body), *_ = mine.items()
    assert problem.message == f"{name} ({body}) is in another run, there, /runs/other, at tcp/127.0.0.1:7448"
    assert problem.hint.endswith("or `./zenpark estop --connect tcp/127.0.0.1:7448`")


def test_a_run_that_has_died_has_nothing() -> None:
    assert check_other_runs(run({"CF01": RADIO}), [run({"CF01": RADIO}, born="long ago")], "x.toml") == []


KEYS = Keys("park")


@pytest.fixture
def endpoint():
    return free_endpoint(preferred_port=0)


@pytest.mark.slow
def test_router_that_just_started_is_waited_for(endpoint):
    over = threading.Event()
    late = threading.Timer(0.6, serve_router, ([endpoint], over))
    late.start()
    try:
        with Emergency().throughout([endpoint], KEYS, "operator", STARTING_S):
            pass
    finally:
        over.set()
        late.join()


def test_one_of_somebody_else_is_not(endpoint):
    with pytest.raises(Unreachable), Emergency().throughout([endpoint], KEYS, "operator", 0.2):
        pass
