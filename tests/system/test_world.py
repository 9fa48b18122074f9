"""The twin service in real processes: its orders, its death, robots of other processes in it."""

import math
import time

import numpy as np
import pytest

from agents.body.kinds import KINDS
from agents.network import messages, pubsub
from agents.network.keys import Keys
from experiments.real_time.conductor import orders
from tests.system.lab import NEAR_TRIANGLE, Flight, RobotProcess, Watcher, WorldProcess, gone, typed

pytestmark = pytest.mark.system

KEYS = Keys()
THREE = """
title = "three"
duration_s = 30.0
[robots]
KH01 = { kind = "khepera4", body = "world", start = [0.0, 0.0] }
CF01 = { kind = "crazyflie", body = "world", start = [0.0, 1.0], hover = 0.6 }
TE01 = { kind = "tello", body = "world", start = [-1.0, 1.0], hover = 0.6 }
"""


@pytest.fixture
def three_file(tmp_path):
    made = tmp_path / "three.toml"
    made.write_text(THREE)
    return made


class Desk(Watcher):
    """The world as an operator, and a robot's process, see it."""

    def __init__(self, endpoint):
        super().__init__(endpoint)
        self.at = self.newest(KEYS.position("*"), messages.Position)
        self.ranges = self.newest(KEYS.ranges("*"), messages.Ranges)
        self.events = self.every(KEYS.world_event, messages.Event)
        self.worlds = self.every(KEYS.world, messages.WorldState, pubsub.pose_subscriber)
        self._seq = round(time.time() * 1e3)

    @property
    def world(self):
        return self.worlds[-1] if self.worlds else None

    def x(self, name):
        return list(self.at[name].position)

    def order_world(self, order, **fields):
        return orders.send_world_order(self.session, KEYS, messages.WorldOrder(order, **fields))

    def tell(self, name, action, **fields):
        self._seq += 1
        command = messages.Command(name, self._seq, time.time(), action, **fields)
        self.session.put(KEYS.setpoint(name), messages.encode(command), encoding=messages.JSON)

    def drive_until(self, name, setpoint, true, what):
        due = [0.0]

        def seen():
            if time.monotonic() > due[0]:
                due[0] = time.monotonic() + 0.02
                self.tell(name, "drive", setpoint=setpoint)
            return true()

        self.until(seen, what)


@pytest.fixture
def desk(router):
    with Desk(router.endpoint) as made:
        yield made


@pytest.fixture
def world(router, desk, three_file):
    carries = "world ready: point-mass at 100 Hz carries KH01, CF01, TE01; mirrors none"
    with WorldProcess(router.endpoint, three_file) as made:
        assert made.ready == f"{carries}; realm park at {router.endpoint}"
        desk.until(lambda: len(desk.at) == 3 and desk.world, "everybody is there")
        yield made


@pytest.mark.mechanism("world: killed", "way out: Ctrl-C")
def test_killed_world_is_restarted_and_robots_continue(tmp_path):
    """Until Ctrl-C, which lands everybody and leaves a valid recording."""
    flight = Flight(tmp_path / "run", "triangle", "--bodies", "world", "--case", "event", *NEAR_TRIANGLE)
    flight.until_flown()
    everyone = list(flight.children().values())
    with Desk(flight.endpoint()) as desk:
        desk.until(lambda: len(desk.state) == 3, "they are there")
        begun = desk.state["CF01"].stamp
        desk.until(lambda: desk.state["CF01"].stamp > begun + 0.5, "they are on their way")
        assert {state.phase for state in desk.state.values()} == {"running"}
        flight.children()["world"].kill()
        flight.until_said(r"world conductor: the world ended \(killed by SIGKILL\); started again")
        again = time.time()
        desk.until(lambda: all(desk.at[name].stamp > again + 0.5 for name in desk.state), "they are in the next world")
        everyone += list(flight.children().values())
    flight.interrupt()
    assert gone(everyone)
    read = flight.read()
    assert read.complete
    assert typed(flight.folder / "event.mcap", "/CF01/status")[-1].phase == "done"
    trace, truth, when = read.trace, read.trace.true_position, read.trace.time
    known = np.isfinite(truth).all(axis=(1, 2))
    assert known[when > again + 0.2 - read.started].any()
    assert np.linalg.norm(np.diff(truth[known], axis=0), axis=2).max() < 0.05, "nobody jumps"
    middle = (when > 0.5) & (when < again + 0.4 - read.started) & known
    assert truth[middle][:, list(trace.robots).index("CF01"), 2].min() > 0.25, "it holds in the air"
    assert not [event for event in trace.events if event.kind == "robot" and "lost" in event.text]


