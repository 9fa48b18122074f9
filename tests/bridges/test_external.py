"""The external body: what it says on the network, and what it believes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from math import isnan, nan
from types import SimpleNamespace

import pytest

from agents.body.interface import UNANSWERED, BodyError, BodyRequest, Disturbance
from agents.body.kinds import KINDS
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from agents.safety.detection import LOWEST_DESCENT_M_S
from agents.vectors import NO_SETPOINT, ZERO, Setpoint, Vector
from bridges import measured_flight
from bridges.external import ExternalBody
from tests.conftest import RouterProcess
from tests.waiting import until

KEYS = Keys()


PLACES = {"KH01": (-0.6, -0.5), "KH02": (0.6, -0.5), "CF01": (0.1, 0.6)}


ALONE = {"TE01": (0.0, 0.0)}


ROWS = {"CF01": "crazyflie", "TE01": "tello", "KH01": "khepera4"}


def request(endpoint: str, rows: dict[str, str] = ROWS, **device: object) -> BodyRequest:
    count = len(rows)
    return BodyRequest(
        names=tuple(rows),
        kinds=tuple(KINDS[kind] for kind in rows.values()),
        addresses=("external",) * count,
        start=(ZERO,) * count,
        yaw=(0.25,) * count,
        rate_hz=100.0,
        seeds=(1,) * count,
        disturbance=(Disturbance(),) * count,
        external=(False,) * count,
        device=(device,) * count,
        endpoints=(endpoint,),
        keys=KEYS,
    )


class FarEnd:
    """The other side, by hand: where each robot is, and what it was told."""

    def __init__(self, endpoint: str) -> None:
        self.session = network.open_session([endpoint], name="far end")
        self._subscriber = pubsub.subscriber(self.session, KEYS.setpoint("*"), 4096)
        self.told: list[messages.Command] = []
        self.place = {name: [0.0, 0.0, 0.0] for name in ROWS}
        self._quiet = threading.Event()
        self._thread: threading.Thread | None = None

    def say(self, name: str, position: list[float], *, stamp: float | None = None, yaw: float | None = 0.5) -> None:
        text = {"robot": name, "stamp": time.time() if stamp is None else stamp, "position": position, "yaw": yaw}
        self.session.put(KEYS.position(name), json.dumps(text), encoding="application/json")

    def talk(self, *names: str) -> None:
        """Says where they are, 100 times a second, in a thread, until `hush`."""

        def run() -> None:
            while not self._quiet.wait(0.01):
                for name in names:
                    self.say(name, self.place[name])

        self._quiet.clear()
        self._thread = threading.Thread(target=run)
        self._thread.start()

    def hush(self) -> None:
        self._quiet.set()
        if self._thread is not None:
            self._thread.join()

    def look(self) -> list[messages.Command]:
        for sample in network.received(self._subscriber.handler):
            self.told.append(messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Command))
        return self.told

    def actions(self, name: str, action: str) -> list[messages.Command]:
        return [command for command in self.look() if (command.robot, command.action) == (name, action)]

    def close(self) -> None:
        self.hush()
        self.session.close()


@pytest.fixture
def far(router: RouterProcess) -> Iterator[FarEnd]:
    made = FarEnd(router.endpoint)
    yield made
    made.close()


@pytest.fixture
def body(router: RouterProcess, far: FarEnd) -> Iterator[ExternalBody]:
    """Open, at the other end of `far`, which talks."""
    far.talk(*ROWS)
    made = ExternalBody(request(router.endpoint))
    made.open()
    yield made
    made.close()


class Drive:
    """Reads and commands, as the runtime does."""

    def __init__(self, body: ExternalBody) -> None:
        self.body = body
        self.zero = time.monotonic()

    def until(
        self, true: Callable[[], object], what: str, setpoints: Sequence[Setpoint] = (NO_SETPOINT,) * len(ROWS)
    ) -> None:
        def tick() -> object:
            self.states = self.body.read(time.monotonic() - self.zero)
            self.body.command(setpoints)
            return true()

        until(tick, what)

    @property
    def flying(self) -> list[bool]:
        return [state.flying for state in self.states]

    @property
    def notes(self) -> list[str]:
        return [state.note for state in self.states]

    @property
    def lowest(self) -> float:
        """Height of the lower of both drones [m]."""
        return min(state.position[2] for state in self.states[:2])


# ---------------------------------------------------------------------- opening


@pytest.mark.system
def test_missing_positions_are_named_with_reasons(router: RouterProcess, far: FarEnd) -> None:
    def refusal(rows: dict[str, str]) -> str:
        body = ExternalBody(request(router.endpoint, rows), 0.5)
        with pytest.raises(BodyError) as caught:
            body.open()
        return str(caught.value)

    far.talk("CF01")
    lines = refusal({"CF01": "crazyflie", "TE01": "tello"})
    assert lines == (
        "TE01: nothing is published on park/TE01/position: is the simulator running and connected to "
        f"{router.endpoint}?"
    )
    far.hush()
    for message, words in (
        ({"stamp": 12.5, "yaw": None}, "stamps are UTC seconds, not simulation time"),
        ({"stamp": time.time() - 7.0, "yaw": None}, "s ago by its stamp"),
        ({"stamp": None, "yaw": None}, "no yaw, without which a robot on wheels cannot steer"),
    ):
        stop = threading.Event()

        def run(message: dict[str, float | None] = message, stop: threading.Event = stop) -> None:
            while not stop.wait(0.02):
                far.say("KH01", [0.0, 0.0, 0.0], **message)  # type: ignore[arg-type]

        thread = threading.Thread(target=run)
        thread.start()
        try:
            assert words in refusal({"KH01": "khepera4"})
        finally:
            stop.set()
            thread.join()


@pytest.mark.system
def test_bad_positions_settings_and_routers_are_named(router: RouterProcess, far: FarEnd) -> None:
    body = ExternalBody(request(router.endpoint, {"CF01": "crazyflie"}), 0.5)
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.02):
            far.session.put(KEYS.position("CF01"), b'{"x": 1.0}', encoding="application/json")

    thread = threading.Thread(target=run)
    thread.start()
    try:
        with pytest.raises(BodyError, match="samples on park/CF01/position are not positions: not a Position"):
            body.open()
    finally:
        stop.set()
        thread.join()
    with pytest.raises(BodyError, match=r"CF01: device: .*`rate`.*has no settings"):
        ExternalBody(request(router.endpoint, {"CF01": "crazyflie"}, rate=5))
    with pytest.raises(BodyError, match="CF01: no router answers at"):
        ExternalBody(request(free_endpoint(preferred_port=0), {"CF01": "crazyflie"}), 0.5).open()


# ---------------------------------------------------------------------- what it believes


@pytest.mark.system
def test_poses_are_as_published_and_grow_old(body: ExternalBody, far: FarEnd) -> None:
    drive = Drive(body)
    far.hush()
    drive.until(lambda: drive.notes[0], "what was said before is old")
    utc, clock = time.time(), time.monotonic() - drive.zero
    for step in range(30):  # half a metre a second along x, with one frame that is elsewhere
        jump = 3.0 if step == 20 else 0.0
        far.say("CF01", [0.005 * step + jump, 0.0, 0.0], stamp=utc - 0.29 + 0.01 * step, yaw=None)
    drive.until(lambda: drive.states[0].position[0] >= 0.14, "the last of them is heard")
    state = drive.states[0]
    assert state.position == pytest.approx((0.145, 0.0, 0.0), abs=1e-12)
    assert state.velocity == pytest.approx((0.5, 0.0, 0.0), abs=0.05)
    assert state.time == pytest.approx(clock, abs=0.01)
    for state in drive.states:
        assert state.yaw == pytest.approx(0.5)
        assert all(map(isnan, (*state.true_position, state.battery)))
        assert not state.flying
    old = [state.time for state in drive.states]
    drive.until(lambda: all("no position for" in note for note in drive.notes), "they grow old")
    assert [state.time for state in drive.states] == pytest.approx(old, abs=0.02)
    far.session.put(KEYS.position("CF01"), b"\xff\x00", encoding="application/json")
    far.say("CF01", [float("nan"), 0.0, 0.0])
    far.say("CF01", [0.0, 0.0, 0.0], stamp=time.time() + 3600.0)
    far.session.put(KEYS.position("CF01"), b'{"robot":"KH01","stamp":1.0,"position":[0,0,0]}', encoding=messages.JSON)
    drive.until(lambda: "4 positions refused" in drive.notes[0], "nonsense is counted")
    assert drive.states[0].position == pytest.approx((0.145, 0.0, 0.0), abs=1e-12)
    far.talk(*ROWS)
    drive.until(lambda: drive.states[0].position[0] == 0.0 and "no position" not in drive.notes[0], "it is back")


@pytest.mark.system
def test_what_robots_see_comes_from_the_far_end(body: ExternalBody, far: FarEnd) -> None:
    drive = Drive(body)
    drive.until(lambda: True, "a first look")
    assert all(state.scan is None for state in drive.states)

    def say(name: str, *distance: float | None, robot: str | None = None) -> None:
        angles = [0.1 * k for k in range(len(distance))]
        sweep = messages.Ranges(robot or name, time.time(), angles, [0.0] * len(distance), list(distance))
        far.session.put(KEYS.ranges(name), messages.encode(sweep), encoding=messages.JSON)

    say("KH01", 0.25, None, 1.5)
    say("CF01", 2.0)
    drive.until(lambda: drive.states[0].scan is not None and drive.states[2].scan is not None, "they are heard")
    first, second, third = (state.scan for state in drive.states)
    assert first is not None
    assert second is None
    assert third is not None
    assert first.distance == (2.0,)
    assert third.distance == (0.25, pytest.approx(nan, nan_ok=True), 1.5)
    assert third.bearing == pytest.approx((0.0, 0.1, 0.2))
    assert third.time == pytest.approx(time.monotonic() - drive.zero, abs=0.5)
    say("KH01", 0.1, robot="TE01")
    drive.until(lambda: any("1 sweeps refused" in note for note in drive.notes), "nonsense is counted")
    drive.until(lambda: all(state.scan is None for state in drive.states), "what is old is forgotten")


# ---------------------------------------------------------------------- what it says


@pytest.mark.system
def test_restarted_simulator_hears_orders_under_way(body: ExternalBody, far: FarEnd) -> None:
    """The twin service was killed while one robot climbed and the other landed; its successor knows of neither."""
    drive = Drive(body)
    drive.until(lambda: True, "a first look")
    body.takeoff([0, 1], [0.6, 0.8])
    far.place["CF01"] = far.place["TE01"] = [0.0, 0.0, 0.3]
    drive.until(lambda: drive.lowest > 0.2, "they are up")
    body.land([1])
    drive.until(lambda: far.actions("TE01", "land"), "one lands")
    climb, landing = far.actions("CF01", "takeoff")[-1].seq, far.actions("TE01", "land")[-1].seq
    far.hush()
    drive.until(lambda: any("no position" in note for note in drive.notes), "silence is noticed")
    assert drive.flying == [True, True, False]
    assert far.actions("TE01", "drive") == []
    told = len(far.actions("CF01", "takeoff"))
    far.talk(*ROWS)
    drive.until(lambda: len(far.actions("CF01", "takeoff")) >= told + 5, "it is told again to climb")
    assert {command.seq for command in far.actions("CF01", "takeoff")} == {climb}
    assert {command.seq for command in far.actions("TE01", "land")} == {landing}
    setpoints = [(0.0, 0.0, 0.6, 0.0), NO_SETPOINT, NO_SETPOINT]
    drive.until(lambda: far.actions("CF01", "drive"), "it is steered", setpoints)
    told = len(far.actions("CF01", "takeoff"))
    driven = len(far.actions("CF01", "drive"))
    drive.until(lambda: len(far.actions("CF01", "drive")) > driven + 40, "it is steered on", setpoints)
    assert len(far.actions("CF01", "takeoff")) <= told + 1, "what is steered need not climb"


@pytest.mark.system
def test_without_a_world_it_says_what_to_start(router: RouterProcess) -> None:
    asked = replace(request(router.endpoint, {"CF01": "crazyflie"}), addresses=("world",))
    with pytest.raises(BodyError) as caught:
        ExternalBody(asked, 0.3).open()
    assert str(caught.value) == (
        "CF01: nothing is published on park/CF01/position: is `./zenpark world serve` with this experiment running and "
        f"connected to {router.endpoint}?"
    )


def test_numbers_after_standstill_exceed_those_of_successor(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(time, "clock_gettime", lambda _clock: now[0])
    monkeypatch.setattr(time, "time", lambda: 1.7e9 + now[0])

    def process() -> ExternalBody:
        made = ExternalBody(request("tcp/127.0.0.1:1", {"CF01": "crazyflie"}))
        monkeypatch.setattr(made, "_read_positions", lambda: None)
        positions = SimpleNamespace(ahead=[0.0], malformed=[0])
        ranges = SimpleNamespace(replace_scans=lambda *_: None, malformed=0)
        monkeypatch.setattr(made, "_positions", positions, raising=False)
        monkeypatch.setattr(made, "_ranges", ranges, raising=False)
        return made

    def numbers(of: ExternalBody) -> list[int]:
        seen: list[int] = []
        monkeypatch.setattr(of, "_put", lambda _row, command: seen.append(command.seq))
        for _ in range(100):
            now[0] += 0.01
            of.read(now[0] - 1000.0)
            of.command([(0.0, 0.0, 0.0, 0.0)])
        return seen

    first = process()
    before = numbers(first)
    assert [later - sooner for sooner, later in pairwise(before)] == [1] * 99
    now[0] += 30.0  # it stands still; another process takes the name, and ends
    between = numbers(process())
    assert numbers(first)[0] > between[-1] > before[-1]


@pytest.mark.system
def test_setpoints_are_sent_once_nan_never(body: ExternalBody, far: FarEnd) -> None:
    for step in range(10):
        x = 4.0 * step
        body.command([(x, x + 1.0, x + 2.0, x + 3.0), NO_SETPOINT, (x + 200.0, 0.0, 0.0, 0.0)])
    until(lambda: len(far.look()) >= 20, "they arrive")
    for name, first in (("CF01", 0.0), ("KH01", 200.0)):
        drives = far.actions(name, "drive")
        given = [command.setpoint for command in drives if command.setpoint is not None]
        assert [setpoint[0] for setpoint in given] == [first + 4.0 * step for step in range(10)]
        assert [command.seq - drives[0].seq for command in drives] == list(range(10))
        assert drives[0].seq > 1e3 * (time.time() - 60.0)  # and grow from one process to the next
        assert all(abs(command.stamp - time.time()) < 5.0 for command in drives)
    assert far.actions("TE01", "drive") == []


@pytest.mark.mechanism("external body: orders are repeated")
@pytest.mark.system
def test_orders_are_repeated_until_obeyed(body: ExternalBody, far: FarEnd) -> None:
    drive = Drive(body)
    drive.until(lambda: True, "a first look")
    rows = range(3)
    body.takeoff(rows, [0.6, 0.8, 0.0])
    drive.until(lambda: len(far.actions("CF01", "takeoff")) >= 3, "takeoff is repeated")
    assert drive.flying == [True, True, False]
    first = far.actions("CF01", "takeoff")[0].seq
    assert {(c.seq, c.height) for c in far.actions("CF01", "takeoff")} == {(first, 0.6)}
    assert {c.height for c in far.actions("TE01", "takeoff")} == {0.8}
    assert far.actions("KH01", "takeoff") == []
    far.place["CF01"] = [0.0, 0.0, 0.3]
    far.place["TE01"] = [0.0, 0.0, 0.3]
    drive.until(lambda: drive.lowest > 0.2, "they are up")
    told = len(far.actions("CF01", "takeoff"))
    drive.until(lambda: len(far.actions("CF01", "takeoff")) >= told + 5, "another may answer half-way up")
    silent = len(far.actions("CF01", "takeoff"))
    again = len(far.actions("TE01", "takeoff"))

    body.land(rows)
    drive.until(lambda: len(far.actions("CF01", "land")) >= 3, "land is repeated")
    assert len(far.actions("CF01", "takeoff")) - silent <= 1
    assert len(far.actions("TE01", "takeoff")) - again <= 1
    assert drive.flying == [True, True, False]
    assert {c.seq for c in far.actions("CF01", "land")} == {first + 1}
    assert len(far.actions("KH01", "land")) >= 1
    far.place["CF01"] = [0.0, 0.0, 0.01]
    drive.until(lambda: not drive.flying[0], "one is down")
    assert drive.flying == [False, True, False]

    body.stop([1, 2])
    body.land([1, 2])  # a stop is the last word
    moving = [(1.0, 1.0, 1.0, 1.0)] * 3
    drive.until(lambda: len(far.actions("TE01", "stop")) >= 5, "stop is repeated", moving)
    assert drive.flying == [False, True, False]  # it is seen where it was
    drive.until(lambda: UNANSWERED in drive.notes[1], "it is said", moving)
    assert UNANSWERED not in drive.notes[2]  # it stands
    far.place["TE01"] = [0.0, 0.0, 0.0]
    drive.until(lambda: not any(drive.flying), "it has come down", moving)
    assert not any(drive.notes)
    assert {c.seq for c in far.actions("TE01", "stop")} == {first + 2}
    assert len(far.actions("KH01", "stop")) >= 5
    assert far.actions("TE01", "drive") == far.actions("KH01", "drive") == []  # a stop is the last word
    assert len(far.actions("CF01", "drive")) >= 5


@pytest.mark.system
def test_unseen_landing_ends_at_last(body: ExternalBody, far: FarEnd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured_flight, "LANDING_S", 1.0)
    drive = Drive(body)
    far.place["CF01"] = far.place["TE01"] = [0.0, 0.0, 0.0]
    drive.until(lambda: True, "a first look")
    body.takeoff([0, 1], [0.6, 0.6])
    far.place["CF01"] = far.place["TE01"] = [0.0, 0.0, 0.5]
    drive.until(lambda: drive.lowest > 0.4, "they are up")
    far.hush()
    far.talk("TE01")
    body.land([0, 1])
    told = time.monotonic()
    drive.until(lambda: not drive.flying[0], "nobody has seen it for long")
    assert time.monotonic() - told > 0.5 / LOWEST_DESCENT_M_S, "from 0.5 m it may take so long"
    assert drive.flying[1]  # this one is seen, and does not come down
    assert drive.notes[0].startswith("no position for")


@pytest.mark.mechanism("external body: router loss")
@pytest.mark.system
def test_it_outlives_its_router(body: ExternalBody, far: FarEnd, router: RouterProcess) -> None:
    drive = Drive(body)
    drive.until(lambda: True, "a first look")
    router.kill()
    drive.until(lambda: drive.notes[0], "silence is noticed", [(1.0, 1.0, 1.0, 1.0)] * 3)
    before = len(far.look())
    router.start()
    drive.until(lambda: not any(drive.notes), "it is back", [(1.0, 1.0, 1.0, 1.0)] * 3)
    drive.until(lambda: len(far.look()) > before, "it is heard again", [(1.0, 1.0, 1.0, 1.0)] * 3)


def test_no_take_off_after_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    body, said = ExternalBody(request("tcp/127.0.0.1:1")), list[str]()
    monkeypatch.setattr(body, "_put", lambda _, command: said.append(command.action))
    body.stop([0])
    body.takeoff([0], [1.0])
    body.land([0])
    body.command([NO_SETPOINT] * 3)
    assert said == ["stop", "stop"]


def test_pose_of_wheels_is_as_old_as_yaw(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that steers by a yaw that is not told any more has no position; one in the air does."""
    body, samples, now = ExternalBody(request("tcp/127.0.0.1:1")), list[tuple[int, float, Vector, float]](), [0.0]
    body._positions = SimpleNamespace(  # type: ignore[assignment]
        receive=lambda *_: samples, ahead=[nan] * 3, malformed=[0] * 3, trouble=[""] * 3
    )
    body._ranges = SimpleNamespace(replace_scans=lambda *_: None, malformed=0)  # type: ignore[assignment]
    monkeypatch.setattr(body, "_now", lambda: now[0])
    for k in range(300):
        now[0] = 0.01 * k
        yaw = 2.0 if k <= 100 else nan
        samples[:] = [(row, now[0], ZERO, yaw) for row in range(3)]
        states = body.read(now[0])
        if k == 140:
            assert states[2].time == pytest.approx(1.4)
    assert [state.yaw for state in states] == [2.0] * 3
    assert [state.time for state in states] == pytest.approx([2.99, 2.99, 1.0])
    assert [state.note for state in states] == ["", "", "no yaw for 2 s"]
