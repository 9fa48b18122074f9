"""Does [channel] make sense: whom it names, and what it asks of each link."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from agents.plugins import did_you_mean
from experiments import assign
from experiments.conditions import of_link
from experiments.experiment import Experiment, LinkChannel
from experiments.links import pairs
from experiments.locate import Path
from experiments.problem import Fault

FORM: Final = '"A > B" is what A says to B, "A - B" goes both ways'
AT: Final = ("channel", "links")
ROUNDING: Final = 1e-9


def faults(experiment: Experiment) -> Iterator[Fault]:
    """Everything in [channel] that contradicts something else."""
    channel = experiment.channel
    yield from _bursts(of_link(channel), ("channel",), LinkChannel(loss=channel.loss, burst=channel.burst))
    there = _heard(experiment) if channel.links or any(outage.links for outage in channel.outages) else None
    said: dict[tuple[str, str], str] = {}
    for text, own in channel.links.items():
        path = (*AT, text)
        yield from _link(experiment, there, text, path, on_key=True)
        yield from _bursts(of_link(channel, own), path, own)
        for pair in _pairs(text):
            if pair in said:
                message = f"what {pair[1]} says to {pair[0]} has its settings by '{said[pair]}' already"
                yield Fault(path, message, "keep one of the two", on_key=True)
                break
            said[pair] = text
    for number, outage in enumerate(channel.outages):
        where = ("channel", "outages", number)
        if outage.from_s >= experiment.duration_s:
            message = f"this outage begins at {outage.from_s:g} s, when the run of {experiment.duration_s:g} s is over"
            yield Fault((*where, "from_s"), message, "begin earlier, or give a longer duration_s")
        for k, text in enumerate(outage.links):
            yield from _link(experiment, there, text, (*where, "links", k))
        for k, robot in enumerate(outage.robots):
            if robot not in experiment.robots:
                hint = did_you_mean(robot, experiment.robots)
                yield Fault((*where, "robots", k), f"no robot is called '{robot}'", hint)


def _pairs(text: str) -> tuple[tuple[str, str], ...]:
    """As `links.pairs`; nothing where that is reported elsewhere."""
    try:
        return pairs(text)
    except ValueError:
        return ()


def _link(
    experiment: Experiment, there: set[tuple[str, str]] | None, text: str, path: Path, *, on_key: bool = False
) -> Iterator[Fault]:
    """Is this a link on which something is said; `there` are all of those, if they are known."""
    both = _pairs(text)
    if not both:
        yield Fault(path, f"{text!r} is no link", FORM, on_key=on_key)
        return
    unknown = [name for name in dict.fromkeys(reversed(both[0])) if name not in experiment.robots]
    for name in unknown:
        yield Fault(path, f"no robot is called '{name}'", did_you_mean(name, experiment.robots), on_key=on_key)
    if unknown:
        return
    deaf = [pair for pair in both if there is not None and pair not in there]
    if deaf:
        listener, speaker = deaf[0]
        hint = f"leave it out, or let {listener} listen to {speaker} in [formation.links]; {FORM}"
        yield Fault(path, f"{listener} does not listen to {speaker}", hint, on_key=on_key)


def _heard(experiment: Experiment) -> set[tuple[str, str]] | None:
    """Who listens to whom, for the formation or for avoidance; None where that cannot be told, which is said there."""
    try:
        links = assign.heard_links(experiment)
    except (ValueError, KeyError):
        return None
    names = tuple(experiment.robots)
    return {(names[i], names[j]) for i, j in zip(links.listener.tolist(), links.speaker.tolist(), strict=True)}


def _bursts(held: LinkChannel, path: Path, own: LinkChannel) -> Iterator[Fault]:
    """Losses in a row: `held` is what holds on a link, `own` what stands at this place of the file."""
    loss, burst = held.loss or 0.0, held.burst
    if burst is None or (own.loss is None and own.burst is None):
        return
    at = (*path, "burst" if own.burst is not None else "loss")
    if loss == 0.0:
        if own.burst is not None:
            yield Fault(
                at, "burst says how losses come, and nothing is lost here", "give a loss too, or leave burst out"
            )
    elif loss < 1.0 and burst * (1.0 - loss) < 1.0 - ROUNDING:
        least = 1.0 / (1.0 - loss)
        message = f"where {100 * loss:g} % is lost by chance, {least:.3g} are lost in a row on average, not {burst:g}"
        yield Fault(at, message, f"give a burst of at least {least:.3g}, or leave burst out: losses by chance")
