"""Exactly one process owns a name, whatever the order in which several claim it."""

from __future__ import annotations

import os
import random
import signal
import threading
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import pytest

from agents.network import name_ownership, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.name_ownership import NameTaken, OwnershipTiming, claim, confirm_ownership
from agents.runtime.loop import Runtime, Setup
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.agents.runtime.test_shutdown import Airborne
from tests.cases import for_each
from tests.conftest import RouterProcess
from tests.fuzz.loopnet import Net, Reply, Sample

KEY = Keys().alive("CF01")
ATONCE = OwnershipTiming(retry_s=0.0)
HASTY = OwnershipTiming(vanish_s=0.0)


class Table:
    """A router's tokens. Each step of a process waits for its turn, and the turns are drawn by chance."""

    def __init__(self, seed: int) -> None:
        self.tokens: list[str] = []
        self.answers = True
        self._chance = random.Random(seed)
        self._turn = threading.Condition()
        self._waiting: set[str] = set()
        self._running: set[str] = set()
        self._next: str | None = None
        self.now = 0.0

    def step(self, who: str) -> None:
        """Waits for the turn of a process."""
        with self._turn:
            self._waiting.add(who)
            self._draw()
            self._turn.wait_for(lambda: self._next == who, 10.0)
            self._next = None
            self._waiting.discard(who)
            self.now += 0.02

    def _draw(self) -> None:
        if self._next is None and self._waiting == self._running and self._waiting:
            self._next = self._chance.choice(sorted(self._waiting))
            self._turn.notify_all()

    def run(self, starts: dict[str, float]) -> dict[str, object]:
        """The outcome of the claims of some sessions, by their starts."""
        return self.together({who: claiming(self, who, at) for who, at in starts.items()})

    def together(self, works: dict[str, Callable[[], object]]) -> dict[str, object]:
        """The outcome of what some sessions do."""
        self._running = set(works)
        results: dict[str, object] = {}

        def work(who: str, what: Callable[[], object]) -> None:
            try:
                results[who] = what()
            except NameTaken as taken:
                results[who] = taken
            with self._turn:
                self._running.discard(who)
                self._draw()

        threads = [threading.Thread(target=work, args=each) for each in works.items()]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return results


def claiming(table: Table, who: str, began: float) -> Callable[[], object]:
    return partial(claim, Session(table, who), [KEY], began=began, timing=ATONCE)  # type: ignore[arg-type]


class Token:
    def __init__(self, session: Session, key: str) -> None:
        self.session, self.key = session, key

    def undeclare(self) -> None:
        self.session.table.step(self.session.who)
        self.session.table.tokens.remove(self.key)


class Session:
    def __init__(self, table: Table, who: str) -> None:
        self.table, self.who = table, who

    def zid(self) -> str:
        return self.who


@pytest.fixture
def faked(monkeypatch):
    """Makes `name_ownership` use a table in place of a network, and its clock."""

    def fake(table: Table) -> Table:
        def declared(session: Session, key: str) -> Token:
            table.step(session.who)
            table.tokens.append(key)
            return Token(session, key)

        def here(session: Session, _key: str) -> set[str] | None:
            table.step(session.who)
            return set(table.tokens) if table.answers else None

        monkeypatch.setattr(pubsub, "alive_token", declared)
        monkeypatch.setattr(network, "tokens_present", here)
        monkeypatch.setattr(network, "connected", lambda _session: True)
        monkeypatch.setattr(name_ownership.time, "monotonic", lambda: table.now)
        return table

    return fake


@for_each("seed", range(120))
def test_exactly_one_of_several_claims_succeeds(seed, faked):
    starts = {"a": 1.0, "b": 2.0, "c": 2.0}
    results = faked(Table(seed)).run({who: starts[who] for who in ("a", "b", "c")[: 2 + seed % 2]})
    assert sorted(isinstance(result, list) for result in results.values()) == [False] * (len(results) - 1) + [True]


def test_owner_with_a_fast_clock_keeps_its_name(faked):
    table = faked(Table(0))
    first = table.run({"owner": 100.0})
    assert isinstance(first["owner"], list)
    assert isinstance(table.run({"later": 1.0})["later"], NameTaken)
    assert Keys.life(KEY, "owner") in table.tokens
    assert not any("later" in token for token in table.tokens)  # it leaves nothing behind


