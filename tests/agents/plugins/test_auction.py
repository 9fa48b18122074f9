"""The auction on networks of points: its bound, its losses, and tasks that appear."""

from math import ceil, dist
from random import Random

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import shortest_path

from agents.plugins.gallery.auction import Auction
from tests.agents.plugins.talking import Talking, law_findings, one_way

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


def hops(pairs, count):
    """Links between the two robots that are farthest apart."""
    joined = np.zeros((count, count))
    for i, j in pairs:
        joined[i, j] = 1.0
    return shortest_path(joined, directed=False, unweighted=True).max()


def least(places, tasks):
    """Least sum of ways [m]."""
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
    for seed in range(100):
        places, tasks, pairs = drawn(seed)
        law = Auction(tasks=tasks, epsilon=EPSILON, calm_s=1e9)
        talking = Talking(law, places, pairs, loss=loss, seed=seed)
        took = settled(talking)
        if not loss:
            longest = max(dist(place, task) for place in places for task in tasks)
            assert took <= 2.0 * hops(pairs, len(places)) * ceil(longest / EPSILON)
        assert no_task_twice(won(talking), tasks)
        gaps.append((total(places, tasks, won(talking)) - least(places, tasks)) / (EPSILON * len(places)))
    assert min(gaps) > -1e-9
    assert 0.01 < max(gaps) <= 1.0  # some are not the least


def test_all_bid_anew_when_a_task_appears():
    places, tasks, pairs = drawn(3)
    law = Auction(tasks=tasks[:-1], later=[(*tasks[-1], 20.0)], epsilon=EPSILON, calm_s=0.5)
    talking = Talking(law, places, pairs)
    while talking.rounds * talking.step_s < 19.95:
        talking.round()
    begin = [place[:2] for place in talking.places]
    assert sorted(dist(place, tasks[k]) < 0.01 for place, k in zip(begin, won(talking), strict=True) if k >= 0)
    settled(talking)
    assert total(begin, tasks, won(talking)) <= least(begin, tasks) + EPSILON * len(places)


@pytest.mark.slow
def test_robots_that_begin_anew_take_no_task_twice():
    for seed in range(40):
        places, tasks, pairs = drawn(seed)
        law, random = Auction(tasks=tasks, epsilon=EPSILON, calm_s=1e9), Random(seed)
        talking = Talking(law, places, pairs, loss=0.3, seed=seed)
        for _ in range(3):
            for _ in range(random.randint(1, 60)):
                talking.round()
            restarted = random.randrange(len(places))
            talking.memory[restarted] = talking.said[restarted] = law.begin(talking.facts[restarted])
        settled(talking)
        assert no_task_twice(won(talking), tasks)


@pytest.mark.slow
def test_rounds_are_foretold_and_small_bids_found():
    ((severity, message, _),) = law_findings("auction")
    assert severity == "note"
    assert f"about {3 * ceil(dist((1.5, -1.5), (-1.6, 1.2)) / 0.15)} rounds" in message
    ((severity, _, remedy),) = law_findings("auction", "formation.law.epsilon=0.01")
    assert severity == "warning"
    assert law_findings("auction", f"formation.law.epsilon={remedy.split()[3]}")[0][0] == "note"


def test_bids_that_do_not_come_back_are_found():
    message, _ = one_way("auction", " - CF")
    assert "do not reach" in message
