"""Who serves a whole run is started again, where others look for it, and not for ever."""

from types import SimpleNamespace

from experiments.file import document
from experiments.real_time.conductor.case_context import CaseContext
from experiments.real_time.conductor.support import STARTS, Servants
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import ROUTER


class Starts:
    """Stands for a launcher, and keeps what it was to start."""

    def __init__(self) -> None:
        self.told: list[tuple[str, ...]] = []

    def start(self, *words: str) -> None:
        self.told.append(words)


def test_a_router_that_died_listens_again_where_other_machines_look_for_it(tmp_path):
    launcher = Starts()
    here, everywhere = "tcp/127.0.0.1:7447", "tcp/0.0.0.0:7447"
    experiment = document.read("triangle").experiment
    hosts = Hosts(launcher, [everywhere])
    servants = Servants(CaseContext(experiment, "only", tmp_path, tmp_path / "case.toml", [here], launcher, hosts))
    dead = SimpleNamespace(name=ROUTER, exit="killed by SIGKILL")
    said = [servants.again(dead) for _ in range(STARTS)]
    assert [words[:2] for words in launcher.told] == [(ROUTER, "agents.runtime.router")] * (STARTS - 1)
    assert all(words[2:4] == ("--listen", everywhere) for words in launcher.told)
    assert said[0] == (ROUTER, "the router ended (killed by SIGKILL); started again")
    assert said[-1] == (
        ROUTER,
        "the router ended (killed by SIGKILL); given up: the robots hold, and land at the end",
    )
    assert servants.start_centre() == ()
    assert servants.again(SimpleNamespace(name="only-KH01", exit="exit code 2")) is None
