"""Advanced publishers and subscribers, made of plain ones, tokens and questions, as those of Zenoh are."""

from __future__ import annotations

import itertools
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import zenoh

from tests.simulated.entities import Publisher, Query, Subscriber
from tests.simulated.kernel import current
from tests.simulated.links import Sample, SourceInfo

if TYPE_CHECKING:
    from tests.simulated.network import Session

HEARTBEAT_S: Final = 0.5  # period in which an advanced publisher repeats the number of a new sample
HISTORY_S: Final = 10.0  # limit of the questions of an advanced subscriber


class AdvancedPublisher(Publisher):
    """A publisher that numbers its samples and answers for the last of them."""

    def __init__(self, session: Session, key: str, mime: object, kept: int) -> None:
        super().__init__(session, key, mime)
        self._cache: deque[Sample] = deque(maxlen=kept)
        self._count = itertools.count()
        self._beating, self._since = False, current().now
        self._place = f"{key}/@adv/pub/{self.id}/_"
        self._queryable = session.declare_queryable(self._place, self._answer)
        self._token = session.declare_token(self._place)

    def put(self, payload: bytes, *, encoding: object = None, **_: object) -> None:
        sample = Sample(self.key, payload, encoding or self._mime, SourceInfo(self.id, next(self._count)))
        self._cache.append(sample)
        if not self._beating:
            self._beating = True
            past = (current().now - self._since) % HEARTBEAT_S
            current().after(HEARTBEAT_S - past, self.session.process.call, self._beat)
        self.session.send(sample, drop=self._drop)

    def undeclare(self) -> None:
        self._token.undeclare()
        self._queryable.undeclare()

    def _beat(self) -> None:
        self._beating = False
        if not self.session.closed:
            number = self._cache[-1].source_info.source_sn
            self.session.send(Sample(self._place, str(number).encode()), drop=True)

    def _answer(self, query: Query) -> None:
        asked = dict(each.partition("=")[::2] for each in query.parameters.split(";"))
        first, _, last = asked.get("_sn", "..").partition("..")
        found = [
            each
            for each in self._cache
            if int(first or 0) <= each.source_info.source_sn <= int(last or each.source_info.source_sn)
        ]
        with query:
            for each in found[-int(asked.get("_max", 0)) :]:
                query.send(each)


class Source:
    """A publisher as an advanced subscriber knows it: number of the last sample, and samples that wait for others."""

    def __init__(self) -> None:
        self.last: int | None = None
        self.questions = 0
        self.waiting: dict[int, Sample] = {}


class AdvancedSubscriber:
    """A subscriber that asks for the last `kept` samples of each publisher, and for those that were lost."""

    def __init__(self, session: Session, key: str, handler: Any, kept: int) -> None:
        self._session, self._kept = session, kept
        self.handler = Subscriber(session, key, handler, "")
        self._sources: dict[str, Source] = {}
        self._first = 1  # pending questions for the first samples
        self._parts = [session.declare_subscriber(key, self._take)]
        self._ask(f"{key}/@adv/pub/**", f"_max={kept}", None)
        self._parts.append(session.watch_tokens(f"{key}/@adv/pub/**", self._discover, history=True))
        self._parts.append(session.declare_subscriber(f"{key}/@adv/pub/**", self._hear))

    def undeclare(self) -> None:
        for each in self._parts:
            each.undeclare()

    def _ask(self, key: str, parameters: str, source: Source | None) -> None:
        def done() -> None:
            if source is None:
                self._first -= 1
            else:
                source.questions -= 1
            for each in self._sources.values() if source is None else (source,):
                self._flush(each)

        self._session.get(f"{key}?{parameters}", timeout=HISTORY_S).then(self._sort, done)

    def _discover(self, sample: Sample) -> None:
        """A publisher has appeared, or is back."""
        if sample.kind == zenoh.SampleKind.PUT:
            source = self._source(sample.key_expr)
            source.questions += 1
            self._ask(sample.key_expr, f"_max={self._kept}", source)

    def _hear(self, beat: Sample) -> None:
        source, number = self._source(beat.key_expr), int(beat.payload)
        if (source.last is None or number > source.last) and number not in source.waiting:
            source.questions += 1
            self._ask(beat.key_expr, f"_sn={'' if source.last is None else source.last + 1}..{number}", source)

    def _source(self, place: str) -> Source:
        zid, number = place.split("/@adv/pub/")[1].split("/")[:2]
        return self._known(f"{zid}/{number}")

    def _known(self, name: str) -> Source:
        if (source := self._sources.get(name)) is None:
            source = self._sources[name] = Source()
        return source

    def _take(self, sample: Sample) -> None:
        self._sort(sample)
        if sample.source_info is None:
            return
        name = sample.source_info.source_id
        source = self._sources[name]
        if source.waiting and not source.questions:
            source.questions += 1
            self._ask(f"{sample.key_expr}/@adv/pub/{name}/**", f"_sn={(source.last or 0) + 1}..", source)

    def _sort(self, sample: Sample) -> None:
        """Pass a sample on, keep it until those before it are here, or drop it as a repetition."""
        if sample.source_info is None:
            self.handler.push(sample)
            return
        number = sample.source_info.source_sn
        source = self._known(sample.source_info.source_id)
        if self._first:
            source.waiting[number] = sample
        elif source.last is not None and number != source.last + 1:
            if number > source.last:
                source.waiting[number] = sample
        else:
            self._pass(source, sample)
            while (following := source.waiting.pop((source.last or 0) + 1, None)) is not None:
                self._pass(source, following)

    def _pass(self, source: Source, sample: Sample) -> None:
        source.last = sample.source_info.source_sn
        self.handler.push(sample)

    def _flush(self, source: Source) -> None:
        """All questions are answered: samples that are still missing are lost."""
        if not self._first and not source.questions:
            waiting, source.waiting = source.waiting, {}
            for number in sorted(waiting):
                if source.last is None or number > source.last:
                    self._pass(source, waiting[number])
