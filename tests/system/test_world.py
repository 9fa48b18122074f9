"""The twin service in real processes: a run in one world, its orders, its death, robots of other processes in it."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from experiments.real_time.conductor import orders
from experiments.recording import playback
from tests.conftest import RouterProcess
from tests.system.lab import (
    NEAR,
    NEAR_TRIANGLE,
    Flight,
    Looking,
    RobotProcess,
    Watcher,
    WorldProcess,
    gone,
    typed,
    until,
)

pytestmark = pytest.mark.system

KEYS = Keys()
THREE = """
title = "three"
duration_s = 30.0
[arena]
size = [4.0, 4.0, 2.0]
[arena.obstacles.post]
radius = 0.1
at = [1.5, 1.5]
[robots.KH01]
kind = "khepera4"
body = "world"
start = [0.0, 0.0]
[robots.CF01]
kind = "crazyflie"
body = "world"
start = [0.0, 1.0]
hover = 0.6
[robots.TE01]
kind = "tello"
body = "world"
start = [-1.0, 1.0]
hover = 0.6
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "three.toml"
    made.write_text(THREE)
    return made


class Desk(Looking):
    """The world as an operator, and a robot's process, see it."""

    def __init__(self, endpoint: str) -> None:
        self.session = network.open_session([endpoint], name="desk")
        self._positions = pubsub.subscriber(self.session, KEYS.position("*"), 4096)
        self._worlds = pubsub.pose_subscriber(self.session, KEYS.world)
        self._events = pubsub.subscriber(self.session, KEYS.event)
        self._ranges = pubsub.subscriber(self.session, KEYS.ranges("*"))
        self.at: dict[str, messages.Position] = {}
        self.ranges: dict[str, messages.Ranges] = {}
        self.events: list[messages.Event] = []
        self.world: messages.WorldState | None = None
        self._seq = round(time.time() * 1e3)

    def look(self) -> None:
        for sample in network.received(self._positions.handler):
            position = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Position)
            self.at[position.robot] = position
        for sample in network.received(self._worlds.handler):
            self.world = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.WorldState)
        for sample in network.received(self._events.handler):
            self.events.append(messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Event))
        for sample in network.received(self._ranges.handler):
            ranges = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Ranges)
            self.ranges[ranges.robot] = ranges

    def x(self, name: str) -> list[float]:
        return list(self.at[name].position)

    def give(self, order: str, **fields: object) -> messages.WorldReply:
        return orders.send_world_order(self.session, KEYS, messages.WorldOrder(order, **fields))  # type: ignore[arg-type]

    def tell(self, name: str, action: str, **fields: object) -> None:
        self._seq += 1
        command = messages.Command(name, self._seq, time.time(), action, **fields)  # type: ignore[arg-type]
        self.session.put(KEYS.setpoint(name), messages.encode(command), encoding=messages.JSON)

    def drive_until(self, name: str, setpoint: tuple[float, ...], true: Callable[[], object], what: str) -> None:
        due = [0.0]

        def seen() -> object:
            if time.monotonic() > due[0]:
                due[0] = time.monotonic() + 0.02
                self.tell(name, "drive", setpoint=setpoint)
            return true()

        self.until(seen, what)

    def close(self) -> None:
        self.session.close()


@pytest.fixture
def desk(router: RouterProcess) -> Iterator[Desk]:
    made = Desk(router.endpoint)
    yield made
    made.close()


@pytest.fixture
def world(router: RouterProcess, desk: Desk, file: Path) -> Iterator[WorldProcess]:
    made = WorldProcess(router.endpoint, file)
    assert made.ready == (
        f"world ready: point-mass at 100 Hz carries KH01, CF01, TE01; mirrors none; realm park at {router.endpoint}"
    )
    desk.until(lambda: len(desk.at) == 3 and desk.world, "everybody is there")
    yield made
    assert made.process.returncode is not None or made.end() == 0


# ---------------------------------------------------------------------- a run


