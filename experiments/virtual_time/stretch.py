"""Stretches of a run in which nothing happens to a robot, flown by compiled functions."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Final

import numba
from numba import njit

from experiments.virtual_time import company
from experiments.virtual_time.company import Ledger, Member
from experiments.virtual_time.compiler import compiled, opened
from experiments.virtual_time.records import Image, Items, Layouts

STEPS: Final = ("advance", "deliver", "observe", "transmit", "detect", "pursue", "note")
DRIVER: Final = """
def {name}({parameters}, at, rows, k, end, dt, log_every, instant):
    {open}
    ledger = open_ledger(at, rows)
    while k < end:
        t = k * dt
        {advance}
        {deliver}
        moves = False
        {observe}
        if moves:
            ledger.reason = AT_PHASES
            return k
        {transmit}
        if instant:
            {deliver}
        trouble = False
        {detect}
        if trouble:
            ledger.reason = AT_HAZARDS
            return k
        {pursue}
        if (g0[0].robot.tick - 1) % log_every == 0:
            {note}
            ledger.times[ledger.sample] = t
            ledger.sample += 1
        k += 1
    return k
"""


class Stretches:
    """Compiled tick of the robots of a flight."""

    def __init__(self, members: list[Member], ledger: Ledger) -> None:
        self._members, self._ledger, self._layouts = members, ledger, Layouts()

    def fly(self, k: int, end: int, dt: float, log_every: int, *, instant: bool) -> int:
        """Fly the ticks from `k` on to before `end`, of `dt` [s]; returns the tick at which the stretch ended.

        The ledger has the reason: of a tick that is half done the rest is left to the caller.
        """
        layouts, groups = self._layouts, dict[str, list[Member]]()
        layouts.forget()
        layouts.guessed = False
        for member in self._members:
            layouts.of(member)
        if layouts.guessed:  # the kinds of lists that are empty for some robots are known now
            layouts.forget()
        for member in self._members:
            groups.setdefault(str(layouts.of(member)), []).append(member)
        kinds = [Items(layouts.of(group[0])) for group in groups.values()]
        of_ledger = layouts.of(self._ledger)
        image = Image(layouts, [*zip(groups.values(), kinds, strict=True), (self._ledger, of_ledger)])
        numbers = [number for group in groups.values() for number in (image.address(group), len(group))]
        run = driver(tuple(kinds), of_ledger)
        k = run(*numbers, image.address(self._ledger), 1, k, end, dt, log_every, instant)
        image.load()
        return k


DRIVERS: Final[dict[Any, Any]] = {}


def driver(kinds: tuple[Items, ...], of_ledger: Any) -> Any:
    """Compiled loop over ticks, for groups of robots of these kinds."""
    key = kinds, of_ledger
    if key in DRIVERS:
        return DRIVERS[key]
    count = range(len(kinds))
    name = "fly_" + hashlib.sha256(f"{kinds} {of_ledger}".encode()).hexdigest()[:20]

    def each(text: str) -> str:
        return "; ".join(text.format(k=k) for k in count)

    source = DRIVER.format(
        name=name,
        parameters=", ".join(f"a{k}, n{k}" for k in count),
        open=each("g{k} = open{k}(a{k}, n{k})"),
        advance=each("advance(g{k}, t, dt)"),
        deliver=each("deliver(g{k}, t)"),
        observe=each("moves = observe(g{k}, t) or moves"),
        transmit=each("transmit(g{k}, t, ledger)"),
        detect=each("trouble = detect(g{k}, t) or trouble"),
        pursue=each("pursue(g{k}, t)"),
        note=each("note(g{k}, ledger)"),
    )
    space: dict[str, Any] = {"__name__": __name__}
    space |= {step: compiled(getattr(company, step)) for step in STEPS}
    space |= {f"open{k}": opened(kind) for k, kind in enumerate(kinds)}
    space |= {"AT_PHASES": company.AT_PHASES, "AT_HAZARDS": company.AT_HAZARDS}
    space["open_ledger"] = opened(of_ledger)
    exec(compile(source, __file__, "exec"), space)  # noqa: S102 - our own source
    made = DRIVERS[key] = njit(space[name], cache=True, nogil=True)
    return made
