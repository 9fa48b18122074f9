"""Faults, by kind as docs/chaos.md defines them: what each does to a run, why it may not be well after it, a script."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from signal import SIGKILL, SIGSTOP, Signals
from typing import Final, Literal

import msgspec
import numpy as np

from agents.network import messages
from tests.reliability.observer import Observer
from tests.reliability.spoilt_run import MOCAP_CLOCK, SpoiltRun, Stage
from twins.arrays import Array
from twins.devices.device import CaptureFault

HELD_M: Final = 0.25  # largest distance of a robot that no process steers
NOTICE_S: Final = 1.0  # after which it must have stopped
DEAF_S: Final = 1.0  # after the return of a robot its receivers have a pose of it
NOTICED_S: Final = 1.0  # a robot without a router holds `neighbour_timeout_s` and so much later
STATUS_S: Final = 1.5  # a status is this old at most
REFUSED: Final = 2  # exit code of a process whose name is taken
GAP_S: Final = (0.5, 2.0)  # from when a fault has healed to the next
LATEST_S: Final = 4.0  # before the end no fault is begun that could not heal
LAST_S: Final = 15.0  # before the end the launcher may die, with which a round ends

Check = Callable[[], str]  # polled until it returns an empty text; before, the reason why the run is not yet well


class Fault(msgspec.Struct, frozen=True):
    """A fault of a script."""

    kind: str
    after_s: float  # so long after all was well again (or, of the first, after the formation had come together) [s]
    victim: str = ""  # a robot; if it has ended by then, the next that is alive. Empty: the whole run
    size: float = 0.0  # clock step [s]

    @property
    def properties(self) -> FaultKind:
        return FAULT_KINDS[self.kind]


@dataclass
class ActiveFault:
    """A fault that was begun, and what is checked after it; all times are monotonic [s]."""

    fault: Fault
    victim: str
    run: SpoiltRun
    observer: Observer
    there: set[str]  # robots under way before
    begun: float = field(default_factory=time.monotonic)
    utc: float = field(default_factory=time.time)  # the same by the wall clock [s]
    live: set[str] = field(default_factory=set)  # robots under way now
    lifted: float = 0.0
    note: str = ""  # for the report
    violations: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._events = len(self.observer.events)
        self._before = dict(self.observer.status)
        self._held_at: Array | None = None
        self.observer.orders.clear()

    def add_violation(self, text: str) -> None:
        """A violation of an invariant, reported once."""
        if text not in self.violations:
            self.violations.append(text)

    def check_held(self) -> None:
        """Check that the body of a victim stops soon, for no process steers it."""
        if time.monotonic() < self.begun + NOTICE_S or not self.observer.connected:
            return
        if self._held_at is None:
            self._held_at = self.observer.invariants.where(self.victim)
        if self.observer.moved(self.victim, self._held_at) > HELD_M:
            self.add_violation(f"{self.victim} moved although no process steered it")

    def reported(self, process: str) -> str:
        """Reason why the conductor has not reported the end of a process since the fault began."""
        events = self.observer.events[self._events :]
        ended = any(each.kind.startswith(process) and "ended" in each.text for each in events)
        return "" if ended else f"the end of the {process} is not reported"

    def lost(self) -> bool:
        """Whether the conductor has reported the end of the victim's process since the fault began."""
        return any(each.kind == "lost" and each.source == self.victim for each in self.observer.events[self._events :])

    def back(self) -> str:
        """Reason why a living victim is neither back nor down."""
        observer, victim = self.observer, self.victim
        if observer.status_at.get(victim, 0.0) < self.lifted:
            return f"no status of {victim} yet"
        if observer.is_down(victim):
            return self.landed()
        return "" if victim in self.live else f"{victim} is not back"

    def landed(self) -> str:
        """Reason why the victim is not down."""
        if not self.observer.is_down(self.victim):
            return f"{self.victim} does not land"
        return f"{self.victim} has not come down yet" if self.observer.invariants.in_the_air(self.victim) else ""

    def loss_noticed(self) -> str:
        """Reason why the loss of the victim is not known to all who receive it."""
        observer, victim = self.observer, self.victim
        if victim in observer.alive:
            return f"{victim} is dead, and its token still stands"
        unaware = [name for name in self.receivers() if victim not in observer.status[name].missing]
        return f"{', '.join(unaware)}: not noticed that {victim} is lost" if unaware else ""

    def unaware(self, names: Collection[str], text: str) -> str:
        """Reason why living robots among `names` neither hold nor land, with `text` in the incident."""
        blind = [name for name in sorted(self.live.intersection(names)) if not self.incidents(name, text)]
        return f"{', '.join(blind)}: not noticed that its position is wrong" if blind else ""

    def awake(self) -> str:
        """Reason why a victim that slept is neither back, and receives the others, nor down."""
        if (why := self.back()) or self.observer.is_down(self.victim):
            return why
        deaf = self.deaf_to()
        return f"{self.victim} receives no pose of {', '.join(deaf)}" if deaf else ""

    def deaf_to(self) -> list[str]:
        """Living robots that have transmitted since the fault was lifted, and the victim received none of their poses.

        Robots at rest do not transmit by events. A status says how many were sent until a second before.
        """
        observer, victim = self.observer, self.victim
        senders = [name for name, receivers in observer.receivers.items() if victim in receivers and name in self.live]
        spoke = [name for name in senders if observer.sent_at.get(name, 0.0) > self.lifted + STATUS_S]
        return [name for name in spoke if observer.received_at.get((victim, name), 0.0) < self.lifted]

    def receivers(self) -> list[str]:
        """Living robots that receive the poses of the victim."""
        return sorted(self.observer.receivers[self.victim] & self.live)

    def positions_kept(self) -> str:
        """Add a violation for each robot that lost its position."""
        for name in self.observer.status:
            for incident in self.incidents(name, "position"):
                self.add_violation(f"{name}: {incident.text}")
        return ""

    def all_held(self) -> str:
        """Reason why not all robots have held for a silent router; a violation for each that was late."""
        limit = self.run.experiment.safety.neighbour_timeout_s + NOTICED_S
        free = []
        for name in sorted(self.live - self.run.shifted):
            since = [each.stamp - self.utc for each in self.incidents(name, "router")]
            if not since:
                free.append(name)
            elif min(since) > limit:
                self.add_violation(f"{name} held only {min(since):.1f} s after the router had frozen")
        return f"{', '.join(free)}: never held while the router was frozen" if free else ""

    def all_landed(self) -> str:
        """Reason why robots without a conductor are not down yet."""
        observer = self.observer
        up = [name for name in observer.invariants.names if observer.invariants.in_the_air(name)]
        asked = sorted(observer.status.keys() - self.run.dead.keys())
        awake = [name for name in asked if observer.status[name].phase != "done"]
        return f"in the air {up}, not done {awake}" if up or awake else ""

    def incidents(self, name: str, what: str) -> list[messages.Incident]:
        """Incidents since the fault began that made a robot hold, land or cut its motors, and whose text has `what`."""
        new = self.observer.status[name].incidents_since(self._before.get(name))
        return [each for each in new if what in each.text and each.text.startswith(("hold", "land", "cut"))]


