"""Orders of the page: emergency stop, land, hold, resume, a leader's target, parameters; each is an event."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf, isfinite, isnan
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import zenoh

from agents.clock import Clock
from agents.fields import description
from agents.network import endpoints as topology
from agents.network import lab, messages, pubsub
from agents.network.keys import Keys
from experiments.real_time.conductor import orders
from experiments.scene.stage import Moment, SceneModel
from experiments.view.heartbeat import STALE_S

if TYPE_CHECKING:
    import viser

    from experiments.real_time.hosts.run_registry import RegisteredRun
    from experiments.view.serving import PageServer

REASON: Final = "button of zenpark view"
SETTLED_S: Final = 0.4  # pause since the last move of a slider, or the end of a drag; then its value is sent
SLIDERS: Final = 6
STEPS: Final = 50  # steps of a slider up to the value of the file
RANGE: Final = 4.0  # times that value at its end
CALMING: Final = ("hold", "land")  # orders that count whatever the page shows
OBSERVER: Final = "observer"
NOTE_S: Final = 8.0
HANDLE: Final = 0.25  # [m] size of a target, in an arena of 2.5 m; in a larger one, as much larger
LEADERS: Final = 5  # most that are dragged
HELD_S: Final = 1.5  # time until the goal that a leader reports is the one that it was sent to
LAST: Final = "Repeat it with `./zenpark estop`, or cut the power."


@dataclass(frozen=True)
class WatchedRun:
    """The run that is watched."""

    endpoints: Sequence[str]
    realm: str
    identity: str  # identity to show, in a lab
    run: RegisteredRun | None = None  # run of this machine, if it is registered

    @property
    def words(self) -> str:
        """Run and routers, for people."""
        return f"at {', '.join(topology.bare(self.endpoints))}" if self.run is None else self.run.words

    @property
    def over(self) -> bool:
        """Whether the run is known to have ended: its process has, on this machine."""
        return self.run is not None and not self.run.alive


def may_act(watched: WatchedRun) -> bool:
    """Whether the page may give orders: with an operator's certificate in a lab, elsewhere unless as an observer."""
    folder = lab.lab_of(watched.endpoints)
    if folder is None:
        return watched.identity != OBSERVER
    try:
        known = lab.register(folder).identities.get(watched.identity)
    except lab.LabError:  # only the own certificate is there: that of an observer
        return False
    return known is not None and known.role == "operator"


