"""Channel model: delay, jitter, loss in bursts or alone, limited bandwidth and outages, on each link by itself.

The virtual clock sends through it, and so does the receiver of a real network: samples that have arrived wait here
until the model lets them through. The fate of a sample follows from the seed, the names at the two ends of its link and
its running number, so that both lose the same samples. docs/networks.md has the formulas.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from math import inf, isnan, log1p, nan
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from agents.vectors import Positive, Share

Delay = Annotated[float, Meta(ge=0, le=60)]
AtLeastOne = Annotated[float, Meta(ge=1)]

# SplitMix64 (Steele, Lea and Flood, Fast splittable pseudorandom number generators, OOPSLA 2014) is a counter with an
# odd step, and a mixer behind it: here the counter is given, not kept.
_WORD: Final = 0xFFFFFFFFFFFFFFFF
_STEP: Final = 0x9E3779B97F4A7C15
_UNIT: Final = 2.0**-53
_MIXERS: Final = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


def key(seed: int, *names: str) -> int:
    """64-bit key of a seed and some names; their order matters."""
    text = "\0".join([str(seed), *names])
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def uniform(word: int, counter: int) -> float:
    """Number in [0, 1), a multiple of 2⁻⁵³: one for each key `word` and counter. Quiet."""
    word = (word + _STEP * counter) & _WORD
    word = ((word ^ (word >> 30)) * _MIXERS[0]) & _WORD
    word = ((word ^ (word >> 27)) * _MIXERS[1]) & _WORD
    return ((word ^ (word >> 31)) >> 11) * _UNIT


ROUNDING_S: Final = 2e-6  # stamps on the wire are whole microseconds, and sums of binary fractions miss the ticks
QUEUE_S: Final = 0.5  # a sample that would wait longer for its link to be free is dropped
LOSS, JITTER, USES = 0, 1, 2  # random numbers of each sample: two, by their index


class LinkEffects(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Effects of the network on the samples of one link."""

    delay_s: Annotated[
        Delay,
        Meta(description="from sender to receiver [s]; in real time the delay of the network itself counts towards it"),
    ] = 0.001
    jitter_s: Annotated[Delay, Meta(description="mean of an exponential addition [s]")] = 0.0
    loss: Annotated[Share, Meta(description="share of samples that never arrive")] = 0.0
    burst: Annotated[
        AtLeastOne | None,
        Meta(description="mean number of samples lost in a row; left out: each is lost or not by itself"),
    ] = None
    bandwidth: Annotated[Positive | None, Meta(description="of each link [bit/s] of payload; left out: no limit")] = (
        None
    )


class Conditions(msgspec.Struct, frozen=True):
    """Conditions of a link: its `LinkEffects`, key, outages and duration."""

    UNSIGNED: ClassVar = ("key",)
    delay: float = 0.0  # [s]
    jitter: float = 0.0  # [s]
    loss: float = 0.0  # share
    burst: float = nan  # mean length, at least 1 / (1 - loss); NaN: each sample is lost or not by itself
    bandwidth: float = inf  # [bit/s], infinity: no limit
    queue: float = inf  # [s]
    key: int = 0  # first half of `key`, drawn by the seed and the names of sender and receiver
    outages: tuple[tuple[float, float], ...] = ()  # begin and end of each [s] after the common start
    duration: float = inf  # [s] time after the common start; later nothing is lost or delayed

    @classmethod
    def of(cls, effects: LinkEffects, outages: Sequence[tuple[float, float]], duration: float) -> Conditions:
        """Conditions, still without a key, of a link with these effects."""
        return cls(
            delay=effects.delay_s,
            jitter=effects.jitter_s,
            loss=effects.loss,
            burst=nan if effects.burst is None else effects.burst,
            bandwidth=inf if effects.bandwidth is None else effects.bandwidth,
            queue=QUEUE_S,
            outages=tuple(outages),
            duration=duration,
        )

    @property
    def random(self) -> bool:
        return self.loss > 0.0 or self.jitter > 0.0


