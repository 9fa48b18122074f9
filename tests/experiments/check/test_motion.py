"""Findings of `check` in the ideal run: acquisition, soft formations, encounters, walls and plans."""

import numpy as np
import pytest

from agents.body.interface import Disturbance, Jitter
from bridges.crazyflie.kind import CRAZYFLIE
from experiments.check.analysis import Analysis
from experiments.check.check import figures
from experiments.check.ideal_run import Prediction, isolated, predict, repetitions
from experiments.check.motion import flight
from experiments.check.theory import unknown_robots, unused_gains
from experiments.definition.experiment import Arena, Experiment, Formation, LegTable, LinkTable, RobotTable, Start
from experiments.definition.formation import linear_step
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.virtual_time import conductor, simulation, stretch
from tests.experiments.checked import GROUND, assert_found, bad, findings
from tests.small import changed, reference, small
from twins.models.quadrotor import Quadrotor

pytestmark = pytest.mark.slow  # each check flies the experiment on the virtual clock

PARK, TRIANGLE = "robotic-park", "triangle"


def robots_on_wheels(duration_s: float = 120.0, **formation: float | str) -> Experiment:
    """Three Kheperas that are to stand 1 m apart, and nearly do from the start."""
    places = {"KH01": [0.0, 0.0], "KH02": [1.2, 0.0], "KH03": [0.6, 1.04]}
    links = {"KH01 - KH02": 1.0, "KH02 - KH03": 1.0, "KH01 - KH03": 1.0}
    return small(
        {name: RobotTable(kind="khepera4", start=start) for name, start in places.items()},
        arena=Arena(size=(6.0, 6.0, 2.0)), duration_s=duration_s,
        formation=Formation(**{"links": links, "gain": 1.0, "clamp": 0.1, **formation}),
    )  # fmt: skip


def test_weak_link_remedy_names_the_laws_own_key():
    offsets = {"KH01 - KH02": [1.0, 0.0], "KH02 - KH03": [-0.5, 0.866], "KH01 - KH03": [0.5, 0.866]}
    links = {pair: LinkTable(offset=offset) for pair, offset in offsets.items()}
    found = findings(robots_on_wheels(40.0, law="displacement", links=links, stiffness=0.05))["wheels-stop"]
    assert "links may stay e = 5 mm/k off" in found.message
    assert found.remedy.startswith("raise stiffness to 0.0")


def test_prediction_is_a_flight_without_noise():
    short = changed(reference(), duration_s=5.0)
    flown, still = predict(Plan(short)), predict(Plan(changed(short, seed=8, disturbance={})))
    np.testing.assert_array_equal(flown.position, still.position)  # no seed matters
    np.testing.assert_allclose(flown.time, np.arange(51) / 10.0, atol=1e-9)
    assert (flown.incidents, flown.stuck) == (still.incidents, still.stuck)
    assert flown.transmissions == still.transmissions == round(5.0 * still.messages_hz)
    assert flown.messages_hz > still.messages_hz  # noise counts here alone


@pytest.mark.parametrize(("compiled", "flown_s", "flights"), [(False, 11.0, 2), (True, 165.0, 1)])
def test_beginning_is_flown_of_many_robots(monkeypatch, compiled, flown_s, flights):
    monkeypatch.setattr(stretch, "possible", lambda _: compiled)
    many = small({f"R{k}": "khepera4" for k in range(200)}, duration_s=600.0)
    assert isolated(Plan(many)).experiment.duration_s == flown_s
    assert isolated(Plan(changed(many, duration_s=15.0))).experiment.duration_s == (15.0 if compiled else 11.0)
    assert repetitions(isolated(Plan(many))) == flights


