"""Consequences of an experiment: graph, rigidity, assignments, channels of links, standby, spares, new kinds."""

import math
from dataclasses import replace
from itertools import permutations

import msgspec
import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from agents.body.interface import BodyError, BodyState, Disturbance, Jitter
from agents.body.kinds import KINDS, Kind
from agents.body.limits import Safety
from agents.errors import Refusal
from agents.network import channel_model, messages
from agents.plugins.laws import Distance
from agents.plugins.planners import Line
from agents.plugins.triggers import Periodic, SendOnDelta
from agents.robot import Robot
from bridges.turtlebot3.kind import TURTLEBOT3
from experiments import run
from experiments.check.analysis import Analysis
from experiments.check.ideal_run import predict
from experiments.definition import bodies, link_conditions
from experiments.definition import standby as reserves
from experiments.definition.experiment import (
    Arena,
    ChannelTable,
    Formation,
    Hybrid,
    LegTable,
    LinkChannelTable,
    LinkTable,
    Outage,
    Rates,
    RobotTable,
    Start,
)
from experiments.definition.graph import adjacency, components, degree, edges, links, reachable
from experiments.definition.plan import Plan
from experiments.definition.rigidity import bend, redundancy, rigidity
from experiments.file import document
from experiments.file.consistency.whole import consistency_faults
from experiments.file.document import load, loads
from experiments.file.problems import DocumentError
from experiments.real_time.conductor.hot_changes import Spares
from experiments.report import style, trajectories
from tests.cases import examples
from tests.experiments.checked import PUBLISHED
from tests.small import changed, reference, small
from twins.scene import Obstacle

# paper, eq. (11): rows from which each robot receives
HEARS = {1: (0, 2, 3, 4), 2: (1, 3, 5), 3: (0, 1, 2, 5), 4: (0, 1, 5, 6), 5: (2, 3, 4, 6), 6: (4, 5)}
REFERENCE = links([(listener, speaker) for listener, heard in HEARS.items() for speaker in heard])


@examples(40)
@given(st.integers(1, 9), st.data())
def test_graph_is_that_of_networkx(rows, data):
    every = [*permutations(range(rows), 2)]
    pairs = data.draw(st.lists(st.sampled_from(every), unique=True, max_size=30)) if every else []
    net, graph = links(pairs), nx.DiGraph(pairs)  # an arrow from receiver to sender, as in the adjacency matrix
    graph.add_nodes_from(range(rows))
    a = nx.to_numpy_array(graph, nodelist=range(rows))
    np.testing.assert_array_equal(adjacency(net, rows), a)
    np.testing.assert_array_equal(np.diag(degree(net, rows)), a.sum(axis=1))
    assert components(net, rows) == nx.number_weakly_connected_components(graph)
    assert {tuple(edge) for edge in edges(net).tolist()} == {tuple(sorted(pair)) for pair in pairs}
    sources = data.draw(st.lists(st.integers(0, rows - 1), unique=True, max_size=3))
    told = set(sources).union(*(nx.ancestors(graph, source) for source in sources))  # arrows point at the speaker
    assert {*np.flatnonzero(reachable(net, rows, np.array(sources, dtype=np.intp))).tolist()} == told


def test_links_take_pairs_with_or_without_targets():
    path = links([(1, 0), (0, 1), (2, 1), (1, 2)])
    assert adjacency(path, 3).tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0]]
    assert np.isnan(path.distance).all()
    assert links([(1, 0), (2, 0)], 0.6, 3.0).distance.tolist() == [0.6, 0.6]
    assert links([(1, 0), (2, 0)], 0.6, [3.0, 4.0]).gain.tolist() == [3.0, 4.0]
    nothing = links([], [], [])
    assert (len(nothing), len(edges(nothing)), components(nothing, 4)) == (0, 0, 4)


def held_heights(rows):
    return np.tile([True, True, False], (rows, 1))


def test_reference_formation_is_rigid_only_with_heights_held():
    pairs = edges(REFERENCE)
    assert (len(REFERENCE), len(pairs)) == (21, 12)
    assert np.flatnonzero(~reachable(REFERENCE, 7, np.array([6]))).tolist() == [0]
    held, free = rigidity(PUBLISHED, pairs, held_heights(7)), rigidity(PUBLISHED, pairs)
    assert (held.rank, held.needed, held.rigid, held.smallest > 0.1) == (11, 2 * 7 - 3, True, True)
    assert (free.rank, free.needed, free.rigid, free.smallest) == (12, 3 * 7 - 6, False, 0.0)


