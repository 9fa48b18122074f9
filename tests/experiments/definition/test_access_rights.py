"""The rights that follow from an experiment, row by row: who, which key, what."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.network.access_control import rules, sizes
from agents.network.keys import Keys
from agents.network.lab import ROLES, Identity, LabError, Register
from experiments.definition import access_rights
from experiments.definition.bodies import choose_bodies
from experiments.definition.experiment import Experiment, Formation, Hybrid, NetworkTable, RobotTable
from experiments.definition.plan import Plan
from experiments.file.document import load
from tests.agents.acl import ACTIONS, held, may, permitted
from tests.cases import examples, for_each
from tests.small import changed, reference

KEYS = Keys()
ROBOTS = ("R0", "R1", "R2", "R3")
OUTSIDER = "mallory"


def control(*experiments, **identities):
    """Rules of a lab that has everybody, each under its own name if `identities` gives no other."""
    names = {robot: "robot" for each in experiments for robot in each.robots} | {role: role for role in ROLES[1:]}
    known = {name: Identity(role, name, "1", "2100-01-01") for name, role in names.items()}
    return rules(access_rights.rights([Plan(each) for each in experiments]), Register({**known, **identities}))


def four_robots(links, processes=(), architecture="distributed", **more):
    robots = {f"R{k}": RobotTable(**{"kind": "khepera4", "start": [0.1 * k, 0.0], **more}) for k in range(4)}
    for group, names in enumerate(processes):
        for name in names:
            robots[name] = changed(robots[name], process=f"shared{group}")
    formation = Formation(links={f"R{a} > R{b}": 0.5 for a, b in links})
    return Experiment(title="Four", robots=robots, duration_s=1.0, formation=formation, architecture=architecture)


WHAT = ("pose", "state", "status", "ranges", "setpoint", "order", "alive", "position", "goal", "truth")
READ, WRITE = ("hear", "last"), ("put", "keep")


def wanted(who, *, own, heard, guided):
    """Actions and `what` that `who` may on `park/<robot>/<what>`; `own`: of its process, `heard`: by a link."""
    goal = {*product(WRITE, ["goal"])} if guided else set()
    match who:
        case "observer" | "recorder" | "operator":
            asks = {"observer": ["pose"], "recorder": [], "operator": ["pose", "order"]}[who]
            return {*product((*READ, "watch"), WHAT), *product(["ask"], asks)}
        case "world":  # no robot of these lives in one
            return {*product(READ, ("setpoint", "status", "state")), ("watch", "alive")}
        case "centre":
            return {*goal, *product(READ, ("pose", "status")), ("watch", "alive")}
        case "ros2":
            return {*goal, *product(READ, ("state", "ranges", "status")), ("watch", "alive")}
        case robot if robot.startswith("R"):
            found = {*product(READ, ["pose"]), ("watch", "alive")} if heard else set()
            if own:
                found |= {*product((*WRITE, "answer", "watch"), WHAT), ("be", "alive")}
                found |= {*product(READ, ("position", "ranges", *(["goal"] if guided else [])))}
            return found
    return set()  # router, positioning, twin: nothing here to measure; and whoever is not in the lab


LINKS = st.sets(st.tuples(st.integers(0, 3), st.integers(0, 3)).filter(lambda pair: pair[0] != pair[1]), max_size=6)
GROUPS = st.sampled_from([(), (("R0", "R1"),), (("R0", "R3"), ("R1", "R2"))])
GUIDED = st.sampled_from([(), ("R0", "R1"), ROBOTS])
ARCHITECTURES = {0: "distributed", 2: Hybrid("hybrid", ["R0", "R1"]), 4: "centralised"}


@pytest.mark.slow
@examples(15)
@given(links=LINKS, groups=GROUPS, guided=GUIDED)
def test_every_right_is_the_wanted_one(links, groups, guided):
    made = control(four_robots(links, groups, ARCHITECTURES[len(guided)]))
    for who in (*ROBOTS, *ROLES[1:], OUTSIDER):
        mates = next((group for group in groups if who in group), (who,))
        heard = {f"R{a}" for a, b in links if f"R{b}" in mates and f"R{b}" not in guided}  # these need no neighbours
        for robot in ROBOTS:
            right = wanted(who, own=robot in mates, heard=robot in heard, guided=robot in guided)
            found = {(a, what) for a, what in product(ACTIONS, WHAT) if may(made, who, a, f"park/{robot}/{what}")}
            assert found == right, (who, robot, links, groups, guided)


@for_each(
    "who, action, keys",
    [
        ("operator", "put", [KEYS.estop]),
        ("operator", "keep", [KEYS.event, KEYS.experiment]),
        ("operator", "ask", [KEYS.world_order, KEYS.run_order]),
        ("operator", "answer", [KEYS.run_order]),
        ("observer", "ask", ["park/*/pose"]),
        ("observer R0", "hear", [KEYS.estop]),
        ("observer", "last", [KEYS.everything, "park/*/pose"]),
        ("recorder", "be", [KEYS.recorder]),
        ("recorder", "put", [KEYS.scene]),
        ("ros2", "hear", [KEYS.scene]),
        ("recorder", "last", [KEYS.centre]),
        ("world", "keep", [KEYS.world]),
        ("world", "put", [KEYS.contact, KEYS.world_event]),
        ("world", "answer", [KEYS.world_order]),
        ("world", "be", [KEYS.world_alive]),
        ("world", "watch", ["park/*/alive"]),
        ("world", "hear", ["park/*/setpoint"]),
        ("centre", "keep", [KEYS.centre]),
        ("centre", "be", [KEYS.centre_alive]),
        ("ros2 R0", "watch", [KEYS.centre_alive]),
    ],
)
def test_what_keeps_an_experiment_going_is_allowed(who, action, keys):
    made = control(four_robots({(0, 1)}, architecture="centralised"))
    assert [key for each, key in product(who.split(), keys) if not may(made, each, action, key)] == []


def test_robot_holds_its_own_tokens_alone():
    made, alive = held(control(four_robots({(0, 1)})), "R0"), KEYS.alive("R0")
    granted = [alive, KEYS.life(alive, "f00d"), KEYS.claim(alive, KEYS.rank(1e9, "f00d"))]
    tokens = [*granted, "park/R0/alive/x/1", "park/R0/pose", "park/R0/**", KEYS.alive("R1")]
    assert [token for token in tokens if permitted(made, "ingress", "liveliness_token", token)] == granted


NO_OPERATORS = ("R0", "R1", *(role for role in ROLES[1:] if role != "operator"), OUTSIDER)
BROAD = (KEYS.estop, "park/**", "park/*/pose", "park/*", "**", "*/*/*", "park/R3/pos$*", KEYS.experiment)


@for_each(
    "who, action, key",
    [
        *((who, action, key) for who in NO_OPERATORS for action in ("put", "delete") for key in BROAD),
        *((who, "ask", "park/*/order") for who in ("R0", "observer", "recorder", "world", "ros2", OUTSIDER)),
        *((who, "ask", key) for who in ("observer", "operator") for key in ("park/**", "park/R0/*", "park/*/*")),
        *((who, "ask", KEYS.world_order) for who in ("R0", "observer", "recorder", OUTSIDER)),
        *((who, action, KEYS.run_order) for who in NO_OPERATORS for action in ("ask", "answer", "put")),
        *(("R0", "hear", key) for key in ("park/**", "park/*/pose", "park/R1/*", "**", "park/R1/state", KEYS.event)),
        *((who, "hear", "**") for who in ("observer", "operator", "recorder")),
        *(("R0", action, "park/R1/pose/@adv/pub/1/1/_") for action in ("put", "answer", "be")),
        *((who, "be", KEYS.centre_alive) for who in ("R0", "operator", "observer", "world", "ros2", OUTSIDER)),
        *((who, "put", KEYS.centre) for who in ("R0", "operator", "observer", "world", "ros2", OUTSIDER)),
        *((who, "put", "park/R1/goal") for who in ("centre", "ros2", "R0", "operator")),
        *((who, "be", "park/R0/alive") for who in ("R1", "operator", "observer", "world", OUTSIDER)),
        *((who, "ask", key) for who in ("R0", "observer", "operator") for key in ("@/**", "@/*/router/**", "@/*/*")),
        ("R0", "answer", "@/*/router/**"),
        *((who, "put", KEYS.event) for who in NO_OPERATORS),
        *((who, "put", KEYS.scene) for who in NO_OPERATORS if who != "recorder"),
        *((who, "put", KEYS.world_event) for who in ("R0", "operator", "observer", "centre", "ros2", OUTSIDER)),
        ("operator", "put", "park/R0/pose"),
        ("operator", "delete", KEYS.estop),
        ("observer", "be", KEYS.recorder),
    ],
)  # fmt: skip
def test_what_would_do_harm_is_denied(who, action, key):
    assert not may(control(four_robots({(1, 0)})), who, action, key)


@pytest.mark.parametrize(("who", "part"), [("observer", "pose"), ("operator", "pose"), ("operator", "order")])
def test_queryable_wildcard_reaches_every_robot(who, part):
    made, key = control(four_robots({(0, 1)})), f"park/*/{part}"
    assert may(made, who, "ask", key)
    for robot in ("R0", "R3"):
        rules_of = held(made, robot)
        assert permitted(rules_of, "egress", "query", key)
        assert permitted(rules_of, "ingress", "reply", f"park/{robot}/{part}")
        assert not any(permitted(rules_of, "ingress", what, key) for what in ("query", "reply", "declare_queryable"))
        assert not permitted(rules_of, "egress", "query", "park/*/state")


def test_linked_routers_pass_on_what_either_admits():
    alone = four_robots({(1, 0)})
    for network in (NetworkTable(routers=2), NetworkTable(connect=["tls/a:7447", "tls/b:7447"])):
        linked = control(changed(alone, network=network))
        for key, action in product(("park/R0/pose", KEYS.estop, KEYS.event, "park/R1/order"), ACTIONS):
            assert may(linked, "router", action, key) == (action != "delete"), (key, action)
            assert not may(control(alone), "router", action, key)
        assert not any(may(linked, "router", *each) for each in product(ACTIONS, ("**", "yard/R0/pose", "yard/**")))
        for who in ("R0", "observer", OUTSIDER):
            assert not may(linked, who, "put", KEYS.estop)


def test_avoidance_gives_ears_and_nothing_else():
    """Avoidance by received poses needs the right to receive them, even without a link."""
    one = next(iter(load("crowd").cases().values()))
    grants = access_rights.rights([one]).robots
    mates = [name for name, robot in one.experiment.robots.items() if robot.process == "squad_E1"]
    assert [key for key in grants[mates[0]].subscribe if key.endswith("/pose")] == ["park/*/pose"], "all forty of them"
    assert grants[mates[0]].publish == [f"park/{mate}/**" for mate in mates]


def test_body_carriers_publish_for_their_own_robots_only():
    four = four_robots({(0, 1)})
    robots = {**four.robots, "R1": changed(four.robots["R1"], body="world"),
              "R2": changed(four.robots["R2"], ranges="world"),
              "R3": changed(four.robots["R3"], position="external")}  # fmt: skip
    made = control(changed(four, robots=robots))
    keys = [f"park/{name}/{what}" for name in robots for what in WHAT]
    allowed = {who: {key for key in keys if may(made, who, "put", key)} for who in ("world", "positioning", "twin")}
    world = {"park/R1/position", "park/R1/truth", "park/R1/ranges", "park/R2/ranges"}
    assert allowed == {"world": world, "positioning": {"park/R3/position"}, "twin": set()}


def test_ros_2_is_reached_on_its_own_keys():
    behind = control(choose_bodies(Plan(reference()), "protocol").experiment)
    alone = control(reference())
    for who in ("TB01", "twin"):
        assert may(behind, who, "put", "TB01/cmd_vel")
        assert may(behind, who, "hear", "TB01/odom")
        assert may(behind, who, "be", "@/1234/@ros2_lv/MP/TB01§odom/nav_msgs§msg§Odometry/:1:0:0,10")
    assert not may(behind, "KH01", "put", "TB01/cmd_vel")
    assert not may(alone, "TB01", "put", "TB01/cmd_vel")
    assert may(behind, "CF01", "put", "park/CF03/pose"), "one radio, one process, one session"
    assert not may(alone, "CF01", "put", "park/CF03/pose")
    made = control(four_robots(set(), kind="turtlebot3", body="rmw://tb3_0?domain=7"))
    assert may(made, "R0", "put", "7/tb3_0/cmd_vel/geometry_msgs::msg::dds_::Twist_/RIHS01_0")
    assert may(made, "R0", "watch", "@ros2_lv/7/**")
    assert not may(made, "R0", "put", "0/tb3_0/cmd_vel/geometry_msgs::msg::dds_::Twist_/RIHS01_0")


def test_cases_that_share_a_router_share_their_rights():
    one, other = four_robots({(0, 1)}), four_robots({(2, 1)})
    made = control(one, other)
    assert [who for who in ROBOTS if may(made, "R1", "hear", f"park/{who}/pose")] == ["R0", "R2"]
    elsewhere = changed(one, network=NetworkTable(realm="yard"))
    with pytest.raises(LabError, match=r"realms park and yard share no router"):
        access_rights.rights([Plan(one), Plan(elsewhere)])


def test_certificate_gives_rights_of_its_name_alone():
    made = control(four_robots({(0, 1)}), R0=Identity("robot", "R0.2", "1", "2100-01-01"))
    assert [may(made, name, "put", "park/R0/pose") for name in ("R0", "R0.2")] == [False, True]  # earlier and now
    with pytest.raises(LabError, match=r"'R0' is a robot of the experiment and operator of the lab"):
        control(four_robots(set()), R0=Identity("operator", "R0", "1", "2100-01-01"))


def test_size_limits_bind_robots_but_not_the_experiment():
    (limit,) = sizes(access_rights.rights([Plan(four_robots(set()))]))
    assert limit["size_limit"] == 65536
    assert {"park/R0/**", "park/R0/**/@adv/**"} < {*limit["key_exprs"]}
    assert not any("run" in key for key in limit["key_exprs"])


def test_needed_identities():
    plan, needed = Plan(reference()), access_rights.needed_identities
    assert set(needed(plan)) == {"router", "operator", "recorder", *plan.experiment.robots}
    assert {"world"} < set(needed(choose_bodies(plan, "world")))
    assert {"centre"} < set(needed(load("architectures").cases()["hybrid"]))
    assert {"twin", "positioning"} < set(needed(choose_bodies(plan, "protocol")))
