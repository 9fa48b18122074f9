"""An experiment of one robot, flown."""

from experiments.definition.experiment import Formation, RobotTable
from tests.agents.swarm import Swarm
from tests.small import NOISY, PERIODIC, pair, triangle  # noqa: F401


def drone(**parts):
    """One Crazyflie that stands in the air."""
    robots = {"F": RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5)}
    return Swarm(pair(robots=robots, formation=Formation(), **parts))
