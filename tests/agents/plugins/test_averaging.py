"""Averages in proportional-integral form on networks of points: where the steps of their estimators are stable."""

from random import Random

import numpy as np
import pytest

from agents.plugins.gallery.aggregative import Aggregative
from agents.plugins.gallery.average import Average
from tests.agents.plugins.talking import Talking, law_findings, one_way


def modes(pairs, count):
    """Eigenvalues of the Laplacian with the weights of the law."""
    joined = np.zeros((count, count))
    for i, j in pairs:
        joined[i, j] = joined[j, i] = 1.0
    degree = joined.sum(axis=1)
    weights = joined / np.maximum(np.maximum(degree[:, None], degree), 1.0)
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


def test_a_link_of_one_way_is_no_average():
    message, remedy = one_way("average", "KH06 - KH01")
    assert "KH01 receives KH06" in message
    assert '"KH06 - KH01"' in remedy


RING = [(k, (k + 1) % 6) for k in range(6)]
ANGLES = np.arange(6) * np.pi / 3.0


@pytest.mark.parametrize(("team", "stable"), [(1.0, True), (3.0, True), (10.0, False)])
def test_descent_too_quick_for_its_estimators_swings(team, stable):
    targets = {f"R{k}": (float(np.cos(a)) + 0.5, float(np.sin(a))) for k, a in enumerate(ANGLES)}
    law = Aggregative(targets=targets, places=dict.fromkeys(targets, (0.0, 0.0)), own=0.1, team=team)
    talking = Talking(law, [(0.0, 0.0)] * 6, RING)
    for _ in range(800):
        talking.round()
    centre = np.mean(talking.places, axis=0)[:2]
    error = np.linalg.norm(centre - [0.5 * 0.1 / (0.1 + team), 0.0])
    assert (error < 1e-2) == stable
    assert (2.0 * (law.rate + law.descent * law.own) ** 2 > law.rate * law.descent * team) == stable
