"""Theorems of the laws of the gallery, in virtual time: periodic, by events, and with a fifth of the messages lost."""

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

from agents.decision.position_control import LEASH
from agents.formation.link import Link
from agents.plugins.gallery.coverage import Coverage
from agents.plugins.gallery.enclosing import Enclosing
from agents.plugins.gallery.integral import Integral
from agents.plugins.gallery.leader_observer import LeaderObserver
from agents.plugins.law import NeighbourView, RobotFacts, View
from agents.vectors import ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from experiments.catalogue import index
from experiments.definition.standby import without_standby
from experiments.file import document
from experiments.virtual_time.simulation import simulate
from tests.cases import nightly
from tests.experiments.virtual_time.evaluators import played_back
from tests.runs import flown, fly

NIGHTLY = pytest.mark.nightly
CENTRALISED = "architecture=centralised"
HYBRID = 'architecture={ kind = "hybrid", robots = ["CF01", "CF03"] }'
MARKS = {"periodic": pytest.mark.slow, "event": NIGHTLY, "event-loss": NIGHTLY}
LOSSY = {"periodic": NIGHTLY, "event": NIGHTLY, "event-loss": pytest.mark.slow}
every_case = pytest.mark.parametrize("case", [pytest.param(case, marks=mark) for case, mark in LOSSY.items()])


def limits(*given):
    """Table of the cases with a limit each; the tightest one is that of the periodic case."""
    rows = [pytest.param(case, most, marks=MARKS[case]) for case, most in zip(MARKS, given, strict=True)]
    return pytest.mark.parametrize(("case", "most"), rows)


def text_of(name):
    return index.find_file(name).read_text("utf-8")


def fly_text(text, case, *changes):
    return fly(document.loads(text, *changes).cases()[case].experiment).trace


def apart(known, shape):
    """Distance of each robot (T, N) from where the mean of all and a shape have it [m]."""
    place = known.true_position[..., :2] - shape
    return np.linalg.norm(place - place.mean(axis=1, keepdims=True), axis=2)


def behind_first(known, shape):
    """Offset of each robot (T, N, 2) from its place behind the first one [m]."""
    place = known.true_position[..., :2] - shape
    return place - place[:, :1]


def rate_of(values, known, begin, end):
    """Rate at which a value decays [1/s]."""
    window = (known.time > begin) & (known.time < end)
    return -np.polyfit(known.time[window], np.log(values[window]), 1)[0]


NOWHERE = Link()


def exchange(law, x, memory, rounds, *, links=(NOWHERE, NOWHERE), **facts):
    """Controls of robots that stand at (x, 0) and (-x, 0), after rounds in which each receives the other's memory."""
    robots = [RobotFacts(name, number, count=4, step_s=0.1, **facts) for number, name in enumerate("AB")]
    places, memory = [(x, 0.0, 0.0), (-x, 0.0, 0.0)], [memory] * 2
    for _ in range(rounds):
        controls = []
        for this, other in ((0, 1), (1, 0)):
            heard = NeighbourView(other, robots[other].name, places[other], ZERO, 0.0, 0.0, memory[other], links[this])
            view = View(robots[this], memory[this], [heard])
            view.position = places[this]
            controls.append(law.step(view, memory[this]))
        memory = [control.memory for control in controls]
    return controls


AVERAGES = [
    ("event-loss", 0.02, ()),
    pytest.param("periodic", 1e-4, (CENTRALISED,), marks=pytest.mark.slow),
    nightly("periodic", 1e-4, ()),
    nightly("event", 0.015, ()),
]


@pytest.mark.parametrize(("case", "most", "changes"), AVERAGES)
def test_average_of_constant_signals_has_no_error(case, most, changes):
    known = flown("average", case, *changes).trace
    assert np.abs(known.memory["x"][-1] - 3.0).max() < most
    assert np.abs(known.memory["x"][0] - 3.0).max() > 1.0
    assert known.measures["disagreement"].shape == (len(known.time), 6)


@pytest.mark.slow
def test_average_of_ramps_has_a_bounded_error():
    known = flown("average", "periodic", "formation.law.ramp={ KH01 = 0.3, KH04 = -0.1 }", "duration_s=60").trace
    later = np.abs(known.memory["x"][..., 0] - 3.0 - known.time[:, None] * 0.2 / 6)[known.time > 30.0]
    assert (later.max() < 0.3, np.ptp(later, axis=0).max() < 0.01) == (True, True)  # it grows no more


