"""Findings of `./zenpark check` about obstacles, range sensors, worlds, mirrors and shadows."""

from __future__ import annotations

import pytest

from experiments.check.check import figures
from experiments.file.document import loads
from tests.commands import invoke
from tests.experiments.checked import findings

pytestmark = pytest.mark.slow  # each check flies the experiment on the virtual clock

HEAD = """title = "One"
duration_s = 20.0
"""
ROBOTS = """[robots.KH01]
kind = "khepera4"
start = [-1.5, 0.0]
[robots.CF01]
kind = "crazyflie"
start = [-1.5, 0.6]
hover = 0.8
[formation.links]
"KH01 > CF01" = 1.0
[[timeline]]
at_s = 2.0
robot = "KH01"
plan = { kind = "line", move_by = [2.5, 0.0], speed = 0.15 }
"""
POST = "[arena.obstacles.post]\nradius = 0.1\nat = [0.5, 0.0]\n"
LOW = POST + "height = 0.3\n"
AVOIDS = '[avoidance]\nkind = "barrier"\n'


def said(*parts, robots=ROBOTS):
    """Findings on an experiment, by code."""
    return findings(loads(HEAD + "".join(parts) + robots))


def test_path_into_an_obstacle_is_found_in_time():
    found = said(LOW)["hits-obstacle"]
    assert found.severity == "warning"
    assert found.message == "KH01 would run into 'post' at 15.3 s, around (0.34, 0.00)"
    assert "[avoidance]" in found.remedy
    assert found.where.endswith(":3:1")


def test_drones_pass_over_low_obstacles_and_meet_tall():
    assert "CF01" not in said(LOW)["hits-obstacle"].message
    both = said(POST.replace("[0.5, 0.0]", "[0.3, 0.0]"))["hits-obstacle"]
    assert both.message.startswith(("KH01, CF01 would run into", "KH01 would"))


@pytest.mark.parametrize("post", [LOW.replace("[0.5, 0.0]", "[0.5, 0.5]"), POST + "bottom = 1.5\n"])
def test_nobody_meets_what_stands_aside_or_hangs_high(post):
    found = said(post)
    assert "hits-obstacle" not in found
    assert found["obstacles"].severity == "note"


def test_moved_obstacle_on_a_path_is_met_there():
    cart = '[arena.obstacles.cart]\nbox = [0.2, 0.2]\nat = [0.5, 1.0]\nheight = 0.3\nplan = { kind = "line", '
    assert "hits-obstacle" not in said(f"{cart}move_by = [0.0, -2.9], speed = 0.5 }}\n")  # long gone
    found = said(f"{cart}move_by = [0.0, -1.0], speed = 0.1 }}\n")["hits-obstacle"]
    assert "KH01 would run into 'cart'" in found.message
    away = said(f"{cart}move_by = [0.0, 3.0], speed = 0.5 }}\n")["obstacle-leaves"]
    assert away.message == "the middle of 'cart' leaves the arena at 2.1 s"


def test_collision_course_with_avoidance_is_a_note():
    found = said(AVOIDS, LOW)
    assert "hits-obstacle" not in found
    assert found["avoidance-acts"].severity == "note"
    assert found["avoidance-acts"].message.endswith("avoidance will have to act")
    stubborn = said(AVOIDS, LOW, robots=ROBOTS.replace('kind = "khepera4"\n', 'kind = "khepera4"\navoids = false\n'))
    assert stubborn["hits-obstacle"].message.startswith("KH01 would run into 'post'")
    assert "avoidance-acts" not in stubborn


def test_movable_obstacle_is_pushed_if_the_engine_can():
    crate = LOW + "mass = 1.0\n"
    found = said(crate)
    assert "in the engine 'point-mass' nothing is pushed" in found["not-pushed"].message
    assert found["pushes"].severity == "note"
    assert "not-pushed" not in said('[world]\nengine = "pymunk"\n', crate)


@pytest.mark.usefixtures("unflown")
def test_robot_in_a_touchable_wall_is_an_error():
    near = ROBOTS.replace("[-1.5, 0.0]", "[-1.95, 0.0]")
    found = said('[world]\nengine = "pymunk"\n', robots=near)["start-overlap"]
    assert found.severity == "error"
    assert found.message.startswith("KH01 starts in a wall of the arena: 0.05 m off, but needs 0.07 m")
    assert "start-overlap" not in said(robots=near)
    assert "start-overlap" not in said('[world]\nengine = "pymunk"\n', "[arena]\nwalls = false\n", robots=near)


