"""Exactly one process owns a name, whatever the order in which several claim it."""

from __future__ import annotations

import os
import random
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from math import inf
from types import SimpleNamespace

import pytest
import zenoh

from agents.body.limits import Safety
from agents.network import messages, name_ownership
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.name_ownership import TRIES, NameTaken, OwnershipTiming, claim, confirm_ownership
from tests.agents.runtime.process import DRONE, QUICK, Airborne, clocked, process
from tests.cases import for_each
from tests.conftest import RouterProcess
from tests.fuzz.messages import sent
from tests.network import Attentive, Mute, Net, Reply, Sample
from tests.small import pair, small
from tests.waiting import PATIENCE_S, ManualClock, until

KEY = Keys().alive("CF01")
AT_ONCE = OwnershipTiming(retry_s=0.0)
BRIEF = OwnershipTiming(vanish_s=0.4, retry_s=0.0)
HASTY = OwnershipTiming(vanish_s=0.0, answer_s=0.0)


class Table(ManualClock):
    """A router's tokens, and the clock. Each act of a session waits for its turn; turns are drawn by chance."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.tokens: list[str] = []
        self.answers: Iterator[set[str] | None] = iter(())  # in place of the tokens; None: no answer
        self.links: Iterator[bool] = iter(())  # whether a session is linked, as long as that is given
        self._seed = seed
        self._turn = threading.Condition()
        self._waiting: set[str] = set()
        self._running: set[str] = set()

    def await_turn(self, name: str) -> None:
        with self._turn:
            self._waiting.add(name)
            self._turn.notify_all()
            assert self._turn.wait_for(lambda: self._drawn() == name, PATIENCE_S)
            self._waiting.discard(name)
            self.now += 0.02

    def _drawn(self) -> str:
        """Session whose turn it is, once all wait for theirs."""
        together = self._waiting == self._running
        return random.Random(f"{self._seed} {self.now}").choice(sorted(self._waiting)) if together else ""

    def together(self, **works: Callable[[Session], object]) -> dict[str, object]:
        """The outcome of what some sessions do at the same time."""
        self._running = set(works)

        def work(name: str, do: Callable[[Session], object]) -> object:
            try:
                return do(Session(self, name))
            except (NameTaken, network.Unreachable) as error:
                return error
            finally:
                with self._turn:
                    self._running.discard(name)
                    self._turn.notify_all()

        with ThreadPoolExecutor(len(works)) as pool:
            return dict(zip(works, pool.map(work, works, works.values()), strict=True))

    def lose(self, name: str) -> list[str]:
        """Drop the tokens of a session, as routers do when it is silent for longer than its lease."""
        lost = [token for token in self.tokens if name in token]
        for token in lost:
            self.tokens.remove(token)
        return lost


class Session:
    """A session of Zenoh at a table, as far as `name_ownership` uses it."""

    def __init__(self, table: Table, name: str) -> None:
        self.table, self.name = table, name
        self.info = self

    def zid(self) -> str:
        return self.name

    def routers_zid(self) -> list[str]:
        return ["router"] * next(self.table.links, True)

    def peers_zid(self) -> list[str]:
        return []

    def liveliness(self) -> Session:
        return self

    def get(self, _key: str, **_: object) -> list[Reply]:
        self.table.await_turn(self.name)
        answer = next(self.table.answers, self.table.tokens)
        if answer is None:
            return [Reply(Sample("", "", b"Timeout"), good=False)]
        return [Reply(Sample(token, "", b""), good=True) for token in answer]

    def declare_token(self, key: str) -> SimpleNamespace:
        self.table.await_turn(self.name)
        self.table.tokens.append(key)
        return SimpleNamespace(undeclare=partial(self._undeclare, key))

    def _undeclare(self, key: str) -> None:
        self.table.await_turn(self.name)
        self.table.tokens.remove(key)


@pytest.fixture
def table(monkeypatch):
    """A table that starts anew with each seed, and is the clock of `name_ownership`."""

    def made(seed: int = 0) -> Table:
        given = Table(seed)
        monkeypatch.setattr(name_ownership, "time", given)
        return given

    return made


def claiming(began: float, timing: OwnershipTiming = AT_ONCE) -> Callable[[Session], object]:
    return partial(claim, alive=[KEY], began=began, timing=timing)  # type: ignore[arg-type]


def waking(tokens: list[str]) -> Callable[[Session], object]:
    """Owner that was cut off: Zenoh declares its tokens again, one by one, and then the owner asks."""

    def work(session: Session) -> object:
        for token in tokens:
            session.declare_token(token)
        return confirm_ownership(session, [KEY], threading.Event(), AT_ONCE)  # type: ignore[arg-type]

    return work


@for_each("seed", range(150))
def test_exactly_one_of_several_claims_succeeds(seed, table):
    starts = {"a": 1.0, "b": 2.0, "c": 2.0}
    results = table(seed).together(**{name: claiming(starts[name], BRIEF) for name in ("a", "b", "c")[: 2 + seed % 2]})
    assert sorted(isinstance(result, list) for result in results.values()) == [False] * (len(results) - 1) + [True]


@for_each("seed", range(80))
def test_at_most_one_owner_drives_the_body(seed, table):
    router = table(seed)
    router.together(old=claiming(1.0))
    results = router.together(new=claiming(2.0, BRIEF), old=waking(router.lose("old")))
    # which one depends on the moment; in the worst case each gives way to the other
    assert sum(not isinstance(result, NameTaken) for result in results.values()) <= 1


def test_owner_with_a_fast_clock_keeps_its_name(table):
    router = table()
    assert isinstance(router.together(owner=claiming(100.0))["owner"], list)
    assert isinstance(router.together(later=claiming(1.0))["later"], NameTaken)
    assert Keys.life(KEY, "owner") in router.tokens
    assert not any("later" in token for token in router.tokens)  # it leaves nothing behind
    router.tokens[:] = [KEY]  # of another make
    assert isinstance(router.together(next=claiming(2.0))["next"], NameTaken)


def test_name_is_free_without_its_tokens(table):
    router = table()
    router.together(dead=claiming(1.0))
    there = list(router.tokens)
    router.lose("dead")
    router.answers = iter([there] * 50)  # until the router drops them, a second later
    assert isinstance(router.together(next=claiming(2.0))["next"], list)


@pytest.mark.parametrize("began", [0.5, 2.0])  # the clock of the new one may be behind
def test_waking_owner_gives_way(began, table):
    router = table()
    router.together(old=claiming(1.0))
    lost = router.lose("old")
    assert isinstance(router.together(new=claiming(began))["new"], list)
    assert isinstance(router.together(old=waking(lost))["old"], NameTaken)
    assert Keys.life(KEY, "new") in router.tokens
    router.lose("new")
    assert router.together(old=waking([*router.lose("old"), KEY]))["old"] is None, "it wakes alone"


def test_empty_answer_of_a_lost_link_proves_nothing(table):
    router = table()
    router.tokens = [Keys.life(KEY, "new")]
    router.answers = iter([set(), set()])
    router.links = iter([True, True, True, False])  # the link is lost after the first answer
    assert isinstance(router.together(old=waking([]))["old"], NameTaken)


def test_slow_answer_of_lost_link_proves_nothing(table):
    """Each question ends with the lease of the link, a moment before the session notices that the link is lost."""
    router, pauses = table(), []

    class Pause(threading.Event):
        def wait(self, timeout=0.0):
            pauses.extend([timeout] * (timeout > 0.0))
            router.sleep(timeout)
            return False

    router.answers = iter(lambda: router.sleep(2.0) or set(), None)
    router.links = iter(lambda: not pauses, None)
    claiming_one = partial(claiming(1.0), stop=Pause())
    assert isinstance(router.together(next=claiming_one)["next"], network.Unreachable)


def test_silent_router_frees_no_name(table):
    router = table()
    router.answers = iter(lambda: None, 0)
    refusal = router.together(a=claiming(1.0))["a"]
    assert isinstance(refusal, network.Unreachable)
    assert "no router answers who owns the name" in str(refusal)


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        (Reply(Sample(Keys().alive("F"), "", b""), good=True), NameTaken),
        (Reply(Sample("", "", b"Timeout"), good=False), network.Unreachable),
    ],
)
def test_a_process_without_its_name_touches_no_body(reply, error):
    body = Airborne()
    with Net().worn() as net:
        net.replies = [reply]
        with pytest.raises(error):
            process(DRONE, body, ownership=HASTY).run()
    assert body.calls == []


class Commanded(Airborne):
    def __init__(self, rows: int = 1) -> None:
        super().__init__(steps=10**9, rows=rows)
        self.commands = 0

    def command(self, _setpoint: object) -> None:
        self.commands += 1


@pytest.mark.parametrize("way", ["still", "opening", "cut off"])
def test_displaced_owner_leaves_the_body_alone(way, monkeypatch):
    body, clock, told = Commanded(), ManualClock(), []
    monkeypatch.setattr(name_ownership, "uptime", clock.monotonic)

    def displaced() -> None:
        if told:
            return
        told.append(body.commands)
        net.replies = [Reply(Sample(Keys.life(Keys().alive("F"), "beef"), "", b""), good=True)]
        if way == "cut off":  # until the router answers again
            silences = iter([0.0])
            monkeypatch.setattr(Attentive, "silent_since", lambda *_: next(silences, inf))
        else:
            clock.sleep(60.0)

    setattr(body, "open" if way == "opening" else "looks", displaced)
    with Net().worn() as net, pytest.raises(NameTaken, match="F: another process has taken this name while this one"):
        process(DRONE, body, ownership=OwnershipTiming(vanish_s=0.0), loop_timeout_s=PATIENCE_S).run()
    assert body.calls == ([] if way == "opening" else ["open"])
    assert (told[0] > 0) == (way != "opening")
    if way != "cut off":
        assert body.commands == told[0]


class Shared(ManualClock):
    """Clock of the loop of a process, and of its question for the owner of its names while that is asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(1000.0)
        clocked(monkeypatch, self)
        monkeypatch.setattr(name_ownership, "time", self)

    def of(self, ownership: name_ownership.OwnershipCheck) -> None:
        self._check, clock = ownership, self

        class Pause(threading.Event):
            def wait(self, timeout: float | None = None) -> bool:
                clock.now += timeout or 0.0
                return super().wait(0.002)

        ownership._over = Pause()

    def sleep(self, seconds: float) -> None:
        if self._check._asking is None or not self._check._asking.is_alive():
            self.now += seconds
        threading.Event().wait(0.0005)