@limits(1e-3, 3e-3, 0.01)
def test_aggregative_team_descends_linearly_to_its_optimum(case, most):
    """A lost message lets the two ends believe different values, of some thresholds of 1 cm, until the next one."""
    known = flown("aggregative", case).trace
    law, names = known.plan.law, known.robots
    targets, places = np.array([law.targets[name] for name in names]), np.array([*law.places.values()])
    share = law.team * len(places) / len(names)
    centre = (law.own * targets.mean(axis=0) + share * places.mean(axis=0)) / (law.own + share)
    optimum = targets - share / law.own * (centre - places.mean(axis=0))
    error = np.linalg.norm(known.true_position[..., :2] - optimum, axis=2).max(axis=1)
    assert error[0] > 0.5
    assert error[known.time > 36.0].max() < most
    falls = (error < 0.5) & (error > 3.0 * most) & (known.time < 25.0)
    rate = -np.polyfit(known.time[falls], np.log(error[falls]), 1)[0]
    assert rate > 0.4  # 0.46: the slowest eigenvalue of points on this ring
    assert np.abs(known.memory["s"][-1] - centre).max() < 2.0 * most


@every_case
def test_robots_fly_to_the_tasks_that_they_won(case):
    known = flown("auction", case).trace
    law, place = known.plan.experiment.formation.law, known.true_position[..., :2]
    tasks = np.array([*law["tasks"], *(each[:2] for each in law["later"])])
    chosen = np.where(known.measures["calm"] >= law.get("calm_s", 1.0), known.measures["task"], -1.0)
    for here, there in combinations(range(6), 2):  # never are two on the way to the same task
        assert not ((chosen[:, here] == chosen[:, there]) & (chosen[:, here] >= 0.0)).any()
    for begin, end, count in ((0.0, 14.9, 4), (15.1, known.time[-1], 5)):
        first, last = np.searchsorted(known.time, [begin, end])
        task = known.measures["task"][last].astype(int)
        won = task[task >= 0]
        assert sorted(won) == [*range(count)]  # each once
        ways = np.linalg.norm(place[first, :, None] - tasks[:count], axis=2)
        least = ways[linear_sum_assignment(ways)].sum()
        assert ways[task >= 0, won].sum() <= least + 6 * law["epsilon"]
    assert np.linalg.norm(place[-1, task >= 0] - tasks[won], axis=1).max() < 0.01
    assert np.linalg.norm(place[-1, task < 0] - place[0, task < 0], axis=1).max() < 0.05  # one is left, and stays


OFFSETS = np.array([[0.5, 0.0], [0.15, 0.48], [-0.4, 0.29], [-0.4, -0.29], [0.15, -0.48]])
MEETINGS = [
    ("periodic", (CENTRALISED,)),
    pytest.param("periodic", (HYBRID,), marks=pytest.mark.slow),
    pytest.param("event-loss", (), marks=pytest.mark.slow),
    nightly("periodic", ()),
]


@pytest.mark.parametrize(("case", "changes"), MEETINGS)
def test_consensus_meets_mean_at_the_graphs_rate(case, changes):
    known = flown("consensus", case, *changes).trace
    mean = (known.true_position[..., :2] - OFFSETS).mean(axis=1)
    assert np.abs(mean - mean[0]).max() < (0.02 if HYBRID in changes else 0.01)
    off = np.linalg.norm(apart(known, OFFSETS), axis=1)
    assert off[-1] < 0.02
    assert rate_of(off, known, 1.0, 6.0) == pytest.approx(0.3 * (2.0 - 2.0 * np.cos(2.0 * np.pi / 5.0)), rel=0.1)