def flat_strip(jitter: float = 0.01, duration_s: float = 30.0) -> Experiment:
    """Two flat triangles of drones that start in their shape, shaken by hover jitter."""
    places = {f"CF{k}": (0.6 * k - 0.9, 0.2 * (k % 2)) for k in range(4)}
    pairs = [("CF0", "CF1"), ("CF0", "CF2"), ("CF1", "CF2"), ("CF1", "CF3"), ("CF2", "CF3")]
    links = {f"{i} - {j}": float(np.hypot(*np.subtract(places[i], places[j]))) for i, j in pairs}
    robots = {name: RobotTable(kind="crazyflie", start=list(place), hover=0.6) for name, place in places.items()}
    return small(
        robots, arena=Arena(size=(8.0, 8.0, 2.0)), formation=Formation(links=links, gain=0.3),
        disturbance={"all": Disturbance(hover_jitter=Jitter(jitter))}, duration_s=duration_s,
    )  # fmt: skip


def test_soft_formation_is_found_under_hover_jitter():
    soft = flat_strip(duration_s=40.0)
    claims = findings(soft)
    assert "after 0.0 s" in claims["acquired"].message  # without noise
    found = claims["soft"]
    assert (found.severity, found.where.startswith("made.json")) == ("warning", True)
    assert "outside the tolerance of 50 mm later, in 4 of 5 flights (seeds 1 to 5)" in found.message
    assert "soft" not in findings(flat_strip(jitter=0.002))
    assert "soft" not in findings(robots_on_wheels())


def test_robots_that_never_begin_are_reported_with_reason(monkeypatch):
    def stuck(*_, **__):
        raise conductor.Stuck("not ready after 60 s: KH01 (its law wants something that is not finite)")

    monkeypatch.setattr(simulation, "simulate", stuck)
    wheels = robots_on_wheels()
    found, numbers = findings(wheels), figures(Plan(wheels))
    assert found["not-begun"].severity == "error"
    assert "not ready after 60 s: KH01" in found["not-begun"].message
    assert not {"acquired", "not-acquired", "wheels-stop"} & found.keys()
    assert (numbers.acquired_s, numbers.end_error_mm) == (None, None)


def test_gain_of_another_law_is_named():
    for law, key, used in (("displacement", "gain", "stiffness"), ("distance", "stiffness", "gain")):
        (found,) = unused_gains([Plan(robots_on_wheels(law=law, **{key: 0.4}))])
        assert (found.code, found.where) == ("unused-gain", ("formation", key))
        assert found.message == f"{key} is not used by the law '{law}', which pulls by {used}"
    assert not [*unused_gains([Plan(robots_on_wheels(law="mixed", stiffness=0.4, gain=1.0))])]


def test_law_value_for_no_robot_is_reported():
    laws = ({"kind": "average", "signal": {"KH01": 1.0, name: 2.0}} for name in ("KH22", "KH03"))
    (found,) = unknown_robots([Plan(robots_on_wheels(law=law)) for law in laws])
    assert (found.code, found.remedy) == ("unknown-robot", "did you mean 'KH02'?")
    assert found.where == ("formation", "law", "signal", "KH22")


@pytest.mark.parametrize(
    ("name", "change", "expected", "message", "remedy"),
    [
        (PARK, "timeline.0.plan.move_by=[2.0, 0.0]; duration_s=33", ("error", "leaves-arena"),
         "TB01 would leave the arena at 3", "shorten"),
        (PARK, "timeline.0.at_s=5; duration_s=18", ("warning", "acquired-late"), "when the plans begin at 5 s",
         "begin later"),
        (PARK, "duration_s=24", ("warning", "lags"), "lags behind its leader", "slowly"),
        (TRIANGLE, "duration_s=2", ("warning", "not-acquired"), "mm off after 2 s", "duration_s"),
        (TRIANGLE, "trigger={ kind = 'send-on-delta', threshold = 15 }; duration_s=10", ("error", "silent"),
         "no robot transmits after its first pose: the trigger 'send-on-delta' fires at nothing", "metres"),
        (TRIANGLE, "formation.gain=10; channel.delay_s=0.6", ("warning", "keeps-oscillating"),
         "oscillates to the end: from 11 to 15 s", "lower the gain"),
    ],
)  # fmt: skip
def test_variants_that_do_not_work_in_flight(name, change, expected, message, remedy):
    assert_found(name, change, expected, message, remedy)


