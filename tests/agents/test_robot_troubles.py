"""Robots whose position, body or neighbours fail: each ends stopped or landed, and no drone comes up again."""

import random
from math import dist, inf, isfinite, isnan, nan

import pytest

from agents.body.limits import Safety
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING, Phase
from agents.network.messages import Order
from agents.plugins.laws import Distance
from agents.runtime.orders import carry_out
from agents.safety.hazards import Cause
from agents.vectors import NO_SETPOINT, UNKNOWN
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from tests.agents.swarm import Swarm, drone, followed
from tests.small import pair, small

STILL = (0.0, 0.0, 0.0, 0.0)
LOST = {
    "nowhere": lambda state: setattr(state, "position", UNKNOWN),
    "half": lambda state: setattr(state, "position", (nan, *state.position[1:])),
    "no heading": lambda state: setattr(state, "yaw", nan),
}


def put(place):
    return lambda state: setattr(state, "position", place)


def frozen(time):
    return lambda state: setattr(state, "time", time)


def shifted(x, y=0.0):
    return lambda state: setattr(state, "position", (state.position[0] + x, state.position[1] + y, state.position[2]))


def cause(swarm, name):
    """Causes of the incidents of a robot so far."""
    return {incident.cause for incident in swarm.robot(name).hazards.incidents}


def told(swarm, seconds):
    """Texts of new incidents of each robot in some seconds."""
    texts = {name: [] for name in swarm.names}
    for _ in range(round(seconds / swarm.dt)):
        swarm.step()
        for name in swarm.names:
            incidents = swarm.robot(name).hazards.incidents
            texts[name] += [incident.text for incident in incidents]
            incidents.clear()
    return texts


def climbing(seconds):
    swarm = drone()
    swarm.run(0.02)
    assert swarm.robot("F").lifecycle.takeoff() == ""
    return swarm.run(seconds)


# ---------------------------------------------------------------- positions that are lost


@pytest.mark.parametrize("what", ["old", *LOST])
@pytest.mark.parametrize("moment", ["climbing", "waiting", "running"])
def test_blind_drone_lands(what, moment):
    if moment == "running":
        swarm = drone().running().run(0.5)
    else:
        swarm = drone().until(AIRBORNE) if moment == "waiting" else climbing(0.8)
    grace = 81 if what == "old" else 31  # 0.5 s until it is old, 0.3 s of holding
    swarm.spoil("F", frozen(swarm.t - 1e-9) if what == "old" else LOST[what])
    for _ in range(grace):
        assert swarm.phase("F") < LANDING
        swarm.step()
    assert swarm.phase("F") == LANDING
    assert swarm.robot("F").lifecycle.reason == "its own position is lost"
    assert swarm.last("F", "setpoint") == pytest.approx(NO_SETPOINT, nan_ok=True)
    swarm.until(DONE)
    assert swarm.last("F", "truth")[2] == 0.0


@pytest.mark.parametrize("what", ["old", *LOST])
def test_blind_wheels_stop_and_go_on(what):
    swarm = Swarm(pair()).running().run(0.5)
    swarm.spoil("A", frozen(swarm.t) if what == "old" else LOST[what])
    if what == "old":
        assert isfinite(swarm.run(0.4).robot("A").error)
    swarm.run(1.0)
    assert isnan(swarm.robot("A").error)
    assert isfinite(swarm.robot("B").error)
    assert swarm.phase("A") == RUNNING
    assert swarm.last("A", "setpoint") == STILL
    swarm.spoil("A", None)
    assert any(swarm.run(0.3).last("A", "setpoint"))


@pytest.mark.parametrize("what", LOST)
def test_leader_drives_on_when_positioning_returns(what):
    swarm = followed().running()
    assert swarm.robot("L").go((0.3, 0.1), swarm.t) == ""
    swarm.run(1.0).spoil("L", LOST[what])
    stood = swarm.run(1.0).last("L", "truth")
    assert dist(swarm.run(1.0).last("L", "truth"), stood) < 1e-6
    assert dist(stood, (0.3, 0.1, 0.0)) > 0.1
    swarm.spoil("L", None)
    assert dist(swarm.run(8.0).last("L", "truth"), (0.3, 0.1, 0.0)) < 0.01


def test_followers_of_blind_wheels_stop():
    robots = {name: RobotTable(kind="khepera4", start=[x, 0.0]) for name, x in (("A", -1.5), ("B", -1.0))}
    shape = Formation(links={"B > A": 0.5})
    swarm = Swarm(pair(robots=robots, formation=shape, prediction={"kind": "constant-velocity"})).running()
    assert swarm.robot("B").go((1.5, 0.0), swarm.t) == ""
    swarm.run(2.5)
    swarm.spoil("B", LOST["nowhere"])
    swarm.run(20.0)
    assert dist(swarm.last("A", "truth"), swarm.last("B", "truth")) > 0.4