RING = 2.0 * np.eye(5) - np.roll(np.eye(5), 1, axis=1) - np.roll(np.eye(5), -1, axis=1)  # its Laplacian
NOISELESS = "disturbance.all.position_sigma=0.0"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "floor", "extra"), [("event", 0.01, 0.0), ("event-decaying", 0.005, 0.05), ("event-loss", 0.01, 0.0)]
)
def test_event_consensus_stays_bounded_and_keeps_events_apart(case, floor, extra):
    """Seyboth, Dimarogonas, Johansson, Automatica 49(1), 2013: thresholds c₀ + c₁ exp(−α t), α below k λ₂."""
    known = flown("consensus", case, NOISELESS).trace
    spectrum, alpha, root = np.linalg.eigvalsh(RING), 0.25, np.sqrt(5.0)
    rate, norm = 0.3 * spectrum[1], 0.3 * spectrum[-1]
    moving = known.time >= 2.0  # the bodies follow
    time, off = known.time[moving], np.linalg.norm(apart(known, OFFSETS), axis=1)[moving]

    def bound(t):
        kept, slow = np.exp(-rate * (t - 2.0)), np.exp(-alpha * t)
        fading = extra * (slow - kept * np.exp(-alpha * 2.0)) / (rate - alpha)
        return kept * off[0] + norm * root * (floor * (1.0 - kept) / rate + fading)

    assert (off <= bound(time)).all()
    assert off[-1] < norm * root * floor / rate
    for robot in range(5):
        events = known.sent.stamp[known.sent.link == robot]
        events = events[events > 2.0]
        coarser = extra * np.exp(-alpha * events[:-1])
        speed = norm * (bound(events[:-1]) + root * (floor + coarser))  # the largest from then on [m/s]
        least = (floor + coarser) / (speed + alpha * coarser)
        assert (np.diff(events) >= least).all()
        assert least.max() > 0.05  # more than two ticks


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "silence"), [(0.0, ""), (0.2, ", maximum_silence_s = 1.0")])
def test_relative_event_consensus_keeps_rate_without_floor(loss, silence):
    """Dimarogonas, Frazzoli, Johansson, TAC 57(5), 2012, with the sum of a robot's errors for that of its law."""
    head, _, tail = text_of("consensus").partition("[formation.law]")
    shape, _, links = tail.partition("[formation.law.offset]")[2].partition("[formation.links]")
    formation = "[formation]\nstiffness = 0.15\nclamp = 1.0\n[formation.shape]"
    text = head + formation + shape + "[formation.links]" + links.replace('"link"', '"shape"')
    share = 0.1
    trigger = f'cases.event.trigger={{ kind = "relative", share = {share}{silence} }}'
    known = fly_text(text, "event", NOISELESS, f"channel.loss={loss}", 'formation.law="displacement"', trigger)
    off = np.linalg.norm(apart(known, OFFSETS), axis=1)
    spectrum, gain = np.linalg.eigvalsh(RING), 2.0 * 0.15  # of a Crazyflie [1/s]
    most = np.sqrt(spectrum[1]) / (2.0 * np.sqrt(2.0 * 2.0))  # share with which ‖A‖ ‖ε‖ outweighs the consensus
    assert rate_of(off, known, 2.0, 15.0) > gain * spectrum[1] * (1.0 - share / (1.0 - 2.0 * share) / most)
    assert off[-1] < 1e-4  # a threshold of 1 cm leaves millimetres
    for robot in range(5):
        events = known.sent.stamp[known.sent.link == robot]
        assert np.diff(events[events > 2.0]).min() > share / (gain * spectrum[-1] * (1.0 + share))


@pytest.mark.slow
def test_followers_go_into_the_hull_of_their_leaders():
    links = '"CF01 > CF03" = "link", "CF03 - CF04" = "link", "CF04 - CF05" = "link", "CF02 > CF05" = "link"'
    bare = "\n".join(line for line in text_of("consensus").splitlines() if " - CF0" not in line)
    known = fly_text(bare, "periodic", f"formation.links={{ {links} }}", 'formation.law={ kind = "consensus" }')
    first, second, *rest = known.true_position[-1, :, :2]
    for share, place in zip((0.25, 0.5, 0.75), rest, strict=True):
        assert place == pytest.approx((1.0 - share) * first + share * second, abs=0.02)