@pytest.mark.parametrize(
    ("position", "free", "motions"),
    [
        ([[0, 0, 0]], "xyz", 3),  # one point: it cannot be seen to turn
        ([[0, 0, 0], [1, 0, 0]], "xyz", 5),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "xyz", 6),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "xy", 3),
        ([[0, 0, 0], [1, 0, 0.8], [2, 0, 0.3]], "xy", 4),  # in a vertical plane: it may also lean out of it
        ([[0, 0, 0], [1, 0, 0.8], [2, 1, 0.3]], "z", 1),
        ([[0, 0, 0], [1, 0, 0.8]], "", 0),
    ],
)
def test_rigid_motions_that_held_coordinates_allow(position, free, motions):
    position = np.array(position, dtype=float)
    moves = np.tile([axis in free for axis in "xyz"], (len(position), 1))
    assert rigidity(position, np.array([[0, len(position) - 1]]), moves).needed == moves.sum() - motions


HEXAGON = [[math.cos(k * math.pi / 3), math.sin(k * math.pi / 3), 0.0] for k in range(6)]
RING = [(k, (k + 1) % 6) for k in range(6)]
VEE = [[0, 0, 0], [-0.3, -0.4, 0], [0.3, -0.4, 0], [-0.6, -0.8, 0], [0.6, -0.8, 0]]
ARMS = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 4)]


@pytest.mark.parametrize(
    ("position", "pairs", "rank", "low", "high"),
    [
        ([[0, 0, 0], [0.5, 0, 0], [1, 0, 0]], [(0, 1), (1, 2), (0, 2)], 2, 0.04, 0.07),
        (HEXAGON, [*RING, (0, 3), (1, 4), (2, 5)], 8, 0.02, 0.05),
        (HEXAGON, [*RING, (0, 2), (2, 4), (4, 0)], 9, 0.001, 0.006),
        (VEE, [*ARMS, (0, 3), (0, 4)], 5, 0.03, 0.15),
        (VEE, [*ARMS, (2, 3), (1, 4)], 7, 0.001, 0.01),
        (HEXAGON[:4], RING[:3], 3, math.inf, math.inf),  # a chain that nothing holds
    ],
)
def test_frameworks_that_bend_to_first_order(position, pairs, rank, low, high):
    """A solver ends some micrometres from such a shape; noise of 2 mm moves a robot by centimetres."""
    solved = np.array(position) + 2e-6 * np.random.default_rng(1).normal(size=(len(position), 3)) * [1, 1, 0]
    held = held_heights(len(position))
    assert rigidity(solved, np.array(pairs), held).rank == rank
    assert low <= bend(solved, np.array(pairs), 0.002, held).way <= high


def one_by_one(position, pairs, free):
    """Rigidity of the rest without each link, and without each robot."""
    without_link = [rigidity(position, np.delete(pairs, k, axis=0), free) for k in range(len(pairs))]
    without_robot = []
    for row in range(len(position)):
        rest = pairs[(pairs != row).all(axis=1)]
        left = rigidity(np.delete(position, row, axis=0), rest - (rest > row), np.delete(free, row, axis=0))
        without_robot.append(left)
    return without_link, without_robot