# ---------------------------------------------------------------- positions that jump


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (shifted(0.5, 0.3), "it jumped by 0.58 m"),
        (lambda state: setattr(state, "yaw", state.yaw + 1.2), "its yaw jumped by 1.2"),
    ],
    ids=["place", "yaw"],
)
def test_wheels_that_jumped_hold_until_started(change, text):
    swarm = Swarm(pair()).running().run(0.5)
    swarm.spoil("A", change)
    swarm.run(0.5)
    (incident,) = [each for each in swarm.robot("A").hazards.incidents if text in each.text]
    assert incident.cause == Cause.POSITION
    assert swarm.last("A", "setpoint") == STILL
    assert swarm.phase("A") == RUNNING
    assert not swarm.robot("A").resume()
    assert any(swarm.run(1.0).last("A", "setpoint"))


def jump(swarm, name, lasts_s, off=1.0):
    """The measured position of a robot is `off` [m] for a time."""
    begin = swarm.t

    def spoil(state):
        if swarm.t < begin + lasts_s:
            x, y, z = state.position
            state.position = (x, y + off, z)

    swarm.spoil(name, spoil)


@pytest.mark.parametrize(("lasts_s", "lands"), [(0.01, False), (0.25, False), (0.5, True)])
def test_drone_that_jumped_lands_unless_back(lasts_s, lands):
    swarm = drone().running().run(0.3)
    place = swarm.last("F", "truth")
    jump(swarm, "F", lasts_s)
    texts = told(swarm, 2.0)["F"]
    assert (swarm.phase("F") >= LANDING) == lands
    assert texts[0].startswith("hold: its own position is lost: it jumped by 1.0")
    assert dist(swarm.last("F", "truth")[:2], place[:2]) < 0.1


@pytest.mark.parametrize("begins", ["climbing", "running", "landing"])
def test_refused_far_position_cuts_no_motors(begins):
    swarm = climbing(0.8) if begins == "climbing" else drone().running().run(0.3)
    if begins == "landing":
        swarm.robot("F").lifecycle.land("by a test")
        swarm.run(0.2)
    jump(swarm, "F", inf, off=1e5)
    while swarm.phase("F") != DONE:
        swarm.step()
        assert isnan(swarm.robot("F").now.position[0])
        assert Cause.FAR_OUTSIDE not in cause(swarm, "F")
    assert swarm.last("F", "truth")[2] < 0.05  # it has landed


@pytest.mark.slow
def test_jumped_wheels_lead_nobody_astray():
    swarm = Swarm(pair()).running().run(10.0)
    before = {name: swarm.last(name, "truth") for name in "AB"}
    jump(swarm, "A", inf)
    texts = told(swarm, 20.0)
    assert all(dist(swarm.last(name, "truth"), before[name]) < 0.01 for name in "AB")
    assert texts == {"A": ["hold: its own position is lost: it jumped by 1.00 m"], "B": []}


def test_start_order_confirms_no_jump_in_the_air():
    swarm = drone().until(AIRBORNE)
    jump(swarm, "F", inf)
    swarm.run(0.1)
    assert carry_out(swarm.robot("F"), Order("start", at=swarm.t + 0.2), swarm.t, 0.0) == ("", None)
    swarm.step()
    assert isnan(swarm.robot("F").now.position[0])


def test_refused_external_positions():
    """An external position that jumps does not reach the robot, except once it lasts on the floor."""
    swarm = drone().running().run(0.5)
    robot = swarm.robot("F")
    x, y, z = swarm.last("F", "position")
    assert robot.believes(swarm.t, (x, y, z))
    assert not robot.believes(swarm.t + 0.01, (x + 1.5, y, z))
    assert robot.believes(swarm.t + 0.02, (x, y, z))
    assert isnan(robot.believed_yaw(swarm.t, nan))


# ---------------------------------------------------------------- outside of the arena


@pytest.mark.parametrize("moment", ["climbing", "running"])
def test_drone_outside_the_arena_lands(moment):
    swarm = drone().running() if moment == "running" else climbing(0.5)
    swarm.spoil("F", put((2.2, 0.0, 0.5)))  # the arena ends at 2 m
    swarm.robot("F").resume()  # it is put there: no jump
    swarm.run(0.1)
    assert swarm.phase("F") < LANDING
    swarm.spoil("F", put((2.3, 0.0, 0.5)))
    swarm.step()
    assert (swarm.phase("F"), swarm.robot("F").lifecycle.reason) == (LANDING, "it left the arena")