@every_case
@pytest.mark.parametrize("share", [0.6, 1.0, 1.2])
def test_pursuit_meets_circles_or_leaves_by_its_angle(case, share):
    angle, gain, half = share * np.pi / 6.0, 0.3, np.pi / 6.0
    known = flown("cyclic-pursuit", case, f"formation.law.angle={angle:.5f}", "duration_s=10").trace
    place = known.true_position[..., 0] + 1j * known.true_position[..., 1]
    mean = place.mean(axis=1)
    assert np.abs(mean - mean[0]).max() < 0.01
    late = known.time > 2.0
    turning = (place * np.exp(-2j * half * np.arange(6))).mean(axis=1)[late]  # the slowest motion of six
    rate = np.polyfit(known.time[late], np.log(np.abs(turning)), 1)[0]
    assert rate == pytest.approx(2.0 * gain * np.sin(half) * np.sin(angle - half), abs=0.008)
    speed = np.polyfit(known.time[late], np.unwrap(np.angle(turning)), 1)[0]
    assert speed == pytest.approx(2.0 * gain * np.sin(half) * np.cos(angle - half), rel=0.03)


LAG_SHAPE = np.array([[0.0, 0.0], [-0.5, 0.5], [-0.5, -0.5], [-1.0, 0.0], [-1.0, -0.7]])


@limits(0.001, 0.005, 0.008)
def test_followers_of_a_constant_leader_do_not_lag(case, most):
    known = flown("leader-observer", case).trace
    window = (known.time > 20.0) & (known.time < 38.0)
    assert np.abs(known.memory["v"][window] - [0.12, 0.0]).max() < 1e-3
    lag = np.linalg.norm(behind_first(known, LAG_SHAPE), axis=2)
    assert lag[window].max() < most < 0.2 < lag[0].max()


@pytest.mark.slow
def test_followers_without_velocity_lag_by_speed_over_gain():
    known = flown("leader-observer", "periodic", "formation.law.observer=1e-9", "duration_s=20").trace
    assert np.linalg.norm(behind_first(known, LAG_SHAPE)[-1, 1:3], axis=1) == pytest.approx(0.12 / 0.5, rel=0.05)


EDGE = np.linspace(-1.78, 1.78, 90)
SPOTS = np.stack(np.meshgrid(EDGE, EDGE), axis=-1).reshape(-1, 2)
WEIGHT = (1.0 + 8.0 * np.exp(-((SPOTS - 0.8) ** 2).sum(axis=1) / (2.0 * 0.5**2))) * (EDGE[1] - EDGE[0]) ** 2


def squares(places):
    return ((SPOTS[:, None] - places) ** 2).sum(axis=2)


def costs(ways):
    """H of places (T, N, 2)."""
    return np.array([squares(places).min(axis=1) @ WEIGHT for places in ways])


def off_centroid(places):
    """Farthest of any robot from the centroid of its cell, on an axis [m]."""
    owner, worst = squares(places).argmin(axis=1), 0.0
    for robot, place in enumerate(places):
        weight = WEIGHT * (owner == robot)
        worst = max(worst, np.abs(weight @ SPOTS / weight.sum() - place).max())
    return worst


@every_case
def test_coverage_lowers_its_cost_and_ends_at_centroids(case):
    known = flown("coverage", case).trace
    ways = known.true_position[::25, :, :2]
    found = costs(ways)
    assert np.diff(found).max() < 0.005
    assert found[-1] < 0.15 * found[0]
    assert known.measures["cost"][-1].sum() == pytest.approx(found[-1], rel=0.02)
    assert off_centroid(ways[-1]) < 0.03


@pytest.fixture(scope="module")
def five_alone():
    """H that the robots reach without CF06."""
    given = document.load("coverage", "robots.CF06.standby=true", "duration_s=16")
    return costs(simulate(without_standby(given.cases()["periodic"]), 1).true_position[-1:, :, :2])[0]


@every_case
def test_coverage_makes_up_for_a_robot_landing_midflight(case, five_alone):
    """The battery of CF06, a Crazyflie among Tellos, is low first."""
    others = tuple(f'robots.CF0{number}.kind="tello"' for number in range(1, 6))
    known = flown("coverage", case, *others, "safety.battery_low=0.975", "duration_s=16").trace
    ((lost, name),) = {(event.stamp, event.source) for event in known.events if event.text.startswith("land: its batt")}
    assert (name, lost) == ("CF06", pytest.approx(8.0, abs=1.0))
    five = known.true_position[:, :5, :2]
    assert costs(five[known.time < lost][-1:])[0] > 2.0 * five_alone
    after = costs(five[known.time > lost + 1.5][::25])  # it is lost to the others after 1 s
    assert np.diff(after).max() < 0.005
    assert after[-1] < 1.15 * five_alone
    assert off_centroid(five[-1]) < 0.06
    assert known.measures["mass"][-1, :5].sum() == pytest.approx(WEIGHT.sum(), rel=0.005)


