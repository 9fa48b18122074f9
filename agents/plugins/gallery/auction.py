"""Assignment of tasks by auction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import ceil, dist, floor, inf, nan
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from zenpark import Control, Law, Measure, Memory, NotNegative, Positive, RobotFacts, Said, Severity, View

Place = tuple[float, float]

MOST_TASKS: Final = 31  # two of 64 numbers for each task


class Auction(Law, frozen=True):
    """Each robot wins one task and goes there: the sum of ways is within n ε of the least, with n robots.

    A robot without a task bids for the task with the largest profit, way saved less price. It raises the price until
    the next best task is as good, and by ε. Neighbours exchange the highest bids; of equal ones that of the higher
    number holds (M. M. Zavlanos, L. Spesivtsev, G. J. Pappas, "A distributed auction algorithm for the assignment
    problem", IEEE Conference on Decision and Control, 2008; on consensus of bids H.-L. Choi, L. Brunet, J. P. How,
    "Consensus-based decentralized auctions for robust task allocation", IEEE Transactions on Robotics 25(4), 2009).
    Bids are states, which a lost message only delays. Prices count in ε: levels are transmitted exactly. Robots without
    a task stay. When a task appears all bid again, from their places at that time. A robot that is lost keeps what it
    won.
    """

    ALONE: ClassVar[bool] = True
    MEASURES: ClassVar[Mapping[str, Measure]] = {"task": Measure(better=""), "calm": Measure("s", better="")}
    SAYS: ClassVar[Mapping[str, Said]] = {
        "level": Said(unit="ε", metre=1e-3),
        "bidder": Said(metre=1e-3),
        "called": Said(metre=1e-3),
    }

    tasks: Annotated[list[Place], Meta(description="places x, y [m]", examples=[[[1.0, 0.5], [-1.0, 0.5]]])] = (
        msgspec.field(default_factory=list)
    )
    later: Annotated[
        list[tuple[float, float, NotNegative]],
        Meta(description="tasks that appear in the run: x, y [m], time after the common start [s]"),
    ] = msgspec.field(default_factory=list)
    epsilon: Annotated[float, Meta(ge=1e-3, description="ε: what a bid adds at least [m]")] = 0.05
    speed: Annotated[Positive, Meta(description="on the way to the task [m/s]")] = 0.2
    gain: Annotated[Positive, Meta(description="of the approach to the task [1/s]")] = 1.0
    calm_s: Annotated[NotNegative, Meta(description="time without a new bid before the robot moves [s]")] = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError if there are more tasks than can be said."""
        if len(self.tasks) + len(self.later) > MOST_TASKS:
            raise ValueError(f"at most {MOST_TASKS} tasks: of each a pose carries two numbers")

    def begin(self, robot: RobotFacts) -> Memory:
        """Price level and bidder of each task, number of tasks so far, way to each [m], time without a new bid [s]."""
        size = max(robot.count, len(self.tasks) + len(self.later))
        none, zero = (-1.0,) * size, (0.0,) * size
        return {"level": zero, "bidder": none, "called": (-1.0,), "way": zero, "calm": (0.0,)}

    def step(self, view: View, memory: Memory) -> Control:
        """Receive bids, bid, and move on when bids are calm."""
        here, robot = view.position[:2], view.robot
        me = float(view.robot.number)
        places = self.called(view.time)
        called, size = (
            float(len(places)),
            max(robot.count, len(places)),
        )  # staying is a task, too, where robots are left
        if memory["called"][0] != called:
            ways = [dist(here, place) for place in places]
            memory = {**self.begin(robot), "way": (*ways, *(0.0,) * (len(memory["way"]) - len(ways)))}
        way = memory["way"]
        level, bidder = [*memory["level"]], [*memory["bidder"]]
        for each in view.known(*self.SAYS):
            if each.said["called"][0] == called:
                for k, bid in enumerate(zip(each.said["level"], each.said["bidder"], strict=True)):
                    level[k], bidder[k] = max(bid, (level[k], bidder[k]))
        profit = [-way[k] - self.epsilon * level[k] for k in range(size)]
        held = sorted((k for k in range(size) if bidder[k] == me), key=profit.__getitem__)
        if not held and not view.leads:
            best = max(range(size), key=profit.__getitem__)
            second = max((profit[k] for k in range(size) if k != best), default=profit[best])
            level[best] += 1.0 + floor((profit[best] - second) / self.epsilon)
            bidder[best] = me
            held = [best]
        for k in held[:-1]:  # a robot may hold, after a restart, what it bid for before
            level[k], bidder[k] = level[k] + 1.0, -1.0
        bids = {"level": tuple(level), "bidder": tuple(bidder)}
        calm = memory["calm"][0] + view.step_s if all(bids[name] == memory[name] for name in bids) else 0.0
        task = held[-1] if held and held[-1] < called else -1
        velocity = None
        if task >= 0 and calm >= self.calm_s:
            far = dist(here, places[task])
            rate = min(self.gain, self.speed / max(far, 1e-9))
            velocity = (rate * (places[task][0] - here[0]), rate * (places[task][1] - here[1]), nan)
        now = {**bids, "called": (called,), "way": way, "calm": (calm,)}
        return Control(memory=now, velocity=velocity, measures={"task": float(task), "calm": calm})

    def called(self, time: float) -> list[Place]:
        """Places of the tasks that have appeared at a time [s], in the order in which they appear."""
        return [*self.tasks, *((x, y) for x, y, at in sorted(self.later, key=_time) if at <= time)]

    def analyse(self, plan: Any) -> Iterator[tuple[Severity, str, str]]:  # noqa: ANN401 - plug-ins know no experiment
        """Rounds that bids may take, about D/ε times the longest way over D links, and the bound of the sum."""
        if plan.hops == inf:
            message = "bids do not reach every robot from every other: two may go to the same task"
            yield "error", message, "link all of them, both ways, directly or through others"
            return
        places, hops = self.called(inf), max(plan.hops, 1)
        most = max((dist((x, y), place) for _, x, y, _ in plan.starts for place in places), default=0.0)
        rounds = hops * ceil(most / self.epsilon)
        seconds, bound = rounds * plan.talk_period_s, len(plan.names) * self.epsilon
        message = (
            f"bids of {self.epsilon:g} m for ways of up to {most:.2g} m, {hops} links across: about {rounds} rounds "
            f"(D·max/ε), {seconds:.2g} s; the sum of ways is within {bound:.2g} m of the least"
        )
        left = plan.experiment.duration_s - max([0.0, *map(_time, self.later)]) - self.calm_s - most / self.speed
        if left <= 0.0:
            yield "warning", message, f"the ways take {most / self.speed:.2g} s more: let the run be longer"
        elif seconds > left:
            enough = 1.1 * most * hops * plan.talk_period_s / left
            remedy = f"let epsilon be {enough:.2g} or more, link robots more directly, or let the run be longer"
            yield "warning", message, remedy
        else:
            yield "note", message, ""


def _time(task: tuple[float, float, float]) -> float:
    return task[2]