def test_wheels_outside_the_arena_roll_out():
    swarm = Swarm(pair()).running()
    swarm.spoil("A", put((9.0, 0.0, 0.0)))
    swarm.robot("A").resume()
    swarm.run(0.5)
    assert [swarm.phase(name) for name in "AB"] == [DONE, RUNNING]
    assert swarm.robot("A").lifecycle.reason == "it left the arena"


# ---------------------------------------------------------------- bodies that fail


def test_stopped_motors_end_commands():
    swarm = drone().running().run(0.2)
    swarm.spoil("F", lambda state: setattr(state, "flying", False))
    swarm.step()
    assert (swarm.phase("F"), swarm.robot("F").lifecycle.reason) == (LANDING, "it came down by itself")
    swarm.step()  # the body is told to land, all the same
    assert isnan(swarm.last("F", "setpoint")[0])
    swarm.step()
    assert swarm.phase("F") == DONE


def test_dead_wheels_are_found():
    swarm = Swarm(pair()).running()
    place = swarm.last("A", "position")

    def dead(state):
        state.position, state.velocity = place, (0.0, 0.0, 0.0)

    swarm.spoil("A", dead)
    swarm.run(10.0)
    assert Cause.UNRESPONSIVE in cause(swarm, "A")
    assert swarm.phase("A") in (RUNNING, LANDING, DONE)
    assert swarm.last("A", "setpoint") == STILL or swarm.phase("A") == RUNNING


def test_stubborn_wheels_are_found():
    """Wheels that drive on although they are told to stand."""
    swarm = Swarm(pair()).running().run(0.5)
    robot = swarm.robot("A")
    assert robot.hold() == ""
    begin, (x, y, z) = swarm.t, swarm.last("A", "position")
    swarm.spoil("A", lambda state: setattr(state, "position", (x - 0.15 * (swarm.t - begin), y, z)))
    swarm.run(4.0)
    assert Cause.STRAYING in cause(swarm, "A")
    assert swarm.phase("A") >= LANDING


@pytest.mark.parametrize("ahead_s", [0.3, 100.0, inf])
def test_silent_body_with_a_fast_clock_lands(ahead_s):
    """Stamps that are ahead would never become old."""
    swarm = drone().running().run(0.5)
    swarm.spoil("F", frozen(swarm.t + ahead_s))
    swarm.run(1.5)
    assert swarm.phase("F") >= LANDING
    assert swarm.robot("F").lifecycle.reason == "its own position is lost"


# ---------------------------------------------------------------- laws and neighbours


class Mad(Distance, frozen=True):
    """Wants nothing that is a number of neighbours that are near."""

    def pull(self, apart, link):
        near = abs(apart[0]) < 0.7
        return (nan if near else 0.1 * -apart[0], 0.0, 0.0)


@pytest.mark.parametrize("kind", ["khepera4", "crazyflie", "tello"])
def test_law_that_wants_nonsense_is_stopped(kind, monkeypatch):
    monkeypatch.setattr(Plan, "law", Mad())
    hover = None if kind == "khepera4" else 0.6
    robots = {name: RobotTable(kind=kind, start=[x, 0.0], hover=hover) for name, x in (("A", -0.4), ("B", 0.4))}
    swarm = Swarm(pair(robots=robots)).running()
    swarm.run(12.0)
    for name in "AB":
        assert all(isfinite(each) or isnan(each) for setpoint in swarm.column(name, "setpoint") for each in setpoint)
        assert Cause.SETPOINT in cause(swarm, name)
        assert swarm.phase(name) >= LANDING or swarm.last(name, "setpoint")[:2] == (0.0, 0.0)


def test_nonsense_is_known_before_take_off(monkeypatch):
    monkeypatch.setattr(Plan, "law", Mad())
    swarm = Swarm(small({"A": "khepera4", "B": "khepera4"}, {"A - B": 0.5}))
    swarm.run(0.2)
    life = swarm.robot("A").lifecycle
    assert (life.phase, life.reason) == (IDLE, "its law wants something that is not finite")
    assert life.takeoff()


def test_robots_that_nearly_touch_land():
    swarm = Swarm(pair(safety=Safety(separation=0.3))).running().run(0.5)
    x, y, z = swarm.last("A", "position")
    swarm.robot("A").neighbours.receive(0, (x + 0.14, y, z), (0.0, 0.0, 0.0), 99.0, 99.0)
    swarm.step()
    swarm.step()
    assert swarm.phase("A") >= LANDING
    assert swarm.robot("A").lifecycle.reason == "far too near to another robot"
    assert swarm.phase("B") == RUNNING  # it knows better where it is itself