def line_of(robot: str, x: float, y: float, speed: float) -> LegTable:
    return LegTable(at_s=1.0, robot=robot, plan={"kind": "line", "move_by": [x, y], "speed": speed})


def robot(x: float, y: float, hover: float | None = None, kind: str = "crazyflie") -> RobotTable:
    """A drone that hovers, or a Khepera."""
    return RobotTable(kind=kind if hover else "khepera4", start=[x, y], hover=hover)


LARGE = Arena(size=(6.0, 6.0, 2.0))
CROSSING = [line_of("A", 0.6, 0.6, 0.1), line_of("B", -0.6, 0.6, 0.1)]  # they meet half-way


LINE = {name: RobotTable(kind="point", start=[x, 0.0]) for name, x in (("A", -0.7), ("B", 0.0), ("C", 0.7))}
TRIPLE = {"A - B": 1.0, "B - C": 1.0, "A - C": 1.0}
RING = {f"R{k}": robot(0.6 * x, 0.6 * y, 0.8) for k, (x, y) in enumerate(((1, 0.1), (-1, 0.1), (0.1, 1), (0.1, -1)))}
PLACES = {"R0": [0.5, 0.0], "R1": [-0.5, 0.0], "R2": [0.0, 0.5], "R3": [0.0, -0.5]}
FAST = Formation(
    law={"kind": "consensus", "gain": 0.65, "offset": PLACES},
    links={f"R{i} - R{j}": LinkTable() for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (2, 3))},
)


def met(scatter: float = 0.0) -> Experiment:
    """Robots that begin in their formation, up to a scatter of the starts, with a law that is too fast."""
    robots = {name: robot(x, y, 0.8) for name, (x, y) in PLACES.items()}
    return small(robots, formation=FAST, duration_s=20.0, start=Start(scatter=scatter))


def low(hover: float, top: float) -> Experiment:
    """A Crazyflie overshoots its take-off by up to 11 %."""
    return small({"F": robot(0.0, 0.0, hover)}, arena=Arena(size=(4.0, 4.0, top)), duration_s=5.0)


def crossed(height: float) -> Experiment:
    robots = {"CF01": robot(-1.0, 0.0, 0.5), "TL01": robot(0.0, 0.0, height, "tello")}
    return small(robots, timeline=[line_of("CF01", 2.0, 0.0, 0.3)], duration_s=15.0)


LANDING = {"G": robot(0.0, 0.01), "H": robot(0.5, 0.5), "F": robot(0.0, 0.0, 0.8)}
BESIDE = small({"G": robot(0.0, 0.0), "F": robot(0.5, 0.0, 0.8)}, {"G > F": 0.801}, duration_s=30.0, tolerance=0.1)


@pytest.mark.parametrize(
    ("made", "severity", "code", "message", "remedy"),
    [
        (small(GROUND, timeline=CROSSING, arena=LARGE), "warning", "too-close", "A and B come within", "other ways"),
        (crossed(0.52), "warning", "too-close", "they touch at 0.17 m", ""),
        (crossed(0.6), "warning", "too-close", "one is above the other then, with 0.07 m between them", ""),
        (crossed(0.65), None, "too-close", "", ""),
        (BESIDE, "note", "lands-beside", "F ends above G, and goes aside before it lands", ""),
        (BESIDE, None, "lands-on", "", ""),
        (small(LANDING, {"G - H": 0.7}, duration_s=30.0, arena=LARGE), "warning", "lands-on",
         "F ends above G, from which it receives no poses, and would land on it", ""),
        (small(GROUND, timeline=[line_of("A", -2.97, 0.0, 0.1)], duration_s=60.0, arena=LARGE), "warning",
         "near-wall", "A comes within the margin of 0.05 m of a wall at 30.", ""),
        (small({"A": robot(0.0, 0.0, 0.8, "tello")}, timeline=[line_of("A", 2.9, 0.0, 0.2)], arena=LARGE,
               duration_s=25.0), "warning", "near-wall", "A comes within the margin of 0.05 m", "held back"),
        (small(LINE, TRIPLE, duration_s=5.0, tolerance=0.01), "warning", "local-minimum",
         "the robots balance in another shape", "off the line"),
        (small(RING, formation=FAST, duration_s=20.0), "warning", "keeps-oscillating",
         "the robots oscillate to the end: from 15 to 20 s", "the law 'consensus'"),
        (met(), None, "keeps-oscillating", "", ""),
        (met(scatter=0.1), "warning", "keeps-oscillating", "the robots oscillate to the end: from 15 to 20 s", ""),
        (low(1.0, 1.05), "warning", "overshoots-arena", "to 1.11 m", "hover at 0.94 m at most"),
        (low(0.94, 1.05), None, "overshoots-arena", "", ""),
    ],
)  # fmt: skip
def test_flights_are_judged(made, severity, code, message, remedy):
    found = findings(made).get(code)
    assert (found and found.severity) == severity
    if found:
        assert message in found.message
        assert remedy in found.remedy


