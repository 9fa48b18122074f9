"""From [channel] of an experiment to what its links do to poses (`agents.network.channel_model.Conditions`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.arrays import Index, Mask
from agents.formation.graph import Links, links
from agents.network import channel_model
from agents.network.channel_model import Conditions, LinkEffects, Outage
from experiments.definition.experiment import Channel, Experiment, LinkChannel
from experiments.definition.links import link_pairs
from experiments.definition.plan import Plan

OWN_S: Final = Channel().delay_s  # any real network takes as long: to wait for it would cost a tick in ten milliseconds
TO_CENTRE, FROM_CENTRE = "to centre", "from centre"  # streams


def models_network(experiment: Experiment) -> bool:
    """Whether the file asks for any network effect."""
    return experiment.channel != Channel()


def link_effects(channel: Channel, own: LinkChannel | None = None) -> LinkEffects:
    """Effects on a link: its `own` settings, and the channel's where it has none."""
    effects = {name: getattr(channel, name) for name in LinkEffects.__struct_fields__}
    if own is not None:
        effects |= {name: value for name in effects if (value := getattr(own, name)) is not None}
    return LinkEffects(**effects)


def virtual_conditions(experiment: Experiment, over: Links, seeds: Sequence[int], *, stream: str = "") -> Conditions:
    """Of all links `over` of all repetitions, those of the first seed first; rows are the robots as in the file.

    What else goes between the same robots has another `stream`, and its own luck.
    """
    ends = _Ends.of(experiment, over.select(np.arange(len(over) // len(seeds))), tuple(experiment.robots))
    return Conditions.side_by_side(_seeded(_of(experiment.channel, ends, experiment.duration_s), ends, seeds, stream))


def receiver_conditions(
    experiment: Experiment, over: Links, listeners: Sequence[str], *, stream: str = ""
) -> Conditions:
    """Of the links on which robots of one process listen, on a real network, which has a delay of its own.

    `over.listener` counts in `listeners`, `over.speaker` in the robots of the file.
    """
    ends = _Ends.of(experiment, over, listeners)
    bare = _of(experiment.channel, ends, experiment.duration_s)
    bare = replace(bare, delay=np.where(bare.delay > OWN_S, bare.delay, 0.0))
    return _seeded(bare, ends, [experiment.seed], stream)[0]


def conditions_to_centre(experiment: Experiment, speakers: Index) -> Conditions:
    """Of poses that the centre hears from robots `speakers` (K,), rows of the file, on a real network."""
    names = tuple(experiment.robots)
    link_pairs = [(row, row) for row in speakers.tolist()]
    return receiver_conditions(experiment, links(link_pairs), names, stream=TO_CENTRE)


def conditions_from_centre(experiment: Experiment, listeners: Sequence[str]) -> Conditions:
    """Of goals that those of the robots `listeners` hear which are guided, in their order, on a real network."""
    names, told = tuple(experiment.robots), Plan(experiment).guided
    link_pairs = [(row, names.index(name)) for row, name in enumerate(listeners) if name in told]
    return receiver_conditions(experiment, links(link_pairs), listeners, stream=FROM_CENTRE)


@dataclass(frozen=True)
class _Ends:
    """Who listens and who speaks on each link (E,), by name."""

    listener: NDArray[np.str_]
    speaker: NDArray[np.str_]

    @classmethod
    def of(cls, experiment: Experiment, links: Links, listeners: Sequence[str]) -> _Ends:
        return cls(np.array(listeners)[links.receiver], np.array(tuple(experiment.robots))[links.sender])

    def named(self, text: str) -> Mask:
        """Which links (E,) a text such as "A > B" or "A - B" means."""
        found = np.zeros(len(self.listener), dtype=bool)
        for listener, speaker in link_pairs(text):
            found |= (self.listener == listener) & (self.speaker == speaker)
        return found


def _of(channel: Channel, ends: _Ends, duration: float) -> Conditions:
    """Without keys."""
    effects = [link_effects(channel), *(link_effects(channel, own) for own in channel.links.values())]
    count = len(ends.listener)
    which = np.zeros(count, dtype=np.intp)
    for number, text in enumerate(channel.links, start=1):
        which[ends.named(text)] = number
    outages = []
    for outage in channel.outages:
        there = np.full(count, not (outage.links or outage.robots))
        for text in outage.links:
            there |= ends.named(text)
        there |= np.isin(ends.listener, outage.robots) | np.isin(ends.speaker, outage.robots)
        outages.append(Outage(outage.from_s, inf if outage.until_s is None else outage.until_s, there))
    return Conditions.from_effects(effects, which, outages, duration)


def _seeded(bare: Conditions, ends: _Ends, seeds: Sequence[int], stream: str) -> list[Conditions]:
    """For each seed, with keys of its own if anything is left to chance."""
    if not (bare.loss.any() or bare.jitter.any()):
        return [bare] * len(seeds)
    more = (stream,) if stream else ()
    both = [(*each, *more) for each in zip(ends.speaker.tolist(), ends.listener.tolist(), strict=True)]
    return [
        replace(bare, key=np.array([channel_model.key(seed, *each) for each in both], dtype=np.uint64))
        for seed in seeds
    ]
