"""Entities of a simulated session: subscribers, tokens, publishers; questions with their replies."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Self

import zenoh

from tests.simulated.kernel import STEPS, Process, Waiters, current
from tests.simulated.links import Id, Link, Payload, Sample

if TYPE_CHECKING:
    from tests.simulated.network import Question, Router, Session


class Left:
    """Answers that are still to come, and what happens after the last."""

    def __init__(self, count: int, after: Callable[[], object]) -> None:
        self._count, self._after = count, after

    def end(self) -> None:
        self._count -= 1
        if self._count <= 0:
            self._after()


class Subscriber:
    """A subscriber of samples or tokens, or a queryable: what arrives waits in a ring, or goes to a callback."""

    def __init__(self, session: Session, key: str, handler: Any, table: str) -> None:
        self.session, self.key, self.table, self.handler = session, key, table, self
        depth = getattr(handler, "depth", None)
        self._waiting: deque[Any] = deque(maxlen=depth)
        self._kernel = current()
        self.push: Callable[[Any], object] = handler if callable(handler) else self._waiting.append

    def try_recv(self) -> Any:
        kernel = self._kernel
        kernel.steps += 1
        if kernel.steps > STEPS:
            raise kernel.spins()
        return self._waiting.popleft() if self._waiting else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.undeclare()

    def undeclare(self) -> None:
        self.session.drop(self)


class Token:
    """A liveliness token."""

    def __init__(self, session: Session, key: str) -> None:
        self.session, self.key = session, key

    def undeclare(self) -> None:
        self.session.withdraw(self)


class Publisher:
    def __init__(self, session: Session, key: str, mime: object, *, drop: bool = True, express: bool = False) -> None:
        self.session, self.key, self._mime, self._drop, self._express = session, key, mime, drop, express
        self.id = Id(session.zid(), next(session.network.numbers))

    def put(self, payload: bytes, *, encoding: object = None, source_info: Any = None, **_: object) -> None:
        sample = Sample(self.key, payload, encoding or self._mime, source_info)
        self.session.send(sample, drop=self._drop, express=self._express)

    def undeclare(self) -> None:
        pass


class Replies:
    """Replies to a question, to be polled or waited for; a question that is lost ends as one that is answered."""

    def __init__(self, limit_s: float, process: Process) -> None:
        self.over = False
        self._items: deque[SimpleNamespace] = deque()
        self._waiters = Waiters()
        self._call: Callable[[Sample], object] | None = None
        self._after: Callable[[], object] | None = None
        current().after(limit_s, process.call, self._expire)

    def then(self, call: Callable[[Sample], object], after: Callable[[], object]) -> None:
        """Give each good reply to a function, and call another at the end."""
        self._call, self._after = call, after
        if self.over:
            after()

    def add(self, sample: Sample, failed: bool = False) -> None:
        if self.over:
            return
        if self._call is not None:
            if not failed:
                self._call(sample)
            return
        self._items.append(SimpleNamespace(ok=None if failed else sample, err=sample if failed else None))
        self._waiters.wake()

    def finish(self) -> None:
        if not self.over:
            self.over = True
            if self._after is not None:
                self._after()
            self._waiters.wake()

    def _expire(self) -> None:
        self.add(Sample("", b"Timeout", "text/plain"), failed=True)
        self.finish()

    def try_recv(self) -> Any:
        current().step()
        if self._items:
            return self._items.popleft()
        if self.over:
            raise zenoh.ZError("simulated: no more replies")
        return None

    def __iter__(self) -> Iterator[Any]:
        while True:
            if self._items:
                yield self._items.popleft()
            elif self.over:
                return
            else:
                self._waiters.wait()


class Query:
    """A question at the one who answers; it ends with its `with` block."""

    def __init__(self, session: Session, link: Link, question: Question, origin: Router, left: Left) -> None:
        self._session, self._link, self._question, self._origin, self._left = session, link, question, origin, left
        self.key_expr, self.parameters, self.encoding = question.key, question.parameters, question.mime
        self.payload = None if question.payload is None else Payload(question.payload)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.drop()

    def drop(self) -> None:
        left, self._left = self._left, Left(2, lambda: None)
        left.end()

    def reply(self, key: object, payload: bytes, encoding: object = "", **_: object) -> None:
        self.send(Sample(str(key), payload, encoding))

    def reply_err(self, payload: bytes, encoding: object = "", **_: object) -> None:
        self.send(Sample("", payload, encoding), failed=True)

    def send(self, sample: Sample, *, failed: bool = False) -> None:
        router: Any = self._link.far
        self._link.send(self._session, router.relay, self._origin, self._origin.reply, self._question, sample, failed)