class Acting:
    """Buttons of an operator's page, and the orders that they give."""

    def __init__(self, session: zenoh.Session, watched: WatchedRun) -> None:
        self._session, self._watched = session, watched
        self._clock = Clock()
        self._keys = keys = Keys(watched.realm)
        self._events = pubsub.pose_publisher(session, keys.event, messages.JSON, pubsub.EVENTS)
        self._urgent = orders.stop_publisher(session, keys)
        self._alive: Sequence[str] = ()
        self._stage = SceneModel.of_robots(())
        self._parts: list[Any] = []  # parts of the present stage
        self._targets: dict[str, Any] = {}  # targets by leader
        self._held_until = -inf  # [s, monotonic] targets stay where they were dragged
        self._dragged = self._ended = False
        self.due: dict[str, tuple[float, Callable[[], object]]] = {}  # orders that wait until a control is at rest
        self._lock = threading.Lock()
        self._number = 0  # number of the present stage

    def build(self, server: PageServer) -> None:
        """Adds the buttons."""
        import viser  # noqa: PLC0415 - an extra

        self._server, gui = server, server.gui
        stop = gui.add_button(
            "EMERGENCY STOP (Shift+S)", color="red", icon=viser.Icon.HAND_STOP, order=0.0,
            hint=f"Cuts the motors of all robots: {self._watched.words}",
        )  # fmt: skip
        stop.on_click(lambda _: self.emergency_stop())
        key = gui.add_command("Emergency stop", hotkey="S", modifier="shift", icon=viser.Icon.HAND_STOP)
        key.on_trigger(lambda _: self.emergency_stop())
        self._folder = gui.add_folder("Orders", order=15.0)
        with self._folder:
            for text, what, icon, colour in (
                ("Hold all", "hold", viser.Icon.PLAYER_PAUSE, "yellow"),
                ("Land all", "land", viser.Icon.PLANE_ARRIVAL, "orange"),
                ("Resume all", "resume", viser.Icon.PLAYER_PLAY, "green"),
            ):  # fmt: skip
                button = gui.add_button(text, icon=icon, color=colour)  # type: ignore[arg-type]
                button.on_click(partial(self.press, messages.Order(what), what))  # type: ignore[arg-type]
            drag = gui.add_checkbox("Drag targets", initial_value=False, hint="Of the leaders.")
            drag.on_update(lambda event: self._show_targets(shown=bool(event.target.value)))

    def set_stage(self, stage: SceneModel, number: int) -> None:
        """Another case: its parameters, and the number by which pages report that they show it."""
        self._stage, self._number = stage, number
        with self._lock:
            self.due.clear()  # orders for the case before
        for part in (*self._parts, *self._targets.values()):
            part.remove()
        self._parts, self._targets = [], {}
        self._show_targets(shown=self._dragged)
        if stage.plan is None:
            return
        with self._folder:
            for parameter in parameters(stage)[:SLIDERS]:
                step = parameter.value / STEPS
                slider = self._server.gui.add_slider(
                    parameter.label, step, RANGE * parameter.value, step, parameter.value
                )
                slider.on_update(partial(self.slide, parameter))
                self._parts.append(slider)

    def follow(self, moment: Moment, alive: Sequence[str], *, ended: bool = False) -> None:
        """Takes in the present state, and gives orders that waited for a control to rest.

        `ended`: All robots have reported their end.
        """
        self._alive, self._moment, self._ended = alive, moment, ended
        now = time.monotonic()
        if now > self._held_until:
            for name, target in list(self._targets.items()):
                goal = moment.goal[self._stage.names.index(name)]
                if np.isfinite(goal).all() and np.abs(target.position - goal).max() > 1e-3:
                    target.position = goal
        with self._lock:
            due = [name for name, (at, _) in self.due.items() if now >= at]
            ready = [(name, *self.due.pop(name)) for name in due]
        for name, at, order in ready:
            if now > at + STALE_S:  # no page was open meanwhile, or nothing was drawn
                self._note(name, "not ordered: its page was closed. Look, then order again.", bad=True)
                continue
            threading.Thread(target=order, daemon=True).start()

    # ------------------------------------------------------------------ orders

    def emergency_stop(self) -> None:
        """Cuts the motors of all robots of the run, and says which run it was and what answered."""
        watched = self._watched
        self._server.gate.stops += 1
        stop = messages.encode(messages.Stop(watched.identity, REASON))
        sent = orders.EmergencyStop(watched.endpoints, watched.realm, watched.identity, watched.run)
        sending = threading.Thread(target=sent.send, args=(REASON,), daemon=True)
        sending.start()
        # the session here may be blocked or closed, which must not keep the result from the page, nor later clicks
        threading.Thread(target=self._urgent.put, args=(stop,), daemon=True).start()
        sending.join()
        seen, moving = sent.seen | sent.strangers, sent.moving | sent.moving_strangers
        doubtful = ", ".join(sorted(moving)) or ("" if seen else sent.failure)
        said = f"stopped: {', '.join(sorted(seen))}" if seen else f"no robot is seen. {LAST}"
        if (watched.over and not seen) or (self._ended and sent.failure is not None):
            said = "the run is over, and no robot of it answers. If one moves, cut its power."
        elif doubtful:
            said = f"NOT known to have stopped: {doubtful}. {LAST}"
        self._note("Emergency stop", f"{sent.where}: {said}", bad=bool(doubtful) or not seen, stays=True)
        threading.Thread(target=self._record, args=("emergency stop", said), daemon=True).start()

    def _show_targets(self, *, shown: bool) -> None:
        """Handles at the goals of the leaders, by which they are dragged."""
        self._dragged = shown
        for target in self._targets.values():
            target.remove()
        self._targets = {}
        scale = HANDLE * max(1.0, float(self._stage.size[:2].max()) / 2.5)
        for name in self._stage.leaders[:LEADERS] if shown else ():
            target = self._server.scene.add_transform_controls(
                f"/targets/{name}", scale=scale, active_axes=(True, True, False), disable_rotations=True,
                depth_test=False, position=(0.0, 0.0, -1000.0),
            )  # fmt: skip
            target.on_update(partial(self._drag, name))
            self._targets[name] = target

    def _drag(self, name: str, event: Any) -> None:  # noqa: ANN401 - viser's own type
        if event.client is None:
            return
        if event.phase != "end":
            self._held_until = inf
            return
        x, y = (round(float(each), 2) for each in event.target.position[:2])
        self._held_until = time.monotonic() + SETTLED_S + HELD_S
        what = f"{name} to x = {x:.2f} m, y = {y:.2f} m"
        if not (isfinite(x) and isfinite(y)) or self._refuse(event.client_id, what):
            return
        blocking, between = self._stage.in_the_way(self._moment, name, (x, y))
        if blocking:
            self._note(what, f"not ordered: it would touch {', '.join(blocking)} there.", bad=True)
            return
        order, warning = messages.Order("go", goal=(x, y)), ""
        if between and self._stage.margin <= 0.0:
            warning = f"{', '.join(between)} is on the straight way there, and nothing avoids: hold in time"
        self._order_in_thread(name, lambda: self._order_all(order, what, [name], warning))

    def slide(self, parameter: Parameter, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:  # moved by this program, not by a hand
            return
        value, what = parameter.limited(float(event.target.value)), parameter.name
        if value != event.target.value:
            event.target.value = value  # set on all pages
        if self._refuse(event.client_id, what):
            return
        order = messages.Order("set", name=parameter.name, value=value)
        self._order_in_thread(what, lambda: self._order_all(order, f"{what} = {value:g}"))

    def press(self, order: messages.Order, what: str, event: viser.GuiEvent[Any]) -> None:
        if order.order in CALMING or not self._refuse(event.client_id, what):
            self._order_all(order, what)

    def _refuse(self, page: int | None, what: str) -> bool:
        """Whether an order is refused, because its page shows the hand behind it no present picture; says so."""
        seen = None if page is None else self._server.gate.seen.get(page)
        if seen is None or seen.drawn == -inf:
            why = "the page does not report which picture it shows"
        elif seen.stage != self._number:
            why = "the page still showed the case before"
        elif (age := time.time() - seen.drawn) > STALE_S:
            why = f"the page showed a picture of {age:.0f} s ago"
        else:
            return False
        self._note(what, f"not ordered: {why}. Look, then order again.", bad=True)
        return True

    def _order_in_thread(self, name: str, order: Callable[[], object]) -> None:
        with self._lock:
            self.due[name] = (time.monotonic() + SETTLED_S, order)

    def _order_all(
        self, order: messages.Order, what: str, robots: Sequence[str] | None = None, warning: str = ""
    ) -> None:
        """Gives an order to robots, to all that are there if none is named, and says what they answered."""
        names = robots or sorted(self._alive)
        if not names:
            over = "the run is over" if self._watched.over or self._ended else "no robot is there"
            self._note(what, f"not ordered: {over}.", bad=True)
            return
        replies = orders.send_order(self._session, self._keys, names, order)
        refused = {name: reply.reason for name, reply in replies.items() if not reply.ok}
        done = [name for name in replies if name not in refused]
        said = f"{len(done)} of {len(replies)} robots"
        if refused:
            said += "; " + "; ".join(f"{name}: {reason}" for name, reason in list(refused.items())[:5])
        self._note(what, f"{said}; {warning}" if warning else said, bad=bool(refused or warning))
        self._record(what, said)

    def _record(self, what: str, said: str) -> None:
        event = messages.Event(self._clock.utc(), "order", self._watched.identity, f"{what}: {said}")
        self._events.put(messages.encode(event))

    def _note(self, title: str, text: str, *, bad: bool, stays: bool = False) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(
                title, text, color="red" if bad else "green", auto_close_seconds=None if stays else NOTE_S
            )


@dataclass(frozen=True)
class Parameter:
    """A parameter that robots change in flight."""

    name: str  # name of the order
    value: float  # value in the file
    unit: str = ""

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def limited(self, value: float) -> float:
        """A value within the reach of the slider, whatever the page sent; NaN becomes the value of the file."""
        if isnan(value):
            return self.value
        return min(max(value, self.value / STEPS), RANGE * self.value)


def parameters(stage: SceneModel) -> list[Parameter]:
    """Parameters that robots change in flight: the numbers of the trigger, and two of the formation."""
    assert stage.plan is not None
    trigger: Any = stage.plan.trigger
    formation = stage.plan.experiment.formation
    found = [Parameter(f"trigger.{name}", value, _unit(trigger, name))
             for name, value in msgspec.structs.asdict(trigger).items()]  # fmt: skip
    found += [Parameter(name, getattr(formation, name), _unit(formation, name)) for name in ("clamp", "tracking_gain")]
    return [
        each for each in found
        if isinstance(each.value, int | float) and not isinstance(each.value, bool) and 0.0 < each.value < np.inf
    ]  # fmt: skip


def _unit(owner: msgspec.Struct, name: str) -> str:
    """Unit of a field, as its description states it in brackets."""
    found = re.search(r"\[([^\]]+)\]", description(type(owner), name))
    return "" if found is None else found[1]