def test_pause_resume_and_reset(world, desk):
    assert desk.order_world("pause") == messages.WorldReply(True, True, pytest.approx(0.0, abs=60.0))
    paused = desk.order_world("pause").time
    stamp = desk.at["KH01"].stamp
    desk.until(lambda: desk.world.paused, "it says so")
    desk.drive_until("KH01", (0.2, 0.0, 0.0, 0.0), lambda: desk.at["KH01"].stamp > stamp + 0.5, "stamps stay fresh")
    assert desk.x("KH01") == [0.0, 0.0, 0.0]
    assert desk.order_world("resume") == messages.WorldReply(True, False, pytest.approx(paused, abs=0.05))
    desk.drive_until("KH01", (0.2, 0.0, 0.0, 0.0), lambda: desk.x("KH01")[0] > 0.1, "it goes on")
    assert desk.order_world("reset", name="KH01").ok
    desk.until(lambda: np.abs(desk.x("KH01")).max() < 0.03, "it is back, but for commands that were on their way")
    refused = desk.order_world("reset", name="KH1")
    assert (refused.ok, refused.reason) == (False, "there is no 'KH1' in this world; did you mean 'KH01'?")
    assert desk.order_world("reset").ok


def test_what_a_world_cannot_use_is_counted(world, desk):
    for _ in range(2):
        desk.tell("CF09", "takeoff", height=0.5)
    desk.until(lambda: desk.world.refused == 2, "both are counted")
    assert sum("CF09 gets commands" in event.text for event in desk.events) == 1
    for nonsense in (b"{", messages.encode(messages.Command("KH02", 1, 1.0, "stop"))):
        desk.session.put(KEYS.setpoint("KH01"), nonsense, encoding=messages.JSON)
    desk.until(lambda: desk.world.malformed == 2, "nonsense is counted")


def test_robots_without_commands_hold_and_then_land(world, desk):
    for name in ("CF01", "TE01"):
        desk.tell(name, "takeoff", height=0.6)
    desk.until(lambda: min(desk.x("CF01")[2], desk.x("TE01")[2]) > 0.59, "they are up")
    desk.tell("TE01", "drive", setpoint=(0.4, 0.0, 0.0, 0.0))
    desk.tell("CF01", "drive", setpoint=(1.0, 1.0, 0.6, 0.0))
    desk.until(lambda: desk.x("TE01")[0] > -0.95, "it moves")
    desk.until(lambda: desk.x("TE01")[2] == 0.0 and desk.x("CF01")[2] == 0.0, "they land")
    assert -0.95 < desk.x("TE01")[0] < -0.55, "half a second at 0.4 m/s, and what it takes to stop"
    assert 0.2 < desk.x("CF01")[0] < 0.6, "where it was when it had not been told anything for half a second"
    assert {event.source for event in desk.events} == {"world"}
    assert {event.text.split()[0] for event in desk.events if event.kind == "silent"} == {"CF01", "TE01"}


@pytest.mark.usefixtures("world")
def test_second_world_and_useless_world_are_refused(router, three_file):
    for arguments, reason in (
        ((three_file,), "zenpark: a world runs in the realm 'park' already: end it first, choose another"),
        (("triangle",), "no robot of this experiment lives in a world"),
        ((three_file, "--engine", "pymonk"), "did you mean 'pymunk'?"),
    ):
        refused = WorldProcess(router.endpoint, *arguments)
        assert refused.wait() == 2
        assert reason in refused.ready


def test_world_ordered_to_end_waits_for_robots(world, router, desk, three_file):
    with RobotProcess(router.endpoint, three_file, "CF01") as robot:
        desk.take_off("CF01")
        world.process.terminate()
        assert robot.end() == 0
        desk.until_all("done", "CF01")  # it landed in the world that was asked to end
        assert world.wait(30) == 0