def test_name_is_free_without_its_tokens(faked, monkeypatch):
    table = faked(Table(0))
    table.run({"dead": 1.0})
    step = table.step

    def vanish(who: str) -> None:
        step(who)
        if table.now > 1.0:
            table.tokens = [token for token in table.tokens if "dead" not in token]

    monkeypatch.setattr(table, "step", vanish)
    assert isinstance(table.run({"next": 2.0})["next"], list)


def asleep(table: Table, who: str) -> list[str]:
    """Takes the tokens of an owner away, as routers do when it is silent for longer than its lease."""
    lost = [token for token in table.tokens if who in token]
    table.tokens = [token for token in table.tokens if token not in lost]
    return lost


def woken(table: Table, who: str, tokens: list[str]) -> Callable[[], object]:
    """What an owner does that was cut off: Zenoh declares its tokens anew, one by one, and then it asks."""

    def work() -> object:
        for token in tokens:
            table.step(who)
            table.tokens.append(token)
        return confirm_ownership(Session(table, who), [KEY], threading.Event(), ATONCE)

    return work


@for_each("seed", range(120))
def test_at_most_one_owner_drives_the_body(seed, faked):
    table = faked(Table(seed))
    table.run({"old": 1.0})
    results = table.together({"new": claiming(table, "new", 2.0), "old": woken(table, "old", asleep(table, "old"))})
    # which one depends on the moment; in the worst case each gives way to the other
    assert sum(not isinstance(result, NameTaken) for result in results.values()) <= 1


@pytest.mark.parametrize("began", [0.5, 2.0])  # the clock of the new one may be behind
def test_waking_owner_gives_way(began, faked):
    table = faked(Table(0))
    table.run({"old": 1.0})
    lost = asleep(table, "old")
    assert isinstance(table.run({"new": began})["new"], list)
    assert isinstance(table.together({"old": woken(table, "old", lost)})["old"], NameTaken)
    assert Keys.life(KEY, "new") in table.tokens


def test_owner_that_wakes_alone_keeps_its_name(faked):
    table = faked(Table(0))
    table.run({"old": 1.0})
    lost = [*asleep(table, "old"), KEY]
    assert table.together({"old": woken(table, "old", lost)})["old"] is None


def test_empty_answer_of_a_lost_link_proves_nothing(faked, monkeypatch):
    table = faked(Table(0))
    table.tokens = [Keys.life(KEY, "new")]
    answers = iter([set(), set()])
    links = iter([True, True, True, False])  # the link is lost after the first answer
    there = network.tokens_present
    monkeypatch.setattr(network, "connected", lambda _session: next(links, True))
    monkeypatch.setattr(network, "tokens_present", lambda session, key: next(answers, None) or there(session, key))
    assert isinstance(table.together({"old": woken(table, "old", [])})["old"], NameTaken)


def test_other_make_with_plain_token_keeps_its_name(faked):
    table = faked(Table(0))
    table.tokens.append(KEY)
    assert isinstance(table.run({"next": 2.0})["next"], NameTaken)


def test_silent_router_frees_no_name(faked):
    table = faked(Table(0))
    table.answers = False
    table._running = {"a"}
    with pytest.raises(network.Unreachable, match="no router answers who owns the name"):
        claiming(table, "a", 1.0)()


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        (Reply(Sample(Keys().alive("F"), "", b""), good=True), NameTaken),
        (Reply(Sample("", "", b"Timeout"), good=False), network.Unreachable),
    ],
)
def test_a_process_without_its_name_touches_no_body(reply, error):
    experiment = pair(robots={"F": RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5)}, formation=Formation())
    timing = OwnershipTiming(vanish_s=0.0, answer_s=0.0)
    setup = Setup(Keys("park"), [], "json", 50.0, lifeline=False, externally_measured=[False], ownership=timing)
    body = Airborne()
    with Net().worn() as net:
        net.replies = [reply]
        robot = Runtime([Plan(experiment).assignment("F")], body, setup)
        with pytest.raises(error):
            robot.run()
    assert body.calls == []


