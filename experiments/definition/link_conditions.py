"""Effects of [channel] on each link, as `agents.network.channel_model.Conditions`."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Final

from msgspec.structs import replace

from agents.network import channel_model
from agents.network.channel_model import Conditions, LinkEffects
from experiments.definition.experiment import ChannelTable, LinkChannelTable
from experiments.definition.links import link_pairs
from experiments.definition.plan import Plan

# any real network takes as long: to wait for it would cost a tick in ten milliseconds
OWN_S: Final = ChannelTable().delay_s
TO_CENTRE, FROM_CENTRE = "to centre", "from centre"  # streams

Ends = Sequence[tuple[str, str]]  # sender and receiver of each link, by name


def models_network(plan: Plan) -> bool:
    """Whether the file asks for any network effect."""
    return plan.experiment.channel != ChannelTable()


def link_effects(channel: ChannelTable, own: LinkChannelTable | None = None) -> LinkEffects:
    """Effects on a link: its `own` settings, and the channel's where it has none."""
    effects = {name: getattr(channel, name) for name in LinkEffects.__struct_fields__}
    if own is not None:
        effects |= {name: value for name in effects if (value := getattr(own, name)) is not None}
    return LinkEffects(**effects)


def conditions_of(plan: Plan, ends: Ends, seed: int, *, stream: str = "", real: bool = False) -> list[Conditions]:
    """Conditions of links between these `ends`.

    Args:
        seed: Of the random numbers.
        stream: Other messages between the same robots have another one, and their own random numbers.
        real: The network has a delay of its own.
    """
    channel, more = plan.experiment.channel, (stream,) if stream else ()
    own = {pair: effects for text, effects in channel.links.items() for pair in link_pairs(text)}
    found = []
    for sender, receiver in ends:
        given = own.get((receiver, sender))
        effects = link_effects(channel, given)
        bare = Conditions.of(effects, _outages(channel, sender, receiver), plan.experiment.duration_s)
        if real and bare.delay <= OWN_S:
            bare = replace(bare, delay=0.0)
        found.append(replace(bare, key=channel_model.key(seed, sender, receiver, *more)) if bare.random else bare)
    return found


def _outages(channel: ChannelTable, sender: str, receiver: str) -> list[tuple[float, float]]:
    """Begin and end of the outages of a link [s]."""
    found = []
    for outage in channel.outages:
        everywhere = not (outage.links or outage.robots)
        named = any((receiver, sender) in link_pairs(text) for text in outage.links)
        if everywhere or named or sender in outage.robots or receiver in outage.robots:
            found.append((outage.from_s, inf if outage.until_s is None else outage.until_s))
    return found
