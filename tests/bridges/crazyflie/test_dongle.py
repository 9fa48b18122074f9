"""The Crazyflie bridge over the unmodified radio driver of cflib and a software Crazyradio."""

import numpy as np
import pytest

from tests.bridges.crazyflie_flight import flown, truth

pytestmark = pytest.mark.system

RADIO = {"link": "radio"}


@pytest.fixture(autouse=True)
def toc_cache(monkeypatch, tmp_path_factory):
    """cflib's cache, kept from one test to the next and away from the user's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def test_flight_over_the_radio():
    with flown(device=RADIO) as (twin, process):
        assert twin.device.lines[0].safelink
        process.takeoff(0.4)
        process.setpoint = [(0.2, 0.0, 0.4, 0.0)]
        process.until(lambda: abs(truth(twin)[0] - 0.2) < 0.03, "goal")
        assert np.abs(process.state.position - twin.truth()[0]).max() < 0.05
        process.land()
