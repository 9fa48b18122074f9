"""Rare parts of compiled ticks, called back in Python: steps of laws outside of the subset, range readings, engines.

There all that Python may use is at hand. What it reads and writes is copied from the records, and to them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from agents.decision.goals import GoalComputer
from agents.decision.stepping import Words
from agents.plugins.law import is_known
from experiments.virtual_time.records import MEASURES, Image
from experiments.virtual_time.tick import Display, Ledger, Member, Stage
from twins.arrays import Array
from twins.body import TwinBody
from twins.engines.engine import Touch

CALL: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))


class Rare(NamedTuple):
    """Rare functions of one object."""

    call: Callable[[int, Any], object]  # given the index of the function, and its numbers
    reads: Sequence[object]  # objects, of which the records are read before
    writes: Sequence[object]  # likewise, records that are written behind


class Steps:
    """Calls back of all robots in stretches."""

    def __init__(self, members: Sequence[Member], twin: TwinBody, touches: list[Touch], window: Display | None) -> None:
        """`touches`: contacts of the run, to which those in stretches are added."""
        self._members, self._twin, self._touches = members, twin, touches
        self.window = window
        self.stage = Stage(len(members)) if twin.together else None
        self.obstacles: dict[float, list[tuple[float, ...]]] = {}  # poses of a world's obstacles at each time [s]
        self._laws = [(each.row, law) for each in members if (law := each.robot.stepping) is not None]
        self.measures = list[str]()  # names of measures
        self.error: BaseException | None = None  # error of a law, or interruption
        self.call = CALL(self._call)
        self.address = ctypes.cast(self.call, ctypes.c_void_p).value or 0

    def board(self, image: Image, t: float) -> None:
        """Find the records of a stretch that begins at `t` [s]."""
        self._image, self.error = image, None
        self._rare = {image.address(thing): rare for thing, rare in self._rare_parts()}
        self.obstacles = {t: [tuple(each) for each in self._twin.engine.obstacles]}

    def _rare_parts(self) -> Iterator[tuple[object, Rare]]:
        """Objects of which something is called back."""
        for member in self._members:
            robot, goals = member.robot, member.robot.goals
            if robot.stepping is not None or goals.changes_shape:
                parts = [goals, *goals.rare_parts()]
                yield goals, Rare(partial(_step, goals), parts, parts)
        if self.stage is not None:
            engine = self._twin.engine
            of_python = () if engine.carriers else engine.motions
            yield self.stage, Rare(self._advance, engine.watched or of_python, of_python)
        if self.window is not None:
            yield self.window, Rare(lambda *_: None, (), ())  # a run fills it itself then

    def _call(self, address: int, which: int, given: Any) -> int:  # noqa: ANN401 - an array of C
        """A rare function of an object; returns 1 after an error."""
        try:
            self._within(self._rare[address], which, given)
        except BaseException as error:  # noqa: BLE001 - C cannot pass it on: the stretch is flown again in Python
            self.error = error
            return 1
        return 0

    def _within(self, rare: Rare, which: int, given: Any) -> None:  # noqa: ANN401 - an array of C
        """Call a rare function between reading and writing records."""
        self._image.read(rare.reads)
        rare.call(which, given)
        self._image.write(rare.writes)

    def _advance(self, _: int, given: Any) -> None:  # noqa: ANN401 - an array of C
        """The engine moves all robots on; their sensors see."""
        t, twin = given[0], self._twin
        engine = twin.engine
        update = partial(self._image.read, [*engine.carriers, *engine.motions]) if engine.carriers else None
        scanned = twin.move(t, update)
        self._touches += twin.touches()
        if engine.obstacles:
            self.obstacles[t] = [tuple(each) for each in engine.obstacles]
        for robot in [member.robot for member in self._members] if scanned else ():
            if parts := robot.rare_parts():
                self._within(Rare(lambda *_, robot=robot: robot.notice(), parts, parts), 0, None)

    def columns(self, ledger: Ledger) -> tuple[dict[str, Array], dict[str, Array]]:
        """Memory (K, N, k) and measures (K, N) of all robots at the samples of a stretch, by name."""
        if not self._laws:
            return {}, {}
        wide, rows = ledger.memory + 1 + MEASURES, len(self._members)
        table = np.frombuffer(ledger.laws)[: ledger.sample * rows * wide].reshape(-1, rows, wide)
        measured = table[:, :, ledger.memory].astype(np.intp)
        measures, memory = dict[str, Array](), dict[str, Array]()
        for k, name in enumerate(self.measures):
            arrived = (measured >> k & 1).astype(bool)
            if arrived.any():
                measures[name] = np.where(arrived, table[:, :, ledger.memory + 1 + k], np.nan)
        for row, law in self._laws if ledger.memory else ():
            begin = 0
            for name, values in sorted(law.memory.items()):
                blank = np.full((ledger.sample, rows, len(values)), np.nan)
                memory.setdefault(name, blank)[:, row] = table[:, row, begin : begin + len(values)]
                begin += len(values)
        return memory, measures


def _step(goals: GoalComputer, which: int, given: Any) -> None:  # noqa: ANN401 - an array of C
    """A rare function of the goals of a robot."""
    if GoalComputer.RARE[which] == "reshape":
        elapsed, x, y, z, t = given[:5]
        goals.reshape(elapsed, (x, y, z), t)
    else:
        t, x, y, z, vx, vy, vz, yaw, start = given[:9]
        goals.step(t, (x, y, z), (vx, vy, vz), yaw, start)


def words_of(says: Mapping[str, int], values: Sequence[float]) -> Words:
    """Variables of these sizes from all their numbers, those that are known."""
    found, begin = list[tuple[str, tuple[float, ...]]](), 0
    for name, size in says.items():
        part = tuple(values[begin : begin + size])
        if is_known(part):
            found.append((name, part))
        begin += size
    return tuple(found)
