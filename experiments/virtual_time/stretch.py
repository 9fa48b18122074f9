"""Stretches of a run in which nothing happens to a robot, flown by compiled functions.

What is compiled is kept in the user's cache folder: the first time takes 5 to 15 s, later ones a fraction of a second.
It is used where it pays.
"""

from __future__ import annotations

import fcntl
import gc
import hashlib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from inspect import isfunction
from pathlib import Path
from time import time
from typing import Any, Final, Protocol

import msgspec
import numpy as np

from agents.decision.lifecycle import READY
from agents.plugins.planners import NO_TARGET, Itinerary
from agents.robot import Robot
from agents.user_folder import cache_folder
from experiments.definition.plan import Plan
from experiments.recording.version import digest, file_digest
from experiments.virtual_time import company
from experiments.virtual_time.company import AT_END, Ledger, Member, Planned, Way
from experiments.virtual_time.network import VirtualNetwork
from experiments.virtual_time.records import BOOL, FLOAT, INT, Image, Items, Layouts, RecordLayout
from experiments.virtual_time.source import OURS
from twins.body import TwinBody

TICK_S: Final = 15e-6  # of CPU for a tick of a robot in plain Python: 10 to 20 µs
PAYS_S: Final = 1.0  # for less work in a process plain Python is quicker than to load numba and a loop (0.6 s),
COMPILES_S: Final = 10.0  # or to compile, which is kept
LONGEST: Final = 10_000  # ticks of a stretch,
ROBOT_TICKS: Final = 1_000_000  # and of all robots in it: noise is drawn, and room kept, for all of them beforehand
LEAST: Final = 20  # after a stretch of fewer ticks
PAUSE: Final = 10  # ticks that are flown in plain Python, twice as many after the next one,
LONGEST_PAUSE: Final = 160  # at most
ROOM: Final = 2  # more samples on a link than its delay asks for
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
WORK: Final = [0.0]  # seconds of plain Python that the flights of this process take, about, and those that will follow
COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")  # of a compiler's messages
REFUSED: Final[dict[str, str]] = {}  # by driver, why it cannot be compiled
DRIVERS: Final[dict[tuple[Any, ...], Any]] = {}  # compiled loops of this process; None: it cannot be compiled
RECENT: Final[dict[bytes, Prepared]] = {}  # of cases that this process has flown; a few
MAX_RECENT: Final = 8  # of those
STEADY: Final = frozenset({"numpy", "msgspec"})  # of others, but no plug-ins


class Flown(Protocol):
    """A run in virtual time, as stretches take it over and leave it."""

    plan: Plan
    robots: list[Robot]
    twin: TwinBody
    network: VirtualNetwork
    dt: float  # of a tick [s]
    log_every: int  # ticks from one sample to the next
    lean: bool  # of samples true positions alone
    lonely: bool  # each robot moves by itself, and the network does nothing but take its time

    def note(self, ledger: Ledger) -> None:
        """Note the samples of a stretch."""
        ...


def stretches_of(flight: Flown) -> Stretches | None:
    """Compiled stretches of a flight, where they are possible and pay; else None: then it is flown as it is."""
    WORK[0] += plain_s(flight.plan)
    return None if WORK[0] < PAYS_S or not possible(flight) else Stretches(flight)


def plain_s(plan: Plan) -> float:
    """About the seconds that a flight takes in plain Python."""
    experiment = plan.experiment
    return TICK_S * experiment.duration_s * experiment.rates.body_hz * len(experiment.robots)


def expect(seconds: float) -> None:
    """Announce flights: seconds of plain Python in this process and in those that share its compiled loops."""
    WORK[0] = max(WORK[0], seconds)


def possible(flight: Flown) -> bool:
    """Whether the robots of a flight can be flown by compiled functions, unless their compiler refuses a plug-in."""
    if not flight.lonely or find_spec("numba") is None:
        return False
    if any(robot.goals.changes_shape or robot.guidance is not None for robot in flight.robots):
        return False
    if flight.robots[0].stepping is None:
        return True
    law = flight.robots[0].assignment.law
    REFUSED[type(law).__name__] = f"the law {type(law).__name__} remembers, in tables that are not compiled"
    return False


@dataclass
class Prepared:
    """Stored layout of the robots of a case, and their compiled loop."""

    rows: list[list[int]]  # of robots of the same layout
    kinds: tuple[Items, ...]  # of each of those
    of_ledger: RecordLayout
    run: Any
    words: int = 1 << 12  # that all objects take, at most, so far