class LinkChannel:
    """Carries samples over one link."""

    def __init__(self, conditions: Conditions) -> None:
        self._conditions = conditions
        self.delay, self.jitter = conditions.delay, conditions.jitter  # [s]
        self.dropped = 0  # samples that were lost
        self._enter, self._leave = _thresholds(conditions)
        self._free = -inf  # time at which the link has sent all that it has taken [s]
        # the delay is all that there is
        self.plain = not (conditions.random or conditions.bandwidth < inf or conditions.outages)

    def arrival(self, seq: int, stamp: float, since: float, size: int) -> float:
        """Time at which a sample that sets out at `stamp` [s] gets through; infinity if it is lost. Quiet.

        `since` [s] is the time of `stamp` after the common start; NaN or negative before it is known or over. Before
        the common start, and after the end, no sample is lost and no link is too slow. A run begins only when all
        robots have received their neighbours, and the real network repeats a first pose until it arrives.
        """
        conditions = self._conditions
        if self.plain:
            return stamp + conditions.delay
        begun = since >= -ROUNDING_S and since < conditions.duration - ROUNDING_S
        took, passes = 0.0, True
        if begun and conditions.bandwidth < inf:
            took = max(self._free - stamp, 0.0)
            passes = took <= conditions.queue + ROUNDING_S
            took += 8.0 * size / conditions.bandwidth
            if passes:
                self._free = stamp + took
        if conditions.jitter > 0.0:
            took -= conditions.jitter * log1p(-uniform(conditions.key, seq * USES + JITTER))
        if begun and passes:
            passes = not (conditions.loss > 0.0 and self.loses(seq)) and self._is_up(since, conditions.delay + took)
        if not passes:
            self.dropped += 1
            return inf
        return stamp + (conditions.delay + took)

    def _is_up(self, since: float, takes: float) -> bool:
        """Whether no outage begins or lasts while a sample is on its way."""
        for begin, end in self._conditions.outages:
            if since < end - ROUNDING_S and since + takes > begin - ROUNDING_S:
                return False
        return True

    def loses(self, seq: int) -> bool:
        """Whether the link loses a sample, by its number alone.

        A link is good or bad, and loses a sample that finds it bad (Gilbert, Capacity of a burst-noise channel, Bell
        System Technical Journal 39, 1960). One number u of each sample changes its state. With u below the probability
        of becoming bad the link is bad, with u above one minus the probability of becoming good it is good. With u in
        between it keeps its state, so the last sample with another u decides. The method looks for that sample and
        keeps no state.
        """
        key = self._conditions.key
        enter, leave = self._enter, self._leave
        while True:
            u = uniform(key, seq * USES + LOSS)
            if seq == 0:  # first sample: as often bad as in the long run
                return u < self._conditions.loss
            if u < enter:
                return True
            if u >= leave:
                return False
            seq -= 1


class Channel:
    """Carries samples over several links."""

    def __init__(self, conditions: Sequence[Conditions]) -> None:
        self.links = [LinkChannel(each) for each in conditions]
        # some link has a bandwidth: sizes must be given
        self.limited = any(each.bandwidth < inf for each in conditions)
        # nothing takes time on any link: a sample is received at once, or lost
        self.instant = not (self.limited or any(each.delay or each.jitter for each in conditions))
        # nothing is lost or takes time: there is no need to send
        self.ideal = self.instant and not any(each.loss or each.outages for each in conditions)
        self._flying: list[tuple[float, int, int, Any]] = []
        self._count = 0

    @property
    def dropped(self) -> list[int]:
        """Samples that were lost on each link."""
        return [link.dropped for link in self.links]

    def send(
        self, link: int, sample: object, seq: int, stamp: float, *, start: float = inf, size: int = 0, now: float = -inf
    ) -> None:
        """A sample sets out on a link, at its `stamp` [s].

        `size` is its payload [bytes], needed where bandwidth is limited; `start` [s] is the common start on the clock
        of stamps, infinity or NaN while it is not known. `now` is, at the receiver of a real network, the time of
        reception [s]: the time that it took counts towards the delay.
        """
        arrival = self.links[link].arrival(seq, stamp, stamp - start, size)
        if arrival < inf:
            self.put(link, max(arrival, now), sample)

    def put(self, link: int, arrival: float, sample: object) -> None:
        """A sample is under way on a link, until its `arrival` [s]."""
        self._count += 1
        heappush(self._flying, (arrival, self._count, link, sample))

    def due(self, t: float) -> list[tuple[int, float, Any]]:
        """Samples that get through by `t` [s], in order of arrival: link, arrival [s] and sample."""
        flying, arrived = self._flying, []
        while flying and flying[0][0] <= t + ROUNDING_S:
            arrival, _, link, sample = heappop(flying)
            arrived.append((link, arrival, sample))
        return arrived

    def forget(self, link: int) -> None:
        """Drop the samples under way when the sender of a link is gone: they would look like its return."""
        self._flying = [each for each in self._flying if each[2] != link]
        heapify(self._flying)


def _thresholds(conditions: Conditions) -> tuple[float, float]:
    """Below the first a link is bad, from the second on good, in between as it was: see `LinkChannel.loses`.

    The chain is bad for `burst` samples on average and for a share `loss` of all. Where each sample is lost by itself
    nothing lies between.
    """
    loss, burst = conditions.loss, conditions.burst
    if isnan(burst) or loss >= 1.0:
        return loss, loss
    enter = loss / (burst * (1.0 - loss))
    return enter, max(1.0 - 1.0 / burst, enter)
