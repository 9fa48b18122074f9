"""The table of docs/formations.md: rate of turning of formations with disagreeing robots, with and without a remedy.

python docs/rotation_table.py       # some minutes; needs nothing but zenpark
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from experiments.definition.experiment import Experiment, Formation, LinkTable, RobotTable, Start
from experiments.definition.formation import errors_over_time
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.metrics.signals import net_rotation
from experiments.metrics.statistics import spread
from experiments.virtual_time import simulation

SEEDS = tuple(range(200, 224))
EVENT = {"kind": "send-on-delta", "threshold": 0.01}
PERIODIC = {"kind": "periodic", "period_s": 0.02}
DEAD = {"kind": "distance", "dead_zone": 0.01}
SETTLED_S, DURATION_S = 40.0, 100.0
changed = msgspec.structs.replace


@dataclass(frozen=True)
class Row:
    """One line: rates [mrad/s] over the seeds, mean link error [mm], messages."""

    name: str
    rate: Sequence[float]
    error: float
    messages: float

    def __str__(self) -> str:
        rate = np.array(self.rate)
        half = spread(rate.tolist()).ci95 or 0.0
        mean = f"{rate.mean():.2f} ± {half:.2f}"
        root = f"{math.sqrt(float((rate**2).mean())):.2f}"
        return f"| {self.name} | {mean} | {root} | {self.error:.1f} | {self.messages:.0f} |"


def measured(name: str, experiment: Experiment) -> Row:
    """Of one experiment, from 40 s on."""
    plan, rate, error, messages = Plan(experiment), [], [], []
    follow = [row for row, each in enumerate(plan.names) if each != experiment.formation.leader]
    for seed in SEEDS:
        log = simulation.simulate(plan, seed)
        late = (log.time >= SETTLED_S) & (log.time < experiment.duration_s)
        position, time = log.true_position[late], log.time[late]
        rate.append(1e3 * (net_rotation(position[:, follow], time) or 0.0))
        error.append(1e3 * float(errors_over_time(plan.law, plan.formation, time, position).mean()))
        messages.append(len(log.sent))
    return Row(name, rate, float(np.mean(error)), float(np.mean(messages)))


def disagreeing(experiment: Experiment, by: float) -> Experiment:
    """Links in both directions: the first robot wants each shorter, the second longer, by `by` [m]."""
    links: dict[str, float | LinkTable] = {}
    for text, distance in experiment.formation.links.items():
        first, sign, second = text.split()
        if sign == ">" or isinstance(distance, LinkTable):
            links[text] = distance
        else:
            links[f"{first} > {second}"], links[f"{second} > {first}"] = distance + by, distance - by
    return changed(experiment, formation=changed(experiment.formation, links=links))


def by_law(experiment: Experiment, law: str | dict[str, object]) -> Experiment:
    """The same by another law."""
    return changed(experiment, formation=changed(experiment.formation, law=law))


def facing(experiment: Experiment) -> Experiment:
    """The reference with offsets instead of distances on two links from its leader; the heading is that of seed 200."""
    beside = {"TB01 > KH01": [-0.139, -0.584], "TB01 > KH03": [0.584, -0.139]}
    links = {**experiment.formation.links, **{text: LinkTable(offset=at, gain=1.0) for text, at in beside.items()}}
    return by_law(changed(experiment, formation=changed(experiment.formation, links=links)), "mixed")


def ring(count: int, kind: str, trigger: dict[str, object]) -> Experiment:
    """A regular polygon with sides of 0.6 m, started at random near its shape, and undisturbed; links go round it."""
    angle = 2.0 * math.pi * np.arange(count) / count
    place = 0.3 / math.sin(math.pi / count) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    hover = 0.8 if kind == "crazyflie" else None
    robots = {f"R{i}": RobotTable(kind=kind, start=(1.15 * place[i]).tolist(), hover=hover) for i in range(count)}
    links = {
        f"R{i} - R{(i + step) % count}": float(math.dist(place[i], place[(i + step) % count]))
        for step in range(1, (count + 1) // 2)
        for i in range(count)
    }
    formation = Formation(links=links)  # type: ignore[arg-type]
    return Experiment(
        title="ring", duration_s=DURATION_S, robots=robots, formation=formation, trigger=trigger,
        start=Start(scatter=0.1),
    )  # fmt: skip


def table() -> Iterator[Row]:
    """All lines."""
    for name, trigger in (("periodic", PERIODIC), ("send-on-delta 1 cm", EVENT)):
        triangle = disagreeing(ring(3, "khepera4", trigger), 0.01)
        yield measured(f"triangle of Kheperas, ± 1 cm, {name}", triangle)
        yield measured("… dead zone 1 cm", by_law(triangle, DEAD))
    five = ring(5, "crazyflie", EVENT)
    yield measured("ring of 5 Crazyflies, send-on-delta 1 cm", five)
    yield measured("… dead zone 1 cm", by_law(five, DEAD))
    park = document.read("robotic-park").cases()
    for name, case in (("periodic", park["periodic"]), ("send-on-delta 1 cm", park["event"])):
        alone = changed(case.experiment, timeline=[], duration_s=DURATION_S)
        yield measured(f"reference, {name}", alone)
        yield measured("… dead zone 1 cm", by_law(alone, DEAD))
        yield measured(f"reference, ± 1 cm, {name}", disagreeing(alone, 0.01))
        yield measured("… dead zone 1 cm", by_law(disagreeing(alone, 0.01), DEAD))
        yield measured("… two offsets from the leader", facing(disagreeing(alone, 0.01)))


if __name__ == "__main__":
    for line in table():
        print(line, flush=True)