Begin = Callable[[ActiveFault], Check]


def _lever(act: Callable[[SpoiltRun, str], str | None], why: Callable[[ActiveFault], str]) -> Begin:
    """A lever of the run for the victim, if there is one, which returns a note; `why` the run is not yet well."""

    def begin(active: ActiveFault) -> Check:
        active.note = act(active.run, active.victim) or ""
        return partial(why, active)

    return begin


def _signal(number: Signals, why: Callable[[ActiveFault], str], role: str = "") -> Begin:
    """A signal to a process, the victim's if no other is named."""
    return _lever(lambda run, victim: run.send(role or victim, number), why)


def _step_clock(name: str) -> Begin:
    """A step of the wall clock that a switch sets: no robot may lose its position."""

    def begin(active: ActiveFault) -> Check:
        switch, active.note = active.run.switch(name), f"{active.fault.size:+g} s"
        switch.write(switch.read() + active.fault.size)
        return active.positions_kept

    return begin


def _capture(fault: CaptureFault, text: str = "position") -> Begin:
    """Wrong poses from motion capture, of a victim if there is one: robots must hold or land by it."""

    def begin(active: ActiveFault) -> Check:
        names = active.run.measured
        active.run.spoil_capture(fault, active.victim)
        if active.victim:
            first = names.index(active.victim)
            names = [*names, names[0]][first : first + (2 if fault == "swapped" else 1)]
            active.note = " and ".join(names[1:])
        return partial(active.unaware, names, text)

    return begin