@pytest.mark.parametrize("names", ["ABCD", "ABC"])
def test_cells_share_area_and_replace_a_lost_robot(names):
    law, places, total = Coverage(), {"A": (-1.0, 0.5), "B": (0.3, -1.2), "C": (0.8, 0.9), "D": (0.1, 0.2)}, 0.0
    for name in names:
        others = [NeighbourView(0, n, (*places[n], 0.0), ZERO, 0.0, 0.0, {}, None) for n in names if n != name]
        view = View(RobotFacts(name, 0, 4, False, 1.0, 0.1), {}, others)
        view.position = (*places[name], 0.0)
        total += law.step(view, {}).measures["mass"]
    assert total == pytest.approx(16.0)
    with pytest.raises(ValueError, match="convex"):
        Coverage(area=[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])


def test_followers_without_any_leader_stop():
    links = [Link(relative=(0.5, 0.0, 0.0)), Link(relative=(-0.5, 0.0, 0.0))]
    memory = {"v": (0.12, 0.0), "links": (1.0,)}  # as of a leader that both heard
    controls = exchange(LeaderObserver(), 0.25, memory, 4, links=links, flies=False, speed=0.2)
    assert [control.velocity[:2] for control in controls] == [(0.0, 0.0)] * 2


@limits(0.04, 0.05, 0.08)
def test_flock_keeps_spacing_velocity_and_rendezvous_of_mean(case, most):
    known = flown("flocking", case).trace
    place = known.true_position[..., :2]
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=3)[:, *np.triu_indices(7, 1)]
    assert apart.min() > 0.5
    near = apart[-1][apart[-1] < 0.84]
    assert near == pytest.approx([0.7] * 12, rel=0.15)  # all edges of a hexagon with its centre
    assert np.abs(known.memory["v"][-1] - [0.1, 0.0]).max() < 0.015
    late = known.time > known.time[-1] - 1.0
    speeds = (place[late][-1] - place[late][0]) / (known.time[late][-1] - known.time[late][0])
    assert np.abs(speeds - [0.1, 0.0]).max() < 0.02
    step, mean, speed = known.time[1] - known.time[0], place[0].mean(axis=0), np.zeros(2)
    for moment, actual in zip(known.time, place.mean(axis=1), strict=True):
        assert np.linalg.norm(mean - actual) < most
        target = np.array([-1.0 + 0.1 * moment, 0.0])
        speed = speed + step * (-0.15 * (mean - target) - 0.8 * (speed - [0.1, 0.0]))
        mean = mean + step * speed


def test_a_recording_has_memory_measures_and_words(tmp_path):
    known, _ = played_back(flown("average", "periodic", "duration_s=5", CENTRALISED).recorder, tmp_path)
    assert {name: values.shape for name, values in known.memory.items()} == dict.fromkeys("xqn", (251, 6, 1))
    assert ([*known.measures], len(known.sent) > 0) == (["disagreement"], True)


WIND = {"CF02": (-0.8, 0.3), "CF03": (-0.8, 0.3), "CF04": (-0.3, 0.1), "CF05": (-0.8, 0.3)}  # [m/s²]
WIND_SHAPE = np.array([[1.0, 0.0], [0.3, 0.6], [0.3, -0.6], [-0.6, 0.6], [-0.6, -0.6]])
SHELTER = 1.0 / (2.0 * 5.0)  # [s²] of a Crazyflie: error of its place in a wind, by gains of its loop


@limits(0.002, 0.005, 0.008)
def test_integral_action_leaves_no_error_in_a_wind(case, most):
    known = flown("integral", case).trace
    assert np.linalg.norm(behind_first(known, WIND_SHAPE)[known.time > 37.0], axis=2).max() < most
    for wind, z in zip(np.array([*WIND.values()]), known.memory["z"][-1, 1:], strict=True):
        beyond = max(SHELTER - LEASH / np.linalg.norm(wind), 0.0)  # what the reference of its place does not hold off
        assert z == pytest.approx(CRAZYFLIE.response * beyond * wind, abs=0.003)


