"""Marks of a course: what groups hand in, judged over seeds that they do not know.

Each exercise of a group is flown and judged in a process of its own, with the experiment, the criteria and the metrics
of the course. It runs no code of the group: stand-ins for its laws and triggers ask walled processes what the robots do
next, see `experiments.course.stand_ins`. It says its result by a pipe at its end: one that ends otherwise has not
passed. However the marking ends, a guard ends these processes with it.
"""

from __future__ import annotations

import os
import resource
import selectors
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

import msgspec

from agents.errors import ExplainedError
from experiments.check.check import check
from experiments.cores import cores
from experiments.course.exercises import Course, CourseError, Exercise, read_models, write
from experiments.course.stand_ins import LEARNED, company
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.file.text import content
from experiments.metrics.criteria import judge
from experiments.metrics.metric import OF_LAW
from experiments.metrics.results import CaseMetrics
from experiments.report.verdict import criteria_met
from experiments.run import simulate_seeds

SOLUTION: Final = "(solution)"  # name of the course's own files among the groups
LONGEST: Final = 1 << 20  # longest answer [bytes]
MOST_FILES: Final = 1 << 16  # largest number of an open file
FEW: Final = 3  # printed errors of a check


class Allowance(NamedTuple):
    """Allowance of the process that marks an exercise of a group."""

    cpu_s: int = 60  # computing time of each of its processes [s]; twice that on the clock for all
    memory: int = 1 << 30  # memory beside that of zenpark itself [bytes]
    file: int = 16 << 20  # largest file, and output [bytes]


DEFAULT: Final = Allowance()


class Mark(msgspec.Struct, frozen=True):
    """An exercise of a group: how many criteria are met by all seeds, and why the others are not."""

    group: str
    exercise: str
    met: int = 0
    of: int = 0  # number of criteria; 0 if nothing was handed in
    words: list[str] = []

    @property
    def passed(self) -> bool:
        """Whether all criteria are met."""
        return 0 < self.of == self.met


class _Work(NamedTuple):
    """Files of a group for an exercise."""

    group: str
    exercise: Exercise
    texts: Mapping[str, str]  # texts by the names of their files
    models: Mapping[str, bytes]  # likewise, learned models
    fault: str = ""  # why they cannot be read

    def failed(self, *words: str) -> Mark:
        """The mark of one that meets no criterion."""
        return Mark(self.group, self.exercise.name, 0, self.exercise.criteria, [*words])


class _Process(NamedTuple):
    number: int
    work: _Work
    until: float  # latest end on the monotonic clock [s]
    said: bytearray


def marks(
    course: Course,
    exercises: Sequence[Exercise],
    groups: Sequence[Path],
    seeds: Sequence[int],
    limits: Allowance = DEFAULT,
) -> Iterator[Mark]:
    """Marks of the course's own solution, then of the groups, each as it is ready.

    Args:
        exercises: Those that are marked, as many processes at a time as there are cores.
        groups: Folders with the files that were filled in.

    Raises:
        CourseError: For a group that is no folder, two of one name, and a criterion that a group could answer itself.
    """
    for each in exercises:
        _refuse_own_judges(each)
    if missing := next((folder for folder in groups if not folder.is_dir()), None):
        raise CourseError(f"{missing} is no folder; give one for each group")
    names = Counter([SOLUTION, *(folder.resolve().name for folder in groups)])
    if twice := next((name for name, times in names.items() if times > 1), None):
        raise CourseError(f"two groups are named {twice}; give their folders other names")
    works = [_Work(SOLUTION, each, course.solved, course.models) for each in exercises]
    works += [_handed_in(each, folder.resolve()) for folder in groups for each in exercises]
    running: dict[int, _Process] = {}  # processes by their pipes
    with (
        tempfile.TemporaryDirectory(prefix="zenpark-mark-") as folder,
        selectors.DefaultSelector() as answers,
        _guarded() as guard,
    ):
        try:
            for number, work in enumerate(works):
                if work.fault or not work.texts:
                    yield work.failed(work.fault) if work.fault else Mark(work.group, work.exercise.name)
                    continue
                while len(running) >= (cores()):
                    yield from _ended(running, answers, limits, guard)
                place = Path(folder) / str(number)
                pipe, process = _begun(work, partial(_mark, course, work, seeds, place, limits), place, limits, guard)
                running[pipe] = process
                answers.register(pipe, selectors.EVENT_READ)
            while running:
                yield from _ended(running, answers, limits, guard)
        finally:
            for pipe, process in running.items():
                _end(pipe, process, guard)


