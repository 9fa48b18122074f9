"""The decision of a robot: received poses, neighbours that go and come back, orders, formations, leaders and plans."""

from math import dist, inf, isnan, nan

import pytest

from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, PAUSED, READY, RUNNING
from agents.network.messages import Order
from agents.runtime.orders import carry_out
from experiments.definition.experiment import Formation, LegTable, Start
from experiments.definition.plan import Plan
from tests.agents.bench import LOGGED, Bench, Swarm, followed
from tests.small import NOISY, changed, pair, reference, triangle

HERE = (-0.4, 0.0, 0.0)
LINE = {"kind": "line", "move_by": [0.3, 0.0], "speed": 0.1}


def lone_robot(experiment=None):
    """The decision of A; B is on link 0."""
    return Bench(Plan(experiment or pair()).assignment("A"), HERE)


def test_missing_neighbour_is_named():
    bench = lone_robot().step()
    assert (bench.life.phase, bench.life.reason) == (IDLE, "never received B")
    assert bench.robot.missing_neighbours() == ["B"]
    bench.position = (nan, 0.0, 0.0)
    assert bench.step().life.reason == "no position of its own"
    bench.position, bench.values["time"] = HERE, bench.t - 0.6
    assert bench.step().life.reason == "no position of its own"  # too old
    del bench.values["time"]
    bench.hear(0, (0.4, 0.1, 0.0))
    bench.step()
    assert (bench.life.phase, bench.life.reason) == (READY, "")
    assert bench.robot.missing_neighbours() == []
    bench.neighbours.mark_lost(0, bench.t)
    assert bench.robot.missing_neighbours() == ["B"]
    patient = lone_robot(pair(start=Start(deadline_s=2.0, missing="go-on"))).step(2.0)
    assert patient.life.phase == IDLE
    assert patient.step(0.02).life.phase == READY


def test_lost_neighbour_is_left_out_until_found():
    swarm = Swarm(triangle()).running().run(0.5)
    robot = swarm.robot("A")

    def active():
        return "".join(sender.name for sender in robot.neighbours.all if sender.active)

    swarm.lose("B", "A")
    swarm.run(1.0)
    assert active() == "BC"
    swarm.run(0.02)
    assert active() == "C"
    assert robot.missing_neighbours() == ["B"]
    before = swarm.last("A", "goal")
    swarm.muted.clear()  # no pose brings it back
    assert swarm.run(0.1).last("A", "goal") != before  # it still follows C
    assert robot.neighbours.all[0].arrival > swarm.t - 0.03
    assert active() == "C"
    swarm.find("B", "A")
    swarm.step()
    assert active() == "BC"
    assert swarm.last("C", "goal") == pytest.approx((0.0, -0.5, 0.0), abs=1e-9)  # without links: it stays
    assert robot.error > 0.0
    for sender in "BC":
        swarm.lose(sender, "A")
    swarm.run(1.1)
    assert isnan(robot.error), "of no link"


def test_unreceived_neighbour_hides_no_lost_one():
    bench = lone_robot(triangle(start=Start(deadline_s=0.1, missing="go-on")))  # B is never received

    def hear(bench):
        bench.hear(1, (0.0, -0.5, 0.0))

    bench.step(0.3, hear).running(hear)
    assert [sender.active for sender in bench.neighbours.all] == [False, True]
    bench.neighbours.mark_lost(1, bench.t)
    bench.step(1.7)
    assert not any(sender.active for sender in bench.neighbours.all)
    assert bench.robot.goal == HERE  # alone: it holds


@pytest.mark.parametrize("what", ["neighbour", "router", "order"])
def test_robot_holds_and_goes_on(what):
    swarm = Swarm(pair())
    swarm.step()
    robot = swarm.robot("A")
    swarm.running().run(0.5)
    if what == "neighbour":
        swarm.lose("B", "A")
    elif what == "router":
        robot.health.offline_since = swarm.t
    busy = swarm.run(0.9).last("A", "goal")
    if what == "order":
        assert robot.hold() == ""
    held = swarm.run(0.3).last("A", "goal")
    assert held != busy
    assert swarm.run(1.0).last("A", "goal") == held
    assert dist(swarm.last("A", "truth"), held) < 0.02
    assert swarm.phase("A") == RUNNING
    if what == "neighbour":
        swarm.find("B", "A")
    robot.health.offline_since = inf
    assert what != "order" or robot.start(0.0) == ""
    assert swarm.run(0.2).last("A", "goal") != held
    assert robot.lifecycle.start_at == swarm.start_at


def test_hold_before_common_start_outlasts_it():
    swarm = Swarm(pair())
    while swarm.phase("A") != AIRBORNE:
        swarm.step()
        swarm.robot("A").lifecycle.takeoff()
    robot = swarm.robot("A")
    assert robot.hold() == ""
    assert robot.start(swarm.t + 0.1, swarm.t) == "", "the order of the conductor"
    held = swarm.run(0.5).last("A", "goal")
    assert (swarm.phase("A"), robot.lifecycle.reason) == (RUNNING, PAUSED)
    assert swarm.run(1.0).last("A", "goal") == held
    assert robot.start(swarm.t, swarm.t) == "", "an order to a robot that runs ends the hold"
    assert robot.lifecycle.reason == ""


