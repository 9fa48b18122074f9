"""Stretches of a run in which nothing happens to a robot, flown by functions that are compiled where it pays.

A stretch begins and ends between the two halves of a tick. While it lasts, its robots live in records. Orders of the
conductor, take-offs and the common start are of a few objects, which are read and written again.
"""

from __future__ import annotations

import ctypes
import sys
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, cast

import msgspec
import numpy as np

from agents.decision.lifecycle import AIRBORNE, DONE, RUNNING
from agents.plugins.planners import Itinerary
from agents.robot import Robot
from agents.vectors import UNKNOWN
from experiments.definition.plan import Plan
from experiments.virtual_time import machine, tick
from experiments.virtual_time.network import Arrived, VirtualNetwork
from experiments.virtual_time.records import Image, Layouts, RecordLayout
from experiments.virtual_time.steps import Steps
from experiments.virtual_time.tick import Crew, Display, Ledger, LinkQueue, Member, PlannedTargets
from experiments.virtual_time.translator.kinds import BOOLEAN, DOUBLE, WHOLE, OutsideError
from experiments.virtual_time.translator.translation import Program
from twins.arrays import Index
from twins.body import TwinBody
from twins.engines.engine import Touch

TICK_S: Final = 15e-6  # [s] CPU time of a tick of a robot in plain Python: 10 to 20 µs
AVOIDING_S: Final = 100e-6  # [s] likewise, with an avoidance that looks at many
PAYS_S: Final = 0.3  # [s] work below which plain Python is quicker than to translate and compile
OFTEN_S: Final = 15.0  # [s] following work for which a second of `cc` pays, about; its program is kept
LONGEST: Final = 10_000  # ticks of a stretch
ROBOT_TICKS: Final = 1_000_000  # ticks of all its robots: noise is drawn, and room kept, for all of them beforehand
LEAST: Final = 20  # ticks below which a stretch is followed by a pause
PAUSE: Final = 40  # ticks that are flown in plain Python then
AHEAD_S: Final = 5.0  # [s] most that a run takes from its begin to the common start, and to land, about
ROOM: Final = 2  # more samples on a link than its delay asks for
LATE, LATEST_S = 40.0, 60.0  # room for jitter: times its mean, of which one in 10¹⁷ is more, and [s]
DRIVER: Final = """
def stretch(crew, k, end, leg, dt, log_every, instant):
    ledger = crew.ledger
    t = k * dt
    while ledger.moves or k < end:
        if not ledger.moves:
            {pursue}
            if (crew.g0[0].robot.tick - 1) % log_every == 0:
                {note}
                ledger.times[ledger.sample] = t
                ledger.sample += 1
            k += 1
            t = k * dt
            if crew.stage is None:
                {advance}
            else:
                {begin_step}
                crew.stage.advance(t)
                {end_step}
            {deliver}
            moves = False
            {observe}
            if moves or k == leg:
                ledger.moves = True
                return k
        ledger.moves = False
        {transmit}
        if instant:
            {deliver}
        trouble = False
        {detect}
        if trouble:
            ledger.ended = True
            return k
    if crew.window is not None:
        {place}
        {show}
    return k
"""
PARTS: Final = {  # parts of the driver, of each group of robots
    "advance": "advance({}, t, dt)", "begin_step": "begin_step({})", "end_step": "end_step({}, t, dt)",
    "deliver": "deliver({}, t)", "observe": "moves = observe({}, t) or moves", "transmit": "transmit({}, t, ledger)",
    "detect": "trouble = detect({}, t) or trouble", "pursue": "pursue({}, t)", "note": "note({}, ledger)",
    "place": "place({}, crew.window)", "show": "show({}, crew.window, t)",
}  # fmt: skip
TYPES: Final[dict[str, Any]] = {WHOLE: ctypes.c_int64, DOUBLE: ctypes.c_double, BOOLEAN: ctypes.c_bool}
GIVEN: Final = (WHOLE, WHOLE, WHOLE, DOUBLE, WHOLE, BOOLEAN)  # arguments of the driver behind the crew
WORK: Final = [0.0, 0.0]  # seconds of plain Python that flights of this process take, about, and that were announced
REFUSED: Final[dict[str, str]] = {}  # reason by law or crew why it cannot be compiled
DRIVERS: Final[dict[RecordLayout, CompiledLoop]] = {}  # drivers of this process
RECENT: Final[dict[bytes, Prepared]] = {}  # cases that this process has flown; a few
MAX_RECENT: Final = 8  # number of those
TOGETHER: Final = 4  # most functions of a program that Python calls