@pytest.mark.parametrize("taken", [True, False], ids=["taken", "free"])
def test_link_that_is_back_waits_for_owner(taken, monkeypatch):
    body, keys, clock = Commanded(), Keys(), Shared(monkeypatch)
    # on wheels it would halt soon without an answer
    wheels = small({"F": "khepera4"}, safety=Safety(neighbour_timeout_s=0.1))
    experiment, timing = (wheels, OwnershipTiming(vanish_s=0.5)) if taken else (DRONE, OwnershipTiming())
    marks: list[tuple[int, int]] = []  # commands and puts so far: at the loss of the link, and at its return
    puts: list[bytes] = []

    def linked(_session: object) -> bool:
        away = bool(marks) and body.reads < 20
        if not away and len(marks) == 1:
            marks.append((body.commands, len(puts)))
            net.replies = [Reply(Sample(Keys.life(keys.alive("F"), "beef"), "", b""), good=True)] * taken
        return not away

    def looks() -> None:
        if not marks:
            marks.append((body.commands, len(puts)))
        elif (len(marks) == 2 and body.commands > marks[1][0]) or body.reads > 200:
            raise OSError("it commands again")

    body.looks = looks
    monkeypatch.setattr(Mute, "put", lambda _, payload, **__: puts.append(payload))
    with Net().worn() as net, monkeypatch.context() as inside:
        inside.setattr(network, "connected", linked)
        runtime = process(experiment, body, ownership=timing, descent=QUICK, loop_timeout_s=PATIENCE_S)
        clock.of(runtime.keeper.ownership)
        with pytest.raises(NameTaken if taken else OSError, match="has taken" if taken else "commands again"):
            runtime.run()
    lost, back = marks
    assert lost[0] < back[0], "it holds by its decisions while it is cut off"
    if taken:
        assert (body.calls, body.commands, len(puts)) == (["open"], *back)