def _refuse_own_judges(exercise: Exercise) -> None:
    """Raises CourseError for an exercise with criteria that judge what the law of the group says of itself."""
    for number, criterion in enumerate(exercise.posed.get("criteria", ()), 1) if exercise.laws else ():
        metric = criterion.get("metric", OF_LAW)
        if metric.startswith(OF_LAW) or metric.partition(":")[0] in exercise.laws:
            said = criterion.get("measure", metric)
            raise CourseError(
                f"{exercise.file}: criterion {number} judges {said!r}, which the law of the group says of itself; "
                "judge a metric of true places, from a file without blanks (docs/teaching.md)"
            )


@contextmanager
def _guarded() -> Iterator[int]:
    """A process that ends those of the groups when this one is gone; yields its pipe, see `_guard`."""
    reading, writing = os.pipe()
    number = os.fork()
    if number == 0:
        _guard(reading)
    os.close(reading)
    try:
        yield writing
    finally:
        os.close(writing)
        os.waitpid(number, 0)


def _guard(pipe: int) -> NoReturn:
    """Read numbers of process groups from a pipe, negative ones of those that ended; end the others at its end."""
    end = os._exit
    try:
        os.setsid()  # a Ctrl-C of the terminal is not for it
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(each, signal.SIG_IGN)
        quiet = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):  # a reader of the output waits for no guard
            os.dup2(quiet, number)
        os.closerange(3, pipe)
        os.closerange(pipe + 1, MOST_FILES)
        groups = set[int]()
        with os.fdopen(pipe, "rb") as lines:
            for line in lines:
                if (number := int(line)) > 0:
                    groups.add(number)
                else:
                    groups.discard(-number)
        for number in groups:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(number, signal.SIGKILL)
    finally:
        end(0)


def _handed_in(exercise: Exercise, folder: Path) -> _Work:
    names = [name for name in exercise.parts if (folder / name).is_file()]  # a pipe would be waited for
    try:
        texts = {name: content(folder / name, name) for name in names}
        return _Work(folder.name, exercise, texts, read_models(folder))
    except (DocumentError, OSError) as error:
        return _Work(folder.name, exercise, {}, {}, str(error))


def _begun(work: _Work, task: Callable[[], Mark], folder: Path, limits: Allowance, guard: int) -> tuple[int, _Process]:
    """A process that does a task in limits, and the pipe by which it says the mark."""
    sys.stdout.flush()
    sys.stderr.flush()
    folder.mkdir()
    reading, writing = os.pipe()
    until = time.monotonic() + 2 * limits.cpu_s
    number = os.fork()
    if number == 0:
        _do(task, folder, writing, limits, guard)
    os.close(writing)
    return reading, _Process(number, work, until, bytearray())