class Flown(Protocol):
    """A run in virtual time, as stretches take it over and leave it."""

    plan: Plan
    robots: list[Robot]
    twin: TwinBody
    network: VirtualNetwork
    dt: float  # length of a tick [s]
    log_every: int  # ticks from one sample to the next
    lean: bool  # True for samples of true positions alone
    compiles: bool  # bodies and network need nothing outside of the subset but the engine of a world
    touches: list[Touch]
    window: Display | None  # window of a learner

    @property
    def start_at(self) -> float:
        """Common start [s], NaN before it is known."""
        ...

    def note(self, ledger: Ledger, steps: Steps) -> None:
        """Note the samples of a stretch."""
        ...


def stretches_of(flight: Flown, last: int = RUNNING) -> Stretches | None:
    """Compiled stretches of a flight, where they are possible and pay; else None: then it is flown as it is."""
    WORK[0] += plain_s(flight.plan)
    return None if WORK[0] < PAYS_S or not possible(flight) else Stretches(flight, last)


def plain_s(plan: Plan) -> float:
    """About the seconds that a flight takes in plain Python."""
    experiment = plan.experiment
    tick_s = TICK_S if plan.avoidance is None else AVOIDING_S
    return tick_s * experiment.duration_s * experiment.rates.body_hz * len(experiment.robots)


def expect(seconds: float) -> None:
    """Announce flights of a case, some of them in this process: seconds of plain Python."""
    WORK[:] = max(WORK[0], seconds), seconds


def possible(flight: Flown) -> bool:
    """Whether the robots of a flight can be flown by compiled functions, unless a plug-in is outside of the subset."""
    stepping = [robot.stepping for robot in flight.robots if robot.stepping is not None]
    fits = all(each.says == flight.network.says and all(each.memory.values()) for each in stepping)
    scans = bool(stepping) and flight.twin.together  # laws may read scans
    guided = any(robot.guidance is not None for robot in flight.robots)
    return flight.compiles and fits and not (scans or guided) and machine.works()


class TornError(Exception):
    """A stretch that failed in a world, which cannot be taken back: the run must begin again, in Python."""


@dataclass
class CompiledLoop:
    """Compiled loop over ticks for a crew, or why there is none."""

    program: Program
    name: str = "fly"  # its function in the program
    text: str = ""  # program in C
    often: bool = False  # compiled for speed
    run: Any = None
    refusal: str = ""

    def translate(self, source: str, types: Sequence[Any]) -> None:
        """Translate it, with others that are not yet compiled for speed: what they share is compiled once."""
        loops = [each for each in DRIVERS.values() if each.text and each.program.names == self.program.names]
        for other in dict.fromkeys(each.program for each in loops):
            together = [each for each in loops if each.program is other]
            full = len(other.entries) == TOGETHER or any(each.often for each in together)
            if full or not other.is_plain or other.changed():
                continue
            joint = other.copy()
            text = joint.entry(source, vars(tick), types)
            if joint.is_plain:
                self.name = joint.entries[-1]
                for each in (*together, self):
                    each.program, each.text = joint, text
                return
        self.text = self.program.entry(source, vars(tick), types)

    def compile(self, *, often: bool) -> None:
        """Compile it, unless that is done; raises NoCompilerError."""
        if self.run is None or often > self.often:
            (address,) = machine.machine(self.text, [self.name], often=often)
            of_c = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, *(TYPES[kind] for kind in (*GIVEN, WHOLE)))
            self.often, self.run = often, of_c(address)


@dataclass
class Prepared:
    """Stored layout of the robots of a case, and their compiled loop."""

    rows: list[list[int]]  # rows of robots of the same layout
    layout: RecordLayout  # layout of the crew
    driver: CompiledLoop
    words: int = 1 << 12  # words that all objects have taken, at most, so far
    flown_s: float = 0.0  # seconds of plain Python that its flights of this process would have taken, about

    def count(self, seconds: float) -> None:
        """Count work in seconds of plain Python; as much as was done probably follows, and `cc` pays for much."""
        self.flown_s += seconds
        if self.flown_s > OFTEN_S and not self.driver.refusal:
            self.driver.compile(often=True)