def test_leader_goes_where_it_is_sent():
    swarm = followed()
    leader, order = swarm.robot("L"), Order("go", goal=(0.2, 0.1))
    assert "cannot go anywhere while idle" in carry_out(leader, order, 0.0, 0.0)[0]
    swarm.running()
    for name, wrong, why in (
        ("L", Order("go", goal=(9.0, 0.0)), "outside the arena"),
        ("L", Order("go"), "needs a `goal`"),
        ("L", Order("go", goal=(nan, 0.0)), "needs a `goal`"),
        ("F", order, "only a leader"),
    ):
        assert why in carry_out(swarm.robot(name), wrong, swarm.t, 0.0)[0]
    leader.hazards.incidents.clear()
    assert carry_out(leader, order, swarm.t, 0.0) == ("", None)
    assert carry_out(leader, Order("set", name="trigger.period_s", value=0.1), swarm.t, 0.0) == ("", 0.1)
    assert carry_out(leader, Order("get", name="trigger.period_s"), swarm.t, 0.0) == ("", 0.1)
    assert [incident.text for incident in leader.hazards.incidents] == [
        "warn: was sent to x = 0.2 m, y = 0.1 m by an operator",
        "warn: was given trigger.period_s = 0.1 by an operator",
    ]
    gone = dist(swarm.run(0.5).last("L", "goal"), (0.0, 0.0, 0.0))
    assert 0.0 < gone < 0.5 * 0.5 * 0.28  # it goes at half its speed, not at once
    assert dist(swarm.run(8.0).last("L", "truth"), (0.2, 0.1, 0.0)) < 0.01
    carry_out(leader, Order("go", goal=(0.0, 0.1)), swarm.t, 0.0)
    assert dist(swarm.run(8.0).last("L", "truth"), (0.0, 0.1, 0.0)) < 0.01


@pytest.mark.parametrize(("kind", "height"), [("khepera4", 0.0), ("crazyflie", 0.5), ("tello", 0.5)])
def test_leader_follows_its_plan(kind, height):
    swarm = followed(kind, 0.8, timeline=[LegTable(at_s=1.0, robot="L", plan=LINE)]).running()
    assert swarm.last("L", "goal") == pytest.approx((0.0, 0.0, height), abs=1e-9)
    for seconds, way, slack in ((1.0, 0.0, 1e-9), (2.0, 0.2, 0.0101), (6.0, 0.3, 1e-9)):
        assert swarm.run(seconds).last("L", "goal") == pytest.approx((way, 0.0, height), abs=slack)
    assert swarm.last("L", "truth") == pytest.approx((0.3, 0.0, height), abs=0.006)


@pytest.mark.slow
def test_follower_with_a_plan_is_pulled_by_both():
    legs = [LegTable(at_s=0.0, robot="F", plan={"kind": "hold", "at": [0.0, 0.5]})]
    swarm = followed(formation=Formation(links={"L > F": 0.5}, tracking_gain=3.0), timeline=legs)
    place = swarm.running().run(40.0).last("F", "truth")
    assert dist(place, (0.0, 0.5, 0.0)) < 0.2  # the pull ends with the third power of what is left
    assert dist(place, (0.0, 0.0, 0.0)) == pytest.approx(0.5, abs=0.02)


ALONE = [[name] for name in reference().robots]
THREE = [["CF03", "TB01", "KH02"], ["KH01", "CF01"], ["CF02", "KH03"]]
WAYS = {
    "mixed": ({"kind": "mixed", "evaluate_every_s": 0.06}, None, {"kind": "mixed", "maximum_silence_s": 0.5}),
    "dynamic": ({"kind": "dynamic", "smoothing_s": 0.2}, "constant-velocity", "dynamic"),
    "predictive": ({"kind": "predictive", "smoothing_s": 0.4}, None, "relative-control"),
    "self-triggered": ("self-triggered", {"kind": "constant-velocity", "horizon_s": 0.3}, "lyapunov"),
}


def eventful(experiment, groups):
    """A short run with everything that may happen; the same whoever shares a process with whom."""
    swarm = Swarm(experiment, groups).running().run(1.5)
    receivers = [name for name in swarm.names if "CF03" in [each.name for each in swarm.robot(name).neighbours.all]]
    for name in receivers:  # its token is gone, then back
        swarm.robot(name).neighbours.mark_lost(swarm.link(name, "CF03"), swarm.t)
    assert swarm.robot("KH02").hold() == ""
    swarm.run(1.53)
    for name in receivers:
        swarm.find("CF03", name)
    assert swarm.robot("KH02").start(0.0) == ""
    swarm.run(0.5).robot("CF02").lifecycle.land("told to")
    return swarm.run(0.5).until(DONE)


@pytest.mark.slow
@pytest.mark.parametrize("way", [None, *WAYS])
def test_robots_apart_equal_robots_together(way):
    park = reference()
    if way is not None:
        trigger, prediction, update = WAYS[way]
        park = changed(park, trigger=trigger, prediction=prediction, formation=changed(park.formation, update=update))
    legs = [LegTable(at_s=2.0, robot="TB01", plan={"kind": "line", "move_by": [0.3, 0.1], "speed": 0.15})]
    experiment = changed(park, duration_s=5.0, timeline=legs, disturbance=NOISY)
    together = eventful(experiment, [tuple(experiment.robots)])
    for groups in [THREE] if way else [ALONE, THREE]:
        apart = eventful(experiment, groups)
        assert (apart.sent, apart.start_at) == (together.sent, together.start_at)
        for name in experiment.robots:
            for what in LOGGED:  # texts: NaN equals NaN
                assert repr(apart.column(name, what)) == repr(together.column(name, what)), (name, what)
            assert apart.robot(name).updates == together.robot(name).updates
    assert len(together.sent) > (50 if way else 300)
    assert {together.phase(name) for name in together.names} == {DONE}
    decisions, updates = together.robot("KH01").decisions, [together.robot(name).updates for name in together.names]
    assert decisions > 40
    assert updates[0] == decisions  # a leader has no law to compute
    assert min(updates) > 1
    assert way is None or sum(updates) < 0.98 * max(updates) * len(updates), updates
