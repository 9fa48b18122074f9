"""Auctions and averages on networks of points that lose messages: their bounds, and steps that are stable."""

from math import ceil, cos, dist, isfinite, nan, pi, sin
from random import Random

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import shortest_path

from agents.decision.stepping import rounded
from agents.formation.link import Link
from agents.plugins.gallery.aggregative import Aggregative
from agents.plugins.gallery.auction import Auction
from agents.plugins.gallery.average import Average
from agents.plugins.law import NeighbourView, RobotFacts, View
from agents.vectors import ZERO
from experiments.catalogue import index
from experiments.check.check import check
from experiments.file import document


class Talking:
    """Points at `places` with a law; `pairs` hear each other, both ways."""

    def __init__(self, law, places, pairs, *, loss=0.0, seed=0, step_s=0.1, every=1):
        self.law, self.loss, self.random, self.step_s, self.every = law, loss, Random(seed), step_s, every
        self.places, self.rounds = [(x, y, 0.0) for x, y in places], 0
        names = [f"R{number}" for number in range(len(places))]
        self.facts = [RobotFacts(each, n, len(names), True, 1.0, step_s) for n, each in enumerate(names)]
        self.memory = [law.begin(each) for each in self.facts]
        self.said = list(self.memory)
        unknown = {name: (nan,) * len(self.memory[0][name]) for name in law.SAYS}
        self.heard = {way: unknown for i, j in pairs for way in ((i, j), (j, i))}  # by receiver and sender
        self.controls = []

    def round(self):
        """All step; then they speak, every so often."""
        self.controls = [self._step(number) for number in range(len(self.facts))]
        self.memory = [each.memory for each in self.controls]
        for number, control in enumerate(self.controls):
            if control.velocity is not None:
                self.places[number] = tuple(
                    p + self.step_s * v if isfinite(v) else p
                    for p, v in zip(self.places[number], control.velocity, strict=True)
                )
        self.rounds += 1
        if self.rounds % self.every == 0:
            self.said = [{name: tuple(map(rounded, each[name])) for name in self.law.SAYS} for each in self.memory]
            for receiver, sender in self.heard:
                if self.random.random() >= self.loss:
                    self.heard[receiver, sender] = self.said[sender]
        return self

    def _step(self, number):
        neighbours = [
            NeighbourView(j, self.facts[j].name, self.places[j], ZERO, nan, 0.0, words, Link())
            for (i, j), words in self.heard.items()
            if i == number
        ]
        view = View(self.facts[number], self.said[number], neighbours)
        view.position, view.time = self.places[number], self.rounds * self.step_s
        return self.law.step(view, self.memory[number])


def law_findings(name, *changes):
    """Severity, message and remedy of what a check finds about the law of an experiment of the catalogue."""
    found = check(document.read(index.find_file(name), changes), ["periodic"])
    return [(each.severity, each.message, each.remedy) for each in found if each.code == "law"]


@pytest.mark.parametrize(
    ("name", "link", "found", "mends"),
    [("auction", " - CF", "do not reach", ""), ("average", "KH06 - KH01", "KH01 receives KH06", '"KH06 - KH01"')],
)
def test_links_of_one_way_are_found(name, link, found, mends):
    """Bids that do not come back, and averages that are none."""
    text = index.find_file(name).read_text("utf-8").replace(link, link.replace(" - ", " > "))
    plan = document.loads(text).cases()["periodic"]
    ((severity, message, remedy),) = plan.law.analyse(plan)
    assert severity == "error"
    assert found in message
    assert mends in remedy


EPSILON = 0.2