def _clock_behind(active: ActiveFault) -> Check:
    run, observer, victim = active.run, active.observer, active.victim
    run.send(victim, SIGKILL)
    run.switch(f"clock-{run.process_of[victim]}").write(-active.fault.size)
    active.note = f"{-active.fault.size:+g} s"
    restarted = back = None

    def check() -> str:
        nonlocal restarted, back
        if restarted is None:
            if victim in observer.alive or not active.lost():
                return f"the loss of {victim} is not reported"
            run.shifted.add(victim)
            restarted = time.monotonic()
            run.restart(victim)
        if (why := run.answer.reason or run.answer.refused.get(victim)) and not run.over:
            active.add_violation(f"{victim} is not let in again: {why}")
            return ""
        if victim not in observer.alive:
            return f"{victim} is not back"
        back = back or time.monotonic()
        received = observer.received_at
        deaf = ", ".join(name for name in active.receivers() if received.get((name, victim), 0.0) < restarted)
        if deaf and time.monotonic() - back > DEAF_S:
            active.add_violation(f"{deaf}: no pose of {victim} received in the first {DEAF_S:g} s after its restart")
        if deaf or victim not in active.live:
            return f"{victim} does not take part yet, or its poses do not reach {deaf or 'any robot'}"
        return ""

    return check


def _double(active: ActiveFault) -> Check:
    victim, second = active.victim, active.run.start_duplicate(active.victim)

    def check() -> str:
        for order in active.observer.orders:
            if order.robot == victim and not active.run.over:
                active.add_violation(f"the body of {victim} was ordered to {order.action}")
        if second.alive:
            return f"the second process of {victim} is not refused yet"
        if second.handle.returncode != REFUSED:
            active.add_violation(f"the second process of {victim}: {second.exit}, {second.tail()[-200:]}")
        return "" if victim in active.live else f"{victim} is not running any more"

    return check


