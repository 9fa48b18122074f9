"""Goals of a robot: laws that give something else than numbers are named before the robot takes off."""

import pytest

from agents.plugins.laws import Distance
from agents.plugins.registry import PluginError
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.agents.swarm import Swarm


class Planar(Distance, frozen=True):
    """Its pull has no height."""

    def pull(self, apart, link):
        return super().pull(apart, link)[:2]


class Silent(Distance, frozen=True):
    """Its error is nothing."""

    def error(self, apart, link):
        super().error(apart, link)


@pytest.mark.parametrize(
    ("law", "says"),
    [
        (Planar(), r"`pull` of the law Planar must give three numbers, not \("),
        (Silent(), r"`error` of the law Silent must give a number, not nothing: is a `return` missing\?"),
    ],
)
def test_law_of_the_wrong_shape_is_named(law, says, monkeypatch):
    monkeypatch.setattr(Plan, "law", law)
    with pytest.raises(PluginError, match=says):
        Swarm(pair()).running()