def drawn(seed):
    """Places of robots and tasks in 4 m × 4 m, links of a tree, and a few more."""
    random = Random(seed)
    robots, tasks = random.randint(2, 8), random.randint(1, 10)
    places, wanted = (
        [(random.uniform(-2.0, 2.0), random.uniform(-2.0, 2.0)) for _ in range(count)] for count in (robots, tasks)
    )
    pairs = {(random.randrange(child), child) for child in range(1, robots)}
    for _ in range(robots // 3):
        pairs.add(tuple(sorted(random.sample(range(robots), 2))))
    return places, wanted, sorted(pairs)


def settled(talking, most=6000):
    """Rounds until all hold the same bids and have heard that nothing changes."""
    calm = 0
    while calm < 40:
        before = [(each["level"], each["bidder"]) for each in talking.memory]
        talking.round()
        now = [(each["level"], each["bidder"]) for each in talking.memory]
        calm = calm + 1 if before == now and len(set(now)) == 1 else 0
        assert talking.rounds < most
    return talking.rounds - 40


def joined(pairs, count):
    """Matrix with 1 where two points hear each other."""
    matrix = np.zeros((count, count))
    for i, j in pairs:
        matrix[i, j] = matrix[j, i] = 1.0
    return matrix


def least(places, tasks):
    ways = np.array([[dist(place, task) for task in tasks] for place in places])
    return ways[linear_sum_assignment(ways)].sum()


def won(talking):
    """Tasks by robot, -1: none."""
    return [int(each.measures["task"]) for each in talking.controls]


def total(places, tasks, taken):
    """Sum of ways [m]."""
    return sum(dist(place, tasks[k]) for place, k in zip(places, taken, strict=True) if k >= 0)


def no_task_twice(taken, tasks):
    got = [each for each in taken if each >= 0]
    return len(got) == len(set(got)) == min(len(taken), len(tasks))


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_auction_total_is_within_bound_of_optimum(loss):
    gaps = []
    for seed in range(40):
        places, tasks, pairs = drawn(seed)
        law = Auction(tasks=tasks, epsilon=EPSILON, calm_s=1e9)
        talking = Talking(law, places, pairs, loss=loss, seed=seed)
        took = settled(talking)
        if not loss:
            longest = max(dist(place, task) for place in places for task in tasks)
            hops = shortest_path(joined(pairs, len(places)), unweighted=True).max()
            assert took <= 2.0 * hops * ceil(longest / EPSILON)
        assert no_task_twice(won(talking), tasks)
        gaps.append((total(places, tasks, won(talking)) - least(places, tasks)) / (EPSILON * len(places)))
    assert min(gaps) > -1e-9
    assert 0.01 < max(gaps) <= 1.0  # some are not the least


@pytest.mark.slow
def test_robots_that_begin_anew_take_no_task_twice():
    for seed in range(20):
        (places, tasks, pairs), random = drawn(seed), Random(seed)
        law = Auction(tasks=tasks, epsilon=EPSILON, calm_s=1e9)
        talking = Talking(law, places, pairs, loss=0.3, seed=seed)
        for _ in range(3):
            for _ in range(random.randint(1, 60)):
                talking.round()
            restarted = random.randrange(len(places))
            talking.memory[restarted] = talking.said[restarted] = law.begin(talking.facts[restarted])
        settled(talking)
        assert no_task_twice(won(talking), tasks)


@pytest.mark.usefixtures("unflown")
def test_rounds_are_foretold_and_small_bids_found():
    ((severity, message, _),) = law_findings("auction")
    assert severity == "note"
    assert f"about {3 * ceil(dist((1.5, -1.5), (-1.6, 1.2)) / 0.15)} rounds" in message
    ((severity, _, remedy),) = law_findings("auction", "formation.law.epsilon=0.01")
    assert severity == "warning"
    assert law_findings("auction", f"formation.law.epsilon={remedy.split()[3]}")[0][0] == "note"


def modes(pairs, count):
    """Eigenvalues of the Laplacian with the weights of the law."""
    links = joined(pairs, count)
    degree = links.sum(axis=1)
    weights = links / np.maximum(np.maximum(degree[:, None], degree), 1.0)
    return np.linalg.eigvalsh(np.diag(weights.sum(axis=1)) - weights).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 4])
def test_growth_is_that_of_the_estimator(every):
    kept, lost = 0, 0
    for seed in range(24):
        random = Random(seed)
        count = random.randint(3, 7)
        pairs = {(k, k + 1) for k in range(count - 1)} | {tuple(sorted(random.sample(range(count), 2)))}
        law = Average(
            signal={f"R{k}": random.uniform(-1.0, 1.0) for k in range(count)},
            rate=random.uniform(0.5, 4.0),
            gain=random.uniform(0.5, 20.0 / every),
            integral=random.uniform(0.5, 9.0 / every),
        )
        growth = law.growth(modes(pairs, count), 0.1, every)
        if 0.98 < growth < 1.02:
            continue
        talking = Talking(law, [(0.0, 0.0)] * count, pairs, every=every)
        for _ in range(300 * every):
            talking.round()
        error = max(abs(each["x"][0] - np.mean([*law.signal.values()])) for each in talking.memory)
        kept, lost = kept + (growth < 1.0), lost + (growth > 1.0)
        assert (error < 0.02) == (growth < 1.0), (seed, growth, error)
    assert kept > 3
    assert lost > 3


@pytest.mark.slow
@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize("name", ["average", "aggregative"])
def test_gains_beyond_the_bound_are_found_with_remedy(name):
    assert [severity for severity, *_ in law_findings(name)] == ["note"]
    ((severity, message, remedy),) = law_findings(name, "formation.law.integral=9", "formation.law.gain=4")
    assert severity == "error"
    assert "diverges" in message
    words = remedy.split()
    gain, integral = words[words.index("gain") + 2], words[words.index("integral") + 2].strip(",")
    changes = (f"formation.law.gain={gain}", f"formation.law.integral={integral}")
    assert law_findings(name, *changes)[0][0] in {"note", "warning"}
    assert law_findings(name, "formation.law.rate=21")[0][0] == "error"


@pytest.mark.parametrize(("team", "stable"), [(1.0, True), (3.0, True), (10.0, False)])
def test_descent_too_quick_for_its_estimators_swings(team, stable):
    targets = {f"R{k}": (cos(k * pi / 3.0) + 0.5, sin(k * pi / 3.0)) for k in range(6)}
    law = Aggregative(targets=targets, places=dict.fromkeys(targets, (0.0, 0.0)), own=0.1, team=team)
    talking = Talking(law, [(0.0, 0.0)] * 6, [(k, (k + 1) % 6) for k in range(6)])
    for _ in range(800):
        talking.round()
    centre = np.mean(talking.places, axis=0)[:2]
    error = np.linalg.norm(centre - [0.5 * 0.1 / (0.1 + team), 0.0])
    assert (error < 1e-2) == stable
    assert (2.0 * (law.rate + law.descent * law.own) ** 2 > law.rate * law.descent * team) == stable