@pytest.mark.parametrize(("events", "back"), [("r", False), ("Rr", True), ("Ss", False), ("RSs", True), ("rR", True)])
def test_link_opened_anew_between_two_looks_is_noticed(events, back):
    """By neighbours: capital letters are gone, small ones are there. At first r is, and of a mesh s."""
    told: list[Callable[[object], object]] = []
    info = SimpleNamespace(routers_zid=lambda: ["r"], peers_zid=lambda: [])
    info.declare_transport_events_listener = lambda callback, **_: told.append(callback)
    session, ownership = SimpleNamespace(info=info), name_ownership.OwnershipCheck([])
    assert not ownership.check_return(session)
    for zid in "r" + "s" * ("S" in events) + events:
        kind = zenoh.SampleKind.PUT if zid.islower() else zenoh.SampleKind.DELETE
        told[0](SimpleNamespace(kind=kind, transport=SimpleNamespace(zid=zid.lower())))
    assert [ownership.check_return(session) for _ in range(2)] == [back, False]


def test_linked_session_is_not_asked_on_each_tick():
    """Events of links tell of a loss; asking takes 0.6 µs, twice a tick."""
    asked, told = [], []
    info = SimpleNamespace(routers_zid=lambda: asked.append("routers") or ["r"], peers_zid=lambda: [])
    info.declare_transport_events_listener = lambda callback, **_: told.append(callback)
    session, ownership = SimpleNamespace(info=info), name_ownership.OwnershipCheck([])
    ownership.check_return(session)
    told[0](SimpleNamespace(kind=zenoh.SampleKind.PUT, transport=SimpleNamespace(zid="r")))
    asked.clear()
    assert not ownership.check_return(session)
    assert asked == []
    told[0](SimpleNamespace(kind=zenoh.SampleKind.DELETE, transport=SimpleNamespace(zid="r")))
    assert ownership.check_return(session)
    assert asked == ["routers"]


