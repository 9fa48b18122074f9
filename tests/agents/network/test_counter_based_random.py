"""Numbers that can be looked up: uniform, without a trace of their neighbours, and the same for ever."""

import numpy as np
import pytest

from agents.network.channel_model import key, uniform

COUNT = 200_000


def keys(*texts):
    return np.array([key(1, text) for text in texts], dtype=np.uint64)


def test_the_first_numbers_of_the_generator_that_it_is():
    """SplitMix64 with seed 0 begins with these words (as in the tests of its other implementations)."""
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    found = uniform(np.zeros(3, dtype=np.uint64), np.arange(1, 4))
    assert found.tolist() == [(word >> 11) / 2**53 for word in words]


def test_keys_are_what_they_were():
    """Whoever changes them loses other samples than runs did before."""
    assert key(1, "A", "B") == 0x2E2988F8CB8FE3C8


def test_keys_differ_by_seed_names_and_their_order():
    made = [key(1, "A", "B"), key(2, "A", "B"), key(1, "B", "A"), key(1, "AB"), key(1, "A", "B", ""), key(11, "B")]
    assert len(set(made)) == len(made)
    assert all(0 <= each < 2**64 for each in made)


@pytest.mark.parametrize("stride", [1, 2, 64, 2**20])
def test_they_are_uniform(stride):
    """χ² over a thousand bins: the mean is 999, four standard deviations are 179."""
    for one in keys("A", "B", "C"):
        u = uniform(np.array([one]), np.arange(COUNT) * stride)
        assert 0.0 <= u.min() < u.max() < 1.0
        bins = np.bincount((1000 * u).astype(int), minlength=1000)
        assert abs(((bins - COUNT / 1000) ** 2 / (COUNT / 1000)).sum() - 999.0) < 179.0
        assert u.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * COUNT))


def test_neighbours_are_independent():
    a, b = (uniform(np.array([one]), np.arange(COUNT)) for one in keys("A", "B"))
    limit = 4.5 / np.sqrt(COUNT)
    for lag in (1, 2, 3, 7, 64):
        assert abs(np.corrcoef(a[:-lag], a[lag:])[0, 1]) < limit
    assert abs(np.corrcoef(a, b)[0, 1]) < limit
    pairs = np.bincount((32 * a[:-1]).astype(int) * 32 + (32 * a[1:]).astype(int), minlength=1024)
    expected = (COUNT - 1) / 1024
    assert abs(((pairs - expected) ** 2 / expected).sum() - 1023.0) < 181.0


def test_a_number_belongs_to_its_key_and_counter():
    names, counter = keys("A", "B", "C"), np.array([5, 1, 2**40])
    whole = uniform(names[:, None], counter)
    assert whole.shape == (3, 3)
    for i in range(3):
        for j in range(3):
            assert whole[i, j] == uniform(names[i : i + 1], counter[j : j + 1])[0]