def test_a_robot_of_another_process_is_seen(router, desk, tmp_path):
    file = tmp_path / "mixed.toml"
    file.write_text(
        'title = "mixed"\nduration_s = 30.0\nworld.sensor_noise = 0.0\n[robots]\n'
        'TB01 = { kind = "turtlebot3", body = "world", start = [0.0, 0.0] }\n'
        'TB02 = { kind = "turtlebot3", start = [1.0, 0.0, 3.141592653589793], ranges = "world" }\n'
    )

    def seen(wanted, *robots):
        return all(desk.ranges[robot].distance[0] == pytest.approx(wanted, abs=1e-3) for robot in robots)

    with WorldProcess(router.endpoint, file) as world:
        assert "carries TB01; mirrors TB02" in world.ready
        desk.until(lambda: "TB01" in desk.ranges and desk.world, "it looks ahead")
        assert seen(2.0, "TB01"), "the wall"
        with RobotProcess(router.endpoint, file, "TB02") as robot:
            desk.until(lambda: desk.world.mirrored == ["TB02"], "the other is there")
            desk.until(lambda: seen(1.0 - 0.105, "TB01", "TB02"), "it is seen, and sees")
            robot.kill()
        desk.until(lambda: seen(2.0, "TB01") and desk.world.mirrored == [], "gone, it is no obstacle, and said to be")


MIXED = """
title = "TB01 stands in the way of KH01, which sees it"
duration_s = 40.0   # the test ends the run when the twin has arrived
positioning = "vicon-twin"
arena.size = [4.0, 4.0, 2.0]
world = { engine = "pymunk", sensor_noise = 0.0 }
avoidance = { kind = "barrier", hears = "neighbours" }
safety = { position_timeout_s = 4.0, land_without_position_s = 4.0 }  # a busy machine holds up the network
robots.TB01 = { kind = "turtlebot3", body = "turtlebot3-twin", position = "external", start = [0.0, 0.0] }
robots.KH01 = { kind = "khepera4", body = "world", start = [-0.3, 0.0] }
[[timeline]]
at_s = 1.4
robot = "KH01"
plan = { kind = "waypoints", points = [[0.33, 0.0]], speed = 0.23 }
"""
BEGINS_S, GOAL, NEAR_M, STAYS_S = 1.4, (0.33, 0.0), 0.08, 0.3


def ahead(scan):
    """Reading of the rays along the nose [m]; NaN without any."""
    along = np.abs(np.array(scan.bearing)) + np.abs(np.array(scan.elevation)) < 1e-6
    readings = [reading for reading, ray in zip(scan.distance, along, strict=True) if ray and reading is not None]
    return min(readings, default=math.nan)


@pytest.mark.mechanism("mixed reality", "motion capture: processes killed")
def test_twin_sees_and_avoids_a_real_robot(tmp_path, router):
    file = tmp_path / "mixed.toml"
    file.write_text(MIXED)
    flight = Flight(tmp_path / "run", file, "--json", f'network.connect=["{router.endpoint}"]')
    with Desk(router.endpoint) as desk:
        scans = desk.every(KEYS.ranges("KH01"), messages.Ranges)
        truths = desk.every(KEYS.truth("KH01"), messages.Position)

        def arrived():
            """It has been near its goal for a while."""
            assert flight.process.poll() is None, flight.logs()
            lately = [each for each in truths if each.stamp > truths[-1].stamp - STAYS_S]
            return lately and all(math.dist(each.position[:2], GOAL) < NEAR_M for each in lately)

        desk.until(arrived, "the twin went around the robot and stays at its goal", 90.0)
        flight.children()["vicon"].kill()
        flight.until_said(
            r"vicon conductor: the vicon ended \(killed by SIGKILL\); started again: robots without a pos"
        )
        again = time.time()
        desk.until(lambda: desk.at["TB01"].stamp > again, "it is measured again")
        flight.children()["vicon-twin"].kill()
        flight.until_said(r"device conductor: the vicon-twin ended \(killed by SIGKILL\); robots that need it hold")
        flight.interrupt()
    played = flight.read("default")
    trace = played.trace
    real, twin = (trace.robots.index(name) for name in ("TB01", "KH01"))
    radius = {name: KINDS[robot.kind].radius for name, robot in trace.plan.experiment.robots.items()}
    truth, measured = trace.true_position[:, :, :2], trace.position[:, :, :2]
    still = (trace.time > BEGINS_S - 1.2) & (trace.time < BEGINS_S)
    away = np.median(np.linalg.norm(measured[still, real] - truth[still, twin], axis=1))
    readings = [ahead(scan) for scan in scans if -1.2 < scan.stamp - played.started - BEGINS_S < 0.0]
    assert len(readings) >= 3
    assert np.nanmedian(readings) == pytest.approx(away - radius["TB01"], abs=0.001)
    assert np.nanmin(np.linalg.norm(truth[:, twin] - truth[:, real], axis=1)) > sum(radius.values()) + 0.01
    assert trace.contacts == ()
    assert trace.avoided[twin] > 0