def test_late_alarm_leaves_the_tokens():
    body, shown = Commanded(rows=2), [Keys().alive("A"), Keys().alive("B")]

    def alarm(why: str, expected: list[str]) -> None:
        """The robots leave the formation, in a thread of the watchdog."""
        runtime.watchdog.call_for_help(why)
        until(lambda: not any(thread.name == "watchdog: alarm" for thread in threading.enumerate()))
        assert [key for key in net.tokens if key in shown] == expected

    def hang() -> None:
        runtime.watchdog.tripped = "it hangs"
        alarm("it hangs", [])

    def steps() -> Iterator[None]:
        hang()
        alarm("it hangs", [])
        yield
        alarm("it hung", shown)  # by a thread that was held up until the loop had recovered
        net.deliver(sent("park/A/order", messages.Order("leave"))[0])
        yield
        hang()
        yield  # A is retired, without the token that the alarm has taken back
        assert [key for key in net.tokens if key in shown] == shown[1:]
        raise OSError("the test is over")

    with Net().worn() as net:
        runtime = process(pair(), body, descent=QUICK, loop_timeout_s=PATIENCE_S)
        body.looks = partial(next, steps(), None)
        with pytest.raises(OSError, match="the test is over"):
            runtime.run()


@pytest.mark.parametrize("empty", [0, 1, 3 * TRIES])
def test_empty_answer_tells_nothing_of_owners(empty):
    """The own token is missing: an owner that was seen may still be there, and nobody knows of others."""
    session, answers, asked = Net().session, [], []
    own, other = (session.declare_token(Keys.life("park/F/alive", each)) for each in (session.zid(), "other"))
    get = session.get

    def answer(key: str, **given: object) -> object:
        asked.append(key)
        if len(asked) == 2:
            other.undeclare()
        return [] if 2 <= len(asked) < 2 + empty else get(key, **given)

    with Net().worn():
        session.get = answer
        confirm_ownership(session, ["park/F/alive"], threading.Event(), note=answers.append)
    own.undeclare()
    assert answers[:2] == [True, False]
    assert answers.count(False) > 1
    assert len(asked) == empty + len(answers)


