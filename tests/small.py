"""Small experiments built in Python, a law in text, and the reference experiment."""

from collections.abc import Mapping
from functools import cache

import msgspec

from agents.body.interface import Disturbance, Jitter
from agents.body.kinds import KINDS
from experiments.definition.experiment import Experiment, Formation, LinkTable, RobotTable
from experiments.file import document

PERIODIC = {"kind": "periodic", "period_s": 0.02}
NOISY = {
    "all": Disturbance(position_sigma=0.0005, yaw_sigma=0.002),
    "crazyflie": Disturbance(hover_jitter=Jitter(0.01)),
    "KH03": Disturbance(latency_s=0.05, odometry_drift=0.002),
    "CF02": Disturbance(latency_s=0.02),
}
COUNTING_LAW = '''
from math import nan

from zenpark import Control, Law, Measure


class Counting(Law, frozen=True):
    """The law `displacement`, which also counts its steps."""

    NEEDS = "relative"
    MEASURES = {"push": Measure("m")}

    stiffness: float = 0.3

    def begin(self, robot):
        return {"steps": (0.0,)}

    def step(self, view, memory):
        x = y = 0.0
        for each in view.neighbours:
            x += self.stiffness * (each.link.relative[0] - view.position[0] + each.position[0])
            y += self.stiffness * (each.link.relative[1] - view.position[1] + each.position[1])
        goal, steps = (view.position[0] + x, view.position[1] + y, nan), memory["steps"][0]
        return Control(memory={"steps": (steps + 1.0,)}, goal=goal, measures={"push": (x * x + y * y) ** 0.5})
'''


def changed(experiment: Experiment, **parts: object) -> Experiment:
    """The experiment with other parts."""
    return msgspec.structs.replace(experiment, **parts)


@cache
def reference(case: str = "event") -> Experiment:
    """A case of the reference experiment; never written to."""
    return document.read("robotic-park").cases()[case].experiment


def small(
    robots: Mapping[str, str | RobotTable], links: Mapping[str, float | LinkTable] | None = None, /, **parts: object
) -> Experiment:
    """Experiment of robots by name: as the file has them, or a kind, which stands 0.5 m right of the one before.

    Drones hover at 0.5 m. `links`: of the formation, e.g. {"A - B": 0.5} [m]; `parts`: whatever else it has.
    """
    tables = {
        name: RobotTable(kind=given, start=[0.5 * k, 0.0], hover=0.5 if KINDS[given].flies else None)
        if isinstance(given, str)
        else given
        for k, (name, given) in enumerate(robots.items())
    }
    fixed = {"title": "A test", "robots": tables, "duration_s": 10.0, "formation": Formation(links=dict(links or {}))}
    return Experiment(**{**fixed, **parts})  # type: ignore[arg-type]


A_AND_B = {"A": RobotTable(kind="khepera4", start=[-0.4, 0.0]), "B": RobotTable(kind="khepera4", start=[0.4, 0.1])}


def pair(**parts: object) -> Experiment:
    """Two ground robots that receive each other, and want to be 0.5 m apart; `parts` changes that."""
    return small(A_AND_B, {"A - B": 0.5}, **{"title": "A pair", "duration_s": 60.0, "trigger": PERIODIC, **parts})


def triangle(**parts: object) -> Experiment:
    """Three ground robots; C receives nobody and stands."""
    robots = {**A_AND_B, "C": RobotTable(kind="khepera4", start=[0.0, -0.5])}
    links: dict[str, float | LinkTable] = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}
    return pair(robots=robots, formation=Formation(links=links), **parts)