@every_case
def test_integral_action_needs_no_leader_for_the_shape(case):
    text = text_of("integral").replace('leader = "CF01"', "").replace('"CF01 > ', '"CF01 - ')
    known = fly_text(text.replace("[5.0, 4.0, 2.5]", "[20.0, 20.0, 2.5]"), case)
    late = known.time > 37.0
    assert np.linalg.norm(behind_first(known, WIND_SHAPE)[late], axis=2).max() < 0.012
    drift = known.true_position[-1, 0, :2] - known.true_position[known.time > 10.0][0, 0, :2]
    assert np.linalg.norm(drift) > 0.5  # with the wind


@every_case
def test_displacement_keeps_an_error_in_a_wind(case):
    known = flown("integral", case, 'formation.law={ kind = "displacement" }').trace
    links = np.array([[2, 0, -1, 0], [0, 2, 0, -1], [-1, 0, 3, -1], [0, -1, -1, 2]])
    expected = np.linalg.solve(known.plan.experiment.formation.stiffness * links, SHELTER * np.array([*WIND.values()]))
    assert np.linalg.norm(expected, axis=1).min() > 0.15
    late = known.time > 37.0
    assert behind_first(known, WIND_SHAPE)[late, 1:].mean(axis=0) == pytest.approx(expected, abs=0.01)


def test_integral_stops_at_limit_and_for_held_robots():
    law = Integral(most=0.1)
    heard = NeighbourView(1, "B", (1.0, 0.0, 0.0), ZERO, 0.0, 0.0, {}, Link(relative=(0.0, 0.0, 0.0)))
    view = View(RobotFacts("A", 0, 2, flies=True, speed=1.0, step_s=0.1), {}, [heard])
    view.position = ZERO
    view.moves = False
    assert law.step(view, {"z": (0.02, 0.01)}).memory["z"] == (0.02, 0.01)
    view.moves = True
    memory = law.begin(view.robot)
    for _ in range(100):
        memory = law.step(view, memory).memory
    assert memory["z"] == pytest.approx((-0.1, 0.0))


@every_case
def test_robots_enclose_a_target_that_two_see(case):
    known = flown("enclosing", case).trace
    place = known.true_position[..., :2]
    assert known.memory["links"][-1, :, 0].tolist() == [0.0, 1.0, 2.0, 1.0, 2.0, 2.0]
    from_target = place[:, 1:] - place[:, :1]
    angle = np.unwrap(np.arctan2(from_target[..., 1], from_target[..., 0]), axis=0)
    ahead = np.sort(angle % (2.0 * np.pi), axis=1)
    gaps = np.diff(ahead, axis=1, append=ahead[:, :1] + 2.0 * np.pi)
    for begin, end in ((16.0, 20.0), (30.0, 38.0)):  # it stands, and drives
        late = (known.time > begin) & (known.time < end)
        assert np.abs(np.linalg.norm(from_target[late], axis=2) - 0.7).max() < 0.01
        assert np.abs(np.degrees(gaps[late]) - 72.0).max() < 4.0
        assert np.linalg.norm(known.memory["target"][late] - place[late, :1], axis=2).max() < 0.008  # 0.1 s old
        turned = np.polyfit(known.time[late], angle[late], 1)[0]
        assert turned.mean() == pytest.approx(0.2 * 2.0 * np.pi / 5.0, rel=0.01)


def test_robots_stay_once_nobody_reports_the_target():
    memory = {"target": (0.0, 0.0), "speed": (0.1, 0.0), "links": (1.0,)}  # as when both saw it
    controls = exchange(Enclosing(), 0.5, memory, 4, flies=True, speed=1.0)
    assert [(control.velocity, control.memory["links"]) for control in controls] == [(None, (4.0,))] * 2