def test_part_of_a_long_run_is_noted():
    plan = Plan(small(GROUND, duration_s=600.0))
    made = Analysis(plan, Prediction(plan, np.array([0.0, 5.0]), np.zeros((2, 4, 3)), 0, 0.0))
    assert [found.code for found in flight(made)] == ["predicted-in-part"]


def test_formation_lost_again_counts_acquired_and_names_stiffness(tmp_path):
    (tmp_path / "lost.toml").write_text(
        'title = "A leader goes"\nduration_s = 17.0\n'
        '[robots.L]\nkind = "turtlebot3"\nstart = [0.0, 0.0]\n[robots.F]\nkind = "khepera4"\nstart = [-0.6, 0.0]\n'
        '[formation]\nlaw = "displacement"\nstiffness = 0.15\n[formation.links]\n"L > F" = { offset = [-0.5, 0.0] }\n'
        '[[timeline]]\nat_s = 8.0\nrobot = "L"\nplan = { kind = "line", move_by = [0.4, 0.0], speed = 0.08 }\n'
    )
    found = bad(str(tmp_path / "lost.toml"))["not-acquired"]
    assert found.message.startswith("the formation, acquired after ")
    assert found.remedy.endswith("or raise the stiffness")


def test_anchors_without_links_are_checked():
    held = Formation(anchors={"CF01": 1.0})
    claims, weak = (
        findings(small({"CF01": robot(0.0, 0.3, 0.7)}, formation=each, duration_s=20.0))
        for each in (held, changed(held, gain=1e-4))
    )
    assert "CF01 is 8 mm off at the end" in claims["anchored"].message
    assert "the anchors can be met" in claims["realisable"].message
    assert (weak["anchor-missed"].severity, "anchored" in weak) == ("warning", False)


def test_noise_that_frees_robots_is_a_note():
    """Three drones that start on a line: without noise they stay on it."""
    given = document.read(TRIANGLE, ["robots.CF01.start=[0.0,-0.5]"])
    claims = findings(given, ["periodic"])
    assert claims["acquired"].severity == "note"
    assert "in 5 of 5 flights (seeds 1 to 5); without noise it is not" in claims["acquired"].message
    assert not {"local-minimum", "not-acquired"} & claims.keys()
    still = document.read(TRIANGLE, ["robots.CF01.start=[0.0,-0.5]", "disturbance={}"])
    assert "local-minimum" in findings(still, ["periodic"])


@pytest.mark.parametrize("axis", [0, 2])
def test_linear_step_is_model(axis):
    dt, setpoint = 0.01, [0.0, 0.0, 0.0, 0.0]
    setpoint[axis] = 0.1
    quadrotor = Quadrotor(CRAZYFLIE, (0.0, 0.0, 0.0), 0.0)
    quadrotor.place((0.0, 0.0, 0.0), 0.0, flying=True)
    state = np.array([0.0, 0.0, 0.0, 0.1])
    for _ in range(200):
        quadrotor.command(tuple(setpoint))
        quadrotor.move(dt)
        state = linear_step(CRAZYFLIE.motion, axis, dt) @ state
        assert quadrotor.position[axis] == pytest.approx(state[0], abs=1e-12)
