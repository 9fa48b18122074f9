"""Camera of the live view: what a page of any shape has in sight."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from experiments.view import live


@pytest.mark.parametrize("size", [(2.0, 2.0, 0.95), (12.0, 12.0, 1.1), (4.3, 2.0, 0.95), (0.5, 6.0, 2.0)])
@pytest.mark.parametrize("aspect", [0.46, 0.85, 1.24, 3.0])
def test_whole_arena_is_in_sight_and_fills_page(size, aspect):
    place, at = live.standpoint(size, aspect)
    ahead = (at - place) / np.linalg.norm(at - place)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = np.array(list(product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)))) * size - place
    depth = np.tan(0.5 * live.FOV) * (seen @ ahead)
    over, up = seen @ right / depth / aspect, seen @ np.cross(right, ahead) / depth
    low, high = live.ABOVE if aspect < live.PHONE else live.FREE
    assert (depth > 0.0).all()
    assert np.abs(over).max() <= 0.9201
    assert low - 1e-4 <= up.min() <= up.max() <= high + 1e-4
    fills = np.ptp(over) / np.ptp(live.FREE), np.ptp(up) / (high - low)
    assert max(fills) == pytest.approx(1.0)
