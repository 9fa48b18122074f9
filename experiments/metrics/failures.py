"""Robots that did not do their part of an experiment, by the events of the run."""

from __future__ import annotations

from collections.abc import Container, Iterable
from math import inf

from agents.network.messages import Event
from agents.safety.hazards import UNRESOLVED, failed, is_blind


def failed_robots(events: Iterable[Event], robots: Container[str]) -> dict[str, str]:
    """A sentence about the first thing that kept each robot from its part, and a cut of its motors after that.

    Stamps are seconds after the common start.
    """
    found: dict[str, str] = {}
    blind: dict[str, Event] = {}  # begin of the last loss of its own position
    for event in events:
        lost = event.kind in {"lost", "failed"} or (event.kind == "hazard" and failed(event.text))
        if event.kind == "hazard" and event.text.startswith("hold: ") and is_blind(event.text):
            blind[event.source] = event
        if lost and event.source in robots and event.source not in found:
            what = f"was lost: {event.text}" if event.kind == "lost" else event.text.removeprefix("warn: ")
            begin = event
            if event.text.startswith(UNRESOLVED) and event.source in blind:
                begin = blind[event.source]
                what = f"{begin.text.removeprefix('hold: ')}, until the end"
            found[event.source] = f"{event.source} {moment(begin)}: {what}"
        elif event.text.startswith("cut: ") and "cut: " not in found.get(event.source, "cut: "):
            found[event.source] += f"; {moment(event)} {event.text}"
    return found


def moment(event: Event) -> str:
    """Time of an event, in words; of a run without a start its stamp is minus infinity."""
    if event.stamp > -0.05:
        return f"at {abs(event.stamp):.1f} s"
    return "before the start" if event.stamp == -inf else f"{-event.stamp:.1f} s before the start"
