"""Effects of [channel] on each link, as `agents.network.channel_model.Conditions`."""

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
    """Conditions of all links `over` of all repetitions, those of the first seed first; rows are those of the file.

    Other messages between the same robots have another `stream`, and their own random numbers.
    """
    ends = _Ends.of(experiment, over.take(np.arange(len(over) // len(seeds))), tuple(experiment.robots))
    return Conditions.side_by_side(
        _seeded(_link_conditions(experiment.channel, ends, experiment.duration_s), ends, seeds, stream)
    )


def receiver_conditions(
    experiment: Experiment, over: Links, receivers: Sequence[str], *, stream: str = ""
) -> Conditions:
    """Conditions of the links on which robots of one process receive, on a real network with its own delay.

    `over.receiver` counts in `receivers`, `over.sender` in the robots of the file.
    """
    ends = _Ends.of(experiment, over, receivers)
    bare = _link_conditions(experiment.channel, ends, experiment.duration_s)
    bare = replace(bare, delay=np.where(bare.delay > OWN_S, bare.delay, 0.0))
    return _seeded(bare, ends, [experiment.seed], stream)[0]


def conditions_to_centre(experiment: Experiment, senders: Index) -> Conditions:
    """Conditions of poses from `senders` (K,), rows of the file, to the central controller, on a real network."""
    names = tuple(experiment.robots)
    link_pairs = [(row, row) for row in senders.tolist()]
    return receiver_conditions(experiment, links(link_pairs), names, stream=TO_CENTRE)


def conditions_from_centre(experiment: Experiment, receivers: Sequence[str]) -> Conditions:
    """Conditions of goals to the guided ones of the robots `receivers`, in their order, on a real network."""
    names, guided = tuple(experiment.robots), Plan(experiment).guided
    link_pairs = [(row, names.index(name)) for row, name in enumerate(receivers) if name in guided]
    return receiver_conditions(experiment, links(link_pairs), receivers, stream=FROM_CENTRE)


@dataclass(frozen=True)
class _Ends:
    """Receiver and sender of each link (E,), by name."""

    receiver: NDArray[np.str_]
    sender: NDArray[np.str_]

    @classmethod
    def of(cls, experiment: Experiment, links: Links, receivers: Sequence[str]) -> _Ends:
        return cls(np.array(receivers)[links.receiver], np.array(tuple(experiment.robots))[links.sender])

    def named(self, text: str) -> Mask:
        """Mask (E,) of the links that a text such as "A > B" or "A - B" means."""
        found = np.zeros(len(self.receiver), dtype=bool)
        for receiver, sender in link_pairs(text):
            found |= (self.receiver == receiver) & (self.sender == sender)
        return found


def _link_conditions(channel: Channel, ends: _Ends, duration: float) -> Conditions:
    """Conditions of these links without random keys."""
    effects = [link_effects(channel), *(link_effects(channel, own) for own in channel.links.values())]
    count = len(ends.receiver)
    which = np.zeros(count, dtype=np.intp)
    for number, text in enumerate(channel.links, start=1):
        which[ends.named(text)] = number
    outages = []
    for outage in channel.outages:
        there = np.full(count, not (outage.links or outage.robots))
        for text in outage.links:
            there |= ends.named(text)
        there |= np.isin(ends.receiver, outage.robots) | np.isin(ends.sender, outage.robots)
        outages.append(Outage(outage.from_s, inf if outage.until_s is None else outage.until_s, there))
    return Conditions.from_effects(effects, which, outages, duration)


def _seeded(bare: Conditions, ends: _Ends, seeds: Sequence[int], stream: str) -> list[Conditions]:
    """Conditions for each seed, with random keys of its own if anything is random."""
    if not (bare.loss.any() or bare.jitter.any()):
        return [bare] * len(seeds)
    more = (stream,) if stream else ()
    both = [(*each, *more) for each in zip(ends.sender.tolist(), ends.receiver.tolist(), strict=True)]
    return [
        replace(bare, key=np.array([channel_model.key(seed, *each) for each in both], dtype=np.uint64))
        for seed in seeds
    ]