class Woken(Airborne):
    """A body that flies; after some ticks its process stands still."""

    def __init__(self) -> None:
        super().__init__(steps=10**9)
        self.commands = 0

    def command(self, _setpoint: object) -> None:
        self.commands += 1


@pytest.mark.parametrize("way", ["still", "opening", "cut off"])
def test_displaced_owner_leaves_the_body_alone(way, monkeypatch):
    experiment = pair(robots={"F": RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5)}, formation=Formation())
    setup = Setup(Keys("park"), [], "json", 50.0, lifeline=False, externally_measured=[False], ownership=HASTY)
    body = Woken()
    told: list[int] = []
    now = [0.0]
    monkeypatch.setattr(name_ownership, "uptime", lambda: now[0])
    with Net().worn() as net:
        robot = Runtime([Plan(experiment).assignment("F")], body, setup)

        def looks() -> None:
            if not told:
                told.append(body.commands)
                net.replies = [Reply(Sample(Keys.life(Keys().alive("F"), "beef"), "", b""), good=True)]
                if way == "cut off":
                    robot._silent_since = 0.0  # until the router answers again
                else:
                    now[0] += 60.0

        body.looks = looks
        if way == "opening":
            body.open = looks
        with pytest.raises(NameTaken, match="F: another process has taken this name while this one stood still"):
            robot.run()
    assert body.calls == ([] if way == "opening" else ["open"])
    assert (told[0] > 0) == (way != "opening")
    if way != "cut off":
        assert body.commands == told[0]


class CountedToken:
    """A liveliness token that may be undeclared once, as Zenoh's."""

    live: ClassVar[list[str]] = []

    def __init__(self, _session: object, key: str) -> None:
        self.key = key
        self.live.append(key)

    def undeclare(self) -> None:
        self.live.remove(self.key)


def test_late_alarm_leaves_the_tokens(monkeypatch):
    setup = Setup(Keys("park"), [], "json", 50.0, lifeline=False, externally_measured=[False, False])
    with Net().worn() as net, monkeypatch.context() as patched:
        patched.setattr(pubsub, "alive_token", CountedToken)
        robot = Runtime([Plan(pair()).assignment(name) for name in "AB"], Airborne(), setup)
        robot.subscribe_to_stops(net.session)
        robot.join(net.session)
        robot._joined = True
        shown = [Keys().alive("A"), Keys().alive("B")]
        assert CountedToken.live == shown
        robot.watchdog.tripped = "it hangs"
        robot._leave_formation("it hangs")
        robot._leave_formation("it hangs")
        assert CountedToken.live == []
        robot._land_after_hang(robot.watchdog.forgive())
        assert CountedToken.live == shown
        robot._leave_formation("it hung")  # by a thread that was held up until the loop had recovered
        assert CountedToken.live == shown
        robot._land_after_hang("it hung")
        assert CountedToken.live == shown
        robot._orders.leaving.add(0)
        robot.robots[0].lifecycle.land("ordered to leave")
        robot.watchdog.tripped = "it hangs"
        robot._leave_formation("it hangs")
        robot._retire(0.0)  # of a row whose token the alarm has taken back
        robot._land_after_hang(robot.watchdog.forgive())
        assert CountedToken.live == shown[1:]


@pytest.mark.mechanism("name ownership")
@pytest.mark.system
def test_real_router_knows_owners_of_names(router: RouterProcess):
    timing = OwnershipTiming(vanish_s=0.0, answer_s=0.5)
    with (
        network.open_session([router.endpoint], name="one") as one,
        network.open_session([router.endpoint], name="two") as two,
    ):
        owned = claim(one, [KEY], began=2.0, timing=timing)
        with pytest.raises(NameTaken):
            claim(two, [KEY], began=1.0, timing=timing)
        for token in owned:
            token.undeclare()
        router.process.send_signal(signal.SIGSTOP)
        os.waitpid(router.process.pid, os.WUNTRACED)  # until it has stopped: else it may still answer
        try:
            with pytest.raises(network.Unreachable):
                claim(two, [KEY], began=1.0, timing=timing)
        finally:
            router.process.send_signal(signal.SIGCONT)
