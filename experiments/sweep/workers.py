"""Who runs the cells of a sweep: a process for each core of this machine, or the workers of a dask scheduler."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from types import TracebackType
from typing import Any, Final, Protocol, Self

import msgspec

from experiments.sweep.runs import Outcome, fly

ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
ADDRESS: Final = re.compile(r"(tcp|tls)://[^\s/]+:[0-9]{1,5}")
ANSWER_S: Final = 10.0  # a scheduler that does not answer for so long is not there


class SweepError(RuntimeError):
    """A sweep that cannot go on, with the remedy; what is done is kept."""


@dataclass(frozen=True)
class Work:
    """Some seeds of one cell: an experiment as JSON, its digest, and that of the code to run it with."""

    cell: str
    case: bytes
    seeds: tuple[int, ...]
    code: str


class Workers(Protocol):
    """A context manager that runs work somewhere.

    Attributes:
        count: How many works are done at once.
    """

    @property
    def count(self) -> int: ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends at once whatever is under way."""

    def done(self, works: Sequence[Work]) -> Iterator[tuple[Work, Outcome]]:
        """Does all of it, and tells of each when it is done, in any order.

        Raises:
            SweepError: If the workers are gone, or are of another kind.
        """
        ...


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Processes:
    """Processes on this machine; with `count` 1 the work is done in this one. Implements `Workers`."""

    def __init__(self, count: int | None = None) -> None:
        """One for each core if no number is given."""
        self.count = cores() if count is None else count
        self._pool: ProcessPoolExecutor | None = None
        self._others = frozenset[Any]()

    def __enter__(self) -> Self:
        if self.count > 1:
            self._others = frozenset(multiprocessing.active_children())
            context = multiprocessing.get_context("spawn")  # a fork would take our threads' locks along
            self._pool = ProcessPoolExecutor(self.count, context, initializer=_prepared)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            for child in multiprocessing.active_children():
                if child not in self._others:
                    child.terminate()
            # once, and waiting: a thread of the pool that still runs when the interpreter ends may print a traceback
            self._pool.shutdown(cancel_futures=True)

    def done(self, works: Sequence[Work]) -> Iterator[tuple[Work, Outcome]]:
        """See `Workers.done`."""
        if self._pool is None:
            for work in works:
                yield work, _checked(fly(work.case, work.seeds, work.code), "this machine")
            return
        waiting: dict[Future[bytes], Work] = {}
        with _environment(ONE_THREAD):  # the processes are started as the work comes in
            for work in works:
                waiting[self._pool.submit(fly, work.case, work.seeds, work.code)] = work
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                try:
                    outcome = _checked(future.result(), "this machine")
                except BrokenProcessPool:
                    raise SweepError(
                        "a process of the sweep was killed, perhaps for want of memory; what is done is kept: give the "
                        "same command again, with fewer --processes"
                    ) from None
                yield waiting.pop(future), outcome


class Cluster:
    """The workers of a dask scheduler, wherever they are. Implements `Workers`."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._client: Any = None
        self._futures: list[Any] = []

    @property
    def count(self) -> int:
        """Threads of all workers, now."""
        return max(1, sum(int(threads) for threads in self._client.nthreads().values()))

    def __enter__(self) -> Self:
        """Connects.

        Raises:
            SweepError: If dask.distributed is not installed, nobody answers, or there is no worker.
        """
        try:
            distributed: Any = import_module("distributed")  # an extra
        except ImportError:
            raise SweepError(
                "--scheduler needs a library that is an extra: ./zenpark install distributed, or "
                "pip install -e '.[cluster]'"
            ) from None
        if not ADDRESS.fullmatch(self._address):
            raise SweepError(f"--scheduler {self._address}: this is no address; write one as tcp://192.0.2.7:8786")
        how = f"`dask scheduler` starts one, and `dask worker {self._address}` on each machine its workers"
        try:
            self._client = distributed.Client(self._address, timeout=ANSWER_S, set_as_default=False)
            self._client.wait_for_workers(1, timeout=ANSWER_S)
        except OSError as error:  # time-outs are
            self._close()
            why = "has no workers" if self._client is not None else f"does not answer ({_first_line(error)})"
            raise SweepError(f"the scheduler at {self._address} {why}: {how}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._client is not None and self._futures:
            self._client.cancel(self._futures)
        self._close()

    def done(self, works: Sequence[Work]) -> Iterator[tuple[Work, Outcome]]:
        """See `Workers.done`; work of a worker that dies is given to another one."""
        distributed: Any = import_module("distributed")
        by_future = {
            self._client.submit(fly, work.case, work.seeds, work.code, pure=False, retries=1): work for work in works
        }
        self._futures = list(by_future)
        for future in distributed.as_completed(self._futures, loop=self._client.loop):
            try:
                answer = future.result()
            except distributed.KilledWorker as error:
                raise SweepError(
                    f"workers died of the same work again and again, perhaps for want of memory ({_first_line(error)});"
                    " what is done is kept: give the same command again"
                ) from None
            except (distributed.comm.CommClosedError, distributed.client.FutureCancelledError, OSError) as error:
                raise SweepError(
                    f"the scheduler at {self._address} is gone ({_first_line(error)}); what is done is kept: start it "
                    "again, and give the same command"
                ) from None
            yield by_future[future], _checked(answer, "a worker")
            future.release()
        self._futures = []

    def _close(self) -> None:
        if self._client is not None:
            self._client.close(timeout=ANSWER_S)


def workers(scheduler: str | None, processes: int | None) -> Workers:
    """Those of a scheduler, if one is named, else of this machine."""
    return Processes(processes) if scheduler is None else Cluster(scheduler)


def _checked(answer: bytes, where: str) -> Outcome:
    outcome = msgspec.json.decode(answer, type=Outcome)
    if outcome.stranger:
        raise SweepError(
            f"{where} has another version of zenpark, of a plug-in or of numpy than this process ({outcome.stranger}), "
            "so its runs would not be the same; install the same everywhere (or, if the code has just been changed, "
            "give the command again)"
        )
    return outcome


def _prepared() -> None:
    """In each process: Ctrl-C is the sweep's, and nobody outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Variables for processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
