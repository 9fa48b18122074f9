"""Rare parts of compiled ticks, called back in Python: steps of laws outside of the subset.

There all that a law may use is at hand. What it reads and writes is copied from the records, and to them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from agents.decision.goals import GoalComputer
from agents.decision.stepping import Words
from agents.plugins.law import is_known
from experiments.virtual_time.company import Ledger, Member
from experiments.virtual_time.records import MEASURES, Image
from twins.arrays import Array

CALL: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))


class Steps:
    """Laws of all robots in stretches."""

    def __init__(self, members: Sequence[Member]) -> None:
        self._members = members
        self._laws = [(each.row, law) for each in members if (law := each.robot.stepping) is not None]
        self.measures = list[str]()  # names of measures
        self.error: BaseException | None = None  # error of a law, or interruption
        self._begun: Any = None  # words of the records at the beginning
        self.call = CALL(self._call)
        self.address = ctypes.cast(self.call, ctypes.c_void_p).value or 0

    def board(self, image: Image) -> None:
        """Find the records of a stretch; what is called back can be undone."""
        self._image, self.error = image, None
        self._begun = None
        rare = [each.robot.goals for each in self._members if each.robot.stepping or each.robot.goals.changes_shape]
        self._rare = {image.address(each): each for each in rare}
        if rare:
            self._begun = image.words.copy()
            self._places = {id(thing): (thing, layout, at) for thing, layout, at in image.changing}

    def _call(self, address: int, which: int, given: Any) -> int:  # noqa: ANN401 - an array of C
        """A rare function of the goals of a robot; returns 1 after an error."""
        try:
            goals = self._rare[address]
            records = [self._places[id(each)] for each in goals.rare_parts() if id(each) in self._places]
            for thing, layout, at in records:
                layout.load(thing, self._image, at)
            if GoalComputer.RARE[which] == "reshape":
                elapsed, x, y, z, t = given[:5]
                goals.reshape(elapsed, (x, y, z), t)
            else:
                t, x, y, z, vx, vy, vz, yaw, start = given[:9]
                goals.step(t, (x, y, z), (vx, vy, vz), yaw, start)
            for thing, layout, at in records:
                layout.store(self._image, thing, at)
        except BaseException as error:  # noqa: BLE001 - C cannot pass it on: the stretch is flown again in Python
            self.error = error
            return 1
        return 0

    def undo(self) -> None:
        """Take all that was called back in a stretch back, and what was read from the records for it."""
        if self._begun is not None:
            self._image.words[:] = self._begun
            self._image.load()

    def columns(self, ledger: Ledger) -> tuple[dict[str, Array], dict[str, Array]]:
        """Memory (K, N, k) and measures (K, N) of all robots at the samples of a stretch, by name."""
        if not self._laws:
            return {}, {}
        wide, rows = ledger.memory + 1 + MEASURES, len(self._members)
        table = np.frombuffer(ledger.laws)[: ledger.sample * rows * wide].reshape(-1, rows, wide)
        measured = table[:, :, ledger.memory].astype(np.intp)
        measures, memory = dict[str, Array](), dict[str, Array]()
        for k, name in enumerate(self.measures):
            there = (measured >> k & 1).astype(bool)
            if there.any():
                measures[name] = np.where(there, table[:, :, ledger.memory + 1 + k], np.nan)
        for row, law in self._laws if ledger.memory else ():
            begin = 0
            for name, values in sorted(law.memory.items()):
                blank = np.full((ledger.sample, rows, len(values)), np.nan)
                memory.setdefault(name, blank)[:, row] = table[:, row, begin : begin + len(values)]
                begin += len(values)
        return memory, measures


def words_of(says: Mapping[str, int], values: Sequence[float]) -> Words:
    """Variables of these sizes from all their numbers, those that are known."""
    found, begin = list[tuple[str, tuple[float, ...]]](), 0
    for name, size in says.items():
        part = tuple(values[begin : begin + size])
        if is_known(part):
            found.append((name, part))
        begin += size
    return tuple(found)