@pytest.mark.timeout(180)
def test_the_reference_experiment_forms_up_in_one_world(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(
        folder, "robotic-park", "--bodies", "world", "--case", "event", "--json", "--no-report",
        "--set", "duration_s=12", "--set", "timeline=[]", *NEAR,
    )  # fmt: skip
    flight.until_said(r"phase conductor: formation", 60.0)
    everyone = list(flight.children().values())
    assert "world" in flight.children()
    code, out = flight.finish(90.0)
    assert code == 0, flight.said()
    until(lambda: gone(everyone), "nothing is left")
    robots = json.loads(out)["cases"]["event"]["robots"]
    followers = {name: robot for name, robot in robots.items() if name != "TB01"}
    assert all(robot["acquired_s"] is not None and robot["lost"] == 0 for robot in followers.values()), followers
    trace = playback.read(folder / "event.mcap").trace
    assert np.isfinite(trace.true_position).all(axis=(1, 2)).mean() > 0.98, "the truth is known"
    last = trace.time > trace.time[-1] - 1.0
    rows = {name: row for row, name in enumerate(trace.robots)}
    for text, link in trace.plan.experiment.formation.links.items():
        one, _, other = text.split()
        apart = np.linalg.norm(trace.true_position[last, rows[one]] - trace.true_position[last, rows[other]], axis=1)
        assert np.abs(apart - (link if isinstance(link, float) else link.distance)).mean() < 0.03, text


@pytest.mark.mechanism("world: killed", "way out: Ctrl-C")
def test_killed_world_is_restarted_and_robots_continue(tmp_path: Path) -> None:
    """Until Ctrl-C, which lands everybody and leaves a valid recording."""
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--bodies", "world", "--case", "event", "--no-report", *NEAR_TRIANGLE)
    flight.until_said(r"phase conductor: formation", 60.0)
    everyone = list(flight.children().values())
    watcher = Watcher(flight.endpoint())
    desk = Desk(flight.endpoint())
    try:
        watcher.until(lambda: len(watcher.state) == 3, "they are there")
        begun = watcher.state["CF01"].stamp
        watcher.until(lambda: watcher.state["CF01"].stamp > begun + 0.5, "they are on their way")
        before = dict(watcher.state)
        flight.children()["world"].kill()
        flight.until_said(r"world conductor: the world ended \(killed by SIGKILL\); started again")
        again = time.time()
        assert {state.phase for state in before.values()} == {"running"}
        desk.until(lambda: all(desk.at[name].stamp > again + 0.5 for name in before), "they are in the next world")
        everyone += list(flight.children().values())
        flight.signal(signal.SIGINT)
        assert flight.finish()[0] == 130
        assert gone(everyone)
    finally:
        watcher.close()
        desk.close()
    read = playback.read(folder / "event.mcap")
    assert read.complete
    with (folder / "event.mcap").open("rb") as stream:
        assert make_reader(stream).get_summary() is not None
    assert typed(folder / "event.mcap", "/CF01/status")[-1].phase == "done"
    trace = read.trace
    truth, when = trace.true_position, trace.time
    known = np.isfinite(truth).all(axis=(1, 2))
    assert known[when > again + 0.2 - read.started].any()
    step = np.linalg.norm(np.diff(truth[known], axis=0), axis=2)
    assert step.max() < 0.05, "nobody jumps"
    middle = (when > 0.5) & (when < again + 0.4 - read.started) & known
    assert truth[middle][:, list(trace.robots).index("CF01"), 2].min() > 0.25, "it holds in the air"
    assert not [event for event in trace.events if event.kind == "robot" and "lost" in event.text]


def test_climbs_and_landings_continue_in_the_next_world(router: RouterProcess, file: Path) -> None:
    world = WorldProcess(router.endpoint, file)
    watcher = Watcher(router.endpoint)
    robots = RobotProcess(router.endpoint, file, "CF01", "TE01")
    both = ("CF01", "TE01")

    def height(name: str) -> float:
        return watcher.state[name].position[2] if name in watcher.state else 0.0

    def again() -> WorldProcess:
        world.kill()
        made = WorldProcess(router.endpoint, file)
        assert "CF01" in made.ready.rpartition(";")[2], "it asks them where they were"
        return made

    try:
        watcher.until(lambda: all(watcher.phase(name) == "ready" for name in both), "they are ready")
        for name in both:
            assert watcher.order(name, messages.Order("takeoff")).ok
        watcher.until(lambda: min(map(height, both)) > 0.25, "they climb")
        world = again()
        watcher.until(lambda: all(watcher.phase(name) == "airborne" for name in both), "they arrive")
        assert min(map(height, both)) > 0.54
        for name in both:
            assert watcher.order(name, messages.Order("land")).ok
        watcher.until(lambda: max(map(height, both)) < 0.4, "they sink")
        world = again()
        watcher.until(lambda: all(watcher.phase(name) == "done" for name in both), "they are down")
        assert max(map(height, both)) < 0.06
    finally:
        robots.end()
        world.end()
        watcher.close()


# ---------------------------------------------------------------------- orders


def test_pause_resume_and_reset(world: WorldProcess, desk: Desk) -> None:
    assert desk.give("pause") == messages.WorldReply(True, True, pytest.approx(0.0, abs=60.0))  # type: ignore[arg-type]
    paused = desk.give("pause").time
    stamp = desk.at["KH01"].stamp
    desk.until(lambda: desk.world and desk.world.paused, "it says so")
    desk.drive_until("KH01", (0.2, 0.0, 0.0, 0.0), lambda: desk.at["KH01"].stamp > stamp + 0.5, "stamps stay fresh")
    assert desk.x("KH01") == [0.0, 0.0, 0.0]
    assert desk.give("resume") == messages.WorldReply(True, False, pytest.approx(paused, abs=0.05))  # type: ignore[arg-type]
    desk.drive_until("KH01", (0.2, 0.0, 0.0, 0.0), lambda: desk.x("KH01")[0] > 0.1, "it goes on")
    assert desk.give("reset", name="KH01").ok
    desk.until(lambda: np.abs(desk.x("KH01")).max() < 0.03, "it is back, but for commands that were on their way")
    refused = desk.give("reset", name="KH1")
    assert (refused.ok, refused.reason) == (False, "there is no 'KH1' in this world; did you mean 'KH01'?")
    assert desk.give("reset").ok


def test_what_a_world_cannot_use_is_counted(world: WorldProcess, desk: Desk) -> None:
    for _ in range(2):
        desk.tell("CF09", "takeoff", height=0.5)
    desk.until(lambda: desk.world and desk.world.refused == 2, "both are counted")
    assert [event.text for event in desk.events if "CF09 gets commands" in event.text] == [
        "CF09 gets commands, but is not in this world: start the world with the experiment that has it"
    ]
    desk.session.put(KEYS.setpoint("KH01"), b"{", encoding=messages.JSON)
    desk.session.put(
        KEYS.setpoint("KH01"), messages.encode(messages.Command("KH02", 1, 1.0, "stop")), encoding=messages.JSON
    )
    desk.until(lambda: desk.world and desk.world.malformed == 2, "nonsense is counted")


# ---------------------------------------------------------------------- robots


def test_robots_without_commands_hold_and_then_land(world: WorldProcess, desk: Desk) -> None:
    for name in ("CF01", "TE01"):
        desk.tell(name, "takeoff", height=0.6)
    desk.until(lambda: min(desk.x("CF01")[2], desk.x("TE01")[2]) > 0.59, "they are up")
    desk.tell("TE01", "drive", setpoint=(0.4, 0.0, 0.0, 0.0))
    desk.tell("CF01", "drive", setpoint=(1.0, 1.0, 0.6, 0.0))
    desk.until(lambda: desk.x("TE01")[0] > -0.95, "it moves")
    desk.until(lambda: desk.x("TE01")[2] == 0.0 and desk.x("CF01")[2] == 0.0, "they land")
    assert -0.95 < desk.x("TE01")[0] < -0.55, "half a second at 0.4 m/s, and what it takes to stop"
    assert 0.2 < desk.x("CF01")[0] < 0.6, "where it was when it had not been told anything for half a second"
    assert {event.source for event in desk.events if event.kind == "silent"} == {"CF01", "TE01"}


def test_second_world_and_useless_world_are_refused(world: WorldProcess, router: RouterProcess, file: Path) -> None:
    second = WorldProcess(router.endpoint, file)
    assert second.wait() == 2
    assert second.ready.startswith("zenpark: a world runs in the realm 'park' already: end it first, choose another")
    none = WorldProcess(router.endpoint, "triangle")
    assert none.wait() == 2
    assert "no robot of this experiment lives in a world" in none.ready
    unknown = WorldProcess(router.endpoint, file, "--engine", "pymonk")
    assert unknown.wait() == 2
    assert "did you mean 'pymunk'?" in unknown.ready


def test_world_ordered_to_end_waits_for_robots(world: WorldProcess, router: RouterProcess, file: Path) -> None:
    watcher = Watcher(router.endpoint)
    robot = RobotProcess(router.endpoint, file, "CF01", lifeline=False)
    try:
        watcher.until(lambda: watcher.phase("CF01") == "ready", "it is ready")
        assert watcher.order("CF01", messages.Order("takeoff")).ok
        watcher.until(lambda: watcher.phase("CF01") == "airborne", "it is up")
        world.process.terminate()
        assert robot.end() == 0
        watcher.until(lambda: watcher.phase("CF01") == "done", "it landed in the world that was asked to end")
        assert world.wait(30) == 0
    finally:
        watcher.close()


def test_a_robot_of_another_process_is_seen(router: RouterProcess, desk: Desk, tmp_path: Path) -> None:
    file = tmp_path / "mixed.toml"
    file.write_text(
        'title = "mixed"\nduration_s = 30.0\n'
        "[world]\nsensor_noise = 0.0\n"
        '[robots.TB01]\nkind = "turtlebot3"\nbody = "world"\nstart = [0.0, 0.0]\n'
        '[robots.TB02]\nkind = "turtlebot3"\nstart = [1.0, 0.0, 3.141592653589793]\nranges = "world"\n'
    )
    world = WorldProcess(router.endpoint, file)
    assert "carries TB01; mirrors TB02" in world.ready
    desk.until(lambda: desk.world, "it is there")
    robot = None
    try:
        desk.until(lambda: "TB01" in desk.ranges, "it looks ahead")
        assert desk.ranges["TB01"].distance[0] == pytest.approx(2.0, abs=1e-3), "the wall"
        robot = RobotProcess(router.endpoint, file, "TB02")
        desk.until(lambda: desk.world and desk.world.mirrored == ["TB02"], "the other is there")
        desk.until(lambda: desk.ranges["TB01"].distance[0] == pytest.approx(1.0 - 0.105, abs=1e-3), "it is seen")
        desk.until(lambda: desk.ranges["TB02"].distance[0] == pytest.approx(1.0 - 0.105, abs=1e-3), "and sees")
        robot.kill()
        robot = None
        desk.until(lambda: desk.ranges["TB01"].distance[0] == pytest.approx(2.0, abs=1e-3), "gone, it is no obstacle")
        assert desk.world is not None
        desk.until(lambda: desk.world and desk.world.mirrored == [], "and is said to be")
    finally:
        if robot is not None:
            robot.end()
        world.end()