def test_robots_too_near_stop_and_go_on():
    experiment = pair(formation=Formation(links={"A - B": 0.35}), safety=Safety(separation=0.3))
    swarm = Swarm(experiment).running().run(0.5)
    x, y, _ = swarm.last("A", "position")
    swarm.robot("A").neighbours.receive(0, (x + 0.25, y, 0.0), (0.0, 0.0, 0.0), swarm.t, swarm.t)
    swarm.muted.add(("B", "A"))
    swarm.run(0.3)
    assert Cause.SEPARATION in cause(swarm, "A")
    held = swarm.last("A", "goal")
    assert swarm.run(0.3).last("A", "goal") == held
    swarm.muted.clear()
    assert swarm.run(1.0).last("A", "goal") != held
    assert swarm.phase("A") == RUNNING


# ---------------------------------------------------------------- phases


def test_drone_goes_through_its_phases():
    swarm = drone(duration_s=1.0).until(DONE)
    phases, setpoints = swarm.column("F", "phase"), swarm.column("F", "setpoint")
    for phase, setpoint in zip(phases, setpoints, strict=True):
        if AIRBORNE <= phase <= RUNNING:
            assert all(map(isfinite, setpoint))
        else:
            assert all(map(isnan, setpoint))  # the body acts by itself
    assert sorted(set(phases)) == [int(phase) for phase in Phase if phase != IDLE]
    assert phases == sorted(phases)
    assert swarm.last("F", "truth")[2] == 0.0


def test_wheels_stand_unless_they_run():
    swarm = Swarm(pair(duration_s=1.0)).until(DONE)
    for name in "AB":
        rows = list(zip(swarm.column(name, "phase"), swarm.column(name, "setpoint"), strict=True))
        assert not any(any(setpoint) for phase, setpoint in rows if not AIRBORNE <= phase <= RUNNING)
        assert any(any(setpoint) for phase, setpoint in rows if phase == RUNNING)


def trouble(rng, swarm, name):
    """One thing that goes wrong with a robot."""
    robot = swarm.robot(name)
    x, y, z = (rng.uniform(-3.0, 3.0) for _ in range(3))
    return rng.choice([
        lambda: swarm.spoil(name, put((x, y, z))),
        lambda: swarm.spoil(name, rng.choice(list(LOST.values()))),
        lambda: swarm.spoil(name, frozen(swarm.t + rng.choice([0.0, 50.0]))),
        lambda: swarm.spoil(name, shifted(x, y)),
        lambda: swarm.spoil(name, None),
        lambda: swarm.spoil(name, lambda state: setattr(state, "velocity", (x * 9.0, nan, z))),
        lambda: swarm.lose(rng.choice([each for each in swarm.names if each != name]), name),
        lambda: swarm.find(rng.choice([each for each in swarm.names if each != name]), name),
        lambda: setattr(robot.health, "offline_since", swarm.t),
        robot.hold,
        robot.resume,
        robot.lifecycle.takeoff,
        lambda: robot.start(swarm.t),
        lambda: robot.lifecycle.land("told to"),
        lambda: robot.lifecycle.stop("told to"),
    ])  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_whatever_happens_no_robot_comes_up_again(seed):
    rng = random.Random(seed)
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.6),
        "T": RobotTable(kind="tello", start=[0.6, 0.0], hover=0.8),
        "K": RobotTable(kind="khepera4", start=[0.0, 0.7]),
    }
    links = {"F - T": 0.7, "K - F": 0.8, "K - T": 0.9}
    barrier = {"kind": "barrier", "hears": "all"}
    swarm = Swarm(small(robots, links, duration_s=60.0, avoidance=barrier)).running().run(1.0)
    for _ in range(25):
        trouble(rng, swarm, rng.choice(swarm.names))()
        swarm.run(rng.uniform(0.05, 0.8))
    for name in swarm.names:
        swarm.robot(name).lifecycle.land("the end")
    swarm.until(DONE, most_s=40.0)
    for name in swarm.names:
        phases = swarm.column(name, "phase")
        assert phases == sorted(phases)
        assert phases[-1] == DONE
        down = phases.index(DONE)
        heights = [place[2] for place in swarm.column(name, "truth", down)]
        assert heights == sorted(heights, reverse=True)
        assert all(not isfinite(each) or abs(each) < 50.0 for s in swarm.column(name, "setpoint") for each in s)
        assert all(isnan(s[0]) or not any(s) for s in swarm.column(name, "setpoint", down))


def test_landed_drone_refuses_to_climb():
    swarm = drone(duration_s=0.5).until(DONE)
    robot = swarm.robot("F")
    assert all((robot.lifecycle.takeoff(), robot.start(swarm.t), robot.hold())), "reasons"
    assert swarm.run(1.0).last("F", "truth")[2] == 0.0
    assert swarm.phase("F") == DONE > READY
