"""Numbers that can be looked up: uniform, without a trace of their neighbours, and the same for ever."""

import numpy as np
import pytest

from agents.network.channel_model import key, uniform

COUNT = 100_000


def numbers(word, stride=1):
    return np.array([uniform(word, counter * stride) for counter in range(COUNT)])


def test_first_numbers_of_splitmix64():
    """SplitMix64 with seed 0 begins with these words (as in the tests of its other implementations)."""
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [uniform(0, counter) for counter in (1, 2, 3)] == [(word >> 11) / 2**53 for word in words]


def test_keys_are_what_they_were():
    """Whoever changes them loses other samples than runs did before."""
    assert key(1, "A", "B") == 0x2E2988F8CB8FE3C8


def test_keys_differ_by_seed_names_and_order():
    made = [key(1, "A", "B"), key(2, "A", "B"), key(1, "B", "A"), key(1, "AB"), key(1, "A", "B", ""), key(11, "B")]
    assert len(set(made)) == len(made)
    assert all(0 <= each < 2**64 for each in made)


@pytest.mark.parametrize("stride", [1, 2, 64, 2**20])
def test_numbers_are_uniform(stride):
    """χ² over a thousand bins: the mean is 999, four standard deviations are 179."""
    u = numbers(key(1, "A"), stride)
    assert 0.0 <= u.min() < u.max() < 1.0
    bins = np.bincount((1000 * u).astype(int), minlength=1000)
    assert abs(((bins - COUNT / 1000) ** 2 / (COUNT / 1000)).sum() - 999.0) < 179.0
    assert u.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * COUNT))


def test_neighbours_are_independent():
    a, b = (numbers(key(1, name)) for name in "AB")
    limit = 4.5 / np.sqrt(COUNT)
    for lag in (1, 2, 3, 7, 64):
        assert abs(np.corrcoef(a[:-lag], a[lag:])[0, 1]) < limit
    assert abs(np.corrcoef(a, b)[0, 1]) < limit
    pairs = np.bincount((32 * a[:-1]).astype(int) * 32 + (32 * a[1:]).astype(int), minlength=1024)
    expected = (COUNT - 1) / 1024
    assert abs(((pairs - expected) ** 2 / expected).sum() - 1023.0) < 181.0