class Stretches:
    """Compiled ticks of the robots of a flight."""

    flown: int  # ticks so far

    def __init__(self, flight: Flown) -> None:
        self._flight, self._case = flight, msgspec.json.encode(flight.plan.experiment)
        twins = flight.twin.twins
        self._members = [Member(row, *each) for row, each in enumerate(zip(flight.robots, twins, strict=True))]
        network, rates = flight.network, flight.plan.experiment.rates
        self._ways: list[Way] = []
        for (robot, k), delay in zip(network.receivers, network.delays, strict=True):
            sender = robot.neighbours.all[k]
            way = Way(sender, delay, ROOM + round(delay * rates.pose_hz))
            self._members[sender.sender].ways.append(way)
            self._ways.append(way)
        self._plans: dict[int, Planned] = {}
        self._paused_until, self._pause, self._refused, self._misfit, self.flown = 0, PAUSE, False, "", 0

    def fly(self, k: int, end: int) -> tuple[int, int]:
        """Fly the ticks from `k` on to before `end`; returns the tick at which the stretch ended, and why.

        Of a tick that is half done the rest is left to the caller, see `Ledger.reason`.
        """
        flight = self._flight
        longest = max(min(LONGEST, ROBOT_TICKS // len(flight.robots)), LEAST)
        end = min(end, k + longest, self._next_leg())
        if self._refused or k < max(self._paused_until, 1) or end - k < LEAST:  # the first tick moves nothing
            return k, AT_END
        if not all(_goes_on(robot, k * flight.dt) for robot in flight.robots):
            return k, AT_END
        ticks, rows, rates = end - k, len(self._members), flight.plan.experiment.rates
        questions = ticks // round(rates.body_hz / rates.pose_hz) + ROOM
        ledger = Ledger(rows, questions * rows, ticks // flight.log_every + ROOM, lean=flight.lean)
        for member in self._members:
            member.seq = flight.network.seq[member.row]
            member.twin.reserve(ticks)
        before = flight.network.board(self._ways)
        with self._planned(k, end):
            last = self._run(ledger, k, end)
        if last < 0:
            self._paused_until = k + LONGEST
            flight.network.leave(self._ways, self._members, ledger, before, -np.inf)
            return k, AT_END
        if last - k < LEAST:
            self._paused_until, self._pause = last + self._pause, min(2 * self._pause, LONGEST_PAUSE)
        else:
            self._pause = PAUSE
        self.flown += last - k
        done = last - 1 if ledger.reason == AT_END else last
        flight.network.leave(self._ways, self._members, ledger, before, done * flight.dt)
        flight.note(ledger)
        flight.twin.moved_to(done * flight.dt)
        return last, ledger.reason

    def _run(self, ledger: Ledger, k: int, end: int) -> int:
        """Run the compiled loop; returns the tick at which it ended, −1 without one."""
        flight = self._flight
        try:
            prepared = RECENT.get(self._case)
            image = None if prepared is None else self._image(prepared, ledger)
            if prepared is None or image is None:
                prepared = self._prepared(ledger)
                if prepared is None:
                    return -1
                image = self._image(prepared, ledger)
        except LookupError:
            self._refused = True
            return -1
        if image is None:
            REFUSED[str(prepared.of_ledger)], self._refused = self._misfit, True
            return -1
        instant = flight.network.instant
        try:
            found = prepared.run(*image.places, k, end, flight.dt, flight.log_every, instant)
        except (ArithmeticError, LookupError, ValueError):  # of a plug-in: flown plain, the error tells where
            self._refused = True
            return -1
        image.load()
        return int(found)

    def _image(self, prepared: Prepared, ledger: Ledger) -> Image | None:
        """All objects in memory, None if they are not of these layouts."""
        groups = [[self._members[row] for row in rows] for rows in prepared.rows]
        try:
            image = Image([*zip(groups, prepared.kinds, strict=True), (ledger, prepared.of_ledger)], prepared.words)
        except TypeError as error:
            self._misfit = str(error)
            return None
        prepared.words = max(prepared.words, image.used)
        return image

    def _prepared(self, ledger: Ledger) -> Prepared | None:
        """Layouts and compiled loop of these robots, None as long as that does not pay; raises LookupError if never."""
        layouts, groups = Layouts(), dict[str, list[int]]()
        for member in self._members:
            layouts.of(member)
        if layouts.guessed:  # the kinds of lists that are empty for some robots are known now
            layouts.forget()
        for member in self._members:
            groups.setdefault(str(layouts.of(member)), []).append(member.row)
        kinds = tuple(Items(layouts.of(self._members[rows[0]])) for rows in groups.values())
        of_ledger = Layouts().of(ledger)
        assert of_ledger is not None
        run = driver(kinds, of_ledger)
        if run is None:
            return None
        while len(RECENT) >= MAX_RECENT:
            del RECENT[next(iter(RECENT))]
        RECENT[self._case] = made = Prepared([*groups.values()], kinds, of_ledger, run)
        return made

    def _next_leg(self) -> int:
        """Tick on which the next leg of a plan begins, or a later one; those of a decision around it are plain."""
        flight, first = self._flight, sys.maxsize
        for robot in flight.robots:
            itinerary, begin = robot.goals.itinerary, robot.lifecycle.start_at
            if itinerary is not None and robot.begun and itinerary.next_at < np.inf:
                first = min(first, int((begin + itinerary.next_at) / flight.dt) - 1)
        return first

    @contextmanager
    def _planned(self, k: int, end: int) -> Iterator[None]:
        """Plans of the robots, computed for all decisions of a stretch, in place of their itineraries."""
        flight, kept = self._flight, dict[int, Itinerary]()
        for row, robot in enumerate(flight.robots):
            itinerary = robot.goals.itinerary
            if itinerary is None:
                continue
            kept[row] = itinerary
            every, begin = robot.assignment.decide_every, robot.lifecycle.start_at
            hz, first = robot.assignment.body_hz / every, robot.tick // every
            place, targets = (np.nan, np.nan, np.nan), []
            for number in range(first, first + (end - k) // every + 2):
                t = (k + number * every - robot.tick) * flight.dt
                targets.append(itinerary.target(t - begin, place, np.nan) if robot.begun else NO_TARGET)
            planned = self._plans.setdefault(row, Planned(hz))
            planned.first, planned.targets = first, targets
            robot.goals.itinerary = planned  # type: ignore[assignment]
        try:
            yield
        finally:
            for row, itinerary in kept.items():
                flight.robots[row].goals.itinerary = itinerary


def _goes_on(robot: Robot, t: float) -> bool:
    """Whether the phase of a robot probably does not move on at `t` [s]: by its last state."""
    return (robot.lifecycle.phase > READY or robot.lifecycle.climbing) and robot.is_steady(t)


def driver(kinds: tuple[Items, ...], of_ledger: RecordLayout) -> Any:
    """Compiled loop over ticks for groups of robots of these kinds; None without one, and as long as it does not pay.

    Raises LookupError if there will be none.
    """
    key = (*kinds, of_ledger)
    if key not in DRIVERS:
        owners = {layout.owner for layout in _layouts(key)}
        text = f"{kinds} {of_ledger} {code_of(owners)} {digest()}"
        name, folder = "fly_" + hashlib.sha256(text.encode()).hexdigest()[:24], cache_folder() / "compiled"
        known = any(folder.glob(f"*/*{name}*.nbi"))
        if not known and WORK[0] < COMPILES_S:
            return None
        with _alone(folder, name) as alone:
            if not (known or alone):  # another process makes it
                return None
            DRIVERS[key] = _compiled(name, kinds, of_ledger, folder)
    if DRIVERS[key] is None:
        raise LookupError
    return DRIVERS[key]


def code_of(owners: Iterable[type]) -> str:
    """Digest of the modules of plug-ins of others, with functions and numbers that they have from elsewhere."""
    waiting, known, total = {base.__module__ for owner in owners for base in owner.__mro__}, set[str](), []
    while waiting:
        name = waiting.pop()
        top = name.partition(".")[0]
        if name in known or top in OURS or top in STEADY or top in sys.stdlib_module_names:
            continue
        known.add(name)
        module = sys.modules[name]
        file = getattr(module, "__file__", None)
        values = vars(module)
        numbers = {key: each for key, each in values.items() if isinstance(each, int | float | tuple)}
        total.append(f"{name} {file_digest(Path(file)) if file else time()} {numbers}")  # of a notebook: never the same
        waiting |= {str(each.__module__) for each in values.values() if isfunction(each)}
    return " ".join(sorted(total))


def _compiled(name: str, kinds: Sequence[Items], of_ledger: RecordLayout, folder: Path) -> Any:
    """Loop of that name, from the cache folder or new; None if it cannot be had, and then `REFUSED` says why."""
    gc.disable()  # a compiler leaves much behind at once, and hardly any circles: a fifteenth of its time
    try:
        return _loop(name, kinds, of_ledger, folder)
    except Exception as error:  # noqa: BLE001 - of a compiler, its cache and plug-ins: the run is flown without them
        REFUSED[name] = COLOUR.sub("", f"{type(error).__name__}: {error}")
        return None
    finally:
        gc.enable()


def _loop(name: str, kinds: Sequence[Items], of_ledger: RecordLayout, folder: Path) -> Any:
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise OSError(f"nothing can be kept in {folder}")
    from experiments.virtual_time.compiler import compiled, kept, opened  # noqa: PLC0415 - half a second, and a level

    count = range(len(kinds))

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
    space: dict[str, Any] = {"__name__": __name__, "AT_PHASES": company.AT_PHASES, "AT_HAZARDS": company.AT_HAZARDS}
    space |= {step: compiled(getattr(company, step)) for step in STEPS}
    space |= {f"open{k}": opened(kind) for k, kind in enumerate(kinds)}
    space["open_ledger"] = opened(of_ledger)
    exec(compile(source, __file__, "exec"), space)
    return kept(space[name], (*(INT,) * (2 * len(kinds) + 4), FLOAT, INT, BOOL), folder)


def _layouts(kinds: Sequence[Any]) -> Iterator[RecordLayout]:
    """All layouts that these kinds lead to."""
    for kind in kinds:
        if isinstance(kind, Items):
            yield from _layouts([kind.item])
        elif isinstance(kind, RecordLayout):
            yield kind
            yield from _layouts(list(kind.fields.values()))


@contextmanager
def _alone(folder: Path, name: str) -> Iterator[bool]:
    """Whether no other process compiles this loop now; none does as long as this lasts."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        file = (folder / f"{name}.lock").open("w")
    except OSError:  # nothing can be kept there
        yield True
        return
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True
