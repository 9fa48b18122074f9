"""The simulated network by itself; `test_conformance` compares it with the real one."""

from types import SimpleNamespace

import pytest
import zenoh

from agents.network.zenoh_config import config, settings
from tests.simulated import faults
from tests.simulated.kernel import BEGIN, Kernel, Process, sleep
from tests.simulated.network import Network

PLACES = ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448", "tcp/127.0.0.1:7449")


class Stage:
    """Routers, clients, and a log of what a client notices."""

    def __init__(self, kernel, routers=1):
        self.kernel, self.network, self.log = kernel, Network(), []
        self.routers = [self.process(f"router{row}", self.route, row) for row in range(routers)]

    def process(self, name, act, *args):
        return Process(name, lambda: act(*args))

    def route(self, row):
        self.network.open(config(settings("router", listen=[PLACES[row]], connect=PLACES[:row])))
        sleep(1000.0)

    def join(self, *places):
        sleep(0.1)
        return self.network.open(config(settings("client", connect=places or PLACES[:1])))

    def note(self, sample):
        there = sample.kind == zenoh.SampleKind.PUT
        self.log.append((round(self.kernel.now - BEGIN, 1), str(sample.key_expr), bytes(sample.payload) or there))

    def witness(self, *places):
        session = self.join(*places)
        session.declare_subscriber("park/**", self.note)
        session.liveliness().declare_subscriber("park/*/alive", self.note, history=True)
        sleep(1000.0)

    def robot(self, *places):
        self.session = self.join(*places)
        self.session.liveliness().declare_token("park/a/alive")
        while True:
            sleep(1.0)
            self.session.put("park/a/pose", str(round(self.kernel.now - BEGIN)).encode())


@pytest.fixture
def kernel():
    with Kernel(1) as made:
        yield made


def test_a_cut_client_is_lost_and_found_again(kernel):
    stage = Stage(kernel)
    stage.process("witness", stage.witness)
    stage.process("robot", stage.robot)
    kernel.after(1.5, lambda: stage.network.cut(stage.session))
    kernel.after(5.5, lambda: stage.network.cut(stage.session, False))
    kernel.run(limit=BEGIN + 6.5)
    assert [each[1:] for each in stage.log] == [
        ("park/a/alive", True),
        ("park/a/pose", b"1"),
        ("park/a/alive", False),
        ("park/a/alive", True),
        ("park/a/pose", b"6"),
    ]
    assert 2.9 <= stage.log[2][0] <= 3.5
    assert stage.log[3][0] == 5.5


@pytest.mark.parametrize(
    ("pause_s", "forgets", "listed"), [(0.0, 0.0, []), (1.0, 0.0, ["park/a/alive"]), (1.0, 1.0, [])]
)
def test_who_watches_tokens_may_ask_in_vain(kernel, pause_s, forgets, listed):
    stage, found = Stage(kernel), []
    stage.network.forgets = forgets

    def ask():
        session = stage.join()
        sleep(2.0)
        session.liveliness().declare_subscriber("park/*/alive", stage.note, history=True)
        sleep(pause_s)
        found.extend(reply.ok.key_expr for reply in session.liveliness().get("park/*/alive"))

    stage.process("robot", stage.robot)
    stage.process("asker", ask)
    kernel.run(limit=BEGIN + 5.0)
    assert found == listed


def test_clients_of_linked_routers_meet(kernel):
    stage = Stage(kernel, routers=3)
    stage.process("witness", stage.witness, PLACES[2])
    stage.process("robot", stage.robot, PLACES[0])
    kernel.run(limit=BEGIN + 2.5)
    assert [each[1:] for each in stage.log] == [
        ("park/a/alive", True),
        ("park/a/pose", b"1"),
        ("park/a/pose", b"2"),
    ]


def test_a_client_goes_over_to_another_router(kernel):
    stage = Stage(kernel, routers=2)
    stage.process("witness", stage.witness, PLACES[1])
    stage.process("robot", stage.robot, *PLACES[:2])
    kernel.after(1.5, stage.routers[0].kill)
    kernel.run(limit=BEGIN + 2.5)
    assert [each[1:] for each in stage.log] == [
        ("park/a/alive", True),
        ("park/a/pose", b"1"),
        ("park/a/alive", False),
        ("park/a/alive", True),
        ("park/a/pose", b"2"),
    ]


def test_link_is_whole_after_overlapping_faults():
    """The end of the second one brought the first one back, for good (seed 120889)."""
    with Kernel(1) as kernel:
        stage = Stage(kernel)
        stage.process("A", stage.witness)
        kernel.run(BEGIN + 1.0)
        (session,), losses = stage.network.sessions, []
        laboratory = SimpleNamespace(altered={}, sessions=lambda _: [session], after=kernel.after)
        for at, lasts, share in ((1.0, 2.0, 0.3), (2.0, 2.0, 0.9), (2.5, 0.2, 0.5)):
            fault = faults.Fault(at, "loss", "A", share, lasts)
            kernel.at(BEGIN + at, faults.KINDS["loss"], laboratory, fault)
        for t in (1.5, 2.6, 2.8, 3.5, 4.5):
            kernel.run(BEGIN + t)
            losses.append(session.loss)
    assert losses == [0.3, 0.5, 0.9, 0.9, 0.0]
