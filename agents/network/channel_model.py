"""Channel model: delay, jitter, loss in bursts or alone, limited bandwidth and outages, on each link by itself.

The virtual clock sends through it, and so does the receiver of a real network: samples that have arrived wait here
until the model lets them through. The fate of a sample follows from the seed, the names at the two ends of its link and
its running number, so that both lose the same samples. docs/networks.md has the formulas.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from agents.arrays import Array, Index, Mask, PoseTable, Positive, Share, every, some

Delay = Annotated[float, Meta(ge=0, le=60)]
AtLeastOne = Annotated[float, Meta(ge=1)]
Words = NDArray[np.uint64]
Counter = NDArray[np.integer] | int

# SplitMix64 (Steele, Lea and Flood, Fast splittable pseudorandom number generators, OOPSLA 2014) is a counter with an
# odd step, and a mixer behind it: here the counter is given, not kept.
_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_MIXERS: Final = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_SHIFTS: Final = (np.uint64(30), np.uint64(27), np.uint64(31))
_SPARE: Final = np.uint64(11)  # bits that a float has no place for


def key(seed: int, *names: str) -> int:
    """A key of 64 bits: another one for another seed, or other names, or the same ones in another order."""
    text = "\0".join([str(seed), *names])
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def uniform(keys: Words, counter: Counter) -> Array:
    """Numbers in [0, 1), multiples of 2⁻⁵³: one for each key and counter, whose shapes are broadcast."""
    first, second, last = _SHIFTS
    word = keys + _STEP * np.asarray(counter, dtype=np.int64).astype(np.uint64)  # wraps, as it must
    word = (word ^ (word >> first)) * _MIXERS[0]
    word = (word ^ (word >> second)) * _MIXERS[1]
    word ^= word >> last
    return np.asarray((word >> _SPARE) * 2.0**-53)


ROUNDING_S: Final = 2e-6  # stamps on the wire are whole microseconds, and sums of binary fractions miss the ticks
LOSS, JITTER, USES = 0, 1, 2  # each sample has so many numbers of its own
SPAN: Final = 64  # so many samples before one are looked at together for what state it found its link in


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
    queue_s: Annotated[
        Delay, Meta(description="a sample that would wait longer for its link to be free is dropped [s]")
    ] = 0.5


@dataclass(frozen=True)
class Outage:
    """Outage of `links` (E,) from `begin` to `end` [s] after the common start."""

    begin: float
    end: float
    links: Mask


@dataclass(frozen=True)
class Conditions:
    """Conditions of links (E): the columns of their `LinkEffects`, keys, outages and duration."""

    delay: Array  # (E,) [s]
    jitter: Array  # (E,) [s]
    loss: Array  # (E,) share
    burst: Array  # (E,) mean length, at least 1 / (1 - loss); NaN: each sample is lost or not by itself
    bandwidth: Array  # (E,) [bit/s], infinity: no limit
    queue: Array  # (E,) [s]
    key: Words  # (E,) of `key`, from the seed and the names of sender and receiver
    outages: tuple[Outage, ...] = ()
    duration: float = np.inf  # [s] from the common start; later nothing is lost or delayed

    def __len__(self) -> int:
        return len(self.delay)

    @classmethod
    def ideal(cls, links: int) -> Conditions:
        """Nothing is lost, nothing takes time."""
        zero, never = np.zeros(links), np.full(links, np.inf)
        return cls(zero, zero, zero, np.full(links, np.nan), never, never, np.zeros(links, dtype=np.uint64))

    @classmethod
    def from_effects(
        cls, effects: Sequence[LinkEffects], which: Index, outages: Sequence[Outage], duration: float
    ) -> Conditions:
        """Conditions, still without keys, of links (E) that have `effects[which]`, `which` (E,)."""

        def column(name: str, absent: float = np.nan) -> Array:
            values = [getattr(each, name) for each in effects]
            return np.array([absent if value is None else value for value in values], dtype=float)[which]

        return cls(
            delay=column("delay_s"),
            jitter=column("jitter_s"),
            loss=column("loss"),
            burst=column("burst"),
            bandwidth=column("bandwidth", np.inf),
            queue=column("queue_s"),
            key=np.zeros(len(which), dtype=np.uint64),
            outages=tuple(outages),
            duration=duration,
        )

    @classmethod
    def side_by_side(cls, parts: Sequence[Conditions]) -> Conditions:
        """Those of several repetitions, which have the same outages each on its own links."""
        names = [field.name for field in fields(cls) if field.name not in {"outages", "duration"}]
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        outages = [
            Outage(first.begin, first.end, np.concatenate([first.links, *(each.links for each in others)]))
            for first, *others in zip(*(part.outages for part in parts), strict=True)
        ]
        return cls(**columns, outages=tuple(outages), duration=parts[0].duration)


class Channel:
    """Carries samples over links (E)."""

    def __init__(self, conditions: Conditions) -> None:
        self._conditions = conditions
        self.dropped: Index = np.zeros(len(conditions), dtype=np.intp)  # (E,) samples that were lost
        delay = conditions.delay
        self._delay: Array | float = delay
        if len(delay) and (delay == delay[0]).all():
            self._delay = float(delay[0])  # one number for all costs nothing to look up
        self._jitters = bool(conditions.jitter.any())
        self._loses = bool(conditions.loss.any())
        # some link has a bandwidth: sizes must be given
        self.limited = bool(np.isfinite(conditions.bandwidth).any())
        self._plain = not (self._jitters or self._loses or self.limited or conditions.outages)
        # nothing takes time on any link: a sample is received at once, or lost
        self.instant = not (conditions.delay.any() or self._jitters or self.limited)
        self.ideal = self._plain and self.instant  # nothing is lost or takes time: there is no need to send
        self._in_order = isinstance(self._delay, float) and not (self._jitters or self.limited)
        self._enter, self._leave = _thresholds(conditions)
        self._free = np.full(len(conditions), -np.inf)  # when each link has sent all that it has taken
        self._flying: list[PoseTable] = []

    def send(self, poses: PoseTable, *, start: Array | float = np.inf, now: float = -np.inf) -> None:
        """Poses (M) set out, on each link at most one, at their `stamp`; their arrival follows.

        Before the common start nothing is lost and no link is too slow: no run begins before all robots have received
        their neighbours, and the real network repeats a first pose until it arrives. Nor is anything after the end.

        `poses` have their sizes, `bytes`, on links of limited bandwidth; `start` [s] is on the clock of stamps, (M,) or
        for all, infinity or NaN while it is not known. `now` is, at the receiver of a real network, the time of
        reception [s]: the time that it took counts towards the delay.
        """
        link, stamp = poses.link, poses.stamp
        delay = self._delay if isinstance(self._delay, float) else self._delay[link]
        if self._plain:
            arrival = stamp + delay
        else:
            passes, took = self._fates(poses, stamp - start)
            arrival = stamp + (delay + took)
            if not every(passes):
                self.dropped[link[~passes]] += 1
                poses, arrival = poses.take(passes), arrival[passes]
        if now > -np.inf:
            arrival, self._in_order = np.maximum(arrival, now), False  # senders are asked one after the other
        if len(arrival):
            self._flying.append(msgspec.structs.replace(poses, arrival=arrival))

    def due(self, t: float) -> PoseTable | None:
        """Poses that get through by `t` [s], in order of arrival."""
        if not self._flying:
            return None
        pool = self._pool()
        here = pool.arrival <= t + ROUNDING_S
        if every(here):
            self._flying = []
            return pool if self._in_order else pool.take(np.argsort(pool.arrival, kind="stable"))
        self._flying = [pool.take(~here)]
        if not some(here):
            return None
        arrived = pool.take(here)
        return arrived.take(np.argsort(arrived.arrival, kind="stable"))

    def forget(self, link: Index) -> None:
        """Samples under way on links whose sender is gone never arrive: they would look like its return."""
        if not self._flying:
            return
        pool = self._pool()
        forgotten = np.isin(pool.link, link)
        self._flying = [] if every(forgotten) else [pool.take(~forgotten)]

    def lost(self, link: Index, seq: Index) -> Mask:
        """Which samples (M,) the links lose, by their numbers alone.

        A link is good or bad, and loses a sample that finds it bad (Gilbert, Capacity of a burst-noise channel, Bell
        System Technical Journal 39, 1960). One number u of each sample moves it: below the probability of becoming bad
        it is bad then, above one less that of becoming good it is good, whatever it was; in between it stays as it was,
        so that the last sample with another number decides. That one is looked for, and no state is kept.
        """
        key = self._conditions.key[link]
        enter, leave = self._enter[link], self._leave[link]
        u = uniform(key, seq * USES + LOSS)
        bad: Mask = u < enter
        asked = np.flatnonzero(~bad & (u < leave))
        back = np.arange(1, SPAN + 1)
        while len(asked):
            number = seq[asked][:, None] - back
            u = uniform(key[asked][:, None], number * USES + LOSS)
            first = number == 0  # before the first sample: as often bad as in the long run
            loss = self._conditions.loss[link[asked]][:, None]
            found = u < np.where(first, loss, enter[asked][:, None])
            decides = found | (u >= np.where(first, loss, leave[asked][:, None]))
            one = decides.argmax(axis=1)
            row = np.arange(len(asked))
            bad[asked] = found[row, one]
            asked, back = asked[~decides[row, one]], back + SPAN
        return bad

    def _fates(self, poses: PoseTable, since: Array) -> tuple[Mask, Array]:
        """Which poses pass (M,), and what their way takes beyond the delay if they do (M,) [s]."""
        conditions, link, seq = self._conditions, poses.link, poses.seq
        begun: Mask = (since >= -ROUNDING_S) & (since < conditions.duration - ROUNDING_S)
        passes, took = np.ones(len(link), dtype=bool), np.zeros(len(link))
        if self.limited:
            took, passes = self._queued(poses, begun)
        if self._jitters:
            took = took - conditions.jitter[link] * np.log1p(-uniform(conditions.key[link], seq * USES + JITTER))
        if self._loses:
            passes &= ~(begun & self.lost(link, seq))
        if conditions.outages:
            there = since + (conditions.delay[link] + took)
            for outage in conditions.outages:
                inside = (since < outage.end - ROUNDING_S) & (there > outage.begin - ROUNDING_S)
                passes &= ~(begun & inside & outage.links[link])
        return passes, took

    def _queued(self, poses: PoseTable, begun: Mask) -> tuple[Array, Mask]:
        """Times that poses wait for those before them and are being sent (M,) [s]; which of them are taken (M,)."""
        if poses.bytes is None:
            raise ValueError("links of limited bandwidth need the sizes of their samples")
        conditions, link = self._conditions, poses.link
        waits = np.where(begun, np.maximum(self._free[link] - poses.stamp, 0.0), 0.0)
        taken: Mask = waits <= conditions.queue[link] + ROUNDING_S
        waits = waits + np.where(begun, 8.0 * poses.bytes / conditions.bandwidth[link], 0.0)
        occupies = begun & taken
        self._free[link[occupies]] = (poses.stamp + waits)[occupies]
        return waits, taken

    def _pool(self) -> PoseTable:
        if len(self._flying) == 1:
            return self._flying[0]
        return PoseTable.joined(self._flying)


def _thresholds(conditions: Conditions) -> tuple[Array, Array]:
    """Below the first a link is bad, from the second on good, in between as it was (E,): see `Channel.lost`.

    The chain is bad for `burst` samples on average and for a share `loss` of all. Where each sample is lost by itself
    nothing lies between.
    """
    loss, burst = conditions.loss, conditions.burst
    alone = np.isnan(burst) | (loss >= 1.0)
    kept = np.where(alone, 1.0, 1.0 - loss)
    length = np.where(alone, 1.0, burst)
    enter = np.where(alone, loss, loss / (length * kept))
    return enter, np.where(alone, loss, np.maximum(1.0 - 1.0 / length, enter))
