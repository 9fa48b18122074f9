"""World, central controller and recorder: their pace, whom they obey, when they end, and robots of a world."""

import math
import os
import signal
import subprocess
import sys
import threading
import types
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from agents.clock import uptime
from agents.decision.centralised import CentreGoal
from agents.errors import Refusal
from agents.network import messages, name_ownership, pubsub, shutdown
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.name_ownership import NameTaken, OwnershipCheck, OwnershipTiming
from agents.network.shutdown import FAREWELL_S, STOPPED_S
from agents.robot import Robot
from agents.runtime.goal_inbox import GoalInbox
from agents.runtime.lifeline import event_line
from agents.vectors import NO_SETPOINT
from experiments.definition.experiment import Arena, Formation, RobotTable, WorldTable
from experiments.definition.plan import Plan
from experiments.real_time.processes import joining, world_network
from experiments.real_time.processes import world as world_module
from experiments.real_time.processes.centre import CentreProcess
from experiments.real_time.processes.recorder import AFTER_S, Recorder, with_truth
from experiments.real_time.processes.world import WorldProcess
from experiments.real_time.processes.world_population import WorldBodies
from experiments.view.observer import Observer
from tests.experiments.recordings import START, state, touched, world_state
from tests.fuzz.messages import sent
from tests.network import Attentive, Mute, Net, Reply, Sample
from tests.small import changed, pair, small
from tests.system.lab import Started
from tests.waiting import until
from twins.scene import Obstacle

KEYS = Keys()
BEGIN, WORLD_HZ = 1000.0, 100.0
DRONE = RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5, body="world")
GUIDED = Plan(pair(architecture="centralised"))


def joint(net, ownership):
    """The `net` for a process; without an `ownership` a standstill of the machine asks for no check."""
    return joining.Network(net.session, KEYS, [], [], ownership or OwnershipCheck([], lease_s=math.inf))


def joined_world(net, bodies=None, ownership=None, clock=uptime, name="F"):
    """World of one drone."""
    plan = Plan(pair(robots={name: DRONE}, formation=Formation()))
    return WorldProcess(plan, bodies or WorldBodies(plan), joint(net, ownership), threading.Event(), clock)


def centre(net, ownership=None, clock=uptime):
    """Central controller of two wheeled robots."""
    return CentreProcess(GUIDED, joint(net, ownership), clock=clock)


class Over:
    """Event whose waits advance a simulated clock, the sixth by `more` [s] than asked; set after so many."""

    def __init__(self, waits, more=0.0):
        self.now, self._left, self._sixth, self._more = BEGIN, waits, waits - 6, more

    def is_set(self):
        return self._left < 0

    def wait(self, seconds):
        self._left -= 1
        self.now += seconds + (self._more if self._left == self._sixth else 0.0)
        return self.is_set()


def decisions(monkeypatch, over, decide):
    """The central controller after a run; `decide` gets it, the time [s] and starts of robots."""
    with Net().worn() as net:
        process = centre(net, clock=lambda: over.now)
        monkeypatch.setattr(process.centre, "decide", lambda t, _, start: decide(process, t, start) or [])
        process.run(over)
    return process


def test_decisions_follow_start_and_skip_standstill(monkeypatch):
    over, decided = Over(12), []

    def decide(process, t, start):
        decided.append((t / process.ticks.period, (over.now - BEGIN) / process.ticks.period))
        if len(decided) == 3:
            for row in process.guided:
                start[row] = 4.25 * process.ticks.period  # robots began there
        over.now += (3.9 if len(decided) == 8 else 0.1) * process.ticks.period

    process = decisions(monkeypatch, over, decide)
    late = 0.05  # of a period of 0.1 s: half a tick of a body at 100 Hz
    times = [0, 1, 2, 3, 3.25, 4.25, 5.25, 6.25, 9.25, 10.25, 11.25, 12.25]
    assert [t for t, _ in decided] == pytest.approx(times)
    assert [at for _, at in decided] == pytest.approx([6.25 + late + 3.9 if t == 9.25 else t + late for t in times])
    assert (process.missed, process.ticks.next) == (2, pytest.approx(13.25 * process.ticks.period))


