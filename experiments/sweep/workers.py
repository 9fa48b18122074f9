"""Workers of a sweep: a process for each core of this machine, or the workers of a dask scheduler."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

import msgspec

from agents.errors import ExplainedError
from experiments.cores import KILLED, cores, pool
from experiments.sweep.runs import WorkResult, fly

ADDRESS: Final = re.compile(r"(tcp|tls)://[^\s/]+:[0-9]{1,5}")
ANSWER_S: Final = 10.0  # time without an answer after which a scheduler counts as absent


@dataclass(frozen=True)
class Work:
    """Some seeds of one cell: an experiment as JSON, its digest, and that of the code to run it with."""

    cell: str
    case: bytes
    seeds: tuple[int, ...]
    code: str
    plain_s: float  # time that all runs of this case in the sweep would take in plain Python, about


@dataclass(frozen=True)
class Workers:
    """Runs work on an executor; without one, in this process."""

    executor: Executor | None
    count: Callable[[], int]  # works that run at once, now
    place: str
    failures: tuple[type[Exception], ...] = ()  # errors of the executor
    reason: Callable[[Exception], str] = str  # words for a failure

    def done(self, works: Sequence[Work]) -> Iterator[tuple[Work, WorkResult]]:
        """Runs all works, and yields each when it is done, in any order.

        Raises ExplainedError if the workers are lost, or have other code.
        """
        if self.executor is None:
            for work in works:
                yield work, self._checked(fly(work.case, work.seeds, work.code, work.plain_s))
            return
        # processes of a pool are started as the work comes in
        works_by_future = {
            self.executor.submit(fly, work.case, work.seeds, work.code, work.plain_s): work for work in works
        }
        try:
            for future in as_completed(works_by_future):
                yield works_by_future[future], self._checked(future.result())
        except self.failures as error:
            raise ExplainedError(f"{self.reason(error)}; what is done is kept: give the same command again") from None
        finally:
            for future in works_by_future:
                future.cancel()

    def _checked(self, answer: bytes) -> WorkResult:
        outcome = msgspec.json.decode(answer, type=WorkResult)
        if outcome.stranger:
            raise ExplainedError(
                f"{self.place} has another version of zenpark, of a plug-in or of numpy than this process "
                f"({outcome.stranger}), so its runs would not be the same; install the same everywhere (or, if the "
                "code has just been changed, give the command again)"
            )
        return outcome


def workers(scheduler: str | None, processes: int | None) -> AbstractContextManager[Workers]:
    """The workers of a scheduler, if one is named, else of this machine.

    The end of the block takes back what no worker has begun; those of a scheduler finish the batch that they are at.
    Raises ExplainedError at the beginning of the block, if a scheduler is not there, or has no worker.
    """
    return _local(processes) if scheduler is None else _cluster(scheduler)


@contextmanager
def _local(processes: int | None) -> Iterator[Workers]:
    """Processes on this machine, one for each core if no number is given; with 1 the work is done in this one."""
    count = cores() if processes is None else processes
    with pool(count) as made:
        at_once = 1 if made is None else count
        words = f"a process of the sweep {KILLED} (then: fewer --processes)"
        yield Workers(made, lambda: at_once, "this machine", (BrokenProcessPool,), lambda _: words)


@contextmanager
def _cluster(address: str) -> Iterator[Workers]:
    """The workers of a dask scheduler, wherever they are; work of one that dies is given to another one."""
    try:
        distributed: Any = import_module("distributed")  # an extra
    except ImportError:
        raise ExplainedError(
            "--scheduler needs a library that is an extra: ./zenpark install distributed, or "
            "pip install -e '.[cluster]'"
        ) from None
    if not ADDRESS.fullmatch(address):
        raise ExplainedError(f"--scheduler {address}: this is no address; write one as tcp://192.0.2.7:8786")
    with ExitStack() as stack:
        client: Any = None
        try:
            client = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
            stack.callback(client.close, timeout=ANSWER_S)
            client.wait_for_workers(1, timeout=ANSWER_S)
        except OSError as error:  # time-outs are
            why = "has no workers" if client is not None else f"does not answer ({_first_line(error)})"
            how = f"`dask scheduler` starts one, and `dask worker {address}` on each machine its workers"
            raise ExplainedError(f"the scheduler at {address} {why}: {how}") from None

        def threads() -> int:
            return max(1, sum(map(int, client.nthreads().values())))

        def reason(error: Exception) -> str:
            if isinstance(error, distributed.KilledWorker):
                return f"workers died of the same work again and again, for want of memory? ({_first_line(error)})"
            return f"the scheduler at {address} is lost, start it again ({_first_line(error)})"

        failures = (distributed.KilledWorker, CancelledError, OSError)
        yield Workers(client.get_executor(pure=False, retries=1), threads, "a worker", failures, reason)


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
