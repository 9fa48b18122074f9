"""Experiments of one, two and three robots."""

from agents.body.interface import Disturbance, Jitter
from experiments.definition.experiment import Formation, RobotTable
from experiments.file import document
from tests.agents.swarm import Swarm

PERIODIC = {"kind": "periodic", "period_s": 0.02}
NOISY = {
    "all": Disturbance(position_sigma=0.0005, yaw_sigma=0.002),
    "crazyflie": Disturbance(hover_jitter=Jitter(0.01)),
    "KH03": Disturbance(latency_s=0.05, odometry_drift=0.002),
    "CF02": Disturbance(latency_s=0.02),
}


def pair(**parts):
    """Two ground robots that receive each other, and want to be 0.5 m apart; `parts` changes that."""
    given = {
        "title": "A pair",
        "duration_s": 60.0,
        "robots": {
            "A": RobotTable(kind="khepera4", start=[-0.4, 0.0]),
            "B": RobotTable(kind="khepera4", start=[0.4, 0.1]),
        },
        "formation": Formation(links={"A - B": 0.5}),
        "trigger": PERIODIC,
        **parts,
    }
    return document.Experiment(**given)


def triangle(**parts):
    """Three ground robots; C receives nobody and stands."""
    robots = {
        name: RobotTable(kind="khepera4", start=start)
        for name, start in {"A": [-0.4, 0.0], "B": [0.4, 0.1], "C": [0.0, -0.5]}.items()
    }
    links = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}
    return pair(robots=robots, formation=Formation(links=links), **parts)


def drone(**parts):
    """One Crazyflie that stands in the air."""
    robots = {"F": RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5)}
    return Swarm(pair(robots=robots, formation=Formation(), **parts))