@examples(60)
@given(st.integers(0, 2**32 - 1), st.integers(3, 9), st.sampled_from([0.5, 0.7, 0.9]), st.booleans())
def test_redundancy_is_that_of_leaving_each_out(seed, rows, share, in_space):
    """Where a singular value is near the limit of zeros the two ways may differ."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, (rows, 3))
    free = np.ones((rows, 3), dtype=bool) if in_space else held_heights(rows)
    every = np.stack(np.triu_indices(rows, 1), axis=1)
    pairs = every[rng.random(len(every)) < share].reshape(-1, 2)
    found = redundancy(position, pairs, free)
    parts = one_by_one(position, pairs, free)
    assume(not any(1e-7 < left.smallest < 1e-3 for part in parts for left in part))
    whole = rigidity(position, pairs, free).rigid
    wanted = tuple([whole and left.rigid for left in part] for part in parts)
    assert (found.pairs.tolist(), found.robots.tolist()) == wanted


NAMES = ("TB01", "KH01", "KH02", "KH03", "CF01", "CF02", "CF03")


@pytest.fixture(scope="module")
def reference_plan():
    return Plan(reference("periodic"))


def test_part_of_the_leader(reference_plan):
    made = reference_plan.assignment("TB01")
    assert (made.name, made.kind, made.neighbours, made.guided) == ("TB01", TURTLEBOT3, (), False)
    assert (made.law, made.trigger, math.isnan(made.hover)) == (Distance(), Periodic(period_s=0.02), True)
    assert (made.clamp, made.tracking_gain, made.duration, made.patience_s) == (0.1, 3.0, 45.0, None)
    assert (made.body_hz, made.pose_every, made.decide_every) == (100.0, 2, 10)
    assert [(leg.at, leg.planner) for leg in made.legs] == [(21.0, Line(move_by=[0.75, 0.0], speed_=0.15))]
    assert [reference_plan.assignment(name).ground for name in NAMES] == [0.0] * 4 + [0.8] * 3


def test_links_of_the_paper(reference_plan):
    """Eq. (11) and figure 11: 12 edges, three of them from the leader only."""
    net = reference_plan.links
    assert {i: tuple(net.sender[net.receiver == i].tolist()) for i in range(1, 7)} == HEARS
    assert 0 not in net.receiver
    distance = {(NAMES[i], NAMES[j]): d for i, j, d in zip(net.receiver, net.sender, net.distance, strict=True)}
    assert distance["KH01", "KH03"] == distance["KH03", "KH01"] == pytest.approx(0.6 * math.sqrt(2))
    assert distance["CF01", "TB01"] == distance["KH02", "CF02"] == 0.86
    drones = {4, 5, 6}
    by_drone = [bool({i, j} & drones) for i, j in zip(net.receiver.tolist(), net.sender.tolist(), strict=True)]
    np.testing.assert_array_equal(net.gain, np.where(by_drone, 1.0, 3.0))
    for row, name in enumerate(NAMES):
        known = reference_plan.assignment(name).neighbours
        assert [link.sender for link in known] == net.sender[net.receiver == row].tolist()
        assert [link.distance for link in known] == net.distance[net.receiver == row].tolist()
        assert all(link.name == NAMES[link.sender] and link.in_law for link in known)


def three(**parts):
    robots = {
        "A": RobotTable(kind="khepera4", start=[0.5, -0.5, 1.5]),
        "B": RobotTable(kind="crazyflie", start=[0.0, 0.25], hover=0.7),
        "C": RobotTable(kind="turtlebot3", start=[-0.5, 0.0]),
    }
    return Plan(small(robots, **parts))


def test_bodies_start_on_the_floor_with_a_yaw(reference_plan):
    made = bodies.body_request(reference_plan, NAMES, 5)
    assert (made.names, made.seeds, made.addresses, made.rate_hz) == (NAMES, (5,) * 7, ("twin",) * 7, 100.0)
    assert (made.start[0], made.start[4]) == ((-0.6, 0.8, 0.0), (-0.2, 0.4, 0.0))
    assert three().start_poses() == ([(0.5, -0.5, 0.0), (0.0, 0.25, 0.0), (-0.5, 0.0, 0.0)], [1.5, 0.0, 0.0])


def test_limits_are_arena_and_safety_of_the_file():
    safety = Safety(speed=0.3, max_goal_distance=0.2, margin=0.1)
    made = three(arena=Arena(size=(2.0, 3.0, 4.0)), safety=safety).limits("A")
    assert (made.low, made.high) == ((-1.0, -1.5, 0.0), (1.0, 1.5, 4.0))
    assert (made.speed, made.max_goal_distance, made.margin) == (0.3, 0.2, 0.1)
    assert (made.position_timeout_s, made.neighbour_timeout_s) == (0.5, 1.0)
    assert three().limits("A").top_speed == np.inf


def test_late_positions_matter_to_kinds_and_bodies():
    for kind, body, position, late_s, behind_s in (
        ("crazyflie", "radio://0/80/2M", "external", 0.15, 0.1),
        ("crazyflie", "crazyflie-twin", "external", 0.15, 0.1),
        ("crazyflie", "crazyflie-twin", "body", math.inf, 0.25),
        ("crazyflie", "twin", "external", math.inf, 0.25),
        ("tello", "tello-twin", "external", math.inf, 0.25),
        ("khepera4", "khepera4-twin", "external", math.inf, 0.25),
    ):
        hover = 0.5 if KINDS[kind].flies else None
        robot = RobotTable(kind=kind, start=[0.0, 0.0], hover=hover, body=body, position=position)
        limits = Plan(small({"A": robot})).limits("A")
        assert (limits.late_s, limits.behind_s) == (late_s, pytest.approx(behind_s))


def test_links_may_have_gains_of_their_own():
    given = {"A > B": LinkTable(distance=0.5, gain=7.0), "B - C": 0.6, "C > A": LinkTable(distance=1.0)}
    net = three(formation=Formation(gain=2.0, links=given)).links
    table = zip(*(column.tolist() for column in (net.receiver, net.sender, net.distance, net.gain)), strict=True)
    assert list(table) == [(0, 2, 1.0, 2.0), (1, 0, 0.5, 7.0), (1, 2, 0.6, 2.0), (2, 1, 0.6, 2.0)]


def test_who_leads():
    def leaders(*links, leader=None):
        return list(three(formation=Formation(links=dict.fromkeys(links, 1.0), leader=leader)).leaders)

    assert leaders() == leaders("A - B", "B > C") == []  # no robot receives, or all
    assert (leaders("A > B", "A > C"), leaders("A > B")) == (["A"], ["A", "C"])
    assert leaders("A - B", leader="B") == ["B"]


def test_disturbances_merge_field_by_field_the_narrower_wins():
    given = {
        "all": Disturbance(position_sigma=0.001, yaw_sigma=0.01, latency_s=0.1),
        "crazyflie": Disturbance(hover_jitter=Jitter(0.01), latency_s=0.2),
        "B": Disturbance(position_sigma=0.0),
    }
    made = three(disturbance=given)
    assert made.disturbance("A") == given["all"]
    assert made.disturbance("B") == Disturbance(Jitter(0.01), 0.0, 0.01, 0.2)
    assert three().disturbance("A") == Disturbance()


def test_rates_patience_and_triggers():
    rates = Rates(body_hz=200.0, pose_hz=40.0, coordination_hz=20.0)
    trigger = {"kind": "send-on-delta", "threshold": 0.02, "maximum_silence_s": 1.0}
    made = three(rates=rates, start=Start(deadline_s=7.0, missing="go-on"), trigger=trigger).assignment("A")
    assert (made.body_hz, made.pose_every, made.decide_every, made.patience_s) == (200.0, 5, 10, 7.0)
    assert made.trigger == SendOnDelta(threshold=0.02, maximum_silence_s=1.0)
    with pytest.raises(msgspec.ValidationError, match="threshold"):
        three(trigger={**trigger, "threshold": -1.0}).assignment("A")


def test_robots_are_not_scattered_into_obstacles():
    robots = {name: RobotTable(kind="khepera4", start=[-0.5, y]) for name, y in (("A", -0.5), ("B", 0.5))}
    arena = Arena(obstacles={"post": Obstacle(radius=0.3, at=(0.0, 0.0))})
    plan = Plan(small(robots, arena=arena, start=Start(scatter=0.6)))
    place = np.array([bodies.scattered_poses(plan, ("A", "B"), seed)[0] for seed in range(100)])
    gap = np.hypot(place[..., 0], place[..., 1]) - 0.3 - 0.07
    assert bodies.CLEAR < gap.min() < 0.1  # it is near enough to be in the way


CONNECTED = ("A", "B", "C")
CHANNELS = {"A - B": 0.5, "A > C": 0.5, "B > C": 0.5}
ENDS = (("B", "A"), ("A", "B"), ("A", "C"), ("B", "C"))  # sender and receiver of each link


def planned(channel=None, **parts):
    return Plan(small(dict.fromkeys(CONNECTED, "khepera4"), CHANNELS, channel=channel or ChannelTable(), **parts))


def conditions(channel, seed=1, **how):
    return link_conditions.conditions_of(planned(channel), ENDS, seed, **how)


def test_default_delay_is_a_millisecond_or_nothing_really():
    late = ChannelTable(delay_s=0.02)
    for channel, real, delay in ((ChannelTable(), False, 0.001), (ChannelTable(), True, 0.0), (late, True, 0.02)):
        assert [link.delay for link in conditions(channel, real=real)] == [delay] * 4
    assert not link_conditions.models_network(planned())
    assert link_conditions.models_network(planned(ChannelTable(loss=0.1)))


def test_links_have_their_own():
    own = {"A > C": LinkChannelTable(loss=0.3, burst=4.0), "A - B": LinkChannelTable(delay_s=0.1, bandwidth=1e4)}
    made = conditions(ChannelTable(loss=0.1, jitter_s=0.01, links=own))
    assert [link.key for link in made] == [channel_model.key(1, *names) for names in ENDS]  # by the seed
    found = [(link.loss, link.burst, link.delay, link.bandwidth, link.jitter, link.queue) for link in made]
    both, of_c, usual = (0.1, np.nan, 0.1, 1e4), (0.3, 4.0, 0.001, np.inf), (0.1, np.nan, 0.001, np.inf)
    np.testing.assert_array_equal(found, [(*each, 0.01, 0.5) for each in (both, both, of_c, usual)])


def test_outages_of_links_of_robots_and_of_all():
    outages = [
        Outage(from_s=1.0, until_s=2.0),
        Outage(from_s=3.0, links=["A > B", "B > C"]),
        Outage(from_s=4.0, until_s=5.0, robots=["B"]),
    ]
    every, some, of_robot = (1.0, 2.0), (3.0, np.inf), (4.0, 5.0)
    found = [[*link.outages] for link in conditions(ChannelTable(outages=outages))]
    assert found == [[every, of_robot], [every, some, of_robot], [every], [every, some, of_robot]]


def test_what_is_possible_is_accepted():
    own = {"A > B": LinkChannelTable(loss=0.1)}
    mixed = ChannelTable(loss=0.5, burst=2.0, links=own, outages=[Outage(from_s=0.0)])
    for channel in (mixed, ChannelTable(loss=1.0, burst=3.0)):
        assert list(consistency_faults(planned(channel))) == []


def test_links_of_avoidance_alone_are_links():
    channel = ChannelTable(links={"C > A": LinkChannelTable(loss=0.5)})
    plan = planned(channel, avoidance={"kind": "potential", "hears": "all"})
    assert list(consistency_faults(plan)) == []
    links = plan.pose_links
    ends = [(CONNECTED[j], CONNECTED[i]) for i, j in zip(links.receiver, links.sender, strict=True)]
    made = link_conditions.conditions_of(plan, ends, 1)
    assert [pair for pair, link in zip(ends, made, strict=True) if link.loss] == [("C", "A")]


BOT = RobotTable(kind="khepera4", start=[0.0, 0.0])
FLY = RobotTable(kind="crazyflie", start=[0.5, 0.5], hover=0.5)


def with_standby(**parts):
    robots = {"A": BOT, "B": changed(BOT, start=[0.5, 0.0]), "C": changed(FLY, standby=True)}
    return small(robots, {"A - B": 0.5, "A - C": 0.7, "C > B": 0.7}, duration_s=5.0, **parts)


def test_without_those_on_standby_nothing_names_them():
    whole = with_standby(
        timeline=[LegTable(at_s=1.0, robot="C", plan="hold")],
        architecture=Hybrid("hybrid", ["A", "C"]),
        channel=ChannelTable(
            links={"A > C": LinkChannelTable(loss=0.5), "A > B": LinkChannelTable(loss=0.1)},
            outages=[Outage(from_s=1.0, links=["A - C"]), Outage(from_s=2.0, robots=["B", "C"]), Outage(from_s=3.0)],
        ),
    )
    plan = reserves.without_standby(Plan(whole))
    made = plan.experiment
    assert ([*made.robots], made.formation.links, made.timeline) == (["A", "B"], {"A - B": 0.5}, [])
    assert list(made.channel.links) == ["A > B"]
    assert [(outage.from_s, outage.robots) for outage in made.channel.outages] == [(2.0, ["B"]), (3.0, [])]
    assert made.architecture == Hybrid("hybrid", ["A"])
    assert not list(consistency_faults(plan))
    assert not list(consistency_faults(Plan(with_standby(spares={"S": FLY, "T": BOT}, on_loss="replace"))))
    assert reserves.without_standby(plan) is plan


def test_virtual_time_flies_without_those_on_standby(tmp_path):
    file = tmp_path / "x.json"
    file.write_bytes(document.write_json(Plan(with_standby())))
    (trace,) = run.simulate(document.read(file)).traces.values()
    assert trace.robots == ("A", "B")


@pytest.mark.parametrize("standby", [True, False])
def test_nobody_waits_for_a_robot_on_standby(standby):
    case = with_standby()
    robot = Robot(Plan(changed(case, robots={**case.robots, "C": changed(FLY, standby=standby)})).assignment("A"))
    assert robot.missing_neighbours() == ["B", "C"]
    place = [link.name for link in robot.assignment.neighbours].index("B")
    robot.neighbours.mark_alive(place)
    robot.neighbours.receive(place, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0)
    state = BodyState(time=0.0, position=(0.0, 0.0, 0.0), yaw=0.0, velocity=(0.0, 0.0, 0.0), flying=False, battery=1.0)
    for tick in range(3):
        robot.transmit(0.01 * tick, state)
        robot.act(0.01 * tick)
    assert (robot.lifecycle.phase > 0) == standby
    assert robot.missing_neighbours() == ["C"]


def order(**more):
    return messages.RunOrder("replace", ["A"], **more)


def test_spare_brings_its_body_and_keeps_the_rest():
    spare = changed(BOT, start=[0.2, 0.3, 1.0], body="khepera4://192.0.2.1", avoids=False)
    spares = Spares(Plan(with_standby(spares={"F": FLY, "S": spare})))
    old = changed(BOT, ranges="world")
    robot, whose = spares.successor("A", old, order())  # the first of its kind
    assert (whose, robot) == ("S", changed(spare, avoids=True))
    spares.used["S"] = "A"
    with pytest.raises(Refusal, match="no spare khepera4 left"):
        spares.successor("A", old, order())
    robot, whose = spares.successor("A", old, order(body="twin", at=(0.5, 0.25), yaw=1.0))
    assert (robot.body, robot.start, whose) == ("twin", [0.5, 0.25, 1.0], None)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (order(spare="F"), "is a crazyflie and cannot be A"),
        (order(spare="G"), "no spare 'G'"),
        (order(spare="S", body="twin"), "leave --body or --with out"),
        (order(body="tello-twin"), "before the run only"),
        (order(body="nowhere://1"), "no 'nowhere'"),
        (order(body="world"), "into the world"),
        (order(body="twin", at=(99.0, 0.0)), "outside of the arena"),
        (order(body="twin", at=(float("nan"), 0.0)), "outside of the arena"),
        (order(body="twin", at=(0.0, 0.0), yaw=float("inf")), "outside of the arena"),
        (order(body="khepera4://192.0.2.1", at=(0.0, 0.0)), "only a twin"),
    ],
)
def test_what_cannot_take_over_a_name(asked, said):
    with pytest.raises(Refusal, match=said):
        Spares(Plan(with_standby(spares={"F": FLY, "S": BOT}))).successor("A", BOT, asked)


KIND = "alphabot"
COUNT = style.MAX_COLOURED_ROBOTS
ROBOTS = [f'[robots.R{k}]\nkind = "{KIND}"\nstart = [{k - 5}.0, 0.0]\n' for k in range(COUNT + 1)]
LINKS = [f'"R{k} > R{k + 1}" = 1.0\n' for k in range(COUNT)]
HALL = 'title = "Rovers"\nduration_s = 2.0\n[arena]\nsize = [12.0, 4.0, 2.0]\n'
ROVERS = "".join([HALL, *ROBOTS, "[formation.links]\n", *LINKS])
ALPHABOT = Kind(
    KIND, "twist", flies=False, radius=0.11, height=0.08, mass=0.8, endurance_s=3600.0, speed=0.3, turn_rate=2.0,
    response=1.0, turn_response=1.5,
)  # fmt: skip
MOVING = replace(ALPHABOT, motion=KINDS["khepera4"].motion)


@pytest.mark.parametrize(("motion", "takes"), [(None, "twist"), (KINDS["khepera4"].motion, "velocity")])
def test_kind_without_twin_is_refused_at_its_place(monkeypatch, motion, takes):
    """Without a motion model, or on the floor with velocities: an omnidirectional robot."""
    monkeypatch.setitem(KINDS.loaded, KIND, replace(ALPHABOT, motion=motion, takes=takes))
    with pytest.raises(DocumentError) as caught:
        loads(ROVERS)
    first = caught.value.problems[0]
    assert (first.line, first.message) == (6, f"no twin of '{KIND}'")
    with pytest.raises(ValueError, match="it must be one of position, velocity, twist"):
        replace(MOVING, takes="wheels")


def test_kind_without_protocol_twin_is_refused_by_name(monkeypatch):
    monkeypatch.setitem(KINDS.loaded, KIND, MOVING)
    with pytest.raises(BodyError, match=f"--bodies protocol: no protocol twin of '{KIND}', only of crazyflie"):
        bodies.choose_bodies(loads(ROVERS).plan, "protocol")
    assert bodies.choose_bodies(load("triangle").plan, "protocol")


def test_many_robots_of_an_uncoloured_kind_are_drawn(monkeypatch):
    monkeypatch.setitem(KINDS.loaded, KIND, MOVING)
    cases = loads(ROVERS).cases()
    figure = trajectories.expected_motion({name: Analysis(case, predict(case)) for name, case in cases.items()})
    assert ALPHABOT.colour in {line.get_color() for line in figure.axes[0].lines}