def test_long_wait_decides_for_no_past_instant(monkeypatch):
    over, seen = Over(12, more=0.73), []
    process = decisions(monkeypatch, over, lambda made, t, _: seen.append((over.now - BEGIN - t, made.late_s)))
    ages, late = zip(*seen, strict=True)
    assert max(ages) < process.ticks.period + process.patience_s
    assert (len(ages), process.missed) == (12, int(0.73 / process.ticks.period))
    assert max(late) == pytest.approx(0.73, abs=1e-9)


@pytest.mark.parametrize("asleep", [False, True])
@pytest.mark.parametrize(("stands_s", "lost", "forgiven"), [(0.05, 0, False), (0.255, 19, False), (2.0, 194, True)])
def test_lateness_is_caught_up_and_standstill_lost(stands_s, lost, forgiven, asleep, monkeypatch):
    now, simulated, slept, over = [BEGIN], [], [], threading.Event()
    lost += asleep and lost > 0  # it begins when a tick is due, not after one

    def sleep(seconds):
        now[0] += seconds + (stands_s if asleep and len(simulated) == 20 else 0.0)

    bodies = WorldBodies(Plan(pair(robots={"F": DRONE}, formation=Formation())))
    advance = bodies.advance

    def stand():
        advance()
        simulated.append(bodies.time)
        now[0] += stands_s if len(simulated) == 20 and not asleep else 0.001
        if len(simulated) == 150:
            over.set()

    monkeypatch.setattr(world_module, "time", types.SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(bodies, "advance", stand)
    with Net().worn() as net:
        process = joined_world(net, bodies, clock=lambda: now[0])
        monkeypatch.setattr(process.commands, "forgive", lambda seconds, t: slept.append((seconds, t)))
        process.run(over)
    assert bodies.time == pytest.approx(150 / WORLD_HZ), "each tick simulates its period"
    assert now[0] - BEGIN == pytest.approx((149 + lost) / WORLD_HZ + 0.001), "in time again"
    assert slept == ([(pytest.approx(lost / WORLD_HZ), pytest.approx((20 + lost) / WORLD_HZ))] if lost else [])
    assert any(seconds > world_network.HANG_S for seconds, _ in slept) == forgiven


TOKENS = {"world": KEYS.world_alive, "centre": KEYS.centre_alive}


@pytest.mark.slow
@pytest.mark.parametrize("way", ["still", "cut off"])
@pytest.mark.parametrize("what", TOKENS)
def test_replaced_process_sends_nothing(what, way, monkeypatch):
    sent, now, silent, over = [], [0.0], [math.inf], threading.Event()

    class Counted(Mute):
        def put(self, payload, **_):
            sent.append(payload)
            if len(sent) == 10 and way == "cut off":
                silent[0] = 0.0
            if len(sent) == 20:
                net.replies = [Reply(Sample(Keys.life(TOKENS[what], "beef"), "", b""), good=True)]
                now[0] += 60.0 if way == "still" else 0.0
                silent[0] = math.inf
            if len(sent) == 40:
                over.set()

    monkeypatch.setattr(name_ownership, "uptime", lambda: now[0])
    monkeypatch.setattr(Attentive, "silent_since", lambda *_: silent[0])
    ownership = OwnershipCheck([TOKENS[what]], timing=OwnershipTiming(vanish_s=0.0))
    with Net().worn() as net:
        for kind in ("publisher", "NumberedPublisher"):
            monkeypatch.setattr(pubsub, kind, lambda *_, **__: Counted())
        process = (joined_world if what == "world" else centre)(net, ownership=ownership)
        if what == "centre":
            monkeypatch.setattr(process.centre, "decide", lambda *_: [CentreGoal(0, (0.0, 0.0, 0.0), 0.0, 0.0)])
        with pytest.raises(NameTaken):
            process.run(over)
    assert 20 <= len(sent) <= 21  # a tick of the world has up to two


MODULES = "experiments.real_time.processes"
WORLD = """
title = "two"
duration_s = 60.0
architecture = "centralised"
[robots]
KH01 = { kind = "khepera4", body = "world", start = [0.0, 0.0] }
KH02 = { kind = "khepera4", body = "world", start = [0.0, 0.5] }
"""


@pytest.mark.system
@pytest.mark.parametrize(
    "what", [pytest.param("world", marks=pytest.mark.mechanism("name ownership: world replaced")), "centre"]
)
def test_frozen_and_replaced(what, router, tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(WORLD)
    with network.open_session([router.endpoint], name="test") as session, ExitStack() as up:

        def start():
            made = up.enter_context(Started(f"{MODULES}.{what}", str(file), "--connect", router.endpoint))
            assert made.process.stdout.readline().startswith(f"{what} ready")
            return made

        def owners():
            tokens = network.tokens_present(session, Keys.lives(TOKENS[what])) or set()
            return sum(Keys.life_of(each) is not None for each in tokens)

        old = start()
        old.freeze()
        until(lambda: not owners(), "its lease is over")
        new = start()
        old.thaw()
        assert old.process.wait(100.0) == 2
        assert f"another process has taken the name '{what}' in the realm 'park'" in old.said()
        assert new.process.poll() is None


@pytest.mark.system
def test_full_disk_of_a_log_ends_no_world(router, tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(WORLD.replace('architecture = "centralised"', ""))
    command = [sys.executable, "-m", f"{MODULES}.world", str(file), "--connect", router.endpoint, "--lifeline"]
    with (
        Path("/dev/full").open("w") as full,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=full, stderr=full, bufsize=0) as process,
        network.open_session([router.endpoint], name="test") as session,
    ):

        def there():
            assert process.poll() is None
            process.stdin.write(b"\n")
            return network.tokens_present(session, KEYS.world_alive)

        until(there, "the world is up")
        process.terminate()
        process.stdin.close()
        assert process.wait(100.0) == 0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_robots_land_although_nobody_reads_their_output(monkeypatch):
    signals, gone = [], [[("", False)]]
    watch = types.SimpleNamespace(changes=lambda: gone.pop() if gone else [])
    monkeypatch.setattr(joining.pubsub, "AliveWatch", lambda *_: watch)
    monkeypatch.setattr("builtins.print", Mock(side_effect=BrokenPipeError))
    monkeypatch.setattr(os, "kill", lambda _, number: signals.append(number))
    with Net().worn() as net:
        watch = joining.ConductorWatch(net.session, KEYS, 0.0)
        until(lambda: signals, "it ends its process")
        watch.close()
    assert signals == [signal.SIGTERM]
    assert shutdown.AFTER_S == AFTER_S > 2.0 * FAREWELL_S + STOPPED_S, "servers and recorders wait for them"


UTC = 1.7e9
NOW, BEHIND = 1_700_000_000_000, 1_600_000_000_000  # milliseconds, at which numbers begin


def own(net, alive, session, *, gone=False):
    net.deliver(f"{Keys.life(alive, session)}\0\0".encode(), gone=gone)


def test_world_obeys_sender_with_clock_behind():
    with Net().worn() as net:
        process = joined_world(net)

        def order(seq, action, **more):
            """Whether it is carried out."""
            before = process.commands.done.get("F", 0)
            net.deliver(sent(KEYS.setpoint("F"), messages.Command("F", seq, UTC, action, **more))[0])
            process.commands.receive(0.0)
            return process.commands.done.get("F", 0) != before

        own(net, KEYS.alive("F"), "one")
        assert order(NOW, "takeoff", height=0.5)
        assert not order(BEHIND, "stop")  # of the same process: said again, or overtaken
        own(net, KEYS.alive("F"), "one")  # it was cut off, and is the same
        assert not order(BEHIND, "stop")
        own(net, KEYS.alive("F"), "one", gone=True)
        own(net, KEYS.alive("F"), "two")
        assert order(BEHIND, "stop")


def test_stopped_world_robot_obeys_new_processes_alone():
    """A process that missed the emergency stop took off again, or drove on."""
    with Net().worn() as net:
        bodies = WorldBodies(Plan(pair(robots={"F": DRONE}, formation=Formation())))
        process = joined_world(net, bodies)

        def flies_after(seq):
            net.deliver(sent(KEYS.setpoint("F"), messages.Command("F", seq, UTC, "takeoff", height=0.5))[0])
            process._tick(0.1 * seq)
            return bodies.body.engine.motions[0].flying

        process._stopped.set()  # a stop before the robot has a process
        process._tick(0.0)
        own(net, KEYS.alive("F"), "one")
        assert flies_after(1)
        process._stopped.set()
        assert [flies_after(2), flies_after(3)] == [False, False]
        assert process.commands.done == {"F": 3}, "it is answered"
        own(net, KEYS.alive("F"), "one")
        assert not flies_after(4), "it was cut off, and is the same"
        own(net, KEYS.alive("F"), "two")
        assert flies_after(5)
        process._stopped.set()
        own(net, KEYS.alive("F"), "one")
        assert not flies_after(6), "both told their names again after a router was lost"


def test_world_of_many_robots_knows_name_owners():
    names = [f"F{row:03}" for row in range(120)]  # each with a token, a claim and the token of an owner
    with Net().worn() as net:
        process = joined_world(net, name="F000")
        for alive in map(KEYS.alive, names):
            for token in (alive, Keys.life(alive, "one"), Keys.claim(alive, Keys.rank(1.0, "one"))):
                net.deliver(f"{token}\0\0".encode())
        process.commands.receive(0.0)
    assert process.commands.lives == dict.fromkeys(names, "one")


def test_centre_with_clock_behind_is_followed():
    robot = Robot(GUIDED.assignment("A"))
    with Net().worn() as net:
        goals = GoalInbox(net.session, KEYS, [robot], valid_box=(5.0, 5.0, 5.0))

        def tell(seq, t, x):
            """The goal that is pursued."""
            goal = messages.Goal("A", seq, UTC + t, (x, 0.0, 0.0), None, UTC + t)
            net.deliver(sent(KEYS.goal("A"), goal)[0])
            goals.receive(t, UTC)
            return robot.guidance.goal[0]

        own(net, KEYS.centre_alive, "one")
        assert (tell(NOW, 1.0, 0.1), tell(BEHIND, 1.1, 0.2), goals.malformed) == (0.1, 0.1, 1)
        own(net, KEYS.centre_alive, "two")
        assert (tell(BEHIND, 0.9, 0.3), goals.malformed) == (0.3, 1)  # its clock lags by a little
    guidance, goal = Robot(GUIDED.assignment("A")).guidance, (0.0, 0.0, 0.0)
    guidance.receive(goal, 0.0, 1.0)
    guidance.mark_lost(2.0)
    guidance.receive(goal, 0.0, 1.9)
    assert guidance.unguided(2.1), "a late goal revives no dead centre"
    guidance.receive(goal, 0.0, 2.2)  # of another one, such as a tool of ROS
    assert not guidance.unguided(2.3)


class Taken:
    """Recording that keeps messages in a list."""

    def __init__(self, kept):
        self._kept = kept

    def write(self, message, *_payload):
        self._kept.append(message)


def test_recorder_keeps_plausible_messages_of_the_world():
    lost = messages.ObstaclePose("box", (0.0, math.nan, 0.0))
    said = [
        (KEYS.contact, changed(touched(0.1), impulse=math.nan)),
        (KEYS.contact, changed(touched(0.1), stamp=math.inf)),
        (KEYS.contact, world_state(0.1)),
        (KEYS.world, changed(world_state(0.1), obstacles=[lost])),
        (KEYS.world, touched(0.1)),
        (KEYS.world, world_state(0.2)),
        (KEYS.contact, touched(0.3)),
    ]
    taken = []
    with Net().worn() as net:
        recorder = Recorder(net.session, KEYS, Taken(taken))
        for key, message in said:  # MessagePack keeps what is not finite; JSON would say null
            net.deliver(sent(key, message)[1])
        recorder.receive()
        assert sorted(map(str, taken)) == sorted(map(str, (touched(0.3), world_state(0.2))))
        assert sum(count for count, _ in recorder.unread.values()) == 5
        taken.clear()
        for last in (False, False, True):  # each once
            recorder.report_malformed(last=last)
    told = [(event.kind, event.source, event.text.split(" on ")[1].split(": ")[0]) for event in taken]
    assert sorted(told) == [("unread", "recorder", key) for key in sorted((KEYS.contact, KEYS.world))]


def test_recorder_writes_each_event_once_whichever_way():
    first, second, third = (messages.Event(START + at, "late", "KH01", "waits") for at in (0.0, 1.0, 2.0))
    taken = []
    with Net().worn() as net:
        lines = deque([event_line(first), event_line(second)[:9], b"stop {}", event_line(third)])
        recorder = Recorder(net.session, KEYS, Taken(taken), lines)
        for event in (first, second):
            net.deliver(sent(KEYS.event, event)[1])
        recorder.receive()
    assert sorted(taken, key=lambda event: event.stamp) == [first, second, third]


def test_world_speaks_for_itself_alone():
    forged = messages.Event(START, "lost", "KH01", "is not on the network any more")
    told = messages.Event(START, "contact", "world", "KH01 touches KH02 (0.1 N s)")
    for reader in ("recorder", "view"):
        with Net().worn() as net:
            taken = []
            made = Recorder(net.session, KEYS, Taken(taken)) if reader == "recorder" else Observer(net.session, KEYS)
            for event in (forged, changed(forged, source="conductor"), told):
                net.deliver(sent(KEYS.world_event, event)[0])
            if isinstance(made, Observer):
                made.update()
                taken = [*made.events]
            else:
                made.receive()
            assert taken == [told], reader


def test_truth_at_a_state_is_interpolated_between_neighbours():
    """At 0.5 m/s the newest of 50 truths a second is up to 1 cm away."""
    turned = [messages.heading(math.pi - 0.05 + 0.02 * k) for k in range(10)]
    truths = [messages.Position("TB01", START + 0.02 * k, (0.01 * k, 0.0, 0.0), turned[k]) for k in range(10)]
    for at in (0.0, 0.013, 0.0975, 0.18):
        found = with_truth(state(at=at), truths)
        assert found.true_position == pytest.approx((0.5 * at, 0.0, 0.0), abs=1e-6)
        assert math.remainder(found.true_yaw - (math.pi - 0.05 + at), math.tau) == pytest.approx(0.0, abs=1e-6)
    assert with_truth(state(at=0.2), truths).true_position == truths[-1].position
    unknown = [with_truth(state(at=at), known) for at, known in ((-0.06, truths), (0.24, truths), (0.0, []))]
    assert [found.true_position for found in unknown] == [None] * 3


OBSTACLES = {
    "post": Obstacle(radius=0.1, at=(1.5, 1.5)),
    "crate": Obstacle(box=(0.4, 0.2), at=(-1.5, -1.0), yaw=math.pi / 2, mass=0.2),
    "fence": Obstacle(wall=[(-0.5, 0.0), (0.5, 0.0)], at=(0.0, -1.5)),
    "shelf": Obstacle(box=(0.5, 0.5), at=(1.5, -1.5), bottom=0.5),
}
FORWARD = (0.2, 0.0, 0.0, 0.0)


def carried(x, y, yaw=0.0):
    return RobotTable(kind="khepera4", start=[x, y, yaw], body="world")


ROBOTS = {
    "KH01": carried(0.0, 0.0),
    "CF01": RobotTable(kind="crazyflie", start=[0.0, 1.0, 0.5], body="world", hover=0.6),
    "TB01": RobotTable(kind="turtlebot3", start=[1.0, 0.0]),
}


class World(WorldBodies):
    """A world with four obstacles, addressed by name."""

    def __init__(self, robots=ROBOTS, obstacles=OBSTACLES, **world):
        super().__init__(Plan(small(robots, arena=Arena(obstacles=obstacles), world=WorldTable(**world))))

    def row(self, name):
        return self.names.index(name)

    def at(self, name):
        return [round(value, 6) for value in self.states[self.row(name)].true_position]

    def go(self, ticks, **setpoints):
        for _ in range(ticks):
            self.body.command([setpoints.get(name, NO_SETPOINT) for name in self.names])
            self.advance()


def test_world_carries_its_robots_and_mirrors_others():
    world = World()
    assert (world.names, world.carried, world.seen) == (tuple(ROBOTS), (True, True, False), (True, True, False))
    assert world.at("CF01") == [0.0, 1.0, 0.0]
    assert np.isnan(world.states[2].true_position).all(), "nobody has said where it is"
    world.go(100, KH01=FORWARD)
    assert world.time == pytest.approx(1.0)
    assert world.at("KH01")[0] == pytest.approx(0.19, abs=0.011)
    seeing = RobotTable(kind="turtlebot3", start=[1.0, 0.0], ranges="world")
    world = World({"TB01": seeing, "KH01": RobotTable(kind="khepera4", start=[0.0, 0.0])})
    assert (world.carried, world.seen) == ((False, False), (True, False)), "a mirrored one may ask for ranges"


def test_reset_puts_back_and_leaves_in_the_air():
    world = World()
    world.takeoff(world.row("CF01"), 0.6)
    world.go(250)
    world.go(100, CF01=(0.4, 1.2, 0.6, 0.0), KH01=FORWARD)
    world.reset("KH01")
    assert world.at("KH01") == [0.0, 0.0, 0.0]
    assert world.at("CF01")[0] > 0.3
    world.reset(None)
    assert [(state.true_yaw, state.flying) for state in world.states[:2]] == [(0.0, False), (0.5, True)]
    for ticks in (0, 50):
        world.go(ticks)
        assert world.at("CF01") == [0.0, 1.0, pytest.approx(0.6, abs=0.01)], "it holds there"


def test_reset_that_cannot_be_is_refused():
    cart = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [0.0, 1.0], "speed": 0.5})
    world = World(obstacles={"cart": cart})
    world.begin(0.0)
    world.go(300)
    for name, reason in (
        ("TB01", "TB01 is only mirrored here"),
        ("KH02", r"there is no 'KH02' in this world; did you mean 'KH01'\?"),
        ("KH01", "KH01 would overlap cart by 170 mm: reset all"),
    ):
        with pytest.raises(Refusal, match=reason):
            world.reset(name)
    world = World()
    world.go(200, KH01=FORWARD)
    world.put("CF01", (0.0, 0.0, 0.0), 0.0, flying=False)
    with pytest.raises(Refusal, match=r"KH01 would overlap CF01 by \d+ mm: move that first"):
        world.reset("KH01")


