"""Rare parts of compiled ticks, called back in Python: steps of laws that remember, and changes of the formation.

There all that a law may use is at hand. What it reads and writes is copied from the records, and to them.
"""

from __future__ import annotations

import ctypes
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from math import inf
from operator import attrgetter
from typing import Any, Final, NamedTuple

from agents.decision.goals import GoalComputer
from agents.decision.neighbours import NO_WORDS, Neighbour
from agents.decision.stepping import Stepping, Words
from agents.plugins.law import Memory
from agents.robot import Robot
from experiments.virtual_time.records import Image

CALL: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))


class Step(NamedTuple):
    """Result of a step: memory and measures of a robot, and the variables that it says from then on."""

    time: float  # [s]
    memory: Memory
    measures: Mapping[str, float]
    words: Words


class Steps:
    """Steps of the laws of all robots in a stretch."""

    def __init__(self, robots: Sequence[Robot]) -> None:
        self._robots = robots
        self._rows = [row for row, robot in enumerate(robots) if robot.stepping is not None]
        self._speak = any(robot.stepping is not None and robot.stepping.speech is not None for robot in robots)
        self._done: list[list[Step]] = [[] for _ in robots]
        self._under_way: Mapping[tuple[int, float], Words] = {}  # words by sender and stamp of what was sent before
        self.error: BaseException | None = None  # error of a law, or interruption
        self.call = CALL(self._call)
        self.address = ctypes.cast(self.call, ctypes.c_void_p).value or 0

    def begin(self, under_way: Mapping[tuple[int, float], Words]) -> None:
        """Begin a stretch; `under_way` are the words of the samples that are on their way."""
        self._under_way, self.error = under_way, None
        senders = [each for robot in self._robots for each in robot.neighbours.all]
        self._stamps = {id(each): each.stamp for each in senders}
        self._said = {id(each): each.said for each in senders}
        for row, robot in enumerate(self._robots):
            law = robot.stepping
            self._done[row] = [Step(-inf, {}, {}, ()) if law is None else _step_of(law, -inf)]

    def board(self, image: Image) -> None:
        """Find the records of a stretch; what steps change can be taken back."""
        laws = [law for robot in self._robots if (law := robot.stepping) is not None]
        self._kept = [(each, each.__dict__.copy()) for law in laws for each in (law, law.speech) if each is not None]
        self._rare = {
            image.address(robot.goals): row
            for row, robot in enumerate(self._robots)
            if robot.stepping is not None or robot.goals.changes_shape
        }
        if not self._rare:
            return
        self._image, self._begun = image, image.words.copy()
        places = {id(thing): (thing, layout, at) for thing, layout, at in image.changing}
        self._records = [[places[id(each)] for each in robot.goals.rare_parts()] for robot in self._robots]

    def _call(self, address: int, which: int, given: Any) -> int:  # noqa: ANN401 - an array of C
        """A rare function of the goals of a robot; returns 1 after an error."""
        try:
            row = self._rare[address]
            robot, records = self._robots[row], self._records[row]
            for thing, layout, at in records:
                layout.load(thing, self._image.memory, at)
            if GoalComputer.RARE[which] == "step":
                self._step(row, robot, given[:9])
            else:
                elapsed, x, y, z, t = given[:5]
                robot.goals.reshape(elapsed, (x, y, z), t)
            for thing, layout, at in records:
                layout.store(self._image, thing, at)
        except BaseException as error:  # noqa: BLE001 - C cannot pass it on: the stretch is flown again in Python
            self.error = error
            return 1
        return 0

    def _step(self, row: int, robot: Robot, given: Sequence[float]) -> None:
        law = robot.stepping
        assert law is not None
        for sender in robot.neighbours.all:
            self._hear(sender)
        t, x, y, z, vx, vy, vz, yaw, start = given
        robot.goals.step(t, (x, y, z), (vx, vy, vz), yaw, start)
        self._done[row].append(_step_of(law, t))

    def _hear(self, sender: Neighbour) -> None:
        """Words of the last pose of a sender."""
        if self._speak and sender.stamp != self._stamps[id(sender)]:
            self._stamps[id(sender)] = sender.stamp
            words = self.words(sender.sender, sender.stamp)
            sender.said = dict(words) if words else NO_WORDS

    def words(self, row: int, stamp: float) -> Words:
        """Words of the sample that a robot sent at a time [s]."""
        if (known := self._under_way.get((row, stamp))) is not None:
            return known
        return self._at(row, stamp).words

    def _at(self, row: int, t: float) -> Step:
        done = self._done[row]
        return done[bisect_right(done, t, key=attrgetter("time")) - 1]

    def end(self) -> None:
        """The robots have all words of a stretch."""
        for robot in self._robots:
            for sender in robot.neighbours.all:
                self._hear(sender)

    def undo(self) -> None:
        """Take all steps of a stretch back, and what was read from the records for them."""
        for thing, before in self._kept:
            thing.__dict__.clear()
            thing.__dict__.update(before)
        if self._rare:
            self._image.words[:] = self._begun
            self._image.load()
            for robot in self._robots:
                for sender in robot.neighbours.all:
                    sender.said = self._said[id(sender)]

    def remembered(self, times: Sequence[float]) -> Iterator[tuple[list[Memory], list[Mapping[str, float]]]]:
        """Memory and measures of all robots at each of these times [s]."""
        for t in times if self._rows else ():
            steps = [self._at(row, t) for row in range(len(self._robots))]
            yield [each.memory for each in steps], [each.measures for each in steps]


def _step_of(law: Stepping, t: float) -> Step:
    return Step(t, law.memory, law.measures, () if law.speech is None else law.speech.fresh)