def _read_error(active: ActiveFault) -> Check:
    observer, victim = active.observer, active.victim
    active.run.switch(f"read-{victim}").write(1.0)

    def check() -> str:
        if not any(order.robot == victim and order.action in ("land", "stop") for order in observer.orders):
            return f"the body of {victim} was ordered neither to land nor to stop"
        if observer.invariants.in_the_air(victim):
            return f"{victim} has not come down yet"
        if not active.lost():  # it lands for as long as a landing may take, for it sees nothing of it
            return f"the process of {victim} has not ended yet"
        active.run.dead.setdefault(victim, time.monotonic())
        return active.loss_noticed()

    return check


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: how it begins, and what a script and a round must know of it."""

    begin: Begin
    lasts_s: float = 0.0  # until it is lifted [s]; 0: it cannot be
    heals_s: float = 1.5  # usual time of the recovery [s]
    victim: bool = True  # one robot; else the whole run
    most: int = 1_000  # in one round
    stage: Stage = "plain"  # the only one on which it can be done; "plain": on each
    never: Stage | None = None  # a stage on which it cannot be done
    size: tuple[float, float] = (0.0, 0.0)  # range of its size [s]
    signed: bool = False  # the size may be negative as well
    unsteered: bool = False  # nothing steers the victim while it lasts: its body must stop
    among: Literal["all", "measured", "flying"] = "all"  # robots that it can befall
    disbands: bool = False  # drones land for it: for the rest of the round no formation is asked for
    ordered: bool = False  # its landings are ordered, so they fail no run
    recorded: Literal["", "lost", "router"] = ""  # kind of the event of which the recording must have one


_landing = partial(FaultKind, heals_s=8.0, most=1, disbands=True)
_wrong_poses = partial(_landing, lasts_s=5.0, stage="motion capture", among="measured")
_router_dies = _signal(SIGKILL, partial(ActiveFault.reported, process="router"), "router")
_router = partial(FaultKind, _router_dies, victim=False, recorded="router")
_recorder_ends = partial(ActiveFault.reported, process="recorder")
FAULT_KINDS: Final = {
    "kill": FaultKind(_lever(SpoiltRun.kill, ActiveFault.loss_noticed), most=2, recorded="lost"),
    "freeze": FaultKind(_signal(SIGSTOP, ActiveFault.back), 5.0, unsteered=True),
    "partition": FaultKind(_lever(SpoiltRun.cut, ActiveFault.back), 3.0, unsteered=True),
    "router": _router(most=3, never="two routers"),
    "failover": _router(most=1, stage="two routers"),
    "frozen-router": FaultKind(
        _signal(SIGSTOP, ActiveFault.all_held, "router"), 5.0, victim=False, most=2, stage="patient router"
    ),
    "conductor": FaultKind(_signal(SIGKILL, ActiveFault.all_landed, "conductor"), victim=False, most=1),
    "clock": FaultKind(_step_clock("clock"), victim=False, size=(0.5, 5.0), signed=True),
    "clock-behind": FaultKind(_clock_behind, heals_s=12.0, most=2, size=(3.0, 4.5), recorded="lost"),
    "mocap-clock": FaultKind(
        _step_clock(MOCAP_CLOCK), 3.0, victim=False, most=3, stage="motion capture", size=(0.5, 4.5), signed=True
    ),
    "mocap-frozen": _wrong_poses(_capture("frozen"), victim=False),
    "mocap-repeated": _wrong_poses(_capture("repeated"), victim=False),
    "mocap-swapped": _wrong_poses(_capture("swapped", "")),
    "mocap-renamed": _wrong_poses(_capture("renamed")),
    "refused-landing": _landing(
        _lever(SpoiltRun.refuse_landing, ActiveFault.landed), 12.0, among="flying", ordered=True
    ),
    "sleep": FaultKind(_lever(SpoiltRun.sleep, ActiveFault.awake), 8.0, heals_s=6.0, most=2, unsteered=True),
    "double": FaultKind(_double, heals_s=6.0),
    "read-error": FaultKind(_read_error, heals_s=12.0, most=1, recorded="lost"),
    "disk": FaultKind(_lever(SpoiltRun.fill_disk, _recorder_ends), victim=False, most=1),
    "corrupt": FaultKind(_lever(SpoiltRun.spoil, ActiveFault.back), 1.0),
}
FAULTS: Final = tuple(FAULT_KINDS)


def script(robots: Sequence[str], count: int, seed: int, kinds: Sequence[str] = FAULTS) -> list[Fault]:
    """`count` faults of `robots`, each kind as often as any other; the same seed gives the same script."""
    random = np.random.default_rng(seed)
    deck = [kinds[place % len(kinds)] for place in range(count)]
    random.shuffle(deck)
    faults = []
    for kind in deck:
        nature, after_s = FAULT_KINDS[kind], round(float(random.uniform(*GAP_S)), 2)
        victim = str(random.choice(list(robots))) if nature.victim else ""
        size = random.uniform(*nature.size) * random.choice([-1.0, 1.0] if nature.signed else [1.0])
        faults.append(Fault(kind, after_s, victim, round(float(size), 3)))
    return faults


def next_fault(waiting: Sequence[Fault], stage: Stage, begun: Mapping[str, int], left_s: float) -> Fault | None:
    """The next fault of a round; None if none fits.

    Args:
        begun: Faults of the round by kind.
        left_s: Rest of the round's time [s]. The death of the launcher, which ends the round, waits for the last of it;
            faults for which drones land come behind the others.
    """
    fits = []
    for fault in waiting:
        kind = fault.properties
        there = kind.stage in ("plain", stage) and kind.never != stage
        if there and begun.get(fault.kind, 0) < kind.most and kind.lasts_s + max(LATEST_S, kind.heals_s) < left_s:
            fits.append(fault)

    def urgency(fault: Fault) -> tuple[bool, bool]:
        return (fault.kind == "conductor") == (left_s > LAST_S), fault.properties.disbands

    return min(fits, key=urgency, default=None)
