"""Goals: a law that gives something else than a vector for each robot and a value for each link is named."""

import numpy as np
import pytest

from agents.plugins.laws import Distance
from agents.plugins.registry import PluginError
from experiments.definition.experiment import Experiment, Formation, Robot
from experiments.definition.plan import Plan
from tests.agents.swarm import Swarm


class OfLinks(Distance, frozen=True):
    """Its offset has a row for each link."""

    def offset(self, position, sender_position, links):
        return position[links.receiver] - sender_position


class Summed(Distance, frozen=True):
    """Its error is one number."""

    def error(self, position, sender_position, links):
        return np.sum(super().error(position, sender_position, links))


@pytest.mark.parametrize(
    ("law", "says"),
    [
        (OfLinks, r"`offset` of the law OfLinks must give a vector for each robot, \(3, 3\), not \(\d, 3\)"),
        (Summed, r"`error` of the law Summed must give one value for each link, \(\d,\), not \(\)"),
    ],
)
def test_a_law_of_the_wrong_shape_is_named(law, says, monkeypatch):
    monkeypatch.setattr(Plan, "law", law())
    places = {"A": [-0.4, 0.0], "B": [0.4, 0.1], "C": [0.0, -0.5]}
    robots = {name: Robot(kind="khepera4", start=start) for name, start in places.items()}
    links = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}
    experiment = Experiment(title="Three", duration_s=5.0, robots=robots, formation=Formation(links=links))
    with pytest.raises(PluginError, match=says):
        Swarm(experiment, [["A", "B", "C"]]).running().run(1.0)