@pytest.mark.usefixtures("unflown")
def test_robot_without_range_sensors_learns_what_it_misses():
    found = said(AVOIDS, POST)["sees-nothing"]
    assert found.message == "CF01 has no range sensors: it cannot avoid 'post'"
    assert 'sensors = ["multiranger"] in [robots.CF01]' in found.remedy
    assert "sees-nothing" not in said(AVOIDS, LOW)  # it flies over it, and hears its neighbour
    assert "sees-nothing" not in said(AVOIDS, POST, robots=ROBOTS.replace("hover", 'sensors = ["multiranger"]\nhover'))
    blind = ROBOTS.replace('kind = "khepera4"', 'kind = "khepera4"\nsensors = []')
    found = said(AVOIDS, robots=blind)["sees-nothing"]
    assert found.message == "KH01 has neither neighbours nor range sensors: it avoids nothing"
    assert 'hears = "all"' in found.remedy
    whole = said(AVOIDS, 'hears = "all"\n', robots=blind)
    assert "sees-nothing" not in whole
    # links of avoidance are none of the formation
    assert whole["connected"].message == "the network is whole; every robot is reached by KH01"


@pytest.mark.usefixtures("unflown")
def test_unlinked_formations_may_share_an_arena_with_avoidance():
    more = ROBOTS + '[robots.A]\nkind = "khepera4"\nstart = [-1.0, -1.0]\n[robots.B]\nkind = "khepera4"\n'
    more = more.replace('CF01" = 1.0\n', 'CF01" = 1.0\n"A > B" = 0.5\n') + "start = [-1.0, -1.5]\n"
    assert said(robots=more)["parts"].severity == "error"
    assert said(AVOIDS, robots=more)["parts"].severity == "note"


@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize(
    ("robot", "code", "part"),
    [
        ('body = "world"\nranges = "world"\n', "ranges-twice", "adds nothing"),
        ('body = "khepera4-twin"\nsensors = []\nranges = "world"\n', "ranges-of-nothing", "no range sensors"),
        ('body = "khepera4-twin"\nranges = "world"\n', "ranges-of-nothing", "without obstacles and robots"),
        ('body = "world"\nshadow = {}\n', "shadow-of-twin", "one twin with another"),
        ("shadow = { restart_s = 2.0 }\n", "shadow-of-twin", "one twin with another"),
    ],
)
def test_worlds_and_shadows_that_make_no_sense(robot, code, part):
    changed = ROBOTS.replace('kind = "khepera4"\n', f'kind = "khepera4"\n{robot}')
    found = said("[arena]\nwalls = false\n", robots=changed)[code]
    assert found.severity == "warning"
    assert part in found.message


@pytest.mark.usefixtures("unflown")
def test_worlds_and_shadows_that_make_sense():
    real = ROBOTS.replace('kind = "khepera4"\n', 'kind = "khepera4"\nbody = "khepera4-twin"\nshadow = {}\n')
    found = said(LOW, robots=real.replace("shadow", 'ranges = "world"\nshadow'))
    assert not {"ranges-twice", "ranges-of-nothing", "shadow-of-twin"} & found.keys()


@pytest.mark.usefixtures("unflown")
def test_summary_names_the_obstacles(tmp_path):
    file = tmp_path / "one.toml"
    cart = '[arena.obstacles.cart]\nbox = [0.2, 0.3]\nat = [0.5, 1.0]\nplan = "hold"\n'
    crate = "[arena.obstacles.crate]\nradius = 0.1\nat = [1.0, 1.0]\nmass = 2.0\n"
    fence = "[arena.obstacles.fence]\nwall = [[1.0, 0.0], [1.0, 1.0]]\nbottom = 1.0\n"
    file.write_text(HEAD + cart + crate + fence + ROBOTS)
    printed = invoke("check", file).stdout
    assert "cart (box 0.2 × 0.3 m, moves), crate (cylinder of radius 0.1 m, 2 kg), fence (wall, 1 m above" in printed
    assert "4 × 4 × 2.5 m" in printed
    assert list(figures(loads(file.read_text()).plan).obstacles) == ["cart", "crate", "fence"]
