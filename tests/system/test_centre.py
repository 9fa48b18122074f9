"""The centre in real processes: a run that it decides, its silence and death, and goals that nobody should believe."""

import json
import time
from contextlib import ExitStack

import numpy as np
import pytest

from agents.network import messages, pubsub
from agents.network.keys import Keys
from experiments.run import reopen
from tests.commands import python
from tests.system.lab import Flight, RobotProcess, Started, Watcher, gone, until

pytestmark = pytest.mark.system

KEYS = Keys()
FAST = """
title = "three, two of them guided"
duration_s = {duration}
trigger = {{ kind = "periodic", period_s = 0.02 }}
architecture = {architecture}
formation.links = {{ "TB01 > KH01" = 0.5, "TB01 > KH02" = 0.5, "KH01 - KH02" = 0.5 }}
[robots]
TB01 = {{ kind = "turtlebot3", start = [-0.4, 0.0] }}
KH01 = {{ kind = "khepera4", start = [0.4, 0.6] }}
KH02 = {{ kind = "khepera4", start = [0.4, -0.6] }}
[[timeline]]
at_s = 0.5
robot = "TB01"
plan = {{ kind = "line", move_by = [-0.9, 0.0], speed = 0.1 }}
"""
HYBRID = '{ kind = "hybrid", robots = ["TB01", "KH01"] }'


@pytest.mark.mechanism("central controller: silent, killed")
def test_robots_hold_while_the_centre_is_dead(tmp_path):
    file, folder = tmp_path / "three.toml", tmp_path / "run"
    file.write_text(FAST.format(duration=12.0, architecture=HYBRID))
    flight = Flight(folder, file, "--json")
    flight.until_said(r"phase conductor: TB01 under way")
    everyone = list(flight.children().values())
    names = ("TB01", "KH01")
    with Watcher(flight.endpoint()) as watcher:
        watcher.until(lambda: all(name in watcher.state for name in names), "telemetry")
        watcher.until(lambda: watcher.state["TB01"].position[0] < -0.45, "the leader drives")
        centre = flight.children()["centre"]
        centre.suspend()  # the next one may be there after a tenth of a second
        silent = time.time()
        watcher.until(lambda: all("its centre is gone" in watcher.status[name].hazard for name in names), "they hold")
        holding = time.time()
        watcher.until(lambda: all(watcher.state[name].stamp > holding + 0.2 for name in names), "they still hold")
        centre.kill()
        flight.until_said(r"centre conductor: the centre ended \(killed by SIGKILL\); started again")
        watcher.until(lambda: watcher.state["TB01"].position[0] < -0.6, "the leader goes on")
    everyone += list(flight.children().values())
    out = flight.interrupt()
    until(lambda: gone(everyone), "nothing is left")

    read, case = flight.read("default"), reopen(folder).metrics["default"]
    trace, died = read.trace, silent - read.started
    back = trace.goals.sent.stamp[trace.goals.sent.stamp > died + 0.15].min()  # of the centre that was started again
    quiet = (trace.time > holding - read.started) & (trace.time < back)
    assert quiet.any()
    held = np.ptp(trace.goal[quiet], axis=0).max(axis=1)
    assert held[[trace.robots.index(name) for name in names]].max() < 1e-6  # they stay where they noticed it
    leader = trace.position[:, 0, 0]
    assert np.ptp(leader[quiet]) < 0.05
    # its plan is what it was: 0.1 m/s from 0.5 s on, from where it had begun, however long nobody said so
    goals = trace.goals.sent
    stays = np.abs(goals.position[:, 0] - leader[quiet][-1]) < 0.01  # until the next centre knows of the start
    for moment in (goals.stamp < died) & (goals.stamp > 1.0), (goals.stamp >= back) & ~stays:
        of_leader = moment & (goals.link == 0)
        assert of_leader.sum() > 3
        wanted = leader[0] - 0.1 * (goals.stamp[of_leader] - 0.5)
        np.testing.assert_allclose(goals.position[of_leader, 0], wanted, rtol=0.0, atol=0.011)
    guidance = case.guidance
    assert guidance.guided == names
    assert guidance.delay_mean_s > 0.0
    assert guidance.load > 0.0
    assert len({report.pid for report in trace.goals.reports}) == 2
    assert json.loads(out)["cases"]["default"]["guidance"]["goals"] == guidance.goals > 20
    assert case.lost == 0


def test_by_hand_and_what_nobody_should_believe(router, watcher, tmp_path):
    file, names = tmp_path / "three.toml", ("TB01", "KH01", "KH02")
    file.write_text(FAST.format(duration=60.0, architecture='"centralised"'))
    command = ("experiments.real_time.processes.centre", str(file), "--connect", router.endpoint)
    with ExitStack() as stack:
        robots = [stack.enter_context(RobotProcess(router.endpoint, file, name)) for name in names]
        watcher.until(lambda: "never received centre" in watcher.status["KH01"].reason, "they wait for the centre")
        assert watcher.status["KH01"].missing == ["centre"]
        centre = stack.enter_context(Started(*command))
        ready = "centre ready: guides TB01, KH01, KH02 at 10 Hz; realm park at"
        assert centre.process.stdout.readline().startswith(ready)
        watcher.until_all("ready", *names)
        second = python("-m", *command, code=2)
        assert "a centre guides the robots in the realm 'park' already" in second.stderr
        watcher.take_off(*names)
        watcher.start(*names)
        watcher.until(lambda: watcher.state["KH01"].goal_receipts, "it is guided")

        refused = watcher.status["KH01"].malformed
        late = watcher.state["KH01"].goal_receipts[-1]
        assert late.acted > late.pose
        now = time.time()
        goals = (
            messages.Goal("KH02", 2**52, now, (0.0, 0.0, 0.0), None, now),
            messages.Goal("KH01", 2**52, now, (1e3, 0.0, 0.0), None, now),
            messages.Goal("KH01", 2**52, now - 5.0, (0.0, 0.0, 0.0), None, now - 5.0),
            messages.Goal("KH01", 1, now, (0.0, 0.0, 0.0), None, now),  # of a centre that came before
        )
        for payload in (b"no goal at all", *map(messages.encode, goals)):
            watcher.session.put(KEYS.goal("KH01"), payload, encoding=messages.JSON)
        watcher.until(lambda: watcher.status["KH01"].malformed >= refused + 5, "all are refused")
        assert watcher.state["KH01"].phase == "running"
        assert abs(watcher.state["KH01"].goal[0]) < 3.0

        inbox = pubsub.Inbox(pubsub.pose_subscriber(watcher.session, KEYS.centre), messages.CentreState)
        reports = []

        def reported():
            reports.extend(inbox.read())
            return reports and reports[-1].received["KH01"] > 0  # the first may be from before the run

        watcher.until(reported, "the centre says how it is, and that it hears KH01")
        assert (reports[-1].robots, reports[-1].missing) == (["TB01", "KH01", "KH02"], [])
        assert centre.end() == 0
        watcher.until(lambda: watcher.status["KH02"].missing == ["centre"], "its end is noticed")
        for robot in robots:
            robot.process.terminate()
        assert [robot.wait() for robot in robots] == [0, 0, 0]