def track_centrally(known, steps, seeing):
    """Estimates (K, 4) of one Kalman filter that has all readings of a run at once."""
    law, step = known.plan.experiment.formation.law, 0.1
    onward, per_axis = np.eye(4) + step * np.eye(4, k=2), [[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]]
    growth = law["agility"] * np.kron(per_axis, np.eye(2))
    x, covariance = np.array([*law["guess"], 0.0, 0.0]), np.diag(np.repeat(law["doubt"], 2)) ** 2
    states = []
    for moment in steps:
        x, covariance = onward @ x, onward @ covariance @ onward.T + growth
        information = np.linalg.inv(covariance)
        vector, (east, north) = information @ x, (x[:2] - known.true_position[moment, seeing, :2]).T
        far = np.hypot(east, north)
        expected, slopes = far, np.stack([east, north]) / far
        if law["sees"] == "direction":
            expected, slopes = np.arctan2(north, east), np.stack([-north, east]) / far**2
        change = known.measures["reading"][moment, seeing] - expected
        if law["sees"] == "direction":
            change = (change + np.pi) % (2.0 * np.pi) - np.pi
        for each, slope in zip(change[~np.isnan(change)], slopes.T[~np.isnan(change)], strict=True):
            information = information + np.outer([*slope, 0, 0], [*slope, 0, 0]) / law["sigma"] ** 2
            vector = vector + np.array([*slope, 0, 0]) * (each + slope @ x[:2]) / law["sigma"] ** 2
        covariance = np.linalg.inv(information)
        x = covariance @ vector
        states.append(x)
    return np.array(states)


def track(case, seed, *changes):
    """Mean squared errors of a place [m²], of the robots and of a central filter, and normalised ones of the robots."""
    run = flown("tracking", case, *changes, seed=seed)
    plan, known = run.plan, run.trace
    seeing, steps = slice(1, None), np.arange(5, len(known.time), 5)
    place = known.true_position[:, 0, :2]
    truth = np.hstack([place, np.gradient(place, known.time, axis=0)])[steps]
    states = track_centrally(known, steps, seeing)
    late = known.time[steps] > 5.0
    apart = (known.memory["x"][steps][:, seeing] - truth[:, None])[late]
    information = known.memory["all"][steps][:, seeing].reshape(len(steps), -1, 4, 4)[late]
    normalised = np.einsum("tni,tnij,tnj->tn", apart, information / plan.experiment.formation.law["sigma"] ** 2, apart)
    squares = (apart[..., :2] ** 2).sum(axis=2).mean(), ((states - truth)[late, :2] ** 2).sum(axis=1).mean()
    return *squares, normalised.mean(axis=1)[::20]  # every two seconds, since errors last that long


@limits(1.1, 1.15, 1.15)
def test_tracking_is_consistent_and_as_accurate_as_central(case, most):
    own, central, normalised = (np.stack(each) for each in zip(*(track(case, seed) for seed in (1, 2)), strict=True))
    assert central.mean() < own.mean() < min(most**2 * central.mean(), 0.05**2)
    normalised = normalised.ravel()
    low, high = 2.0 * gammaincinv(2.0 * len(normalised), [0.005, 0.995]) / len(normalised)  # of χ² with 4 each
    assert low < normalised.mean() < high


@pytest.mark.slow
def test_tracking_by_directions():
    own, central, _ = track("periodic", 1, "formation.law.sees=direction", "formation.law.sigma=0.08")
    assert own < min(1.1**2 * central, 0.06**2)


def without_lines(*begins):
    """Text of the file without lines that begin so."""
    text = index.find_file("tracking").read_text("utf-8")
    return "\n".join(line for line in text.splitlines() if not line.startswith(begins))


@pytest.mark.slow
def test_robots_without_sight_know_target_from_others():
    bare = document.loads(without_lines('"TB01 > KH01"', '"TB01 > KH04"'))
    known = fly(bare.cases()["event"].experiment).trace
    late = known.time > 5.0
    assert np.isnan(known.measures["reading"][late][:, [1, 4]]).all()
    apart = known.memory["x"][late][:, 1:, :2] - known.true_position[late, :1, :2]
    assert np.sqrt((apart**2).sum(axis=2).mean(axis=0)).max() < 0.06


@pytest.mark.parametrize(
    ("target", "unseen", "faults"),
    [("KH99", "-", ["the target 'KH99' is no robot of the experiment"]), ("KH02", "-", []),
     ("TB01", "TB01 > ", ["no robot sees TB01"])],
)  # fmt: skip
def test_a_target_is_a_robot_that_others_see(target, unseen, faults):
    plan = document.loads(without_lines(f'"{unseen}'), f"formation.law.target={target}").plan
    assert [each[:2] for each in plan.law.analyse(plan)] == [("error", fault) for fault in faults]