def owner(session: str, began: float) -> list[str]:
    return [Keys.life(KEY, session), Keys.claim(KEY, Keys.rank(began, session))]


@pytest.mark.parametrize(
    ("tokens", "found"),
    [
        ([], ([], False)),
        (owner("beef", 2.0), (["beef"], False)),
        (owner("beef", 2.0)[:1], ([], False)),
        (owner("beef", 2.0)[1:], ([], False)),
        ([*owner("beef", 2.0), Keys.objection(KEY, "beef", "f00d")], (["beef"], False)),
        (owner("beef", 0.5), ([], False)),
        ([*owner("beef", 0.5), Keys.objection(KEY, "beef", "f00d")], ([], True)),
        ([*owner("beef", 0.5), Keys.objection(KEY, "beef", "cafe")], ([], False)),
        ([Keys.objection(KEY, "beef", "f00d")], ([], False)),
    ],
)
def test_earlier_of_two_owners_stays(tokens, found):
    """Another session is an owner with both of its tokens; a stranger's objection is none."""
    assert name_ownership.rivals(KEY, "f00d", [KEY, *owner("f00d", 1.0), *tokens]) == found
    assert name_ownership.rivals(KEY, "f00d", tokens) == ([], False)


@pytest.mark.parametrize(
    ("began", "away", "noticed"), [(2.0, False, False), (2.0, True, False), (2.0, True, True), (0.5, False, False)]
)
def test_owner_objects_to_a_later_one(began, away, noticed, monkeypatch):
    clock, net = ManualClock(), Net()
    monkeypatch.setattr(name_ownership, "uptime", clock.monotonic)
    with net.worn():
        net.session.info.routers_zid = lambda: ["r"]
        check = name_ownership.OwnershipCheck([KEY], network.ROBOT_LEASE_S)
        assert not check.check_return(net.session)
        clock.sleep(0.7 * away)
        assert not noticed or check.check_standstill()
        for token in (*owner("f00d", 1.0), *owner("beef", began)):
            check._follow_tokens(Sample(token, "", b""))
        until(lambda: not any(thread.name == "objection" for thread in threading.enumerate()))
        assert (Keys.objection(KEY, "f00d", "beef") in net.tokens) == (began == 2.0 and not away)
        assert check.check_return(net.session) == (away and not noticed)
        assert check.finished()
        check._follow_tokens(Sample(Keys.objection(KEY, "beef", "f00d"), "", b""))
        if began == 0.5:
            with pytest.raises(NameTaken):
                check.finished()
        assert check.is_contested(net.session) == (began == 0.5)


@pytest.mark.mechanism("name ownership")
@pytest.mark.system
def test_real_router_knows_owners_of_names(patient_router: RouterProcess):
    """Links to a router that is stopped outlive the questions: nothing but a missing answer says so."""
    router, timing = patient_router, OwnershipTiming(vanish_s=0.0, answer_s=0.5)
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