def test_reset_puts_back_pushed_obstacles():
    belt = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.5})
    world = World({"KH01": carried(-1.0, -1.0, math.pi)}, {"crate": OBSTACLES["crate"], "belt": belt}, engine="pymunk")
    world.go(400, KH01=FORWARD)
    pushed, still = world.obstacles().values()
    assert (pushed[0] < -1.55, still) == (True, (0.0, -1.0, 0.0))
    world.begin(world.time + 0.5)
    world.go(150)
    moved = world.obstacles()["belt"][0]
    assert moved == pytest.approx(0.5, abs=0.05), "a planned one moves from the start on"
    world.reset(None)
    assert world.obstacles()["crate"] == (-1.5, -1.0, pytest.approx(math.pi / 2, abs=1e-6))
    assert world.at("KH01") == [-1.0, -1.0, 0.0]
    world.go(20)
    assert world.obstacles()["belt"][0] == pytest.approx(moved + 0.1, abs=0.03), "and goes on"
    assert world.time == pytest.approx(5.7)


def test_contacts_have_names():
    places = [(0.0, 0.0), (0.3, 0.0, math.pi), (1.8, 0.0), (1.5, 1.2, math.pi / 2)]
    world = World({f"KH0{number}": carried(*place) for number, place in enumerate(places, 1)}, engine="pymunk")
    found = []
    for _ in range(200):
        world.go(1, **dict.fromkeys(world.names, FORWARD))
        found += world.meetings(0.0)
    pairs = {frozenset((meeting.first, meeting.second)) for meeting in found}
    assert pairs == {frozenset(("KH01", "KH02")), frozenset(("KH03", "wall")), frozenset(("KH04", "post"))}
    assert all(meeting.impulse > 0.0 and meeting.overlap < 1e-3 for meeting in found)


def test_wheels_stop_with_a_watchdog_alone():
    world = World()
    for made, hold_s in ((world, np.inf), (World(wheel_watchdog_s=0.7), 0.7)):
        assert (made.hold_s[made.row("CF01")], made.hold_s[made.row("KH01")]) == (0.5, hold_s)
    world.go(10, KH01=FORWARD)
    world.go(300)
    assert world.at("KH01")[0] > 0.5, "it drives on, as the real one"