class Stretches:
    """Compiled ticks of the robots of a flight."""

    flown: int  # ticks so far
    refusal: str  # why nothing can be compiled, empty as long as it can
    called_back: str = ""  # likewise for steps of laws, and changes of the formation
    tick: int  # tick of the present stretch of which the first half is done
    end: int  # last tick of the present stretch
    moved: bool = False  # phases have moved on at the present tick, of which the rest of the first half is to be flown

    def __init__(self, flight: Flown, last: int = RUNNING) -> None:
        """No stretch goes on beyond the end of the `last` phase."""
        self._flight = flight
        self._case = msgspec.json.encode(flight.plan.experiment) + str(flight.window is not None).encode()
        self._last = last
        twins = flight.twin.twins
        carriers = flight.twin.engine.carriers or [None] * len(twins)
        network, rates = flight.network, flight.plan.experiment.rates
        says = network.says
        self._members = [
            Member(row, robot, twin, carrier, sum(says.values()))
            for row, (robot, twin, carrier) in enumerate(zip(flight.robots, twins, carriers, strict=True))
        ]
        self._steps, self._ways = Steps(self._members, flight.twin, flight.touches, flight.window), list[LinkQueue]()
        for (robot, k), channel in zip(network.receivers, network.channels, strict=True):
            sender = robot.neighbours.all[k]
            late = min(LATE * channel.jitter, LATEST_S)
            way = LinkQueue(sender, channel, ROOM + round((channel.delay + late) * rates.pose_hz), sum(says.values()))
            self._members[sender.sender].ways.append(way)
            self._ways.append(way)
        self._under_way = array("d", bytes(8 * sum(len(way.samples) for way in self._ways)))
        place, whole = 0, cast("memoryview[float]", memoryview(self._under_way))
        for way in self._ways:  # one array of all of them is copied at once
            way.samples, place = whole[place : place + len(way.samples)], place + len(way.samples)
        self._plans, self._itineraries = dict[int, PlannedTargets](), dict[int, Itinerary]()
        self.flown, self.refusal = 0, ""
        self._prepared: Prepared | None = None
        self._paused_until, self._refused = 0, False
        self._image: Image | None = None
        self._before: Sequence[Arrived] = ()
        # words of the records at the begin of a stretch, and arrays, each with its numbers then
        self._first: tuple[Index, list[tuple[array[float], array[float]]]] | None = None

    @property
    def open(self) -> bool:
        """Whether the robots live in records now."""
        return self._image is not None

    def begin(self, k: int) -> bool:
        """Begin a stretch from tick `k`, of which the first half is done; returns whether it pays."""
        flight = self._flight
        rates, duration_s = flight.plan.experiment.rates, flight.robots[0].assignment.duration
        longest = max(min(LONGEST, ROBOT_TICKS // len(flight.robots)), LEAST)
        soon = k * flight.dt + AHEAD_S
        ends = (soon if np.isnan(flight.start_at) else flight.start_at) + duration_s + AHEAD_S * (self._last == DONE)
        end = min(k + longest, round(max(ends, soon) / flight.dt))
        if self._refused or k < self._paused_until or end - k < LEAST:
            return False
        if not all(_goes_on(robot, (k + 1) * flight.dt) for robot in flight.robots):
            return False
        ticks = end - k
        transmissions = ticks // round(rates.body_hz / rates.pose_hz) + ROOM
        samples = ticks // flight.log_every + ROOM
        self._ledger = ledger = Ledger(self._members, transmissions, samples, start=flight.start_at, lean=flight.lean)
        if not flight.lean:
            for way in self._ways:
                way.arrivals = array("d", (0.0,)) * transmissions
        for member in self._members:
            member.seq = flight.network.seq[member.row]
            member.twin.reserve(ticks)
        self._before = flight.network.board(self._ways)
        self._begun, self.tick, self.end = k, k, end
        for row, robot in enumerate(flight.robots):
            if robot.goals.itinerary is not None:
                self._itineraries[row], every = robot.goals.itinerary, robot.assignment.decide_every
                self._plans[row] = PlannedTargets(robot.assignment.body_hz / every, ticks // every + ROOM)
                robot.goals.itinerary = self._plans[row]  # type: ignore[assignment]
        self._plan(k)
        prepared = self._prepared or RECENT.get(self._case)
        if prepared is not None and (self._prepared is not None or not prepared.driver.program.changed()):
            self._image = self._stored(prepared, ledger)
        if prepared is None or self._image is None:
            prepared = self._new(ledger)
            self._image = self._stored(prepared, ledger)
        prepared.count(TICK_S * ticks * len(flight.robots))
        self._prepared, self.refusal = prepared, prepared.driver.refusal or self.refusal
        self.called_back = next(iter(prepared.driver.program.called_back.values()), "")
        if self.refusal:
            REFUSED[str(prepared.layout)] = self.refusal
        if self.refusal or self._image is None:
            self._refused = True
            self.leave()
            return False
        self._steps.board(self._image, k * flight.dt)
        self._first = None
        if flight.window is not None and not self._itineraries and not self.called_back:
            notes = {id(each) for each in (ledger.times, ledger.sent, ledger.samples, ledger.laws)}
            arrays = [(each, each[:]) for key, each in self._image.arrays.items() if key not in notes]
            arrays.append((self._under_way, self._under_way[:]))
            self._first = self._image.words.copy(), arrays
        return True

    def rewind(self, k: int) -> bool:
        """Go back to tick `k`, if the present stretch began then, and all since was quiet; returns whether."""
        prepared = self._prepared
        if prepared is None or self._image is None or self._first is None or self._begun != k:
            return False
        prepared.count(TICK_S * (self.tick - self._begun) * len(self._members))
        self._image.words[:], self.tick = self._first[0], self._begun
        for each, begin in self._first[1]:
            each[:] = begin
        return True

    def go(self, end: int) -> bool:
        """Fly on until the first half of tick `end` is done, of a stretch that has begun; returns False if it ended.

        Not so far if a phase moves on: then `moved` says so. Raises TornError.
        """
        steps, flight, image, prepared = self._steps, self._flight, self._image, self._prepared
        assert image is not None
        assert prepared is not None
        self.moved = False
        if steps.stage is None:
            words, samples = image.words.copy(), self._under_way[:]
        given = (self.tick, end, self._leg, flight.dt, flight.log_every, flight.network.instant, steps.address)
        found = prepared.driver.run(image.address(image.roots[0][0]), *given)
        if found >= 0:
            self.tick = found
            image.read([self._ledger])
            self.moved = self._ledger.moves and self._live(image, found * flight.dt)
            return self.moved or not (self._ledger.ended or self._ledger.moves)
        if steps.stage is None:
            image.words[:] = words
            self._under_way[:] = samples
        if isinstance(steps.error, KeyboardInterrupt):
            raise steps.error
        if steps.stage is not None:
            raise TornError
        self._refused = True  # flown plain; that tells an error
        return False

    def _live(self, image: Image, t: float) -> bool:
        """Phases and plans move on at `t` [s], up to the end of the last one; returns False for what happens rarely."""
        robots, twins = self._flight.robots, self._flight.twin.twins
        self._first = None
        image.read(self._members)
        moving = [member.row for member in self._members if member.moves]
        lives = [(robots[row], robots[row].lifecycle) for row in moving]
        image.read(part for robot, life in lives for part in (life, robot.now, robot.now.state, robot.landing))
        for robot, life in lives:
            together = robot.assignment.lands_at == np.inf and not robot.landing.aside
            if not (life.climbing or (AIRBORNE <= life.phase < self._last and together)):
                return False
        for row in moving:
            robot, motion = robots[row], twins[row].motion
            image.read([robot, robot.neighbours, *robot.neighbours.all, motion])
            robot.live(t)
            if robot.takes_off:
                self._flight.twin.takeoff((row,), (robot.assignment.hover,))
            if robot.lands:
                self._flight.twin.land((row,))
            robot.takes_off = robot.lands = False
            image.write([robot, robot.lifecycle, robot.landing, motion])
        if self._itineraries:
            image.read(part for row in self._itineraries for part in (robots[row], robots[row].now))
            self._plan(self.tick)
            image.write(self._plans.values())
        return True

    def order(self, give: Callable[[], object]) -> None:
        """Let a conductor `give` orders, which robots get before the next tick."""
        lives, ledger = [robot.lifecycle for robot in self._flight.robots], self._ledger
        self.read(lives)
        give()
        ledger.start = self._flight.start_at
        self.write([*lives, ledger])

    def read(self, things: Iterable[object] | None = None) -> None:
        """Read some objects of the robots as they are now, or all; changes of them are of no effect, but see `write`.

        Numbers of transmissions are among them.
        """
        if self._image is not None:
            self._image.read(things)
            self._image.read(self._members)
        for member in self._members:
            self._flight.network.seq[member.row] = member.seq

    def write(self, things: Sequence[object]) -> None:
        """Let changes of these objects take effect."""
        self._first = None
        if self._image is not None:
            self._image.write(things)

    def leave(self) -> bool:
        """End a stretch: the robots are as after plain ticks; see `Ledger.moves` for what it returns."""
        flight, ledger, k = self._flight, self._ledger, self.tick
        self.read()
        if self._image is not None:
            self._image.free()
        self._image = None
        for row, itinerary in self._itineraries.items():
            flight.robots[row].goals.itinerary = itinerary
        self._itineraries.clear()
        if k - self._begun < LEAST:
            self._paused_until = k + PAUSE
        self.flown += k - self._begun
        flight.network.leave(self._ways, ledger, self._before, k * flight.dt)
        flight.note(ledger, self._steps)
        flight.twin.moved_to(k * flight.dt)
        for member in self._members:
            member.twin.reserve(0)  # lets go of what was used
        del self._ledger
        return ledger.moves

    def _stored(self, prepared: Prepared, ledger: Ledger) -> Image | None:
        """All objects in memory, None if they are not of these layouts."""
        self._steps.measures = prepared.driver.program.measures
        crew = self._crew(prepared.rows, ledger)
        try:
            image = Image([(crew, prepared.layout)], prepared.words, self._steps.measures)
        except TypeError as error:
            self.refusal = str(error)
            return None
        self.refusal, prepared.words = "", max(prepared.words, image.used)
        return image

    def _new(self, ledger: Ledger) -> Prepared:
        """Layouts and compiled loop of these robots; raises OutsideError, or NoCompilerError, if there is none."""
        layouts, groups = Layouts(), dict[RecordLayout | None, list[int]]()
        for member in self._members:
            layouts.of(member)
        if layouts.guessed:  # the kinds of lists that are empty for some robots are known now
            layouts.forget()
        for member in self._members:
            groups.setdefault(layouts.of(member), []).append(member.row)
        rows = [*groups.values()]
        layout = layouts.of(self._crew(rows, ledger))
        assert layout is not None
        while len(RECENT) >= MAX_RECENT:
            del RECENT[next(iter(RECENT))]
        plan = self._flight.plan
        often = max(WORK[1], plain_s(plan)) > OFTEN_S
        RECENT[self._case] = found = Prepared(rows, layout, driver(layout, len(rows), plan.names, often=often))
        return found

    def _crew(self, rows: Sequence[Sequence[int]], ledger: Ledger) -> Crew:
        """Crew of robots in groups of the same layout, by their `rows`."""
        groups = [[self._members[row] for row in each] for each in rows]
        return Crew(groups, ledger, self._steps.stage, self._flight.window)

    def _plan(self, k: int) -> None:
        """Targets of the decisions from tick `k` on, until the next leg of a plan: robots begin it where they are."""
        flight, self._leg = self._flight, sys.maxsize
        for row, itinerary in self._itineraries.items():
            robot, planned = flight.robots[row], self._plans[row]
            every, begin = robot.assignment.decide_every, robot.lifecycle.start_at
            now = robot.now
            planned.first = first = robot.tick // every
            place = (now.position[0], now.position[1], robot.goals.ground) if robot.tick % every == 0 else UNKNOWN
            for number in range(
                first, first + len(planned.targets) // 4 if robot.lifecycle.phase == RUNNING else first
            ):
                tick = k + number * every - robot.tick
                if number > first and tick * flight.dt - begin >= itinerary.next_at - 1e-9:
                    self._leg = min(self._leg, tick)
                    break
                target = itinerary.target(tick * flight.dt - begin, place, now.yaw)
                planned.targets[4 * (number - first) : 4 * (number - first) + 4] = array("d", target)
                place = UNKNOWN


def _goes_on(robot: Robot, t: float) -> bool:
    """Whether nothing happens to a robot, and its phase probably does not move on at `t` [s]: by its last state."""
    life = robot.lifecycle
    if (life.moved and life.phase != RUNNING) or robot.takes_off or robot.lands or robot.stops:
        return False
    return not (robot.causes or robot.hazards.under_way) and robot.is_steady(t)


def driver(crew: RecordLayout, groups: int, names: Sequence[str], *, often: bool) -> CompiledLoop:
    """Compiled loop over ticks for a crew of this number of groups, of robots with these names."""
    numbers = {name: number for number, name in enumerate(names)}
    before = DRIVERS.get(crew)
    fits = before is not None and before.program.names == numbers and not before.program.changed()
    DRIVERS[crew] = known = before if fits and before is not None else CompiledLoop(Program(numbers))
    try:
        if known is not before:
            parts = {name: "; ".join(text.format(f"crew.g{k}") for k in range(groups)) for name, text in PARTS.items()}
            known.translate(DRIVER.format(**parts), (crew, *GIVEN))
        if not known.refusal:
            known.compile(often=often)
    except Exception as error:  # noqa: BLE001 - of any plug-in and compiler: the run is flown without them
        named = isinstance(error, OutsideError | machine.NoCompilerError)
        known.refusal = str(error) if named else f"{type(error).__name__}: {error}"
    return known
