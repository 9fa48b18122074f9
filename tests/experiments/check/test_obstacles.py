"""Findings of `./zenpark check` about obstacles, range sensors, worlds, mirrors and shadows."""

import pytest

from experiments.file.document import loads
from tests.commands import invoke
from tests.experiments.checked import findings

pytestmark = pytest.mark.slow  # each check flies the experiment on the virtual clock

HEAD = 'title = "One"\nduration_s = 20.0\n'
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
CART = '[arena.obstacles.cart]\nbox = [0.2, 0.2]\nat = [0.5, 1.0]\nheight = 0.3\nplan = { kind = "line", '
AVOIDS = '[avoidance]\nkind = "barrier"\n'
ALL = AVOIDS + 'hears = "all"\n'
PYMUNK = '[world]\nengine = "pymunk"\n'
OPEN = "[arena]\nwalls = false\n"
NEAR_WALL = ROBOTS.replace("[-1.5, 0.0]", "[-1.95, 0.0]")
SEEING = ROBOTS.replace("hover", 'sensors = ["multiranger"]\nhover')
APART = (
    ROBOTS.replace('CF01" = 1.0\n', 'CF01" = 1.0\n"A > B" = 0.5\n')
    + '[robots.A]\nkind = "khepera4"\nstart = [-1.0, -1.0]\n[robots.B]\nkind = "khepera4"\nstart = [-1.0, -1.5]\n'
)


def khepera(keys):
    return ROBOTS.replace('kind = "khepera4"\n', f'kind = "khepera4"\n{keys}\n')


BLIND = khepera("sensors = []")


@pytest.mark.parametrize(
    ("text", "severity", "code", "message", "absent"),
    [
        (LOW + ROBOTS, "warning", "hits-obstacle", "KH01 would run into 'post' at 15.3 s, around (0.34, 0.00)", ""),
        (LOW.replace("0.0", "0.5") + ROBOTS, "note", "obstacles", "", "hits-obstacle"),  # aside
        (POST + "bottom = 1.5\n" + ROBOTS, "note", "obstacles", "", "hits-obstacle"),  # high above
        (f"{CART}move_by = [0.0, -1.0], speed = 0.1 }}\n{ROBOTS}", "warning", "hits-obstacle",
         "KH01 would run into 'cart'", ""),
        (f"{CART}move_by = [0.0, -2.9], speed = 0.5 }}\n{ROBOTS}", "note", "obstacles", "", "hits-obstacle"),  # gone
        (f"{CART}move_by = [0.0, 3.0], speed = 0.5 }}\n{ROBOTS}", "warning", "obstacle-leaves",
         "the middle of 'cart' leaves the arena at 2.1 s", ""),
        # CF01 flies over it, and receives its neighbour
        (AVOIDS + LOW + ROBOTS, "note", "avoidance-acts", "avoidance will have to act", "hits-obstacle sees-nothing"),
        (AVOIDS + LOW + khepera("avoids = false"), "warning", "hits-obstacle", "KH01 would run", "avoidance-acts"),
        (LOW + "mass = 1.0\n" + ROBOTS, "warning", "not-pushed", "in the engine 'point-mass' nothing is pushed", ""),
        (LOW + "mass = 1.0\n" + ROBOTS, "note", "pushes", "", ""),
        (PYMUNK + LOW + "mass = 1.0\n" + ROBOTS, "note", "pushes", "", "not-pushed"),
        (PYMUNK + NEAR_WALL, "error", "start-overlap",
         "KH01 starts in a wall of the arena: 0.05 m off, but needs 0.07 m", ""),
        (PYMUNK + OPEN + NEAR_WALL, "note", "connected", "", "start-overlap"),
        (AVOIDS + POST + ROBOTS, "warning", "sees-nothing", "CF01 has no range sensors: it cannot avoid 'post'", ""),
        (AVOIDS + POST + SEEING, "note", "connected", "", "sees-nothing"),
        (AVOIDS + BLIND, "warning", "sees-nothing", "KH01 has neither neighbours nor range sensors", ""),
        # links of avoidance are none of the formation
        (ALL + BLIND, "note", "connected", "the network is whole; every robot is reached by KH01", "sees-nothing"),
        (APART, "error", "parts", "", ""),
        (AVOIDS + APART, "note", "parts", "", ""),
        (OPEN + khepera('body = "world"\nranges = "world"'), "warning", "ranges-twice", "adds nothing", ""),
        (OPEN + khepera('body = "khepera4-twin"\nsensors = []\nranges = "world"'), "warning", "ranges-of-nothing",
         "no range sensors", ""),
        (OPEN + khepera('body = "khepera4-twin"\nranges = "world"'), "warning", "ranges-of-nothing",
         "without obstacles and robots", ""),
        (OPEN + khepera('body = "world"\nshadow = {}'), "warning", "shadow-of-twin", "one twin with another", ""),
        (LOW + khepera('body = "khepera4-twin"\nranges = "world"\nshadow = {}'), "warning", "hits-obstacle", "",
         "ranges-twice ranges-of-nothing shadow-of-twin"),
    ],
)  # fmt: skip
def test_surroundings_are_judged(text, severity, code, message, absent):
    found = findings(loads(HEAD + text))
    assert found[code].severity == severity
    assert message in found[code].message
    assert not found[code].message.startswith("in case")  # there is one alone
    assert not found.keys() & set(absent.split())


@pytest.mark.usefixtures("unflown")
def test_summary_names_the_obstacles(tmp_path):
    cart = '[arena.obstacles.cart]\nbox = [0.2, 0.3]\nat = [0.5, 1.0]\nplan = "hold"\n'
    crate = "[arena.obstacles.crate]\nradius = 0.1\nat = [1.0, 1.0]\nmass = 2.0\n"
    fence = "[arena.obstacles.fence]\nwall = [[1.0, 0.0], [1.0, 1.0]]\nbottom = 1.0\n"
    (tmp_path / "one.toml").write_text(HEAD + cart + crate + fence + ROBOTS)
    printed = invoke("check", tmp_path / "one.toml").stdout
    assert "cart (box 0.2 × 0.3 m, moves), crate (cylinder of radius 0.1 m, 2 kg), fence (wall, 1 m above" in printed