def _do(task: Callable[[], Mark], folder: Path, pipe: int, limits: Allowance, guard: int) -> NoReturn:
    """Do a task in this process, which was forked for it and ends with it."""
    end, code = os._exit, 1
    try:
        os.setsid()
        os.write(guard, b"%d\n" % os.getpid())
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.SIG_DFL)
        os.chdir(folder)
        os.environ["ZENPARK_CACHE_DIR"] = str(folder / "cache")
        output = os.open("output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for number in (1, 2):
            os.dup2(output, number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.closerange(3, pipe)
        os.closerange(pipe + 1, MOST_FILES)
        resource.setrlimit(resource.RLIMIT_CPU, (limits.cpu_s, limits.cpu_s + 1))
        resource.setrlimit(resource.RLIMIT_FSIZE, (limits.file, limits.file))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError):  # a system without /proc
            size = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize() + limits.memory
            resource.setrlimit(resource.RLIMIT_AS, (size, size))
        said = msgspec.json.encode(task())
        os.write(pipe, said)
        code = 0
    finally:
        end(code)


def _mark(course: Course, work: _Work, seeds: Sequence[int], folder: Path, limits: Allowance) -> Mark:
    """Mark what a group handed in, in the process of its own."""
    exercise, texts = work.exercise, work.texts
    solved, handed = folder / "course", folder / "group"
    try:
        write({**course.files, **{name: course.solved[name] for name in exercise.laws}}, solved)
        write({**work.models, **course.given}, solved)
        write({name: texts.get(name, course.files[name]) for name in exercise.laws}, handed)
        changes = exercise.filled(texts[exercise.file], exercise.file) if exercise.file in texts else []
        learned = any(LEARNED in each for each in (*changes, course.files[exercise.file]))
        with company(exercise.classes, solved, handed, limits.cpu_s, limits.memory, learned=learned) as cells:
            read = load(solved / exercise.file, *changes)
            if errors := [str(each) for each in check(read) if each.severity == "error"]:
                return work.failed(*(each.replace(f"{solved}/", "") for each in errors[:FEW]))
            cases = list[CaseMetrics]()
            for case, seed in product(read.cases(), seeds):
                cells.leave()
                cases += simulate_seeds(read, [seed], cases=[case], processes=1)[0].metrics.values()
        met = [each.passed for each in judge(cases)].count(True)
        words = [line.text for line in criteria_met(cases) if line.mark == "bad"]
        return Mark(work.group, exercise.name, met, exercise.criteria, words[1:])
    except ExplainedError as error:
        return work.failed(str(error).replace(f"{solved}/", ""))
    except Exception as error:  # noqa: BLE001 - a metric of the course that meets what its author did not expect
        return work.failed(f"{type(error).__name__}: {error}")


def _ended(
    running: dict[int, _Process], answers: selectors.BaseSelector, limits: Allowance, guard: int
) -> Iterator[Mark]:
    """Marks of the processes that end next, or that are ended for they took too long."""
    wait_s = min(each.until for each in running.values()) - time.monotonic()
    for key, _ in answers.select(max(wait_s, 0.0)):
        process = running[key.fd]
        said = os.read(key.fd, LONGEST)
        process.said.extend(said)
        if not said or len(process.said) > LONGEST:
            answers.unregister(key.fd)
            yield _result(process, _end(key.fd, running.pop(key.fd), guard), limits)
    for pipe, process in [*running.items()]:
        if time.monotonic() > process.until:
            answers.unregister(pipe)
            _end(pipe, running.pop(pipe), guard)
            words = f"took more than {2 * limits.cpu_s} s, of which its law may compute {limits.cpu_s} s (--limit)"
            yield process.work.failed(words)


def _end(pipe: int, process: _Process, guard: int) -> int:
    """End a process with all that it began; returns its status."""
    with suppress(ProcessLookupError):  # its group may be gone, or not there yet
        os.killpg(process.number, signal.SIGKILL)
    with suppress(ProcessLookupError):
        os.kill(process.number, signal.SIGKILL)
    os.close(pipe)
    with suppress(OSError):  # a guard that is gone
        os.write(guard, b"-%d\n" % process.number)  # no other process has its number yet
    return os.waitpid(process.number, 0)[1]


def _result(process: _Process, status: int, limits: Allowance) -> Mark:
    """The mark that a process said, if it ended as it should."""
    work, code = process.work, os.waitstatus_to_exitcode(status)
    if code == -signal.SIGXCPU:
        return work.failed(f"took more than {limits.cpu_s} s of computing time")
    if code < 0:
        return work.failed(f"its process was ended by {signal.Signals(-code).name}")
    try:
        mark = msgspec.json.decode(process.said, type=Mark)
    except msgspec.DecodeError:
        return work.failed(f"its process ended before the verdict, with exit code {code}")
    return msgspec.structs.replace(mark, group=work.group, exercise=work.exercise.name, of=work.exercise.criteria)
